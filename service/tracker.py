"""How one event changes what the service knows, and what is then to be done.

``step`` is a function of state, event and time alone: no clock, no files, no link. A recorded
night therefore replays exactly, and every reaction of the service can be tested as a value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from service.tracking import (
    acquisition,
    alarms,
    attention,
    dither,
    evidence,
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
)
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.commands import Command
from service.tracking.events import Effect, Event
from service.tracking.loop import CommandState
from service.tracking.policy import Policy
from service.tracking.state import TrackerState
from service.tracking.turn import Turn
from service.tracking.updates import decide, fetch_in_use
from service.tracking.worth import note_declined
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
        If it names a reconstructor nobody has heard of.
    """
    if isinstance(event, Command):
        interlocks.require(state, event, policy, now_ns)
    turn = Turn(state, event, policy, now_ns)
    attention.judge_rules(turn)
    measuring.watch_measurement(turn)
    REACTIONS[type(event)](turn, event)
    probation.follow(turn)
    attention.judge_rules(turn)
    note_declined(turn)
    _go_on(turn)
    attention.follow(turn)
    return turn.state, tuple(turn.effects)


def _go_on(turn: Turn) -> None:
    """Let what runs go on, and decide what else is wanted: what has the mirror comes first."""
    if turn.state.measuring is not None:
        return
    fetch_in_use(turn)
    if turn.state.stopped_because:
        resume.keep_stopped(turn)
        return
    acquisition.acquire(turn)
    if turn.acquisition.under_way:
        return
    measuring.follow_noisy(turn)
    if not measuring.awaits_its_dither(turn.state):
        decide(turn)
        offload.demand(turn)


def _on_tick(turn: Turn, _: ev.Tick) -> None:
    rtc.on_tick(turn)
    validity.age(turn)
    refusals.follow(turn)
    operator.close_again(turn)


def _on_trouble(turn: Turn, trouble: ev.Trouble) -> None:
    if trouble.over:
        validity.end_alarm(turn, trouble.name, trouble.t_ns_utc)
    elif trouble.name == alarms.MIRROR_SILENT:
        dither.stop_unanswered(turn, trouble.text)
    else:
        turn.alarm(trouble.name, trouble.text)


def _on_window(turn: Turn, event: ev.WindowFitted) -> None:
    if turn.state.measuring is not None:
        evidence.refuse_window(turn, measuring.MEASURING)
        return
    mode_proof.learn(turn, event.estimate)
    evidence.on_window(turn, event)
    dither.learn(turn, event.estimate)


def _on_made(turn: Turn, made: ev.MatrixMade) -> None:
    if turn.acquisition.under_way:
        reconstructors.propose(turn, made.record)
    elif probation.is_way_back(turn.state, made):
        probation.go_back(turn, made)
    else:
        reconstructors.on_matrix(turn, made)


def _on_dither_measured(turn: Turn, heard: ev.DitherMeasured) -> None:
    loud = dither.why_too_strong(turn, heard)
    if loud is not None:
        measuring.cut_off(turn, f"its dither was too strong: {heard.text}")
        dither.stop_too_strong(turn, heard.id, loud)


def _on_answer(turn: Turn, answered: ev.Answered) -> None:
    reply = answered.reply
    match answered.request:
        case DitherRequest() as request:
            dither.on_answer(turn, request, reply)
        case DitherStop():
            dither.on_stop_answer(turn, reply)
        case MeasureRequest() as request:
            measuring.on_answer(turn, request, reply)
        case OffloadRequest() as request:
            offload.on_answer(turn, request, reply)
        case LoopRequest() | RampRequest() as request:
            outcome = CommandState.ACCEPTED if reply.accepted else CommandState.REFUSED
            operator.on_loop_answer(turn, request.id, outcome, reply.reason)


def _on_failure(turn: Turn, failed: ev.JobFailed) -> None:
    match failed.effect:
        case ev.Ask(request=MeasureRequest(id=name)):
            measuring.fail(turn, turn.state.measurement(name), failed.text)
        case ev.Ask(request=OffloadRequest(id=name)):
            offload.on_failure(turn, name, failed.text)
        case ev.FinishNoisy(record=noisy):
            measuring.fail(turn, noisy, failed.text)
        case ev.Ask(request=LoopRequest(id=name) | RampRequest(id=name)):
            operator.on_loop_answer(turn, name, CommandState.FAILED, failed.text)
        case effect:
            rtc.on_failure(turn, effect, failed.text)


REACTIONS: Final[dict[type, Callable[[Turn, Any], object]]] = {
    ev.Tick: _on_tick,
    Status: rtc.on_status,
    ev.SessionStarted: rtc.on_new_session,
    ev.RtcVanished: rtc.on_vanished,
    ev.ServicesMet: rtc.on_services,
    ev.Trouble: _on_trouble,
    ev.Noted: lambda turn, noted: turn.log(noted.name, noted.text, noted.level),
    ev.FarFitted: lambda _turn, _event: None,  # an acquisition's
    ev.WindowFitted: _on_window,
    ev.WindowLost: evidence.on_lost,
    ev.Watched: evidence.on_watchdog,
    ev.Unwatched: lambda turn, unwatched: evidence.cannot_watch(turn, unwatched.text),
    ev.MatrixMade: _on_made,
    ev.MatrixFetched: reconstructors.on_fetched,
    ev.ModesRecognised: mode_proof.recognise,
    ev.MarginJudged: reconstructors.on_margin,
    ev.ProposalJudged: reconstructors.on_proposal_judged,
    Acknowledgement: reconstructors.on_acknowledgement,
    ev.MatrixMeasured: lambda turn, measured: measuring.on_measured(turn, measured.record),
    ev.Answered: _on_answer,
    ev.DitherSilent: dither.on_silence,
    ev.DitherMeasured: _on_dither_measured,
    ev.Compared: probation.on_compared,
    ev.LoopHeld: rtc.hear_loop,
    ev.Vibrations: rtc.hear_vibrations,
    ev.JobFailed: _on_failure,
    cmd.SetMode: operator.set_mode,
    cmd.SetPointing: lambda turn, command: validity.point(turn, command.pointing),
    cmd.SetValue: attention.tell_value,
    cmd.SetLoop: operator.set_loop,
    cmd.Ramp: operator.ramp,
    cmd.StopEverything: resume.stop,
    cmd.Resume: resume.release,
    cmd.Acquire: acquisition.acquire_on_command,
    cmd.AbortAcquisition: acquisition.abort_on_command,
    cmd.StartDither: operator.start_dither,
    cmd.StopDither: dither.stop_by_operator,
    cmd.Measure: measuring.measure,
    cmd.GiveUp: lambda turn, command: measuring.give_up(turn, command.id),
    cmd.MeasureNoisy: measuring.measure_noisy,
    cmd.AcknowledgeAlarm: attention.acknowledge,
    cmd.MuteAlarm: attention.mute,
    cmd.UnmuteAlarm: attention.unmute,
    cmd.Refit: operator.refit,
    cmd.Approve: operator.approve,
    cmd.Reject: operator.reject,
    cmd.Publish: operator.publish,
    cmd.Rollback: operator.roll_back,
}
"""What each event, and each command, does: there is one for every kind of either."""
