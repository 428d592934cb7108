"""How strongly slope noise moves the outer ring of the mirror in closed loop."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from service.control.gate import (
    MAX_EDGE_MOTION_M,
    MAX_HELD_EDGE_MOTION_M,
    MAX_SLIP_SAFE_LEAK,
    check_edge_motion,
    compute_edge_motion_m,
)
from service.control.loop import ControlLoop

N = 6


def outer(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(4, N))


def reconstructor(seed: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(N, 20)).astype(np.float32) * 1e-7


SETTLED = 200
"""Frames before anything is measured."""


@cache
def noise() -> np.ndarray:
    """White noise of the slopes as the reconstructor hands it on: 1000 frames of 250 loops."""
    matrix = reconstructor()
    slopes = np.random.default_rng(3).normal(size=(SETTLED + 1000, 250, matrix.shape[1]))
    return slopes @ matrix.T


def simulated(coupling, gain, ring, leak, delay) -> float:
    """The same loop played on it."""
    command = np.zeros((len(noise()) + delay, *noise().shape[1:]))
    for k, added in enumerate(noise()):
        reply = added + command[k] @ coupling.T
        command[k + delay] = leak * command[k + delay - 1] - gain * reply
    return float((command[SETTLED:] @ ring.T).std(axis=(0, 1)).max())


def loop_of(n, leak, delay):
    return ControlLoop(gains=np.ones(n), leak=leak, delay_frames=float(delay), frame_rate_hz=1000.0)


@pytest.mark.parametrize(("leak", "delay"), [(0.999, 2), (0.95, 1), (1.0, 3)])
def test_the_motion_is_that_of_a_loop_played_in_time(leak, delay):
    """1.5 %: the scatter of a variance over 250 000 correlated frames, and 256 frequencies."""
    matrix, ring, gain = reconstructor(), outer(), 0.3
    coupling = np.eye(N) + 0.15 * np.random.default_rng(5).normal(size=(N, N))
    found = compute_edge_motion_m(
        matrix, coupling.astype(np.float32), np.full(N, gain), ring, loop_of(N, leak, delay)
    )
    played = simulated(coupling, gain, ring, leak, delay)
    assert found == pytest.approx(played, rel=0.015)


def test_one_aligned_mode_without_delay_to_speak_of_has_the_textbook_variance():
    """One frame of delay, no leak: variance of the command is g / (2 - g) times that of R n."""
    matrix = np.full((1, 1), 1e-7, np.float32)
    one = np.eye(1, dtype=np.float32)
    found = compute_edge_motion_m(matrix, one, np.array([0.5]), np.ones((1, 1)), loop_of(1, 1.0, 1))
    assert found == pytest.approx(1e-7 * np.sqrt(0.5 / 1.5), rel=1e-4)


def test_a_slippery_loop_is_named_with_what_to_do_and_a_leak_forgives_it():
    assert check_edge_motion(0.99 * MAX_EDGE_MOTION_M, 1.0) is None
    assert check_edge_motion(2.0 * MAX_EDGE_MOTION_M, MAX_SLIP_SAFE_LEAK) is None
    assert check_edge_motion(2.0 * MAX_EDGE_MOTION_M, 0.999) is not None


def test_a_loop_that_holds_may_move_its_edge_a_little_more_and_no_further():
    between_m = (MAX_EDGE_MOTION_M + MAX_HELD_EDGE_MOTION_M) / 2
    assert check_edge_motion(between_m, 0.999) is not None
    assert check_edge_motion(between_m, 0.999, holds=True) is None
    reason = check_edge_motion(1.001 * MAX_HELD_EDGE_MOTION_M, 0.999, holds=True)
    assert reason is not None
    assert f"{MAX_HELD_EDGE_MOTION_M * 1e9:.0f} nm" in reason


def test_what_is_borne_of_a_loop_that_holds_lies_below_every_slip_that_was_seen():
    """201 nm is the least motion with which a loop without leak has slipped (edge_slip.md)."""
    assert MAX_EDGE_MOTION_M < MAX_HELD_EDGE_MOTION_M < 201e-9
