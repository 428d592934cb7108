"""``step``: how one event changes the state, and which effects follow.

``step`` is a function of state, event and time alone: no clock, no files, no link. A recorded
night therefore replays exactly, and every reaction of the service can be tested as a value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from service.tracking import (
    alarm_records,
    alarm_rules,
    alarms,
    dither,
    interlocks,
    mode_proof,
    offload,
    operator,
    passive_processing,
    pointing_law,
    reconstructors,
    resume,
    rtc,
    validity,
    window_processing,
)
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.alarm_rules import derive_alarms
from service.tracking.commands import Command
from service.tracking.events import Effect, Event
from service.tracking.operation_records import CommandState
from service.tracking.operations import acquisition, measurement, noisy_measurement, probation
from service.tracking.policy import Policy
from service.tracking.state import TrackerState
from service.tracking.step_context import StepContext
from service.tracking.update_policy import note_declined
from service.tracking.updates import decide_updates, fetch_in_use
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
    state: TrackerState, event: Event, policy: Policy, now_ns: int, cause: str = ""
) -> tuple[TrackerState, tuple[Effect, ...]]:
    """Return the next state and what is to be done.

    Parameters
    ----------
    state
        What is known.
    event
        What has happened, or a command.
    policy
        The user's numbers.
    now_ns
        The service's clock, nanoseconds.
    cause
        Id of the command or event that has led to this one; empty: it stands for itself, and what
        it leads to has its own.

    Raises
    ------
    CommandError
        If an operator's command cannot be carried out in this state; the state stands.
    UnknownIdError
        If it names an unknown reconstructor.
    """
    if isinstance(event, Command):
        interlocks.require(state, event, policy, now_ns)
    cause = cause or ev.new_id(ev.kebab(type(event)), now_ns)
    context = StepContext(state, policy, now_ns, cause)
    event = pointing_law.event_of_now(context, event)
    derive_alarms(context)
    for part in (_react, _go_on):
        part(context, event)
        derive_alarms(context)
    ordered = isinstance(event, Command)
    alarm_records.update_records(context, timely=isinstance(event, ev.Tick), ordered=ordered)
    return context.state, tuple(context.effects)


def _react(context: StepContext, event: Event) -> None:
    """Take the event in."""
    measurement.give_up_lost(context, event)
    reaction = REACTIONS.get(type(event))
    if reaction is not None:
        reaction(context, event)
    pointing_law.follow_law(context)
    window_processing.reset_run(context)
    probation.advance(context, event)
    note_declined(context, rejected=isinstance(event, cmd.Reject))


def _go_on(context: StepContext, event: Event) -> None:
    """Let what runs go on, and decide what else is wanted: what has the mirror comes first."""
    if context.state.measuring is not None:
        return
    fetch_in_use(context)
    if context.operator.stopped_because:
        resume.keep_stopped(context)
        return
    acquisition.advance(context, event)
    if context.acquisition.under_way:
        return
    noisy_measurement.advance(context, event)
    if not noisy_measurement.awaits_its_dither(context.state):
        decide_updates(context)
        offload.request_offload(context)


def _on_tick(context: StepContext, _: ev.Tick) -> None:
    """Let what depends on the time alone age: the RTC's silence, α, alarms."""
    rtc.on_tick(context)
    validity.age_registration(context)
    operator.close_again(context)


def _on_log_event(context: StepContext, event: ev.LogEvent) -> None:
    """Put it on record."""
    context.log(event.name, event.text, event.level)


def _on_condition(context: StepContext, event: ev.ConditionChanged) -> None:
    """Raise or end its alarm; stop a dither that the mirror does not follow."""
    if event.over:
        validity.end_alarm(context, event.name, event.t_ns_utc)
    elif event.name == alarms.MIRROR_SILENT:
        dither.stop_unanswered(context, event.text)
    else:
        context.raise_alarm(event.name, event.text)


def _on_window(context: StepContext, event: ev.WindowFitted) -> None:
    """Take α and what the dithered modes have shown from a window."""
    if context.state.measuring is not None:
        window_processing.reject_window(context, measurement.MEASURING)
        return
    mode_proof.learn_modes(context, event.estimate)
    window_processing.on_window(context, event)
    dither.learn_precision(context, event.estimate)


def _on_made(context: StepContext, made: ev.MatrixMade) -> None:
    """Propose a reconstructor that was made, or send it where that is what it was made for."""
    if context.acquisition.under_way:
        reconstructors.propose(context, made.record)
    elif probation.is_way_back(context.state, made):
        probation.send_way_back(context, made)
    else:
        reconstructors.on_matrix(context, made)


def _on_dither_measured(context: StepContext, event: ev.DitherMeasured) -> None:
    """Stop a dither that is stronger in the light than was asked for."""
    loud = dither.why_too_strong(context, event)
    if loud is not None:
        noisy_measurement.fail_noisy_measurement(
            context, f"its dither was too strong: {event.text}"
        )
        dither.stop_too_strong(context, event.id, loud)


def _on_unusable(context: StepContext, event: ev.DitherUnusable) -> None:
    """Put on record that windows of this dither cannot be cut."""
    context.warn("dither.unusable", event.text)


def _on_answer(context: StepContext, answered: ev.Answered) -> None:
    """Note what the RTC says to a request, where the request came from."""
    reply = answered.reply
    match answered.request:
        case DitherRequest() as request:
            dither.on_answer(context, request, reply)
        case DitherStop():
            dither.on_stop_answer(context, reply)
        case MeasureRequest() as request:
            measurement.on_answer(context, request, reply)
        case OffloadRequest() as request:
            offload.on_answer(context, request, reply)
        case LoopRequest() | RampRequest() as request:
            outcome = CommandState.ACCEPTED if reply.accepted else CommandState.REFUSED
            operator.on_loop_answer(context, request.id, outcome, reply.reason)


def _on_failure(context: StepContext, failed: ev.JobFailed) -> None:
    """Note that something could not be done, where it was asked for."""
    match failed.effect:
        case ev.Ask(request=MeasureRequest(id=name)):
            measurement.fail_measurement(context, context.state.measurement(name), failed.text)
        case ev.Ask(request=OffloadRequest(id=name)):
            offload.on_failure(context, name, failed.text)
        case ev.FinishNoisy(record=noisy):
            measurement.fail_measurement(context, noisy, failed.text)
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
    ev.LogEvent: _on_log_event,
    ev.WindowFitted: _on_window,
    ev.WindowLost: window_processing.on_lost,
    ev.PassiveFitted: passive_processing.process_passive,
    ev.PassiveUnavailable: passive_processing.on_passive_unavailable,
    ev.MatrixMade: _on_made,
    ev.MatrixFetched: reconstructors.on_fetched,
    ev.ModesRecognised: mode_proof.note_recognised,
    ev.MarginJudged: reconstructors.on_margin,
    ev.ProposalJudged: reconstructors.on_proposal_judged,
    Acknowledgement: reconstructors.on_acknowledgement,
    ev.MatrixMeasured: measurement.on_measured,
    ev.Answered: _on_answer,
    ev.DitherSilent: dither.on_silence,
    ev.DitherUnusable: _on_unusable,
    ev.DitherMeasured: _on_dither_measured,
    ev.Compared: probation.on_compared,
    ev.LoopHeld: rtc.on_loop_held,
    ev.Vibrations: rtc.on_vibrations,
    ev.JobFailed: _on_failure,
    cmd.SetMode: operator.set_mode,
    cmd.SetPointing: operator.set_pointing,
    cmd.SetValue: alarm_rules.set_value,
    cmd.SetLoop: operator.set_loop,
    cmd.Ramp: operator.ramp,
    cmd.StopEverything: resume.stop_everything,
    cmd.Resume: resume.resume_everything,
    cmd.Acquire: acquisition.acquire_on_command,
    cmd.AbortAcquisition: acquisition.abort_on_command,
    cmd.StartDither: operator.start_dither,
    cmd.StopDither: dither.stop_by_operator,
    cmd.Measure: measurement.measure,
    cmd.GiveUp: measurement.give_up_on_command,
    cmd.MeasureNoisy: noisy_measurement.measure_noisy,
    cmd.AcknowledgeAlarm: alarm_records.acknowledge,
    cmd.MuteAlarm: alarm_records.mute,
    cmd.UnmuteAlarm: alarm_records.unmute,
    cmd.Refit: operator.refit,
    cmd.Approve: operator.approve,
    cmd.Reject: operator.reject,
    cmd.Publish: operator.publish,
    cmd.Rollback: operator.roll_back,
}
"""What takes in each event and each command, before the operation that runs is given it.

One entry for every kind of either but what an operation alone can use: ``TAKEN_BY_OPERATIONS``.
"""

TAKEN_BY_OPERATIONS: Final = frozenset({ev.WideCaptureFitted})
"""Nothing of the state depends on these but an operation; without one they mean nothing."""
