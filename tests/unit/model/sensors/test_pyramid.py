"""The modulated pyramid at rest; the Jacobian itself is checked against an FFT in tests/physics."""

from __future__ import annotations

import dataclasses
import functools
import tracemalloc
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from service.errors import ModelError
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.kinds import Normalisation, SlopeOrder
from service.model.misregistration import Misregistration
from service.model.pupil import instrument_pupil
from service.model.sensors.model import SensorModel
from service.model.sensors.pyramid.description import Pyramid
from service.model.sensors.pyramid.light import PyramidLight, repair_pixels
from service.model.sensors.pyramid.model import PyramidModel
from service.model.sensors.pyramid.optics import Nodes, PyramidOptics, enough_modulation_points
from service.model.sensors.pyramid.signals import pixel_places
from service.model.sensors.pyramid.working_point import Halo, working_point
from service.model.sensors.registry import KINDS, kind_of
from service.model.sensors.sensor import CannotTell, Fineness, PupilPosition, WorkingPoint
from tests.support.lamps import beam, counts_of, flao, fringes, gaussian, small, with_diameter
from tests.support.numerics import small_basis, small_instrument, small_model

LIGHT = PyramidLight(instrument=flao())

N_MANY = 30
"""Shapes of a sensor of 20 subapertures for which the gradient at every point is computed."""


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


# --- position of the light


def found_in(counts, instrument=None) -> PupilPosition:
    found = PyramidLight(instrument=instrument or flao()).find_pupil(counts)
    assert isinstance(found, PupilPosition), found
    return found


@pytest.mark.parametrize("shift", [(-0.92, 0.35), (2.3, -1.3)])
def test_an_even_pupil_is_found_to_a_fiftieth_of_a_subaperture(shift):
    found = found_in(counts_of(flao(), shift))
    assert found.at == pytest.approx(shift, abs=0.02)


@pytest.mark.parametrize("light", [gaussian, fringes])
def test_uneven_light_moves_it_by_less_than_a_tenth(light):
    shift = (-0.62, 0.41)
    found = found_in(counts_of(flao(), shift, beam(light)))
    assert found.at == pytest.approx(shift, abs=0.1)


def test_dead_and_hot_pixels_are_named_and_do_no_harm():
    shift = (0.3, -0.7)
    counts = counts_of(flao(), shift)
    counts[0, 8, 9], counts[1, 14, 3], counts[3, 20, 21] = 0.0, 60_000.0, np.nan
    _, bad = repair_pixels(counts, flao())
    assert bad.sum() == 3
    found = found_in(counts)
    assert found.at == pytest.approx(shift, abs=0.03)


def test_a_faint_map_is_found_within_its_own_uncertainty():
    """3.5 σ: not one in 2000 beyond it."""
    pulls = []
    for seed in range(5):
        found = found_in(counts_of(small(), (0.4, -0.2), n_frames=1, seed=seed), small())
        pulls.append((found.at[0] - 0.4) / found.sigma[0])
        pulls.append((found.at[1] + 0.2) / found.sigma[1])
    assert np.abs(pulls).max() < 3.5
    assert np.std(pulls) > 0.2


def test_images_that_disagree_widen_the_uncertainty():
    counts = counts_of(small(), (0.0, 0.0))
    apart = counts.copy()
    apart[0] = np.roll(apart[0], 1, axis=1)
    assert found_in(apart, small()).sigma[0] > 2 * found_in(counts, small()).sigma[0]


def test_darkness_tells_nothing():
    found = LIGHT.find_pupil(np.zeros((4, 30, 30)))
    assert isinstance(found, CannotTell)
    assert "no light" in found.reason


def test_frames_of_nan_tell_nothing():
    assert isinstance(LIGHT.find_pupil(np.full((4, 30, 30), np.nan)), CannotTell)


def test_another_instruments_pupil_is_not_taken_for_this_ones():
    counts = counts_of(with_diameter(flao(), 18.0))
    found = LIGHT.find_pupil(counts)
    assert isinstance(found, CannotTell)
    assert "unexplained" in found.reason


def test_light_without_a_pupil_tells_nothing():
    noise = np.random.default_rng(3).exponential(100.0, size=(30, 30))
    assert isinstance(LIGHT.find_pupil(np.tile(noise, (4, 1, 1))), CannotTell)


def test_counts_of_another_size_are_refused():
    with pytest.raises(ModelError, match=r"found counts \(4, 12, 12\); expected \(4, 30, 30\)"):
        LIGHT.find_pupil(np.ones((4, 12, 12)))


# --- the sensor


SHIFT = (0.21, -0.13)
RECIPES = [
    (order, normalisation)
    for order in (SlopeOrder.XY, SlopeOrder.IMAGES)
    for normalisation in Normalisation
]


def sensor_of(instrument, sampling=2, dtype=np.float64, kept_bytes=1e9):
    pupil = instrument_pupil(instrument, sampling)
    fineness = Fineness(n_nodes=sampling, dtype=dtype, kept_bytes=kept_bytes)
    return kind_of(instrument).sensor(instrument, pupil, fineness), pupil


def instrument_with(order, normalisation):
    plain = small_instrument()
    return replace(plain, slopes=replace(plain.slopes, order=order, normalisation=normalisation))


@pytest.mark.parametrize("kept_bytes", [1e9, 0.0])
@pytest.mark.parametrize(("order", "normalisation"), RECIPES)
def test_what_is_applied_to_shapes_is_the_jacobian(order, normalisation, kept_bytes):
    sensor, pupil = sensor_of(instrument_with(order, normalisation), kept_bytes=kept_bytes)
    response, shapes = sensor.at(SHIFT), small_basis().render(pupil.points)[:, :5]
    applied = response.apply(shapes)
    assert len(applied) == sensor.n_signals
    np.testing.assert_allclose(
        applied, response.jacobian() @ shapes, atol=1e-10 * np.abs(applied).max()
    )


@pytest.mark.parametrize(("order", "normalisation"), RECIPES)
def test_shift_rates_are_those_of_the_response(order, normalisation):
    """Central differences of 1e-3 subaperture: what is left is of third order, some 1e-5."""
    instrument = instrument_with(order, normalisation)
    # edges are exact, areas a quadrature: six nodes integrate what three leave in the second digit
    pupil = instrument_pupil(instrument, 2)
    sensor = kind_of(instrument).sensor(instrument, pupil, Fineness(n_nodes=6, dtype=np.float64))
    shapes, step = small_basis().render(pupil.points)[:, :5], 1e-3
    signals, *rates = sensor.at(SHIFT).with_shift_rates(shapes)
    np.testing.assert_array_equal(signals, sensor.at(SHIFT).apply(shapes))
    for axis, rate in enumerate(rates):
        before, after = (
            sensor.at(tuple(SHIFT + side * step * np.eye(2)[axis])).apply(shapes)
            for side in (-1.0, 1.0)
        )
        difference = (after - before) / (2 * step)
        assert np.linalg.norm(rate - difference) < 1e-4 * np.linalg.norm(difference)


def test_light_that_is_all_the_same_changes_nothing_and_less_of_it_makes_slopes_larger():
    sensor, _ = sensor_of(small_instrument())
    response = sensor.at(SHIFT)
    np.testing.assert_array_equal(response.lit(response.light).jacobian(), response.jacobian())
    dim = response.light.copy()
    dim[0, :, 0] *= 0.5
    assert np.linalg.norm(response.lit(dim).jacobian()) > np.linalg.norm(response.jacobian())


def test_pixels_of_a_subaperture_are_its_four_places_in_the_light():
    valid = np.zeros((3, 3), dtype=bool)
    valid[1, 2] = True
    light = np.arange(36.0).reshape(2, 3, 2, 3)
    expected = [light[0, 1, 0, 2], light[0, 1, 1, 2], light[1, 1, 0, 2], light[1, 1, 1, 2]]
    np.testing.assert_array_equal(light.reshape(-1)[pixel_places(valid)][:, 0], expected)


@pytest.mark.parametrize("displaced", [False, True])
@pytest.mark.parametrize("keeps", [True, False])
@pytest.mark.parametrize("normalisation", Normalisation)
def test_the_memory_of_a_response_is_known_beforehand(normalisation, keeps, displaced):
    """20 subapertures across."""
    plain = instrument_with(SlopeOrder.XY, normalisation)
    if displaced:
        plain = replace(plain, wfs=kind_of(plain).displace_images(plain, np.arange(8.0) / 50.0))
    wide = replace(plain, wfs=replace(plain.wfs, n_subapertures=20, pupil_separation_subap=25.0))
    sensor, pupil = sensor_of(wide, 3, np.float32, kept_bytes=1e9 if keeps else 0.0)
    assert sensor.keeps_gradient is keeps
    tracemalloc.start()
    try:
        sensor.at((0.0, 0.0)).apply(np.ones((len(pupil.points), N_MANY), np.float32))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert not sensor.optics.are_few(N_MANY)
    assert sensor.work(N_MANY).memory_bytes == pytest.approx(peak, rel=0.2)


@pytest.mark.parametrize("offsets", [None, np.arange(8.0).reshape(2, 2, 2) / 50.0])
@pytest.mark.parametrize("normalisation", Normalisation)
@pytest.mark.parametrize("order", [SlopeOrder.XY, SlopeOrder.IMAGES])
@pytest.mark.parametrize("rooftop", [0.0, 0.7])
def test_a_few_shapes_have_the_same_response_as_by_the_gradient(
    order, normalisation, offsets, rooftop
):
    """In double precision; with displaced images, and images that move."""
    sensor, pupil = sensor_of(instrument_with(order, normalisation), 3, np.float64)
    wfs = replace(sensor.optics.wfs, rooftop_lambda_over_d=rooftop)
    optics = replace(sensor.optics, offsets=offsets, wfs=wfs)
    shapes = np.random.default_rng(1).standard_normal((len(pupil.points), 3))
    assert optics.are_few(3)
    for edges in ({}, {"nodes_x": Nodes.edges()}, {"nodes_y": Nodes.edges()}):
        whole = optics.response(sensor.valid, SHIFT, **edges).to(shapes, np.matmul)
        few = optics.response(sensor.valid, SHIFT, shapes=shapes, **edges)
        for name in ("images", "gradient", "flux_gradient"):
            expected = getattr(whole, name)
            found, size = getattr(few, name), np.abs(expected).max()
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * size)


def test_work_grows_with_shapes_by_one_product():
    sensor, pupil = sensor_of(small_instrument())
    n_points = len(pupil.points)
    more = sensor.work(150).flop - sensor.work(50).flop
    assert more == pytest.approx(2.0 * 100 * sensor.n_signals * n_points, rel=0.1)


class SteadySpot(WorkingPoint):
    """The working point of a sensor that is no pyramid."""

    coherence = 1.0


def test_the_working_point_of_another_sensor_is_refused():
    instrument = small_instrument()
    with pytest.raises(ModelError, match="expected a halo"):
        kind_of(instrument).sensor(
            instrument, instrument_pupil(instrument, 2), Fineness(), SteadySpot()
        )


@dataclass(frozen=True)
class Another:
    """A sensor that is no pyramid."""

    kind: ClassVar[str] = "another"


def test_a_pyramid_asked_for_another_sensor_says_what_it_found():
    instrument = replace(small_instrument(), wfs=Another())
    with pytest.raises(ModelError, match=r"found wfs\.kind = another, expected pyramid"):
        PyramidModel().sensor(instrument, instrument_pupil(small_instrument(), 2), Fineness())


class Plain(SensorModel):
    """A kind that has only what it must."""

    name = "plain"
    read_sensor = sensor = pixels = noise_terms = aot = None


def test_a_kind_without_light_frames_or_working_point_says_so():
    plain, instrument = Plain(), small_instrument()
    seen = plain.light(instrument)
    assert isinstance(seen, CannotTell)
    assert plain.working_point(instrument, n_controlled=10, sampling=2) is None
    assert not plain.edge_slips
    assert plain.find_fitted_key(instrument.wfs) is None
    assert plain.frames(None, frozenset()) is None
    with pytest.raises(ModelError, match="expected signals of a plain"):
        plain.signals_of_frames(instrument, np.zeros((1, 2, 2)), np.zeros((2, 2)))


def test_every_kind_is_found_under_the_name_its_records_have():
    for name, kind in KINDS.items():
        assert kind.name == name
        assert kind.model.name == name
    assert kind_of(small_instrument()).name == "pyramid"


# --- the working point


ALIGNED = Misregistration()


@pytest.fixture(scope="module")
def flao_halo():
    return working_point(load_instrument("flao-lbt"), n_controlled=400, sampling=3)


@functools.cache
def small_halo(r0_m):
    return working_point(small_instrument(), n_controlled=30, r0_m=r0_m, sampling=3)


def small_matrix(halo):
    model = InteractionModel(small_instrument(), small_basis(), working_point=halo)
    return model.interaction_matrix(ALIGNED)


def gains(halo):
    """How much of the flat response each mode keeps."""
    flat = small_model().interaction_matrix(ALIGNED)
    return np.einsum("sm,sm->m", flat, small_matrix(halo)) / np.einsum("sm,sm->m", flat, flat)


def test_the_core_is_what_a_residual_of_130_nm_leaves_coherent(flao_halo):
    # Marechal: exp(-(2 pi 130 / 750)^2) = 0.31; fitting 110 nm and servo 70 nm add to 130
    assert flao_halo.core_weight == pytest.approx(0.31, abs=0.02)


def test_nearly_nine_tenths_of_the_light_stay_on_the_grid(flao_halo):
    # the design study kept 0.887 at the same sampling
    assert flao_halo.core_weight + flao_halo.weights.sum() == pytest.approx(0.887, abs=0.02)


def test_without_residual_the_source_is_the_modulation_circle():
    perfect = small_halo(50.0)
    assert perfect.core_weight > 0.99
    np.testing.assert_allclose(gains(perfect), 1.0, atol=0.03)


def test_a_halo_of_no_light_changes_nothing():
    dark = Halo(core_weight=1.0, radii=np.array([2.0]), weights=np.array([0.0]), n_points=(20,))
    flat = small_model().interaction_matrix(ALIGNED)
    np.testing.assert_allclose(small_matrix(dark), flat, atol=1e-5 * np.abs(flat).max())


def test_worse_seeing_lowers_the_optical_gain_of_every_mode():
    good, bad = (gains(small_halo(r0_m)) for r0_m in (0.4, 0.15))
    assert np.all(bad < good)
    assert np.all((bad > 0.0) & (good < 1.0))


@pytest.mark.parametrize(("n_controlled", "r0_m"), [(0, 0.1), (30, 0.0), (30, -1.0)])
def test_no_loop_or_no_r0_is_refused(n_controlled, r0_m):
    with pytest.raises(ModelError, match="working point"):
        working_point(small_instrument(), n_controlled=n_controlled, r0_m=r0_m, sampling=3)


def shift_derivative_error(n_nodes):
    """How far the analytic shift derivative is from central differences, relative."""
    whole = small_halo(0.2)
    halo = dataclasses.replace(  # every third ring
        whole,
        radii=whole.radii[1::3],
        weights=3.0 * whole.weights[1::3],
        n_points=whole.n_points[1::3],
    )
    model = InteractionModel(
        small_instrument(),
        small_basis(),
        working_point=halo,
        detector_nodes=n_nodes,
        dtype=np.float64,
    )
    step = 1e-3
    ahead, behind = (
        model.interaction_matrix(dataclasses.replace(ALIGNED, shift_x_subap=x))
        for x in (step, -step)
    )
    numeric = (ahead - behind) / (2 * step)
    return np.linalg.norm(model.derivatives(ALIGNED)[0] - numeric) / np.linalg.norm(numeric)


@pytest.mark.long
def test_the_derivatives_follow_the_matrix_at_the_working_point_too():
    # the halo's finer structure needs more nodes than the flat response, but only those
    coarse, fine = (shift_derivative_error(n_nodes) for n_nodes in (3, 6))
    assert coarse < 0.04
    assert fine < coarse / 4


def test_long_rings_need_their_points_more_than_short_ones():
    halo = small_halo(0.2)
    n_rings = len(halo.n_points)
    even = dataclasses.replace(halo, n_points=(sum(halo.n_points) // n_rings,) * n_rings)
    finer = dataclasses.replace(halo, n_points=tuple(4 * n for n in halo.n_points))
    graded, equal, fine = (small_matrix(h) for h in (halo, even, finer))
    assert np.linalg.norm(graded - fine) < np.linalg.norm(equal - fine)
