"""The filter that tells a loop's own noise from turbulence."""

from __future__ import annotations

import numpy as np
import pytest

from service.errors import ModelError
from service.estimation.passive import N_TAPS, high_pass


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
