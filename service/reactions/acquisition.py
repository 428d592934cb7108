"""From nothing known to tracking: open, look from afar, confirm, close on few modes, widen.

Nothing is assumed of the registration. The loop is opened, for one that is closed far from
registration slips; smooth modes lead to α and other modes must confirm it; a reconstructor for as
many modes as the gate accepts everywhere in α ± 3σ closes the loop; then ordinary windows sharpen
α and more modes follow. What does not come true within its time begins anew with the loop opened
again, a few times, and then ends in a state that says why.
"""

from __future__ import annotations

from dataclasses import replace

from service import events as ev
from service.errors import CommandError
from service.events import Event
from service.reactions.acquisition_closed import closed_stage, on_made
from service.reactions.acquisition_ends import abort, again, fail, without_dither
from service.reactions.acquisition_far import far_stage, on_far, on_missed
from service.reactions.acquisition_over import forgotten
from service.reactions.acquisition_plan import begun, why_needed, why_not_now
from service.reactions.acquisition_restart import on_gap, taken_up
from service.reactions.activity import ramping
from service.reactions.alarms import Act, forbidding
from service.reactions.journal import logged, without_alarm
from service.reactions.matrices import Step
from service.reactions.mode_ladder import half_of, limited
from service.reactions.noisy import cut_off
from service.reactions.policy import SECOND_NS, Policy
from service.state import Acquisition, AcquisitionStage, Mode, TrackerState
from service.telemetry.faraway import NOT_FOUND

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
