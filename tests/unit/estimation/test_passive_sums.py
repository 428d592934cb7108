"""Sums over filtered commands: what enters them, and what does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.passive import (
    SAMPLES_KEPT,
    TAPER_FRAMES,
    Passive,
    accumulate,
    fit,
    passive_matrix,
)
from service.estimation.windows import CHUNK_FRAMES
from service.model.misregistration import Misregistration
from tests.numerics import (
    N_CONTROLLED,
    N_MODES,
    SOMEWHERE,
    Sky,
    block_of,
    closed_loop,
    part,
    small_loop,
    small_model,
)


def young(memory_frames: float = 1e9, delay_frames: float = 2.0) -> Passive:
    return Passive(n_modes=N_CONTROLLED, memory_frames=memory_frames, delay_frames=delay_frames)


def random_block(n_frames: int, seed: int = 3):
    rng = np.random.default_rng(seed)
    commands = 1e-8 * rng.normal(size=(n_frames, N_MODES))
    commands[:, N_CONTROLLED:] = 0.0
    return block_of(1e-2 * rng.normal(size=(n_frames, 224)), commands, None)


def fed(block, n: int, state: Passive | None = None) -> Passive:
    state = state or young()
    for start in range(0, block.n_frames, n):
        state = accumulate(state, part(block, start, min(start + n, block.n_frames)))
    return state


@pytest.mark.parametrize("n", [1, 7, 30, 400])
def test_how_telemetry_is_cut_into_blocks_changes_nothing(n):
    """1e-5: single precision. A chunk ends with a block, so the last of them are looked at."""
    block = random_block(2000)
    whole, cut = fed(block, 2000), fed(block, n)
    last = whole.n_effective - cut.n_effective
    assert 0 <= last < CHUNK_FRAMES + TAPER_FRAMES
    again = fed(part(block, 0, 2000 - int(last)), 2000)
    for one, other in zip(cut.sums, again.sums, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5 * np.abs(other).max())


def test_a_run_that_is_too_short_leaves_nothing():
    state = young()
    for k in range(40):
        block = replace(random_block(60, seed=k), first_seq=100 * k)
        state = accumulate(state, block)
    assert not state.sums


def test_a_gap_does_not_let_turbulence_in():
    """A run cut off without fading is off by more than the noise: three times the scatter here."""
    sky = Sky(noise=2e-4, turbulence=1.0, memory=0.9999)
    block = closed_loop(small_loop(), sky, np.zeros((12000, N_MODES)))
    near = small_model().linearise(SOMEWHERE)
    whole, broken = young(), young()
    for start in range(0, 12000, 400):
        whole = accumulate(whole, part(block, start, start + 400))
        broken = accumulate(broken, part(block, start, start + 397))
    sigma = [np.sqrt(np.diag(fit(state, near).covariance)) for state in (whole, broken)]
    assert np.all(sigma[1] < 1.6 * sigma[0])


def test_old_frames_are_forgotten():
    """After six memories 99.8 % of the sums are of the new registration.

    A chunk of 560 frames fades together: 560 / (1 - exp(-0.56)) of them remain.
    """

    def quiet(alpha, first_seq, n_frames):
        commands = random_block(n_frames).commands_m
        slopes = commands @ small_model().interaction_matrix(alpha).T
        return replace(block_of(slopes, commands, None), first_seq=first_seq)

    state = young(memory_frames=1000)
    state = fed(quiet(Misregistration(), 0, 3000), 100, state)
    assert state.n_effective == pytest.approx(1306, rel=0.05)
    state = fed(quiet(SOMEWHERE, 3000, 6600), 100, state)
    found = passive_matrix(state).matrix
    expected = small_model().interaction_matrix(SOMEWHERE)[:, :N_CONTROLLED]
    assert np.linalg.norm(found - expected) < 0.01 * np.linalg.norm(expected)


def test_a_constant_offset_of_slopes_and_commands_hardly_matters():
    """1 %: an offset of 25 times the slopes' RMS is seen at the two ends of a run alone."""
    block = random_block(4000)
    slopes = block.commands_m @ small_model().interaction_matrix(SOMEWHERE).T
    lifted = block_of(slopes + 0.25, block.commands_m + np.float32(2e-8), None)
    plain = passive_matrix(fed(block_of(slopes, block.commands_m, None), 200)).matrix
    offset = passive_matrix(fed(lifted, 200)).matrix
    assert np.linalg.norm(plain - offset) < 0.01 * np.linalg.norm(plain)


def test_a_dither_outside_the_loop_is_not_taken_for_a_controlled_mode():
    """Sines ten times the noise on four uncontrolled modes: α moves by less than 4 of its σ."""
    n_frames = 12000
    dither = np.zeros((n_frames, N_MODES))
    turns = np.outer(np.arange(n_frames), [0.211, 0.239, 0.283, 0.331])
    dither[:, -4:] = 2e-8 * np.sin(2 * np.pi * turns)
    block = closed_loop(small_loop(), Sky(turbulence=0.003, memory=0.999), dither)
    near = small_model().linearise(SOMEWHERE)
    found = fit(fed(block, 200), near)
    assert np.all(np.abs(found.step) < 4 * np.sqrt(np.diag(found.covariance)))


def test_a_dither_of_controlled_modes_is_read_by_windows_and_not_by_looks():
    """It had made looks 15 times as precise as without, with another bias: a jump when it ended."""
    n_frames = 12000
    dither = np.zeros((n_frames, N_MODES))
    turns = np.outer(np.arange(n_frames), [0.211, 0.239, 0.283, 0.331])
    dither[:, N_CONTROLLED - 4 : N_CONTROLLED] = 2e-8 * np.sin(2 * np.pi * turns)
    sky, near = Sky(turbulence=0.003, memory=0.999), small_model().linearise(SOMEWHERE)
    looks = [
        fit(fed(closed_loop(small_loop(), sky, moved), 200), near)
        for moved in (np.zeros_like(dither), dither)
    ]
    alone, beside = (np.sqrt(np.diag(look.covariance)) for look in looks)
    assert np.all(beside > 0.7 * alone)
    assert np.all(np.abs(looks[1].step) < 4 * beside)
    assert np.isnan(looks[1].misfit), "what is noise cannot be told beside it"


def test_a_dither_of_controlled_modes_that_begins_or_ends_joins_no_frames_of_both():
    block = random_block(4000)
    dithered = replace(block, dither_m=np.zeros_like(block.commands_m))
    dithered.dither_m[:, 0] = 1e-8 * np.sin(1.3 * np.arange(4000))
    state = young()
    for first in range(0, 4000, 200):
        shown = dithered if 1000 <= first < 2000 else block
        state = accumulate(state, part(shown, first, first + 200))
    assert 3000 < state.n_effective < 4000


def test_a_loop_without_two_frames_of_delay_is_not_summed_and_says_why():
    state = accumulate(young(delay_frames=1.4), random_block(2000))
    assert not state.sums
    assert state.n_effective == 0.0
    assert "1.4 frames" in state.why_unusable
    assert young().why_unusable is None


def test_of_more_modes_than_its_memory_can_tell_some_are_summed_evenly_spread():
    """4300 modes at 500 Hz: 21,500 frames are needed, 5000 are remembered, 2000 come in a look."""
    telling = Passive(n_modes=1000, memory_frames=5000.0)
    np.testing.assert_array_equal(telling.instruments, np.arange(1000))
    extreme = Passive(n_modes=4300, memory_frames=5000.0)
    assert extreme.why_unusable is None
    assert len(extreme.instruments) == 200
    steps = np.diff(extreme.instruments)
    assert extreme.instruments[0] == 0
    assert set(steps) == {21, 22}


@pytest.mark.parametrize("size", [100, 500, 6000])
def test_samples_are_one_in_128_frames_however_they_come_and_bounded(size):
    assert len(fed(random_block(6000), size).samples) == pytest.approx(6000 // 128, abs=1)
    assert len(fed(random_block(20000), size).samples) == SAMPLES_KEPT
