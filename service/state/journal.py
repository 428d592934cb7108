"""What happened, and what is wrong for as long as it lasts."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """How loudly an event speaks."""

    INFO = "info"
    WARNING = "warning"
    ALARM = "alarm"


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """Something that must be seen, for as long as it lasts."""

    name: str
    since_ns_utc: int
    text: str
    """What was found, and what to do."""

    seen_ns_utc: int = 0
    """When it was last found to be so."""

    t_ns_utc: int = 0
    """When it was raised, by the RTC's clock: telemetry from before does not tell that it is over.
    0: not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogEntry:
    """One thing that happened."""

    t_ns_utc: int
    level: Level
    name: str
    """Machine-readable, like ``reconstructor.applied``."""

    text: str
