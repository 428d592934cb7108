"""Streams stored some frames apart: the lag is measured, without a reconstructor."""

import numpy as np
import pytest

from pyrcal.playback.alignment import MIN_FRAMES, measure_delay

N_SLOPES, N_MODES, GAIN = 60, 20, 0.4


def loop(delay, n_frames, seed=1, leak=0.99):
    """An integrator on slowly changing turbulence, with noise; its matrix is not the model's."""
    rng = np.random.default_rng(seed)
    response = rng.normal(size=(N_SLOPES, N_MODES))
    reconstructor = np.linalg.pinv(response + 0.1 * rng.normal(size=response.shape))
    turbulence = np.cumsum(rng.normal(size=(n_frames, N_MODES)), axis=0)
    slopes, commands = np.zeros((n_frames, N_SLOPES)), np.zeros((n_frames, N_MODES))
    for t in range(n_frames):
        if t >= delay:
            commands[t] = leak * commands[t - 1] + GAIN * reconstructor @ slopes[t - delay]
        seen = response @ (turbulence[t] - commands[t])
        slopes[t] = seen + 0.5 * rng.normal(size=N_SLOPES)
    return slopes, commands


def apart(slopes, commands, frames):
    """Store slopes so many frames before the commands they belong to."""
    n = len(slopes)
    kept = slopes[max(frames, 0) : n + min(frames, 0)]
    return kept, commands[max(-frames, 0) : n + min(-frames, 0)]


@pytest.mark.parametrize("frames", [-5, -3, -2, 0, 2, 3, 5])
@pytest.mark.parametrize("delay", [2, 3])
def test_the_delay_is_found_whatever_the_streams_are_apart(delay, frames):
    slopes, commands = apart(*loop(delay, 1500), frames)
    assert measure_delay(slopes, commands, 2.0) == delay + frames


def test_a_sign_of_slopes_changes_nothing():
    slopes, commands = loop(2, 1500)
    assert measure_delay(-slopes, commands, 2.0) == 2


@pytest.mark.parametrize("seed", range(4))
def test_commands_that_slopes_do_not_lead_to_tell_no_delay(seed):
    rng = np.random.default_rng(seed)
    slopes, _ = loop(2, 1500, seed)
    walk = np.cumsum(rng.normal(size=(1500, N_MODES)), axis=0)
    sines = np.sin(np.arange(1500)[:, None] * [0.3, 0.7, 1.1])
    for commands in (walk, rng.normal(size=walk.shape), np.zeros_like(walk), sines):
        assert measure_delay(slopes, commands, 2.0) is None


def test_too_few_frames_tell_no_delay():
    slopes, commands = loop(2, MIN_FRAMES - 1)
    assert measure_delay(slopes, commands, 2.0) is None
