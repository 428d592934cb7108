"""The pyramid as the rest of pyrcal meets it: a sensor, its response, its kind."""

import tracemalloc
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from service.errors import ModelError
from service.model.kinds import Normalisation, SlopeOrder
from service.model.pupil import instrument_pupil
from service.model.sensors.kind import SensorKind, WorkingPoint
from service.model.sensors.pyramid.kind import PyramidKind
from service.model.sensors.pyramid.signals import pixel_places
from service.model.sensors.registry import KINDS, kind_of
from service.model.sensors.sensor import CannotTell, Fineness
from tests.numerics import small_basis, small_instrument

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


@pytest.mark.parametrize("keeps", [True, False])
@pytest.mark.parametrize("normalisation", Normalisation)
def test_the_memory_of_a_response_is_known_beforehand(normalisation, keeps):
    """20 subapertures across."""
    plain = instrument_with(SlopeOrder.XY, normalisation)
    wide = replace(plain, wfs=replace(plain.wfs, n_subapertures=20, pupil_separation_subap=25.0))
    sensor, pupil = sensor_of(wide, 3, np.float32, kept_bytes=1e9 if keeps else 0.0)
    assert sensor.keeps_gradient is keeps
    tracemalloc.start()
    try:
        sensor.at((0.0, 0.0)).apply(np.ones((len(pupil.points), 1), np.float32))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert sensor.work(0).memory_bytes == pytest.approx(peak, rel=0.2)


def test_work_grows_with_shapes_by_one_product():
    sensor, pupil = sensor_of(small_instrument())
    n_points = len(pupil.points)
    more = sensor.work(150).flop - sensor.work(50).flop
    assert more == pytest.approx(2.0 * 100 * sensor.n_signals * n_points, rel=0.1)


def test_the_working_point_of_another_sensor_is_refused():
    instrument = small_instrument()
    with pytest.raises(ModelError, match="expected a halo"):
        kind_of(instrument).sensor(
            instrument, instrument_pupil(instrument, 2), Fineness(), WorkingPoint()
        )


@dataclass(frozen=True)
class Another:
    """A sensor that is no pyramid."""

    kind: ClassVar[str] = "another"


def test_a_pyramid_asked_for_another_sensor_says_what_it_found():
    instrument = replace(small_instrument(), wfs=Another())
    with pytest.raises(ModelError, match=r"found wfs\.kind = another, expected pyramid"):
        PyramidKind().sensor(instrument, instrument_pupil(small_instrument(), 2), Fineness())


class Plain(SensorKind):
    """A kind that has only what it must."""

    name = "plain"
    described = sensor = pixels = noise_terms = aot = None


def test_a_kind_without_light_frames_or_working_point_says_so():
    plain, instrument = Plain(), small_instrument()
    seen = plain.light(instrument)
    assert isinstance(seen, CannotTell)
    assert "of a plain" in seen.reason
    assert plain.working_point(instrument, n_controlled=10, sampling=2) is None
    assert not plain.edge_slips
    assert plain.find_fitted_key(instrument.wfs) is None
    assert plain.frames(None, frozenset()) is None
    with pytest.raises(ModelError, match="expected signals of a plain"):
        plain.signals_of_frames(instrument, np.zeros((1, 2, 2)), np.zeros((2, 2)))
    with pytest.raises(ModelError, match="expected none"):
        plain.bin_sensor(instrument.wfs, 2)


def test_every_kind_is_found_under_the_name_its_records_have():
    for name, kind in KINDS.items():
        assert kind.name == name
    assert kind_of(small_instrument()) is KINDS["pyramid"]
