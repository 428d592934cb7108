"""Vibration lines found in the slopes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from service.estimation.vibration import (
    MIN_SEGMENTS,
    SEGMENT_FRAMES,
    Vibrations,
    lines_hz,
    listen,
    views_of,
)
from tests.numerics import block_of, part

N_SLOPES = 60


def slopes(seed: int, vibrations: dict[float, float], n_segments: int = 12) -> np.ndarray:
    """Turbulence-like noise with a red spectrum, and sines on tip: Hz to amplitude in σ."""
    rng = np.random.default_rng(seed)
    n_frames = n_segments * SEGMENT_FRAMES
    noise = lfilter([1.0], [1.0, -0.9], rng.normal(size=(n_frames, N_SLOPES)), axis=0)
    for frequency, amplitude in vibrations.items():
        turns = frequency * np.arange(n_frames) / 1000.0
        noise[:, : N_SLOPES // 2] += amplitude * np.sin(2 * np.pi * turns)[:, None]
    return noise


def heard(rows: np.ndarray, batch: int = 50) -> Vibrations:
    block = block_of(rows, np.zeros((len(rows), 1)), None)
    state = Vibrations(views=views_of(N_SLOPES))
    for start in range(0, len(rows), batch):
        state = listen(state, part(block, start, min(start + batch, len(rows))))
    return state


@pytest.mark.parametrize("seed", range(8))
def test_noise_alone_has_no_line(seed):
    assert lines_hz(heard(slopes(seed, {}))) == ()


def test_lines_are_found_to_a_bin():
    """Bins are 0.98 Hz wide; a sine between two of them shows in either."""
    found = lines_hz(heard(slopes(1, {61.0: 0.5, 240.0: 0.3})))
    assert len(found) == 2
    np.testing.assert_allclose(found, [61.0, 240.0], atol=1.0)


def test_the_dithers_own_lines_are_not_vibrations():
    found = lines_hz(heard(slopes(1, {61.0: 0.5, 240.0: 0.3})), known_hz=(240.0,))
    np.testing.assert_allclose(found, [61.0], atol=1.0)


def test_nothing_is_said_before_enough_has_been_heard():
    young = heard(slopes(1, {61.0: 0.5}, n_segments=MIN_SEGMENTS - 1))
    assert lines_hz(young) == ()


def test_a_gap_starts_the_segment_anew():
    rows = slopes(1, {}, n_segments=2)
    block = block_of(rows, np.zeros((len(rows), 1)), None)
    state = Vibrations(views=views_of(N_SLOPES))
    state = listen(state, part(block, 0, 1000))
    state = listen(state, part(block, 1010, 2010))
    assert state.n_segments == 0
    assert listen(state, part(block, 2010, 2048)).n_segments == 1
