"""The watchdog: registration from what a loop's own noise does to the mirror."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from service.errors import ModelError
from service.estimation.frames import FrameBlock
from service.estimation.passive import (
    MIN_FRAMES_PER_MODE,
    N_TAPS,
    SAMPLES_KEPT,
    TAPER_FRAMES,
    Passive,
    accumulate,
    fit,
    high_pass,
    passive_matrix,
)
from service.estimation.windows import CHUNK_FRAMES
from service.model.misregistration import Misregistration
from service.records.estimates import BIAS_FLOOR, PassiveEstimate
from tests.support.numerics import (
    N_CONTROLLED,
    N_MODES,
    SOMEWHERE,
    Sky,
    block_of,
    closed_loop,
    part,
    small_linearisation,
    small_loop,
    small_model,
)

SKY = Sky(noise=2e-3, turbulence=0.003, memory=0.999)
"""Weak turbulence, for its steps are white: at the filter's frequencies there is noise alone."""


def young(memory_frames: float = 1e9, delay_frames: float = 2.0) -> Passive:
    return Passive(n_modes=N_CONTROLLED, memory_frames=memory_frames, delay_frames=delay_frames)


def fed(block: FrameBlock, state: Passive | None = None, n: int = 200) -> Passive:
    state = state or young()
    for start in range(0, block.n_frames, n):
        state = accumulate(state, part(block, start, min(start + n, block.n_frames)))
    return state


def quiet_block(n_frames: int, alpha: Misregistration = SOMEWHERE, gains: float | np.ndarray = 0.6):
    """A noise-free sensor watching commands that are known."""
    commands = 1e-8 * np.random.default_rng(3).normal(size=(n_frames, N_MODES))
    commands[:, N_CONTROLLED:] = 0.0
    matrix = small_model().interaction_matrix(alpha).astype(float)[:, :N_CONTROLLED]
    return block_of((commands[:, :N_CONTROLLED] * gains) @ matrix.T, commands, None)


@cache
def night(seed: int = 1, noise: float = SKY.noise) -> FrameBlock:
    """Twelve seconds of a closed loop."""
    return closed_loop(small_loop(), replace(SKY, seed=seed, noise=noise), np.zeros((12000, 40)))


def settled(state: Passive) -> PassiveEstimate:
    """The estimate about a linearisation at the estimate before."""
    near = small_linearisation()
    for _ in range(3):
        found = fit(state, near)
        assert found is not None
        near = small_model().linearise(found.alpha)
    return found


def test_a_noise_free_sensor_gives_back_its_own_matrix():
    """1e-4: single precision and a ridge of 1e-6."""
    found = passive_matrix(fed(quiet_block(2000))).matrix
    expected = 0.6 * small_model().interaction_matrix(SOMEWHERE)[:, :N_CONTROLLED]
    assert np.linalg.norm(found - expected) < 1e-4 * np.linalg.norm(expected)


@pytest.fixture
def every_third(monkeypatch):
    """Of the controlled modes each third alone is an instrument."""
    some = property(lambda state: np.arange(0, state.n_modes, 3))
    monkeypatch.setattr(Passive, "instruments", some)


def test_some_modes_tell_the_registration_though_all_of_them_move(every_third):
    """As the whole does, to 1e-5: what moves with the instruments is in the model, too."""
    state = fed(quiet_block(2000))
    assert [part.shape[1] for part in state.sums] == [(N_CONTROLLED + 2) // 3] * 3
    found = settled(state)
    np.testing.assert_allclose(found.alpha.vector, SOMEWHERE.vector, atol=1e-5)
    np.testing.assert_allclose(found.optical_gain, np.full(N_CONTROLLED, 0.6), rtol=1e-3)


def test_in_a_closed_loop_some_modes_tell_it_with_a_misfit_of_one(every_third):
    """Four of its own sigma: the turbulence here has no bias at the filter's frequencies."""
    near = small_model().linearise(SOMEWHERE)
    found = fit(fed(night()), near)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.alpha.vector - SOMEWHERE.vector) < 4 * sigma)
    assert found.misfit == pytest.approx(1, abs=0.2)


def test_a_noise_free_sensor_gives_its_registration_and_gains():
    """1e-5: single precision and a ridge of 1e-6."""
    found = settled(fed(quiet_block(2000)))
    np.testing.assert_allclose(found.alpha.vector, SOMEWHERE.vector, atol=1e-5)
    np.testing.assert_allclose(found.optical_gain, 0.6, rtol=1e-3)
    np.testing.assert_allclose(found.step, 0.0, atol=1e-4)


def test_one_step_is_exact_to_first_order_whatever_the_gains():
    """1 %: α is a thousandth of a subaperture, so that second order is a thousandth of it.

    A free gain takes what a derivative has in common with its own mode; forgetting that makes
    the step of the magnification 9 % short.
    """
    small = np.array([1e-3, -2e-3, 1e-4, 1e-4])
    near = small_linearisation()
    gains = np.linspace(0.3, 1.0, N_CONTROLLED)
    block = quiet_block(2000)
    matrix = near.matrix_at(Misregistration.from_vector(near.alpha.vector + small))
    slopes = (block.commands_m[:, :N_CONTROLLED] * gains) @ matrix[:, :N_CONTROLLED].T
    found = fit(fed(block_of(slopes, block.commands_m, None)), near)
    np.testing.assert_allclose(found.step, small, rtol=0.01)
    np.testing.assert_allclose(found.optical_gain, gains, rtol=1e-3)


def test_a_far_linearisation_is_a_little_off_and_says_how_far_it_went():
    """10 % of α: second order, α being a tenth of a subaperture."""
    found = fit(fed(quiet_block(2000)), small_linearisation())
    at_rest = Misregistration().vector
    np.testing.assert_allclose(found.step, SOMEWHERE.vector - at_rest, rtol=0.1)
    np.testing.assert_allclose(found.alpha.vector, at_rest + found.step, atol=1e-12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_closed_loop_tells_its_registration_within_its_scatter(seed):
    """4.5 of the σ of its scatter, the floor left out: once in 10 000 for each of twelve."""
    found = settled(fed(night(seed)))
    error = found.alpha.vector - SOMEWHERE.vector
    assert np.all(np.abs(error) < 4.5 * np.sqrt(np.diag(found.covariance)))
    assert np.all(np.sqrt(np.diag(found.covariance))[:2] < 0.02)


def test_the_scatter_of_windows_is_the_one_stated():
    """24 windows of 1.5 s: mean normalised squared error 4 ± 5 · sqrt(8 / 24)."""
    near = small_model().linearise(SOMEWHERE)
    squares = []
    for seed in (1, 2, 3):
        for start in range(0, 12000, 1500):
            found = fit(fed(part(night(seed), start, start + 1500)), near)
            squares.append(found.step @ np.linalg.solve(found.covariance, found.step))
    assert 1.1 < np.mean(squares) < 6.9


@pytest.mark.parametrize("turbulence", [pytest.param(0.03, marks=pytest.mark.long), 0.1])
def test_the_scatter_is_the_one_stated_where_fast_turbulence_is_left_in_the_slopes(turbulence):
    """Turbulence looks like modes, so its slopes are correlated: they are no white noise.

    24 windows as above; slopes taken for white make the mean 13.6 and 18.6.
    """
    near = small_model().linearise(SOMEWHERE)
    squares = []
    for seed in (1, 2, 3):
        sky = replace(SKY, seed=seed, turbulence=turbulence)
        block = closed_loop(small_loop(), sky, np.zeros((12000, 40)))
        for start in range(0, 12000, 1500):
            found = fit(fed(part(block, start, start + 1500)), near)
            squares.append(found.step @ np.linalg.solve(found.covariance, found.step))
    assert 1.1 < np.mean(squares) < 6.9, np.mean(squares)


def test_what_the_model_explains_has_a_misfit_of_one():
    """20 %: 64 samples of the noise of 240 slopes, and the fit of 30 columns to as many."""
    assert fit(fed(night()), small_model().linearise(SOMEWHERE)).misfit == pytest.approx(1, abs=0.2)


def test_a_sensor_that_is_not_the_modelled_one_shows_in_the_misfit():
    block = night()
    turned = block_of(np.roll(block.slopes, 3, axis=1), block.commands_m, None)
    assert fit(fed(turned), small_model().linearise(SOMEWHERE)).misfit > 2.0


def test_sigma_is_never_below_the_bias_that_no_dither_has_taught():
    """10 % of a subaperture, more where the scatter says that the signal is weak."""
    found = fit(fed(night()), small_linearisation())
    assert np.all(found.sigma > BIAS_FLOOR)
    strong, weak = (replace(found, covariance=np.eye(4) * s**2) for s in (1e-4, 0.014))
    np.testing.assert_allclose(strong.sigma[:2], 0.10, rtol=1e-3)
    np.testing.assert_allclose(weak.sigma[:2], np.hypot(0.10, 0.14), rtol=0.01)
    np.testing.assert_allclose(weak.sigma[3], np.hypot(0.001, 0.014))


def test_noise_widens_sigma_beyond_the_floor():
    block = quiet_block(700)
    noise = 30.0 * np.random.default_rng(4).normal(size=block.slopes.shape)
    found = fit(fed(block_of(block.slopes + noise, block.commands_m, None)), small_linearisation())
    assert np.all(found.sigma > 2 * BIAS_FLOOR)


def test_too_few_frames_give_no_estimate_rather_than_a_poor_one():
    least = MIN_FRAMES_PER_MODE * N_CONTROLLED
    enough = replace(fed(quiet_block(1000)), n_effective=float(least))
    assert fit(young(), small_linearisation()) is None
    assert fit(enough, small_linearisation()) is not None
    assert fit(replace(enough, n_effective=least - 1.0), small_linearisation()) is None


@pytest.mark.parametrize("still", [slice(7, 8), slice(None)], ids=["one mode", "all modes"])
def test_modes_that_never_move_do_not_break_the_watchdog(still):
    block = quiet_block(1000)
    commands = block.commands_m.copy()
    commands[:, still] = 0.0
    slopes = commands @ small_model().interaction_matrix(SOMEWHERE).T
    found = fit(fed(block_of(slopes, commands, None)), small_linearisation())
    assert found is None or np.all(np.isfinite(found.sigma))


# --- the filter


def response(delay_frames: float, turns: float) -> complex:
    """Of the filter at this frequency, in units of the frame rate."""
    chosen = high_pass(delay_frames)
    lags = np.arange(N_TAPS) - chosen.ahead
    return complex(np.sum(chosen.taps * np.exp(-2j * np.pi * turns * lags)))


@pytest.mark.parametrize("delay_frames", [2.0, 2.4, 3.0])
def test_slow_turbulence_is_kept_out_and_fast_noise_let_through(delay_frames):
    """At 20 Hz of 1 kHz a mode of 400 is 1000 times the noise; at 200 Hz there is only noise."""
    assert abs(response(delay_frames, 0.0)) < 1e-6
    assert abs(response(delay_frames, 0.02)) < 1e-3
    assert abs(response(delay_frames, 0.2)) > 0.3


def test_a_step_leaves_nothing_once_it_is_past():
    steps = np.zeros((60, 2), np.float32)
    steps[30:] = 1.0
    filtered = high_pass(2.0)(steps)
    assert len(filtered) == 60 - N_TAPS + 1
    assert np.abs(filtered[:20]).max() == 0.0
    assert np.abs(filtered[30:]).max() < 1e-6


def test_a_row_looks_ahead_no_further_than_commands_that_ignore_its_noise():
    """With two frames of delay the noise of frame k is first seen in the command of k + 2."""
    pulse = np.zeros((40, 1), np.float32)
    pulse[20] = 1.0
    chosen = high_pass(2.0)
    rows = np.flatnonzero(chosen(pulse)[:, 0]) + chosen.behind
    assert rows.min() == 20 - chosen.ahead
    assert chosen.ahead == 1
    assert high_pass(3.4).ahead == 2


def test_the_filter_makes_an_instrument_that_is_blind_to_the_noise_of_its_frame():
    """``E[z_k n_k] = 0`` and ``E[z_k c_k] > 0`` in a loop that is driven by noise alone.

    The standard error of a mean product of 200 000 frames is its σ over 447; 5 of them.
    """
    rng = np.random.default_rng(1)
    noise = rng.normal(size=200_000)
    commands = np.zeros(200_000)
    for k in range(2, len(noise)):
        commands[k] = 0.999 * commands[k - 1] - 0.35 * (noise[k - 2] + commands[k - 2])
    chosen = high_pass(2.0)
    filtered = chosen(commands[:, None].astype(np.float32))[:, 0]
    now = slice(chosen.behind, len(noise) - chosen.ahead)
    scale = filtered.std() / np.sqrt(len(filtered))
    assert abs(np.mean(filtered * noise[now])) < 5 * scale
    assert np.mean(filtered * commands[now]) > 50 * scale * commands.std()


def test_a_quick_loop_has_no_such_instrument():
    with pytest.raises(ModelError, match="1\\.9 frames"):
        high_pass(1.9)


# --- sums over filtered commands: what enters them, and what does not


def random_block(n_frames: int, seed: int = 3):
    rng = np.random.default_rng(seed)
    commands = 1e-8 * rng.normal(size=(n_frames, N_MODES))
    commands[:, N_CONTROLLED:] = 0.0
    return block_of(1e-2 * rng.normal(size=(n_frames, 224)), commands, None)


@pytest.mark.parametrize("n", [1, 7, 30, 400])
def test_how_telemetry_is_cut_into_blocks_changes_nothing(n):
    """1e-5: single precision. A chunk ends with a block, so the last of them are looked at."""
    block = random_block(2000)
    whole, cut = fed(block, n=2000), fed(block, n=n)
    last = whole.n_effective - cut.n_effective
    assert 0 <= last < CHUNK_FRAMES + TAPER_FRAMES
    again = fed(part(block, 0, 2000 - int(last)), n=2000)
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
    state = fed(quiet(Misregistration(), 0, 3000), state, n=100)
    assert state.n_effective == pytest.approx(1306, rel=0.05)
    state = fed(quiet(SOMEWHERE, 3000, 6600), state, n=100)
    found = passive_matrix(state).matrix
    expected = small_model().interaction_matrix(SOMEWHERE)[:, :N_CONTROLLED]
    assert np.linalg.norm(found - expected) < 0.01 * np.linalg.norm(expected)


def test_a_constant_offset_of_slopes_and_commands_hardly_matters():
    """1 %: an offset of 25 times the slopes' RMS is seen at the two ends of a run alone."""
    block = random_block(4000)
    slopes = block.commands_m @ small_model().interaction_matrix(SOMEWHERE).T
    lifted = block_of(slopes + 0.25, block.commands_m + np.float32(2e-8), None)
    plain = passive_matrix(fed(block_of(slopes, block.commands_m, None), n=200)).matrix
    offset = passive_matrix(fed(lifted, n=200)).matrix
    assert np.linalg.norm(plain - offset) < 0.01 * np.linalg.norm(plain)


def test_new_references_leave_nothing_of_their_step_if_they_have_a_name():
    """The mirror takes the new shape, and the slopes see it against the new zero point.

    1 %: a shape of 40 times the commands' RMS is seen at the two ends of a run. One over the step
    is off by four times as much as that.
    """
    block, n = random_block(4000), 2000
    response = small_model().interaction_matrix(SOMEWHERE)
    shape_m = np.zeros(N_MODES, np.float32)
    shape_m[:5] = 4e-7
    slopes = block.commands_m @ response.T
    after = part(block_of(slopes, block.commands_m + shape_m, None), n, 4000)
    before = fed(part(block_of(slopes, block.commands_m, None), 0, n))
    plain = passive_matrix(fed(block_of(slopes, block.commands_m, None))).matrix
    errors = []
    for name in ("ncpa-2", None):
        state = before
        for start in range(0, n, 200):
            state = accumulate(state, replace(part(after, start, start + 200), reference_name=name))
        found = passive_matrix(state).matrix
        errors.append(np.linalg.norm(found - plain) / np.linalg.norm(plain))
    assert errors[0] < 0.01
    assert errors[1] > 0.03


def test_a_dither_outside_the_loop_is_not_taken_for_a_controlled_mode():
    """Sines ten times the noise on four uncontrolled modes: α moves by less than 4 of its σ."""
    n_frames = 12000
    dither = np.zeros((n_frames, N_MODES))
    turns = np.outer(np.arange(n_frames), [0.211, 0.239, 0.283, 0.331])
    dither[:, -4:] = 2e-8 * np.sin(2 * np.pi * turns)
    block = closed_loop(small_loop(), Sky(turbulence=0.003, memory=0.999), dither)
    near = small_model().linearise(SOMEWHERE)
    found = fit(fed(block, n=200), near)
    assert np.all(np.abs(found.step) < 4 * np.sqrt(np.diag(found.covariance)))


def test_a_dither_of_controlled_modes_is_read_by_windows_and_not_by_looks():
    """It had made looks 15 times as precise as without, with another bias: a jump when it ended."""
    n_frames = 12000
    dither = np.zeros((n_frames, N_MODES))
    turns = np.outer(np.arange(n_frames), [0.211, 0.239, 0.283, 0.331])
    dither[:, N_CONTROLLED - 4 : N_CONTROLLED] = 2e-8 * np.sin(2 * np.pi * turns)
    sky, near = Sky(turbulence=0.003, memory=0.999), small_model().linearise(SOMEWHERE)
    looks = [
        fit(fed(closed_loop(small_loop(), sky, moved)), near)
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
    assert "1.4 frames" in state.explain_unusable
    assert young().explain_unusable is None


def test_of_more_modes_than_its_memory_can_tell_some_are_summed_evenly_spread():
    """4300 modes at 500 Hz: 21,500 frames are needed, 5000 are remembered, 2000 come in a look."""
    telling = Passive(n_modes=1000, memory_frames=5000.0)
    np.testing.assert_array_equal(telling.instruments, np.arange(1000))
    extreme = Passive(n_modes=4300, memory_frames=5000.0)
    assert extreme.explain_unusable is None
    assert len(extreme.instruments) == 200
    steps = np.diff(extreme.instruments)
    assert extreme.instruments[0] == 0
    assert set(steps) == {21, 22}


@pytest.mark.parametrize("size", [100, 500, 6000])
def test_samples_are_one_in_128_frames_however_they_come_and_bounded(size):
    assert len(fed(random_block(6000), n=size).samples) == pytest.approx(6000 // 128, abs=1)
    assert len(fed(random_block(20000), n=size).samples) == SAMPLES_KEPT
