"""How much mis-registration a loop of the full telescope takes, against the measured limits."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from service.control.gate import judge
from service.control.loop import ControlLoop, pole_radius
from service.control.reconstructor import invert
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from tests.support.numerics import flao_matrix, flao_model

GAIN = 0.5
TINY = np.diag(np.array([1e-4, 1e-4, 1e-6, 1e-6]) ** 2)


@cache
def reconstructor(n_modes: int):
    return invert(flao_matrix(), n_modes).matrix


def radius(n_modes: int, alpha: Misregistration) -> float:
    """Of the aligned reconstructor when the mirror is elsewhere, with the exact D."""
    matrix = flao_model().interaction_matrix(alpha)[:, :n_modes]
    return float(pole_radius(np.linalg.eigvals(GAIN * reconstructor(n_modes) @ matrix)).max())


LIMITS = [
    (400, "shift", 0.34, lambda v: Misregistration(shift_x_subap=v)),
    (400, "rotation", 1.4, lambda v: Misregistration(rotation_rad=np.deg2rad(v))),
    (400, "magnification", 0.04, lambda v: Misregistration(magnification=1 + v)),
]
"""Seen in closed-loop simulations at a gain of 0.5."""


@pytest.mark.parametrize(
    ("n_modes", "limit", "place"),
    [
        pytest.param(n, v, f, id=name, marks=() if name == "shift" else pytest.mark.long)
        for n, name, v, f in LIMITS
    ],
)
def test_400_modes_hold_below_and_fail_above_the_limits_seen(n_modes, limit, place):
    """20 % either way: the limits were read off runs a step of 0.05 apart."""
    assert radius(n_modes, place(0.8 * limit)) < 1.0
    assert radius(n_modes, place(1.2 * limit)) > 1.0


def test_a_shift_of_034_subapertures_is_the_edge_of_stability_for_400_modes():
    """2 % of the radius."""
    assert radius(400, Misregistration(shift_x_subap=0.34)) == pytest.approx(1.0, abs=0.02)


def test_more_modes_take_less_shift():
    shifted = Misregistration(shift_x_subap=0.25)
    assert radius(594, shifted) > radius(400, shifted) > radius(100, shifted)


def test_the_gate_refuses_at_the_limit_and_accepts_well_inside():
    """A linearisation half-way: what the service would have at hand."""
    shifts = (0.05, 0.34)
    at_hand: Linearisation = flao_model().linearise(Misregistration(shift_x_subap=0.2))
    loop = ControlLoop(frame_rate_hz=1000.0, gains=np.full(400, GAIN), leak=1.0, delay_frames=2.0)
    near, far = (
        judge(
            reconstructor(400),
            at_hand,
            Misregistration(shift_x_subap=shift),
            TINY,
            loop,
            bound=0.95,
        )
        for shift in shifts
    )
    assert near.accepted, near.reason
    assert not far.accepted
    assert far.worst_pole_radius == pytest.approx(1.0, abs=0.03)
