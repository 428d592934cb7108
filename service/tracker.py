"""How one event changes what the service knows, and what is then to be done.

``step`` is a function of state, event and time alone: no clock, no files, no link. A recorded
night therefore replays exactly, and every reaction of the service can be tested as a value.
"""

from __future__ import annotations

from dataclasses import replace

from service.tracking import events as ev
from service.tracking.acquisition import acquire, on_acquire
from service.tracking.activity import refuse_if_occupied
from service.tracking.alarms import logged, with_alarm
from service.tracking.dither import on_dither, on_measured, on_silence, on_vibrations
from service.tracking.dither_schedule import learnt
from service.tracking.events import Command, Event, Step
from service.tracking.loop_commands import close_again, on_loop
from service.tracking.measuring import (
    MEASURING,
    awaits_its_dither,
    gather,
    meanwhile,
    on_measurement,
    on_noisy,
)
from service.tracking.operator import on_command
from service.tracking.policy import Policy
from service.tracking.reconstructors import (
    on_acknowledgement,
    on_fetched,
    on_margin,
    on_matrix,
    on_proposal_judged,
    shelved,
)
from service.tracking.rtc import (
    on_failure,
    on_new_session,
    on_services,
    on_status,
    on_tick,
    on_vanished,
)
from service.tracking.state import TrackerState
from service.tracking.updates import decide
from service.tracking.validity import aged
from service.tracking.validity import over as ended
from service.tracking.windows import on_watchdog, on_window, refuse_window
from service.tracking.worth import declined

__all__ = ["Command", "Event", "Policy", "step"]


def step(state: TrackerState, event: Event, policy: Policy, now_ns: int) -> Step:
    """Return the next state and what is to be done.

    Raises
    ------
    CommandError
        If an operator's command cannot be carried out in this state; the state stands.
    UnknownIdError
        If it names a reconstructor nobody has heard of.
    """
    refuse_if_occupied(state, event, now_ns)
    before = state
    state, effects = _react(meanwhile(state, event, now_ns), event, policy, now_ns)
    state = declined(before, state, event, now_ns)
    if state.measuring is not None:
        return state, effects
    state, more = acquire(before, state, event, policy, now_ns)
    effects = (*effects, *more)
    if state.acquisition.under_way:
        return state, effects
    state, more = gather(state, event, policy, now_ns)
    effects = (*effects, *more)
    if awaits_its_dither(state):
        return state, effects
    state, more = decide(state, policy, now_ns)
    return state, (*effects, *more)


def _react(  # noqa: C901 - one line for each event
    state: TrackerState, event: Event, policy: Policy, now_ns: int
) -> Step:
    match event:
        case ev.Tick():
            return close_again(aged(on_tick(state, now_ns), policy, now_ns), now_ns)
        case ev.StatusSeen(rtc=rtc):
            return on_status(state, rtc, now_ns), ()
        case ev.SessionStarted(session=session):
            return on_new_session(state, session, now_ns), ()
        case ev.RtcVanished():
            return on_vanished(state, now_ns), ()
        case ev.ServicesMet():
            return on_services(state, event, now_ns), ()
        case ev.Trouble(name=name, text=text, over=over):
            if over:
                return ended(state, name, now_ns, event.t_ns_utc), ()
            return with_alarm(state, name, text, now_ns), ()
        case ev.Noted(name=name, text=text, level=level):
            return logged(state, name, text, now_ns, level), ()
        case ev.Measure() | ev.GiveUp() | ev.MatrixMeasured():
            return on_measurement(state, event, policy, now_ns)
        case ev.JobFailed(effect=ev.AskMeasurement()):
            return on_measurement(state, event, policy, now_ns)
        case ev.MeasureNoisy() | ev.GiveUpNoisy() | ev.NoisyMade():
            return on_noisy(state, event, policy, now_ns)
        case ev.JobFailed(effect=ev.FinishNoisy()):
            return on_noisy(state, event, policy, now_ns)
        case ev.SetLoop() | ev.Ramp() | ev.LoopAnswered():
            return on_loop(state, event, now_ns)
        case ev.JobFailed(effect=ev.AskLoop() | ev.AskRamp()):
            return on_loop(state, event, now_ns)
        case ev.Acquire() | ev.AbortAcquisition():
            return on_acquire(state, event, policy, now_ns)
        case ev.FarFitted():
            return state, ()
        case ev.MatrixMade(record=record) if state.acquisition.under_way:
            return shelved(state, record, now_ns), ()
        case ev.WindowFitted() if state.measuring is not None:
            return refuse_window(state, MEASURING, now_ns), ()
        case ev.WindowFitted(estimate=estimate):
            after = on_window(state, event, policy, now_ns)
            return learnt(state, after, estimate), ()
        case ev.WindowLost(refused=refused):
            return refuse_window(state, refused.reason, now_ns, mistold=refused.mistold), ()
        case ev.Vibrations():
            return on_vibrations(state, event, now_ns), ()
        case ev.Watched():
            return on_watchdog(state, event, policy, now_ns), ()
        case ev.Unwatched(text=text):
            return replace(state, unwatched=text), ()
        case _:
            return _react_to_matrices(state, event, policy, now_ns)


def _react_to_matrices(  # noqa: C901 - one line for each event
    state: TrackerState, event: Event, policy: Policy, now_ns: int
) -> Step:
    match event:
        case ev.MatrixMade():
            return on_matrix(state, event, now_ns)
        case ev.MatrixFetched(record=record):
            return on_fetched(state, record, now_ns), ()
        case ev.MarginJudged():
            return on_margin(state, event, now_ns), ()
        case ev.ProposalJudged():
            return on_proposal_judged(state, event, now_ns)
        case ev.Acknowledged():
            return on_acknowledgement(state, event, now_ns), ()
        case ev.DitherAnswered():
            return on_dither(state, event, now_ns), ()
        case ev.DitherSilent():
            return on_silence(state, event, now_ns), ()
        case ev.DitherMeasured():
            return on_measured(state, event, policy, now_ns)
        case ev.JobFailed(effect=effect, text=text):
            return on_failure(state, effect, text, now_ns), ()
        case _:
            return on_command(state, event, policy, now_ns)
