"""Shapes made of functions that end, tile by tile, against the same shapes everywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy

from service.errors import ModelError
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.local import LocalShapes, stack_shapes, tiles_of
from service.model.modes import ModalBasis
from service.model.pupil import instrument_pupil
from service.model.sensors.shack_hartmann.description import ShackHartmann
from tests.support.local import RECIPES, basis, many_actuators
from tests.support.numerics import SOMEWHERE, small_basis


class Everywhere(ModalBasis):
    """The same functions, of which nobody knows that they end."""

    is_local = False


def everywhere():
    names = ("surface", "mode_to_actuator", "coefficients", "variance_m2", "y_sign")
    return Everywhere(**{name: getattr(basis(), name) for name in names})


def local_shapes(sampling=2):
    pupil = instrument_pupil(many_actuators(), sampling)
    model = InteractionModel(many_actuators(), basis(), pupil_sampling=sampling, dtype=np.float64)
    shapes = model._render_modes(SOMEWHERE)
    assert isinstance(shapes, LocalShapes)
    return pupil, model, shapes


def test_every_lit_point_is_in_one_tile():
    pupil = instrument_pupil(many_actuators(), 3)
    tiles = tiles_of(pupil)
    places = np.concatenate([tile.places for tile in tiles])
    np.testing.assert_array_equal(np.sort(places), np.arange(len(pupil.points)))
    for tile in tiles:
        np.testing.assert_array_equal(tile.points[tile.lit], pupil.points[tile.places])


def test_a_gaussian_is_left_out_where_it_is_lower_than_a_millionth():
    surface = basis().surface
    point = np.array([[0.2, 0.3]])
    heights = surface.basis(point)[0]
    np.testing.assert_array_equal(surface.near(point), np.flatnonzero(heights >= 1e-6))


def test_all_forms_of_local_shapes_are_the_modes():
    """A millionth of a function is left out at most."""
    pupil, model, shapes = local_shapes()
    expected = basis().render(model._mirror_points(SOMEWHERE))
    np.testing.assert_allclose(shapes.array(), expected, atol=1.1e-6)
    rows = np.random.default_rng(1).normal(size=(7, len(pupil.points)))
    np.testing.assert_allclose(rows @ shapes, rows @ shapes.array(), atol=1e-11)
    np.testing.assert_allclose(
        scipy.sparse.csr_array(rows) @ shapes, rows @ shapes.array(), atol=1e-11
    )
    assert shapes.shape == expected.shape
    assert shapes.n_near < 160


def test_shapes_beside_one_another_are_seen_as_each_alone():
    pupil, model, shapes = local_shapes()
    turned = model._move_modes(SOMEWHERE, lambda at: at[:, ::-1] * [1.0, -1.0])
    rows = np.random.default_rng(2).normal(size=(5, len(pupil.points)))
    both = stack_shapes([shapes, turned])
    apart = np.hstack([rows @ shapes, rows @ turned])
    assert both.shape == (len(pupil.points), 2 * shapes.shape[1])
    np.testing.assert_allclose(rows @ both, apart, atol=1e-11)
    np.testing.assert_allclose(scipy.sparse.csr_array(rows) @ both, apart, atol=1e-11)
    arrays = [shapes.array(), turned.array()]
    np.testing.assert_allclose(rows @ stack_shapes(arrays), apart, atol=1e-11)


def test_few_modes_are_cheaper_as_an_array():
    some = basis().subset(np.arange(20))
    model = InteractionModel(many_actuators(), some, pupil_sampling=2)
    shapes = model._render_modes(SOMEWHERE)
    assert isinstance(shapes, np.ndarray)
    expected = some.render(model._mirror_points(SOMEWHERE))
    np.testing.assert_allclose(shapes, expected, atol=2e-6)


@pytest.mark.parametrize("kept_bytes", [0.0, 1e9], ids=["streamed", "kept"])
@pytest.mark.parametrize("stop", Stop)
def test_the_matrix_and_its_derivatives_are_those_of_functions_without_end(stop, kept_bytes):
    """1e-5 in every column, of its own norm, or of a derivative the mean column's."""
    instrument = many_actuators(stop)
    local = InteractionModel(instrument, basis(), pupil_sampling=2, kept_bytes=kept_bytes)
    whole = InteractionModel(instrument, everywhere(), pupil_sampling=2)
    found, expected = local.linearise(SOMEWHERE), whole.linearise(SOMEWHERE)
    assert isinstance(local._render_modes(SOMEWHERE), LocalShapes)
    lit = np.linalg.norm(expected.matrix, axis=0) > 1e-2 * np.linalg.norm(expected.matrix, 2)
    for one, other in zip(
        (found.matrix, *found.derivatives), (expected.matrix, *expected.derivatives), strict=True
    ):
        apart = np.linalg.norm(one - other, axis=0)
        assert np.all(apart[lit] < 1e-5 * np.linalg.norm(other, axis=0)[lit].mean())


@pytest.mark.parametrize(("order", "normalisation"), RECIPES)
def test_what_is_streamed_is_the_jacobian_times_the_shapes(order, normalisation):
    plain = many_actuators()
    instrument = replace(
        plain, slopes=replace(plain.slopes, order=order, normalisation=normalisation)
    )
    model = InteractionModel(
        instrument, basis(), pupil_sampling=2, dtype=np.float64, kept_bytes=0.0
    )
    response, shapes = model.sensor.at((0.21, -0.13)), model._render_modes(SOMEWHERE)
    expected = response.jacobian() @ shapes.array()
    np.testing.assert_allclose(
        response.apply(shapes), expected, atol=1e-10 * np.abs(expected).max()
    )


def test_a_sparse_jacobian_takes_local_shapes_as_it_takes_an_array():
    plain = many_actuators()
    lenslets = replace(plain, wfs=ShackHartmann(n_subapertures=24, wavelength_m=600e-9))
    model = InteractionModel(lenslets, basis(), dtype=np.float64)
    shapes = model._render_modes(SOMEWHERE)
    assert isinstance(shapes, LocalShapes)
    expected = model.measure_signals(SOMEWHERE, shapes.array())
    np.testing.assert_allclose(
        model.measure_signals(SOMEWHERE, shapes), expected, atol=1e-10 * np.abs(expected).max()
    )


def test_functions_that_reach_everywhere_have_no_patch():
    with pytest.raises(ModelError, match="expected local ones"):
        small_basis().patch(np.zeros((1, 2)))
