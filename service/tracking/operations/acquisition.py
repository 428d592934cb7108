"""Acquisition: from an unknown registration to tracking.

Nothing is assumed of the registration. The loop is opened, because a loop closed far from
registration slips; smooth modes lead to α and other modes must confirm it; a reconstructor for as
many modes as the gate accepts everywhere in α ± 3σ closes the loop; then ordinary windows sharpen α
and more modes follow. If a stage does not finish within its time, the acquisition restarts with the
loop opened again, a few times, and then ends in a state that gives the reason.

An acquisition that was interrupted by the end of the service or by a gap in the link leaves the
RTC's loop unchanged, mostly open. The next service, or the same one when the RTC is back, restarts
it if that is permitted and the loop is as it was left; otherwise it reports what it found and
leaves the decision to the operator. It never closes a loop.
"""

from __future__ import annotations

from dataclasses import replace

from service.control.gate import MAX_SLIP_SAFE_LEAK
from service.estimation.windows import RefusalKind
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking import reconstructors, update_policy
from service.tracking.alarms import Interlock
from service.tracking.dither import allow_dither, choose_dither, stop_running_dither
from service.tracking.events import Event
from service.tracking.operation_records import Acquisition, AcquisitionStage, Interruption
from service.tracking.operations import acquisition_stages as stages
from service.tracking.operations.noisy_measurement import fail_noisy_measurement
from service.tracking.operations.running import running_ramp
from service.tracking.policy import SECOND_NS
from service.tracking.products import MatrixState, ReconstructorRecord
from service.tracking.sending import check_sendable
from service.tracking.state import Mode, TrackerState
from service.tracking.step_context import StepContext, present
from service.wire import DitherRequest, LoopRequest, Reply, Status

MIN_FINAL_WINDOWS = 2
"""Ordinary windows that must agree with the last reconstructor in the loop."""

NO_RTC = (
    "no RTC is present; once there is one, the acquisition restarts or reports why not; the loop "
    "may be open"
)

_LASTING_STAGES = (AcquisitionStage.FAILED, AcquisitionStage.INTERRUPTED)
"""Stages that remain until an operator, or windows, end them."""

MAX_STAGE_DURATION_S = 180.0
"""Longest time in one stage: a simulated RTC may be ten times slower than its timestamps."""

_LOST_STATES = (MatrixState.REJECTED, MatrixState.FAILED)


def acquire_on_command(context: StepContext, _: cmd.Acquire) -> None:
    """Begin an acquisition by order."""
    allow_dither(context)
    _begin(context, present(context.rtc), "the operator asks", commanded=True)


def abort_on_command(context: StepContext, _: cmd.AbortAcquisition) -> None:
    """End an acquisition by order."""
    stages.abort_acquisition(context, "by the operator", held_off=True)


def advance(context: StepContext, event: Event) -> None:
    """Take an acquisition further after an event, or begin one where the service needs it."""
    acquisition = context.acquisition
    if acquisition.stage is AcquisitionStage.INTERRUPTED:
        _resume_interrupted(context)
    elif not acquisition.under_way:
        if context.windows.accepted > context.before.windows.accepted:
            # An accepted window ends the sequence of misses.
            stages.set_acquisition(context, replace(acquisition, misses=0))
        _forget_when_over(context, event)
        why = stages.explain_acquisition(context.state, context.policy, context.now_ns)
        if why is not None and context.rtc and running_ramp(context.state, context.now_ns) is None:
            _begin(context, context.rtc, why, commanded=False)
    elif isinstance(event, ev.RtcVanished):
        # the state before still knows in which session that was
        stages.set_acquisition(context, _interrupt(context.before, "the RTC vanished"))
        _note_interrupted(context, NO_RTC)
    else:
        with context.because_of("" if isinstance(event, cmd.Instruction) else acquisition.cause):
            _advance(context, event)


def acquisition_to_save(state: TrackerState) -> Acquisition | None:
    """Return what the next service must know of an acquisition; None: nothing.

    One that was aborted matters while α is not known: it says why, and why the loop may be open. So
    does one that holds back the next.
    """
    acquisition = state.operations.acquisition
    if acquisition.under_way:
        return _interrupt(state, "the service ended")
    aborted = acquisition.stage is AcquisitionStage.ABORTED and state.alpha.registration is None
    lasts = acquisition.stage in _LASTING_STAGES or acquisition.held_off
    return _saved_part(acquisition) if aborted or lasts else None


def restore_acquisition(context: StepContext, left: Acquisition) -> None:
    """Take over the acquisition that the service before this one has left."""
    stages.set_acquisition(context, left)
    if left.stage not in {AcquisitionStage.FAILED, AcquisitionStage.ABORTED}:
        _note_interrupted(context, NO_RTC)


def _begin(context: StepContext, rtc: Status, why: str, *, commanded: bool) -> None:
    stop_running_dither(context)
    # Its telemetry would contain the opening of the loop.
    fail_noisy_measurement(context, "an acquisition has begun")
    lost = _own_loop_lost(context)
    stages.begin_acquisition(context, rtc, why=why, commanded=commanded)
    context.log("acquisition.begun", why)
    if lost is not None:
        # The loop was unstable with this number of modes although its matrix fitted α, so the same
        # number would fail again (``_own_loop_lost``).
        most = update_policy.half_of_modes(rtc.n_controlled)
        first = min(context.acquisition.n_modes, most)
        limited = replace(
            context.acquisition,
            max_modes=most,
            n_modes=first,
            lost_with=context.before.matrices.in_use,
        )
        stages.set_acquisition(context, limited)
        update_policy.limit_modes(context, most, f"{lost} with {rtc.n_controlled} modes")
    stages.wide_capture_stage(context, rtc)


def _own_loop_lost(context: StepContext) -> str | None:
    """Return the alarm of a loop that did not hold on a matrix made for where the mirror is.

    On as many modes it would not hold the next time, unless the mirror turns out to be elsewhere
    (``update_policy.is_beyond_verdict``). The RTC's own matrix says nothing of that.
    """
    used = context.state.used
    if used is None or used.alpha is None:
        return None
    alarm = context.blocking_alarm(Interlock.HOLD)
    return None if alarm is None else alarm.name


def _advance(context: StepContext, event: Event) -> None:
    """Take one that is under way further."""
    n_effects = len(context.effects)
    if not _end_by_event(context, event):
        _take_in(context, event)
    acted = len(context.effects) > n_effects
    if acted or not context.acquisition.under_way or context.rtc is None:
        return
    if context.acquisition.stage in {AcquisitionStage.PARTIAL, AcquisitionStage.WIDENING}:
        _closed_stage(context, context.rtc)
    else:
        stages.wide_capture_stage(context, context.rtc)


def _end_by_event(context: StepContext, event: Event) -> bool:
    """End or restart an acquisition that cannot go on after the event; return True if it did so."""
    acquisition, state = context.acquisition, context.state
    late = context.now_ns - acquisition.since_ns_utc > MAX_STAGE_DURATION_S * SECOND_NS
    match event:
        case cmd.StopDither():
            stages.abort_acquisition(context, "because the dither was stopped")
        case cmd.SetMode(mode=mode) if mode is not Mode.AUTO and not acquisition.commanded:
            stages.abort_acquisition(context, f"because the mode is {mode}")
        # Opening the loop begins a session of its own. In a later stage the loop was changed from
        # outside.
        case ev.SessionStarted() if acquisition.stage is not AcquisitionStage.OPENING:
            stages.restart_acquisition(context, "the RTC began a new session")
        case ev.DitherMeasured(id=loud, text=text) if loud == state.dithers.policy.loud_id and text:
            stages.fail_acquisition(context, text)
        case ev.DitherUnusable(text=text):
            stages.fail_acquisition(context, f"its dither cannot be read: {text}")
        case ev.Tick() if late:
            stages.restart_acquisition(
                context, f"{acquisition.text}: not done in {MAX_STAGE_DURATION_S:.0f} s"
            )
        case _:
            return _end_by_answer(context, event)
    return True


def _end_by_answer(context: StepContext, event: Event) -> bool:
    acquisition = context.acquisition
    match event:
        case ev.Answered(
            request=LoopRequest(id=acquisition.command), reply=Reply(accepted=False, reason=reason)
        ):
            stages.fail_acquisition(context, f"the RTC will not change its loop: {reason}")
        case ev.JobFailed(effect=ev.Ask(request=LoopRequest(id=acquisition.command)), text=text):
            stages.restart_acquisition(context, text)
        case _:
            return False
    return True


def _take_in(context: StepContext, event: Event) -> None:
    match event:
        case ev.WideCaptureFitted():
            stages.on_wide_capture(context, event)
        case ev.WindowLost(refused=refused) if refused.kind is RefusalKind.NOT_FOUND:
            stages.on_missed(context, refused.reason)
        case ev.Answered(request=DitherRequest(), reply=Reply(accepted=False, reason=reason)):
            stages.on_missed(context, f"the RTC refused the dither: {reason}")
        case ev.MatrixMade():
            _on_made(context, event)
        case _:
            pass


def _closed_stage(context: StepContext, rtc: Status) -> None:
    """Make, send, close; then let ordinary windows sharpen α and go on to more modes."""
    acquisition = context.acquisition
    record = context.state.reconstructor(acquisition.matrix)
    if record is not None and record.state in _LOST_STATES:
        stages.restart_acquisition(context, f"{record.id} was not applied: {record.reason}")
    elif acquisition.stage is AcquisitionStage.WIDENING:
        _widen(context, rtc, record)
    elif record is None:
        # After the request for a leak, the gate must judge the loop with it.
        if acquisition.command is None or rtc.leak <= MAX_SLIP_SAFE_LEAK:
            _make(context, acquisition.n_modes, rtc)
    elif rtc.cm_id != record.id:
        return
    elif rtc.loop == "open":
        if acquisition.command is None:
            stages.request_loop(context, cmd.SetLoop(loop="closed"))
    else:
        n_windows = context.windows.accepted
        stages.set_acquisition(context, replace(acquisition, applied=record.id, windows=n_windows))
        text = f"closed on {record.n_modes} modes: sharpening the registration"
        stages.enter_stage(context, AcquisitionStage.WIDENING, text)


def _on_made(context: StepContext, made: ev.MatrixMade) -> None:
    """Send a reconstructor that has passed the gate, with the gains it was judged with."""
    record, acquisition, rtc = made.record, context.acquisition, context.rtc
    if acquisition.stage not in {AcquisitionStage.PARTIAL, AcquisitionStage.WIDENING}:
        return
    if record.state is MatrixState.REFUSED:
        _on_refused(context, record)
        return
    found = acquisition.found
    if rtc is None or found is None:
        stages.restart_acquisition(context, f"{record.id} cannot be sent: no RTC is there")
        return
    gains = stages.gains_for(found, record.n_modes, rtc.n_modes)
    stale = update_policy.verdict_doubtful_reason(
        context.state, record.judged, gains[: record.n_modes]
    )
    if stale is not None:
        reconstructors.change_state(
            context, record.id, MatrixState.DISCARDED, f"while it was made, {stale}"
        )
        context.log("reconstructor.discarded", f"{record.id}: {stale}")
        return
    reason = check_sendable(context.state, record)
    if reason is not None:
        stages.restart_acquisition(context, f"{record.id} cannot be sent: {reason}")
        return
    reconstructors.send_with(context, record.id, gains)
    most = acquisition.max_modes
    if acquisition.stage is AcquisitionStage.WIDENING and record.n_modes < (made.asked_modes or 0):
        most = record.n_modes
    sent = replace(acquisition, matrix=record.id, n_modes=record.n_modes, sent=True, command=None)
    stages.set_acquisition(context, replace(sent, max_modes=most))


def _on_refused(context: StepContext, record: ReconstructorRecord) -> None:
    """With the loop closed be content with the modes there are; else try a leak for the edge."""
    acquisition, gate, rtc = context.acquisition, record.gate, context.rtc
    slippery = gate is not None and gate.edge_motion_m is not None
    if acquisition.stage is AcquisitionStage.WIDENING:
        stages.set_acquisition(context, replace(acquisition, max_modes=acquisition.n_modes))
    # With this leak a slipped segment at the edge recovers within a tenth of a second
    # (docs/results/reliability.md).
    elif slippery and rtc is not None and rtc.leak > MAX_SLIP_SAFE_LEAK:
        text = f"a leak of {MAX_SLIP_SAFE_LEAK} is to keep the outer ring in place"
        context.log("acquisition.leak", text)
        stages.request_loop(context, cmd.SetLoop(leak=MAX_SLIP_SAFE_LEAK))
    else:
        reason = gate.reason if gate is not None else record.reason
        stages.fail_acquisition(context, f"no number of modes passes the gate: {reason}")


def _widen(context: StepContext, rtc: Status, record: ReconstructorRecord | None) -> None:
    acquisition, registration = context.acquisition, context.registration
    slipped = context.blocking_alarm(Interlock.HOLD)
    if slipped is not None:
        stages.restart_acquisition(
            context, f"{slipped.name} with {acquisition.n_modes} modes", slipped=True
        )
        return
    if rtc.loop == "open":
        stages.restart_acquisition(context, "the loop was opened from outside")
        return
    doubted = registration is not None and bool(registration.doubt)
    waiting = doubted or context.matrices.making_since_ns_utc is not None
    if record is not None and rtc.cm_id == record.id and not waiting:
        if record.applied_frame_seq is not None and acquisition.applied != record.id:
            n_windows = context.windows.accepted
            acquisition = replace(acquisition, applied=record.id, windows=n_windows)
            stages.set_acquisition(context, acquisition)
        seen, goal = context.windows.accepted - acquisition.windows, _goal(acquisition)
        if seen >= 1 and (
            record.n_modes < goal or update_policy.has_moved(context.state, record, context.policy)
        ):
            _make(context, goal, rtc, at_least=record.n_modes)
            return
        if seen >= MIN_FINAL_WINDOWS:
            _finish(context, record)
            return
    choose_dither(context, rtc)


def _make(context: StepContext, n_modes: int, rtc: Status, *, at_least: int = 0) -> None:
    """Ask for a reconstructor of so many modes, or fewer but more than ``at_least``."""
    found, state = context.acquisition.found, context.state
    if state.matrices.making_since_ns_utc is not None or found is None:
        return
    if context.now_ns >= state.matrices.no_making_before_ns_utc:
        effect = ev.MakeMatrix(
            n_modes=n_modes,
            why=f"acquisition: {n_modes} modes",
            gains=stages.gains_for(found, n_modes, rtc.n_modes),
            fewer=tuple(
                fewer for fewer in update_policy.fewer_modes_than(n_modes) if fewer > at_least
            ),
        )
        reconstructors.request_matrix(context, effect)


def _goal(acquisition: Acquisition) -> int:
    goal = acquisition.n_modes if acquisition.found is None else acquisition.found.n_controlled
    return goal if acquisition.max_modes is None else min(goal, acquisition.max_modes)


def _finish(context: StepContext, record: ReconstructorRecord) -> None:
    acquisition = context.acquisition
    goal = acquisition.found.n_controlled if acquisition.found is not None else record.n_modes
    took_s = (context.now_ns - acquisition.started_ns_utc) / SECOND_NS
    of_goal = "" if record.n_modes >= goal else f" of {goal}"
    text = f"tracking after {took_s:.0f} s, {record.n_modes}{of_goal} modes controlled"
    stages.enter_stage(context, AcquisitionStage.TRACKING, text)


def _forget_when_over(context: StepContext, event: Event) -> None:
    """Forget an acquisition that holds back the next one, when that is no longer necessary.

    One that failed is forgotten when α is known without it: the operator who closed the loop has
    mended its cause, and a later failure has another. One that an operator ended is forgotten then
    too, or when an operator sets the mode and so decides what the service may do by itself.
    """
    acquisition = context.acquisition
    if acquisition.stage is not AcquisitionStage.FAILED and not acquisition.held_off:
        return
    if acquisition.held_off and isinstance(event, cmd.SetMode):
        text = f"an operator has set the mode, {event.mode}, since the last was ended"
    elif _is_followed(context.state):
        text = f"{MIN_FINAL_WINDOWS} windows agree in the closed loop: none is needed any more"
    else:
        return
    stages.set_acquisition(context, Acquisition(text=text, since_ns_utc=context.now_ns))
    context.log("acquisition.idle", text)


def _is_followed(state: TrackerState) -> bool:
    """Return whether windows that came since agree on α, in a closed loop."""
    rtc, registration = state.loop.rtc, state.alpha.registration
    if rtc is None or not rtc.in_loop or registration is None:
        return False
    since = state.windows.accepted - state.operations.acquisition.windows
    believed = registration.usable and registration.suspected_jump is None
    return believed and min(since, registration.n_windows) >= MIN_FINAL_WINDOWS


def _saved_part(acquisition: Acquisition) -> Acquisition:
    """Return it without what is of telemetry and commands that have been overtaken."""
    return replace(acquisition, alpha=None, covariance=None, command=None, applied=None, windows=0)


def _interrupt(state: TrackerState, cause: str) -> Acquisition:
    session = None if state.loop.rtc is None else state.loop.rtc.session
    doing = f"{state.operations.acquisition.stage}: {state.operations.acquisition.text}"
    interruption = Interruption(doing=doing, session=session, cause=cause)
    return replace(_saved_part(state.operations.acquisition), interruption=interruption)


def _resume_interrupted(context: StepContext) -> None:
    """Restart an interrupted acquisition, or report why not and the operator's options."""
    rtc = context.rtc
    if rtc is None:
        return
    if rtc.loop != "open":
        _note_closed(context, rtc)
        return
    why_not = _check_automatic_resumption(context, rtc)
    if why_not is not None:
        do = (
            "The loop may be open, and its matrix is for a registration that was rejected: "
            "acquire again, or close the loop on a matrix of your own"
        )
        _note_interrupted(context, f"it does not restart by itself: {why_not}", do)
        return
    cause = _cause(context.acquisition)
    stages.set_acquisition(context, replace(context.acquisition, interruption=None))
    stages.restart_acquisition(context, cause)


def _check_automatic_resumption(context: StepContext, rtc: Status) -> str | None:
    state = context.state
    if stages.acquisition_left_open(state, rtc) is None:
        return "the RTC has begun another session since, and who left its loop open is not known"
    if state.operator.mode is not Mode.AUTO:
        return f"the mode is {state.operator.mode}"
    if not context.policy.acquires:
        return "the settings forbid that"
    if state.dithers.stopped:
        return "the dither was stopped"
    return stages.check_acquisition(state, context.policy)


def _note_interrupted(context: StepContext, what: str, do: str = "") -> None:
    """Say what was going on, and what it waits for."""
    text = f"{_cause_text(context.acquisition)}; {what}{'. ' if do else ''}{do}"
    acquisition, stage = context.acquisition, AcquisitionStage.INTERRUPTED
    if (acquisition.stage, acquisition.text) == (stage, text):
        return
    stages.set_acquisition(
        context, replace(acquisition, stage=stage, text=text, since_ns_utc=context.now_ns)
    )
    context.warn("acquisition.interrupted", what)


def _note_closed(context: StepContext, rtc: Status) -> None:
    """End the acquisition after the loop was closed."""
    matrix, judged = rtc.cm_id or "an unknown matrix", "which it has not judged"
    if rtc.cm_id is not None and rtc.cm_id == context.acquisition.matrix:
        judged = "which had passed the gate: the registration is followed from there"
    text = f"{_cause_text(context.acquisition)}; the loop is closed on {matrix}, {judged}"
    stages.enter_stage(context, AcquisitionStage.ABORTED, text)


def _cause_text(acquisition: Acquisition) -> str:
    left = acquisition.interruption
    doing = "unknown" if left is None else left.doing
    return f"{_cause(acquisition)} during an acquisition ({doing})"


def _cause(acquisition: Acquisition) -> str:
    left = acquisition.interruption
    return "it was cut off" if left is None else left.cause
