"""Noisy interaction matrices: a random dither asked for, waited for, and what came of it.

The sums are kept where the telemetry comes in; here is only how far each is.
"""

from __future__ import annotations

from dataclasses import replace

from service import events as ev
from service.errors import CommandError, UnknownIdError
from service.events import Event
from service.reactions.dither_choice import total_m
from service.reactions.journal import logged
from service.reactions.matrices import Step
from service.reactions.policy import SECOND_NS, Policy
from service.reactions.random_dither import RANDOM_TOTAL_M, Asked, plan_random
from service.state import (
    DitherView,
    Level,
    NoisyRecord,
    NoisyState,
    RtcView,
    TrackerState,
)

NOISY_KEPT = 100

DURATION_S = 30.0
"""Where none is asked for: an element is worth its noise by then, on a bright star."""

FREE_WITHIN_S = 15.0
"""For the service's own dither to be gone from the RTC's status."""

MADE_WITHIN_S = 120.0
"""For the fit and the archive."""


def on_noisy(state: TrackerState, event: Event, policy: Policy, now_ns: int) -> Step:
    """Ask for a noisy interaction matrix, give one up, or note what came of it.

    Raises
    ------
    CommandError
        If none can be measured now, or the one to be given up is over.
    UnknownIdError
        If nobody has heard of the one to be given up.
    """
    match event:
        case ev.MeasureNoisy():
            return _ask(state, event, policy, now_ns)
        case ev.GiveUpNoisy(id=noisy_id):
            return _give_up(state, noisy_id, now_ns)
        case ev.NoisyMade(record=record):
            return _made(state, record, now_ns), ()
        case ev.JobFailed(effect=ev.FinishNoisy(record=record), text=text):
            return _failed(state, record, text, now_ns), ()
        case _:
            raise TypeError(f"no event of a noisy matrix: {event!r}")


def gather(state: TrackerState, event: Event, policy: Policy, now_ns: int) -> Step:
    """Go on with the one under way: start its dither, note that it plays, or that it is over."""
    record = state.gathering
    if record is None:
        return state, ()
    match record.state:
        case NoisyState.WAITING if isinstance(event, ev.StopDither):
            return cut_off(state, "the operator stopped the dither", now_ns), ()
        case NoisyState.WAITING:
            return _waiting(state, record, policy, now_ns)
        case NoisyState.ASKED | NoisyState.RUNNING:
            return _playing(state, record, event, now_ns)
        case _:
            return _overdue(state, record, now_ns), ()


def cut_off(state: TrackerState, why: str, now_ns: int) -> TrackerState:
    """Return the state without the one under way, which has lost its dither."""
    record = state.gathering
    return state if record is None else _failed(state, record, why, now_ns)


def awaits_its_dither(state: TrackerState) -> bool:
    """Return whether another dither has to end first: until then the service begins none."""
    record = state.gathering
    return record is not None and record.state is NoisyState.WAITING


def _ask(state: TrackerState, command: ev.MeasureNoisy, policy: Policy, now_ns: int) -> Step:
    rtc = _ready(state, command)
    duration_s, budget_m = command.duration_s or DURATION_S, policy.dither_budget_m
    total = command.total_m or min(RANDOM_TOTAL_M, budget_m)
    if total > budget_m * (1.0 + 1e-9) and not command.over_budget:
        raise CommandError(
            f"noisy matrix: {1e9 * total:.3g} nm RMS in all, budget {1e9 * budget_m:.3g} nm; say "
            "over_budget if that is meant"
        )
    asked = Asked(id=command.id, modes=command.modes, total_m=total, duration_s=duration_s)
    dither = plan_random(asked, rtc, policy, now_ns)
    record = NoisyRecord(
        id=command.id,
        state=NoisyState.WAITING,
        modes=dither.modes,
        total_m=total_m(dither),
        duration_s=duration_s,
        window_s=dither.window_s or duration_s,
        seed=dither.seed or 0,
        asked_ns_utc=now_ns,
        basis_id=rtc.basis_id,
        config_id=rtc.config_id,
    )
    text = (
        f"{record.id}: {len(record.modes)} modes, {1e9 * record.total_m:.3g} nm RMS in all, "
        f"{duration_s:g} s"
    )
    state = logged(_with(state, record), "noisy-matrix.asked", text, now_ns)
    return _freed(state, record, rtc, policy, now_ns)


def _ready(state: TrackerState, command: ev.MeasureNoisy) -> RtcView:
    """Return the RTC, where it can play a dither now."""
    rtc = state.rtc
    if rtc is None or rtc.loop == "open":
        raise CommandError("noisy matrix: it needs an RTC with its loop closed")
    if state.noisy_matrix(command.id) is not None:
        text = f"{command.id} was measured before; ids are never reused"
        raise CommandError(f"noisy matrix: {text}")
    return rtc


def _freed(
    state: TrackerState, record: NoisyRecord, rtc: RtcView, policy: Policy, now_ns: int
) -> Step:
    """Stop the service's own dither, or, where none runs, begin."""
    own = state.dither
    if own is None and rtc.dither_id is None:
        return _begun(state, record, rtc, policy, now_ns)
    if own is not None:
        dithering = replace(state.dithering, stopped_id=own.id, ended_ns_utc=None)
        state = replace(state, dither=None, dithering=dithering)
    return state, (ev.AskNoDither(),)


def _waiting(state: TrackerState, record: NoisyRecord, policy: Policy, now_ns: int) -> Step:
    rtc = state.rtc
    if rtc is not None and rtc.loop != "open" and rtc.dither_id is None:
        return _begun(state, record, rtc, policy, now_ns)
    if now_ns - record.asked_ns_utc > FREE_WITHIN_S * SECOND_NS:
        text = f"the dither that ran did not end within {FREE_WITHIN_S:.0f} s"
        return _failed(state, record, text, now_ns), ()
    return state, ()


def _begun(
    state: TrackerState, record: NoisyRecord, rtc: RtcView, policy: Policy, now_ns: int
) -> Step:
    try:
        dither = plan_random(_asked(record), rtc, policy, now_ns)
    except CommandError as error:  # the RTC is another than when it was asked for
        return _failed(state, record, str(error), now_ns), ()
    record = replace(
        record,
        state=NoisyState.ASKED,
        window_s=dither.window_s or record.duration_s,
        seed=dither.seed or 0,
    )
    return replace(_with(state, record), dither=dither), (ev.AskDither(dither=dither),)


def _asked(record: NoisyRecord) -> Asked:
    return Asked(
        id=record.id, modes=record.modes, total_m=record.total_m, duration_s=record.duration_s
    )


def _playing(state: TrackerState, record: NoisyRecord, event: Event, now_ns: int) -> Step:
    match event:
        case ev.DitherAnswered(id=record.id, accepted=False, reason=reason):
            return _failed(state, record, f"the RTC refused the dither: {reason}", now_ns), ()
        case ev.JobFailed(effect=ev.AskDither(dither=DitherView(id=record.id)), text=text):
            return _failed(state, record, text, now_ns), ()
        case _:
            pass
    dither = state.dither
    if dither is None or dither.id != record.id:
        if record.state is NoisyState.ASKED:
            return _failed(state, record, "its dither never began", now_ns), ()
        record = replace(record, state=NoisyState.FINISHING)
        return _with(state, record), (ev.FinishNoisy(record=record),)
    if record.state is NoisyState.ASKED and dither.start_seq is not None:
        return _with(state, replace(record, state=NoisyState.RUNNING)), ()
    return state, ()


def _overdue(state: TrackerState, record: NoisyRecord, now_ns: int) -> TrackerState:
    longest_s = record.duration_s + FREE_WITHIN_S + MADE_WITHIN_S
    if now_ns - record.asked_ns_utc < 10.0 * longest_s * SECOND_NS:
        return state  # a simulated RTC may be ten times slower than its timestamps
    return _failed(state, record, "the worker did not answer", now_ns)


def _give_up(state: TrackerState, noisy_id: str, now_ns: int) -> Step:
    record = state.noisy_matrix(noisy_id)
    if record is None:
        raise UnknownIdError(f"noisy matrix {noisy_id}: nobody has heard of it")
    if not record.under_way:
        raise CommandError(f"{noisy_id} is {record.state}: there is nothing to give up")
    plays = state.dither is not None and state.dither.id == noisy_id
    record = replace(record, state=NoisyState.GIVEN_UP, reason="by the operator")
    state = logged(_with(state, record), "noisy-matrix.given-up", noisy_id, now_ns)
    if not plays:
        return state, ()
    return replace(state, dither=None), (ev.AskNoDither(),)


def _made(state: TrackerState, record: NoisyRecord, now_ns: int) -> TrackerState:
    known, found = state.noisy_matrix(record.id), record.finding
    if found is None or (known is not None and known.state is NoisyState.GIVEN_UP):
        return state
    text = f"{record.id}: {found.n_frames} frames, signal / noise of an element {found.snr:.2f}"
    return logged(_with(state, record), "noisy-matrix.stored", text, now_ns)


def _failed(state: TrackerState, record: NoisyRecord, text: str, now_ns: int) -> TrackerState:
    known = state.noisy_matrix(record.id)
    if known is not None and known.state is NoisyState.GIVEN_UP:
        return state
    state = _with(state, replace(record, state=NoisyState.FAILED, reason=text))
    return logged(state, "noisy-matrix.failed", f"{record.id}: {text}", now_ns, Level.WARNING)


def _with(state: TrackerState, record: NoisyRecord) -> TrackerState:
    others = tuple(r for r in state.noisy if r.id != record.id)
    return replace(state, noisy=(*others, record)[-NOISY_KEPT:])
