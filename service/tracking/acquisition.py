"""From nothing known to tracking: open, look from afar, confirm, close on few modes, widen.

Nothing is assumed of the registration. The loop is opened, for one that is closed far from
registration slips; smooth modes lead to α and other modes must confirm it; a reconstructor for as
many modes as the gate accepts everywhere in α ± 3σ closes the loop; then ordinary windows sharpen
α and more modes follow. What does not come true within its time begins anew with the loop opened
again, a few times, and then ends in a state that says why.

One that was cut off, by the end of the service or a gap in the link, leaves the RTC's loop as it
had it, mostly open. The next service, or the same one when the RTC is back, begins anew where it
may and the loop is as it was left; whatever else it finds it says, and leaves to the operator. It
never closes a loop.
"""

from __future__ import annotations

from dataclasses import replace

from service.control.gate import FORGIVING_LEAK
from service.errors import CommandError
from service.telemetry.openloop import NOT_FOUND
from service.tracking import events as ev
from service.tracking.acquisition_stages import (
    abort,
    again,
    begun,
    entered,
    fail,
    far_stage,
    gains_for,
    left_open,
    on_far,
    on_missed,
    told,
    why_needed,
    why_not_now,
    without_dither,
)
from service.tracking.activity import ramping
from service.tracking.alarms import Act, forbidding, logged, with_alarm, without_alarm
from service.tracking.dither_schedule import choose_dither
from service.tracking.events import Event, SetMode, Step
from service.tracking.loop import RtcView
from service.tracking.measuring import cut_off
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.products import MatrixState, ReconstructorRecord
from service.tracking.reconstructors import send, why_unsendable, why_worthless, with_state
from service.tracking.stages import Acquisition, AcquisitionStage, Interruption
from service.tracking.state import Level, Mode, TrackerState
from service.tracking.worth import fewer_than, half_of, limited, moved

ENOUGH_WINDOWS = 2
"""Ordinary windows that must have held with the last reconstructor."""

_LOST = (MatrixState.REJECTED, MatrixState.FAILED)


def closed_stage(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Make, send, close; then let ordinary windows sharpen α and go on to more modes."""
    acquisition = state.acquisition
    record = state.reconstructor(acquisition.matrix) if acquisition.matrix else None
    if record is not None and record.state in _LOST:
        return again(state, f"{record.id} was not applied: {record.reason}", now_ns)
    if acquisition.stage is AcquisitionStage.WIDENING:
        return _widened(state, rtc, record, policy, now_ns)
    if record is None:
        if acquisition.command is not None and rtc.leak > FORGIVING_LEAK:
            return state, ()
        return _make(state, acquisition.n_modes, rtc, now_ns)
    if rtc.cm_id != record.id:
        return state, ()
    if rtc.loop == "open":
        if acquisition.command is not None:
            return state, ()
        return told(state, ev.SetLoop(closed=True), now_ns)
    acquisition = replace(acquisition, applied=record.id, windows=state.windows_accepted)
    state = replace(state, acquisition=acquisition)
    text = f"closed on {record.n_modes} modes: sharpening the registration"
    return entered(state, AcquisitionStage.WIDENING, text, now_ns), ()


def on_made(state: TrackerState, made: ev.MatrixMade, now_ns: int) -> Step:
    """Send a reconstructor that has passed the gate, with the gains it was judged with."""
    record, acquisition, rtc = made.record, state.acquisition, state.rtc
    if acquisition.stage not in {AcquisitionStage.PARTIAL, AcquisitionStage.WIDENING}:
        return state, ()
    if record.state is MatrixState.REFUSED:
        return _refused(state, record, now_ns)
    found = acquisition.found
    if rtc is None or found is None:
        return again(state, f"{record.id} cannot be sent: no RTC is there", now_ns)
    gains = gains_for(found, record.n_modes, rtc.n_modes)
    stale = why_worthless(state, record.judged, gains[: record.n_modes])
    if stale is not None:
        state = with_state(state, record.id, MatrixState.DISCARDED, f"while it was made, {stale}")
        return logged(state, "reconstructor.discarded", f"{record.id}: {stale}", now_ns), ()
    reason = why_unsendable(state, record)
    if reason is not None:
        return again(state, f"{record.id} cannot be sent: {reason}", now_ns)
    state, _ = send(state, record.id, now_ns)
    acquisition = replace(
        acquisition, matrix=record.id, n_modes=record.n_modes, sent=True, command=None
    )
    if acquisition.stage is AcquisitionStage.WIDENING and record.n_modes < (made.asked_modes or 0):
        acquisition = replace(acquisition, most_modes=record.n_modes)
    effect = ev.SendMatrix(id=record.id, n_modes=record.n_modes, gains=gains)
    return replace(state, acquisition=acquisition), (effect,)


def _refused(state: TrackerState, record: ReconstructorRecord, now_ns: int) -> Step:
    """With the loop closed be content with the modes there are; else try a leak for the edge."""
    acquisition, gate, rtc = state.acquisition, record.gate, state.rtc
    if acquisition.stage is AcquisitionStage.WIDENING:
        acquisition = replace(acquisition, most_modes=acquisition.n_modes)
        return replace(state, acquisition=acquisition), ()
    slippery = gate is not None and gate.edge_motion_m is not None
    if slippery and rtc is not None and rtc.leak > FORGIVING_LEAK:
        text = f"a leak of {FORGIVING_LEAK} is to keep the outer ring in place"
        state = logged(state, "acquisition.leak", text, now_ns)
        return told(state, ev.SetLoop(leak=FORGIVING_LEAK), now_ns)
    reason = gate.reason if gate is not None else record.reason
    return fail(state, f"no number of modes passes the gate: {reason}", now_ns)


def _widened(
    state: TrackerState,
    rtc: RtcView,
    record: ReconstructorRecord | None,
    policy: Policy,
    now_ns: int,
) -> Step:
    acquisition = state.acquisition
    slipped = forbidding(state, Act.HOLD)
    if slipped is not None:
        text = f"{slipped.name} with {acquisition.n_modes} modes"
        return again(state, text, now_ns, slipped=True)
    if rtc.loop == "open":
        return again(state, "somebody opened the loop", now_ns)
    doubted = state.registration is not None and bool(state.registration.doubt)
    waiting = doubted or state.making_since_ns_utc is not None
    if record is None or rtc.cm_id != record.id or waiting:
        return choose_dither(state, rtc, policy, now_ns)
    if record.applied_frame_seq is not None and acquisition.applied != record.id:
        acquisition = replace(acquisition, applied=record.id, windows=state.windows_accepted)
        state = replace(state, acquisition=acquisition)
    seen = state.windows_accepted - acquisition.windows
    goal = _goal(acquisition)
    if seen >= 1 and (record.n_modes < goal or moved(state, record, policy)):
        return _make(state, goal, rtc, now_ns, at_least=record.n_modes)
    if seen >= ENOUGH_WINDOWS:
        return _done(state, record, now_ns), ()
    return choose_dither(state, rtc, policy, now_ns)


def _make(
    state: TrackerState, n_modes: int, rtc: RtcView, now_ns: int, *, at_least: int = 0
) -> Step:
    """Ask for a reconstructor of so many modes, or fewer but more than ``at_least``."""
    found = state.acquisition.found
    if state.making_since_ns_utc is not None or found is None or now_ns < state.retries.make_ns_utc:
        return state, ()
    effect = ev.MakeMatrix(
        n_modes=n_modes,
        why=f"acquisition: {n_modes} modes",
        gains=gains_for(found, n_modes, rtc.n_modes),
        fewer=tuple(rung for rung in fewer_than(n_modes) if rung > at_least),
    )
    return replace(state, making_since_ns_utc=now_ns), (effect,)


def _goal(acquisition: Acquisition) -> int:
    goal = acquisition.n_modes if acquisition.found is None else acquisition.found.n_controlled
    return goal if acquisition.most_modes is None else min(goal, acquisition.most_modes)


def _done(state: TrackerState, record: ReconstructorRecord, now_ns: int) -> TrackerState:
    acquisition = state.acquisition
    goal = acquisition.found.n_controlled if acquisition.found is not None else record.n_modes
    took_s = (now_ns - acquisition.started_ns_utc) / SECOND_NS
    of_goal = "" if record.n_modes >= goal else f" of {goal}"
    text = f"tracking after {took_s:.0f} s, {record.n_modes}{of_goal} modes controlled"
    state = entered(state, AcquisitionStage.TRACKING, text, now_ns)
    return without_alarm(state, "acquisition", now_ns)


def forgotten(state: TrackerState, event: Event, now_ns: int) -> TrackerState:
    """Return the state without an acquisition that holds back the next, once it need not.

    One that had failed: when α is known without it, for whoever closed the loop has mended what it
    could not, and the next trouble is another one. One that an operator ended: then too, or when an
    operator sets the mode, which is to say what the service may do by itself.
    """
    acquisition = state.acquisition
    failed = acquisition.stage is AcquisitionStage.FAILED
    if not failed and not acquisition.held_off:
        return state
    if acquisition.held_off and isinstance(event, SetMode):
        text = f"an operator has set the mode, {event.mode}, since the last was ended"
    elif _followed(state):
        text = f"{ENOUGH_WINDOWS} windows agree in the closed loop: none is needed any more"
    else:
        return state
    idle = Acquisition(text=text, since_ns_utc=now_ns)
    state = without_alarm(replace(state, acquisition=idle), "acquisition", now_ns)
    return logged(state, "acquisition.idle", text, now_ns)


def _followed(state: TrackerState) -> bool:
    """Return whether windows that came since agree on α, in a closed loop."""
    rtc, known = state.rtc, state.registration
    if rtc is None or not rtc.in_loop or known is None:
        return False
    since = state.windows_accepted - state.acquisition.windows
    believed = known.usable and known.candidate is None
    return believed and min(since, known.n_windows) >= ENOUGH_WINDOWS


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


PATIENCE_S = 180.0
"""In one stage: a simulated RTC may be ten times slower than its timestamps."""


def on_acquire(state: TrackerState, event: Event, policy: Policy, now_ns: int) -> Step:
    """Begin or abort an acquisition because an operator says so.

    Raises
    ------
    CommandError
        If there is none to abort, or none can begin now.
    """
    if isinstance(event, ev.AbortAcquisition):
        interrupted = state.acquisition.stage is AcquisitionStage.INTERRUPTED
        if not state.acquisition.under_way and not interrupted:
            raise CommandError("acquisition: none is under way")
        state = without_alarm(state, "acquisition", now_ns)
        return abort(state, "by the operator", now_ns, held_off=True)
    reason = why_not_now(state, policy)
    if state.rtc is None or reason is not None:
        raise CommandError(f"acquisition: {reason}")
    state = replace(state, dither_stopped=False)
    return _begin(state, policy, now_ns, "the operator asks", commanded=True)


def acquire(
    before: TrackerState, state: TrackerState, event: Event, policy: Policy, now_ns: int
) -> Step:
    """Take an acquisition further after an event, or begin one where the service needs it.

    ``before`` is the state before anybody else had seen the event.
    """
    acquisition = state.acquisition
    if acquisition.stage is AcquisitionStage.INTERRUPTED:
        return taken_up(state, policy, now_ns)
    if not acquisition.under_way:
        if state.windows_accepted > before.windows_accepted:
            state = replace(state, acquisition=replace(acquisition, misses=0))
        state = forgotten(state, event, now_ns)
        why = why_needed(state, policy, now_ns)
        if why is None or ramping(state, now_ns) is not None:
            return state, ()
        return _begin(state, policy, now_ns, why, commanded=False)
    if isinstance(event, ev.RtcVanished):
        return on_gap(before, state, now_ns), ()
    state, effects = _ended_by(state, event, now_ns) or _heard(state, event, policy, now_ns)
    if effects or not state.acquisition.under_way or state.rtc is None:
        return state, effects
    if state.acquisition.stage in {AcquisitionStage.PARTIAL, AcquisitionStage.WIDENING}:
        return closed_stage(state, state.rtc, policy, now_ns)
    return far_stage(state, state.rtc, policy, now_ns)


def _begin(state: TrackerState, policy: Policy, now_ns: int, why: str, *, commanded: bool) -> Step:
    rtc = state.rtc
    if rtc is None:
        return state, ()
    state, effects = without_dither(without_alarm(state, "acquisition", now_ns))
    state = cut_off(state, "an acquisition has begun", now_ns)
    lost = _own_loop_lost(state)
    state = begun(state, rtc, policy, now_ns, why=why, commanded=commanded)
    state = logged(state, "acquisition.begun", why, now_ns)
    if lost is not None:
        most = half_of(rtc.n_controlled)
        first = min(state.acquisition.n_modes, most)
        acquisition = replace(state.acquisition, most_modes=most, n_modes=first)
        state = replace(state, acquisition=acquisition)
        state = limited(state, most, f"{lost} with {rtc.n_controlled} modes", now_ns)
    state, more = far_stage(state, rtc, policy, now_ns)
    return state, (*effects, *more)


def _own_loop_lost(state: TrackerState) -> str | None:
    """Return the alarm of a loop that did not hold on a matrix made for where the mirror is.

    On as many modes it would not hold the next time; the RTC's own matrix says nothing of that.
    """
    record = state.reconstructor(state.in_use) if state.in_use is not None else None
    if record is None or record.alpha is None:
        return None
    alarm = forbidding(state, Act.HOLD)
    return None if alarm is None else alarm.name


def _ended_by(state: TrackerState, event: Event, now_ns: int) -> Step | None:
    """Return what an event makes of an acquisition that cannot go on, or None."""
    acquisition = state.acquisition
    match event:
        case ev.StopDither():
            return abort(state, "because the dither was stopped", now_ns)
        case ev.SetMode(mode=mode) if mode is not Mode.AUTO and not acquisition.commanded:
            return abort(state, f"because the mode is {mode}", now_ns)
        case ev.SessionStarted() if acquisition.stage is not AcquisitionStage.OPENING:
            return again(state, "the RTC began a new session", now_ns)
        case ev.DitherMeasured(id=loud, text=text) if loud == state.dithering.loud_id and text:
            return fail(state, text, now_ns)
        case ev.Noted(name="dither.unusable", text=text):
            return fail(state, f"its dither cannot be read: {text}", now_ns)
        case ev.Tick() if _late(acquisition, now_ns):
            return again(state, f"{acquisition.text}: not done in {PATIENCE_S:.0f} s", now_ns)
        case _:
            return _ended_by_answer(state, event, now_ns)


def _ended_by_answer(state: TrackerState, event: Event, now_ns: int) -> Step | None:
    asked = state.acquisition.command
    match event:
        case ev.LoopAnswered(id=command, accepted=False, reason=reason) if command == asked:
            return fail(state, f"the RTC will not change its loop: {reason}", now_ns)
        case ev.JobFailed(effect=ev.AskLoop(id=command), text=text) if command == asked:
            return again(state, text, now_ns)
        case _:
            return None


def _late(acquisition: Acquisition, now_ns: int) -> bool:
    return now_ns - acquisition.since_ns_utc > PATIENCE_S * SECOND_NS


def _heard(state: TrackerState, event: Event, policy: Policy, now_ns: int) -> Step:
    match event:
        case ev.FarFitted():
            return on_far(state, event, policy, now_ns)
        case ev.WindowLost(refused=refused) if refused.reason.startswith(NOT_FOUND):
            return on_missed(state, refused.reason, now_ns)
        case ev.DitherAnswered(accepted=False, reason=reason):
            return on_missed(state, f"the RTC refused the dither: {reason}", now_ns)
        case ev.MatrixMade():
            return on_made(state, event, now_ns)
        case _:
            return state, ()
