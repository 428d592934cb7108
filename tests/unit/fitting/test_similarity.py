"""Maps that turn, scale and shift."""

import numpy as np
import pytest

from pyrcal.fitting.guide_star import Similarity
from service.model.misregistration import Misregistration, rotation

ALPHA = Misregistration(shift_x_subap=0.3, shift_y_subap=-0.2, rotation_rad=0.4, magnification=1.1)
POINTS = np.random.default_rng(1).normal(size=(20, 2))


def test_it_is_what_a_registration_does_to_the_mirror():
    """conventions.md: turned and scaled first, shifted last."""
    expected = 1.1 * POINTS @ rotation(0.4).T + [0.3, -0.2]
    assert Similarity.of(ALPHA).points(POINTS) == pytest.approx(expected)


def test_a_registration_comes_back_from_its_map():
    assert Similarity.of(ALPHA).alpha.vector == pytest.approx(ALPHA.vector)


def test_maps_follow_one_another():
    first, then = Similarity(turn=2j, shift=1 + 0j), Similarity(turn=0.5 + 0j, shift=3j)
    assert then.after(first).points(POINTS) == pytest.approx(then.points(first.points(POINTS)))


def test_the_inverse_leads_back():
    there = Similarity.of(ALPHA)
    assert there.inverse.points(there.points(POINTS)) == pytest.approx(POINTS)


def test_in_another_unit_the_same_points_land_in_the_same_places():
    there = Similarity.of(ALPHA)
    assert there.scale_unit(0.2).points(POINTS / 0.2) * 0.2 == pytest.approx(there.points(POINTS))
