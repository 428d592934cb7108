"""The modulated pyramid at rest; the Jacobian itself is checked against an FFT in tests/physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.errors import ModelError
from service.model.interaction import InteractionModel
from service.model.pupil import instrument_pupil
from service.model.sensors.pyramid.description import Pyramid
from service.model.sensors.pyramid.optics import Nodes, PyramidOptics, enough_modulation_points
from tests.numerics import small_basis, small_instrument, small_model


def optics(*, modulation: float = 3.0, **arguments) -> PyramidOptics:
    instrument = small_instrument()
    wfs = Pyramid(
        n_subapertures=12,
        wavelength_m=750e-9,
        modulation_lambda_over_d=modulation,
        pupil_separation_subap=15.0,
    )
    return PyramidOptics(wfs=wfs, pupil=instrument_pupil(instrument, 3), **arguments)


@pytest.mark.parametrize("n_modulation", [26, 27, 29, 0])
def test_fewer_than_28_points_or_an_odd_number_are_refused_at_three_lambda_over_d(n_modulation):
    """20 points make tip wrong by 5 %, 28 by 5e-5."""
    with pytest.raises(ModelError, match=r"expected an even number >= 28 for a radius of 3.0 λ/D"):
        optics(n_modulation=n_modulation)


@pytest.mark.parametrize(("modulation", "least"), [(2.0, 22), (3.0, 28), (5.0, 40)])
def test_a_wider_modulation_needs_more_points(modulation, least):
    optics(modulation=modulation, n_modulation=least)
    with pytest.raises(ModelError, match="modulation points"):
        optics(modulation=modulation, n_modulation=least - 2)


@pytest.mark.parametrize(("modulation", "enough"), [(2.0, 22), (2.5, 26), (3.0, 28), (5.0, 40)])
def test_the_model_chooses_an_even_number_of_points_that_is_enough(modulation, enough):
    instrument = small_instrument()
    wfs = replace(instrument.wfs, modulation_lambda_over_d=modulation)
    assert enough_modulation_points(wfs) == enough
    model = InteractionModel(replace(instrument, wfs=wfs), small_basis())
    assert model.sensor.optics.n_modulation == enough


def test_twice_the_modulation_points_change_nothing():
    """At 28 points and 3 λ/D the sum over the circle has converged to 5e-5 (tip, full pupil)."""
    valid = small_model().valid
    few, many = (
        optics(n_modulation=n, dtype=np.float64).response(valid).gradient for n in (28, 56)
    )
    assert np.linalg.norm(few - many) < 1e-4 * np.linalg.norm(many)


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_area_nodes_integrate_polynomials_up_to_their_order_exactly(n):
    nodes = Nodes.area(n)
    assert nodes.weights.sum() == pytest.approx(1.0)
    assert nodes.weights @ nodes.offsets ** (2 * n - 2) == pytest.approx(
        0.5 ** (2 * n - 2) / (2 * n - 1)
    )


def test_edge_nodes_are_the_rate_of_the_light_on_a_pixel_when_the_image_moves_forward():
    """A brightness rising along x falls on every pixel when the image moves to +x."""
    nodes = Nodes.edges()
    assert nodes.weights @ (2.0 * nodes.offsets) == pytest.approx(-2.0)


def test_one_whole_subaperture_of_shift_moves_the_images_by_one_pixel():
    model = optics(dtype=np.float64)
    at_rest, moved = model.images(), model.images((1.0, 0.0))
    np.testing.assert_allclose(moved[..., 1:], at_rest[..., :-1], rtol=1e-9)
    moved = model.images((0.0, -1.0))
    np.testing.assert_allclose(moved[:, :-1], at_rest[:, 1:], rtol=1e-9)


def test_the_four_images_mirror_one_another():
    images = optics(dtype=np.float64).images()
    np.testing.assert_allclose(images, images[::-1, ::-1], rtol=1e-9)
    np.testing.assert_allclose(images, images[:, :, ::-1, ::-1], rtol=1e-9)
    np.testing.assert_allclose(images, images.transpose(2, 3, 0, 1), rtol=2e-3)  # grey edge


def test_light_is_not_made_and_little_of_it_leaves_the_images():
    """Four images share the pupil's light; the pyramid's edges diffract a few per cent away."""
    model = optics(dtype=np.float64)
    pupil_light = (model.pupil.amplitude**2).sum() / model.pupil.sampling**2
    assert 0.85 * pupil_light < model.images().sum() < pupil_light


def test_a_piston_of_the_wavefront_is_not_seen():
    """float32 rounding, summed over some thousand pupil points."""
    response = optics().response(small_model().valid)
    piston = response.gradient.sum(axis=1)
    assert np.abs(piston).max() < 1e-4 * np.abs(response.gradient).sum(axis=1).max()


def test_single_precision_is_good_to_a_few_parts_in_a_million():
    valid = small_model().valid
    single, double = (
        optics(dtype=dtype).response(valid, (0.2, -0.1)).gradient
        for dtype in (np.float32, np.float64)
    )
    assert single.dtype == np.float32
    assert np.linalg.norm(single - double) < 5e-6 * np.linalg.norm(double)
