"""How an acquisition goes from stage to stage, begins anew, and ends."""

from __future__ import annotations

from dataclasses import replace

from service import events as ev
from service.reactions.acquisition_plan import left_open
from service.reactions.alarms import Act, forbidding
from service.reactions.evidence import voided
from service.reactions.journal import logged, with_alarm
from service.reactions.loop import on_loop
from service.reactions.matrices import Step
from service.reactions.mode_ladder import half_of, limited
from service.state import AcquisitionStage, Level, LoopFound, TrackerState

MOST_ATTEMPTS = 3
"""Times the loop is opened for one acquisition."""

HELD_OFF = (
    "; none begins by itself until windows agree in a closed loop, the mode is set anew, or one is "
    "asked for"
)
"""After an operator ended one, in the text of it."""

_BELIEVED = (
    AcquisitionStage.PARTIAL,
    AcquisitionStage.WIDENING,
    AcquisitionStage.INTERRUPTED,
)
"""Stages in which α, where there is one, has been found by this acquisition."""


def entered(state: TrackerState, stage: AcquisitionStage, text: str, now_ns: int) -> TrackerState:
    """Return the state at the beginning of a stage."""
    acquisition = replace(
        state.acquisition, stage=stage, text=text, since_ns_utc=now_ns, misses=0, command=None
    )
    level = Level.WARNING if stage is AcquisitionStage.FAILED else Level.INFO
    state = replace(state, acquisition=acquisition)
    return logged(state, f"acquisition.{stage}", text, now_ns, level)


def told(state: TrackerState, command: ev.SetLoop, now_ns: int) -> Step:
    """Tell the RTC to change its loop, and remember that it was told."""
    state, effects = on_loop(state, command, now_ns)
    asked = state.loop_command
    acquisition = replace(state.acquisition, command=None if asked is None else asked.id)
    return replace(state, acquisition=acquisition), effects


def without_dither(state: TrackerState) -> Step:
    """Stop the dither that runs, if one does; nobody takes it for a dither to be adopted."""
    running = state.dither.id if state.dither is not None else None
    if running is None and state.rtc is not None:
        running = state.rtc.dither_id
    if running is None:
        return state, ()
    dithering = replace(state.dithering, stopped_id=running)
    return replace(state, dither=None, dithering=dithering), (ev.AskNoDither(),)


def again(state: TrackerState, reason: str, now_ns: int, *, slipped: bool = False) -> Step:
    """Begin anew with the loop opened again, at once, a few times; then give up.

    A loop that has slipped is closed on half as many modes next time.
    """
    acquisition = state.acquisition
    if acquisition.attempt >= MOST_ATTEMPTS:
        return fail(state, f"{reason}, after {acquisition.attempt} attempts", now_ns)
    most = acquisition.most_modes
    if slipped:
        most = half_of(acquisition.n_modes)
        state = limited(state, most, reason, now_ns)
    goal = acquisition.n_modes if acquisition.found is None else acquisition.found.n_controlled
    state, effects = without_dither(voided(state, "the acquisition had not begun anew"))
    state = replace(
        state,
        registration=None,
        acquisition=replace(
            acquisition,
            attempt=acquisition.attempt + 1,
            alpha=None,
            covariance=None,
            matrix=None,
            most_modes=most,
            n_modes=min(acquisition.n_modes, most or goal),
        ),
    )
    state = entered(state, AcquisitionStage.OPENING, f"opening the loop again: {reason}", now_ns)
    if state.rtc is None or state.rtc.loop == "open":
        return state, effects
    state, more = told(state, ev.SetLoop(closed=False), now_ns)
    return state, (*effects, *more)


def fail(state: TrackerState, reason: str, now_ns: int) -> Step:
    """Give up: the loop stays as it is, but one that is out of hand is opened."""
    closed = state.rtc is not None and state.rtc.loop != "open"
    out_of_hand = forbidding(state, Act.HOLD) is not None
    state, effects = without_dither(state)
    over = replace(state.acquisition, windows=state.windows_accepted)
    state = replace(state, registration=None, acquisition=over)
    if closed and out_of_hand:
        state, more = told(state, ev.SetLoop(closed=False), now_ns)
        effects = (*effects, *more)
    text = (
        f"no registration was acquired: {reason}; see the log, then acquire again, or close the "
        "loop on a matrix of your own"
    )
    state = entered(state, AcquisitionStage.FAILED, text, now_ns)
    return with_alarm(state, "acquisition", text, now_ns), effects


def abort(state: TrackerState, why: str, now_ns: int, *, held_off: bool = False) -> Step:
    """End it at once: the loop as it was found, if it held then and nothing was sent; else as is.

    As is means open, or closed on a reconstructor that has passed the gate. ``held_off``: none
    begins by itself for now, though what made this one begin may last.
    """
    acquisition = state.acquisition
    state, effects = without_dither(state)
    if acquisition.stage not in _BELIEVED:
        state = replace(state, registration=None)
    left, found = "left as it is", _to_give_back(state)
    if found is not None:
        left = "closed as it was found"
        state, more = told(state, ev.SetLoop(closed=True, leak=found.leak), now_ns)
        effects = (*effects, *more)
    text = f"ended {why}; the loop is {left}{HELD_OFF if held_off else ''}"
    over = replace(state.acquisition, held_off=held_off, windows=state.windows_accepted)
    state = replace(state, acquisition=over)
    return entered(state, AcquisitionStage.ABORTED, text, now_ns), effects


def _to_give_back(state: TrackerState) -> LoopFound | None:
    """Return the loop as it was found, if it held then and its matrix is still in the RTC."""
    acquisition, rtc = state.acquisition, state.rtc
    found = acquisition.found
    if rtc is None or found is None or acquisition.sent or not (found.closed and found.held):
        return None
    if acquisition.interruption is not None and left_open(state, rtc) is None:
        return None
    return found
