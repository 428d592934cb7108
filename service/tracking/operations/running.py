"""Name the operations that run now.

Which orders that allows is in :mod:`service.tracking.interlocks`. What the service is in, in the
words of a control room, follows from what runs and which alarms last.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from service.estimation.loop import NO_RTC, explain_open_loop
from service.records.alarms import STANDING_BY, Alarm, Severity
from service.records.operations import CommandState, DitherPurpose, LoopCommand
from service.records.state import Mode, TrackerState
from service.tracking.dither_request import MAX_STOP_DELAY_S, infer_purpose
from service.tracking.policy import SECOND_NS

RAMP_REPLY_TIMEOUT_S = 30.0
"""A gain ramp that the RTC has neither accepted nor refused for so long is none."""


class OperationKind(StrEnum):
    """Operations that may run, or keep others from running."""

    STOPPED = "an operator has stopped everything"
    MEASURING = "an interaction matrix is being measured"
    GATHERING = "a noisy interaction matrix is being measured"
    RAMPING = "a gain ramp is under way"
    ACQUIRING = "an acquisition is under way"
    OWN_DITHER = "a dither of the service's own choice plays"
    OTHER_DITHER = "a dither of an operator or another program plays"
    STANDING_BY = "another service drives the RTC"
    MAKING = "a reconstructor is being computed"
    SENDING = "a reconstructor is on its way to the RTC"


@dataclass(frozen=True, slots=True)
class RunningOperation:
    """Something that runs, in words."""

    kind: OperationKind
    text: str
    """Running operation, and how it ends."""


def running_operations(state: TrackerState, now_ns: int) -> tuple[RunningOperation, ...]:
    """Return all that runs now, what is exclusive first."""
    return (*_exclusive(state, now_ns), *_dither(state, now_ns), *_of_matrices(state))


def running_ramp(state: TrackerState, now_ns: int) -> LoopCommand | None:
    """Return the gain ramp that the RTC is busy with, or None: opening the loop ends one."""
    # No status says that a ramp runs: only the RTC's answer and the clock do.
    asked, rtc = state.loop.command, state.loop.rtc
    if asked is None or not asked.lasts_s or rtc is None or rtc.loop == "open":
        return None
    if asked.state is CommandState.ASKED:
        waits = now_ns - asked.asked_ns_utc < RAMP_REPLY_TIMEOUT_S * SECOND_NS
        return asked if waits else None
    accepted = asked.state is CommandState.ACCEPTED
    return asked if accepted and now_ns < asked.until_ns_utc else None


def _exclusive(state: TrackerState, now_ns: int) -> Iterator[RunningOperation]:
    for alarm in state.alarms.active:
        if alarm.name == STANDING_BY:
            yield RunningOperation(OperationKind.STANDING_BY, alarm.text)
    if state.operator.stopped_because:
        yield RunningOperation(
            OperationKind.STOPPED, f"{state.operator.stopped_because}; release the stop first"
        )
    if state.measuring is not None:
        text = f"interaction matrix {state.measuring.id} is being measured"
        yield RunningOperation(OperationKind.MEASURING, f"{text}; wait for it, or give it up")
    if state.noisy_measurement is not None:
        text = f"noisy matrix {state.noisy_measurement.id} is under way; wait for it, or give it up"
        yield RunningOperation(OperationKind.GATHERING, text)
    ramp = running_ramp(state, now_ns)
    if ramp is not None:
        left_s = max((ramp.until_ns_utc - now_ns) / SECOND_NS, 0.0) or ramp.lasts_s
        text = f"gain ramp {ramp.id} is under way; wait for it, {left_s:.0f} s"
        yield RunningOperation(OperationKind.RAMPING, f"{text}, or open the loop to end it")
    if state.operations.acquisition.under_way:
        doing = state.operations.acquisition.text
        text = f"an acquisition is under way ({doing}); wait for it, or abort it"
        yield RunningOperation(OperationKind.ACQUIRING, text)


def _dither(state: TrackerState, now_ns: int) -> Iterator[RunningOperation]:
    """Yield the dither that plays, unless it was ordered to stop."""
    # A status may be a second old, and still show a dither that was just asked to stop. One of the
    # service's own that nobody follows is about to be stopped: nobody has to wait for it.
    followed = state.dithers.dither
    stopping = now_ns - state.dithers.policy.stop_asked_ns_utc < MAX_STOP_DELAY_S * SECOND_NS
    seen = None if state.loop.rtc is None or stopping else state.loop.rtc.dither_id
    if followed is not None:
        own = followed.purpose.automatic
        kind = OperationKind.OWN_DITHER if own else OperationKind.OTHER_DITHER
        yield RunningOperation(kind, f"{followed.id} is running; stop it first")
    elif seen is not None and infer_purpose(seen, None) is DitherPurpose.FOREIGN:
        yield RunningOperation(OperationKind.OTHER_DITHER, f"{seen} is running; stop it first")


def _of_matrices(state: TrackerState) -> Iterator[RunningOperation]:
    if state.matrices.making_since_ns_utc is not None:
        yield RunningOperation(
            OperationKind.MAKING, "a reconstructor is being computed; wait for it"
        )
    for record in state.matrices.reconstructors:
        if record.on_its_way:
            text = f"reconstructor {record.id} is on its way to the RTC; wait for it"
            yield RunningOperation(OperationKind.SENDING, text)


class ServiceState(StrEnum):
    """State of the service; the first that applies, from the bottom."""

    OPERATIONAL = "Operational"
    """The loop is closed, or the service has the mirror."""

    READY = "Ready"
    """No RTC, an open loop, or everything was stopped."""

    DEGRADED = "Degraded"
    """A serious alarm is active."""

    NOT_READY = "NotReady"
    """Starting, standing by, or waiting for a prerequisite."""

    ERROR = "Error"
    """A critical alarm is active."""


class CurrentOperation(StrEnum):
    """The service's operation; the first that holds, from above."""

    ACQUIRING = "Acquiring"
    """An acquisition runs."""

    MEASURING = "Measuring"
    """A matrix is being measured, or a gain ramp runs."""

    HOLD = "Hold"
    """Mode hold, or everything is stopped."""

    TRACKING = "Tracking"
    """α is followed in closed loop."""

    IDLE = "Idle"
    """α is unknown, or the loop is open."""


OPERATION_OF: dict[OperationKind, CurrentOperation] = {
    OperationKind.ACQUIRING: CurrentOperation.ACQUIRING,
    OperationKind.MEASURING: CurrentOperation.MEASURING,
    OperationKind.GATHERING: CurrentOperation.MEASURING,
    OperationKind.RAMPING: CurrentOperation.MEASURING,
    OperationKind.STOPPED: CurrentOperation.HOLD,
}
"""Current operation while one of these runs; others do not change it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Operating:
    """State and operation of the service, and why."""

    service_state: ServiceState
    current_operation: CurrentOperation
    because: str
    """Reason in one sentence."""

    @property
    def words(self) -> str:
        """Both as one."""
        return f"{self.service_state}, {self.current_operation}"


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
    # The loop in danger comes first, then what keeps the service from its work, then what it does.
    occupation, doing = _current_operation(state, now_ns)
    operation, because = ServiceState.OPERATIONAL, doing
    critical, serious = (_first(state, grade) for grade in (Severity.CRITICAL, Severity.SERIOUS))
    if critical is not None:
        operation, because = ServiceState.ERROR, critical.text
    elif hindered:
        operation, because = ServiceState.NOT_READY, hindered
    elif serious is not None:
        operation, because = ServiceState.DEGRADED, serious.text
    elif state.operator.stopped_because:
        operation = ServiceState.READY
    elif occupation in {CurrentOperation.IDLE, CurrentOperation.HOLD, CurrentOperation.TRACKING}:
        idle = _explain_idleness(state)
        operation, because = (ServiceState.READY, idle) if idle else (operation, because)
    return Operating(service_state=operation, current_operation=occupation, because=because)


def _current_operation(state: TrackerState, now_ns: int) -> tuple[CurrentOperation, str]:
    for running in running_operations(state, now_ns):
        if running.kind in OPERATION_OF:
            return OPERATION_OF[running.kind], running.text
    if state.operator.mode is Mode.HOLD:
        return CurrentOperation.HOLD, "mode is hold: nothing is made or sent unless ordered"
    if _explain_idleness(state):
        return CurrentOperation.IDLE, "there is no closed loop"
    if state.alpha.registration is None:
        return CurrentOperation.IDLE, "α is not known yet: no window has been accepted"
    return CurrentOperation.TRACKING, "α is known and the loop is closed"


def _explain_idleness(state: TrackerState) -> str:
    rtc = state.loop.rtc
    if rtc is None:
        return NO_RTC
    return "" if rtc.in_loop else explain_open_loop(rtc)


def _first(state: TrackerState, severity: Severity) -> Alarm | None:
    return next(
        (alarm for alarm in state.alarms.active if alarm.definition.severity is severity), None
    )
