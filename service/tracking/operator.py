"""What an operator asks for: the mode, dithers, reconstructors."""

from __future__ import annotations

from dataclasses import replace

from service.errors import CommandError
from service.tracking import events as ev
from service.tracking.dither import allow, ask_for
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
from service.tracking.loop import Dither
from service.tracking.policy import Policy
from service.tracking.products import MatrixState, ModeSet
from service.tracking.reconstructors import change_state, known_record, make, send_once_judged
from service.tracking.state import Mode, Orders, TrackerState
from service.tracking.turn import Turn
from service.tracking.worth import outdated
from service.wire import DitherKind, Status


def set_mode(turn: Turn, mode: Mode) -> None:
    """Go on in the mode an operator orders; that of the settings is remembered."""
    of_settings = turn.state.settings_mode or turn.state.mode
    _order(turn, mode, None if mode is of_settings else of_settings)
    turn.log("mode", f"mode is {mode}")


def orders_of(state: TrackerState) -> Orders:
    """Return what the next service has to obey; the default is nothing."""
    return Orders(
        mode=None if state.settings_mode is None else state.mode,
        settings_mode=state.settings_mode,
        dither_stopped=state.dither_stopped,
    )


def obey(turn: Turn, orders: Orders) -> None:
    """Take over what was ordered before a restart, the mode being the settings' so far.

    What was said last counts: an order outlives the service, and ends with the next one, or when
    the settings say something else than they did when it was given.
    """
    if orders.dither_stopped:
        allow(turn, allowed=False)
        text = "by an operator before the restart; POST /v1/dither with start lets it dither again"
        turn.warn("dither.stopped", text)
    of_settings, ordered = turn.state.mode, orders.mode
    if ordered is None or ordered is of_settings:
        return
    if of_settings is not orders.settings_mode:
        text = (
            f"mode is {of_settings}: the settings, which said {orders.settings_mode} when an "
            f"operator set {ordered}, have been changed since"
        )
    else:
        text = (
            f"mode is {ordered}, as an operator set it before the restart, and not {of_settings} "
            "as the settings say: PUT /v1/mode changes it"
        )
        _order(turn, ordered, of_settings)
    turn.warn("mode", text)


def approve(turn: Turn, matrix_id: str) -> None:
    """Send a proposal, judged anew where need be, unless α is no longer what it was made for.

    Raises
    ------
    CommandError
        If it is none, or cannot be sent.
    """
    _check_proposed(turn, matrix_id)
    known = turn.known
    if known is not None and not known.usable:
        raise CommandError(f"{matrix_id} cannot be judged: α is invalid ({known.standing.reason})")
    if outdated(turn.state, known_record(turn.state, matrix_id)):
        raise CommandError(f"{matrix_id} was made for another α than the present one: refit")
    send_once_judged(turn, matrix_id)


def reject(turn: Turn, matrix_id: str, reason: str) -> None:
    """Discard a proposal.

    Raises
    ------
    CommandError
        If it is none.
    """
    _check_proposed(turn, matrix_id)
    change_state(turn, matrix_id, MatrixState.DISCARDED, reason or "by the operator")
    turn.log("reconstructor.discarded", matrix_id)


def publish(turn: Turn, matrix_id: str) -> None:
    """Offer a reconstructor again; what has never been in use only if the gate can judge it.

    Raises
    ------
    CommandError
        If it cannot, or no RTC is there.
    """
    used = {MatrixState.APPLIED, MatrixState.SUPERSEDED}
    if known_record(turn.state, matrix_id).state not in used and turn.known is None:
        raise CommandError(
            f"{matrix_id} cannot be judged: α is not known yet; start a dither, wait for a window"
        )
    _copy(turn, matrix_id, f"the operator publishes {matrix_id} again")


def roll_back(turn: Turn) -> None:
    """Offer the reconstructor again that was in use before.

    Raises
    ------
    CommandError
        If there was none, or no RTC is there.
    """
    states = MatrixState.SUPERSEDED
    earlier = [r.id for r in turn.state.reconstructors if r.state is states]
    if not earlier:
        raise CommandError("rollback: no earlier reconstructor has been in use")
    _copy(turn, earlier[-1], f"the operator goes back to {earlier[-1]}")


def refit(turn: Turn, n_modes: int | None) -> None:
    """Make a reconstructor for the present α.

    Raises
    ------
    CommandError
        If α is not known, no RTC is there, or it has no such number of modes.
    """
    rtc = turn.rtc
    if rtc is None:
        raise CommandError("refit: no RTC is there")
    if turn.known is None:
        raise CommandError("refit: α is not known yet; start a dither and wait for a window")
    asked = n_modes or rtc.n_controlled
    if not 0 < asked <= rtc.n_modes:
        raise CommandError(f"refit: found {asked} modes; expected 1 to {rtc.n_modes}")
    make(turn, ev.MakeMatrix(n_modes=asked, why="the operator asked"))


def start_dither(turn: Turn, command: ev.StartDither) -> None:
    """Start a dither; what is not said of it is the service's own choice.

    Raises
    ------
    CommandError
        If it cannot be played or read, or costs more than the budget.
    """
    rtc = turn.rtc
    if rtc is None or rtc.loop == "open":
        raise CommandError("a dither needs an RTC with its loop closed")
    choice = by_hand(turn.state, rtc, turn.policy)
    dither = _planned(command, choice, rtc, turn.policy, turn.now_ns)
    found_nm, budget_nm = 1e9 * total_m(dither.request), 1e9 * turn.policy.dither_budget_m
    cost = f"{found_nm:.3g} nm RMS in all, budget {budget_nm:.3g} nm"
    over = found_nm > budget_nm * (1.0 + 1e-9)
    if over and not command.over_budget:
        raise CommandError(f"dither: {cost}; say over_budget if that is meant")
    allow(turn)
    modes = dither.request.modes
    which = f"modes {modes}" if len(modes) < 10 else f"{len(modes)} modes"
    text = f"{dither.request.kind}, {which}, {cost}" + (": over budget, as asked" if over else "")
    turn.log("dither.asked", text)
    ask_for(turn, dither)


def _planned(
    command: ev.StartDither, choice: Choice, rtc: Status, policy: Policy, now_ns: int
) -> Dither:
    """Return the dither to ask for.

    Raises
    ------
    CommandError
        If it could not be played, or not be read.
    """
    if command.kind is DitherKind.BINARY or isinstance(command.modes, ModeSet):
        asked = RandomChoice(
            id=f"{ASKED_DITHER}{now_ns}",
            modes=command.modes or ModeSet.CONTROLLED,
            total_m=command.total_m or min(RANDOM_TOTAL_M, policy.dither_budget_m),
            duration_s=command.duration_s or policy.dither_duration_s,
        )
        return plan_random(asked, rtc, policy, now_ns)
    dither = plan_dither(
        rtc,
        policy,
        now_ns,
        choice=choice,
        modes=command.modes,
        amplitude_m=command.amplitude_m,
        frequency_hz=command.frequency_hz,
        duration_s=command.duration_s,
    )
    if max(dither.request.modes) >= rtc.n_modes:
        raise CommandError(
            f"dither: found mode {max(dither.request.modes)}; expected 0 to {rtc.n_modes - 1}"
        )
    reason = why_unusable(dither, rtc, policy)
    if reason is not None:
        raise CommandError(f"dither: {reason}")
    return dither


def _copy(turn: Turn, source: str, why: str) -> None:
    """Offer an earlier matrix again; hold, or the service would replace it at once."""
    if turn.rtc is None:
        raise CommandError("no RTC is there")
    of_settings = turn.state.settings_mode or turn.state.mode
    _order(turn, Mode.HOLD, None if of_settings is Mode.HOLD else of_settings)
    make(turn, ev.CopyMatrix(source=source, why=why))
    turn.log("mode", f"hold: {why}")


def _order(turn: Turn, mode: Mode, of_settings: Mode | None) -> None:
    turn.state = replace(turn.state, mode=mode, settings_mode=of_settings)


def _check_proposed(turn: Turn, matrix_id: str) -> None:
    record = known_record(turn.state, matrix_id)
    if record.state is not MatrixState.PROPOSED:
        raise CommandError(f"{matrix_id} is {record.state}, not proposed")
