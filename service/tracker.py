"""How one event changes what the service knows, and what is then to be done.

``step`` is a function of state, event and time alone: no clock, no files, no link. A recorded
night therefore replays exactly, and every reaction of the service can be tested as a value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from service.tracking import (
    acquisition,
    alarm_records,
    alarms,
    dither,
    interlocks,
    measuring,
    mode_proof,
    offload,
    operator,
    probation,
    reconstructors,
    refusals,
    resume,
    rtc,
    validity,
    window_processing,
)
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.commands import Command
from service.tracking.events import Effect, Event
from service.tracking.loop import CommandState
from service.tracking.policy import Policy
from service.tracking.state import TrackerState
from service.tracking.step_context import StepContext
from service.tracking.update_policy import note_declined
from service.tracking.updates import decide, fetch_in_use
from service.wire import (
    Acknowledgement,
    DitherRequest,
    DitherStop,
    LoopRequest,
    MeasureRequest,
    OffloadRequest,
    RampRequest,
    Status,
)

__all__ = ["Command", "Event", "Policy", "step"]


def step(
    state: TrackerState, event: Event, policy: Policy, now_ns: int
) -> tuple[TrackerState, tuple[Effect, ...]]:
    """Return the next state and what is to be done.

    Raises
    ------
    CommandError
        If an operator's command cannot be carried out in this state; the state stands.
    UnknownIdError
        If it names an unknown reconstructor.
    """
    if isinstance(event, Command):
        interlocks.require(state, event, policy, now_ns)
    context = StepContext(state, policy, now_ns)
    alarm_records.judge_rules(context)
    measuring.watch_measurement(context, event)
    REACTIONS[type(event)](context, event)
    probation.follow(context, event)
    alarm_records.judge_rules(context)
    note_declined(context, rejected=isinstance(event, cmd.Reject))
    _go_on(context, event)
    ordered = isinstance(event, Command)
    alarm_records.follow(context, timely=isinstance(event, ev.Tick), ordered=ordered)
    return context.state, tuple(context.effects)


def _go_on(context: StepContext, event: Event) -> None:
    """Let what runs go on, and decide what else is wanted: what has the mirror comes first."""
    if context.state.measuring is not None:
        return
    fetch_in_use(context)
    if context.state.stopped_because:
        resume.keep_stopped(context)
        return
    acquisition.acquire(context, event)
    if context.acquisition.under_way:
        return
    measuring.follow_noisy(context, event)
    if not measuring.awaits_its_dither(context.state):
        decide(context)
        offload.demand(context)


def _on_tick(context: StepContext, _: ev.Tick) -> None:
    rtc.on_tick(context)
    validity.age(context)
    refusals.follow(context)
    operator.close_again(context)


def _on_condition(context: StepContext, event: ev.ConditionChanged) -> None:
    if event.over:
        validity.end_alarm(context, event.name, event.t_ns_utc)
    elif event.name == alarms.MIRROR_SILENT:
        dither.stop_unanswered(context, event.text)
    else:
        context.raise_alarm(event.name, event.text)


def _on_window(context: StepContext, event: ev.WindowFitted) -> None:
    if context.state.measuring is not None:
        window_processing.reject_window(context, measuring.MEASURING)
        return
    mode_proof.learn(context, event.estimate)
    window_processing.on_window(context, event)
    dither.learn(context, event.estimate)


def _on_made(context: StepContext, made: ev.MatrixMade) -> None:
    if context.acquisition.under_way:
        reconstructors.propose(context, made.record)
    elif probation.is_way_back(context.state, made):
        probation.go_back(context, made)
    else:
        reconstructors.on_matrix(context, made)


def _on_dither_measured(context: StepContext, event: ev.DitherMeasured) -> None:
    loud = dither.why_too_strong(context, event)
    if loud is not None:
        measuring.cut_off(context, f"its dither was too strong: {event.text}")
        dither.stop_too_strong(context, event.id, loud)


def _on_answer(context: StepContext, answered: ev.Answered) -> None:
    reply = answered.reply
    match answered.request:
        case DitherRequest() as request:
            dither.on_answer(context, request, reply)
        case DitherStop():
            dither.on_stop_answer(context, reply)
        case MeasureRequest() as request:
            measuring.on_answer(context, request, reply)
        case OffloadRequest() as request:
            offload.on_answer(context, request, reply)
        case LoopRequest() | RampRequest() as request:
            outcome = CommandState.ACCEPTED if reply.accepted else CommandState.REFUSED
            operator.on_loop_answer(context, request.id, outcome, reply.reason)


def _on_failure(context: StepContext, failed: ev.JobFailed) -> None:
    match failed.effect:
        case ev.Ask(request=MeasureRequest(id=name)):
            measuring.fail(context, context.state.measurement(name), failed.text)
        case ev.Ask(request=OffloadRequest(id=name)):
            offload.on_failure(context, name, failed.text)
        case ev.FinishNoisy(record=noisy):
            measuring.fail(context, noisy, failed.text)
        case ev.Ask(request=LoopRequest(id=name) | RampRequest(id=name)):
            operator.on_loop_answer(context, name, CommandState.FAILED, failed.text)
        case effect:
            rtc.on_failure(context, effect, failed.text)


REACTIONS: Final[dict[type, Callable[[StepContext, Any], object]]] = {
    ev.Tick: _on_tick,
    Status: rtc.on_status,
    ev.SessionStarted: rtc.on_new_session,
    ev.RtcVanished: rtc.on_vanished,
    ev.ServicesMet: rtc.on_services,
    ev.ConditionChanged: _on_condition,
    ev.LogEvent: lambda context, event: context.log(event.name, event.text, event.level),
    ev.WideCaptureFitted: lambda _context, _event: None,  # an acquisition's
    ev.WindowFitted: _on_window,
    ev.WindowLost: window_processing.on_lost,
    ev.PassiveFitted: window_processing.process_passive,
    ev.PassiveUnavailable: lambda context, event: window_processing.note_passive_unavailable(
        context, event.text
    ),
    ev.MatrixMade: _on_made,
    ev.MatrixFetched: reconstructors.on_fetched,
    ev.ModesRecognised: mode_proof.recognise,
    ev.MarginJudged: reconstructors.on_margin,
    ev.ProposalJudged: reconstructors.on_proposal_judged,
    Acknowledgement: reconstructors.on_acknowledgement,
    ev.MatrixMeasured: lambda context, measured: measuring.on_measured(context, measured.record),
    ev.Answered: _on_answer,
    ev.DitherSilent: dither.on_silence,
    ev.DitherMeasured: _on_dither_measured,
    ev.Compared: probation.on_compared,
    ev.LoopHeld: rtc.on_loop_held,
    ev.Vibrations: rtc.on_vibrations,
    ev.JobFailed: _on_failure,
    cmd.SetMode: operator.set_mode,
    cmd.SetPointing: lambda context, command: validity.point(context, command.pointing),
    cmd.SetValue: alarm_records.set_value,
    cmd.SetLoop: operator.set_loop,
    cmd.Ramp: operator.ramp,
    cmd.StopEverything: resume.stop,
    cmd.Resume: resume.release,
    cmd.Acquire: acquisition.acquire_on_command,
    cmd.AbortAcquisition: acquisition.abort_on_command,
    cmd.StartDither: operator.start_dither,
    cmd.StopDither: dither.stop_by_operator,
    cmd.Measure: measuring.measure,
    cmd.GiveUp: lambda context, command: measuring.give_up(context, command.id),
    cmd.MeasureNoisy: measuring.measure_noisy,
    cmd.AcknowledgeAlarm: alarm_records.acknowledge,
    cmd.MuteAlarm: alarm_records.mute,
    cmd.UnmuteAlarm: alarm_records.unmute,
    cmd.Refit: operator.refit,
    cmd.Approve: operator.approve,
    cmd.Reject: operator.reject,
    cmd.Publish: operator.publish,
    cmd.Rollback: operator.roll_back,
}
"""What each event, and each command, does: there is one for every kind of either."""
