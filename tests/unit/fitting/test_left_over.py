"""Features planted in a map of what is left over, each found at its place."""

import numpy as np
import pytest

from pyrcal.fitting.left_over import find_arms

N = 36
Y, X = np.indices((N, N)) - (N - 1) / 2
RADIUS = np.hypot(X, Y)


def residual_map(arms=()):
    level = 0.2 * (1.0 + 0.1 * np.random.default_rng(1).normal(size=(2, N, N)))
    for angle_deg, offset in arms:
        angle = np.deg2rad(angle_deg)
        forward = np.cos(angle) * X + np.sin(angle) * Y
        left = np.cos(angle) * Y - np.sin(angle) * X
        level[:, (np.abs(left - offset) < 0.7) & (forward > 0.0)] *= 2.5
    level[:, (RADIUS > N / 2) | (RADIUS < 0.3 * N / 2)] = np.nan
    return level


@pytest.mark.parametrize("arms", [((0, 0.0), (120, 0.0), (240, 0.0)), ((45, 2.2), (225, -2.2))])
def test_arms_are_found_radial_or_not(arms):
    found = sorted(find_arms(residual_map(arms)), key=lambda arm: arm.angle_deg)
    assert len(found) == len(arms)
    for arm, (angle, offset) in zip(found, arms, strict=True):
        assert abs((arm.angle_deg - angle + 180.0) % 360.0 - 180.0) <= 6.0
        assert arm.offset_subap == pytest.approx(offset, abs=1.2)


def test_a_map_without_arms_and_one_line_alone_have_none():
    assert find_arms(residual_map()) == ()
    assert find_arms(residual_map(((30, 0.0),))) == ()
