"""Modes measured on a grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.errors import ModelError
from service.model.instrument import TabulatedModes
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.tabulated import (
    MARGIN_SUBAP,
    TabulatedBasis,
    fill_table,
    known_samples,
    pad_mask,
)
from tests.support.numerics import N_MODES, small_basis, small_instrument

SUBAPERTURE_M = 8.0 / 12


def table(points_per_subaperture=4.0, half_subap=9.5, dtype=np.float64):
    """The small instrument's own modes, on a grid that reaches well beyond the pupil."""
    half = int(half_subap * points_per_subaperture)
    line = np.arange(-half, half + 1) / points_per_subaperture
    x, y = np.meshgrid(line, line)
    cube = small_basis().render(np.column_stack([x.ravel(), y.ravel()]))
    cube = cube.T.reshape(N_MODES, len(line), len(line)).astype(dtype)
    return cube, np.hypot(x, y)


def basis_of(cube, known=None, points_per_subaperture=4.0, **mount) -> TabulatedBasis:
    modes = TabulatedModes(
        cube=cube,
        pitch_m=SUBAPERTURE_M / points_per_subaperture,
        known=known_samples(cube) if known is None else known,
        **mount,
    )
    basis = modal_basis(replace(small_instrument(), mirror=modes))
    assert isinstance(basis, TabulatedBasis)
    return basis


@pytest.fixture(scope="module")
def basis():
    return basis_of(table()[0])


@pytest.fixture
def points():
    return np.random.default_rng(5).uniform(-4.2, 4.2, (200, 2))


def polynomial(x, y):
    return 0.3 - x + 0.5 * y + 0.2 * x * y - 0.1 * y**2 + 0.03 * x**3 - 0.02 * x * y**2


def test_a_cubic_surface_is_reproduced_exactly_between_the_points(points):
    """Away from the table's edge, where splines are mirrored: 1e-6 is what reaches 20 lines in."""
    line = np.arange(-40, 41) / 4.0
    x, y = np.meshgrid(line, line)
    basis = basis_of(polynomial(x, y)[None])
    expected = polynomial(*points.T)
    np.testing.assert_allclose(basis.render(points)[:, 0], expected, atol=1e-6)


def test_tabulated_modes_are_the_modes_they_were_sampled_from(basis, points):
    """0.5 % of the steepest of 40 modes at 4 points per subaperture."""
    expected = small_basis().render(points)
    error = np.linalg.norm(basis.render(points) - expected, axis=0)
    assert np.all(error < 5e-3 * np.linalg.norm(expected, axis=0))


def test_slopes_agree_with_central_differences(basis, points):
    direction = np.random.default_rng(6).normal(size=points.shape)
    ahead, behind = (basis.render(points + s * direction) for s in (1e-5, -1e-5))
    expected = (ahead - behind) / 2e-5
    np.testing.assert_allclose(basis.render_slope(points, direction), expected, atol=1e-6)


def test_a_mirror_seen_from_behind_has_its_y_axis_reversed(basis, points):
    behind = basis_of(table()[0], parity=-1)
    flip = np.array([1.0, -1.0])
    direction = np.random.default_rng(7).normal(size=points.shape)
    for found in (behind, replace(basis, y_sign=-1.0)):
        np.testing.assert_array_equal(found.render(points), basis.render(points * flip))
        np.testing.assert_allclose(
            found.render_slope(points, direction),
            basis.render_slope(points * flip, direction * flip),
            atol=1e-12,
        )


def test_a_table_of_single_precision_stays_one(points):
    single, double = (basis_of(table(dtype=dtype)[0]) for dtype in (np.float32, np.float64))
    assert single.coefficients.dtype == np.float32
    np.testing.assert_allclose(single.render(points), double.render(points), atol=2e-5)


def test_a_subset_of_all_modes_in_order_is_no_copy(basis):
    assert basis.subset(np.arange(basis.n_modes)) is basis
    assert basis.subset(np.arange(basis.n_modes)[::-1]) is not basis


def test_combinations_keep_the_precision_of_the_table():
    single = basis_of(table(dtype=np.float32)[0])
    combined = single.combine_modes(np.full((single.n_modes, 2), 0.5))
    assert combined.coefficients.dtype == np.float32


def test_a_subset_is_those_columns(basis, points):
    some = basis.subset([7, 2])
    assert some.n_modes == 2
    np.testing.assert_allclose(some.render(points), basis.render(points)[:, [7, 2]], atol=1e-14)


def test_expected_variances_are_those_of_the_modes_it_tabulates(basis):
    """2 %: the table of the steepest modes is a little off, and so is their overlap."""
    np.testing.assert_allclose(basis.variance_m2, small_basis().variance_m2, rtol=0.02)


# --- where a table ends


def test_a_table_is_known_up_to_its_last_sample_and_not_beyond():
    basis = basis_of(table(half_subap=6.0)[0])
    places = np.array([[6.0, 0.0], [-6.0, 6.0], [6.01, 0.0], [0.0, -6.01]])
    np.testing.assert_array_equal(basis.known(places), [True, True, False, False])


def test_zeros_outside_and_nan_are_found_and_zero_lines_of_odd_modes_are_not():
    cube, radius = table()
    odd = cube[[0]] * (radius < 6.0)
    odd[0, :, odd.shape[2] // 2] = 0.0
    found = known_samples(odd)
    inside = radius < 5.5
    assert found[inside].all()
    assert not found[radius > 6.5].any()
    cube[3, 10, 10] = np.nan
    assert not known_samples(cube)[10, 10]
    assert known_samples(cube).sum() == cube[0].size - 1


def test_a_tilt_is_continued_as_a_tilt():
    """Oddly about the nearest sample: exact for a plane wherever the image is known."""
    y, x = np.mgrid[-10:11, -10:11].astype(float)
    plane = (2.0 + 0.3 * x - 0.7 * y)[None]
    known = np.hypot(x, y) < 7.0
    shapes = fill_table(np.where(known, plane, np.nan), known, (2, 3))
    y, x = np.mgrid[-12:13, -13:14].astype(float)
    near = np.hypot(x, y) < 10.0
    found = shapes[:, 0].reshape(25, 27)
    np.testing.assert_allclose(found[near], (2.0 + 0.3 * x - 0.7 * y)[near], atol=1e-12)
    assert np.all(np.isfinite(found))


def test_a_negative_margin_cuts():
    known = np.ones((9, 11), bool)
    assert pad_mask(known, (-2, 1)).shape == (5, 13)
    cube = np.arange(99.0).reshape(1, 9, 11)
    shapes = fill_table(cube, known, (-2, -1))
    np.testing.assert_array_equal(shapes[:, 0], cube[0, 2:-2, 1:-1].ravel())


def test_a_table_much_larger_than_the_pupil_is_cut_to_what_can_be_reached():
    basis = basis_of(table(half_subap=20.0)[0])
    assert len(basis.surface_known) <= 2 * 4 * (6 + MARGIN_SUBAP) + 3


def test_a_table_too_coarse_for_the_sensor_is_refused():
    with pytest.raises(ModelError, match=r"1\.50 points per subaperture; expected at least 2"):
        basis_of(table(1.5)[0], points_per_subaperture=1.5)


def test_a_table_that_knows_nothing_is_refused():
    with pytest.raises(ModelError, match="knows nothing"):
        basis_of(np.zeros((3, 60, 60)))


# --- in the model


def test_slopes_near_unknown_surface_are_named_and_follow_the_registration():
    cube, radius = table(half_subap=6.5)
    model = InteractionModel(small_instrument(), basis_of(cube))
    assert not model.unknown_rows(Misregistration()).any()
    masked = InteractionModel(small_instrument(), basis_of(cube, radius < 7.0))
    grown = Misregistration(magnification=0.85)
    rows = masked.unknown_rows(grown)
    assert rows.any()
    assert not rows.all()
    y, x = np.nonzero(masked.valid)
    distance = np.hypot(x - 5.5, y - 5.5)
    known_radius = 7.0 * 0.85
    assert rows.reshape(2, -1)[:, distance > known_radius - 0.2].all()
    assert not rows.reshape(2, -1)[:, distance < known_radius - 2.6].any()


def test_with_the_mirror_as_stop_the_same_part_of_the_beam_is_unknown_wherever_the_images_are():
    """A hole in the table at +x: one subaperture further along x when the images move by one."""
    cube, _ = table()
    known = np.ones(cube.shape[1:], bool)
    half = len(known) // 2
    known[half : half + 2, half + 12 : half + 14] = False
    model = InteractionModel(small_instrument(), basis_of(cube, known))

    def columns(alpha):
        plane = np.zeros(model.valid.shape, bool)
        plane[model.valid] = model.unknown_rows(alpha)[: model.valid.sum()]
        return plane

    at_rest, moved = columns(Misregistration()), columns(Misregistration(shift_x_subap=1.0))
    assert 4 <= at_rest.sum() <= 16
    np.testing.assert_array_equal(moved[:, 1:], at_rest[:, :-1])


def test_the_matrix_of_a_table_is_that_of_its_modes(basis):
    """0.5 % at 4 points per subaperture."""
    alpha = Misregistration(shift_x_subap=0.3, rotation_rad=0.02, magnification=1.01)
    tabulated, analytic = (
        InteractionModel(small_instrument(), b).interaction_matrix(alpha)
        for b in (basis, small_basis())
    )
    assert np.linalg.norm(tabulated - analytic) < 5e-3 * np.linalg.norm(analytic)
