"""Demodulation of telemetry, and the windows it refuses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from service.errors import ModelError
from service.estimation import lockin
from service.estimation.demodulation import SIDE_OFFSETS_HZ
from service.estimation.frames import FrameBlock
from service.estimation.lockin import (
    MAX_LAG_FRAMES,
    LockIn,
    LockInPlan,
    Spectra,
    compute_total_commands,
    fit_window,
    join_windows,
)
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from service.records.estimates import LockInEstimate, RefusalKind, WindowRefused
from service.records.messages import compose
from tests.support.lockin import N_FRAMES, N_SLOPES, N_SMALL_MODES, PLAN, plan, run, telemetry
from tests.support.numerics import (
    DT_NS,
    FRAME_RATE_HZ,
    N_CONTROLLED,
    N_MODES,
    SOMEWHERE,
    T0_NS,
    Sky,
    block_of,
    closed_loop,
    part,
    sines,
    small_linearisation,
    small_loop,
    small_model,
)


def only_refusal(*blocks: FrameBlock) -> WindowRefused:
    """The one window that ended, refused."""
    (refused,) = run(*blocks)
    assert isinstance(refused, WindowRefused)
    return refused


# --- the plan


def test_side_bins_stand_on_both_sides_at_three_to_twenty_hertz():
    bins = PLAN.bins_hz
    assert bins.shape == (2, 37)
    np.testing.assert_array_equal(bins[:, 0], [230.0, 270.0])
    assert np.abs(SIDE_OFFSETS_HZ).min() == 3.0
    assert np.abs(SIDE_OFFSETS_HZ).max() == 20.0
    assert SIDE_OFFSETS_HZ.sum() == 0.0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"modes": (3,)}, "modes, frequencies and amplitudes differ in length"),
        ({"modes": (), "frequencies_hz": (), "amplitude_m": ()}, "differ in length"),
        ({"frequencies_hz": (15.0, 270.0)}, "lines at 15 to 270 Hz; expected between 20 and"),
        ({"frequencies_hz": (230.0, 485.0)}, "and 480 Hz, room for the side bins"),
        (
            {"frame_rate_hz": 5.5},
            "found 5.5 frames a second; expected more than 80, room for the side",
        ),
        ({"frequencies_hz": (230.5, 270.0), "n_frames": 1001}, "1001 frames cut a period"),
        ({"frequencies_hz": (230.0, 233.0)}, "closer than 4 bins in one window"),
    ],
)
def test_plans_that_cannot_work_are_refused(change, text):
    with pytest.raises(ModelError, match=text):
        replace(PLAN, **change)


# --- what is demodulated


def test_a_known_sinusoid_is_demodulated_exactly():
    """A sqrt(2) sin(wk) under a Hann window of N frames leaves -i A N / (2 sqrt 2); 1e-5: float32.

    Mode 3 starts its window at frame 100, 23 whole periods after the dither's start.
    """
    block = telemetry()
    (first, second) = run(block)
    for spectra in (first, second):
        expected = -0.5j * N_FRAMES / np.sqrt(2) * np.array([5e-9, 8e-9])
        np.testing.assert_allclose(spectra.dither[[0, 1], [3, 1]], expected, rtol=1e-5)


def test_lines_do_not_leak_into_one_another_nor_into_the_side_bins():
    """A Hann window of whole periods is blind beyond one bin; 1e-5: float32 phasors."""
    dither = sines(PLAN, 1100, N_SMALL_MODES)
    (spectra,) = run(block_of(np.zeros((1100, N_SLOPES)), dither, dither))
    line = np.abs(spectra.commands[0, 0, 3])
    assert np.abs(spectra.dither[1, 3]) < 1e-5 * line
    assert np.abs(spectra.commands[:, 1:]).max() < 2e-5 * line


def defined(columns):
    k = np.arange(N_FRAMES)
    hann = np.sin(np.pi * (k + 0.5) / N_FRAMES) ** 2
    return (hann * np.exp(-2j * np.pi * PLAN.bins_hz[:, :, None] / FRAME_RATE_HZ * k)) @ columns


def test_the_sums_are_those_of_the_definition():
    """Sums of ``h_k x_k exp(-i w k)``, k from the window's first frame; 2e-6: float32."""
    block = telemetry()
    (spectra, _) = run(block)
    expected = defined(block.slopes[100:1100])
    np.testing.assert_allclose(spectra.slopes, expected, atol=2e-6 * np.abs(expected).max())


def test_strong_turbulence_far_from_the_lines_stays_out_of_all_bins():
    """A thousand times the noise, at 3 Hz: float32 leaves 1e-7 of it, the noise is 1e-3."""
    block = telemetry()
    slow = 1e3 * np.sin(2 * np.pi * 3.1 * np.arange(2500) / FRAME_RATE_HZ)
    slopes = (block.slopes + slow[:, None]).astype(np.float32)
    (spectra, _) = run(replace(block, slopes=slopes))
    expected = defined(slopes[100:1100].astype(float))
    error = np.abs(spectra.slopes - expected)
    assert np.sqrt(np.mean(error**2)) < 1e-3 * np.sqrt(np.mean(np.abs(expected) ** 2))


def test_windows_follow_one_another_from_the_first_frame_of_the_plan():
    first, second = run(telemetry())
    assert (first.first_seq, second.first_seq) == (100, 1100)
    assert (first.session, first.cm_id) == ("night-1", "cm-1")


def test_nothing_ends_before_the_plan_begins_or_the_window_is_full():
    assert run(part(telemetry(), 0, 100)) == []
    assert run(part(telemetry(), 0, 1099)) == []
    assert len(run(part(telemetry(), 0, 1100))) == 1


def test_a_window_ends_with_the_exposure_of_its_last_frame():
    (first, _) = run(telemetry())
    assert first.t_end_ns_utc == T0_NS + 1099 * DT_NS


# --- frames that never came


def without(block: FrameBlock, start: int, stop: int) -> tuple[FrameBlock, FrameBlock]:
    """The block with rows missing."""
    return part(block, 0, start), part(block, stop, block.n_frames)


def test_missing_frames_are_counted_and_count_as_zeros():
    block = telemetry(1100)
    holes = replace(block, slopes=block.slopes.copy())
    holes.slopes[500:530] = 0.0
    (spectra,) = run(*without(block, 500, 530))
    (expected,) = run(holes)
    assert spectra.n_missing == 30
    np.testing.assert_allclose(spectra.slopes, expected.slopes, atol=1e-3)


def test_missing_frames_at_the_end_of_a_window_are_counted_too():
    (spectra,) = run(*without(telemetry(1110), 1070, 1100))
    assert isinstance(spectra, Spectra)
    assert spectra.n_missing == 30


def test_five_per_cent_missing_is_the_most_a_window_takes():
    (spectra,) = run(*without(telemetry(1100), 500, 550))
    assert isinstance(spectra, Spectra)
    assert spectra.n_missing == 50
    refused = run(*without(telemetry(1600), 500, 551))[0]
    assert refused.reason == compose("window.frames-missing", missing=51, n_frames=1000, most=0.05)


def test_many_small_gaps_add_up_to_a_refusal():
    block = telemetry(1100)
    ended = run(*(part(block, start, start + 9) for start in range(0, 1100, 10)))
    assert ended[0].reason.code == "window.frames-missing"
    assert ended[0].reason.values["missing"] == 51


# --- windows that are given up


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"session": "night-2"}, "window.new-session"),
        ({"cm_id": "cm-2"}, "window.matrix-changed: cm-1 -> cm-2"),
        ({"cm_id": None}, "window.matrix-changed: cm-1 -> None"),
        ({"reference_name": "ncpa-2"}, "window.reference-changed: None -> ncpa-2"),
        ({"t0_ns_utc": T0_NS + 600 * DT_NS + 600_000}, "window.clock-stepped"),
        ({"t0_ns_utc": T0_NS + 600 * DT_NS - 600_000}, "window.clock-stepped"),
    ],
)
def test_a_window_is_not_continued_across_a_change(change, key):
    block = telemetry(1100)
    refused = only_refusal(part(block, 0, 600), replace(part(block, 600, 1100), **change))
    assert refused.reason.key == key
    assert refused.t_ns_utc == T0_NS + 600 * DT_NS


def test_a_jitter_of_less_than_half_a_frame_is_no_clock_step():
    block = telemetry(1100)
    late = replace(part(block, 600, 1100), t0_ns_utc=T0_NS + 600 * DT_NS + 400_000)
    (spectra,) = run(part(block, 0, 600), late)
    assert isinstance(spectra, Spectra)


def test_after_a_refusal_a_new_window_begins_at_the_change():
    block = telemetry(2000)
    swapped = replace(part(block, 600, 2000), cm_id="cm-2")
    refused, spectra = run(part(block, 0, 600), swapped)
    assert isinstance(refused, WindowRefused)
    assert (spectra.first_seq, spectra.cm_id, spectra.n_missing) == (600, "cm-2", 0)


def test_a_dither_that_ends_inside_a_window_is_named():
    block = telemetry(1100)
    ended = replace(part(block, 600, 1100), dither_m=None)
    refused = only_refusal(part(block, 0, 600), ended, replace(ended, first_seq=1100))
    assert refused.reason.code == "window.dither-ended"
    assert refused.kind is RefusalKind.CUT_SHORT


def test_after_a_dither_that_ended_nothing_is_demodulated_until_it_is_back():
    block = telemetry(3000)
    off = replace(part(block, 600, 900), dither_m=None)
    refused, spectra = run(part(block, 0, 600), off, part(block, 900, 1950))
    assert isinstance(refused, WindowRefused)
    assert spectra.first_seq == 900


def test_telemetry_without_dither_columns_opens_no_window():
    assert run(replace(telemetry(2500), dither_m=None)) == []


def test_a_dither_weaker_than_half_its_request_is_named_with_both_numbers():
    block = telemetry(1100)
    weak = replace(block, dither_m=block.dither_m * np.float32([1, 0.4, 1, 1, 1]))
    reason = only_refusal(weak).reason
    assert (reason.code, reason.values["mode"]) == ("window.dither-weak", 1)
    found_nm, requested_nm = (reason.values[name] for name in ("found_nm", "requested_nm"))
    assert (found_nm, requested_nm) == pytest.approx((3.2, 8.0), rel=1e-3)
    assert "3.20 nm of dither at 270.0 Hz" in str(reason)


def test_a_dither_a_little_weaker_than_its_request_is_used():
    block = telemetry(1100)
    (spectra,) = run(replace(block, dither_m=block.dither_m * np.float32(0.6)))
    assert isinstance(spectra, Spectra)


def test_spectra_take_the_memory_of_the_sums():
    bank = PLAN.demodulation
    sums = bank.empty(7)
    assert np.shares_memory(bank.at_bins(sums), sums)


# --- windows that are joined


def white(n_frames: int, seed: int) -> FrameBlock:
    rng = np.random.default_rng(seed)
    dither = sines(PLAN, n_frames, N_SMALL_MODES)
    return block_of(rng.normal(size=(n_frames, 400)), dither, dither)


def test_joined_windows_show_the_dither_as_each_of_them_does():
    first, second = run(telemetry(2200))
    both = join_windows(first, second)
    assert both is not None
    lines = np.arange(2), [3, 1]
    np.testing.assert_allclose(both.dither[lines], first.dither[lines], rtol=1e-4)
    assert np.shares_memory(both.slopes, second.slopes)
    assert (both.n_windows, both.window_s) == (2, 2.0)
    assert (both.first_seq, both.t_end_ns_utc) == (first.first_seq, second.t_end_ns_utc)


def test_a_line_that_begins_a_window_with_another_phase_is_turned_back():
    first, second = run(
        without(telemetry(2300), 1100, 1103)[0], without(telemetry(2300), 0, 1103)[1]
    )
    assert second.first_seq - first.first_seq == 1003
    both = join_windows(first, second)
    lines = np.arange(2), [3, 1]
    np.testing.assert_allclose(both.dither[lines], first.dither[lines], rtol=1e-4)


def test_noise_falls_as_in_a_longer_window_at_the_lines_and_beside_them():
    windows = run(white(4200, seed=3))
    one = np.mean([np.abs(w.slopes) ** 2 for w in windows])
    both = join_windows(join_windows(windows[0], windows[1]), join_windows(windows[2], windows[3]))
    two = np.mean(np.abs(both.slopes) ** 2)
    # 29,600 complex numbers: the ratio of their powers is good to 1 %
    assert both.n_windows == 4
    assert two / one == pytest.approx(0.25, rel=0.05)


def test_three_windows_count_the_same():
    windows = run(white(3200, seed=4))
    mean = np.mean([w.slopes[0, 0] for w in windows], axis=0)
    both = join_windows(join_windows(*windows[:2]), windows[2])
    # the lines have whole periods in a window, so there is no phase to turn
    np.testing.assert_allclose(both.slopes[0, 0], mean, atol=1e-3 * np.abs(mean).max())


@pytest.mark.parametrize(
    "change",
    [
        {"session": "another"},
        {"cm_id": "another"},
        {"first_seq": 3100},
        {"plan": replace(PLAN, amplitude_m=(5e-9, 9e-9))},
    ],
)
def test_windows_of_other_loops_dithers_or_times_are_not_joined(change):
    first, second = run(telemetry(2200))
    assert join_windows(first, replace(second, **change)) is None


# --- the fit of a window


N_WINDOWS, FIRST = 48, 12


def the_response(dither, matrix, loop, frequency_hz, gain):
    """Return the total command that one line leads to."""
    found = compute_total_commands(
        dither[None], loop.reconstructor @ matrix, loop, (frequency_hz,), np.array([gain])
    )
    return found[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A star and the loop and dither it is observed with."""

    sky: Sky
    gain: float
    plan: LockInPlan

    @property
    def loop(self) -> lockin.ClosedLoop:
        return small_loop(gain=self.gain)


BRIGHT = Case(sky=Sky(noise=2e-3), gain=0.3, plan=plan(230.0, 270.0))
FAINT = Case(sky=Sky(noise=0.05, turbulence=0.3), gain=0.5, plan=plan(60.0, 90.0))
"""Strong turbulence and noise at frequencies where the loop answers both: the hard case."""


@cache
def bright_windows() -> list[Spectra]:
    return windows(BRIGHT, N_WINDOWS)


@cache
def faint_windows() -> list[Spectra]:
    return windows(FAINT, N_WINDOWS)


def windows(case: Case, number: int) -> list[Spectra]:
    dither = sines(case.plan, number * case.plan.n_frames)
    return demodulated(case, closed_loop(case.loop, case.sky, dither))


def demodulated(case: Case, block) -> list[Spectra]:
    _, ended = LockIn(plan=case.plan).accumulate(block)
    assert all(isinstance(window, Spectra) for window in ended)
    return ended


def settled(case: Case, spectra: list[Spectra]) -> list[LockInEstimate]:
    """Estimates about a linearisation where the first of them are, found from α = 0 in rounds."""
    linearisation = small_linearisation()
    for _ in range(2):
        first = [fit_window(window, linearisation, case.loop) for window in spectra[:FIRST]]
        mean = np.mean([estimate.alpha.vector for estimate in first], axis=0)
        linearisation = small_model().linearise(Misregistration.from_vector(mean))
    return [fit_window(window, linearisation, case.loop) for window in spectra]


@cache
def bright_estimates() -> list[LockInEstimate]:
    return settled(BRIGHT, bright_windows())


@cache
def faint_estimates() -> list[LockInEstimate]:
    return settled(FAINT, faint_windows())


def errors(case: Case, estimates: list[LockInEstimate]) -> np.ndarray:
    return np.array([e.alpha.vector for e in estimates]) - case.sky.alpha.vector


def in_sigma_of_the_mean(error: np.ndarray) -> np.ndarray:
    return error.mean(axis=0) / (error.std(axis=0, ddof=1) / np.sqrt(len(error)))


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((BRIGHT, bright_estimates), id="bright", marks=pytest.mark.long),
        pytest.param((FAINT, faint_estimates), id="faint"),
    ],
)
def found(request):
    """A case and the estimates of its 48 windows."""
    case, estimates = request.param
    return case, estimates()


def test_the_mean_of_many_windows_is_the_truth(found):
    """Each parameter within 3 σ of the mean of 48 windows."""
    error = errors(*found)
    assert np.abs(in_sigma_of_the_mean(error)).max() < 3.0


def test_the_predicted_covariance_is_the_scatter_that_is_seen(found):
    """chi2/4 has a standard deviation of 0.10 over 48 windows; 0.94 was measured elsewhere."""
    _, estimates = found
    chi2 = [
        d @ np.linalg.solve(e.covariance, d) for d, e in zip(errors(*found), estimates, strict=True)
    ]
    assert 0.6 < np.mean(chi2) / 4 < 1.6


def test_the_sigma_of_the_gains_is_the_scatter_that_is_seen(found):
    """48 windows tell a standard deviation to 10 %."""
    case, estimates = found
    seen = np.std([np.abs(e.optical_gain) for e in estimates], axis=0, ddof=1)
    said = np.sqrt(np.mean([e.gain_sigma**2 for e in estimates], axis=0))
    np.testing.assert_allclose(seen / said, 1.0, atol=0.3)
    assert estimates[0].modes == case.plan.modes


def test_the_command_as_its_own_instrument_is_biased(monkeypatch):
    """What the instrument is for: the command carries turbulence and noise of its own."""
    right = errors(FAINT, faint_estimates())
    windows = [replace(window, dither=window.commands[:, 0]) for window in faint_windows()]
    monkeypatch.setattr(lockin, "compute_total_commands", lambda dither, *_: dither.astype(complex))
    wrong = errors(FAINT, settled(FAINT, windows))
    assert np.abs(in_sigma_of_the_mean(wrong)).max() > 5.0
    assert np.abs(wrong.mean(axis=0))[0] > 3 * np.abs(right.mean(axis=0))[0]


def test_the_optical_gain_and_the_alignment_of_the_columns_are_measured():
    """1 %: 48 windows at a signal to noise of a few hundred."""
    estimates = bright_estimates()
    gains = np.mean([e.optical_gain for e in estimates], axis=0)
    np.testing.assert_allclose(np.abs(gains), BRIGHT.sky.optical_gain, rtol=0.01)
    assert np.abs(np.mean([e.lag_frames for e in estimates], axis=0)).max() < 0.01


def test_an_exact_model_leaves_nothing_but_noise():
    misfit = np.mean([e.misfit for e in bright_estimates()])
    assert misfit == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("lag", [1, -1])
def test_columns_that_are_a_frame_apart_are_noticed_with_the_sign_of_the_lag(lag):
    """Positive: the slopes lag behind the commands. 0.05: the loop's own reply moves too."""
    dither = sines(BRIGHT.plan, 3002)
    block = closed_loop(BRIGHT.loop, BRIGHT.sky, dither)
    late = replace(block, slopes=np.roll(block.slopes, lag, axis=0))
    for estimate in settled(BRIGHT, demodulated(BRIGHT, late)):
        np.testing.assert_allclose(estimate.lag_frames, lag, atol=0.05)
        assert np.abs(estimate.lag_frames).min() > MAX_LAG_FRAMES


def test_a_wrong_model_shows_in_the_misfit():
    """The residual of a sensor that is not the model's: 40 % more gain on every other slope."""
    block = closed_loop(BRIGHT.loop, BRIGHT.sky, sines(BRIGHT.plan, 3000))
    uneven = np.where(np.arange(block.slopes.shape[1]) % 2, 1.4, 1.0).astype(np.float32)
    other = demodulated(BRIGHT, replace(block, slopes=block.slopes * uneven))
    assert min(e.misfit for e in settled(BRIGHT, other)) > 5.0


def test_modes_that_stand_still_change_nothing():
    """Of an ELT most do; they are left out of the sums."""
    spectra, about = bright_windows()[0], small_linearisation()
    n_slopes, n_modes = about.matrix.shape
    wide = [(0, 0), (0, 9 * n_modes)]
    other = np.random.default_rng(1).normal(size=(5, n_slopes, 9 * n_modes)).astype(np.float32)
    other *= np.abs(about.matrix).max()
    many = replace(
        about,
        matrix=np.hstack([about.matrix, other[0]]),
        derivatives=np.concatenate([about.derivatives, other[1:]], axis=2),
    )
    still = replace(
        spectra,
        commands=np.pad(spectra.commands, [(0, 0), *wide]),
        dither=np.pad(spectra.dither, wide),
    )
    few, found = (
        fit_window(window, lin, BRIGHT.loop) for window, lin in ((spectra, about), (still, many))
    )
    np.testing.assert_allclose(found.alpha.vector, few.alpha.vector, atol=1e-6)
    np.testing.assert_allclose(found.covariance, few.covariance, rtol=1e-3)
    assert (found.weak, found.dither_m) == (few.weak, pytest.approx(few.dither_m))


def test_an_estimate_says_which_window_it_is_of():
    spectra = bright_windows()[0]
    estimate = fit_window(spectra, small_linearisation(), BRIGHT.loop)
    assert (estimate.session, estimate.cm_id) == ("night-1", "cm-1")
    assert estimate.t_ns_utc == spectra.t_end_ns_utc > T0_NS + 998 * DT_NS


def test_an_estimate_says_how_much_dither_it_is_of():
    found = fit_window(bright_windows()[0], small_linearisation(), BRIGHT.loop)
    total_m = np.sqrt(np.sum(np.square(BRIGHT.plan.amplitude_m)))
    assert found.dither_m == pytest.approx(total_m, rel=1e-3)
    assert found.window_s == 1.0


def test_the_step_leads_from_the_linearisation_to_the_estimate():
    estimate = fit_window(bright_windows()[0], small_linearisation(), BRIGHT.loop)
    np.testing.assert_allclose(
        estimate.step, estimate.alpha.vector - Misregistration().vector, atol=1e-12
    )
    assert np.all(np.linalg.eigvalsh(estimate.covariance) > 0)
    np.testing.assert_array_equal(estimate.covariance, estimate.covariance.T)


def test_twice_the_dither_halves_the_uncertainty():
    """σ = κ / (A sqrt T). 20 %: the scatter of six windows' own noise estimate."""
    double = replace(BRIGHT, plan=replace(BRIGHT.plan, amplitude_m=(20e-9, 20e-9)))
    once = settled(BRIGHT, windows(BRIGHT, 6))
    twice = settled(double, windows(double, 6))
    sigma = [
        np.sqrt(np.mean([np.diag(e.covariance) for e in found], axis=0)) for found in (once, twice)
    ]
    np.testing.assert_allclose(sigma[0] / sigma[1], 2.0, rtol=0.2)


# --- without noise


def quiet(linearisation: Linearisation, alpha: Misregistration, gain: complex) -> Spectra:
    """One window of a noise-free sensor that is exactly the linearised model."""
    matrix = linearisation.matrix_at(alpha)
    loop = small_loop()
    dither = np.zeros((2, N_MODES), complex)
    dither[[0, 1], [33, 37]] = -1.8e-6j
    commands = np.zeros((2, 37, N_MODES), complex)
    commands[:, 0] = [
        the_response(u, matrix, loop, f, gain)
        for u, f in zip(dither, BRIGHT.plan.frequencies_hz, strict=True)
    ]
    rng = np.random.default_rng(9)
    slopes = gain * commands @ matrix.T.astype(complex)
    slopes[:, 1:] += 1e-9 * rng.normal(size=slopes[:, 1:].shape)
    return Spectra(
        plan=BRIGHT.plan,
        session="night-1",
        cm_id="cm-1",
        first_seq=0,
        t_end_ns_utc=T0_NS,
        n_missing=0,
        slopes=slopes.astype(np.complex64),
        commands=commands.astype(np.complex64),
        dither=dither.astype(np.complex64),
    )


@pytest.mark.parametrize("gain", [1.0, 0.45, 0.6 * np.exp(0.1j)])
def test_a_noise_free_linear_sensor_is_read_exactly(gain):
    """1e-5 subapertures, radians and magnification: single precision of the spectra."""
    estimate = fit_window(
        quiet(small_linearisation(), SOMEWHERE, gain), small_linearisation(), small_loop()
    )
    np.testing.assert_allclose(estimate.alpha.vector, SOMEWHERE.vector, atol=1e-5)
    np.testing.assert_allclose(estimate.optical_gain, gain, atol=1e-4)


def test_slopes_that_are_known_to_be_noisy_count_less():
    """Half of them four times as noisy as the others: counted alike they cost twice the σ."""
    even = small_linearisation()
    rng, spectra = np.random.default_rng(3), quiet(even, SOMEWHERE, 1.0)
    shape = np.where(rng.random(even.matrix.shape[0]) < 0.5, 4.0, 1.0)
    noise = rng.normal(size=(2, *spectra.slopes.shape)) * shape
    size = 0.01 * np.abs(spectra.slopes[:, 0]).mean()
    noisy = replace(
        spectra, slopes=(spectra.slopes + size * (noise[0] + 1j * noise[1])).astype(np.complex64)
    )
    known = replace(even, noise_shape=shape / np.sqrt(np.mean(shape**2)))
    alike, weighted = (fit_window(noisy, about, small_loop()) for about in (even, known))
    sigma = np.sqrt([np.diag(alike.covariance), np.diag(weighted.covariance)])
    expected = np.sqrt(np.mean(shape**2) * np.mean(shape**-2.0))
    assert expected > 2.0
    np.testing.assert_allclose(sigma[0] / sigma[1], expected, rtol=0.25)
    error = np.abs(weighted.alpha.vector - SOMEWHERE.vector)
    assert np.all(error < 3 * sigma[1])


# --- the closed loop's answer to the dither


def response(mode: int, optical_gain: float, **loop) -> np.ndarray:
    dither = np.zeros(N_MODES)
    dither[mode] = 1.0
    matrix = small_linearisation().matrix
    return the_response(dither, matrix, small_loop(**loop), 230.0, optical_gain)


def test_a_dither_of_an_uncontrolled_mode_passes_unchanged_and_moves_the_controlled_ones():
    """Modes are not orthogonal to the sensor: the reconstructor takes some of it for its own."""
    found = response(35, 0.7)
    assert found[35] == pytest.approx(1.0)
    np.testing.assert_array_equal(found[N_CONTROLLED:][np.arange(10) != 5], 0.0)
    assert np.abs(found[:N_CONTROLLED]).max() > 1e-3


def test_a_dither_of_a_controlled_mode_is_rejected_by_the_textbook_function():
    """R D is the identity on controlled modes: 1 / (1 + g γ e^{-iwd} / (1 - leak e^{-iw}))."""
    z = np.exp(-2j * np.pi * 0.23)
    expected = 1.0 / (1.0 + 0.3 * 0.7 * z**2 / (1.0 - 0.999 * z))
    found = response(4, 0.7)
    assert found[4] == pytest.approx(expected, rel=1e-4)
    assert np.abs(np.delete(found, 4)).max() < 1e-4


def test_an_open_loop_leaves_the_dither_alone():
    found = response(35, 0.7, gain=0.0)
    np.testing.assert_array_equal(found, np.eye(N_MODES)[35])


def test_the_simulated_loop_answers_as_the_formula_says():
    """The transfer function against frames of the recursion itself, no turbulence, no noise.

    1e-3: what single precision and the first windows' transient leave.
    """
    case = replace(BRIGHT, sky=replace(BRIGHT.sky, noise=0.0, turbulence=0.0))
    spectra = windows(case, 2)[1]
    matrix = small_model().interaction_matrix(case.sky.alpha)
    for line, frequency in enumerate(case.plan.frequencies_hz):
        expected = the_response(
            spectra.dither[line], matrix, case.loop, frequency, case.sky.optical_gain
        )
        np.testing.assert_allclose(
            spectra.commands[line, 0], expected, atol=1e-3 * np.abs(expected).max()
        )


def test_a_mode_in_the_place_of_another_is_told_and_no_other_is():
    """On the linear plant a free mode is the file's, or another in its place."""
    here = small_model().linearise(SOMEWHERE)
    place = np.arange(N_MODES)
    place[[33, 39]] = [39, 33]
    other = replace(here, matrix=here.matrix[:, place], derivatives=here.derivatives[:, :, place])
    for spectra in bright_windows()[:6]:
        assert fit_window(spectra, here, BRIGHT.loop).answers_as == (33, 37)
        assert fit_window(spectra, other, BRIGHT.loop).answers_as == (39, 37)


def test_noise_puts_no_mode_in_the_place_of_another():
    assert {estimate.answers_as for estimate in faint_estimates()} == {(33, 37)}


def test_a_line_far_weaker_than_the_strongest_is_told():
    spectra, here = bright_windows()[0], small_model().linearise(SOMEWHERE)
    estimate = fit_window(spectra, here, BRIGHT.loop)
    assert estimate.weak == ()
    assert estimate.strong.all()
    dither = spectra.dither.copy()
    dither[1] *= 0.2
    weaker = fit_window(replace(spectra, dither=dither), here, BRIGHT.loop)
    assert weaker.weak == (37,)
    np.testing.assert_array_equal(weaker.strong, [True, False])
