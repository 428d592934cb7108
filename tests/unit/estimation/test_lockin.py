"""Demodulation of telemetry, and the windows it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.errors import ModelError
from service.estimation.demodulation import SIDE_OFFSETS_HZ
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan, Spectra, join_windows
from service.estimation.windows import WindowRefused
from tests.numerics import DT_NS, FRAME_RATE_HZ, T0_NS, block_of, part, sines

N_FRAMES = 1000
N_SLOPES, N_SMALL_MODES = 6, 5

PLAN = LockInPlan(
    modes=(3, 1),
    frequencies_hz=(230.0, 270.0),
    amplitude_m=(5e-9, 8e-9),
    frame_rate_hz=FRAME_RATE_HZ,
    n_frames=N_FRAMES,
    first_seq=100,
)


def telemetry(n_frames: int = 2500, plan: LockInPlan = PLAN) -> FrameBlock:
    """Noise with the dither in the commands, from frame 0."""
    rng = np.random.default_rng(7)
    dither = sines(plan, n_frames, N_SMALL_MODES)
    commands = dither + 1e-8 * rng.normal(size=dither.shape)
    return block_of(rng.normal(size=(n_frames, N_SLOPES)), commands, dither)


def run(*blocks: FrameBlock, plan: LockInPlan = PLAN) -> list[Spectra | WindowRefused]:
    lock_in, ended = LockIn(plan=plan), []
    for block in blocks:
        lock_in, more = lock_in.accumulate(block)
        ended += more
    return ended


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


@pytest.mark.parametrize("size", [1, 7, 50, 999, 1000, 1001])
def test_the_split_into_blocks_makes_no_difference(size):
    """1e-5 of the noise: float32 sums in another order."""
    block = telemetry()
    whole = run(block)
    pieces = run(*(part(block, start, start + size) for start in range(0, 2500, size)))
    assert len(whole) == len(pieces) == 2
    for one, other in zip(whole, pieces, strict=True):
        np.testing.assert_allclose(one.slopes, other.slopes, atol=1e-5 * np.abs(one.slopes).max())
        np.testing.assert_allclose(one.commands, other.commands, atol=1e-5 * 1e-8 * N_FRAMES)
        np.testing.assert_allclose(one.dither, other.dither, atol=1e-5 * 1e-8 * N_FRAMES)
        assert (one.first_seq, one.t_end_ns_utc) == (other.first_seq, other.t_end_ns_utc)


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
    assert "51 of 1000 frames missing, more than 5%: check the link" in refused.reason


def test_many_small_gaps_add_up_to_a_refusal():
    block = telemetry(1100)
    ended = run(*(part(block, start, start + 9) for start in range(0, 1100, 10)))
    assert "51 of 1000 frames missing" in ended[0].reason


# --- windows that are given up


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"session": "night-2"}, "the RTC started a new session inside the window"),
        ({"cm_id": "cm-2"}, "the reconstructor changed inside the window: cm-1 -> cm-2"),
        ({"cm_id": None}, "the reconstructor changed inside the window: cm-1 -> None"),
        ({"t0_ns_utc": T0_NS + 600 * DT_NS + 600_000}, "clock stepped or it paused"),
        ({"t0_ns_utc": T0_NS + 600 * DT_NS - 600_000}, "clock stepped or it paused"),
    ],
)
def test_a_window_is_not_continued_across_a_change(change, text):
    block = telemetry(1100)
    refused = only_refusal(part(block, 0, 600), replace(part(block, 600, 1100), **change))
    assert text in refused.reason
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
    assert "the dither ended inside the window" in only_refusal(part(block, 0, 600), ended).reason


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
    assert "mode 1 carries 3.20 nm of dither at 270.0 Hz, 8.00 nm were requested" in reason
    assert "see whether the RTC clips it" in reason


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
