"""The log and the alarms inside the state: bounded, and never the same line twice in a row."""

from __future__ import annotations

from dataclasses import replace

from service.state import Alarm, Level, LogEntry, TrackerState

LOG_LENGTH = 500


def logged(
    state: TrackerState, name: str, text: str, now_ns: int, level: Level = Level.INFO
) -> TrackerState:
    """Return the state with one more line in its log; a repeated line only renews its time."""
    entry = LogEntry(t_ns_utc=now_ns, level=level, name=name, text=text)
    before = state.log
    if before and (before[-1].name, before[-1].text) == (name, text):
        before = before[:-1]
    return replace(state, log=(*before, entry)[-LOG_LENGTH:])


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
