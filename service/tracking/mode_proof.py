"""Verification of modes: their response must agree with the instrument file.

If the sign, order or size of a mode is wrong in the file, any loop that begins to control it
diverges. The RTC's own matrix verifies the modes that it controls. Every other mode is dithered
once before a matrix commands it. Many modes are dithered together, because only the sign and the
rough size of each response is needed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.estimation.demodulation import SIDE_OFFSETS_HZ
from service.estimation.own_matrix import N_NEIGHBOURS
from service.records import alarms
from service.records import events as ev
from service.records.estimates import DitheredEstimate, LockInEstimate, RandomEstimate
from service.records.products import (
    UNEVEN_RATIO,
    MatrixState,
    ModeAnswer,
    ModeProof,
    ModeRatio,
    ReconstructorRecord,
)
from service.records.registration import Registration
from service.records.state import Mode, TrackerState
from service.tracking.dither_request import (
    N_LINES,
    PROVING_LINE_RANGE,
    VIBRATION_CLEARANCES_HZ,
    choose_modes,
    step_of,
)
from service.tracking.mode_limits import (
    MAX_LISTED_MODES,
    add_ratios,
    compare,
    format_modes,
    format_subject,
)
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext
from service.tracking.update_policy import is_settled, limit_modes
from service.wire import Status

PLAUSIBLE_RESPONSE_RATIO = (0.4, 2.0)
"""Plausible range of a mode's response relative to the median of the modes dithered with it:
optical gains stay within it, and so do all modes of a model that is 40 % wrong per mode."""

MIN_RESPONSE_RATIO = 0.1
"""Slopes over the model's of any mode that a pyramid sees."""

RESPONSE_LIMIT_SIGMA = 4.0
"""Number of σ by which a response must be beyond a limit to count as beyond it."""

MAX_SHOWN_MODES = 100
"""Modes that are shown together: each has a line of its own, and shares the budget."""

MAX_WEAK_LINES = 40
"""Largest number of modes that weak lines verify during the first dither."""

FAILED_DITHER_DIVISOR = 4
"""Divisor of that number after each dither without a result: fewer modes get larger amplitudes."""

MIN_LINE_SPACING_STEPS = 5
"""Smallest spacing of two lines in inverse window lengths. Four separate them; rounding takes up to
one."""

RESULT_TIMEOUT_S = 15.0
"""Time for a result after a dither was requested, in addition to the window itself."""

MAX_PROOF_TRIES = 3
"""Number of dithers without a result after which modes are not tried for a while."""


def proven_modes(state: TrackerState) -> frozenset[int]:
    """Return the modes whose response is known to agree with the instrument file.

    The modes of the matrix in use count as verified even if a dither contradicts one of them. The
    loop runs with them: the RTC's own matrix verifies its modes, and the service controls verified
    modes only.
    """
    return state.matrices.mode_proof.proven | _controlled(state)


def _controlled(state: TrackerState) -> frozenset[int]:
    """Return the modes that the matrix in use is known to control as they are."""
    in_use = None if state.matrices.in_use is None else state.reconstructor(state.matrices.in_use)
    if in_use is None:
        return frozenset()
    # A matrix without a parent is the RTC's own; only there may the model fail to recognise a mode.
    strange = state.matrices.mode_proof.strange if in_use.parent is None else frozenset()
    return frozenset(range(in_use.n_modes)) - strange


def shunned_modes(state: TrackerState) -> frozenset[int]:
    """Return the contrary modes outside the loop: none is used for α."""
    return state.matrices.mode_proof.contrary - proven_modes(state)


def answers_well(state: TrackerState, mode: int) -> bool:
    """Return whether a mode is proven and no window contradicts it."""
    proof = state.matrices.mode_proof
    return mode in proven_modes(state) - proof.contrary - proof.suspected


def check_information(context: StepContext, estimate: DitheredEstimate) -> str | None:
    """Return why a window of these modes does not determine α, or None.

    What the loop makes of a line is fitted with the gain of the line's own mode.
    """
    if context.policy.dither_modes or context.policy.mode_information is None:
        return None  # there is no choice of others
    proof = context.matrices.mode_proof
    odd = (proof.contrary | proof.suspected).intersection(estimate.modes)
    # Weak lines have too little weight to bias α.
    odd -= proven_modes(context.state).union(estimate.weak)
    if not odd:
        return None
    return (
        f"{format_subject(odd)} not answered as the instrument file says: such a window gives no α"
    )


def n_proven_modes(state: TrackerState, n_modes: int) -> int:
    """Return how many modes, from the first on and at most ``n_modes``, are proven."""
    proven = proven_modes(state)
    return next((mode for mode in range(n_modes) if mode not in proven), n_modes)


def check_proven(state: TrackerState, record: ReconstructorRecord) -> str | None:
    """Return why a matrix would control unproven modes, or None."""
    if state.operations.acquisition.under_way:
        return None  # An acquisition closes the loop on smooth modes first, and watches it.
    proven = proven_modes(state)
    # A matrix commands all modes from the first on.
    missing = [mode for mode in range(record.n_modes) if mode not in proven]
    if not missing:
        return None
    contrary = [mode for mode in missing if mode in state.matrices.mode_proof.contrary]
    if contrary:
        return f"{format_subject(contrary)} not answered as the instrument file says"
    return (
        f"{format_subject(missing)} not been seen to answer yet: a dither shows them before they "
        "are controlled; let the service dither"
    )


def awaits_proof(context: StepContext, rtc: Status) -> bool:
    """Return whether modes that are wanted are still to be shown by a dither."""
    allowed = context.policy.dither_enabled and not context.dithers.stopped
    return allowed and bool(_missing_modes(context, rtc))


def modes_to_show(context: StepContext, rtc: Status, window_s: float) -> tuple[int, ...]:
    """Return the modes that the next window should verify; empty if there are none, or not now.

    If few are missing, modes with much information on α are added, because the window must still
    measure it.
    """
    state, registration = context.state, context.registration
    busy = state.on_probation or state.matrices.making_since_ns_utc is not None
    on_way = any(record.on_its_way for record in state.matrices.reconstructors)
    if registration is None or busy or on_way or state.operator.mode is Mode.HOLD:
        return ()
    if not awaits_proof(context, rtc):
        return ()
    missing = _missing_modes(context, rtc)
    # Many weak lines measure α less well, so that α must be known first.
    if not (is_settled(registration) or (unknown_loop(state, rtc) and _plausible(registration))):
        return ()
    # Fewer modes share the budget after a failure, so that each line is stronger.
    at_once = max(
        MAX_SHOWN_MODES // FAILED_DITHER_DIVISOR**state.matrices.mode_proof.n_tries, N_LINES
    )
    most = min(len(lines_clear(context, rtc, window_s)), at_once, rtc.max_dither_modes)
    shown = missing[:most]
    others = [mode for mode in _to_compare(context, rtc, shown) if mode not in shown]
    shown += others[: most - len(shown)]
    telling = choose_modes(rtc, context.policy, shunned_modes(state))
    spare = [mode for mode in telling if mode not in shown]
    room = min(N_LINES if others else N_LINES - len(shown), most - len(shown))
    return tuple(sorted([*shown, *spare[: max(room, 0)]]))


def find_weak_line_modes(context: StepContext, rtc: Status, telling: tuple[int, ...]) -> list[int]:
    """Return the free modes that weak lines verify during the first dither for α.

    After a rejected window there are none: a dither with few lines is recovered soonest.
    """
    chosen = context.policy.mode_information is not None
    idle = context.operator.mode is Mode.HOLD or context.windows.run < 0
    if idle or not chosen or not awaits_proof(context, rtc):
        return []
    free = (mode for mode in _missing_modes(context, rtc) if mode >= rtc.n_controlled)
    return [mode for mode in free if mode not in telling][:MAX_WEAK_LINES]


def _to_compare(context: StepContext, rtc: Status, shown: list[int]) -> list[int]:
    """Return the neighbours of possibly uneven modes, and modes that were never compared."""
    state, proof = context.state, context.matrices.mode_proof
    controlled, odd = _controlled(state), proof.contrary | proof.suspected
    healthy = [m for m in range(rtc.n_modes) if m not in odd and m not in shown]
    found: dict[int, None] = {}
    for doubted in (one.mode for one in proof.doubtful if one.mode in shown):
        # The loop counteracts the dither of controlled modes, so a mode is compared with modes that
        # are controlled like itself.
        side = doubted in controlled
        healthy.sort(key=lambda m: ((m in controlled) != side, abs(m - doubted)))
        found |= dict.fromkeys(healthy[:N_NEIGHBOURS])
    new = range(_wanted_modes(context, rtc)) if shown else ()
    return [*found, *(m for m in new if m not in proof.compared | controlled | odd)]


def unknown_loop(state: TrackerState, rtc: Status) -> bool:
    """Return whether the answers of the controlled modes are unknown.

    No matrix can be sent before that is known: one window is enough to begin with.
    """
    return n_proven_modes(state, rtc.n_controlled) < rtc.n_controlled


def _plausible(registration: Registration) -> bool:
    """Return whether no window contradicts α, though there may be one only."""
    return registration.suspected_jump is None and not registration.doubt and registration.usable


def lines_clear(context: StepContext, rtc: Status, window_s: float) -> tuple[float, ...]:
    """Return lines for many modes at once: evenly spaced, none on a vibration, lowest first."""
    step, edge_hz = step_of(rtc, window_s), float(SIDE_OFFSETS_HZ.max()) + 1.0
    low = max(PROVING_LINE_RANGE[0] * rtc.frame_rate_hz, edge_hz)
    high = min(PROVING_LINE_RANGE[1] * rtc.frame_rate_hz, rtc.frame_rate_hz / 2 - edge_hz)
    # Whole hertz apart: the dither on the mirror is verified second by second, and lines must not
    # mix within one second.
    spacing = np.ceil(max(MIN_LINE_SPACING_STEPS * step, (high - low) / MAX_SHOWN_MODES))
    avoid = (*context.policy.dither_avoid_hz, *context.loop.vibrations_hz)
    # Both start and spacing are whole hertz, and so are all lines.
    lines = np.arange(np.ceil(low), high, spacing)
    return tuple(
        float(line)
        for line in lines
        if all(abs(line - v) >= VIBRATION_CLEARANCES_HZ[-1] for v in avoid)
    )


def note_shown(context: StepContext, modes: tuple[int, ...]) -> None:
    """Record that a dither was requested to verify these modes."""
    proof = context.matrices.mode_proof
    # A worker that is behind discards windows; the modes are not to blame for that.
    if context.state.alarm(alarms.WORKER_BEHIND) is None:
        proof = _after_miss(proof)
    shown = replace(proof, shown=frozenset(modes), shown_ns_utc=context.now_ns)
    context.matrices = replace(context.matrices, mode_proof=shown)
    context.log(
        "modes.shown", f"modes {format_modes(modes)} are dithered before they are controlled"
    )


def awaits_result(context: StepContext, window_s: float) -> bool:
    """Return whether the result of the last dither for verification may still arrive."""
    proof = context.matrices.mode_proof
    waited_s = (context.now_ns - proof.shown_ns_utc) / SECOND_NS
    return bool(proof.shown) and waited_s < window_s + RESULT_TIMEOUT_S


def learn_modes(context: StepContext, event: ev.WindowFitted) -> None:
    """Record which modes of a window respond as the model predicts, even if its α is rejected."""
    estimate, rtc, proof = event.estimate, context.rtc, context.matrices.mode_proof
    if context.state.measuring is not None:
        return  # these frames are no ordinary telemetry
    if rtc is None or estimate.session != rtc.session or estimate.gain_sigma is None:
        return
    modes, gains = np.array(estimate.modes), np.real(estimate.optical_gain)
    proven, contrary = _classify(gains, np.abs(estimate.optical_gain), estimate.gain_sigma)
    good, bad = (frozenset(modes[which].tolist()) for which in (proven, contrary))
    before = proof
    # Two windows must agree before a mode is excluded.
    sure = bad & (proof.suspected | proof.contrary)
    compared = _without(
        compare(modes, gains, estimate.gain_sigma, estimate.unexplained),
        bad | _controlled(context.state),
    )
    uneven, doubtful = _judge_ratios(proof, compared, bad)
    doubted = frozenset(one.mode for one in doubtful)
    accused = (proof.suspected | bad | proof.contrary) - good
    proof = replace(
        proof,
        # One contrary response revokes a verification; only the exclusion of a mode needs two.
        proven=(proof.proven | (good - doubted)) - bad,
        compared=proof.compared | compared.keys(),
        contrary=(proof.contrary | sure) - good,
        suspected=(proof.suspected | bad) - good - sure,
        answers=_answers(proof, estimate, gains, bad, accused),
        uneven=uneven,
        doubtful=doubtful,
    )
    if proof.shown and proof.shown <= frozenset(estimate.modes):
        shown = (good | bad) & (proof.shown - before.proven)
        shown |= compared.keys() & {one.mode for one in before.doubtful}
        proof = replace(proof, n_tries=0) if shown else _after_miss(proof)
        proof = replace(proof, shown=frozenset())
    if proof == before:
        return
    context.matrices = replace(context.matrices, mode_proof=proof)
    _limit_to_proven(context, rtc, bad)


def _without(ratios: dict[int, ModeRatio], modes: frozenset[int]) -> dict[int, ModeRatio]:
    """Return the ratios of all other modes, in order."""
    return {mode: ratios[mode] for mode in sorted(ratios) if mode not in modes}


def _judge_ratios(
    proof: ModeProof, compared: dict[int, ModeRatio], bad: frozenset[int]
) -> tuple[frozenset[int], tuple[ModeRatio, ...]]:
    """Return the modes that are certainly uneven, and those that may be, after this window."""
    before = {one.mode: one for one in proof.doubtful}
    together = add_ratios(before, compared)
    uneven = {mode for mode, one in together.items() if one.certain}
    # A mode stays uneven until a window compares it again and it no longer stands out.
    uneven |= {m for m in proof.uneven if m not in compared or compared[m].stands_out}
    # A contrary mode is judged by its response, not by its ratio to others.
    rest = _without(before | together, bad | uneven)
    return frozenset(uneven - bad), tuple(one for one in rest.values() if one.undecided)


def _answers(
    proof: ModeProof,
    estimate: LockInEstimate | RandomEstimate,
    gains: NDArray[np.float64],
    bad: frozenset[int],
    accused: frozenset[int],
) -> tuple[ModeAnswer, ...]:
    """Return the responses of the accused modes, this window's replacing earlier ones."""
    like = estimate.answers_as or estimate.modes
    found = {answer.mode: answer for answer in proof.answers if answer.mode in accused}
    for mode, gain, other in zip(estimate.modes, gains.tolist(), like, strict=True):
        if mode in bad:
            found[mode] = ModeAnswer(mode=mode, gain=gain, like=other)
    return tuple(found[mode] for mode in sorted(found))


def note_recognised(context: StepContext, event: ev.ModesRecognised) -> None:
    """Record the recognised modes of the matrix in use."""
    proof = replace(
        context.matrices.mode_proof,
        strange=frozenset(event.strange),
        own_response_ratio=event.response,
        own_uneven=event.uneven,
        own_weights=event.weights,
        own_misfit_ratio=event.misfit,
        own_model_error=event.model_error,
    )
    context.matrices = replace(context.matrices, mode_proof=proof)
    context.alpha = replace(context.alpha, own_matrix_alpha=event.alpha)
    context.log("modes.recognised", f"{event.id}: {event.text}")


def note_passed(context: StepContext, record: ReconstructorRecord) -> None:
    """Record that the loop was as good with this matrix as before: its modes are verified.

    They remain so when a matrix of fewer modes follows, after a jump for example.
    """
    proof = context.matrices.mode_proof
    # The loop was judged as a whole: that does not verify a mode which a dither has found wrong.
    held = frozenset(range(record.n_modes)) - proof.contrary - proof.suspected
    if not held <= proof.proven:
        proof = replace(proof, proven=proof.proven | held)
        context.matrices = replace(context.matrices, mode_proof=proof)


def proof_to_keep(state: TrackerState) -> ModeProof | None:
    """Return the results on modes to keep over a restart; None if there are none.

    Modes of the matrix in use are not kept as suspected, because after a restart the service does
    not know that matrix at first.
    """
    proof, proven = state.matrices.mode_proof, proven_modes(state)
    kept = replace(
        proof,
        # The measured responses of modes end with the service. Where the model explains the RTC's
        # own matrix well, sign and size of a mode are enough; else the gate needs its response.
        proven=frozenset() if proof.own_weights else proof.proven,
        contrary=shunned_modes(state),
        suspected=proof.suspected - proven,
        shown=frozenset(),
        shown_ns_utc=0,
        n_tries=0,
    )
    return None if kept == ModeProof() else kept


def restore_proof(context: StepContext, proof: ModeProof, session: str) -> None:
    """Restore the results of the previous run; they count once the RTC has identified itself."""
    restored = replace(proof, session=session)
    context.matrices = replace(context.matrices, mode_proof=restored)


def forget_session(context: StepContext) -> None:
    """Discard the results on modes of the previous session, because the RTC may have changed.

    Restored results wait for the RTC's status, which identifies the session.
    """
    if not context.matrices.mode_proof.session:
        context.matrices = replace(context.matrices, mode_proof=ModeProof())


def believe_restored(context: StepContext, rtc: Status) -> None:
    """Accept the results restored from before a restart if they are of this RTC and session."""
    proof = context.matrices.mode_proof
    if not proof.session:
        return
    # Another session may have another order or signs of modes.
    same = proof.session == rtc.session and context.registration is not None
    now = replace(proof, session="") if same else ModeProof()
    context.matrices = replace(context.matrices, mode_proof=now)
    if not same:
        context.log("modes.not-restored", "the RTC is not the one whose modes were seen")
        return
    context.log("modes.restored", f"{now.n_proven} modes were seen before the restart")
    _limit_to_proven(context, rtc, now.contrary)


def _classify(
    gains: NDArray[np.float64], size: NDArray[np.float64], sigma: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which modes respond as the model predicts, and which certainly do not."""
    # The optical gain is common to all modes, so each mode is judged relative to the median.
    typical = float(np.median(size))
    low, high = (
        max(PLAUSIBLE_RESPONSE_RATIO[0] * typical, MIN_RESPONSE_RATIO),
        PLAUSIBLE_RESPONSE_RATIO[1] * typical,
    )
    # The signed gain: a response with the other sign is never seen here, however strong.
    seen = gains > RESPONSE_LIMIT_SIGMA * sigma
    proven = seen & (gains > low) & (gains < high)
    contrary = (gains + RESPONSE_LIMIT_SIGMA * sigma < low) | (
        gains - RESPONSE_LIMIT_SIGMA * sigma > high
    )
    return proven, contrary & ~proven


def _limit_to_proven(context: StepContext, rtc: Status, bad: frozenset[int]) -> None:
    """Stop controlling modes with a wrong response for a while if one of them was newly found."""
    in_the_way = _contrary_in_the_way(context, rtc)
    if in_the_way and bad & shunned_modes(context.state):
        text = _contrary_in_words(context.matrices.mode_proof, in_the_way)
        limit_modes(context, in_the_way[0], text)


def contrary_text(context: StepContext) -> str | None:
    """Return a description of the wanted modes that contradict the instrument file, or None."""
    if context.rtc is None:
        return context.alarm_text(alarms.MODES_CONTRARY)
    in_the_way = _contrary_in_the_way(context, context.rtc)
    return _contrary_in_words(context.matrices.mode_proof, in_the_way) if in_the_way else None


def _contrary_in_words(proof: ModeProof, in_the_way: list[int]) -> str:
    return (
        f"{format_subject(in_the_way)} not answered the dither as the instrument file says"
        f"{_in_words(proof, in_the_way)}: no new matrix controls more than {in_the_way[0]} modes"
    )


def _contrary_in_the_way(context: StepContext, rtc: Status) -> list[int]:
    if not context.matrices.mode_proof.contrary:
        return []
    target = _target_modes(context, rtc)
    return sorted(mode for mode in shunned_modes(context.state) if mode < target)


def _in_words(proof: ModeProof, modes: list[int]) -> str:
    """Return the responses of modes, in brackets."""
    answers = {answer.mode: answer for answer in proof.answers}
    listed = [answers[mode] for mode in modes[:MAX_LISTED_MODES] if mode in answers]
    parts = []
    for answer in listed:
        other = answers.get(answer.like)
        if answer.like == answer.mode:
            parts.append(f"{answer.gain:+.2f}")
        elif other is None or other.like != answer.mode:
            parts.append(f"{answer.mode} is in the place of {answer.like}")
        elif answer.mode < other.mode or other not in listed:
            parts.append(f"{answer.mode} and {answer.like} are exchanged")
    times = " times the model" if any(answer.like == answer.mode for answer in listed) else ""
    return f" ({', '.join(parts)}{times})" if parts else ""


def explain_uneven(context: StepContext) -> str | None:
    """Return which modes respond more or less strongly than their neighbours, or None."""
    proof = context.matrices.mode_proof
    if proof.session:
        return None  # it is not known yet whether this is the same RTC
    found = [f"{proof.own_uneven}: matrices allow for it"] if proof.own_uneven else []
    if proof.uneven:
        one = "answers" if len(proof.uneven) == 1 else "answer"
        noun = "mode" if len(proof.uneven) == 1 else "modes"
        found.append(
            f"{noun} {format_modes(proof.uneven)} {one} the dither more than {UNEVEN_RATIO:g} "
            "times as strongly or as weakly as their neighbours"
        )
    return "; ".join(found) or None


def _after_miss(proof: ModeProof) -> ModeProof:
    """Return the results after a dither that has verified no mode."""
    return replace(proof, n_tries=proof.n_tries + 1) if proof.shown else proof


def give_up_unseen(context: StepContext, rtc: Status) -> None:
    """Exclude modes for a while that several dithers have not verified."""
    proof = context.matrices.mode_proof
    if proof.n_tries < MAX_PROOF_TRIES:
        return
    # Several dithers could not confirm the suspicion: it must not have these modes tried for ever.
    suspected = proof.suspected - proof.shown
    given_up = replace(proof, shown=frozenset(), n_tries=0, suspected=suspected)
    context.matrices = replace(context.matrices, mode_proof=given_up)
    text = (
        f"{format_subject(proof.shown)} not been seen to answer in {MAX_PROOF_TRIES} dithers: "
        "see why windows "
        "are refused, or give the dither more budget"
    )
    limit_modes(context, n_proven_modes(context.state, rtc.n_modes), text)


def _missing_modes(context: StepContext, rtc: Status) -> list[int]:
    """Return the modes that are needed now and not verified yet.

    Modes that one window has found wrong come first, so that the finding is confirmed or refuted.
    """
    proof, wanted = context.matrices.mode_proof, _wanted_modes(context, rtc)
    doubted = {one.mode for one in proof.doubtful} - _controlled(context.state)
    proven = proven_modes(context.state) - doubted
    accused = sorted(m for m in (proof.suspected | doubted) - proven if m < rtc.n_modes)
    return [*accused, *(m for m in range(wanted) if m not in proven and m not in accused)]


def _wanted_modes(context: StepContext, rtc: Status) -> int:
    """Return up to which mode all should be proven now."""
    limit, n_modes = context.matrices.mode_limit, _target_modes(context, rtc)
    if limit is not None and context.now_ns < limit.until_ns_utc:
        n_modes = min(n_modes, limit.n_modes)
    return n_modes


def _target_modes(context: StepContext, rtc: Status) -> int:
    """Return how many modes are controlled, wanted, or in a proposal that awaits an operator."""
    proposed = (
        r.n_modes for r in context.matrices.reconstructors if r.state is MatrixState.PROPOSED
    )
    return max(rtc.n_controlled, context.policy.wanted_modes(rtc), *proposed, 0)
