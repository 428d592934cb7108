"""The working point that follows the optical gains, in the sensor and in the work done with it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from service.control.gate import judge
from service.estimation.windows import ClosedLoop
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import Misregistration
from service.model.sensors.pyramid import working_point as pyramid_at_work
from service.model.sensors.pyramid.working_point import working_point
from service.runtime.worker import OpticsWorker
from service.runtime.worker.sensor import MIN_GAIN_CHANGE, STRENGTH_RANGE
from tests.support.small import (
    COMPUTE,
    N_CONTROLLED,
    SIGMA,
    conditions,
    loop_settings,
    small_instrument,
)
from tests.support.workbench import ALPHA, MODES, dithered_window

AT_WORK = replace(COMPUTE, sampling=COMPUTE.sampling._replace(working_point_modes=N_CONTROLLED))


@pytest.fixture(autouse=True)
def each_working_point_once(monkeypatch):
    monkeypatch.setattr(pyramid_at_work, "working_point", once)


@pytest.fixture
def bench():
    return OpticsWorker(small_instrument(), AT_WORK)


once = cache(working_point)
"""Each takes a second or two."""


@cache
def on_sky(strength):
    """A bench whose sensor is that of a residual of another strength, for good."""
    instrument = small_instrument()
    halo = once(
        instrument,
        n_controlled=N_CONTROLLED,
        r0_m=instrument.modes.r0_m * strength**-0.6,
        sampling=COMPUTE.sampling.pupil,
    )
    other = OpticsWorker(instrument, COMPUTE)
    other._model = RtcInteractionModel(instrument, other._model.basis, working_point=halo)
    return other


@cache
def flat():
    """A bench that knows of no residual."""
    return OpticsWorker(small_instrument(), COMPUTE)


def still():
    return ClosedLoop(
        reconstructor=np.zeros((N_CONTROLLED, flat().describe().n_slopes), np.float32),
        gains=np.zeros(90),
        leak=0.999,
        delay_frames=2.0,
        frame_rate_hz=1000.0,
    )


@pytest.mark.parametrize("strength", [pytest.param(0.4, marks=pytest.mark.long), 2.0])
def test_the_residual_is_found_from_the_gains_it_leaves(bench, strength):
    sky = on_sky(strength)
    window = dithered_window(sky, ALPHA, noise=1e-6)
    for _ in range(3):
        estimate = bench.fit(window, still(), ALPHA)
    assert bench._sensor.strength == pytest.approx(strength, rel=0.1)
    told, seen = bench.response(ALPHA), sky.response(ALPHA)
    expected = [seen[:, m] @ told[:, m] / (told[:, m] @ told[:, m]) for m in MODES]
    np.testing.assert_allclose(np.abs(estimate.optical_gain), expected, rtol=0.01)


def test_what_follows_the_residual_is_nearer_the_truth_than_what_does_not(bench):
    window = dithered_window(on_sky(2.0), ALPHA, noise=1e-6)

    def error(estimate):
        return np.abs(estimate.alpha.vector - ALPHA.vector) / SIGMA

    followed = error(bench.fit(window, still(), ALPHA))
    still_there = error(flat().fit(window, still(), ALPHA))
    assert np.linalg.norm(followed) < 0.3 * np.linalg.norm(still_there)


def test_a_sensor_without_a_residual_is_taken_for_one(bench):
    window = dithered_window(flat(), ALPHA, noise=1e-6)
    estimate = bench.fit(window, still(), ALPHA)
    assert bench._sensor.strength == STRENGTH_RANGE[0]
    np.testing.assert_allclose(estimate.alpha.vector, ALPHA.vector, atol=5e-4)
    np.testing.assert_allclose(np.abs(estimate.optical_gain), 1.0, atol=0.01)


def test_gains_that_hardly_differ_cost_no_linearisation(bench):
    sensor = bench._sensor
    kept = sensor.linearise(ALPHA)
    expected = sensor.ratio()[list(MODES)].astype(complex)
    assert not sensor.follow(MODES, expected * np.exp(0.9 * MIN_GAIN_CHANGE))
    assert sensor.near(ALPHA) is kept
    assert sensor.follow(MODES, expected * np.exp(1.1 * MIN_GAIN_CHANGE))
    assert sensor.strength < 1.0
    assert sensor.near(ALPHA) is not kept


def test_a_flat_response_follows_nothing():
    sensor = OpticsWorker(small_instrument(), COMPUTE)._sensor
    sensor.linearise(ALPHA)
    assert not sensor.follow(MODES, np.full(4, 0.3 + 0j))
    assert sensor.strength == 0.0
    np.testing.assert_array_equal(sensor.ratio(), 1.0)


def test_gains_are_counted_once_when_a_loop_is_judged(bench):
    """The gate sees the response at work, whether told so by the model or by the gains."""
    made = flat().make(conditions(ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95))
    near = bench._sensor.near(ALPHA)
    at_work = replace(loop_settings(), optical_gain=bench._sensor.ratio()[:N_CONTROLLED])
    verdict = bench.judge(made.matrix, conditions(ALPHA, np.diag(SIGMA**2), at_work, 0.95))
    itself = judge(made.matrix, near, ALPHA, np.diag(SIGMA**2), loop_settings(), bound=0.95)
    assert verdict.worst_pole_radius == pytest.approx(itself.worst_pole_radius, abs=1e-5)
    told = flat().judge(made.matrix, conditions(ALPHA, np.diag(SIGMA**2), at_work, 0.95))
    assert verdict.aligned_pole_radius == told.aligned_pole_radius
    aligned = bench.judge(
        made.matrix, conditions(Misregistration(), np.diag(SIGMA**2), loop_settings(), 0.95)
    )
    assert aligned.worst_pole_radius != pytest.approx(verdict.worst_pole_radius, abs=1e-3)
