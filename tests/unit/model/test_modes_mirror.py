"""Influence functions."""

from __future__ import annotations

import numpy as np
import pytest

from service.instrument.mirrors import rings
from service.model.instrument import Mirror
from service.model.kinds import Influence, InfluenceShape
from service.model.surface import Gaussian, ThinPlate, mirror_surface

POSITIONS = rings(1, 4, 1.1)

SURFACES = {"thin plate": ThinPlate(POSITIONS), "gaussian": Gaussian(POSITIONS, 1.1, 0.35)}


@pytest.fixture
def points():
    return np.random.default_rng(3).uniform(-5, 5, (60, 2))


def test_thin_plate_influence_functions_are_one_at_their_own_actuator_and_zero_at_others():
    surface = ThinPlate(POSITIONS)
    influence = surface.coefficients(np.eye(len(POSITIONS)))
    heights = surface.basis(POSITIONS) @ influence
    np.testing.assert_allclose(heights, np.eye(len(POSITIONS)), atol=1e-10)


@pytest.mark.parametrize("plane", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.3, -0.2, 0.7)])
def test_thin_plates_reproduce_planes_everywhere_outside_the_actuators_too(points, plane):
    """A plane has no bending energy."""
    surface = ThinPlate(POSITIONS)
    strokes = (plane[0] + POSITIONS @ plane[1:])[:, None]
    heights = surface.basis(2 * points) @ surface.coefficients(strokes)
    np.testing.assert_allclose(heights[:, 0], plane[0] + 2 * points @ plane[1:], atol=1e-9)


def test_gaussian_influence_falls_to_the_coupling_at_one_pitch():
    surface = Gaussian(np.array([[0.0, 0.0], [3.0, 4.0]]), pitch=5.0, coupling=0.35)
    strokes = surface.coefficients(np.eye(2))
    heights = surface.basis(np.array([[0.0, 0.0], [3.0, 4.0]])) @ strokes
    np.testing.assert_allclose(heights, [[1.0, 0.35], [0.35, 1.0]])


@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
def test_slopes_agree_with_central_differences(surface, points):
    """Tolerance: the difference's own error at a step of 1e-5, third derivatives of order one."""
    direction = np.random.default_rng(4).normal(size=points.shape)
    step = 1e-5
    expected = surface.basis(points + step * direction) - surface.basis(points - step * direction)
    np.testing.assert_allclose(
        surface.slope(points, direction), expected / (2 * step), rtol=1e-6, atol=1e-8
    )


@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
def test_slopes_are_finite_on_the_actuators_and_linear_in_the_direction(surface):
    along = np.tile([1.0, 2.0], (len(POSITIONS), 1))
    slope = surface.slope(POSITIONS, along)
    assert np.all(np.isfinite(slope))
    np.testing.assert_allclose(surface.slope(POSITIONS, -3 * along), -3 * slope)


@pytest.mark.parametrize(
    ("influence", "kind"), [(Influence.THIN_PLATE, ThinPlate), (Influence.GAUSSIAN, Gaussian)]
)
def test_a_mirror_in_metres_becomes_a_surface_in_subapertures(influence, kind):
    shape = InfluenceShape(influence=influence, coupling=0.2)
    mirror = Mirror(positions_m=POSITIONS, pitch_m=1.1, shape=shape)
    surface = mirror_surface(mirror, subaperture_m=0.5)
    assert isinstance(surface, kind)
    np.testing.assert_allclose(surface.positions, 2 * POSITIONS)


def test_the_gaussians_pitch_is_scaled_with_the_positions():
    mirror = Mirror(
        positions_m=np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
        pitch_m=1.0,
        shape=InfluenceShape(influence=Influence.GAUSSIAN, coupling=0.2),
    )
    surface = mirror_surface(mirror, subaperture_m=0.25)
    assert surface.basis(np.array([[4.0, 0.0]]))[0, 0] == pytest.approx(0.2)
