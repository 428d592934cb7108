"""The RTC as its own status shows it: its loop, its dither, where its telescope looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Pointing:
    """A direction of the telescope."""

    elevation_deg: float
    """Above the horizon, degrees."""

    azimuth_deg: float
    """From north over east, degrees; only differences count."""

    def separation_deg(self, other: Pointing) -> float:
        """Return the angle on the sky between two directions, degrees."""
        return float(np.rad2deg(np.arccos(np.clip(self._unit() @ other._unit(), -1.0, 1.0))))

    def _unit(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        elevation, azimuth = np.deg2rad([self.elevation_deg, self.azimuth_deg])
        return np.array(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ]
        )


SAME_GAIN = 0.05
"""Relative: an RTC may follow the seeing with its gains once a second, and the gate judges with the
largest optical gains there may be, which are a tenth above those measured."""

SAME_DELAY = 0.05
"""Frames."""

SAME_LEAK = 1e-6

SAME_RATE = 1e-5
"""Relative: a rate that is measured, and not nominal, is told differently every time."""


def same_gains(some: Sequence[float], others: Sequence[float]) -> bool:
    """Return whether these are the gains of one loop."""
    if some == others:  # as nearly always, and a hundred times as quick
        return True
    return len(some) == len(others) and np.allclose(some, others, rtol=SAME_GAIN, atol=0.0)


def same_rate(one_hz: float, other_hz: float) -> bool:
    """Return whether these are one frame rate."""
    return abs(one_hz - other_hz) <= SAME_RATE * one_hz


def same_numbers(some: tuple[float, ...], others: tuple[float, ...]) -> bool:
    """Return whether two ``RtcView.loop_numbers`` are of one loop: the only definition of it."""
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


class DitherKind(StrEnum):
    """Shape of a dither in time."""

    SINE = "sine"
    """One line for each mode."""

    BINARY = "binary"
    """Plus or minus the amplitude in every frame, at random."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherView:
    """A dither, asked for or running."""

    id: str
    modes: tuple[int, ...]
    amplitude_m: tuple[float, ...]
    """RMS of each mode, metres OPD."""

    frequency_hz: tuple[float, ...]
    """One for each mode of a sine; a binary dither has none."""

    duration_s: float
    start_seq: int | None
    """First frame that contains it; None until the RTC has accepted."""

    asked_ns_utc: int
    """When it was asked for, then when it was accepted or adopted; 0: none of these."""

    kind: DitherKind = DitherKind.SINE
    seed: int | None = None
    """Of a binary dither's signs; None: a sine has none."""

    window_s: float | None = None
    """Of telemetry in one estimate, where it was planned with the dither."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RtcView:
    """The RTC as its last status message shows it."""

    session: str
    loop: str
    """"open", "closed" or "partial"."""

    frame_rate_hz: float
    delay_frames: float
    leak: float
    gains: tuple[float, ...]
    """One per mode of the basis; 0 where uncontrolled."""

    n_controlled: int
    n_modes: int
    n_slopes: int
    cm_id: str | None
    basis_id: str
    config_id: str
    magnitude: float | None
    max_dither_m: float
    max_dither_modes: int
    dither_id: str | None
    """The dither now running; None: none."""

    t_ns_utc: int
    """The RTC's own timestamp of this status."""

    seq: int = -1
    """Last frame processed when it was made; -1: not known."""

    flux: bytes | None = field(default=None, repr=False, compare=False)
    """``<f4`` ``[4, n_subapertures, n_subapertures]`` mean counts of the pupil images; None: not
    told."""

    dither: DitherView | None = None
    """What is running, where it has been announced to the frame; else None."""

    pointing: Pointing | None = None
    """Of the telescope; None: the RTC does not know."""

    @property
    def in_loop(self) -> tuple[int, ...]:
        """Modes the loop moves, the controlled ones with a gain; none: it is open.

        Some gains of 0 ("partial") make it a loop of the other modes, no less closed.
        """
        if self.loop == "open":
            return ()
        return tuple(i for i, gain in enumerate(self.gains[: self.n_controlled]) if gain)

    @property
    def why_open(self) -> str:
        """What to tell of a loop with no mode in it."""
        return "the loop is open" if self.loop == "open" else "all gains of the loop are 0"

    def same_loop(self, other: RtcView) -> bool:
        """Return whether telemetry and verdicts of the other are of this loop as well.

        Its gains may follow the seeing; one that enters or leaves 0 makes it another.
        """
        return (
            self.session == other.session
            and self.loop == other.loop
            and same_numbers(self.loop_numbers, other.loop_numbers)
        )

    @property
    def loop_numbers(self) -> tuple[float, ...]:
        """Return all of the loop that the bias of its passive estimate depends on."""
        return (
            float(self.n_controlled),
            self.leak,
            self.delay_frames,
            self.frame_rate_hz,
            *self.gains,
        )


class CommandState(StrEnum):
    """What has become of a command to the RTC."""

    ASKED = "asked"
    """The RTC has not answered yet."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    """The RTC would not; the reason is the RTC's."""

    FAILED = "failed"
    """No answer: whether it was carried out is unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopCommand:
    """A change of the loop, or a gain ramp, asked of the RTC."""

    id: str
    text: str
    """What was asked for."""

    state: CommandState
    asked_ns_utc: int
    lasts_s: float = 0.0
    """How long the RTC is busy with it, at its nominal rate; 0: it changes at once."""

    until_ns_utc: int = 0
    """Until when it is, once it has accepted; 0: not known."""

    reason: str = ""
    """Why it was refused, or has failed."""
