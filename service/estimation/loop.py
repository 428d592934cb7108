"""The loop as a status shows it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.estimation.windows import ClosedLoop
from service.wire import Loop, Status

NO_RTC = "no RTC is there"

SAME_GAIN = 0.05
"""Relative: an RTC may follow the seeing with its gains once a second, and the gate judges with the
largest optical gains there may be, which are a tenth above those measured."""

SAME_DELAY = 0.05
"""Frames."""

SAME_LEAK = 1e-6

SAME_RATE = 1e-5
"""Relative difference of two frame rates that are considered equal: a measured rate varies from one
status to the next."""


def build_loop(rtc: Status, cm_id: str, matrix: NDArray[np.float32]) -> ClosedLoop:
    """Return the loop closed by a status and a matrix ``(n_controlled, n_slopes)``."""
    return ClosedLoop(
        cm_id=cm_id,
        reconstructor=matrix,
        gains=np.array(rtc.gains[: len(matrix)], np.float32),
        leak=rtc.leak,
        delay_frames=rtc.delay_frames,
        frame_rate_hz=rtc.frame_rate_hz,
    )


def same_gains(some: Sequence[float], others: Sequence[float]) -> bool:
    """Return whether these are the gains of one loop."""
    if some == others:  # as nearly always, and a hundred times as quick
        return True
    # No absolute tolerance: a mode that enters or leaves a gain of 0 makes another loop.
    return len(some) == len(others) and np.allclose(some, others, rtol=SAME_GAIN, atol=0.0)


def same_rate(one_hz: float, other_hz: float) -> bool:
    """Return whether these are one frame rate."""
    return abs(one_hz - other_hz) <= SAME_RATE * one_hz


def loop_numbers(rtc: Status | None) -> tuple[float, ...]:
    """Return all of the loop that the bias of its passive estimate depends on; empty: no RTC."""
    return () if rtc is None else _numbers(rtc, rtc.n_controlled, rtc.gains)


def _numbers(rtc: Status, n_modes: int, gains: tuple[float, ...]) -> tuple[float, ...]:
    return (float(n_modes), rtc.leak, rtc.delay_frames, rtc.frame_rate_hz, *gains)


def same_numbers(some: tuple[float, ...], others: tuple[float, ...]) -> bool:
    """Return whether two :func:`loop_numbers` are of one loop: the only definition of it."""
    if len(some) != len(others) or not some:
        return some == others
    modes, leak, delay, rate, *gains = some
    n_modes, other_leak, other_delay, other_rate, *other_gains = others
    return (
        modes == n_modes
        and abs(leak - other_leak) <= SAME_LEAK
        and abs(delay - other_delay) <= SAME_DELAY
        and same_rate(rate, other_rate)
        and same_gains(gains, other_gains)
    )


def same_loop(one: Status, other: Status) -> bool:
    """Return whether telemetry and verdicts of one loop are of the other as well.

    Its gains may follow the seeing; one that enters or leaves 0 makes it another.
    """
    return _same_state(one, other) and same_numbers(loop_numbers(one), loop_numbers(other))


def same_but_for_modes(one: Status, other: Status) -> bool:
    """Return whether two loops differ in nothing but how many modes they control."""
    # The gains of the modes that both control decide; those of added modes have no counterpart.
    n_modes = min(one.n_controlled, other.n_controlled)
    some, others = (_numbers(rtc, n_modes, rtc.gains[:n_modes]) for rtc in (one, other))
    return _same_state(one, other) and same_numbers(some, others)


def _same_state(one: Status, other: Status) -> bool:
    return one.session == other.session and one.loop == other.loop


def explain_open_loop(rtc: Status) -> str:
    """Return the message for a loop that controls no mode."""
    return "the loop is open" if rtc.loop == Loop.OPEN else "all gains of the loop are 0"


def last_seq(rtc: Status) -> int:
    """Return the last frame processed when a status was made; -1: there had been none."""
    return -1 if rtc.seq is None else rtc.seq


def extend_gains(rtc: Status, n_modes: int) -> tuple[float, ...]:
    """Return gains for ``n_modes`` controlled modes: those in force, the last one for new modes."""
    last = rtc.gains[rtc.n_controlled - 1]
    kept = rtc.gains[: min(rtc.n_controlled, n_modes)]
    return (*kept, *(last,) * (n_modes - len(kept)), *(0.0,) * (rtc.n_modes - n_modes))


def select_gains(rtc: Status, n_modes: int) -> tuple[float, ...]:
    """Return the gains of the modes that a reconstructor of ``n_modes`` would command."""
    return extend_gains(rtc, n_modes)[:n_modes]
