"""What the service is in, in the words of a control room: from what runs and which alarms last."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from service.tracking.activity import Activity, under_way
from service.tracking.alarms import Alarm, Severity
from service.tracking.loop import why_open
from service.tracking.state import Mode, TrackerState


class Operation(StrEnum):
    """Whether the service does its work; the first that holds, from below."""

    OPERATIONAL = "Operational"
    """It works for an RTC whose loop is closed, or has its mirror; what it does says the rest."""

    READY = "Ready"
    """It can work, and there is nothing to do: no RTC is there, or its loop is open."""

    DEGRADED = "Degraded"
    """An alarm that is serious lasts: it does less than it should."""

    NOT_READY = "NotReady"
    """It can do nothing of its work: it starts, stands by, or waits for what everything needs."""

    ERROR = "Error"
    """An alarm that is critical lasts: the loop, or what is heard of it, cannot be relied on."""


class Occupation(StrEnum):
    """What it does; the first that holds, from above."""

    ACQUIRING = "Acquiring"
    """α is looked for from nothing, with the loop open."""

    MEASURING = "Measuring"
    """An interaction matrix is being measured, or gains are tried in a ramp."""

    HOLD = "Hold"
    """An operator has set mode hold, or stopped everything: nothing is made or sent by itself."""

    TRACKING = "Tracking"
    """α is known, and followed in a closed loop."""

    IDLE = "Idle"
    """None of these: α is not known, or there is no closed loop to follow it in."""


OCCUPIES: dict[Activity, Occupation] = {
    Activity.ACQUIRING: Occupation.ACQUIRING,
    Activity.MEASURING: Occupation.MEASURING,
    Activity.GATHERING: Occupation.MEASURING,
    Activity.RAMPING: Occupation.MEASURING,
    Activity.STOPPED: Occupation.HOLD,
}
"""What it does while one of these runs; the others change nothing of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Operating:
    """What the service is in and does, and why."""

    operation: Operation
    occupation: Occupation
    because: str
    """In a sentence."""

    @property
    def words(self) -> str:
        """Both as one."""
        return f"{self.operation}, {self.occupation}"


def operating(state: TrackerState, hindered: str, now_ns: int) -> Operating:
    """Return what the service is in.

    Parameters
    ----------
    state
        What is known.
    hindered
        What keeps it from all of its work; empty: nothing.
    now_ns
        The service's clock, nanoseconds.
    """
    occupation, doing = _occupation(state, now_ns)
    operation, because = Operation.OPERATIONAL, doing
    critical, serious = (_first(state, grade) for grade in (Severity.CRITICAL, Severity.SERIOUS))
    if critical is not None:
        operation, because = Operation.ERROR, critical.text
    elif hindered:
        operation, because = Operation.NOT_READY, hindered
    elif serious is not None:
        operation, because = Operation.DEGRADED, serious.text
    elif occupation in {Occupation.IDLE, Occupation.HOLD, Occupation.TRACKING}:
        idle = _why_nothing_to_do(state)
        operation, because = (Operation.READY, idle) if idle else (operation, because)
    return Operating(operation=operation, occupation=occupation, because=because)


def _occupation(state: TrackerState, now_ns: int) -> tuple[Occupation, str]:
    for running in under_way(state, now_ns):
        if running.activity in OCCUPIES:
            return OCCUPIES[running.activity], running.text
    if state.mode is Mode.HOLD:
        return Occupation.HOLD, "mode is hold: nothing is made or sent unless asked for"
    if _why_nothing_to_do(state):
        return Occupation.IDLE, "there is no closed loop"
    if state.registration is None:
        return Occupation.IDLE, "α is not known yet: no window has been accepted"
    return Occupation.TRACKING, "α is known and the loop is closed"


def _why_nothing_to_do(state: TrackerState) -> str:
    rtc = state.rtc
    if rtc is None:
        return "no RTC is there"
    return "" if rtc.in_loop else why_open(rtc)


def _first(state: TrackerState, severity: Severity) -> Alarm | None:
    return next((alarm for alarm in state.alarms if alarm.kind.severity is severity), None)
