"""Karhunen-Loeve modes."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from service.errors import ModelError
from service.instrument.mirrors import grid, rings
from service.instrument.reader import load_instrument
from service.model import karhunen_loeve
from service.model.instrument import Mirror
from service.model.kinds import Influence, InfluenceShape
from service.model.modes import ModalBasis, karhunen_loeve_basis
from service.model.pupil import instrument_pupil
from service.model.surface import Gaussian, ThinPlate, mirror_surface
from tests.support.numerics import N_MODES, flao_basis, small_basis, small_instrument

STEEPEST = 1e-6
"""Largest change of a stroke, relative to the largest, that rounding in the covariance may make."""

TURN = np.array([[0.9801, -0.1987], [0.1987, 0.9801]])
"""About 11.5 degrees: a mirror mounted askew has no symmetry left in the sensor's axes."""


def without_symmetry():
    jitter = np.random.default_rng(8).normal(0.0, 0.08, (105, 2))
    return rings(1, 5, 0.8) + jitter


def on_pupil(basis: ModalBasis, sampling: int = 4, **instrument):
    """Piston-free modes and the weights of the pupil's points."""
    pupil = instrument_pupil(small_instrument(**instrument), sampling)
    shapes = basis.render(pupil.points)
    return shapes - pupil.weights @ shapes, pupil.weights, pupil.points


def tilt_parts(basis: ModalBasis, **instrument):
    """Correlation of modes 0 and 1 with the planes x and y over the pupil, ``(2, 2)``."""
    shapes, weights, points = on_pupil(basis, **instrument)
    planes = points / np.sqrt(weights @ points**2)
    return shapes[:, :2].T @ (planes * weights[:, None])


def test_modes_are_orthonormal_over_the_pupil_and_free_of_piston():
    """A unit command is 1 m RMS; 1e-9 is rounding, on the grid the norm is defined on."""
    shapes, weights, _ = on_pupil(small_basis())
    gram = shapes.T @ (shapes * weights[:, None])
    np.testing.assert_allclose(gram, np.eye(N_MODES), atol=1e-9)


def test_the_norm_hardly_depends_on_the_grid_it_is_taken_on():
    """1 %: edge cells of half the width, at the small instrument's 4 points a subaperture."""
    shapes, weights, _ = on_pupil(small_basis(), sampling=8)
    np.testing.assert_allclose(weights @ shapes**2, 1.0, atol=0.01)


def test_mode_zero_rises_along_x_and_mode_one_along_y():
    """0.95: the obscured edge lets a KL tilt bend a little away from the plane."""
    parts = tilt_parts(small_basis())
    assert parts[0, 0] > 0.95
    assert parts[1, 1] > 0.95
    assert abs(parts[0, 1]) < 1e-6
    assert abs(parts[1, 0]) < 1e-6


def test_the_first_variances_fall():
    variance = flao_basis().variance_m2
    assert np.all(variance > 0)
    assert np.all(np.diff(variance[:50]) <= 1e-3 * variance[:49])  # equal pairs in a fixed order
    assert np.all(variance[10:] < variance[:-10])


def test_the_full_instrument_has_594_modes_of_663_actuators():
    assert flao_basis().mode_to_actuator.shape == (663, 594)


@pytest.mark.parametrize("influence", Influence)
def test_command_and_surface_are_the_same_shape(influence):
    instrument = small_instrument(influence=influence)
    basis = karhunen_loeve_basis(instrument)
    points = np.random.default_rng(1).uniform(-5, 5, (20, 2))
    influence_functions = basis.surface.basis(points) @ basis.surface.coefficients(np.eye(105))
    np.testing.assert_allclose(
        basis.render(points), influence_functions @ basis.mode_to_actuator, atol=1e-9
    )


def test_mode_slopes_agree_with_central_differences():
    """1e-6: what rounding leaves of a difference over 2e-5."""
    basis, rng = small_basis(), np.random.default_rng(2)
    points, direction = rng.uniform(-5, 5, (30, 2)), rng.normal(size=(30, 2))
    ahead, behind = (basis.render(points + step * direction) for step in (1e-5, -1e-5))
    np.testing.assert_allclose(
        basis.render_slope(points, direction), (ahead - behind) / 2e-5, atol=1e-6
    )


def perturbed(monkeypatch, instrument):
    """The basis of this instrument when the covariance is off by one part in 1e12."""
    exact = karhunen_loeve.pupil_statistics

    def noisy(*arguments):
        gram, covariance = exact(*arguments)
        noise = np.random.default_rng(5).uniform(-1, 1, covariance.shape)
        return gram, covariance * (1 + 0.5e-12 * (noise + noise.T))

    with monkeypatch.context() as patch:
        patch.setattr(karhunen_loeve, "pupil_statistics", noisy)
        return karhunen_loeve_basis(instrument)


@pytest.mark.parametrize(
    "layout",
    [rings(1, 5, 0.8), grid(11, 0.8, 8.4), rings(1, 5, 0.8) @ TURN.T, without_symmetry()],
    ids=["rings", "grid", "rings askew", "no symmetry"],
)
def test_rounding_in_the_covariance_does_not_change_the_basis(monkeypatch, layout):
    """Neither the sign nor the orientation of a pair of equal variance is left to chance."""
    instrument = small_instrument(layout)
    strokes = karhunen_loeve_basis(instrument).mode_to_actuator
    again = perturbed(monkeypatch, instrument).mode_to_actuator
    np.testing.assert_allclose(again, strokes, atol=STEEPEST * np.abs(strokes).max())


@pytest.mark.long
def test_rounding_does_not_change_the_basis_of_the_full_instrument(monkeypatch):
    strokes = flao_basis().mode_to_actuator
    again = perturbed(monkeypatch, load_instrument("flao-lbt")).mode_to_actuator
    np.testing.assert_allclose(again, strokes, atol=STEEPEST * np.abs(strokes).max())


@pytest.mark.parametrize("layout", [without_symmetry(), rings(1, 5, 0.8) @ TURN.T])
def test_a_layout_without_symmetry_has_orthonormal_modes_too(layout):
    shapes, weights, _ = on_pupil(karhunen_loeve_basis(small_instrument(layout)))
    gram = shapes.T @ (shapes * weights[:, None])
    np.testing.assert_allclose(gram, np.eye(N_MODES), atol=1e-9)


def test_a_layout_without_symmetry_has_its_tilts_along_the_axes_too():
    parts = tilt_parts(karhunen_loeve_basis(small_instrument(without_symmetry())))
    assert parts[0, 0] > 0.95
    assert parts[1, 1] > 0.95


@pytest.mark.parametrize("influence", Influence)
@pytest.mark.parametrize(("nx", "ny"), [(11, 9), (9, 11)])
def test_a_mirror_denser_along_one_axis_still_has_the_x_tilt_first(influence, nx, ny):
    """Whichever of its two tilts has a variance a few millionths larger."""
    y, x = np.meshgrid(np.linspace(-4.2, 4.2, ny), np.linspace(-4.2, 4.2, nx), indexing="ij")
    layout = np.column_stack([x.ravel(), y.ravel()])
    parts = tilt_parts(karhunen_loeve_basis(small_instrument(layout, influence=influence)))
    assert parts[0, 0] > 0.95
    assert parts[1, 1] > 0.95


def test_as_many_modes_as_actuators_are_refused_because_piston_is_not_one():
    with pytest.raises(
        ModelError,
        match="n_modes = 105; expected at least tip and tilt, and fewer than the 105 actuators",
    ):
        karhunen_loeve_basis(small_instrument(n_modes=105))


def test_every_mode_but_piston_can_be_asked_for():
    basis = karhunen_loeve_basis(small_instrument(n_modes=104))
    assert basis.variance_m2.shape == (104,)
    assert np.all(np.isfinite(basis.coefficients))


def test_a_basis_that_is_sent_leaves_its_sums_behind_and_renders_the_same():
    basis, points = small_basis(), np.array([[0.3, -1.2], [4.0, 2.0]])
    before = basis.render(points)
    sent = pickle.dumps(basis)
    assert len(sent) < 2 * basis.coefficients.nbytes + basis.mode_to_actuator.nbytes
    np.testing.assert_array_equal(pickle.loads(sent).render(points), before)


# --- modes of a mirror


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
