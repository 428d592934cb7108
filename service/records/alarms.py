"""Names and definitions of alarms, and operators' notes on them.

The one table of them is alarms.toml; docs/operate/runbook.md shows it. What operators do about them
is as LSST's ts_watcher has it (doc/displaying_alarms.rst there).
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum, auto
from importlib.resources import files
from typing import Final

import msgspec

from service.records.messages import Message

VANISHED = "rtc-vanished"
LOOP_OPEN = "loop-open"
RTC_CLOCK = "rtc-clock"
SECOND_RTC = "second-rtc"
OTHER_BASIS = "basis-mismatch"
RENAMED = "sensor-renamed"
OTHER_INSTRUMENT = "instrument-mismatch"
DIVERGING = "loop-diverging"
LOST = "loop-lost"
EDGE_SLIP = "edge-slip"
MISALIGNED = "columns-misaligned"
STALE = "estimate-stale"
SUSPECTED = "jump-suspected"
DISAGREES = "watchdog"
SHORT_MARGIN = "margin"
PROBATION = "probation"
NOT_ACKNOWLEDGED = "no-acknowledgement"
NO_DITHER = "dither"
DITHER_LOST = "dither-lost"
NOT_STOPPED = "dither-not-stopped"
OVER_BUDGET = "dither-over-budget"
NOT_AS_ASKED = "dither-not-as-asked"
MIRROR_SILENT = "mirror-silent"
OFF_LOOP = "commands-off-loop"
NOT_PLAYED = "commands-not-played"
WRONG_MATRIX = "matrix-mismatch"
WRONG_ANSWER = "response-mismatch"
MODES_UNEVEN = "modes-uneven"
MODES_CONTRARY = "modes-contrary"
WRONG_LOOP = "loop-law"
WRONG_UNIT = "command-unit"
ARCHIVE_FAILED = "archive-failed"
DISK_LOW = "disk-low"
OTHER_SUM = "wrong-matrix"
SECOND_SERVICE = "second-service"
STANDING_BY = "standing-by"
FRAMES_UNUSED = "frames-unused"
FRAMES_LOST = "frames-lost"
NO_FRAMES = "no-frames"
TELEMETRY_OLD = "telemetry-old"
CLOCK_LEAPT = "clock-leapt"
NOT_RESTORED = "alpha-not-restored"
LINK_FLOODED = "link-flooded"
REST_CROWDED = "rest-crowded"
LINK_REFUSED = "link-refused"
CERTIFICATE_ENDING = "certificate-ending"
WINDOWS_REFUSED = "windows-refused"
MESSAGES_REFUSED = "messages-refused"
STATUS_FLOOD = "status-flood"
WORKER_LOST = "worker-lost"
WORKER_BEHIND = "worker-behind"
CLUSTER_LOST = "cluster-lost"
LOOP_OPENED = "loop-opened"
SLOPES_STAND = "slopes-stand"
NOT_FOUND = "registration-not-found"
UNDECLARED = "undeclared-transition"
MISAPPLIED = "matrix-misapplied"
REFERENCES_MISAPPLIED = "references-misapplied"


RULE_PREFIX = "rule."
"""Prefix of the alarms of operators' own rules: no other alarm has a dot in its name."""


class Interlock(StrEnum):
    """Things that an alarm may forbid."""

    MEASURE = auto()
    """Use windows or ordinary telemetry as measurements."""

    DECIDE = auto()
    """Make, send or dither without an order: mode auto does nothing."""

    HOLD = auto()
    """Keep the loop as it is: after some seconds the service acquires by itself."""

    SEND_NEW = auto()
    """Send a matrix that was never in use, as approvals and acquisitions do."""

    SEND_KNOWN = auto()
    """Send one that was in use before, as a rollback does."""

    ASK = auto()
    """Send requests to the RTC, or use its telemetry."""


class Severity(StrEnum):
    """Severity of an alarm, lowest first."""

    WARNING = auto()
    """The service does its work."""

    SERIOUS = auto()
    """The service does less than it should."""

    CRITICAL = auto()
    """The loop is in danger, or its telemetry cannot be used."""

    @property
    def rank(self) -> int:
        """Place in the order, 0 for the lowest."""
        return list(Severity).index(self)

    def above(self, other: Severity | None) -> bool:
        """Return whether it matters more than another; None: than nothing."""
        return other is None or self.rank > other.rank


class Responsible(StrEnum):
    """Party that can end a wait."""

    RTC = "rtc"
    OPERATOR = "operator"
    WORKER = "worker"
    """The service's own, which computes."""

    SERVICE = "service"
    """Another one, of the same system."""

    NETWORK = "network"
    """Administrator of routers, addresses, names and ports."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Prerequisite:
    """Something the service waits for."""

    name: str
    """Machine-readable."""

    responsible: Responsible
    """Party that can end the wait."""

    text: str
    """Missing prerequisite, and the remedy."""

    blocks: bool = False
    """True if the service can do none of its work meanwhile."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmDefinition:
    """Definition of an alarm: severity, meaning, remedy, interlocks."""

    severity: Severity
    means: str
    """Meaning of the alarm."""

    do: str
    """Action for the operator."""

    blocks: frozenset[Interlock] = frozenset()

    because: str = ""
    """Cause in the past tense, for the reason of a refusal; empty if it refuses nothing."""

    responsible: Responsible | None = None
    """Party that can end the wait, if the service waits for it although it may forbid nothing."""

    origin: str = "settings"
    """File of the service that finds it; ``settings``: a rule of the operators' own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """Something that must be seen, for as long as it lasts."""

    name: str
    since_ns_utc: int
    message: Message
    """Finding, and the remedy."""

    seen_ns_utc: int = 0
    """Time of the last detection."""

    t_ns_utc: int = 0
    """Time at which it was raised, by the RTC's clock; earlier telemetry does not end it. 0 if
    unknown."""

    own: AlarmDefinition | None = None
    """Definition that replaces the one of the table; None to use the table's."""

    @property
    def text(self) -> str:
        """Sentence of the message."""
        return str(self.message)

    @property
    def definition(self) -> AlarmDefinition:
        """Its definition; an unknown name has an empty one."""
        listed = self.own or ALARMS.get(self.name)
        return listed or AlarmDefinition(severity=Severity.WARNING, means="", do="")


class AlarmState(StrEnum):
    """State of an alarm with operators."""

    ACTIVE = "active"
    """Active and not acknowledged."""

    ACKNOWLEDGED = "acknowledged"
    """Active and acknowledged; it disappears when it ends."""

    STALE = "stale"
    """Ended unseen; it stays until acknowledged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorNote:
    """An operator's note on an alarm."""

    by: str
    reason: str
    t_ns_utc: int
    until_ns_utc: int | None = None
    """End of a mute; None if it has none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmRecord:
    """History of an alarm: times, worst severity, acknowledgement, mute."""

    name: str
    worst: Severity | None = None
    """The most severe it has been since somebody last was done with it; None: it was not raised."""

    since_ns_utc: int = 0
    text: str = ""
    """Text when it was raised; for a stale alarm, at its end."""

    over_ns_utc: int | None = None
    """Time of its end; None if it is active or was not raised."""

    acknowledged: OperatorNote | None = None
    muted: OperatorNote | None = None

    @property
    def alarm_state(self) -> AlarmState | None:
        """Its state with operators; None: it was never raised."""
        if self.worst is None:
            return None
        if self.acknowledged is not None:
            return AlarmState.ACKNOWLEDGED
        return AlarmState.ACTIVE if self.over_ns_utc is None else AlarmState.STALE


def _read() -> dict[str, AlarmDefinition]:
    text = files(__package__).joinpath("alarms.toml").read_text(encoding="utf-8")
    return msgspec.convert(tomllib.loads(text), dict[str, AlarmDefinition])


ALARMS: Final = _read()
"""Definitions by name, from alarms.toml."""


def as_critical(name: str) -> AlarmDefinition:
    """Return the definition of an alarm that is worse now than the table says."""
    return replace(ALARMS[name], severity=Severity.CRITICAL)


def blocking_alarm(alarms: Iterable[Alarm], interlock: Interlock) -> Alarm | None:
    """Return an alarm that forbids this now, or None."""
    return next((alarm for alarm in alarms if alarm_blocks(alarm, interlock)), None)


def alarm_blocks(alarm: Alarm, interlock: Interlock) -> bool:
    """Return whether this alarm forbids this."""
    return interlock in alarm.definition.blocks
