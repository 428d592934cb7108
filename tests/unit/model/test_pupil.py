"""The grey pupil."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.errors import ModelError
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.pupil import Illumination, annular_pupil, instrument_pupil
from service.model.sensors.pyramid.description import pyramid_in
from service.model.sensors.pyramid.table import FftGrid
from tests.support.numerics import small_basis, small_instrument, small_model


def pupil(sampling=3, diameter=30.0, obscuration=0.11, n=30):
    return annular_pupil(
        n_subapertures=n, diameter_subap=diameter, obscuration_ratio=obscuration, sampling=sampling
    )


@pytest.mark.parametrize("sampling", [1, 2, 3, 4])
@pytest.mark.parametrize(("diameter", "obscuration"), [(30.0, 0.11), (29.3, 0.0), (12.0, 0.3)])
def test_the_light_adds_up_to_the_area_of_the_annulus(sampling, diameter, obscuration):
    """1e-4: what 32 Gauss-Legendre nodes per cell leave on the edge of a disc."""
    area = pupil(sampling, diameter, obscuration).amplitude.sum() / sampling**2
    expected = np.pi / 4 * diameter**2 * (1 - obscuration**2)
    assert area == pytest.approx(expected, rel=1e-4)


def test_cells_well_inside_are_full_and_cells_well_outside_are_dark():
    grid = pupil()
    radius = np.hypot(grid.coordinates[:, None], grid.coordinates)
    assert np.all(grid.amplitude[(radius > 2.2) & (radius < 14.5)] == pytest.approx(1.0))
    assert np.all(grid.amplitude[radius > 15.5] == 0.0)
    assert np.all(grid.amplitude[radius < 1.2] == pytest.approx(0.0))


def test_an_edge_cell_holds_the_fraction_that_is_lit():
    """A disc of diameter 1 in one cell of width 1 covers π/4 of it."""
    grid = pupil(sampling=1, diameter=1.0, obscuration=0.0, n=1)
    assert grid.amplitude[0, 0] == pytest.approx(np.pi / 4, rel=1e-3)


def test_the_pupil_is_its_own_image_under_flips_and_transposition():
    amplitude = pupil().amplitude
    np.testing.assert_allclose(amplitude, amplitude[::-1], atol=1e-12)
    np.testing.assert_allclose(amplitude, amplitude[:, ::-1], atol=1e-12)
    np.testing.assert_allclose(amplitude, amplitude.T, atol=1e-3)  # chords run along one axis


def test_the_centre_of_the_grid_is_the_centre_of_the_pupil():
    grid = pupil(sampling=2)
    np.testing.assert_allclose(grid.coordinates, -grid.coordinates[::-1])
    assert np.diff(grid.coordinates) == pytest.approx(0.5)
    np.testing.assert_allclose(grid.weights @ grid.points, 0.0, atol=1e-12)


def test_points_are_x_then_y_in_row_major_order_and_weights_sum_to_one():
    grid = pupil()
    first, second = grid.points[:2]
    assert first[1] == second[1]  # same row
    assert second[0] - first[0] == pytest.approx(1 / 3)  # one step along x
    assert len(grid.points) == np.count_nonzero(grid.lit)
    assert grid.weights.sum() == pytest.approx(1.0)


def test_a_pupil_wider_than_the_sensor_gets_a_grid_that_holds_it():
    assert pupil(sampling=2, diameter=31.5).coordinates[-1] == pytest.approx(15.75)


@pytest.mark.parametrize(
    "wrong", [{"sampling": 0}, {"obscuration": 1.0}, {"obscuration": -0.1}, {"diameter": 0.0}]
)
def test_impossible_pupils_are_refused_with_what_was_expected(wrong):
    with pytest.raises(ModelError, match=r"expected >= 1, in \[0, 1\), > 0"):
        pupil(**wrong)


# --- illumination


def ramp(slope: float = 0.02, reach: int = 10) -> Illumination:
    """Light that rises along +x."""
    u = np.arange(-reach, reach + 1.0)
    return Illumination(coordinates=u, intensity=np.tile(1.0 + slope * u, (len(u), 1)))


def test_the_amplitude_is_the_root_of_the_intensity():
    pupil = annular_pupil(n_subapertures=12, diameter_subap=12.0, obscuration_ratio=0.1, sampling=3)
    lit = pupil.lit_by(ramp())
    ratio = (lit.amplitude[pupil.lit] / pupil.amplitude[pupil.lit]) ** 2
    np.testing.assert_allclose(ratio, 1.0 + 0.02 * pupil.points[:, 0], rtol=1e-12)
    np.testing.assert_array_equal(lit.lit, pupil.lit)


def test_rows_are_y_and_beyond_the_map_the_edge_goes_on():
    light = ramp(reach=2)
    found = light.at(np.array([-5.0, 0.5, 5.0]))
    np.testing.assert_allclose(found, np.tile([0.96, 1.01, 1.04], (3, 1)))


def test_even_light_of_any_strength_changes_no_slope():
    u = np.array([-10.0, 10.0])
    dim = Illumination(coordinates=u, intensity=np.full((2, 2), 0.3))
    lit = InteractionModel(small_instrument(), small_basis(), illumination=dim)
    np.testing.assert_allclose(
        lit.interaction_matrix(Misregistration()),
        small_model().interaction_matrix(Misregistration()),
        rtol=1e-3,
        atol=1e-3 * np.abs(small_model().interaction_matrix(Misregistration())).max(),
    )


def test_slopes_are_larger_where_there_is_more_light():
    lit = InteractionModel(small_instrument(), small_basis(), illumination=ramp(0.05))
    even = small_model().interaction_matrix(Misregistration())[:, 0]
    uneven = lit.interaction_matrix(Misregistration())[:, 0]
    n = len(even) // 2
    x = np.nonzero(lit.valid)[1]
    left, right = x < 4, x > 7
    gain = uneven[:n] / even[:n]
    assert np.median(gain[right]) > 1.1 > 0.9 > np.median(gain[left])


@pytest.mark.parametrize(
    ("intensity", "text"),
    [
        (np.ones((2, 3)), r"found \(2, 3\); expected \(3, 3\)"),
        (np.full((3, 3), np.nan), "negative or not finite"),
        (np.full((3, 3), -1.0), "negative or not finite"),
        (np.zeros((3, 3)), "no light at all"),
    ],
)
def test_light_that_cannot_be_is_refused(intensity, text):
    with pytest.raises(ModelError, match=text):
        Illumination(coordinates=np.arange(3.0), intensity=intensity)


def test_points_of_a_simulated_pupil_are_lit_or_not():
    """As OOPAO draws them, on its own grid alone."""
    about, n = small_instrument(), 2 * small_instrument().wfs.n_subapertures
    grid = FftGrid(points_per_subaperture=2, width_subap=2.0 * n)
    simulated = replace(about, obscuration_ratio=0.0, wfs=replace(pyramid_in(about), fft_grid=grid))
    along = np.linspace(-n / 2, n / 2, n)
    drawn = np.add.outer(along**2, along**2) < ((n + 1) / 2) ** 2
    np.testing.assert_array_equal(instrument_pupil(simulated, 2).amplitude, drawn)
    assert np.any(instrument_pupil(simulated, 3).amplitude % 1.0)
