"""Alarms and log inside the state, and what each alarm forbids for as long as it lasts."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from enum import Enum, auto

from service.tracking.policy import SECOND_NS
from service.tracking.state import Alarm, Level, LogEntry, TrackerState

LOG_LENGTH = 500

BURST_NS = 60 * SECOND_NS
"""A line that comes again within this is counted, not told."""

REPEATING = frozenset(
    {
        "acknowledgement.unknown",
        "dither.lost",
        "dither.unusable",
        "job.failed",
        "measurement.ignored",
        "message.malformed",
        "reconstructor.not-offered",
        "watchdog.failed",
        "window.outlier",
        "window.refused",
    }
)
"""Lines that say the same though their numbers differ: what becomes of telemetry, and of deeds that
are tried again."""

LOOKED_BACK = 30
"""So many lines back the beginning of a burst is looked for."""

_NUMBERS = re.compile(r"[-+]?[0-9][0-9.e+-]*")


def logged(
    state: TrackerState, name: str, text: str, now_ns: int, level: Level = Level.INFO
) -> TrackerState:
    """Return the state with one more line in its log; one that repeats is counted instead."""
    entry = LogEntry(t_ns_utc=now_ns, level=level, name=name, text=text)
    for back, before in enumerate(reversed(state.log[-LOOKED_BACK:]), start=1):
        # the very last line may be any; what lies between makes a story of two equal ones
        if (back == 1 or name in REPEATING) and _same(before, entry):
            counted = replace(before, times=before.times + 1, last_ns_utc=now_ns)
            log = list(state.log)
            log[-back] = counted
            return replace(state, log=tuple(log))
    return replace(state, log=(*state.log, entry)[-LOG_LENGTH:])


def _same(before: LogEntry, entry: LogEntry) -> bool:
    if before.name != entry.name or entry.t_ns_utc - before.t_ns_utc >= BURST_NS:
        return False
    if entry.name not in REPEATING:
        return before.text == entry.text
    return _NUMBERS.sub("", before.text) == _NUMBERS.sub("", entry.text)


def counted(state: TrackerState, now_ns: int) -> TrackerState:
    """Return the state with a line for each burst that is over, which says how often it was."""
    for entry in state.log:
        if entry.times > 1 and now_ns - entry.t_ns_utc >= BURST_NS:
            lasted_s = (entry.last_ns_utc - entry.t_ns_utc) / SECOND_NS
            told = replace(
                entry,
                t_ns_utc=now_ns,
                text=f"{entry.text} ({entry.times} times in {lasted_s:.0f} s)",
                times=1,
            )
            log = tuple(replace(e, times=1) if e is entry else e for e in state.log)
            state = replace(state, log=(*log, told)[-LOG_LENGTH:])
    return state


def new_lines(before: TrackerState, after: TrackerState) -> list[LogEntry]:
    """Return the lines that were added; one that was only counted is not among them."""
    if after.log is before.log:
        return []
    known = {entry.line for entry in before.log}
    return [entry for entry in after.log if entry.line not in known]


def with_alarm(state: TrackerState, name: str, text: str, now_ns: int) -> TrackerState:
    """Return the state with this alarm raised; one already raised keeps its beginning."""
    before = next((a for a in state.alarms if a.name == name), None)
    raised = before
    if raised is None:
        t_ns = 0 if state.rtc is None else state.rtc.t_ns_utc
        raised = Alarm(name=name, since_ns_utc=now_ns, text=text, t_ns_utc=t_ns)
    alarm = replace(raised, text=text, seen_ns_utc=now_ns)
    others = tuple(a for a in state.alarms if a.name != name)
    state = replace(state, alarms=(*others, alarm))
    return state if before is not None else logged(state, name, text, now_ns, Level.ALARM)


def without_alarm(state: TrackerState, name: str, now_ns: int) -> TrackerState:
    """Return the state without this alarm."""
    if all(a.name != name for a in state.alarms):
        return state
    state = replace(state, alarms=tuple(a for a in state.alarms if a.name != name))
    return logged(state, name, f"{name}: over", now_ns)


OFF_LOOP = "commands-off-loop"
"""The alarm of a saturated mirror, or of an RTC whose account of its loop is wrong."""

WRONG_MATRIX = "matrix-mismatch"
"""The alarm of an RTC whose own matrix is of other slopes or commands than the file tells."""

WRONG_ANSWER = "response-mismatch"
"""The alarm of slopes that answer a dither otherwise than the file tells."""

WRONG_LOOP = "loop-law"
"""The alarm of an RTC whose leak, gains or delay are others than its status says."""

WRONG_UNIT = "command-unit"
"""The alarm of commands that no mirror can play."""

ARCHIVE_FAILED = "archive-failed"
"""The alarm of a disk that refuses: what cannot be recorded is not done."""

OTHER_SUM = "wrong-matrix"
"""The alarm of an RTC that acknowledges, or holds, other numbers than were sent."""

SECOND_SERVICE = "second-service"
"""The alarm of two services for one RTC; it forbids nothing to the one that drives."""

STANDING_BY = "standing-by"
"""The alarm of a service that leaves the RTC to another one."""


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
    "second-rtc": Rule("two RTCs were sending", _STRANGER),
    "basis-mismatch": Rule("the RTC had another basis or configuration", _STRANGER),
    "instrument-mismatch": Rule("the RTC was not of the instrument in the file", _STRANGER),
    "loop-diverging": Rule("the loop was diverging", _OUT_OF_HAND),
    "edge-slip": Rule("the edge had slipped", _OUT_OF_HAND),
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
