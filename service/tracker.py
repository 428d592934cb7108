"""The pure function ``step``: how one event changes the state, and which effects follow.

``step`` depends on state, event, policy and time only; it uses no clock, file or network. A
recorded night therefore replays exactly, and tests compare the returned state and effects.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from service import wire
from service.records import alarms
from service.records import commands as cmd
from service.records import events as ev
from service.records.commands import Command
from service.records.events import Effect, Event
from service.records.operations import CommandState, MeasureState
from service.records.state import TrackerState
from service.tracking import (
    alarm_records,
    alarm_rules,
    dither,
    interlocks,
    mode_proof,
    offload,
    operator,
    pointing_law,
    reconstructors,
    resume,
    rtc,
    validity,
    window_processing,
)
from service.tracking.alarm_rules import derive_alarms
from service.tracking.operations import acquisition, measurement, probation
from service.tracking.policy import Policy
from service.tracking.step_context import StepContext
from service.tracking.update_policy import note_declined
from service.tracking.updates import decide_updates, fetch_in_use

__all__ = ["Command", "Event", "Policy", "step"]


def step(
    state: TrackerState, event: Event, policy: Policy, now_ns: int, cause: str = ""
) -> tuple[TrackerState, tuple[Effect, ...]]:
    """Return the next state and the effects to carry out.

    Parameters
    ----------
    state
        Present state; it is not changed.
    event
        Event from the RTC, the worker or the clock, or a command of an operator.
    policy
        Thresholds and limits from the settings.
    now_ns
        Time of the service, nanoseconds since the Unix epoch, UTC.
    cause
        Id of the command or event that led to this one; if empty, a new id is made. Effects and
        log lines carry it.

    Raises
    ------
    CommandError
        If a command cannot be carried out in this state, which then remains as it is.
    UnknownIdError
        If a command names an unknown reconstructor.
    """
    if isinstance(event, Command):
        interlocks.require(state, event, policy, now_ns)
    cause = cause or ev.new_id(ev.kebab(type(event)), now_ns)
    context = StepContext(state, policy, now_ns, cause)
    event = pointing_law.event_of_now(context, event)
    # Alarms are derived before and after each part: time alone can raise one, and the second part
    # must see those that the event has raised, because they forbid operations.
    derive_alarms(context)
    for part in (_react, _advance):
        part(context, event)
        derive_alarms(context)
    ordered = isinstance(event, Command)
    alarm_records.update_records(context, timely=isinstance(event, ev.Tick), ordered=ordered)
    return context.state, tuple(context.effects)


def _react(context: StepContext, event: Event) -> None:
    """Update the state with the event; see :data:`REACTIONS`."""
    measurement.give_up_lost(context, event)
    reaction = REACTIONS.get(type(event))
    if reaction is not None:
        reaction(context, event)
    resume.drop_unconfirmed(context)
    pointing_law.follow_law(context)
    window_processing.reset_run(context)
    probation.advance(context, event)
    note_declined(context, rejected=isinstance(event, cmd.Reject))


def _advance(context: StepContext, event: Event) -> None:
    """Advance the operation that is running, and decide on updates if none needs the mirror."""
    # The RTC measures an interaction matrix with the loop open and must not be disturbed.
    if context.state.measuring is not None:
        return
    fetch_in_use(context)
    # After an emergency stop nothing is sent or played until an operator resumes.
    if context.operator.stopped_because:
        resume.keep_stopped(context)
        return
    acquisition.advance(context, event)
    # Updates follow α, which an acquisition is about to determine.
    if context.acquisition.under_way:
        return
    measurement.advance_noisy(context, event)
    noisy = context.state.noisy_measurement
    # Another dither has to end before its own: until then the service begins none.
    if noisy is None or noisy.state is not MeasureState.WAITING:
        decide_updates(context)
        offload.request_offload(context)


def _on_tick(context: StepContext, _: ev.Tick) -> None:
    """Update what depends on time: silence of the RTC, age of α, alarms."""
    rtc.on_tick(context)
    validity.age_registration(context)
    operator.close_again(context)


def _on_log_event(context: StepContext, event: ev.LogEvent) -> None:
    """Record the event in the log."""
    context.log(event.name, event.text, event.level)


def _on_condition(context: StepContext, event: ev.ConditionChanged) -> None:
    """Raise or end an alarm; stop a dither that the mirror does not follow."""
    if event.over:
        validity.end_alarm(context, event.name, event.t_ns_utc)
    elif event.name == alarms.MIRROR_SILENT:
        dither.stop_unanswered(context, event.text)
    else:
        if event.name == alarms.WORKER_LOST:
            mode_proof.forget_responses(context)
        context.raise_alarm(event.name, event.text)


def _on_window(context: StepContext, event: ev.WindowFitted) -> None:
    """Update α, verified modes and dither precision from a window."""
    if context.state.measuring is not None:
        window_processing.reject_window(context, measurement.MEASURING)
        return
    mode_proof.learn_modes(context, event.estimate)
    window_processing.on_window(context, event)
    dither.learn_precision(context, event.estimate)


def _on_made(context: StepContext, made: ev.MatrixMade) -> None:
    """Propose a new reconstructor, or send it for a rollback."""
    if context.acquisition.under_way:
        reconstructors.propose(context, made.record)
    elif probation.is_way_back(context.state, made):
        probation.send_way_back(context, made)
    else:
        reconstructors.on_matrix(context, made)


def _on_dither_measured(context: StepContext, event: ev.DitherMeasured) -> None:
    """Stop a dither measured stronger than requested."""
    reason = dither.check_measured_dither(context, event)
    if reason is not None:
        measurement.fail_noisy_measurement(context, f"its dither was too strong: {event.text}")
        dither.stop_too_strong(context, event.id, reason)


def _on_unusable(context: StepContext, event: ev.DitherUnusable) -> None:
    """Log that no windows can be cut from this dither."""
    context.warn("dither.unusable", event.text)


def _on_answer(context: StepContext, answered: ev.Answered) -> None:
    """Pass the RTC's reply to the requester."""
    reply = answered.reply
    match answered.request:
        case wire.DitherRequest() as request:
            dither.on_answer(context, request, reply)
        case wire.DitherStop():
            dither.on_stop_answer(context, reply)
        case wire.MeasureRequest() as request:
            measurement.on_answer(context, request, reply)
        case wire.OffloadRequest() as request:
            offload.on_answer(context, request, reply)
        case wire.LoopRequest() | wire.RampRequest() as request:
            outcome = CommandState.ACCEPTED if reply.accepted else CommandState.REFUSED
            operator.on_loop_answer(context, request.id, outcome, reply.reason)
            n_modes = getattr(request, "n_controlled", None)
            if n_modes is not None and reply.accepted:
                rtc.on_modes_commanded(context, ev.ModesCommanded(n_modes=n_modes))


def _on_failure(context: StepContext, failed: ev.JobFailed) -> None:
    """Pass the failure of an effect to its requester, which may ask again later."""
    match failed.effect:
        case ev.Ask(request=wire.MeasureRequest(id=name)):
            measurement.fail_measurement(context, context.state.measurement(name), failed.text)
        case ev.Ask(request=wire.OffloadRequest(id=name)):
            offload.on_failure(context, name, failed.text)
        case ev.FinishNoisy(record=noisy):
            measurement.fail_measurement(context, noisy, failed.text)
        case ev.Ask(request=wire.LoopRequest(id=name) | wire.RampRequest(id=name)):
            operator.on_loop_answer(context, name, CommandState.FAILED, failed.text)
        case effect:
            rtc.on_failure(context, effect, failed.text)


REACTIONS: Final[dict[type, Callable[[StepContext, Any], object]]] = {
    ev.Tick: _on_tick,
    wire.Status: rtc.on_status,
    ev.SessionStarted: rtc.on_new_session,
    ev.RtcVanished: rtc.on_vanished,
    ev.ServicesMet: rtc.on_services,
    ev.ConditionChanged: _on_condition,
    ev.LogEvent: _on_log_event,
    ev.WindowFitted: _on_window,
    ev.WindowLost: window_processing.on_lost,
    ev.PassiveFitted: window_processing.process_passive,
    ev.PassiveUnavailable: window_processing.on_passive_unavailable,
    ev.MatrixMade: _on_made,
    ev.MatrixFetched: reconstructors.on_fetched,
    ev.ModesRecognised: mode_proof.note_recognised,
    ev.MarginJudged: reconstructors.on_margin,
    ev.ProposalJudged: reconstructors.on_proposal_judged,
    wire.Acknowledgement: reconstructors.on_acknowledgement,
    ev.MatrixMeasured: measurement.on_measured,
    ev.Answered: _on_answer,
    ev.DitherSilent: dither.on_silence,
    ev.DitherUnusable: _on_unusable,
    ev.DitherMeasured: _on_dither_measured,
    ev.Compared: probation.on_compared,
    ev.LoopHeld: rtc.on_loop_held,
    ev.MatrixMisapplied: reconstructors.on_misapplied,
    ev.Vibrations: rtc.on_vibrations,
    ev.ModelChanged: rtc.on_model_changed,
    ev.ModesCommanded: rtc.on_modes_commanded,
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
    cmd.MeasureNoisy: measurement.measure_noisy,
    cmd.AcknowledgeAlarm: alarm_records.acknowledge,
    cmd.MuteAlarm: alarm_records.mute,
    cmd.UnmuteAlarm: alarm_records.unmute,
    cmd.Refit: operator.refit,
    cmd.Approve: operator.approve,
    cmd.Reject: operator.reject,
    cmd.Publish: operator.publish,
    cmd.Rollback: operator.roll_back,
}
"""Function that updates the state for each kind of event and command.

It is called before the operation that is running receives the event. Events in
``TAKEN_BY_OPERATIONS`` have no entry.
"""

TAKEN_BY_OPERATIONS: Final = frozenset({ev.WideCaptureFitted})
"""Events that only an operation uses; they are ignored if none is running."""
