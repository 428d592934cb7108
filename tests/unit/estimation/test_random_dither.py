"""Random binary dither: the noisy interaction matrix and the registration in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.errors import ModelError
from service.estimation import random_dither
from service.estimation.random_dither import (
    Correlated,
    RandomDither,
    RandomPlan,
    fit_random,
    join_random_windows,
    noisy_matrix,
)
from service.model.interaction import Linearisation
from service.records.estimates import RandomEstimate, RefusalKind, WindowRefused
from tests.support.numerics import (
    N_MODES,
    SOMEWHERE,
    Sky,
    block_of,
    closed_loop,
    part,
    small_loop,
    small_model,
)

FREE = (31, 33, 35, 37)
AMPLITUDE_M = 5e-9


def plan(modes: tuple[int, ...] = FREE, n_frames: int = 2000, first_seq: int = 0) -> RandomPlan:
    return RandomPlan(
        modes=modes,
        amplitude_m=(AMPLITUDE_M,) * len(modes),
        n_frames=n_frames,
        first_seq=first_seq,
    )


def signs(modes: tuple[int, ...], n_frames: int, seed: int = 5) -> np.ndarray:
    """The dither ``(n_frames, n_modes)``."""
    rng = np.random.default_rng(seed)
    dither = np.zeros((n_frames, N_MODES))
    dither[:, list(modes)] = AMPLITUDE_M * rng.choice([-1.0, 1.0], size=(n_frames, len(modes)))
    return dither


def quiet_block(modes: tuple[int, ...], n_frames: int, gain: float = 0.6):
    """A noise-free sensor that sees the dither and nothing else."""
    dither = signs(modes, n_frames)
    slopes = gain * dither @ small_model().interaction_matrix(SOMEWHERE).T.astype(float)
    return block_of(slopes, dither, dither)


def near_somewhere() -> Linearisation:
    return small_model().linearise(SOMEWHERE)


def only_window(state: RandomDither, *blocks) -> Correlated | WindowRefused:
    found = []
    for block in blocks:
        state, ended = state.accumulate(block)
        found += ended
    assert len(found) == 1
    return found[0]


def test_a_noise_free_sensor_gives_back_its_own_columns():
    """1e-5: single precision. No turbulence, so nothing to whiten: ρ is that of random signs."""
    window = only_window(RandomDither(plan=plan()), quiet_block(FREE, 2001))
    noisy = noisy_matrix(window)
    expected = 0.6 * small_model().interaction_matrix(SOMEWHERE)[:, list(FREE)]
    assert abs(window.sums.memory) < 0.1
    # whitening by a ρ that is not zero leaves -ρ s[k-1], as random as the signs themselves
    bound = 3.0 * abs(window.sums.memory) + 1e-5
    assert np.linalg.norm(noisy.matrix - expected) < bound * np.linalg.norm(expected)


def test_the_blocks_a_window_came_in_do_not_matter():
    block = quiet_block(FREE, 2001)
    whole = only_window(RandomDither(plan=plan()), block)
    pieces = [part(block, k, min(k + 17, 2001)) for k in range(0, 2001, 17)]
    again = only_window(RandomDither(plan=plan()), *pieces)
    for name in ("response", "late", "dither_power", "noise_power", "slope_power", "memory"):
        one, other = getattr(whole.sums, name), getattr(again.sums, name)
        np.testing.assert_allclose(other, one, rtol=1e-4, atol=1e-6 * np.abs(one).max())
    assert again.sums.n_pairs == whole.sums.n_pairs == 1999


def test_a_missing_frame_costs_the_two_pairs_it_was_in():
    block = quiet_block(FREE, 2001)
    window = only_window(RandomDither(plan=plan()), part(block, 0, 1000), part(block, 1001, 2001))
    assert (window.n_missing, window.sums.n_pairs) == (1, 1997)


def test_the_end_of_the_window_may_be_missing():
    block = quiet_block(FREE, 2100)
    window = only_window(RandomDither(plan=plan()), part(block, 0, 1990), part(block, 2050, 2100))
    assert isinstance(window, Correlated)


def looped(n_frames: int, seed: int, sky: Sky | None = None, modes: tuple[int, ...] = FREE):
    return closed_loop(small_loop(), replace(sky or Sky(), seed=seed), signs(modes, n_frames, seed))


EVERY = tuple(range(N_MODES))


@pytest.fixture
def many(monkeypatch):
    """Modes so few that the small instrument has many."""
    monkeypatch.setattr(random_dither, "MIN_MODES_WITHOUT_BATCHES", 30)


@pytest.mark.usefixtures("many")
@pytest.mark.parametrize("modes", [pytest.param(FREE, marks=pytest.mark.long), EVERY])
def test_sigma_is_the_scatter_of_closed_loop_windows(modes):
    """24 windows, 4 parameters: chi2/4 within 1 ± 0.35 at 95 %.

    24 batches, or the scatter of 40 modes where all are dithered, widen it: 96 windows of all
    have a mean of 1.3 and 0.87 of them inside. On a telescope with hundreds of modes it is 1.05.
    """
    near = near_somewhere()
    distances, inside = [], 0
    for seed in range(24):
        window = only_window(RandomDither(plan=plan(modes)), looped(2001, seed, modes=modes))
        found = fit_random(window, near)
        assert isinstance(found, RandomEstimate)
        error = found.alpha.vector - SOMEWHERE.vector
        distances.append(error @ np.linalg.solve(found.covariance, error) / 4)
        inside += bool(distances[-1] < 9.49 / 4)
    assert 0.6 < np.mean(distances) < 1.7
    assert inside >= 17


@pytest.mark.usefixtures("many")
@pytest.mark.parametrize("modes", [FREE, EVERY])
def test_the_gain_of_each_mode_is_the_sensors_optical_gain_within_its_own_sigma(modes):
    """chi2 of 4 and of 40 gains, within its 99 % range."""
    window = only_window(RandomDither(plan=plan(modes, 8000)), looped(8001, 3, modes=modes))
    found = fit_random(window, near_somewhere())
    distance = np.sum(((found.optical_gain - 0.7) / found.gain_sigma) ** 2)
    low, high = {4: (0.2, 14.9), 40: (20.7, 66.8)}[len(modes)]
    assert low < distance < high
    assert np.all(found.gain_sigma < 0.05)


def test_a_slope_that_answers_in_its_own_row_has_no_lag():
    found = fit_random(
        only_window(RandomDither(plan=plan(n_frames=8000)), looped(8001, 3)), near_somewhere()
    )
    assert found.lag_frames[0] < 0.05


@pytest.mark.parametrize("modes", [FREE, EVERY])
@pytest.mark.usefixtures("many")
def test_two_windows_joined_are_as_good_as_one_of_twice_the_length(modes):
    """A pair of frames is lost at the seam, and ρ is that of two halves: a fifth of σ."""
    near, block = near_somewhere(), looped(4001, 6, modes=modes)
    _, halves = RandomDither(plan=plan(modes, 2000)).accumulate(block)
    whole = fit_random(only_window(RandomDither(plan=plan(modes, 4000)), block), near)
    both = fit_random(join_random_windows(*halves), near)
    sigma = np.sqrt(np.diag(whole.covariance))
    assert np.all(np.abs(both.alpha.vector - whole.alpha.vector) < 0.2 * sigma)
    np.testing.assert_allclose(np.sqrt(np.diag(both.covariance)), sigma, rtol=0.25)


def test_windows_of_different_modes_are_never_joined():
    one = only_window(RandomDither(plan=plan()), quiet_block(FREE, 2001))
    other = only_window(RandomDither(plan=plan(FREE[:3])), quiet_block(FREE[:3], 2001))
    with pytest.raises(ModelError, match="windows of 4 modes in session night-1 and 3"):
        join_random_windows(one, other)


def test_the_noise_of_the_elements_is_what_they_scatter_by():
    """Two halves of a night differ by noise alone: sqrt(2) of its stated σ.

    The turbulence on the slopes has some ten degrees of freedom, 40 columns of it are known to
    3.5 %: twice that. The signal-to-noise ratio of the whole is sqrt(2) times that of a half.
    """
    _, halves = RandomDither(plan=plan(EVERY, 8000)).accumulate(looped(16001, 9, modes=EVERY))
    one, other = (noisy_matrix(half) for half in halves)
    difference = (one.matrix - other.matrix) / np.hypot(one.noise, other.noise)
    assert np.sqrt(np.mean(difference**2)) == pytest.approx(1.0, abs=0.07)
    assert noisy_matrix(join_random_windows(*halves)).snr == pytest.approx(
        np.sqrt(2) * one.snr, rel=0.1
    )


def test_slopes_that_answer_one_frame_late_are_refused_as_misaligned():
    block = looped(2002, 4)
    late = block_of(block.slopes[:-1], block.commands_m[1:], block.dither_m[1:])
    refused = fit_random(only_window(RandomDither(plan=plan()), late), near_somewhere())
    assert isinstance(refused, WindowRefused)
    assert refused.reason.code == "window.answered-late"
    assert refused.kind is RefusalKind.MISALIGNED


def test_a_dither_that_never_reached_the_mirror_is_not_seen():
    loop_only = closed_loop(small_loop(), Sky(seed=2), np.zeros((2001, N_MODES)))
    pretended = replace(loop_only, dither_m=signs(FREE, 2001).astype(np.float32))
    refused = fit_random(only_window(RandomDither(plan=plan()), pretended), near_somewhere())
    assert isinstance(refused, WindowRefused)
    assert refused.reason.code == "window.dither-not-seen"
    assert refused.kind is RefusalKind.OTHER


def test_a_clipped_dither_is_refused_with_the_mode_and_both_amplitudes():
    block = quiet_block(FREE, 2001)
    dither = block.dither_m.copy()
    dither[:, 35] *= 0.2
    refused = only_window(RandomDither(plan=plan()), replace(block, dither_m=dither))
    assert isinstance(refused, WindowRefused)
    assert refused.reason.code == "window.dither-weak"
    assert refused.reason.values["mode"] == 35
    assert "carries 1.00 nm of dither, 5.00 nm were requested" in str(refused.reason)


def test_another_reconstructor_inside_the_window_ends_it():
    block = quiet_block(FREE, 2001)
    swapped = replace(part(block, 1000, 2001), cm_id="cm-2")
    refused = only_window(RandomDither(plan=plan()), part(block, 0, 1000), swapped)
    assert isinstance(refused, WindowRefused)
    assert refused.reason.key == "window.matrix-changed: cm-1 -> cm-2"


def test_a_window_too_short_for_its_modes_is_refused_before_it_begins():
    with pytest.raises(ModelError, match="found windows of 150 frames, expected at least 192"):
        plan(n_frames=150)
