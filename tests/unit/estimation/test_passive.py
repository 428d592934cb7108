"""The watchdog: registration from first differences of ordinary telemetry."""

from __future__ import annotations

import numpy as np
import pytest

from service.estimation.passive import (
    BIAS_FLOOR,
    MIN_FRAMES_PER_MODE,
    Passive,
    PassiveEstimate,
    accumulate,
    fit,
    interaction_matrix,
)
from service.model.misregistration import Misregistration
from tests.numerics import (
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


def young(memory_frames: float = 1e9, n_modes: int = N_CONTROLLED) -> Passive:
    return Passive(n_modes=n_modes, memory_frames=memory_frames)


def random_commands(n_frames: int, seed: int = 3) -> np.ndarray:
    commands = 1e-8 * np.random.default_rng(seed).normal(size=(n_frames, N_MODES))
    commands[:, N_CONTROLLED:] = 0.0
    return commands


def quiet_block(n_frames: int, alpha: Misregistration = SOMEWHERE, gain: float = 0.6):
    """A noise-free sensor watching commands that are known."""
    commands = random_commands(n_frames)
    slopes = gain * commands @ small_model().interaction_matrix(alpha).T.astype(float)
    return block_of(slopes, commands, None)


def test_a_noise_free_sensor_gives_back_its_own_matrix():
    """1e-4: single precision and a ridge of 1e-6."""
    found = interaction_matrix(accumulate(young(), quiet_block(2000)))
    expected = 0.6 * small_model().interaction_matrix(SOMEWHERE)[:, :N_CONTROLLED]
    assert np.linalg.norm(found - expected) < 1e-4 * np.linalg.norm(expected)


def test_a_constant_offset_of_slopes_and_commands_is_not_seen():
    block = quiet_block(500)
    lifted = block_of(block.slopes + 0.25, block.commands_m + np.float32(2e-8), None)
    plain, offset = (interaction_matrix(accumulate(young(), b)) for b in (block, lifted))
    assert np.linalg.norm(plain - offset) < 1e-4 * np.linalg.norm(plain)


def test_too_few_frames_give_no_estimate_rather_than_a_poor_one():
    least = MIN_FRAMES_PER_MODE * N_CONTROLLED
    block = quiet_block(least + 1)
    assert fit(young(), small_linearisation()) is None
    assert interaction_matrix(accumulate(young(), part(block, 0, least))) is None
    assert fit(accumulate(young(), part(block, 0, least)), small_linearisation()) is None
    assert fit(accumulate(young(), block), small_linearisation()) is not None


def test_a_single_frame_has_no_difference():
    state = young()
    assert accumulate(state, quiet_block(1)) is state


def test_no_difference_spans_two_blocks():
    """Frames may be missing between them."""
    block = quiet_block(100)
    state = accumulate(accumulate(young(), part(block, 0, 50)), part(block, 50, 100))
    assert state.n_effective == pytest.approx(98, rel=1e-6)


def test_old_frames_are_forgotten():
    """After six memories at another registration 99.8 % of the sums are of the new one.

    A hundred frames at a time fade together: 99 / (1 - exp(-99/500)) = 552 of them remain. 10 %:
    second order of a linearisation at α = 0.
    """
    state = young(memory_frames=500)
    for _ in range(20):
        state = accumulate(state, quiet_block(100, Misregistration()))
    assert state.n_effective == pytest.approx(552, rel=0.03)
    for _ in range(30):
        state = accumulate(state, quiet_block(100, SOMEWHERE))
    found = fit(state, small_linearisation()).alpha.vector - Misregistration().vector
    np.testing.assert_allclose(found, SOMEWHERE.vector - [0, 0, 0, 1], rtol=0.1)


def settled(state: Passive) -> PassiveEstimate:
    """The estimate about a linearisation at the estimate before."""
    near = small_linearisation()
    for _ in range(3):
        found = fit(state, near)
        near = small_model().linearise(found.alpha)
    return found


def test_a_noise_free_sensor_gives_its_registration_and_gains():
    """1e-5: single precision and a ridge of 1e-6."""
    found = settled(accumulate(young(), quiet_block(2000)))
    np.testing.assert_allclose(found.alpha.vector, SOMEWHERE.vector, atol=1e-5)
    np.testing.assert_allclose(found.gains, 0.6, rtol=1e-3)
    np.testing.assert_allclose(found.step, 0.0, atol=1e-4)


def test_one_step_is_exact_to_first_order_whatever_the_gains():
    """1 %: α is a thousandth of a subaperture, so that second order is a thousandth of it.

    A free gain takes what a derivative has in common with its own mode; forgetting that makes
    the step of the magnification 9 % short.
    """
    small = np.array([1e-3, -2e-3, 1e-4, 1e-4])
    near = small_linearisation()
    gains = np.linspace(0.3, 1.0, N_CONTROLLED)
    alpha = Misregistration.from_vector(near.alpha.vector + small)
    commands = random_commands(2000)
    slopes = (commands[:, :N_CONTROLLED] * gains) @ near.matrix_at(alpha)[:, :N_CONTROLLED].T
    found = fit(accumulate(young(), block_of(slopes, commands, None)), near)
    np.testing.assert_allclose(found.step, small, rtol=0.01)
    np.testing.assert_allclose(found.gains, gains, rtol=1e-3)


def test_a_far_linearisation_is_a_little_off_and_says_how_far_it_went():
    """10 % of α: second order, α being a tenth of a subaperture."""
    found = fit(accumulate(young(), quiet_block(2000)), small_linearisation())
    at_rest = Misregistration().vector
    np.testing.assert_allclose(found.step, SOMEWHERE.vector - at_rest, rtol=0.1)
    np.testing.assert_allclose(found.alpha.vector, at_rest + found.step, atol=1e-12)


def test_a_closed_loop_tells_its_registration_within_its_own_uncertainty():
    """3 of the stated σ, floor included, over twenty seconds of turbulence without wind."""
    sky = Sky(noise=2e-3, turbulence=0.1, memory=0.999)
    block = closed_loop(small_loop(), sky, np.zeros((20000, N_MODES)))
    found = settled(accumulate(young(), block))
    assert np.all(np.abs(found.alpha.vector - sky.alpha.vector) < 3 * found.sigma)
    assert np.all(found.sigma[2:] < 2 * BIAS_FLOOR[2:])


@pytest.mark.parametrize("n_frames", [400, 20000])
def test_no_integration_takes_sigma_below_the_floor_of_the_wind(n_frames):
    block = quiet_block(n_frames)
    noisy = block_of(
        block.slopes + 1e-2 * np.random.default_rng(4).normal(size=block.slopes.shape),
        block.commands_m,
        None,
    )
    found = fit(accumulate(young(), noisy), small_linearisation())
    assert np.all(found.sigma >= BIAS_FLOOR)


def test_noise_widens_sigma_beyond_the_floor():
    block = quiet_block(400)
    noise = 30.0 * np.random.default_rng(4).normal(size=block.slopes.shape)
    found = fit(
        accumulate(young(), block_of(block.slopes + noise, block.commands_m, None)),
        small_linearisation(),
    )
    assert np.all(found.sigma > 2 * BIAS_FLOOR)


@pytest.mark.parametrize("still", [slice(7, 8), slice(None)], ids=["one mode", "all modes"])
def test_modes_that_never_move_do_not_break_the_watchdog(still):
    block = quiet_block(1000)
    commands = block.commands_m.copy()
    commands[:, still] = 0.0
    slopes = commands @ small_model().interaction_matrix(SOMEWHERE).T
    found = fit(accumulate(young(), block_of(slopes, commands, None)), small_linearisation())
    assert found is None or np.all(np.isfinite(found.sigma))
