"""When telemetry was taken, and what it can therefore tell of.

A window is fitted seconds after it was taken, by a busy worker later still. What casts a doubt, or
says that nothing the loop does is a measurement, has a time by the RTC's clock; what was taken
before that time ends neither, whenever it is worked out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from service.reactions.alarms import RULES, Act, forbids
from service.reactions.journal import without_alarm
from service.reactions.policy import SECOND_NS
from service.state import Pointing, TrackerState

CLOCK_SET_BACK_S = 60.0
"""Telemetry is never so much older than what is known: the RTC's clock has gone back."""

_ROUNDING_NS = 1_000_000
"""A window that follows another begins where that one ends, but for the rounding of a frame."""

_POINTINGS_KEPT = 120
_TURNED_DEG = 0.05
"""By how much the telescope turns before another line of its way is kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Taken:
    """A stretch of telemetry, by the RTC's clock."""

    began_ns_utc: int
    ended_ns_utc: int


def taken(began_ns_utc: int, ended_ns_utc: int) -> Taken:
    """Return the stretch that ended then; 0: nobody says when it began, it is taken for short."""
    return Taken(began_ns_utc=began_ns_utc or ended_ns_utc, ended_ns_utc=ended_ns_utc)


def precedes(state: TrackerState, when: Taken, since_ns_utc: int) -> bool:
    """Return whether telemetry began before a time, and so cannot tell of what is since then."""
    if state.rtc is not None and since_ns_utc - state.rtc.t_ns_utc > CLOCK_SET_BACK_S * SECOND_NS:
        return False
    return when.began_ns_utc < since_ns_utc - _ROUNDING_NS


def why_void(state: TrackerState, when: Taken) -> str | None:
    """Return why telemetry taken then measures nothing, whatever is the matter now; None: it may.

    What is the matter now is asked of the alarms.
    """
    if not precedes(state, when, state.void_before_ns_utc):
        return None
    return f"{state.void_because} when it was taken: its telemetry is no measurement"


def voided(state: TrackerState, because: str, t_ns_utc: int = 0) -> TrackerState:
    """Return the state in which nothing taken until now is a measurement any more.

    ``t_ns_utc`` is the RTC's clock now, where it is known better than by its status.
    """
    before_ns = max(t_ns_utc, 0 if state.rtc is None else state.rtc.t_ns_utc)
    return replace(state, void_before_ns_utc=before_ns, void_because=because)


def over(state: TrackerState, name: str, now_ns: int, t_ns_utc: int = 0) -> TrackerState:
    """Return the state without an alarm; telemetry that it was of stays what it was."""
    alarm = next((alarm for alarm in state.alarms if alarm.name == name), None)
    state = without_alarm(state, name, now_ns)
    if alarm is None or not forbids(alarm, Act.MEASURE):
        return state
    return voided(state, RULES[name].because, t_ns_utc)


def tells_of(state: TrackerState, name: str, when: Taken) -> bool:
    """Return whether telemetry was taken since this alarm was raised, or there is no such alarm."""
    alarm = next((alarm for alarm in state.alarms if alarm.name == name), None)
    return alarm is None or not precedes(state, when, alarm.t_ns_utc)


def pointed(state: TrackerState, pointing: Pointing | None) -> TrackerState:
    """Return the state of a telescope that looks there, and remembers its way."""
    if pointing is None:
        return state
    way, t_ns = state.pointings, 0 if state.rtc is None else state.rtc.t_ns_utc
    if not way or way[-1][1].separation_deg(pointing) >= _TURNED_DEG:
        way = (*way, (t_ns, pointing))[-_POINTINGS_KEPT:]
    return replace(state, pointing=pointing, pointings=way)


def pointing_at(state: TrackerState, t_ns_utc: int) -> Pointing | None:
    """Return where the telescope looked at a time of the RTC's clock, as far as it is known."""
    later = [place for place in state.pointings if place[0] > t_ns_utc]
    if not later:
        return state.pointing
    earlier = state.pointings[: len(state.pointings) - len(later)]
    return earlier[-1][1] if earlier else later[0][1]
