"""Registration from commands alone: each is answered by another, a delay later."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from service.estimation import correlation, passive
from service.estimation.correlation import CORRELATION_BIAS, CommandCorrelation, accumulate, seen
from service.estimation.description import Description
from service.estimation.estimator import FrameContext, LoopContext
from service.estimation.frames import FrameBlock
from service.estimation.passive import Passive
from service.estimation.windows import ClosedLoop
from tests.numerics import (
    N_CONTROLLED,
    N_MODES,
    SOMEWHERE,
    Sky,
    closed_loop,
    part,
    small_loop,
    small_model,
)

SKY = Sky(noise=2e-3, turbulence=0.003, memory=0.999)
"""Weak turbulence: at the filter's frequencies there is noise alone."""


def loop(**changes) -> ClosedLoop:
    return replace(small_loop(), **changes)


def young(terms: ClosedLoop | None = None) -> CommandCorrelation:
    sums = Passive(n_modes=N_CONTROLLED, memory_frames=1e9)
    return CommandCorrelation(n_modes=N_CONTROLLED, sums=sums, terms=terms or loop())


def fed(block: FrameBlock, state: CommandCorrelation | None = None, n: int = 200):
    state = state or young()
    for start in range(0, block.n_frames, n):
        state = accumulate(state, part(block, start, min(start + n, block.n_frames)))
    return state


@cache
def night(seed: int = 1) -> FrameBlock:
    """Twelve seconds of a closed loop."""
    return closed_loop(small_loop(), replace(SKY, seed=seed), np.zeros((12000, N_MODES)))


def without_slopes(block: FrameBlock) -> FrameBlock:
    return replace(block, slopes=block.slopes[:, :0])


def test_what_r_saw_is_read_off_the_commands_that_it_led_to():
    """1e-5 of the largest: commands are in single precision."""
    block, terms = part(night(), 0, 300), small_loop()
    expected = (block.slopes @ terms.reconstructor.T)[:-2]
    found = seen(block, terms, 2)
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())


def test_what_r_saw_of_a_dither_is_no_dither():
    """The dither is added to what the integrator commands, and R has not seen it yet."""
    terms = small_loop()
    dither = np.zeros((300, N_MODES))
    dither[:, :N_CONTROLLED] = 1e-8 * np.random.default_rng(1).normal(size=(300, N_CONTROLLED))
    block = closed_loop(terms, SKY, dither)
    expected = (block.slopes @ terms.reconstructor.T)[:-2]
    np.testing.assert_allclose(seen(block, terms, 2), expected, atol=2e-5 * np.abs(expected).max())


def test_no_slope_is_needed():
    """A loop a tenth of a subaperture off tells so by its commands, within 4.5 of its own σ."""
    near = small_model().linearise(SOMEWHERE)
    found = fed(without_slopes(night())).fit(near)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.step) < 4.5 * sigma)
    assert np.all(sigma[:2] < 0.02)
    assert found.optical_gain == pytest.approx(SKY.optical_gain, abs=0.1)
    assert found.misfit == pytest.approx(1, abs=0.25)


def test_it_finds_the_way_from_a_perfect_registration():
    """12 % of α, a tenth of a subaperture away: the second order, and 1 % of noise."""
    near = small_model().linearise(replace(SOMEWHERE, shift_x_subap=0.0, shift_y_subap=0.0))
    found = fed(night()).fit(near)
    np.testing.assert_allclose(found.step[:2], [0.11, -0.07], atol=0.03)


def test_the_scatter_of_looks_is_the_one_stated():
    """24 looks of 1.5 s: mean normalised squared error 4 ± 5 · sqrt(8 / 24)."""
    near = small_model().linearise(SOMEWHERE)
    squares = []
    for seed in (1, 2, 3):
        for start in range(0, 12000, 1500):
            found = fed(part(night(seed), start, start + 1500)).fit(near)
            squares.append(found.step @ np.linalg.solve(found.covariance, found.step))
    assert 1.1 < np.mean(squares) < 6.9, np.mean(squares)


def test_slopes_tell_more_than_the_commands_that_follow_them():
    near = small_model().linearise(SOMEWHERE)
    slopes = Passive(n_modes=N_CONTROLLED, memory_frames=1e9)
    for start in range(0, 12000, 500):
        slopes = passive.accumulate(slopes, part(night(), start, start + 500))
    by_slopes, by_commands = slopes.fit(near), fed(night()).fit(near)
    ratio = np.sqrt(np.diag(by_commands.covariance) / np.diag(by_slopes.covariance))
    assert np.all((ratio > 0.95) & (ratio < 1.6)), ratio


def test_blocks_of_any_size_give_the_same_pairs_of_command_and_answer():
    one, other = (fed(part(night(), 0, 400), n=n) for n in (1, 160))
    for columns in ("slopes", "commands_m"):
        some, others = (
            np.concatenate([getattr(block, columns) for block in state.sums.waiting])
            for state in (one, other)
        )
        assert len(some) == 398
        np.testing.assert_array_equal(some, others)


def test_an_answer_that_is_missing_is_no_answer_of_the_frame_after_the_gap():
    whole = part(night(), 0, 3000)
    state = fed(part(whole, 0, 1500))
    state = fed(part(whole, 1507, 3000), state)
    near = small_model().linearise(SOMEWHERE)
    found = state.fit(near)
    assert np.all(np.abs(found.step) < 4.5 * np.sqrt(np.diag(found.covariance)))


def test_a_dither_that_begins_between_two_blocks_is_told_from_commands():
    dither = np.zeros((400, N_MODES))
    dither[200:, N_CONTROLLED - 1] = 1e-8
    block = closed_loop(small_loop(), SKY, dither)
    first = replace(part(block, 0, 200), dither_m=None)
    both = [
        accumulate(accumulate(young(), one), part(block, 200, 400))
        for one in (first, part(block, 0, 200))
    ]
    for state in both:
        assert state.tail.next_seq == 400
    waiting = [np.concatenate([b.slopes for b in state.sums.waiting]) for state in both]
    np.testing.assert_array_equal(*waiting)


def test_modes_without_gain_are_not_read():
    """They do not move, and a division by their gain would be one by nothing."""
    gains = small_loop().gains.copy()
    gains[5] = 0.0
    read = seen(part(night(), 0, 20), loop(gains=gains), 2)
    assert read.shape == (18, N_CONTROLLED - 1)
    assert np.all(np.isfinite(read))


def test_a_delay_between_frames_says_why_there_is_none():
    state = replace(
        young(), sums=Passive(n_modes=N_CONTROLLED, memory_frames=1e9, delay_frames=2.4)
    )
    assert "the loop's delay is 2.4 frames, whole ones are needed" in state.why_unusable
    assert accumulate(state, night()) is state


def test_a_matrix_that_nobody_knows_tells_nothing():
    known = Description(n_slopes=240, n_modes=N_MODES, mode_variance_m2=np.ones(N_MODES))
    context = LoopContext(description=known)
    frames = FrameContext(block=night(), loop=context, rtc=None, terms=None, lines_hz=())
    state = replace(young(), terms=None)
    assert state.update(frames) is state
    assert state.fit(small_model().linearise(SOMEWHERE)) is None


def test_it_has_a_bias_of_its_own():
    found = fed(night()).fit(small_model().linearise(SOMEWHERE))
    assert found.bias is CORRELATION_BIAS
    assert np.all(found.sigma > CORRELATION_BIAS.floor)


def test_sums_that_are_closed_begin_with_nothing():
    closed = fed(night()).emptied(rests=True)
    assert closed.n_effective == 0.0
    assert closed.fit(small_model().linearise(SOMEWHERE)) is None
    assert correlation.accumulate(closed, part(night(), 0, 1)).n_waiting == 0
