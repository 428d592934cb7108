from __future__ import annotations

import pytest

from pyrcal_studies.heritier2018.scans import pull_reason
from pyrcal_studies.heritier2018.telescope import beyond_actuators_subap


def test_errors_beyond_sigma_are_the_telescopes_only_if_the_ideal_one_is_free_of_them() -> None:
    assert "displaced actuators" in pull_reason(1.2)
    assert "is in the model" in pull_reason(4.0)


def test_at_the_papers_magnification_the_pupil_reaches_half_a_subaperture_too_far() -> None:
    # outermost ring (14 - 0.5) x 0.30 m, subapertures of 8.22 m / 30
    assert beyond_actuators_subap(1.0) == pytest.approx(15 - 4.05 / 0.274, abs=1e-6)
    assert beyond_actuators_subap(0.98) == pytest.approx(0.515, abs=1e-3)
