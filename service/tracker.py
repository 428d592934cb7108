"""The pure function ``step``: how one event changes the state, and which effects follow.

``step`` depends on state, event, policy and time only; it uses no clock, file or network. A
recorded night therefore replays exactly, and tests compare the returned state and effects.

Three tables say what the service does:

:data:`REACTIONS`
    What each event and command changes. Only these functions are given the event.
:data:`DECIDERS`
    What is decided after every event, whatever it was, from all that is known by then.
:data:`service.tracking.alarm_rules.RULES`
    Which alarms follow from what is known. ``derive_alarms`` applies them before the reactions, and
    where it is among the deciders. The table is next to the functions that it names.

An order is checked by ``interlocks`` first, against the alarms that the last event left. A failure
leaves the state as it was. The functions of one step share only the context: what an earlier one
has done is the difference between ``context.state`` and ``context.before``, by which
``dither.learn_precision`` knows that the window was accepted, and ``probation.advance`` that the
matrix was swapped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from service import wire
from service.records import alarms
from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import Interlock
from service.records.commands import Command
from service.records.events import Effect, Event
from service.records.operations import MeasureState
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
    references,
    resume,
    rtc,
    updates,
    validity,
    window_processing,
)
from service.tracking.alarm_rules import derive_alarms
from service.tracking.operations import acquisition, measurement, probation
from service.tracking.operations.running import running_ramp
from service.tracking.policy import Policy
from service.tracking.step_context import StepContext

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
    # Time alone can raise an alarm, which the reactions must see.
    derive_alarms(context)
    for react in REACTIONS[type(event)]:
        react(context, event)
    for decider in DECIDERS:
        if all(guard(context) for guard in decider.guards):
            decider.decide(context)
    alarm_records.update_records(context, ordered=isinstance(event, Command))
    return context.state, tuple(context.effects)


def _on_tick(context: StepContext, _: ev.Tick) -> None:
    """Update what depends on time: what is overdue, age of α, a loop to close again."""
    measurement.give_up_overdue(context)
    rtc.give_up_overdue(context)
    references.give_up_overdue(context)
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
        dither.stop_unanswered(context, str(event.text))
    else:
        context.raise_alarm(event.name, event.text)


def _on_made(context: StepContext, made: ev.MatrixMade) -> None:
    """Propose a new reconstructor; send it without approval, or as the way back of a probation."""
    if context.acquisition.under_way:
        reconstructors.propose(context, made.record)
    elif probation.is_way_back(context.state, made):
        probation.send_way_back(context, made)
    else:
        reconstructors.on_matrix(context, made)


def _on_unusable(context: StepContext, event: ev.DitherUnusable) -> None:
    """Log that no windows can be cut from this dither."""
    context.warn("dither.unusable", event.text)


def _on_answer(context: StepContext, answered: ev.Answered) -> None:
    """Process the RTC's reply to a request, as ``ANSWERS`` says."""
    for react in ANSWERS[type(answered.request)]:
        react(context, answered.request, answered.reply)


def _on_failure(context: StepContext, failed: ev.JobFailed) -> None:
    """Process the failure of an effect, as ``FAILURES`` says."""
    what = failed.effect.request if isinstance(failed.effect, ev.Ask) else failed.effect
    for react in FAILURES[type(what)]:
        react(context, what, failed.text)


Reactions = dict[type, tuple[Callable[..., None], ...]]

REACTIONS: Final[Reactions] = {
    ev.Tick: (_on_tick,),
    wire.Status: (rtc.on_status,),
    ev.SessionStarted: (rtc.on_new_session, acquisition.on_new_session),
    ev.RtcVanished: (measurement.on_vanished, rtc.on_vanished, acquisition.on_vanished),
    ev.ServicesMet: (rtc.on_services,),
    ev.ConditionChanged: (_on_condition,),
    ev.LogEvent: (_on_log_event,),
    ev.WindowFitted: (mode_proof.learn_modes, window_processing.on_window, dither.learn_precision),
    ev.WideCaptureFitted: (acquisition.on_wide_capture,),
    ev.WindowLost: (window_processing.on_lost, acquisition.on_lost),
    ev.PassiveFitted: (window_processing.process_passive,),
    ev.PassiveUnavailable: (window_processing.on_passive_unavailable,),
    ev.MatrixMade: (operator.on_refit_made, _on_made, acquisition.on_made),
    ev.MatrixFetched: (reconstructors.on_fetched,),
    ev.ModesRecognised: (mode_proof.note_recognised,),
    ev.MarginJudged: (reconstructors.on_margin,),
    ev.ProposalJudged: (reconstructors.on_proposal_judged,),
    wire.Acknowledgement: (reconstructors.on_acknowledgement,),
    ev.MatrixMeasured: (measurement.on_measured,),
    ev.Answered: (_on_answer,),
    ev.DitherSilent: (dither.on_silence,),
    ev.DitherUnusable: (_on_unusable, acquisition.on_dither_unusable),
    ev.DitherMeasured: (dither.on_measured, acquisition.on_too_strong, measurement.on_too_strong),
    ev.Compared: (probation.on_compared,),
    ev.LoopHeld: (rtc.on_loop_held,),
    ev.MatrixMisapplied: (reconstructors.on_misapplied,),
    ev.ReferencesMade: (references.on_made,),
    ev.ShapeHeld: (references.on_held,),
    ev.ReferencesFetched: (references.on_fetched,),
    ev.Vibrations: (rtc.on_vibrations,),
    ev.ModelChanged: (rtc.on_model_changed,),
    ev.ModesCommanded: (rtc.on_modes_commanded,),
    ev.JobFailed: (_on_failure,),
    cmd.SetMode: (operator.set_mode, probation.on_mode_set, acquisition.on_mode_set),
    cmd.SetPointing: (operator.set_pointing,),
    cmd.SetValue: (alarm_rules.set_value,),
    cmd.SetLoop: (operator.set_loop,),
    cmd.Ramp: (operator.ramp,),
    cmd.StopEverything: (resume.stop_everything,),
    cmd.Resume: (resume.resume_everything,),
    cmd.Acquire: (acquisition.acquire_on_command,),
    cmd.AbortAcquisition: (acquisition.abort_on_command,),
    cmd.StartDither: (operator.start_dither,),
    cmd.StopDither: (dither.on_stop, acquisition.on_dither_stop, measurement.on_dither_stop),
    cmd.Measure: (measurement.measure,),
    cmd.GiveUp: (measurement.give_up_on_command,),
    cmd.MeasureNoisy: (measurement.measure_noisy,),
    cmd.AcknowledgeAlarm: (alarm_records.acknowledge,),
    cmd.MuteAlarm: (alarm_records.mute,),
    cmd.UnmuteAlarm: (alarm_records.unmute,),
    cmd.Refit: (operator.refit,),
    cmd.Approve: (operator.approve,),
    cmd.Reject: (operator.reject,),
    cmd.Publish: (operator.publish,),
    cmd.Rollback: (operator.roll_back,),
    cmd.LoadShape: (references.load_shape,),
    cmd.ClearShape: (references.clear_shape,),
    cmd.ApproveReferences: (references.approve,),
    cmd.RejectReferences: (references.reject,),
    cmd.RollBackReferences: (references.roll_back,),
}
"""Functions of context and event that update the state for each kind of event and command."""

ANSWERS: Final[Reactions] = {
    wire.DitherRequest: (
        dither.on_answer,
        acquisition.on_dither_answer,
        measurement.on_dither_answer,
    ),
    wire.DitherStop: (dither.on_stop_answer,),
    wire.MeasureRequest: (measurement.on_answer,),
    wire.OffloadRequest: (offload.on_answer,),
    wire.LoopRequest: (rtc.on_loop_answer, operator.on_loop_answer, acquisition.on_loop_answer),
    wire.RampRequest: (operator.on_loop_answer,),
    wire.ReferencesRequest: (references.on_answer,),
}
"""Functions of context, request and reply for each kind of request that the RTC has answered."""

FAILURES: Final[Reactions] = {
    ev.MakeMatrix: (operator.on_refit_failed, reconstructors.on_making_failed, rtc.fail_order),
    ev.RepublishMatrix: (reconstructors.on_making_failed, rtc.fail_order, probation.on_copy_failed),
    ev.JudgeMatrix: (reconstructors.on_judging_failed, rtc.log_failure),
    ev.JudgeProposal: (reconstructors.on_judging_failed, rtc.fail_order),
    ev.SendMatrix: (rtc.on_modes_unknown, reconstructors.on_send_failed, rtc.log_failure),
    ev.FetchMatrix: (reconstructors.on_fetch_failed, rtc.log_failure),
    ev.FetchReferences: (rtc.log_failure,),
    ev.FinishNoisy: (measurement.on_finish_failed,),
    ev.MakeReferences: (references.on_making_failed, rtc.log_failure),
    ev.SendReferences: (references.on_sending_failed,),
    wire.DitherRequest: (dither.on_failure, rtc.fail_order, measurement.on_dither_failed),
    wire.DitherStop: (rtc.log_failure,),
    wire.MeasureRequest: (measurement.on_failure,),
    wire.OffloadRequest: (offload.on_failure,),
    wire.LoopRequest: (
        rtc.on_modes_unknown,
        operator.on_loop_failed,
        acquisition.on_loop_failed,
    ),
    wire.RampRequest: (operator.on_loop_failed,),
    wire.ReferencesRequest: (rtc.log_failure,),
}
"""Functions of context, effect and text for each kind of effect, or request, that has failed."""


def not_measuring(context: StepContext) -> bool:
    """Return True unless the RTC measures a matrix, whose open loop nothing may disturb."""
    return context.state.measuring is None


def not_stopped(context: StepContext) -> bool:
    """Return True unless everything is stopped: then nothing is sent or played."""
    return not context.operator.stopped_because


def not_acquiring(context: StepContext) -> bool:
    """Return True unless an acquisition is under way: updates follow α, which it determines."""
    return not context.acquisition.under_way


def no_noisy_matrix_waits(context: StepContext) -> bool:
    """Return True unless a noisy matrix waits for a dither to end: until then none begins."""
    noisy = context.state.noisy_measurement
    return noisy is None or noisy.state is not MeasureState.WAITING


def may_ask(context: StepContext) -> bool:
    """Return True if an RTC is there, and no alarm forbids to ask anything of it."""
    return context.rtc is not None and context.blocking_alarm(Interlock.ASK) is None


def may_decide(context: StepContext) -> bool:
    """Return True unless a gain ramp changes the loop, or an alarm forbids to decide."""
    ramp = running_ramp(context.state, context.now_ns)
    return ramp is None and context.blocking_alarm(Interlock.DECIDE) is None


class Decider(NamedTuple):
    """A decision that is made after every event, where all guards hold."""

    name: str
    guards: tuple[Callable[[StepContext], bool], ...]
    decide: Callable[[StepContext], None]


_UNDISTURBED: Final = (not_measuring, not_acquiring, no_noisy_matrix_waits, may_ask)
_READY: Final = (*_UNDISTURBED, not_stopped, may_decide)

DECIDERS: Final = (
    Decider("a restored α", (), resume.drop_unconfirmed),
    Decider("the pointing law", (), pointing_law.follow_law),
    Decider("windows in a row", (), window_processing.reset_run),
    Decider("the probation", (), probation.advance),
    # Before all that an alarm forbids: a reaction may have raised one.
    Decider("alarms", (), derive_alarms),
    Decider("the RTC's matrix", (not_measuring, may_ask), updates.fetch_in_use),
    Decider("references in use", (not_measuring, may_ask), references.read_back),
    Decider("the acquisition", (not_measuring, not_stopped), acquisition.advance),
    Decider(
        "a noisy matrix", (not_measuring, not_stopped, not_acquiring), measurement.advance_noisy
    ),
    # Also while everything is stopped, and before another dither is chosen.
    Decider("unwanted dithers", _UNDISTURBED, dither.stop_unwanted),
    Decider("the dither", _READY, dither.choose_dither),
    Decider("reconstructors", _READY, updates.decide_updates),
    Decider("references", _READY, references.decide_references),
    Decider("the offload", _READY, offload.request_offload),
    Decider("alarms of what was decided", (), derive_alarms),
)
"""Decisions in the order in which they are made.

None of them knows the event. Guards see the state as the deciders before have left it.
"""
