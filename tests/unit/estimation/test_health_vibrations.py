"""Vibration lines found in the slopes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy

from service.estimation.health import MIN_SEGMENTS, SEGMENT_FRAMES, SlopeSpectra, VibrationMonitor
from tests.support.numerics import block_of, part

N_SLOPES = 60


def slopes(seed: int, vibrations: dict[float, float], n_segments: int = 12) -> np.ndarray:
    """Turbulence-like noise with a red spectrum, and sines on tip: Hz to amplitude in σ."""
    rng = np.random.default_rng(seed)
    n_frames = n_segments * SEGMENT_FRAMES
    noise = scipy.signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=(n_frames, N_SLOPES)), axis=0)
    for frequency, amplitude in vibrations.items():
        turns = frequency * np.arange(n_frames) / 1000.0
        noise[:, : N_SLOPES // 2] += amplitude * np.sin(2 * np.pi * turns)[:, None]
    return noise


def listened(rows: np.ndarray, batch: int = 50) -> SlopeSpectra:
    block = block_of(rows, np.zeros((len(rows), 1)), None)
    state = VibrationMonitor.of(N_SLOPES).quiet
    for start in range(0, len(rows), batch):
        state = state.with_frames(part(block, start, min(start + batch, len(rows))))
    return state


@pytest.mark.parametrize("seed", range(8))
def test_noise_alone_has_no_line(seed):
    assert listened(slopes(seed, {})).lines_hz() == ()


def test_lines_are_found_to_a_bin():
    """Bins are 0.98 Hz wide; a sine between two of them shows in either."""
    found = listened(slopes(1, {61.0: 0.5, 240.0: 0.3})).lines_hz()
    assert len(found) == 2
    np.testing.assert_allclose(found, [61.0, 240.0], atol=1.0)


def test_the_steep_end_of_turbulence_is_no_line():
    rng = np.random.default_rng(3)
    # a loop's own overshoot at 5 Hz, where turbulence bends
    steep = scipy.signal.lfilter(
        [1.0], [1.0, -1.993, 0.994], rng.normal(size=(12 * 1024, N_SLOPES)), axis=0
    )
    assert listened(steep).lines_hz() == ()


def test_the_dithers_own_lines_are_not_vibrations():
    found = listened(slopes(1, {61.0: 0.5, 240.0: 0.3})).lines_hz(known_hz=(240.0,))
    np.testing.assert_allclose(found, [61.0], atol=1.0)


def test_nothing_is_said_before_enough_has_been_heard():
    young = listened(slopes(1, {61.0: 0.5}, n_segments=MIN_SEGMENTS - 1))
    assert young.lines_hz() == ()


def test_a_gap_starts_the_segment_anew():
    rows = slopes(1, {}, n_segments=2)
    block = block_of(rows, np.zeros((len(rows), 1)), None)
    state = VibrationMonitor.of(N_SLOPES).quiet
    state = state.with_frames(part(block, 0, 1000))
    state = state.with_frames(part(block, 1010, 2010))
    assert state.n_segments == 0
    assert state.with_frames(part(block, 2010, 2048)).n_segments == 1


DITHER_HZ = (211.0, 239.0)


def overheard(parts: list[tuple[dict[str, float], bool, int]]) -> tuple[float, ...]:
    """Lines found after parts of a night, each with its lines, whether dithered, how many spectra.

    The dither's lines show in the slopes as any vibration does.
    """
    state, first = VibrationMonitor.of(N_SLOPES), 0
    for seed, (vibrations, dithered, n_segments) in enumerate(parts):
        lines = vibrations | (dict.fromkeys(DITHER_HZ, 0.3) if dithered else {})
        rows = slopes(seed, lines, n_segments)
        dither = np.zeros((len(rows), 1)) if dithered else None
        block = replace(block_of(rows, np.zeros((len(rows), 1)), dither), first_seq=first)
        for start in range(0, len(rows), 50):
            piece = part(block, start, min(start + 50, len(rows)))
            state = state.follow(piece, DITHER_HZ if dithered else ())
        first += len(rows)
    return state.lines_hz


def test_a_dither_is_no_vibration_and_what_vibrates_beside_it_is_heard():
    assert overheard([({}, True, 12)]) == ()
    np.testing.assert_allclose(overheard([({61.0: 0.5}, True, 12)]), [61.0], atol=1.0)


def test_a_vibration_on_the_dither_is_heard_in_a_pause():
    on_it = {239.0: 0.3}
    assert overheard([(on_it, True, 12)]) == ()
    found = overheard([(on_it, True, 12), (on_it, False, 12)])
    np.testing.assert_allclose(found, [239.0], atol=1.0)


def test_what_was_heard_in_two_ways_is_told_once():
    found = overheard([({61.0: 0.5}, True, 12), ({61.0: 0.5}, False, 12)])
    np.testing.assert_allclose(found, [61.0], atol=1.0)
