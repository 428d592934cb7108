"""The RTC's loop: which gains more modes would have, what has been asked of it, where it points."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service.errors import CommandError
from service.wire import Pointing, Status

NO_RTC = "no RTC is there"


def present(rtc: Status | None) -> Status:
    """Return the RTC, for what is done only where one is there.

    Raises
    ------
    CommandError
        If none is.
    """
    if rtc is None:
        raise CommandError(NO_RTC)
    return rtc


def extended_gains(rtc: Status, n_modes: int) -> tuple[float, ...]:
    """Return gains for ``n_modes`` controlled modes: those in force, the last one for new modes."""
    last = rtc.gains[rtc.n_controlled - 1]
    kept = rtc.gains[: min(rtc.n_controlled, n_modes)]
    return (*kept, *(last,) * (n_modes - len(kept)), *(0.0,) * (rtc.n_modes - n_modes))


def commanded_gains(rtc: Status, n_modes: int) -> tuple[float, ...]:
    """Return the gains of the modes that a reconstructor of ``n_modes`` would command."""
    return extended_gains(rtc, n_modes)[:n_modes]


def separation_deg(one: Pointing, other: Pointing) -> float:
    """Return the angle on the sky between two directions, degrees."""
    return float(np.rad2deg(np.arccos(np.clip(_unit(one) @ _unit(other), -1.0, 1.0))))


def _unit(pointing: Pointing) -> NDArray[np.float64]:
    elevation, azimuth = np.deg2rad([pointing.elevation_deg, pointing.azimuth_deg])
    across = np.cos(elevation)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])


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

    cause: str = field(default="", compare=False)
    """Id of the order or event that has asked for it."""
