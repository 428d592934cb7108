"""The alarms by name, and what each forbids for as long as it lasts: the one table of it.

An alarm that is not in it is for the operator to see; it forbids nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from service.tracking.state import Alarm, TrackerState

ACQUISITION = "acquisition"
"""An acquisition has failed, or was cut off."""

VANISHED = "rtc-vanished"
"""The RTC's token is gone."""

LOOP_OPEN = "loop-open"
"""No mode is in the loop, and nobody here has opened it."""

SECOND_RTC = "second-rtc"
OTHER_BASIS = "basis-mismatch"
OTHER_INSTRUMENT = "instrument-mismatch"
DIVERGING = "loop-diverging"
EDGE_SLIP = "edge-slip"
MISALIGNED = "columns-misaligned"

STALE = "estimate-stale"
"""A closed loop runs on an α that is not worth much, or no window is accepted."""

SUSPECTED = "jump-suspected"
"""A window far out waits for the one that decides about it."""

DISAGREES = "watchdog"
"""Ordinary telemetry contradicts α."""

SHORT_MARGIN = "margin"
"""The gate would not let the matrix in use through now."""

NOT_ACKNOWLEDGED = "no-acknowledgement"
"""A reconstructor was sent, and nobody says that it is in use."""

NO_DITHER = "dither"
"""The dither that is wanted was refused, or cannot be read."""

DITHER_LOST = "dither-lost"
"""A dither was accepted, and does not reach the mirror."""

NOT_STOPPED = "dither-not-stopped"
"""A dither goes on that was asked to stop."""

OVER_BUDGET = "dither-over-budget"
"""From when the RTC plays a dither stronger than it may until it plays one as it may."""

NOT_AS_ASKED = "dither-not-as-asked"
"""The frames hold another dither than the one that was asked for."""

OFF_LOOP = "commands-off-loop"
"""A saturated mirror, or an RTC whose account of its loop is wrong."""

WRONG_MATRIX = "matrix-mismatch"
"""An RTC whose own matrix is of other slopes or commands than the file tells."""

WRONG_ANSWER = "response-mismatch"
"""Slopes that answer a dither otherwise than the file tells."""

WRONG_LOOP = "loop-law"
"""An RTC whose leak, gains or delay are others than its status says."""

WRONG_UNIT = "command-unit"
"""Commands that no mirror can play."""

ARCHIVE_FAILED = "archive-failed"
"""A disk that refuses: what cannot be recorded is not done."""

OTHER_SUM = "wrong-matrix"
"""An RTC that acknowledges, or holds, other numbers than were sent."""

SECOND_SERVICE = "second-service"
"""Two services for one RTC; it forbids nothing to the one that drives."""

STANDING_BY = "standing-by"
"""A service that leaves the RTC to another one."""

FRAMES_UNUSED = "frames-unused"
"""Frames that come and are not used."""

MESSAGES_REFUSED = "messages-refused"
"""Other messages of the RTC that break the contract."""

STATUS_FLOOD = "status-flood"
"""Statuses more often than the contract allows."""

WORKER_LOST = "worker-lost"
"""A worker that died or hangs, until another has done a job."""

WORKER_BEHIND = "worker-behind"
"""A worker that does not keep up."""


class Act(Enum):
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


@dataclass(frozen=True, slots=True)
class Rule:
    """What one alarm forbids."""

    because: str
    """What was the matter while it lasted, for the reason of a refusal."""

    acts: frozenset[Act]


_STRANGER = frozenset({Act.MEASURE, Act.DECIDE, Act.SEND_NEW, Act.SEND_KNOWN, Act.ASK})
_MISTOLD = frozenset({Act.MEASURE, Act.SEND_NEW, Act.SEND_KNOWN})
_OUT_OF_HAND = frozenset({Act.MEASURE, Act.DECIDE, Act.HOLD})

RULES: dict[str, Rule] = {
    SECOND_RTC: Rule("two RTCs were sending", _STRANGER),
    OTHER_BASIS: Rule("the RTC had another basis or configuration", _STRANGER),
    OTHER_INSTRUMENT: Rule("the RTC was not of the instrument in the file", _STRANGER),
    DIVERGING: Rule("the loop was diverging", _OUT_OF_HAND),
    EDGE_SLIP: Rule("the edge had slipped", _OUT_OF_HAND),
    WRONG_MATRIX: Rule("the RTC's matrix was of other slopes or commands", _MISTOLD),
    WRONG_LOOP: Rule("the loop was not what the RTC tells of it", _MISTOLD | {Act.DECIDE}),
    WRONG_UNIT: Rule("the commands were in another unit", _MISTOLD | {Act.DECIDE}),
    # windows go on: one that is as it should be ends it
    WRONG_ANSWER: Rule("slopes answered otherwise than told", _MISTOLD - {Act.MEASURE}),
    ARCHIVE_FAILED: Rule("the disk refused to be written", frozenset({Act.DECIDE})),
    OTHER_SUM: Rule(
        "the RTC held another matrix than was sent",
        frozenset({Act.DECIDE, Act.SEND_NEW, Act.SEND_KNOWN}),
    ),
    STANDING_BY: Rule("another service was driving the RTC", _STRANGER),
    OFF_LOOP: Rule("the commands were off the loop equation", frozenset({Act.MEASURE, Act.DECIDE})),
}
"""By the name of the alarm."""


def forbidding(state: TrackerState, act: Act) -> Alarm | None:
    """Return an alarm that forbids this now, or None."""
    return next((alarm for alarm in state.alarms if forbids(alarm, act)), None)


def forbids(alarm: Alarm, act: Act) -> bool:
    """Return whether this alarm forbids this."""
    rule = RULES.get(alarm.name)
    return rule is not None and act in rule.acts
