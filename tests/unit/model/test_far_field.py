"""Sums of thin plates, far ones as polynomials."""

from functools import cache

import numpy as np
import pytest

from service.model.far_field import FAR_DISTANCE_RATIO, TILE_SUBAP, PlateSum
from service.model.surface import ThinPlate

RADIUS_SUBAP = 15.0
ROUNDED = 6e-8
"""What float32 rounds, relative."""


@cache
def mirror():
    """Return 600 actuators scattered over a disc."""
    rng = np.random.default_rng(3)
    radius = RADIUS_SUBAP * np.sqrt(rng.random(600))
    angle = 2 * np.pi * rng.random(600)
    return ThinPlate(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]))


@cache
def modes():
    """Return the sum of ten shapes: a plane, a wave of 3 subapertures, random strokes."""
    surface, rng = mirror(), np.random.default_rng(4)
    x, y = surface.positions.T
    smooth = np.column_stack([2.0 + 3.0 * x - y, np.sin(2 * np.pi * x / 3.0)])
    strokes = np.hstack([smooth, rng.standard_normal((len(x), 8))])
    return PlateSum(surface=surface, coefficients=surface.coefficients(strokes))


def places(n=900, reach=17.0):
    """Return points over the disc and a little beyond, the first on an actuator."""
    points = np.random.default_rng(5).uniform(-reach, reach, (n, 2))
    points[0] = mirror().positions[7]
    return points


def test_heights_are_those_of_all_plates_one_by_one():
    direct = mirror().basis(places()) @ modes().coefficients
    error = np.abs(modes().heights(places()) - direct).max(axis=0)
    assert np.all(error < 0.01 * ROUNDED * np.abs(direct).max(axis=0))


def test_slopes_are_those_of_all_plates_one_by_one():
    along = np.random.default_rng(6).standard_normal((900, 2))
    direct = mirror().slope(places(), along) @ modes().coefficients
    error = np.abs(modes().slopes(places(), along) - direct).max(axis=0)
    assert np.all(error < 0.05 * ROUNDED * np.abs(direct).max(axis=0))


def test_slopes_are_the_derivative_of_the_heights():
    points, along = places(50), np.array([0.6, -0.8])
    step = 1e-4
    found = modes().slopes(points, np.broadcast_to(along, points.shape))
    beside = modes().heights(points + step * along) - modes().heights(points - step * along)
    # r² log r bends without bound at its own actuator, on which the first point lies
    np.testing.assert_allclose(found[1:], (beside / (2 * step))[1:], rtol=1e-3, atol=1e-2)


def test_a_plane_stays_a_plane_whatever_tile_it_is_read_in():
    points = places()
    plane = 2.0 + 3.0 * points[:, 0] - points[:, 1]
    np.testing.assert_allclose(modes().heights(points)[:, 0], plane, atol=1e-6)


def test_no_actuator_is_far_from_a_tile_that_is_near():
    modes().heights(places())
    for tile in modes().tiles.values():
        apart = np.abs(mirror().positions @ [1.0, 1.0j] - tile.middle)
        expected = int(np.sum(apart < FAR_DISTANCE_RATIO * TILE_SUBAP / np.sqrt(2.0)))
        assert len(tile.near) == expected


@pytest.mark.parametrize("n", [0, 1])
def test_no_point_and_one_point_are_points_too(n):
    points = places()[:n]
    assert modes().heights(points).shape == modes().slopes(points, points).shape == (n, 10)
