"""The stages of an acquisition that close the loop: on few modes first, then on more."""

from __future__ import annotations

from dataclasses import replace

from service import events as ev
from service.control.edge import FORGIVING_LEAK
from service.reactions.acquisition_ends import again, entered, fail, told
from service.reactions.acquisition_plan import gains_for
from service.reactions.alarms import Act, forbidding
from service.reactions.dither_schedule import choose_dither
from service.reactions.journal import logged, without_alarm
from service.reactions.matrices import Step, send, why_unsendable
from service.reactions.mode_ladder import fewer_than
from service.reactions.policy import SECOND_NS, Policy
from service.reactions.shelf import with_state
from service.reactions.verdicts import why_worthless
from service.reactions.worth import moved
from service.state import (
    Acquisition,
    AcquisitionStage,
    MatrixState,
    ReconstructorRecord,
    RtcView,
    TrackerState,
)

ENOUGH_WINDOWS = 2
"""Ordinary windows that must have held with the last reconstructor."""

_LOST = (MatrixState.REJECTED, MatrixState.FAILED)


def closed_stage(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Make, send, close; then let ordinary windows sharpen α and go on to more modes."""
    acquisition = state.acquisition
    record = state.reconstructor(acquisition.matrix) if acquisition.matrix else None
    if record is not None and record.state in _LOST:
        return again(state, f"{record.id} was not applied: {record.reason}", now_ns)
    if acquisition.stage is AcquisitionStage.WIDENING:
        return _widened(state, rtc, record, policy, now_ns)
    if record is None:
        if acquisition.command is not None and rtc.leak > FORGIVING_LEAK:
            return state, ()
        return _make(state, acquisition.n_modes, rtc, now_ns)
    if rtc.cm_id != record.id:
        return state, ()
    if rtc.loop == "open":
        if acquisition.command is not None:
            return state, ()
        return told(state, ev.SetLoop(closed=True), now_ns)
    acquisition = replace(acquisition, applied=record.id, windows=state.windows_accepted)
    state = replace(state, acquisition=acquisition)
    text = f"closed on {record.n_modes} modes: sharpening the registration"
    return entered(state, AcquisitionStage.WIDENING, text, now_ns), ()


def on_made(state: TrackerState, made: ev.MatrixMade, now_ns: int) -> Step:
    """Send a reconstructor that has passed the gate, with the gains it was judged with."""
    record, acquisition, rtc = made.record, state.acquisition, state.rtc
    if acquisition.stage not in {AcquisitionStage.PARTIAL, AcquisitionStage.WIDENING}:
        return state, ()
    if record.state is MatrixState.REFUSED:
        return _refused(state, record, now_ns)
    found = acquisition.found
    if rtc is None or found is None:
        return again(state, f"{record.id} cannot be sent: no RTC is there", now_ns)
    gains = gains_for(found, record.n_modes, rtc.n_modes)
    stale = why_worthless(state, record.judged, gains[: record.n_modes])
    if stale is not None:
        state = with_state(state, record.id, MatrixState.DISCARDED, f"while it was made, {stale}")
        return logged(state, "reconstructor.discarded", f"{record.id}: {stale}", now_ns), ()
    reason = why_unsendable(state, record)
    if reason is not None:
        return again(state, f"{record.id} cannot be sent: {reason}", now_ns)
    state, _ = send(state, record.id, now_ns)
    acquisition = replace(
        acquisition, matrix=record.id, n_modes=record.n_modes, sent=True, command=None
    )
    if acquisition.stage is AcquisitionStage.WIDENING and record.n_modes < (made.asked_modes or 0):
        acquisition = replace(acquisition, most_modes=record.n_modes)
    effect = ev.SendMatrix(id=record.id, n_modes=record.n_modes, gains=gains)
    return replace(state, acquisition=acquisition), (effect,)


def _refused(state: TrackerState, record: ReconstructorRecord, now_ns: int) -> Step:
    """With the loop closed be content with the modes there are; else try a leak for the edge."""
    acquisition, gate, rtc = state.acquisition, record.gate, state.rtc
    if acquisition.stage is AcquisitionStage.WIDENING:
        acquisition = replace(acquisition, most_modes=acquisition.n_modes)
        return replace(state, acquisition=acquisition), ()
    slippery = gate is not None and gate.edge_motion_m is not None
    if slippery and rtc is not None and rtc.leak > FORGIVING_LEAK:
        text = f"a leak of {FORGIVING_LEAK} is to keep the outer ring in place"
        state = logged(state, "acquisition.leak", text, now_ns)
        return told(state, ev.SetLoop(leak=FORGIVING_LEAK), now_ns)
    reason = gate.reason if gate is not None else record.reason
    return fail(state, f"no number of modes passes the gate: {reason}", now_ns)


def _widened(
    state: TrackerState,
    rtc: RtcView,
    record: ReconstructorRecord | None,
    policy: Policy,
    now_ns: int,
) -> Step:
    acquisition = state.acquisition
    slipped = forbidding(state, Act.HOLD)
    if slipped is not None:
        text = f"{slipped.name} with {acquisition.n_modes} modes"
        return again(state, text, now_ns, slipped=True)
    if rtc.loop == "open":
        return again(state, "somebody opened the loop", now_ns)
    doubted = state.registration is not None and bool(state.registration.doubt)
    waiting = doubted or state.making_since_ns_utc is not None
    if record is None or rtc.cm_id != record.id or waiting:
        return choose_dither(state, rtc, policy, now_ns)
    if record.applied_frame_seq is not None and acquisition.applied != record.id:
        acquisition = replace(acquisition, applied=record.id, windows=state.windows_accepted)
        state = replace(state, acquisition=acquisition)
    seen = state.windows_accepted - acquisition.windows
    goal = _goal(acquisition)
    if seen >= 1 and (record.n_modes < goal or moved(state, record, policy)):
        return _make(state, goal, rtc, now_ns, at_least=record.n_modes)
    if seen >= ENOUGH_WINDOWS:
        return _done(state, record, now_ns), ()
    return choose_dither(state, rtc, policy, now_ns)


def _make(
    state: TrackerState, n_modes: int, rtc: RtcView, now_ns: int, *, at_least: int = 0
) -> Step:
    """Ask for a reconstructor of so many modes, or fewer but more than ``at_least``."""
    found = state.acquisition.found
    if state.making_since_ns_utc is not None or found is None or now_ns < state.retries.make_ns_utc:
        return state, ()
    effect = ev.MakeMatrix(
        n_modes=n_modes,
        why=f"acquisition: {n_modes} modes",
        gains=gains_for(found, n_modes, rtc.n_modes),
        fewer=tuple(rung for rung in fewer_than(n_modes) if rung > at_least),
    )
    return replace(state, making_since_ns_utc=now_ns), (effect,)


def _goal(acquisition: Acquisition) -> int:
    goal = acquisition.n_modes if acquisition.found is None else acquisition.found.n_controlled
    return goal if acquisition.most_modes is None else min(goal, acquisition.most_modes)


def _done(state: TrackerState, record: ReconstructorRecord, now_ns: int) -> TrackerState:
    acquisition = state.acquisition
    goal = acquisition.found.n_controlled if acquisition.found is not None else record.n_modes
    took_s = (now_ns - acquisition.started_ns_utc) / SECOND_NS
    of_goal = "" if record.n_modes >= goal else f" of {goal}"
    text = f"tracking after {took_s:.0f} s, {record.n_modes}{of_goal} modes controlled"
    state = entered(state, AcquisitionStage.TRACKING, text, now_ns)
    return without_alarm(state, "acquisition", now_ns)
