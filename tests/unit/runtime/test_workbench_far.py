"""Finding the registration from nothing, with the service's own models of a small instrument."""

import numpy as np
import pytest

from service.control.dither import COARSE_BAND, FINE_BAND, spread_lines, spread_modes
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan
from service.estimation.openloop import WideCaptureEstimate
from service.estimation.windows import WindowRefused
from service.model.misregistration import Misregistration
from service.runtime.worker import OpticsWorker
from tests.unit.estimation.lamps import counts_of
from tests.unit.runtime.small import COMPUTE, small_instrument

FAR = Misregistration(
    shift_x_subap=-1.2, shift_y_subap=0.8, rotation_rad=np.deg2rad(5.0), magnification=0.96
)


@pytest.fixture(scope="module")
def bench():
    return OpticsWorker(small_instrument(), COMPUTE)


def window(bench, reach=COARSE_BAND, *, seed=1, noise=1e-3):
    """An open loop whose mirror lies at ``FAR``, with half the model's response."""
    lines = spread_lines(1000.0, 1.0, 8)
    matrix = bench._model.interaction_matrix(FAR)
    modes = spread_modes(reach, matrix.shape[1], len(lines))
    plan = LockInPlan(
        modes=modes,
        frequencies_hz=lines[: len(modes)],
        amplitude_m=(5e-8,) * len(modes),
        frame_rate_hz=1000.0,
        n_frames=1000,
        first_seq=0,
    )
    turns = np.outer(np.arange(1000) / 1000.0, plan.frequencies_hz)
    dither = np.zeros((1000, matrix.shape[1]), np.float32)
    dither[:, list(modes)] = 5e-8 * np.sqrt(2) * np.sin(2 * np.pi * turns)
    rng = np.random.default_rng(seed)
    slopes = 0.5 * dither @ matrix.T + noise * rng.standard_normal((1000, len(matrix)))
    block = FrameBlock(
        session="s1",
        first_seq=0,
        t0_ns_utc=0,
        dt_ns=1_000_000,
        slopes=slopes.astype(np.float32),
        commands_m=dither,
        dither_m=dither,
        cm_id=None,
    )
    _, (spectra,) = LockIn(plan=plan).accumulate(block)
    return spectra


def test_two_sets_of_modes_find_the_same_place_one_after_the_other(bench):
    first = bench.find(window(bench), None, None)
    assert isinstance(first, WideCaptureEstimate)
    assert np.all(np.abs(first.estimate.alpha.vector - FAR.vector) < COARSE_BAND.floor)
    second = bench.find(window(bench, FINE_BAND), first.estimate.alpha, None)
    assert isinstance(second, WideCaptureEstimate)
    assert np.all(np.abs(second.estimate.alpha.vector - FAR.vector) < FINE_BAND.floor)


def test_light_saves_steps_and_changes_nothing(bench):
    flux = counts_of(small_instrument(), (-1.2, 0.8)).astype("<f4").tobytes()
    lit, dark = bench.find(window(bench), None, flux), bench.find(window(bench), None, None)
    assert isinstance(lit, WideCaptureEstimate)
    assert isinstance(dark, WideCaptureEstimate)
    difference = np.abs(lit.estimate.alpha.vector - dark.estimate.alpha.vector)
    # both are steps to the same minimum of the same window, each ended when it is shorter than this
    assert np.all(difference < [2e-3, 2e-3, 1e-4, 1e-4])


def test_noise_alone_is_no_registration(bench):
    spectra = window(bench, noise=30.0)
    assert isinstance(bench.find(spectra, None, None), WindowRefused)
