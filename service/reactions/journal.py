"""The log and the alarms inside the state: bounded, and never the same line twice in a row."""

from __future__ import annotations

import re
from dataclasses import replace

from service.reactions.policy import SECOND_NS
from service.state import Alarm, Level, LogEntry, TrackerState

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
