"""Which modes may be controlled: those that have been seen to answer as the instrument file says.

A mode whose sign, place or size is another than the file says makes any loop diverge that begins
to control it. The RTC's own matrix tells how those modes answer that it controls. All others are
dithered once before a matrix commands them: many at a time, for no more is asked of each than its
sign and its rough size.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.telemetry.comb import SIDE_OFFSETS_HZ
from service.telemetry.lockin import WindowEstimate
from service.telemetry.random_dither import RandomEstimate
from service.tracking import alarms
from service.tracking import events as ev
from service.tracking.dither_modes import N_LINES, PROVING_RANGE, chosen_modes
from service.tracking.dither_request import CLEARANCES_HZ, step_of
from service.tracking.mode_limits import ModeProof
from service.tracking.policy import SECOND_NS
from service.tracking.products import MatrixState, ReconstructorRecord
from service.tracking.state import Mode, TrackerState
from service.tracking.turn import Turn
from service.tracking.worth import limit_modes, settled
from service.wire import Status

SIZE_RANGE = (0.4, 2.0)
"""Of a mode's response over the median of the modes dithered with it: optical gains lie within."""

LEAST_RESPONSE = 0.1
"""Slopes over the model's of any mode that a pyramid sees."""

SIGNIFICANT = 4.0
"""1 σ of a response by which it must lie on one side of a limit to be told."""

MOST_AT_ONCE = 100
"""Modes that are shown together: each has a line of its own, and shares the budget."""

FEWER = 4
"""Divides that number after each dither that has told nothing: fewer modes are stronger."""

CLOSEST_STEPS = 5
"""Between two lines, in periods of the window: four are needed to tell them apart."""

TOLD_WITHIN_S = 15.0
"""For what a dither has shown, from when it was asked for, besides the window itself."""

TRIES = 3
"""That tell nothing, before modes are left alone for a while."""

_NAMED = 8


def proven_modes(state: TrackerState) -> frozenset[int]:
    """Return the modes that are known to answer as the instrument file says.

    Those of the matrix in use are, whatever a dither says of one: the RTC's own tells them, of the
    service's only proven ones are controlled, and the loop runs with them.
    """
    proof = state.mode_proof
    in_use = None if state.in_use is None else state.reconstructor(state.in_use)
    controlled = frozenset(range(0 if in_use is None else in_use.n_modes))
    if in_use is not None and in_use.parent is None:
        controlled -= proof.strange
    return proof.proven | controlled


def most_modes(state: TrackerState, n_modes: int) -> int:
    """Return how many modes, from the first on and at most ``n_modes``, are proven."""
    proven = proven_modes(state)
    return next((mode for mode in range(n_modes) if mode not in proven), n_modes)


def why_unproven(state: TrackerState, record: ReconstructorRecord) -> str | None:
    """Return why a matrix would control modes that nobody has seen to answer, or None."""
    if state.acquisition.under_way:
        return None  # it closes the loop on smooth modes first, and watches it
    proven = proven_modes(state)
    missing = [mode for mode in range(record.n_modes) if mode not in proven]
    if not missing:
        return None
    contrary = [mode for mode in missing if mode in state.mode_proof.contrary]
    if contrary:
        return f"{_named(contrary)} not answered as the instrument file says"
    return (
        f"{_named(missing)} not been seen to answer yet: a dither shows them before they are "
        "controlled; let the service dither"
    )


def awaits_proof(turn: Turn, rtc: Status) -> bool:
    """Return whether modes that are wanted are still to be shown by a dither."""
    allowed = turn.policy.dither_enabled and not turn.state.dither_stopped
    return allowed and not turn.policy.dither_modes and bool(_missing(turn, rtc))


def modes_to_show(turn: Turn, rtc: Status, window_s: float) -> tuple[int, ...]:
    """Return the modes that the next window should show; empty: none, or not now.

    Where few are missing, modes that tell of α are added: a window must still measure it.
    """
    state, known = turn.state, turn.known
    busy = state.on_probation or state.making_since_ns_utc is not None
    on_way = any(record.on_its_way for record in state.reconstructors)
    if known is None or not settled(known) or busy or on_way or state.mode is Mode.HOLD:
        return ()
    if not awaits_proof(turn, rtc):
        return ()
    missing = _missing(turn, rtc)
    at_once = max(MOST_AT_ONCE // FEWER**state.mode_proof.n_tries, N_LINES)
    most = min(len(lines_clear(turn, rtc, window_s)), at_once, rtc.max_dither_modes)
    shown = missing[:most]
    spare = [mode for mode in chosen_modes(rtc, turn.policy) if mode not in shown]
    return tuple(sorted([*shown, *spare[: max(min(N_LINES, most) - len(shown), 0)]]))


def lines_clear(turn: Turn, rtc: Status, window_s: float) -> tuple[float, ...]:
    """Return lines for many modes at once: evenly spaced, none on a vibration, lowest first."""
    step, edge_hz = step_of(rtc, window_s), float(SIDE_OFFSETS_HZ.max()) + 1.0
    low = max(PROVING_RANGE[0] * rtc.frame_rate_hz, edge_hz)
    high = min(PROVING_RANGE[1] * rtc.frame_rate_hz, rtc.frame_rate_hz / 2 - edge_hz)
    # whole hertz apart: what is played is looked at second by second, and lines must not mix there
    spacing = np.ceil(max(CLOSEST_STEPS * step, (high - low) / MOST_AT_ONCE))
    avoid = (*turn.policy.dither_avoid_hz, *turn.state.vibrations_hz)
    lines = np.arange(np.ceil(low), high, spacing)
    return tuple(
        float(line) for line in lines if all(abs(line - v) >= CLEARANCES_HZ[-1] for v in avoid)
    )


def begin(turn: Turn, modes: tuple[int, ...]) -> None:
    """Note that a dither has been asked for to see these modes."""
    proof = turn.state.mode_proof
    if turn.state.alarm(alarms.WORKER_BEHIND) is None:  # which gives windows up: no fault of theirs
        proof = _missed(proof)
    shown = replace(proof, shown=frozenset(modes), shown_ns_utc=turn.now_ns)
    turn.state = replace(turn.state, mode_proof=shown)
    turn.log("modes.shown", f"modes {_listed(modes)} are dithered before they are controlled")


def awaits_result(turn: Turn, window_s: float) -> bool:
    """Return whether what the last such dither has shown may still be on its way."""
    proof = turn.state.mode_proof
    waited_s = (turn.now_ns - proof.shown_ns_utc) / SECOND_NS
    return bool(proof.shown) and waited_s < window_s + TOLD_WITHIN_S


def learn(turn: Turn, estimate: WindowEstimate | RandomEstimate) -> None:
    """Take over which modes of a window answer as they should, whatever it says of α."""
    rtc, proof = turn.rtc, turn.state.mode_proof
    if rtc is None or estimate.session != rtc.session or estimate.gain_sigma is None:
        return
    modes = np.array(estimate.modes)
    gains = np.real(estimate.optical_gain)
    proven, contrary = _told(gains, np.abs(estimate.optical_gain), estimate.gain_sigma)
    good, bad = frozenset(modes[proven].tolist()), frozenset(modes[contrary].tolist())
    before = proof
    sure = bad & (proof.suspected | proof.contrary)
    proof = replace(
        proof,
        proven=(proof.proven | good) - bad,
        contrary=(proof.contrary | sure) - good,
        suspected=(proof.suspected | bad) - good - sure,
    )
    if proof.shown and proof.shown <= frozenset(estimate.modes):
        told = (good | bad) & proof.shown
        proof = replace(proof, n_tries=0) if told else _missed(proof)
        proof = replace(proof, shown=frozenset())
    if proof == before:
        return
    turn.state = replace(turn.state, mode_proof=proof)
    _tell(turn, rtc, dict(zip(modes[contrary].tolist(), gains[contrary].tolist(), strict=True)))


def recognise(turn: Turn, event: ev.ModesRecognised) -> None:
    """Take over which modes of the matrix in use the model has recognised."""
    proof = replace(
        turn.state.mode_proof, strange=frozenset(event.strange), own_response_ratio=event.response
    )
    turn.state = replace(turn.state, mode_proof=proof)
    turn.log("modes.recognised", f"{event.id}: {event.text}")
    if event.uneven:
        turn.alarm(alarms.MODES_UNEVEN, f"{event.uneven}: matrices allow for it")
    else:
        turn.calm(alarms.MODES_UNEVEN)


def _told(
    gains: NDArray[np.float64], size: NDArray[np.float64], sigma: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which modes answer as they should, and which certainly do not; the rest may do."""
    typical = float(np.median(size))
    low, high = max(SIZE_RANGE[0] * typical, LEAST_RESPONSE), SIZE_RANGE[1] * typical
    seen = gains > SIGNIFICANT * sigma
    proven = seen & (gains > low) & (gains < high)
    contrary = (gains + SIGNIFICANT * sigma < low) | (gains - SIGNIFICANT * sigma > high)
    return proven, contrary & ~proven


def _tell(turn: Turn, rtc: Status, answers: dict[int, float]) -> None:
    """Say which modes answer otherwise, and control none of them for a while."""
    contrary = turn.state.mode_proof.contrary - proven_modes(turn.state)
    in_the_way = sorted(mode for mode in contrary if mode < _target(turn, rtc))
    if not in_the_way:
        turn.calm(alarms.MODES_CONTRARY)
        return
    seen = ", ".join(f"{answers[mode]:+.2f}" for mode in in_the_way[:_NAMED] if mode in answers)
    text = (
        f"{_named(in_the_way)} not answered the dither as the instrument file says"
        f"{f' ({seen} times the model)' if seen else ''}: no new matrix controls more than "
        f"{in_the_way[0]} modes"
    )
    turn.alarm(alarms.MODES_CONTRARY, text)
    if any(mode in contrary for mode in answers):
        limit_modes(turn, in_the_way[0], text)


def _missed(proof: ModeProof) -> ModeProof:
    """Return the account after a dither that has shown nothing."""
    return replace(proof, n_tries=proof.n_tries + 1) if proof.shown else proof


def give_up(turn: Turn, rtc: Status) -> None:
    """Leave modes alone for a while that several dithers have not shown."""
    proof = turn.state.mode_proof
    if proof.n_tries < TRIES:
        return
    turn.state = replace(turn.state, mode_proof=replace(proof, shown=frozenset(), n_tries=0))
    text = (
        f"{_named(proof.shown)} not been seen to answer in {TRIES} dithers: see why windows are "
        "refused, or give the dither more budget"
    )
    limit_modes(turn, most_modes(turn.state, rtc.n_modes), text)


def _missing(turn: Turn, rtc: Status) -> list[int]:
    """Return the modes that are wanted now, and that nobody has seen to answer."""
    proven = proven_modes(turn.state)
    return [mode for mode in range(_wanted(turn, rtc)) if mode not in proven]


def _wanted(turn: Turn, rtc: Status) -> int:
    """Return up to which mode all should be proven now."""
    limit, n_modes = turn.state.mode_limit, _target(turn, rtc)
    if limit is not None and turn.now_ns < limit.until_ns_utc:
        n_modes = min(n_modes, limit.n_modes)
    return n_modes


def _target(turn: Turn, rtc: Status) -> int:
    """Return how many modes are controlled, are to be, or await an operator's word."""
    proposed = (r.n_modes for r in turn.state.reconstructors if r.state is MatrixState.PROPOSED)
    return max(rtc.n_controlled, min(turn.policy.n_modes_target, rtc.n_modes), *proposed, 0)


def _named(modes: Collection[int]) -> str:
    """Return modes as the subject of a sentence, with its verb."""
    return f"mode {_listed(modes)} has" if len(modes) == 1 else f"modes {_listed(modes)} have"


def _listed(modes: Iterable[int]) -> str:
    """Return modes in words, lowest first, a run of them by its ends."""
    runs: list[list[int]] = []
    for mode in sorted(modes):
        if runs and mode == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], mode]
        else:
            runs.append([mode])
    said = [" to ".join(map(str, run)) for run in runs]
    more = f" and {len(said) - _NAMED} more" if len(said) > _NAMED else ""
    return ", ".join(said[:_NAMED]) + more
