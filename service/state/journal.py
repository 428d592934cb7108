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


class Party(StrEnum):
    """Whom the service waits for."""

    RTC = "rtc"
    OPERATOR = "operator"
    WORKER = "worker"
    """The service's own, which computes."""

    SERVICE = "service"
    """Another one, of the same system."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Waiting:
    """Something the service waits for."""

    name: str
    """Machine-readable."""

    party: Party
    """Who can end it."""

    text: str
    """What is missing, and what to do."""

    hinders: bool = False
    """Whether the service can do nothing of its work meanwhile."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogEntry:
    """One thing that happened."""

    t_ns_utc: int
    level: Level
    name: str
    """Machine-readable, like ``reconstructor.applied``."""

    text: str

    times: int = 1
    """How often: a line that repeats within a minute is told once, and again with this count."""

    last_ns_utc: int = 0
    """The last time, where it was more than once."""

    @property
    def line(self) -> tuple[int, str, str]:
        """What makes it this line and no other, however often it has happened."""
        return self.t_ns_utc, self.name, self.text
