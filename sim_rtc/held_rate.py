"""The highest frame rate that this machine holds, from the products that a frame takes."""

from __future__ import annotations

import time

import numpy as np
from threadpoolctl import threadpool_limits

from sim_rtc.computer.feed import message_frames

RATES_HZ = (1000.0, 800.0, 500.0, 400.0, 250.0, 200.0, 100.0, 50.0, 20.0, 10.0)
"""Frame rates that are tried, below the requested one, hertz."""

DITHERED_FROM_HZ = 200.0
"""Below it the lines of a dither do not fit under the loop's own bandwidth."""

SHARE = 0.4
"""Fraction of a core that the products of a frame may use. The turbulence uses as much again, and
the service needs the rest of a machine of two cores."""

MEASURED_S = 0.5


def frame_s(n_slopes: int, n_modes: int, n_controlled: int, rate_hz: float) -> float:
    """Return how long the products of one frame of a linear plant take one core, seconds.

    Processor time of one thread, the fastest of many messages: what else this machine does for a
    moment does not count. Slopes of a message's frames together, as many as at this rate, the
    modes they show, and the mirror's part in these two frames at a time, as the loop has it.
    """
    n_frames = message_frames(rate_hz)
    rng = np.random.default_rng(1)
    response = rng.standard_normal((n_slopes, n_modes), dtype=np.float32)
    reconstructor = rng.standard_normal((n_slopes, n_controlled), dtype=np.float32)
    modal = rng.standard_normal((n_modes, n_controlled), dtype=np.float32)
    commands = rng.standard_normal((n_frames, n_modes), dtype=np.float32)
    fastest_s, until_s = float("inf"), time.perf_counter() + MEASURED_S
    with threadpool_limits(1):
        while fastest_s == float("inf") or time.perf_counter() < until_s:
            begun_s = time.thread_time()
            slopes = commands @ response.T
            slopes @ reconstructor
            for first in range(0, n_frames, 2):
                commands[first : first + 2] @ modal
            fastest_s = min(fastest_s, time.thread_time() - begun_s)
    return fastest_s / n_frames


def held_rate_hz(asked_hz: float, one_frame_s: float) -> float:
    """Return the highest rate, at most ``asked_hz``, at which frames leave enough of the clock."""
    slower = (rate_hz for rate_hz in RATES_HZ if rate_hz < asked_hz)
    held = (rate_hz for rate_hz in (asked_hz, *slower) if rate_hz * one_frame_s <= SHARE)
    return next(held, RATES_HZ[-1])


def slow_motion(asked_hz: float, one_frame_s: float) -> float:
    """Return the speed, of 1 that is real time, at which frames leave enough of the clock."""
    return min(max(SHARE / one_frame_s, RATES_HZ[-1]) / asked_hz, 1.0)
