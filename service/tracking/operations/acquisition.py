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

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, wraps
from typing import Concatenate, ParamSpec

import numpy as np
from numpy.typing import NDArray

from service.control.dither import (
    COARSE_BAND,
    FINE_BAND,
    FIRST_LOOP_MODES,
    MIN_LINES,
    Band,
    spread_lines,
    spread_modes,
)
from service.control.gate import MAX_SLIP_SAFE_LEAK
from service.estimation.loop import NO_RTC
from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import LOST, Interlock, alarm_blocks, blocking_alarm
from service.records.estimates import RefusalKind
from service.records.operations import (
    Acquisition,
    AcquisitionStage,
    Dither,
    DitherPurpose,
    Interruption,
    LoopFound,
    ProbationState,
)
from service.records.products import MatrixState, ReconstructorRecord
from service.records.registration import Registration
from service.records.state import Level, Mode, TrackerState
from service.tracking import reconstructors, update_policy, validity
from service.tracking.dither import (
    allow_dither,
    choose_dither,
    request_dither,
    request_stop,
    stop_running_dither,
    stop_unwanted,
)
from service.tracking.dither_request import name_dither
from service.tracking.operations.measurement import fail_noisy_measurement
from service.tracking.operations.running import running_ramp
from service.tracking.operator import set_loop
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.step_context import StepContext, present
from service.tracking.transitions import move
from service.wire import DitherKind, DitherRequest, LoopRequest, Reply, Status

ReactionP = ParamSpec("ReactionP")

MIN_FINAL_WINDOWS = 2
"""Ordinary windows that must agree with the last reconstructor in the loop."""

NO_RTC_LEFT = (
    "no RTC is present; once there is one, the acquisition restarts or reports why not; the loop "
    "may be open"
)

CUT_OFF = Interruption(doing="unknown", session=None, cause="it was cut off")
"""Interruption of which nothing is known."""

MAX_STAGE_DURATION_S = 180.0
"""Longest time in one stage: a simulated RTC may be ten times slower than its timestamps."""

_LOST_STATES = (MatrixState.REJECTED, MatrixState.FAILED)


FAR_WINDOW_S = 2.0
"""Telemetry in one estimate with the loop open, seconds."""

FAR_DITHER_DURATION_S = 6.0
"""Duration of a dither, seconds: two windows and the time until they are fitted; short, so that it
ends soon after a crashed service."""

CLOSING_GAIN = 0.3
"""Gain of every mode if the loop was open at the start: its status does not contain the gains."""

MAX_DIVERGENCE_S = 2.0
"""Duration of an alarm of a diverging loop after which the service opens the loop itself. A lost
loop is opened at once, unless the service is rolling back to the previous matrix, which takes less
than this."""

MISSES_BEFORE_ACQUISITION = 3
"""Consecutive windows without a registration after which the service acquires by itself."""

MISSES_WHILE_TRACKING = 10
"""Consecutive windows without a registration, while α is known, after which the service acquires:
bad telemetry alone opens no loop."""

MAX_ATTEMPTS = 3
"""Largest number of times that one acquisition opens the loop."""

HELD_OFF_TEXT = (
    "; none starts by itself until windows agree in a closed loop, the mode is set again, or an "
    "operator orders one"
)
"""End of the text of an acquisition that an operator ended."""

_MEASURED_STAGES = (
    AcquisitionStage.PARTIAL,
    AcquisitionStage.WIDENING,
    AcquisitionStage.INTERRUPTED,
)
"""Stages in which α, if it is known, was measured by this acquisition."""

MAX_ESTIMATE_DIFFERENCE = 23.5
"""χ² of the difference of two estimates (4 degrees of freedom) that one in 10^4 exceeds."""

MAX_STAGE_MISSES = 4
"""Failed windows of a stage after which the loop is opened again."""

STOP_STATUS_DELAY_S = 2.0
"""Longest time until the status shows the end of a dither that was stopped."""


def acquire_on_command(context: StepContext, _: cmd.Acquire) -> None:
    """Begin an acquisition by order."""
    allow_dither(context)
    _begin(context, present(context.rtc), "the operator asks", commanded=True)


def abort_on_command(context: StepContext, _: cmd.AbortAcquisition) -> None:
    """End an acquisition by order."""
    abort_acquisition(context, "by the operator", held_off=True)


def on_mode_set(context: StepContext, command: cmd.SetMode) -> None:
    """End an acquisition without an order, unless the mode is auto; end a hold-off."""
    acquisition = context.acquisition
    if acquisition.held_off:
        text = f"an operator has set the mode, {command.mode}, since the last was ended"
        _forget(context, text)
    elif acquisition.under_way and not acquisition.commanded and command.mode is not Mode.AUTO:
        abort_acquisition(context, f"because the mode is {command.mode}")


def on_dither_stop(context: StepContext, _: cmd.StopDither) -> None:
    """End an acquisition whose dither an operator stops."""
    if context.acquisition.under_way:
        abort_acquisition(context, "because the dither was stopped")


def _during_acquisition(
    react: Callable[Concatenate[StepContext, ReactionP], None],
) -> Callable[Concatenate[StepContext, ReactionP], None]:
    """Have a reaction take place only during an acquisition, which is then its cause."""

    @wraps(react)
    def guarded(context: StepContext, /, *args: ReactionP.args, **kwargs: ReactionP.kwargs) -> None:
        if context.acquisition.under_way:
            with context.because_of(context.acquisition.cause):
                react(context, *args, **kwargs)

    return guarded


@_during_acquisition
def on_new_session(context: StepContext, _: ev.SessionStarted) -> None:
    """Restart an acquisition whose loop was changed from outside."""
    # Opening the loop begins a session of its own.
    if context.acquisition.stage is not AcquisitionStage.OPENING:
        _restart_acquisition(context, "the RTC began a new session")


@_during_acquisition
def on_vanished(context: StepContext, _: ev.RtcVanished) -> None:
    """Interrupt an acquisition whose RTC has gone."""
    # the state before still knows in which session that was
    context.acquisition = _interrupt(context.before, "the RTC vanished")
    _note_interrupted(context, NO_RTC_LEFT)


@_during_acquisition
def on_too_strong(context: StepContext, event: ev.DitherMeasured) -> None:
    """End an acquisition whose dither was too strong."""
    if event.text and event.id == context.dither_policy.loud_id:
        _fail_acquisition(context, event.text)


@_during_acquisition
def on_dither_unusable(context: StepContext, event: ev.DitherUnusable) -> None:
    """End an acquisition whose dither cannot be read."""
    _fail_acquisition(context, f"its dither cannot be read: {event.text}")


@_during_acquisition
def on_loop_answer(context: StepContext, request: LoopRequest, reply: Reply) -> None:
    """End an acquisition for which the RTC does not change its loop."""
    if request.id == context.acquisition.command and not reply.accepted:
        _fail_acquisition(context, f"the RTC will not change its loop: {reply.reason}")


@_during_acquisition
def on_loop_failed(context: StepContext, request: LoopRequest, text: str) -> None:
    """Restart an acquisition whose request to change the loop had no answer."""
    if request.id == context.acquisition.command:
        _restart_acquisition(context, text)


@_during_acquisition
def on_dither_answer(context: StepContext, _: DitherRequest, reply: Reply) -> None:
    """Count a dither that the RTC has refused as a window without a result."""
    if not reply.accepted:
        _note_miss(context, f"the RTC refused the dither: {reply.reason}")


@_during_acquisition
def on_lost(context: StepContext, event: ev.WindowLost) -> None:
    """Count a window of an open loop that no registration explains."""
    if event.refused.kind is RefusalKind.NOT_FOUND:
        _note_miss(context, str(event.refused.reason))


def advance(context: StepContext) -> None:
    """Take an acquisition further, or begin one where the service needs it."""
    acquisition = context.acquisition
    if acquisition.stage is AcquisitionStage.INTERRUPTED:
        _resume_interrupted(context)
    elif acquisition.under_way:
        with context.because_of(acquisition.cause):
            _advance_stage(context)
    else:
        if context.windows.accepted > context.before.windows.accepted:
            # An accepted window ends the sequence of misses.
            context.acquisition = replace(acquisition, misses=0)
        _forget_when_over(context)
        why = explain_acquisition(context.state, context.policy, context.now_ns)
        if why is not None and context.rtc and running_ramp(context.state, context.now_ns) is None:
            _begin(context, context.rtc, why, commanded=False)


def acquisition_to_save(state: TrackerState) -> Acquisition | None:
    """Return what the next service must know of an acquisition; None: nothing.

    One that was aborted matters while α is not known: it says why, and why the loop may be open. So
    does one that holds back the next.
    """
    acquisition = state.operations.acquisition
    if acquisition.under_way:
        return _interrupt(state, "the service ended")
    aborted = acquisition.stage is AcquisitionStage.ABORTED and state.alpha.registration is None
    # Stages that remain until an operator, or windows, end them.
    lasts = acquisition.stage in {AcquisitionStage.FAILED, AcquisitionStage.INTERRUPTED}
    return _saved_part(acquisition) if aborted or lasts or acquisition.held_off else None


def restore_acquisition(context: StepContext, left: Acquisition) -> None:
    """Take over the acquisition that the service before this one has left."""
    context.acquisition = left
    if left.stage not in {AcquisitionStage.FAILED, AcquisitionStage.ABORTED}:
        _note_interrupted(context, NO_RTC_LEFT)


def _begin(context: StepContext, rtc: Status, why: str, *, commanded: bool) -> None:
    """Begin one: nothing is known of α any more."""
    stop_running_dither(context)
    # Its telemetry would contain the opening of the loop.
    fail_noisy_measurement(context, "an acquisition has begun")
    lost, left = _own_loop_lost(context), acquisition_left_open(context.state, rtc)
    found = left.found if left is not None else None
    found = found or _loop_found(context.state, rtc, context.policy)
    # The loop was unstable with this number of modes although its matrix fitted α, so the same
    # number would fail again (``_own_loop_lost``).
    most = None if lost is None else update_policy.half_of_modes(rtc.n_controlled)
    first = min(found.n_controlled, FIRST_LOOP_MODES)
    begun = Acquisition(
        stage=AcquisitionStage.OPENING,
        text=f"opening the loop: {why}",
        started_ns_utc=context.now_ns,
        since_ns_utc=context.now_ns,
        commanded=commanded,
        attempt=1,
        found=found,
        n_modes=first if most is None else min(first, most),
        max_modes=most,
        lost_with=None if lost is None else context.before.matrices.in_use,
        sent=left is not None and left.sent,
        cause=context.cause,
    )
    context.acquisition = move(context, context.acquisition, begun)
    # A window that began before the loop is opened would mix two loops.
    validity.invalidate_telemetry(context, "the acquisition had not begun")
    validity.forget_registration(context)
    reconstructors.forget_verdict(context)
    context.log("acquisition.begun", why)
    if most is not None:
        update_policy.limit_modes(context, most, f"{lost} with {rtc.n_controlled} modes")
    _wide_capture_stage(context, rtc)


def _own_loop_lost(context: StepContext) -> str | None:
    """Return the alarm of a loop that did not hold on a matrix made for where the mirror is.

    On as many modes it would not hold the next time, unless the mirror turns out to be elsewhere
    (``is_beyond_verdict``). The RTC's own matrix says nothing of that.
    """
    used = context.state.used
    if used is None or used.alpha is None:
        return None
    alarm = context.blocking_alarm(Interlock.HOLD)
    return None if alarm is None else alarm.name


def _advance_stage(context: StepContext) -> None:
    """Take an acquisition under way one step further, unless it awaits an answer."""
    acquisition, rtc = context.acquisition, context.rtc
    # The RTC or the worker first answers what the acquisition has asked for in this step.
    if any(effect.cause == acquisition.cause for effect in context.effects):
        return
    if context.now_ns - acquisition.since_ns_utc > MAX_STAGE_DURATION_S * SECOND_NS:
        reason = f"{acquisition.text}: not done in {MAX_STAGE_DURATION_S:.0f} s"
        _restart_acquisition(context, reason)
    elif rtc is None:
        return
    elif acquisition.stage in {AcquisitionStage.PARTIAL, AcquisitionStage.WIDENING}:
        _closed_stage(context, rtc)
    else:
        _wide_capture_stage(context, rtc)


def _closed_stage(context: StepContext, rtc: Status) -> None:
    """Make, send, close; then let ordinary windows sharpen α and go on to more modes."""
    acquisition = context.acquisition
    record = context.state.reconstructor(acquisition.matrix)
    if record is not None and record.state in _LOST_STATES:
        _restart_acquisition(context, f"{record.id} was not applied: {record.reason}")
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
            _request_loop(context, cmd.SetLoop(loop="closed"))
    else:
        n_windows = context.windows.accepted
        context.acquisition = replace(acquisition, applied=record.id, windows=n_windows)
        text = f"closed on {record.n_modes} modes: sharpening the registration"
        _enter_stage(context, AcquisitionStage.WIDENING, text)


@_during_acquisition
def on_made(context: StepContext, made: ev.MatrixMade) -> None:
    """Send a reconstructor that has passed the gate, with the gains it was judged with."""
    record, acquisition, rtc = made.record, context.acquisition, context.rtc
    if acquisition.stage not in {AcquisitionStage.PARTIAL, AcquisitionStage.WIDENING}:
        return
    if record.state is MatrixState.REFUSED:
        _on_refused(context, record)
        return
    found = acquisition.found
    if rtc is None or found is None:
        _restart_acquisition(context, f"{record.id} cannot be sent: no RTC is there")
        return
    gains = _gains_for(found, record.n_modes, rtc.n_modes)
    stale = update_policy.verdict_doubtful_reason(
        context.state, record.judged, gains[: record.n_modes]
    )
    if stale is not None:
        reconstructors.change_state(
            context, record.id, MatrixState.DISCARDED, f"while it was made, {stale}"
        )
        context.log("reconstructor.discarded", f"{record.id}: {stale}")
        return
    reason = reconstructors.check_sendable(context.state, record)
    if reason is not None:
        _restart_acquisition(context, f"{record.id} cannot be sent: {reason}")
        return
    reconstructors.send(context, record.id, gains=gains)
    most = acquisition.max_modes
    if acquisition.stage is AcquisitionStage.WIDENING and record.n_modes < (made.asked_modes or 0):
        most = record.n_modes
    sent = replace(acquisition, matrix=record.id, n_modes=record.n_modes, sent=True, command=None)
    context.acquisition = replace(sent, max_modes=most)


def _on_refused(context: StepContext, record: ReconstructorRecord) -> None:
    """With the loop closed be content with the modes there are; else try a leak for the edge."""
    acquisition, gate, rtc = context.acquisition, record.gate, context.rtc
    slippery = gate is not None and gate.edge_motion_m is not None
    if acquisition.stage is AcquisitionStage.WIDENING:
        context.acquisition = replace(acquisition, max_modes=acquisition.n_modes)
    # With this leak a slipped segment at the edge recovers within a tenth of a second
    # (docs/results/reliability.md).
    elif slippery and rtc is not None and rtc.leak > MAX_SLIP_SAFE_LEAK:
        text = f"a leak of {MAX_SLIP_SAFE_LEAK} is to keep the outer ring in place"
        context.log("acquisition.leak", text)
        _request_loop(context, cmd.SetLoop(leak=MAX_SLIP_SAFE_LEAK))
    else:
        reason = gate.reason if gate is not None else record.reason
        _fail_acquisition(context, f"no number of modes passes the gate: {reason}")


def _widen(context: StepContext, rtc: Status, record: ReconstructorRecord | None) -> None:
    acquisition, registration = context.acquisition, context.registration
    slipped = context.blocking_alarm(Interlock.HOLD)
    if slipped is not None:
        _restart_acquisition(
            context, f"{slipped.name} with {acquisition.n_modes} modes", slipped=True
        )
        return
    if rtc.loop == "open":
        _restart_acquisition(context, "the loop was opened from outside")
        return
    doubted = registration is not None and bool(registration.doubt)
    waiting = doubted or context.matrices.making_since_ns_utc is not None
    if record is not None and rtc.cm_id == record.id and not waiting:
        if record.applied_frame_seq is not None and acquisition.applied != record.id:
            n_windows = context.windows.accepted
            acquisition = replace(acquisition, applied=record.id, windows=n_windows)
            context.acquisition = acquisition
        seen = context.windows.accepted - acquisition.windows
        goal = min(acquisition.n_modes_before, acquisition.max_modes or rtc.n_modes)
        if seen >= 1 and (
            record.n_modes < goal or update_policy.has_moved(context.state, record, context.policy)
        ):
            _make(context, goal, rtc, at_least=record.n_modes)
            return
        if seen >= MIN_FINAL_WINDOWS:
            _finish(context, record)
            return
    stop_unwanted(context)
    choose_dither(context)


def _make(context: StepContext, n_modes: int, rtc: Status, *, at_least: int = 0) -> None:
    """Ask for a reconstructor of so many modes, or fewer but more than ``at_least``."""
    found, state = context.acquisition.found, context.state
    if state.matrices.making_since_ns_utc is not None or found is None:
        return
    if context.now_ns >= state.matrices.no_making_before_ns_utc:
        effect = ev.MakeMatrix(
            n_modes=n_modes,
            why=f"acquisition: {n_modes} modes",
            gains=_gains_for(found, n_modes, rtc.n_modes),
            fewer=tuple(
                fewer for fewer in update_policy.fewer_modes_than(n_modes) if fewer > at_least
            ),
        )
        reconstructors.request_matrix(context, effect)


def _finish(context: StepContext, record: ReconstructorRecord) -> None:
    acquisition = context.acquisition
    goal = acquisition.n_modes_before
    took_s = (context.now_ns - acquisition.started_ns_utc) / SECOND_NS
    of_goal = "" if record.n_modes >= goal else f" of {goal}"
    text = f"tracking after {took_s:.0f} s, {record.n_modes}{of_goal} modes controlled"
    _enter_stage(context, AcquisitionStage.TRACKING, text)


def _forget_when_over(context: StepContext) -> None:
    """Forget an acquisition that holds back the next one, when α is known without it.

    The operator who closed the loop has mended the cause of one that failed, and a later failure
    has another. One that an operator ended is forgotten also when the mode is set, which decides
    what the service may do by itself (:func:`on_mode_set`).
    """
    acquisition = context.acquisition
    holds_back = acquisition.stage is AcquisitionStage.FAILED or acquisition.held_off
    if holds_back and _is_followed(context.state):
        text = f"{MIN_FINAL_WINDOWS} windows agree in the closed loop: none is needed any more"
        _forget(context, text)


def _forget(context: StepContext, text: str) -> None:
    idle = Acquisition(text=text, since_ns_utc=context.now_ns)
    context.acquisition = move(context, context.acquisition, idle)
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
    cause = (context.acquisition.interruption or CUT_OFF).cause
    context.acquisition = replace(context.acquisition, interruption=None)
    _restart_acquisition(context, cause)


def _check_automatic_resumption(context: StepContext, rtc: Status) -> str | None:
    state = context.state
    if acquisition_left_open(state, rtc) is None:
        return "the RTC has begun another session since, and who left its loop open is not known"
    if state.operator.mode is not Mode.AUTO:
        return f"the mode is {state.operator.mode}"
    if not context.policy.acquires:
        return "the settings forbid that"
    if state.dithers.stopped:
        return "the dither was stopped"
    return check_acquisition(state, context.policy)


def _note_interrupted(context: StepContext, what: str, do: str = "") -> None:
    """Say what was going on, and what it waits for."""
    text = f"{_cause_text(context.acquisition)}; {what}{'. ' if do else ''}{do}"
    acquisition, stage = context.acquisition, AcquisitionStage.INTERRUPTED
    if (acquisition.stage, acquisition.text) == (stage, text):
        return
    interrupted = replace(acquisition, stage=stage, text=text, since_ns_utc=context.now_ns)
    context.acquisition = move(context, acquisition, interrupted)
    context.warn("acquisition.interrupted", what)


def _note_closed(context: StepContext, rtc: Status) -> None:
    """End the acquisition after the loop was closed."""
    matrix, judged = rtc.cm_id or "an unknown matrix", "which it has not judged"
    if rtc.cm_id is not None and rtc.cm_id == context.acquisition.matrix:
        judged = "which had passed the gate: the registration is followed from there"
    text = f"{_cause_text(context.acquisition)}; the loop is closed on {matrix}, {judged}"
    _enter_stage(context, AcquisitionStage.ABORTED, text)


def _cause_text(acquisition: Acquisition) -> str:
    left = acquisition.interruption or CUT_OFF
    return f"{left.cause} during an acquisition ({left.doing})"


def band_of(stage: AcquisitionStage) -> Band:
    """Return the band of modes that is dithered in a stage with the loop open."""
    return COARSE_BAND if stage is AcquisitionStage.COARSE else FINE_BAND


def wide_capture_dither(
    stage: AcquisitionStage, rtc: Status, policy: Policy, now_ns: int
) -> Dither | str:
    """Return the dither of a stage with the loop open, or why there is none.

    It is strong: an open loop leaves the pyramid little response, and nothing is observed
    meanwhile that could be spoilt.
    """
    modes, lines = _wide_capture_modes(stage, rtc)
    reason = _check_mode_number(modes, rtc)
    if reason is not None:
        return reason
    request = DitherRequest(
        id=name_dither(DitherPurpose.ACQUIRE, now_ns),
        kind=DitherKind.SINE,
        modes=modes,
        amplitude_m=(min(policy.acquisition_amplitude_m, rtc.max_dither_m),) * len(modes),
        frequency_hz=lines[: len(modes)],
        duration_s=FAR_DITHER_DURATION_S,
    )
    return Dither(
        request=request,
        purpose=DitherPurpose.ACQUIRE,
        asked_ns_utc=now_ns,
        window_s=FAR_WINDOW_S,
    )


def _wide_capture_modes(
    stage: AcquisitionStage, rtc: Status
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return the modes dithered in a stage with the loop open, and lines for them, Hz."""
    # With the loop open a dithered line is a measured column of D, so any mode of the basis can be
    # used.
    lines = _lines(rtc.frame_rate_hz, rtc.max_dither_modes)
    return spread_modes(band_of(stage), rtc.n_modes, len(lines)) if lines else (), lines


@lru_cache(maxsize=4)
def _lines(frame_rate_hz: float, n_lines: int) -> tuple[float, ...]:
    """Return the lines of an RTC; whether there are enough is asked with every state shown."""
    return spread_lines(frame_rate_hz, FAR_WINDOW_S, n_lines)


def _check_mode_number(modes: tuple[int, ...], rtc: Status) -> str | None:
    if len(modes) >= MIN_LINES:
        return None
    return (
        f"found room for {len(modes)} dithered modes; expected at least {MIN_LINES}: the "
        f"RTC plays {rtc.max_dither_modes} at once, at {rtc.frame_rate_hz:g} Hz, and its basis "
        f"has {rtc.n_modes}"
    )


def _loop_found(state: TrackerState, rtc: Status, policy: Policy) -> LoopFound:
    """Return the loop as it is, and as it shall be closed again."""
    closed = rtc.loop != "open"
    out_of_hand = blocking_alarm(state.alarms.active, Interlock.HOLD) is not None
    goal = rtc.n_controlled or policy.wanted_modes(rtc)
    # The status of an open loop does not contain the gains with which it was closed.
    gains = rtc.gains if closed else (CLOSING_GAIN,) * goal
    return LoopFound(
        closed=closed,
        gains=gains,
        n_controlled=goal,
        leak=rtc.leak,
        held=closed and not out_of_hand,
    )


def acquisition_left_open(state: TrackerState, rtc: Status) -> Acquisition | None:
    """Return the interrupted acquisition, if the loop is as it left it.

    Opening a loop begins a session: the same session means that the loop was not closed in between.
    """
    left = state.operations.acquisition.interruption
    if left is None or left.session != rtc.session or rtc.loop != "open":
        return None
    return state.operations.acquisition


def _gains_for(found: LoopFound, n_modes: int, of_basis: int) -> tuple[float, ...]:
    """Return the gains ``(of_basis,)`` with which so many modes are closed."""
    return (*found.gains[:n_modes], *(0.0,) * (of_basis - n_modes))


def may_acquire(state: TrackerState, policy: Policy) -> bool:
    """Return whether the service may acquire by itself in mode auto, if it has a reason to."""
    rtc, acquisition = state.loop.rtc, state.operations.acquisition
    if not policy.acquires or rtc is None or rtc.loop == "open":
        return False
    if not policy.dither_enabled or state.dithers.stopped or state.measuring is not None:
        return False
    failed = acquisition.stage is AcquisitionStage.FAILED
    blocked = blocking_alarm(state.alarms.active, Interlock.SEND_NEW) is not None
    return not (failed or acquisition.held_off or blocked)


def explain_acquisition(state: TrackerState, policy: Policy, now_ns: int) -> str | None:
    """Return why the service should acquire by itself, or None."""
    if state.operator.mode is not Mode.AUTO or not may_acquire(state, policy):
        return None
    trial = state.operations.probation
    if trial is not None and trial.state is ProbationState.ACQUIRING:
        return f"the loop is lost with {trial.id} and with {trial.before}"
    # The matrix before is on its way to the RTC, or has just come there.
    returns = {ProbationState.ROLLING_BACK, ProbationState.WATCHED}
    goes_back = trial is not None and trial.state in returns
    for alarm in state.alarms.active:
        lasted_ns = now_ns - alarm.since_ns_utc
        # During a rollback the loop is given the time in which the previous matrix can recover it.
        waits_s = 0.0 if alarm.name == LOST and not goes_back else MAX_DIVERGENCE_S
        if alarm_blocks(alarm, Interlock.HOLD) and lasted_ns >= waits_s * SECOND_NS:
            return f"{alarm.name} for {lasted_ns / SECOND_NS:.0f} s"
    # Bad telemetry alone also refuses windows. Only a loop that has stopped correcting is opened
    # for it.
    if has_missed_enough(state) and not state.loop.holds:
        return f"{state.operations.acquisition.misses} windows in a row found no registration"
    return None


def has_missed_enough(state: TrackerState) -> bool:
    """Return whether so many windows in a row found no registration that it is no chance."""
    is_known = state.alpha.registration is not None and state.alpha.registration.usable
    return state.operations.acquisition.misses >= (
        MISSES_WHILE_TRACKING if is_known else MISSES_BEFORE_ACQUISITION
    )


def count_miss(context: StepContext, kind: RefusalKind) -> None:
    """Count a refused window, if α was out of its reach and no acquisition is under way."""
    if not context.acquisition.under_way and kind is RefusalKind.OUT_OF_REACH:
        context.acquisition = replace(context.acquisition, misses=context.acquisition.misses + 1)


def check_acquisition(state: TrackerState, policy: Policy) -> str | None:
    """Return why no acquisition can begin now, or None."""
    if state.loop.rtc is None:
        return NO_RTC
    if not policy.dither_enabled:
        return "the settings forbid any dither"
    alarm = blocking_alarm(state.alarms.active, Interlock.SEND_NEW)
    if alarm is not None:
        return f"{alarm.name}: {alarm.text}"
    modes, _ = _wide_capture_modes(AcquisitionStage.COARSE, state.loop.rtc)
    return _check_mode_number(modes, state.loop.rtc)


def carry_alpha(context: StepContext, step: NDArray[np.float64]) -> None:
    """Shift the α that was found, because the pointing law has moved by a step ``(4,)``."""
    found = context.acquisition.alpha
    if found is not None:
        context.acquisition = replace(context.acquisition, alpha=found.add_step(step))


def _enter_stage(context: StepContext, stage: AcquisitionStage, text: str) -> None:
    """Begin a stage."""
    entered = replace(
        context.acquisition,
        stage=stage,
        text=text,
        since_ns_utc=context.now_ns,
        misses=0,
        command=None,
    )
    context.acquisition = move(context, context.acquisition, entered)
    if context.acquisition is not entered:
        return
    level = Level.WARNING if stage is AcquisitionStage.FAILED else Level.INFO
    context.log(f"acquisition.{stage}", text, level)


def _request_loop(context: StepContext, command: cmd.SetLoop) -> None:
    """Ask the RTC to change its loop, and remember having asked."""
    set_loop(context, command)
    asked = context.loop.command
    context.acquisition = replace(context.acquisition, command=None if asked is None else asked.id)


def _restart_acquisition(context: StepContext, reason: str, *, slipped: bool = False) -> None:
    """Restart with the loop opened again, at once, a few times; then give up.

    A loop that has slipped is closed on half as many modes next time.
    """
    acquisition = context.acquisition
    # What is sent to an RTC that applies something else does not lead anywhere.
    if acquisition.attempt >= MAX_ATTEMPTS or context.matrices.misapplied:
        _fail_acquisition(context, f"{reason}, after {acquisition.attempt} attempts")
        return
    most = acquisition.max_modes
    lost_with = acquisition.lost_with
    if slipped:
        # Fewer modes tolerate a larger misregistration.
        most, lost_with = update_policy.half_of_modes(acquisition.n_modes), None
        update_policy.limit_modes(context, most, reason)
    validity.invalidate_telemetry(context, "the acquisition had not restarted")
    stop_running_dither(context)
    validity.forget_registration(context)
    context.acquisition = replace(
        acquisition,
        attempt=acquisition.attempt + 1,
        alpha=None,
        covariance=None,
        matrix=None,
        max_modes=most,
        lost_with=lost_with,
        n_modes=min(acquisition.n_modes, most or acquisition.n_modes_before),
    )
    _enter_stage(context, AcquisitionStage.OPENING, f"opening the loop again: {reason}")
    if context.rtc is not None and context.rtc.loop != "open":
        _request_loop(context, cmd.SetLoop(loop="open"))


def _fail_acquisition(context: StepContext, reason: str) -> None:
    """Give up: the loop stays as it is, but one that is out of hand is opened."""
    closed = context.rtc is not None and context.rtc.loop != "open"
    out_of_hand = context.blocking_alarm(Interlock.HOLD) is not None
    stop_running_dither(context)
    validity.forget_registration(context)
    context.acquisition = replace(context.acquisition, windows=context.windows.accepted)
    if closed and out_of_hand:
        _request_loop(context, cmd.SetLoop(loop="open"))
    text = (
        f"no registration was acquired: {reason}; see the log, then acquire again, or close the "
        "loop on a matrix of your own"
    )
    _enter_stage(context, AcquisitionStage.FAILED, text)


def abort_acquisition(context: StepContext, why: str, *, held_off: bool = False) -> None:
    """End it at once: the loop as it was found, if it held then and nothing was sent; else as is.

    As is means open, or closed on a reconstructor that has passed the gate. ``held_off``: none
    begins by itself for now, though what made this one begin may last.
    """
    stop_running_dither(context)
    # In the other stages a second set of modes has not confirmed α.
    if context.acquisition.stage not in _MEASURED_STAGES:
        validity.forget_registration(context)
    left, found = "left as it is", _to_give_back(context.state)
    if found is not None:
        left = "closed as it was found"
        _request_loop(context, cmd.SetLoop(loop="closed", leak=found.leak))
    text = f"ended {why}; the loop is {left}{HELD_OFF_TEXT if held_off else ''}"
    over = replace(context.acquisition, held_off=held_off, windows=context.windows.accepted)
    context.acquisition = over
    _enter_stage(context, AcquisitionStage.ABORTED, text)


def _wide_capture_stage(context: StepContext, rtc: Status) -> None:
    """Open the loop, then keep the dither of the stage running."""
    acquisition = context.acquisition
    if acquisition.stage is AcquisitionStage.OPENING:
        if rtc.loop != "open":
            if acquisition.command is None:
                _request_loop(context, cmd.SetLoop(loop="open"))
            return
        text = "looking for the registration with the loop open, on smooth modes"
        _enter_stage(context, AcquisitionStage.COARSE, text)
    elif rtc.loop != "open":
        _restart_acquisition(context, "the loop was closed from outside")
        return
    _keep_dithering(context, rtc)


@_during_acquisition
def on_wide_capture(context: StepContext, event: ev.WideCaptureFitted) -> None:
    """Take over where a window puts the mirror, or hold it against where another one did."""
    rtc, before, estimate = context.rtc, context.acquisition, event.found.estimate
    began_ns = event.began_ns_utc or estimate.t_ns_utc
    estimate = validity.at_present(context.state, estimate, began_ns, estimate.t_ns_utc)
    if validity.explain_void(context.state, began_ns) is not None:
        return
    if rtc is None or not before.uses_wide_capture or estimate.session != rtc.session:
        return
    dither = wide_capture_dither(before.stage, rtc, context.policy, 0)
    if isinstance(dither, str) or dither.request.modes != estimate.modes:
        return  # a window of another stage
    covariance = estimate.covariance + np.diag(band_of(before.stage).floor ** 2)
    context.acquisition = replace(before, alpha=estimate.alpha, covariance=covariance)
    x, y, rotation, magnification = np.sqrt(np.diag(covariance))
    place = (
        f"{estimate.alpha} +- {x:.3f}, {y:.3f} subap, {np.rad2deg(rotation):.2f} deg, "
        f"{magnification:.3f} (1 sigma)"
    )
    if before.stage is AcquisitionStage.COARSE or before.alpha is None or before.covariance is None:
        stop_running_dither(context)
        _enter_stage(context, AcquisitionStage.CONFIRMING, f"{place}: other modes must confirm it")
        return
    difference = estimate.alpha.vector - before.alpha.vector
    chi2 = float(difference @ np.linalg.solve(covariance + before.covariance, difference))
    # Two sets of modes must agree before α is used (docs/decisions/0019-acquisition.md).
    if chi2 > MAX_ESTIMATE_DIFFERENCE:
        context.acquisition = before
        reason = (
            f"two sets of modes disagree: {before.alpha} and {estimate.alpha}, "
            f"chi2 {chi2:.0f}, expected at most {MAX_ESTIMATE_DIFFERENCE}"
        )
        _restart_acquisition(context, reason)
        return
    registration = Registration(
        alpha=estimate.alpha,
        covariance=covariance,
        floor=context.policy.floor,
        image_floor=context.policy.image_floor,
        t_ns_utc=estimate.t_ns_utc,
        arrived_ns_utc=context.now_ns,
        n_windows=1,
        basis_id=context.loop.basis_id,
        config_id=context.loop.config_id,
        nominal=context.alpha.law.nominal,
    )
    validity.store_registration(context, registration)
    _lift_limit_of_jump(context)
    stop_running_dither(context)
    _enter_stage(context, AcquisitionStage.PARTIAL, f"{place}: closing the loop")


def _lift_limit_of_jump(context: StepContext) -> None:
    """Allow all modes again where the loop was lost because the mirror had jumped.

    The matrix that lost it was made for another registration, beyond what the gate had judged it
    at: the loss says nothing of how many modes hold at this one.
    """
    acquisition = context.acquisition
    record = context.state.reconstructor(acquisition.lost_with)
    if record is None or not update_policy.is_beyond_verdict(context.state, record):
        return
    n_modes = acquisition.n_modes_before
    first = min(n_modes, FIRST_LOOP_MODES)
    context.acquisition = replace(acquisition, max_modes=None, n_modes=first, lost_with=None)
    update_policy.forget_limit(context)
    context.log("modes.limit-lifted", f"the mirror has moved since {record.id}: {n_modes} modes")


def _note_miss(context: StepContext, reason: str) -> None:
    """Count a window without a result; after a few, restart."""
    misses = context.acquisition.misses + 1
    if misses >= MAX_STAGE_MISSES:
        _restart_acquisition(context, reason)
    else:
        context.acquisition = replace(context.acquisition, misses=misses)


def _keep_dithering(context: StepContext, rtc: Status) -> None:
    """Ask for the dither of the stage once no other one runs."""
    if context.dither is not None or context.now_ns < context.dithers.no_dither_before_ns_utc:
        return
    if rtc.dither_id is not None:
        stopping = rtc.dither_id == context.dither_policy.stopped_id
        since_s = (context.now_ns - context.acquisition.since_ns_utc) / SECOND_NS
        if not (stopping and since_s < STOP_STATUS_DELAY_S):
            context.put_off(dither_s=STOP_STATUS_DELAY_S)
            request_stop(context)
        return
    dither = wide_capture_dither(context.acquisition.stage, rtc, context.policy, context.now_ns)
    if isinstance(dither, str):
        _fail_acquisition(context, dither)
    else:
        request_dither(context, dither)


def _to_give_back(state: TrackerState) -> LoopFound | None:
    """Return the loop as it was found, if it held then and its matrix is still in the RTC."""
    acquisition, rtc = state.operations.acquisition, state.loop.rtc
    found = acquisition.found
    if rtc is None or found is None or acquisition.sent or not (found.closed and found.held):
        return None
    if acquisition.interruption is not None and acquisition_left_open(state, rtc) is None:
        return None
    return found
