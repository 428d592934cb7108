"""How one event changes what the service knows, and what is then to be done.

``step`` is a function of state, event and time alone: no clock, no files, no link. A recorded
night therefore replays exactly, and every reaction of the service can be tested as a value.
"""

from __future__ import annotations

from service.tracking import (
    alarms,
    attention,
    dither,
    evidence,
    measuring,
    operator,
    probation,
    reconstructors,
    rtc,
    rules,
    stopping,
)
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.acquisition import abort_on_command, acquire, acquire_on_command
from service.tracking.activity import refuse_if_occupied
from service.tracking.commands import Command
from service.tracking.events import Effect, Event
from service.tracking.loop import CommandState
from service.tracking.policy import Policy
from service.tracking.state import TrackerState
from service.tracking.turn import Turn
from service.tracking.updates import decide, fetch_in_use
from service.tracking.validity import age, end_alarm, point
from service.tracking.worth import note_declined
from service.wire import (
    Acknowledgement,
    DitherRequest,
    DitherStop,
    LoopRequest,
    MeasureRequest,
    RampRequest,
    Reply,
    Status,
)
from service.wire import Command as Request

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
    refuse_if_occupied(state, event, now_ns)
    turn = Turn(state, event, policy, now_ns)
    rules.judge(turn)
    measuring.watch_measurement(turn)
    _react(turn)
    probation.follow(turn)
    rules.judge(turn)
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
        stopping.keep_stopped(turn)
        return
    acquire(turn)
    if turn.acquisition.under_way:
        return
    measuring.follow_noisy(turn)
    if not measuring.awaits_its_dither(turn.state):
        decide(turn)


def _react(turn: Turn) -> None:  # noqa: C901 - one line for each event
    match turn.event:
        case ev.Tick():
            rtc.on_tick(turn)
            age(turn)
            operator.close_again(turn)
        case Status() as status:
            rtc.on_status(turn, status)
        case ev.SessionStarted(session=session):
            rtc.on_new_session(turn, session)
        case ev.RtcVanished():
            rtc.on_vanished(turn)
        case ev.ServicesMet() as met:
            rtc.on_services(turn, met)
        case ev.Trouble(name=name, over=True, t_ns_utc=t_ns):
            end_alarm(turn, name, t_ns)
        case ev.Trouble(name=alarms.MIRROR_SILENT, text=text):
            dither.stop_unanswered(turn, text)
        case ev.Trouble(name=name, text=text):
            turn.alarm(name, text)
        case ev.Noted(name=name, text=text, level=level):
            turn.log(name, text, level)
        case ev.FarFitted():
            pass  # an acquisition's
        case ev.WindowFitted() if turn.state.measuring is not None:
            evidence.refuse_window(turn, measuring.MEASURING)
        case ev.WindowFitted(estimate=estimate) as fitted:
            evidence.on_window(turn, fitted)
            dither.learn(turn, estimate)
        case ev.WindowLost(refused=refused):
            evidence.refuse_window(turn, refused.reason, mistold=refused.mistold)
        case ev.Watched() as watched:
            evidence.on_watchdog(turn, watched)
        case ev.Unwatched(text=text):
            evidence.cannot_watch(turn, text)
        case _:
            _react_to_answer(turn)


def _react_to_answer(turn: Turn) -> None:  # noqa: C901 - one line for each event
    match turn.event:
        case ev.MatrixMade(record=made) if turn.acquisition.under_way:
            reconstructors.propose(turn, made)
        case ev.MatrixMade() as event if probation.is_way_back(turn.state, event):
            probation.go_back(turn, event)
        case ev.MatrixMade() as event:
            reconstructors.on_matrix(turn, event)
        case ev.MatrixFetched(record=fetched):
            reconstructors.on_fetched(turn, fetched)
        case ev.MarginJudged() as judged:
            reconstructors.on_margin(turn, judged)
        case ev.ProposalJudged() as verdict:
            reconstructors.on_proposal_judged(turn, verdict)
        case Acknowledgement() as acknowledged:
            reconstructors.on_acknowledgement(turn, acknowledged)
        case ev.MatrixMeasured(record=measured):
            measuring.on_measured(turn, measured)
        case ev.Answered() as answered:
            _react_to_reply(turn, answered.request, answered.reply)
        case ev.DitherSilent() as silent:
            dither.on_silence(turn, silent)
        case ev.DitherMeasured() as heard:
            loud = dither.why_too_strong(turn, heard)
            if loud is not None:
                measuring.cut_off(turn, f"its dither was too strong: {heard.text}")
                dither.stop_too_strong(turn, heard.id, loud)
        case ev.Compared() as event:
            probation.on_compared(turn, event)
        case ev.Vibrations() as vibrations:
            rtc.hear_vibrations(turn, vibrations)
        case ev.JobFailed() as failed:
            _react_to_failure(turn, failed.effect, failed.text)
        case _:
            _obey(turn)


def _react_to_reply(turn: Turn, request: Request, reply: Reply) -> None:
    match request:
        case DitherRequest():
            dither.on_answer(turn, request, reply)
        case DitherStop():
            dither.on_stop_answer(turn, reply)
        case MeasureRequest():
            measuring.on_answer(turn, request, reply)
        case LoopRequest() | RampRequest():
            outcome = CommandState.ACCEPTED if reply.accepted else CommandState.REFUSED
            operator.on_loop_answer(turn, request.id, outcome, reply.reason)


def _react_to_failure(turn: Turn, effect: Effect, text: str) -> None:
    match effect:
        case ev.Ask(request=MeasureRequest(id=name)):
            measuring.fail_by_id(turn, name, text)
        case ev.FinishNoisy(record=noisy):
            measuring.fail(turn, noisy, text)
        case ev.Ask(request=LoopRequest(id=command) | RampRequest(id=command)):
            operator.on_loop_answer(turn, command, CommandState.FAILED, text)
        case _:
            rtc.on_failure(turn, effect, text)


def _obey(turn: Turn) -> None:  # noqa: C901 - one line for each command
    match turn.event:
        case cmd.SetMode(mode=mode):
            operator.set_mode(turn, mode)
        case cmd.SetPointing(pointing=pointing):
            point(turn, pointing)
        case cmd.SetValue() as command:
            rules.tell(turn, command)
        case cmd.SetLoop() as command:
            operator.set_loop(turn, command)
        case cmd.Ramp() as command:
            operator.ramp(turn, command)
        case cmd.StopEverything() as command:
            stopping.stop(turn, command)
        case cmd.Resume() as command:
            stopping.resume(turn, command)
        case cmd.Acquire():
            acquire_on_command(turn)
        case cmd.AbortAcquisition():
            abort_on_command(turn)
        case cmd.StartDither() as command:
            operator.start_dither(turn, command)
        case cmd.StopDither():
            dither.stop_by_operator(turn)
        case cmd.Measure() as command:
            measuring.measure(turn, command)
        case cmd.GiveUp(id=name):
            measuring.give_up(turn, name)
        case cmd.MeasureNoisy() as command:
            measuring.measure_noisy(turn, command)
        case cmd.AcknowledgeAlarm() as command:
            attention.acknowledge(turn, command)
        case cmd.MuteAlarm() as command:
            attention.mute(turn, command)
        case cmd.UnmuteAlarm() as command:
            attention.unmute(turn, command)
        case _:
            _obey_about_matrices(turn)


def _obey_about_matrices(turn: Turn) -> None:
    match turn.event:
        case cmd.Refit(n_modes=n_modes):
            operator.refit(turn, n_modes)
        case cmd.Approve(id=name):
            operator.approve(turn, name)
        case cmd.Reject(id=name, reason=reason):
            operator.reject(turn, name, reason)
        case cmd.Publish(id=name):
            operator.publish(turn, name)
        case cmd.Rollback():
            operator.roll_back(turn)
        case _:
            raise TypeError(f"an event the tracker does not know: {turn.event!r}")
