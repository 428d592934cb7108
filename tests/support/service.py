"""What tests of several modules share of system.test_service."""

from __future__ import annotations

from tests.support.night import ALPHA

TOLERANCE = {
    "shift_x_subap": 0.02,
    "shift_y_subap": 0.02,
    "rotation_deg": 0.05,
    "magnification": 0.002,
}


def check_registration(known):
    for name, tolerance in TOLERANCE.items():
        error = known["alpha"][name] - ALPHA[name]
        assert abs(error) < tolerance, (name, error)
        assert abs(error) < 4 * known["sigma"][name], (name, error, known["sigma"][name])
