"""The heavy work on a small instrument."""

from dataclasses import replace

import numpy as np
import pytest

from service.control.dither import COARSE_BAND, FINE_BAND, spread_lines, spread_modes
from service.estimation import passive
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.estimation.openloop import WideCaptureEstimate
from service.estimation.windows import ClosedLoop, RefusalKind, WindowRefused
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import Misregistration
from service.runtime.worker import OpticsWorker, run_job
from tests.unit.estimation.lamps import counts_of
from tests.unit.runtime.small import (
    COMPUTE,
    N_CONTROLLED,
    SIGMA,
    conditions,
    loop_settings,
    small_instrument,
)

ALPHA = Misregistration(
    shift_x_subap=0.12, shift_y_subap=-0.08, rotation_rad=0.004, magnification=1.003
)
LINES = (210.0, 240.0, 280.0, 330.0)
MODES = (63, 69, 75, 81)
AMPLITUDE_M = 2e-8


@pytest.fixture(scope="module")
def bench():
    return OpticsWorker(small_instrument(), COMPUTE)


@pytest.fixture(scope="module")
def aligned(bench):
    return bench.make(
        conditions(Misregistration(), np.diag(SIGMA**2), loop_settings(), 0.95)
    ).matrix


def dithered_window(bench, alpha, *, gain=1.0, noise=1e-4, seed=1):
    """An open loop with a dither and noise: slopes are D(α) times the commands."""
    rng = np.random.default_rng(seed)
    matrix = bench._model.interaction_matrix(alpha)
    time = np.arange(1000) / 1000.0
    dither = np.zeros((1000, matrix.shape[1]), np.float32)
    for mode, line in zip(MODES, LINES, strict=True):
        dither[:, mode] = AMPLITUDE_M * np.sqrt(2) * np.sin(2 * np.pi * line * time)
    slopes = gain * dither @ matrix.T + noise * rng.standard_normal((1000, len(matrix)))
    block = FrameBlock(
        session="s1",
        first_seq=0,
        t0_ns_utc=0,
        dt_ns=1_000_000,
        slopes=slopes.astype(np.float32),
        commands_m=dither,
        dither_m=dither,
        cm_id="initial",
    )
    plan = LockInPlan(
        modes=MODES,
        frequencies_hz=LINES,
        amplitude_m=(AMPLITUDE_M,) * 4,
        frame_rate_hz=1000.0,
        n_frames=1000,
        first_seq=0,
    )
    _, (window,) = LockIn(plan=plan).accumulate(block)
    assert isinstance(window, Spectra)
    return window


def open_loop(reconstructor):
    return ClosedLoop(
        reconstructor=reconstructor,
        gains=np.zeros(90),
        leak=0.999,
        delay_frames=2.0,
        frame_rate_hz=1000.0,
    )


def test_it_describes_the_telemetry_it_expects(bench):
    description = bench.describe()
    assert (description.n_slopes, description.n_modes) == (224, 90)
    assert description.mode_variance_m2.shape == (90,)
    assert np.all(description.mode_variance_m2 > 0.0)


@pytest.mark.parametrize("start", [Misregistration(), ALPHA, replace(ALPHA, shift_x_subap=0.4)])
def test_a_window_gives_back_the_registration_it_was_made_with(bench, aligned, start):
    window = dithered_window(bench, ALPHA, gain=0.6)
    estimate = bench.fit(window, open_loop(aligned), start)
    error = estimate.alpha.vector - ALPHA.vector
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(error) < 4 * sigma + 2e-4)
    np.testing.assert_allclose(np.abs(estimate.optical_gain), 0.6, atol=0.02)


@pytest.mark.parametrize("offset", [0.0, 0.005, 0.011, 0.015, 0.019, 0.03])
def test_no_distance_from_the_last_linearisation_keeps_a_fit_from_settling(bench, aligned, offset):
    bench.fit(dithered_window(bench, ALPHA), open_loop(aligned), ALPHA)
    there = replace(ALPHA, shift_x_subap=ALPHA.shift_x_subap + offset)
    estimate = bench.fit(dithered_window(bench, there, noise=1e-6), open_loop(aligned), ALPHA)
    assert not isinstance(estimate, WindowRefused)
    assert estimate.alpha.shift_x_subap == pytest.approx(there.shift_x_subap, abs=1e-3)


def test_a_second_workbench_finds_the_first_linearisation_prepared(tmp_path, monkeypatch):
    compute = replace(COMPUTE, cache=tmp_path)
    first = OpticsWorker(small_instrument(), compute)
    described = first.describe()
    monkeypatch.setattr(RtcInteractionModel, "linearise", lambda *_: pytest.fail("again"))
    second = OpticsWorker(small_instrument(), compute)
    again = second.describe()
    np.testing.assert_array_equal(again.mode_information, described.mode_information)
    np.testing.assert_array_equal(
        second._sensor.near(Misregistration()).derivatives,
        first._sensor.near(Misregistration()).derivatives,
    )


@pytest.fixture
def linearised(bench, monkeypatch):
    """Where the fine model was linearised."""
    model, taken = bench._sensor._model, []
    linearise = model.linearise
    monkeypatch.setattr(model, "linearise", lambda alpha: taken.append(alpha) or linearise(alpha))
    return taken


def test_a_mirror_that_stays_is_linearised_once_however_windows_scatter(bench, aligned, linearised):
    starts = np.random.default_rng(4).normal(0.0, 0.005, (6, 2))
    for seed, (x, y) in enumerate(starts):
        start = replace(
            ALPHA, shift_x_subap=ALPHA.shift_x_subap + x, shift_y_subap=ALPHA.shift_y_subap + y
        )
        window = dithered_window(bench, ALPHA, noise=0.3, seed=seed)
        estimate = bench.fit(window, open_loop(aligned), start)
        assert np.all(np.abs(estimate.alpha.vector - ALPHA.vector) < [0.1, 0.1, 0.02, 0.01])
    assert len(linearised) <= 1


def test_a_faint_star_does_not_ask_for_a_linearisation_finer_than_its_noise(
    bench, aligned, linearised
):
    start = replace(ALPHA, shift_x_subap=ALPHA.shift_x_subap + 0.05)
    bench._sensor.linearise(start)
    estimate = bench.fit(dithered_window(bench, ALPHA, noise=3.0), open_loop(aligned), start)
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert sigma[0] > 0.02
    assert len(linearised) == 1
    error = estimate.alpha.vector - ALPHA.vector
    assert np.all(np.abs(error) < 4 * sigma)


def test_noise_without_a_signal_is_refused_in_words(bench, aligned):
    window = dithered_window(bench, ALPHA, gain=0.0, noise=1.0)
    outcome = bench.fit(window, open_loop(aligned), Misregistration())
    if not isinstance(outcome, WindowRefused):
        assert np.any(np.sqrt(np.diag(outcome.covariance)) > 0.1)
    else:
        kinds = {"did not settle": RefusalKind.OUT_OF_REACH, "no fit": RefusalKind.OTHER}
        assert [outcome.kind] == [kinds[text] for text in kinds if text in outcome.reason]


def test_a_reconstructor_inverts_the_interaction_matrix_of_its_registration(bench):
    made = bench.make(conditions(ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95))
    product = made.matrix @ bench._model.interaction_matrix(ALPHA)[:, :N_CONTROLLED]
    np.testing.assert_allclose(product, np.eye(N_CONTROLLED), atol=1e-3)
    assert made.gate.accepted
    assert 1.0 < made.condition_number < 20.0


def test_the_gate_sees_through_a_reconstructor_for_another_place(bench, aligned):
    far = replace(ALPHA, rotation_rad=np.deg2rad(25.0))
    verdict = bench.judge(aligned, conditions(far, np.diag(SIGMA**2), loop_settings(), 0.95))
    assert not verdict.accepted
    assert verdict.worst_pole_radius > 1.0
    near = bench.judge(
        aligned, conditions(Misregistration(), np.diag(SIGMA**2), loop_settings(), 0.95)
    )
    assert near.accepted


def test_a_gain_beyond_stability_is_refused_however_good_the_matrix(bench):
    made = bench.make(conditions(ALPHA, np.diag(SIGMA**2), loop_settings(gain=1.2), 0.95))
    assert not made.gate.accepted
    assert "unstable" in made.gate.reason


def test_the_watchdog_says_nothing_of_nothing(bench):
    empty = passive.Passive(n_modes=N_CONTROLLED, memory_frames=1000.0)
    assert bench.fit_passive(empty, Misregistration()) is None


def test_a_job_outside_a_worker_process_is_a_programming_error():
    with pytest.raises(RuntimeError, match="not in a worker process"):
        run_job(OpticsWorker.describe)


# --- far from the nominal registration


FAR = Misregistration(
    shift_x_subap=-1.2, shift_y_subap=0.8, rotation_rad=np.deg2rad(5.0), magnification=0.96
)


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
