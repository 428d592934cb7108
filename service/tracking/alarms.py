"""The alarms by name, and what each forbids for as long as it lasts.

The one table of them is alarms.toml; docs/states.md shows it.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from enum import StrEnum, auto
from importlib.resources import files
from typing import Final

import msgspec

from service.tracking.state import Alarm, Party, TrackerState

STOPPED = "stopped"
ACQUISITION = "acquisition"
VANISHED = "rtc-vanished"
LOOP_OPEN = "loop-open"
SECOND_RTC = "second-rtc"
OTHER_BASIS = "basis-mismatch"
OTHER_INSTRUMENT = "instrument-mismatch"
DIVERGING = "loop-diverging"
EDGE_SLIP = "edge-slip"
MISALIGNED = "columns-misaligned"
STALE = "estimate-stale"
SUSPECTED = "jump-suspected"
DISAGREES = "watchdog"
SHORT_MARGIN = "margin"
NOT_ACKNOWLEDGED = "no-acknowledgement"
NO_DITHER = "dither"
DITHER_LOST = "dither-lost"
NOT_STOPPED = "dither-not-stopped"
OVER_BUDGET = "dither-over-budget"
NOT_AS_ASKED = "dither-not-as-asked"
OFF_LOOP = "commands-off-loop"
WRONG_MATRIX = "matrix-mismatch"
WRONG_ANSWER = "response-mismatch"
WRONG_LOOP = "loop-law"
WRONG_UNIT = "command-unit"
ARCHIVE_FAILED = "archive-failed"
DISK_LOW = "disk-low"
OTHER_SUM = "wrong-matrix"
SECOND_SERVICE = "second-service"
STANDING_BY = "standing-by"
FRAMES_UNUSED = "frames-unused"
MESSAGES_REFUSED = "messages-refused"
STATUS_FLOOD = "status-flood"
WORKER_LOST = "worker-lost"
WORKER_BEHIND = "worker-behind"


class Act(StrEnum):
    """What an alarm may forbid."""

    MEASURE = auto()
    """Take a window, or a look at ordinary telemetry, for a measurement."""

    DECIDE = auto()
    """Make, send or dither without being asked: mode auto does nothing."""

    HOLD = auto()
    """Count on the loop as it is: after some seconds of this the service acquires by itself."""

    SEND_NEW = auto()
    """Send a matrix that was never in use, whoever approves of it; acquisitions need that."""

    SEND_KNOWN = auto()
    """Send one that has been in use before: a rollback."""

    ASK = auto()
    """Ask anything of the RTC, or follow its telemetry: nobody knows whose it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """What there is to know of an alarm, whenever it is raised."""

    means: str
    """What is the matter."""

    do: str
    """What an operator does about it."""

    forbids: frozenset[Act] = frozenset()

    because: str = ""
    """What was the matter while it lasted, for the reason of a refusal; empty: refuses nothing."""

    party: Party | None = None
    """Who can end it, where that is waited for though it may forbid nothing."""


def _read() -> dict[str, Kind]:
    text = files(__package__).joinpath("alarms.toml").read_text(encoding="utf-8")
    return msgspec.convert(tomllib.loads(text), dict[str, Kind])


ALARMS: Final = _read()
"""By name, as alarms.toml tells."""


def forbidding(state: TrackerState, act: Act) -> Alarm | None:
    """Return an alarm that forbids this now, or None."""
    return next((alarm for alarm in state.alarms if forbids(alarm, act)), None)


def forbids(alarm: Alarm, act: Act) -> bool:
    """Return whether this alarm forbids this."""
    kind = ALARMS.get(alarm.name)
    return kind is not None and act in kind.forbids
