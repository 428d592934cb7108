"""What an operator asks for."""

from __future__ import annotations

from dataclasses import replace

from service.errors import CommandError
from service.tracking import events as ev
from service.tracking.alarms import logged
from service.tracking.dither import found_again, told_to_stop
from service.tracking.dither_plan import (
    ASKED_DITHER,
    RANDOM_TOTAL_M,
    Choice,
    RandomChoice,
    by_hand,
    plan_dither,
    plan_random,
    total_m,
    why_unusable,
)
from service.tracking.events import Event, Step
from service.tracking.loop import DitherKind, DitherView, RtcView
from service.tracking.policy import Policy
from service.tracking.products import MatrixState, ModeSet
from service.tracking.reconstructors import known_record, send_once_judged, with_state
from service.tracking.resume import with_mode
from service.tracking.state import Mode, TrackerState
from service.tracking.validity import pointed
from service.tracking.worth import outdated


def on_command(  # noqa: C901 - one line for each command
    state: TrackerState, event: Event, policy: Policy, now_ns: int
) -> Step:
    """Carry out an operator's command, or say why it cannot be.

    Raises
    ------
    CommandError
        If it makes no sense in this state.
    """
    match event:
        case ev.SetMode(mode=mode):
            return logged(with_mode(state, mode), "mode", f"mode is {mode}", now_ns), ()
        case ev.SetPointing(pointing=pointing):
            return pointed(state, pointing), ()
        case ev.StopDither():
            state = found_again(replace(state, dither=None, dither_stopped=True), now_ns)
            state = told_to_stop(state, now_ns)
            return logged(state, "dither.stopped", "by the operator", now_ns), (ev.AskNoDither(),)
        case ev.StartDither():
            return _start_dither(state, event, policy, now_ns)
        case ev.Refit(n_modes=n_modes):
            return _refit(state, n_modes, now_ns)
        case ev.Approve(id=matrix_id):
            return _approve(state, matrix_id, policy, now_ns)
        case ev.Reject(id=matrix_id, reason=reason):
            _proposed(state, matrix_id)
            state = with_state(state, matrix_id, MatrixState.DISCARDED, reason or "by the operator")
            return logged(state, "reconstructor.discarded", matrix_id, now_ns), ()
        case ev.Publish(id=matrix_id):
            _judgeable(state, matrix_id)
            return _copy(state, matrix_id, f"the operator publishes {matrix_id} again", now_ns)
        case ev.Rollback():
            return _rollback(state, now_ns)
        case _:
            raise TypeError(f"an event the tracker does not know: {event!r}")


def _approve(state: TrackerState, matrix_id: str, policy: Policy, now_ns: int) -> Step:
    """Send a proposal, judged anew where need be, unless α is no longer what it was made for."""
    _proposed(state, matrix_id)
    known = state.registration
    if known is not None and not known.usable:
        raise CommandError(f"{matrix_id} cannot be judged: α is invalid ({known.standing.reason})")
    if outdated(state, known_record(state, matrix_id)):
        raise CommandError(f"{matrix_id} was made for another α than the present one: refit")
    return send_once_judged(state, matrix_id, now_ns)


def _start_dither(state: TrackerState, event: ev.StartDither, policy: Policy, now_ns: int) -> Step:
    rtc = state.rtc
    if rtc is None or rtc.loop == "open":
        raise CommandError("a dither needs an RTC with its loop closed")
    dither = _planned_dither(event, by_hand(state, rtc, policy), rtc, policy, now_ns)
    found_nm, budget_nm = 1e9 * total_m(dither), 1e9 * policy.dither_budget_m
    cost = f"{found_nm:.3g} nm RMS in all, budget {budget_nm:.3g} nm"
    over = found_nm > budget_nm * (1.0 + 1e-9)
    if over and not event.over_budget:
        raise CommandError(f"dither: {cost}; say over_budget if that is meant")
    state = replace(state, dither=dither, dither_stopped=False)
    modes = f"modes {dither.modes}" if len(dither.modes) < 10 else f"{len(dither.modes)} modes"
    text = f"{dither.kind}, {modes}, {cost}" + (": over budget, as asked" if over else "")
    return logged(state, "dither.asked", text, now_ns), (ev.AskDither(dither=dither),)


def _planned_dither(
    event: ev.StartDither, choice: Choice, rtc: RtcView, policy: Policy, now_ns: int
) -> DitherView:
    """Return the dither to ask for.

    Raises
    ------
    CommandError
        If it could not be played, or not be read.
    """
    if event.kind is DitherKind.BINARY or isinstance(event.modes, ModeSet):
        asked = RandomChoice(
            id=f"{ASKED_DITHER}{now_ns}",
            modes=event.modes or ModeSet.CONTROLLED,
            total_m=event.total_m or min(RANDOM_TOTAL_M, policy.dither_budget_m),
            duration_s=event.duration_s or policy.dither_duration_s,
        )
        return plan_random(asked, rtc, policy, now_ns)
    dither = plan_dither(
        rtc,
        policy,
        now_ns,
        choice=choice,
        modes=event.modes,
        amplitude_m=event.amplitude_m,
        frequency_hz=event.frequency_hz,
        duration_s=event.duration_s,
    )
    if max(dither.modes) >= rtc.n_modes:
        raise CommandError(
            f"dither: found mode {max(dither.modes)}; expected 0 to {rtc.n_modes - 1}"
        )
    reason = why_unusable(dither, rtc, policy)
    if reason is not None:
        raise CommandError(f"dither: {reason}")
    return dither


def _refit(state: TrackerState, n_modes: int | None, now_ns: int) -> Step:
    if state.rtc is None:
        raise CommandError("refit: no RTC is there")
    if state.registration is None:
        raise CommandError("refit: α is not known yet; start a dither and wait for a window")
    wanted = n_modes or state.rtc.n_controlled
    if not 0 < wanted <= state.rtc.n_modes:
        raise CommandError(f"refit: found {wanted} modes; expected 1 to {state.rtc.n_modes}")
    state = replace(state, making_since_ns_utc=now_ns)
    return state, (ev.MakeMatrix(n_modes=wanted, why="the operator asked"),)


def _copy(state: TrackerState, source: str, why: str, now_ns: int) -> Step:
    """Offer an earlier matrix again; hold, or the service would replace it at once."""
    if state.rtc is None:
        raise CommandError("no RTC is there")
    state = replace(with_mode(state, Mode.HOLD), making_since_ns_utc=now_ns)
    state = logged(state, "mode", f"hold: {why}", now_ns)
    return state, (ev.CopyMatrix(source=source, why=why),)


def _rollback(state: TrackerState, now_ns: int) -> Step:
    earlier = [r.id for r in state.reconstructors if r.state is MatrixState.SUPERSEDED]
    if not earlier:
        raise CommandError("rollback: no earlier reconstructor has been in use")
    return _copy(state, earlier[-1], f"the operator goes back to {earlier[-1]}", now_ns)


def _proposed(state: TrackerState, matrix_id: str) -> None:
    record = known_record(state, matrix_id)
    if record.state is not MatrixState.PROPOSED:
        raise CommandError(f"{matrix_id} is {record.state}, not proposed")


def _judgeable(state: TrackerState, matrix_id: str) -> None:
    """Refuse what has never been in use while the gate cannot judge it."""
    used = known_record(state, matrix_id).state in {MatrixState.APPLIED, MatrixState.SUPERSEDED}
    if state.registration is None and not used:
        raise CommandError(
            f"{matrix_id} cannot be judged: α is not known yet; start a dither, wait for a window"
        )
