"""An acquisition cut off by the end of the service or a gap in the link, and what follows.

The RTC's loop stays as the acquisition had it, mostly open, and its matrix is for a registration
that was not believed. The next service, or the same one when the RTC is back, begins anew where it
may and the loop is as it was left; whatever else it finds it says, and leaves to the operator. It
never closes a loop.
"""

from __future__ import annotations

from dataclasses import replace

from service.reactions.acquisition_ends import again, entered
from service.reactions.acquisition_plan import left_open, why_not_now
from service.reactions.journal import logged, with_alarm, without_alarm
from service.reactions.matrices import Step
from service.reactions.policy import Policy
from service.state import (
    Acquisition,
    AcquisitionStage,
    Interruption,
    Level,
    Mode,
    RtcView,
    TrackerState,
)

NO_RTC = "no RTC is there: when one is, it begins anew or says why not; the loop may be open"

_LASTING = (AcquisitionStage.FAILED, AcquisitionStage.INTERRUPTED)
"""Stages that an operator, or windows, must end."""


def left_behind(state: TrackerState) -> Acquisition | None:
    """Return what the next service must know of an acquisition; None: nothing.

    One that was aborted matters while α is not known: it says why, and why the loop may be open. So
    does one that holds back the next.
    """
    acquisition = state.acquisition
    if acquisition.under_way:
        return _cut_off(state, "the service ended")
    aborted = acquisition.stage is AcquisitionStage.ABORTED and state.registration is None
    lasts = acquisition.stage in _LASTING or acquisition.held_off
    return _kept(acquisition) if aborted or lasts else None


def _kept(acquisition: Acquisition) -> Acquisition:
    """Return it without what is of telemetry and commands that have been overtaken."""
    return replace(acquisition, alpha=None, covariance=None, command=None, applied=None, windows=0)


def _cut_off(state: TrackerState, cause: str) -> Acquisition:
    session = None if state.rtc is None else state.rtc.session
    doing = f"{state.acquisition.stage}: {state.acquisition.text}"
    interruption = Interruption(doing=doing, session=session, cause=cause)
    return replace(_kept(state.acquisition), interruption=interruption)


def on_gap(before: TrackerState, state: TrackerState, now_ns: int) -> TrackerState:
    """Return the state in which an acquisition waits for an RTC that has vanished.

    ``before`` still knows in which session that was.
    """
    state = replace(state, acquisition=_cut_off(before, "the RTC vanished"))
    return _waiting(state, NO_RTC, now_ns)


def inherited(state: TrackerState, left: Acquisition, now_ns: int) -> TrackerState:
    """Return the state of a service to which the one before it has left this acquisition."""
    state = replace(state, acquisition=left)
    if left.stage is AcquisitionStage.FAILED:
        return with_alarm(state, "acquisition", left.text, now_ns)
    if left.stage is AcquisitionStage.ABORTED:
        return state
    return _waiting(state, NO_RTC, now_ns)


def taken_up(state: TrackerState, policy: Policy, now_ns: int) -> Step:
    """Begin an acquisition that was cut off anew, or say why not and what the operator can do."""
    rtc = state.rtc
    if rtc is None:
        return state, ()
    if rtc.loop != "open":
        return _closed(state, rtc, now_ns), ()
    why_not = _why_not_by_itself(state, rtc, policy)
    if why_not is not None:
        return _refusing(state, why_not, now_ns), ()
    cause = _cause(state.acquisition)
    state = replace(state, acquisition=replace(state.acquisition, interruption=None))
    state = without_alarm(state, "acquisition", now_ns)
    return again(state, cause, now_ns)


def _why_not_by_itself(state: TrackerState, rtc: RtcView, policy: Policy) -> str | None:
    if left_open(state, rtc) is None:
        return "the RTC has begun another session since, and who left its loop open is not known"
    if state.mode is not Mode.AUTO:
        return f"the mode is {state.mode}"
    if not policy.acquires:
        return "the settings forbid that"
    if state.dither_stopped:
        return "the dither was stopped"
    return why_not_now(state, policy)


def _refusing(state: TrackerState, why: str, now_ns: int) -> TrackerState:
    """Return the state that says why what was cut off does not go on, and what to do."""
    do = (
        "The loop may be open, and its matrix is for a registration that was not believed: acquire "
        "again, or close the loop on a matrix of your own"
    )
    return _waiting(state, f"it does not begin anew by itself: {why}", now_ns, do)


def _waiting(state: TrackerState, what: str, now_ns: int, do: str = "") -> TrackerState:
    """Return the state that says what was going on, and what it waits for."""
    text = f"{_said(state.acquisition)}; {what}{'. ' if do else ''}{do}"
    if any((alarm.name, alarm.text) == ("acquisition", text) for alarm in state.alarms):
        return state
    acquisition = replace(
        state.acquisition, stage=AcquisitionStage.INTERRUPTED, text=text, since_ns_utc=now_ns
    )
    state = replace(state, acquisition=acquisition)
    state = logged(state, "acquisition.interrupted", what, now_ns, Level.WARNING)
    return with_alarm(state, "acquisition", text, now_ns)


def _closed(state: TrackerState, rtc: RtcView, now_ns: int) -> TrackerState:
    """Return the state after somebody, or the acquisition itself, has closed the loop."""
    matrix, told = rtc.cm_id or "an unknown matrix", "which it has not judged"
    if rtc.cm_id is not None and rtc.cm_id == state.acquisition.matrix:
        told = "which had passed the gate: the registration is followed from there"
    text = f"{_said(state.acquisition)}; the loop is closed on {matrix}, {told}"
    state = without_alarm(state, "acquisition", now_ns)
    return entered(state, AcquisitionStage.ABORTED, text, now_ns)


def _said(acquisition: Acquisition) -> str:
    left = acquisition.interruption
    doing = "unknown" if left is None else left.doing
    return f"{_cause(acquisition)} during an acquisition ({doing})"


def _cause(acquisition: Acquisition) -> str:
    left = acquisition.interruption
    return "it was cut off" if left is None else left.cause
