"""Decide whether a new reconstructor justifies a swap, and its number of modes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.control.expected_gain import estimate_noise_loss_m
from service.estimation.loop import SAME_DELAY, SAME_LEAK, same_gains
from service.model.misregistration import Misregistration, step_text
from service.records.products import Assessment, Judged, MatrixState, ModeLimit, ReconstructorRecord
from service.records.registration import Registration
from service.records.state import TrackerState
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.step_context import StepContext
from service.wire import Status

MIN_AGREEING_WINDOWS = 2
"""Windows that must agree before anything is made from them."""

VERDICT_MARGIN = np.array([0.05, 0.05, np.deg2rad(0.05), 0.005])
"""Half of the accuracy that Heritier et al. 2018, section 3.2, require (10 % of a subaperture and
0.1 deg), and 0.5 % of magnification: a verdict still holds this far beyond α ± 3σ (numeric
units)."""

REFUSED_INTERVAL_S = 30.0
"""Least time to the next request after one was refused, rejected or not acknowledged."""

THRESHOLD_DECAY_S = 60.0
"""Time over which the thresholds, doubled by an update, return to their own values."""

MIN_SIGNIFICANT_STEP = 18.5
"""Squared distance, in σ, of a step of four parameters that noise makes once in a thousand."""

MIN_RELEVANT_MOVE = np.array([0.01, 0.01, np.deg2rad(0.02), 0.001])
"""A move of α that changes what a new matrix would win (numeric units), if it is more than 1 σ."""

MIN_PROPOSAL_LIFETIME_S = 30.0
"""Time during which a proposal is not replaced, even if α is known better: an operator needs it to
read the reason, check the loop and approve, and the gate judges the proposal once more."""

MAX_VERDICT_DISTANCE = np.array([0.01, 0.01, np.deg2rad(0.02), 0.001])
"""Largest distance of a registration from the one of a verdict, numeric units."""


def is_settled(registration: Registration) -> bool:
    """Return True if α is reliable: windows agree, and none of them indicates a jump."""
    sure = registration.suspected_jump is None and not registration.doubt
    return registration.n_windows >= MIN_AGREEING_WINDOWS and sure and registration.usable


def verdict_invalid_reason(
    state: TrackerState, judged: Judged | None, gains: tuple[float, ...]
) -> str | None:
    """Return why a verdict says nothing of a loop with these gains now; None: it does.

    It was taken over α ± 3σ as they were then, which must hold all of α ± 3σ as they are now, but
    for a small ``VERDICT_MARGIN``: σ grows between two windows, and another verdict takes as long.
    """
    registration = state.alpha.registration
    if registration is None or judged is None:
        return None if registration is None else explain_loop_change(state, judged, gains)
    moved = registration.alpha.distance(judged.alpha)
    # The gate examined the ends of the 3 σ ellipsoid: the present one must lie inside the examined
    # one.
    if np.any(moved + 3.0 * registration.sigma > 3.0 * judged.sigma + VERDICT_MARGIN):
        return "α ± 3σ reaches further than it was judged for"
    return explain_loop_change(state, judged, gains)


def verdict_doubtful_reason(
    state: TrackerState, judged: Judged | None, gains: tuple[float, ...]
) -> str | None:
    """Return why a verdict is invalid or α in doubt, or None.

    While α is in doubt no verdict is known to cover it. A reconstructor that was requested by an
    operator is sent all the same.
    """
    registration = state.alpha.registration
    if registration is not None and registration.doubt:
        return registration.doubt
    return verdict_invalid_reason(state, judged, gains)


def explain_loop_change(
    state: TrackerState, judged: Judged | None, gains: tuple[float, ...]
) -> str | None:
    """Return what has changed in the loop since a verdict; None if nothing, or without an RTC.

    The status of an open loop does not contain the gains that it will close with.
    """
    rtc = state.loop.rtc
    if rtc is None:
        return None
    if judged is None:
        return "the loop of its verdict is unknown"
    if judged.session != rtc.session:
        return "the RTC has begun a new session"
    if abs(judged.leak - rtc.leak) > SAME_LEAK:
        return f"the leak was {judged.leak:g}, it is {rtc.leak:g}"
    if abs(judged.delay_frames - rtc.delay_frames) > SAME_DELAY:
        return f"the delay was {judged.delay_frames:g} frames, it is {rtc.delay_frames:g}"
    # The status of an open loop does not contain the gains that it will close with.
    same = rtc.loop == "open" or same_gains(gains, judged.gains)
    return None if same else "the gains have changed"


def update_reason(
    state: TrackerState, in_use: ReconstructorRecord, policy: Policy, now_ns: int
) -> str | None:
    """Return why the reconstructor in use should be replaced now, or None."""
    registration = state.alpha.registration
    if registration is None:
        return None
    if in_use.alpha is None:
        return f"{in_use.id} was not made for a known registration"
    if state.matrices.margin is not None and not state.matrices.margin.accepted:
        return f"{in_use.id}: {state.matrices.margin.reason}"
    if has_moved(state, in_use, policy):
        step = registration.alpha.vector - in_use.alpha.vector
        return f"moved by {step_text(step)} since {in_use.id}"
    if _has_jumped(state, in_use, registration):
        return f"{in_use.id} was made before the mirror jumped"
    last = state.matrices.assessment
    if last is None or last.id != in_use.id:
        return None
    return _gain_reason(last, in_use, registration, policy, now_ns)


def assessment_is_old(state: TrackerState, in_use: ReconstructorRecord) -> bool:
    """Return whether the last judgement of the matrix in use no longer applies.

    Its verdict holds as long as :func:`verdict_invalid_reason` says. What a new one would win
    counts only where α is known to be elsewhere than where the one in use was made for: there every
    move counts.
    """
    registration, last = state.alpha.registration, state.matrices.assessment
    gains = () if state.loop.rtc is None else state.loop.rtc.gains[: in_use.n_modes]
    if verdict_invalid_reason(state, in_use.judged, gains) is not None:
        return True
    if registration is None or last is None:
        return False
    if _step_since(in_use, registration.alpha, registration) is None:
        return False
    noise = np.sqrt(np.diag(registration.covariance))
    return bool(
        np.any(registration.alpha.distance(last.alpha) > np.maximum(MIN_RELEVANT_MOVE, noise))
    )


def _gain_reason(
    last: Assessment,
    in_use: ReconstructorRecord,
    registration: Registration,
    policy: Policy,
    now_ns: int,
) -> str | None:
    """Return what a new one would win, where that is more than the threshold of now."""
    since = _step_since(in_use, last.alpha, registration)
    if since is None:
        return None
    step, covariance = since
    found, since_s = last.expected, (now_ns - in_use.created_ns_utc) / SECOND_NS
    # Soon after an update another one must win more.
    raised = 1.0 + max(0.0, 1.0 - since_s / THRESHOLD_DECAY_S)
    # Noise of α alone would show a loss, which no new matrix recovers.
    win_m = found.loss_m - estimate_noise_loss_m(found.loss_m, step, covariance)
    if win_m > policy.update_gain_m * raised:
        return f"a new one is expected to win {win_m * 1e9:.2f} nm over {in_use.id}"
    share = _margin_lost(last)
    if share > policy.update_margin * raised:
        return (
            f"{in_use.id} has lost {share:.0%} of its stability margin: pole radius "
            f"{found.pole_radius:.3f}, a new one's {found.fresh_pole_radius:.3f}"
        )
    return None


def _margin_lost(last: Assessment) -> float:
    """Return how much of the margin of a new reconstructor the one in use no longer has."""
    # The margin is the distance of the largest pole from the unit circle. A new matrix without any
    # has nothing that could have been lost.
    whole = 1.0 - last.expected.fresh_pole_radius
    return (1.0 - (1.0 - last.expected.pole_radius) / whole) if whole > 0.0 else 0.0


def _step_since(
    in_use: ReconstructorRecord, alpha: Misregistration, registration: Registration
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the step from a matrix's registration to ``alpha``, and its covariance.

    Both are taken as measured: they share the model error, and drift that was added since is not an
    error of either. None if noise explains the step, or the matrix's registration is unknown.
    """
    if in_use.alpha is None or in_use.sigma is None:
        return None
    step = alpha.vector - in_use.alpha.vector
    # The record's σ includes the model error, which must not count as an error of the step. The
    # model error may have grown since: the difference must not be negative.
    then = np.maximum(in_use.sigma**2 - registration.floor**2, 0.0)
    covariance = registration.covariance + np.diag(then)
    far = step @ np.linalg.solve(covariance, step) >= MIN_SIGNIFICANT_STEP
    return (step, covariance) if far else None


def has_moved(state: TrackerState, record: ReconstructorRecord, policy: Policy) -> bool:
    """Return whether α is so far from what this reconstructor was made for that it must go.

    Whatever is expected of it: the linear model knows nothing of how a pyramid's gains change.
    """
    return _apart(state, record, policy.update_threshold)


def _has_jumped(
    state: TrackerState, in_use: ReconstructorRecord, registration: Registration
) -> bool:
    """Return whether the mirror has jumped since, further than the gate's verdict reaches.

    What a new one wins does not matter: what has jumped once may jump again.
    """
    since = (registration.jumped_ns_utc or 0) > in_use.created_ns_utc
    return since and is_outdated(state, in_use)


def is_left_behind(state: TrackerState, record: ReconstructorRecord, policy: Policy) -> bool:
    """Return True if α is so far from this reconstructor that it is obsolete."""
    registration = state.alpha.registration
    return registration is not None and (
        has_moved(state, record, policy) or _has_jumped(state, record, registration)
    )


def is_outdated(state: TrackerState, record: ReconstructorRecord) -> bool:
    """Return whether this reconstructor's verdict is of another registration than the present."""
    return _apart(state, record, MAX_VERDICT_DISTANCE)


def is_beyond_verdict(state: TrackerState, record: ReconstructorRecord) -> bool:
    """Return whether α is certainly outside the range for which this matrix was made and judged."""
    registration = state.alpha.registration
    if registration is None or record.alpha is None or record.sigma is None:
        return False
    # Certainly outside: even the end of α ± 3σ that is nearest to the matrix.
    moved = registration.alpha.distance(record.alpha) - 3.0 * registration.sigma
    return bool(np.any(moved > 3.0 * record.sigma + VERDICT_MARGIN))


def _apart(
    state: TrackerState, record: ReconstructorRecord, threshold: NDArray[np.float64]
) -> bool:
    registration = state.alpha.registration
    if registration is None:
        return False
    if record.alpha is None or record.sigma is None:
        return True
    # σ without the model error: both registrations share that error.
    distance = registration.alpha.distance(record.alpha)
    noise = np.sqrt(np.diag(registration.covariance))
    return bool(np.any(distance > np.maximum(threshold, 3.0 * noise)))


MODE_STEP_RATIO = 1.05
"""Ratio of two numbers of modes that are tried one after the other. A step costs at most 3 nm of
wavefront at 500 and 400 modes, 4 at 100 (FLAO, 1", where 400 leave 117). Halves are tried, so that
six trials find the most of 594 that pass; half of this step would take one more."""

MIN_TRIED_MODES = 30
"""Smallest number of modes that is tried where more are refused."""

FIRST_MODES_DELAY_S = 60.0
"""First delay after the number of modes was lowered before more are tried."""

MAX_MODES_DELAY_S = 1800.0

DECLINED_MODES_DELAY_S = 3600.0
"""Delay after an operator declined more modes: the same hour brings no second proposal."""

MODES_LIMIT_MEMORY_S = 3600.0
"""A limit found again later than this has nothing to do with the last one."""

MORE_MODES_MARGIN_RATIO = 1.5
"""More modes are tried only while there is this times the margin that the gate asks for."""


def half_of_modes(n_modes: int) -> int:
    """Return half of ``n_modes``, or all of them where half is below ``MIN_TRIED_MODES``."""
    return n_modes if n_modes // 2 < MIN_TRIED_MODES else n_modes // 2


def fewer_modes_than(n_modes: int) -> tuple[int, ...]:
    """Return the numbers of modes that are tried where ``n_modes`` fail, largest first."""
    n_steps = max(int(np.log(n_modes / MIN_TRIED_MODES) / np.log(MODE_STEP_RATIO)), 0)
    return tuple(round(n_modes / MODE_STEP_RATIO**k) for k in range(1, n_steps + 1))


def more_modes_to_try(
    state: TrackerState, rtc: Status, policy: Policy, now_ns: int
) -> tuple[int, ...]:
    """Return the numbers of modes above the present one that may be tried now, largest first.

    New modes get the gain of the last: where that is 0 they would not be in the loop.
    """
    # Added modes get the gain of the last one.
    if not rtc.gains[rtc.n_controlled - 1]:
        return ()
    target = policy.wanted_modes(rtc)
    limit = state.matrices.mode_limit
    # The end of the delay alone is not enough: the present number of modes must have margin to
    # spare.
    if limit is not None and (now_ns < limit.until_ns_utc or not _comfortable(state)):
        target = min(target, limit.n_modes)
    rungs = {target, *fewer_modes_than(target)}
    return tuple(sorted((rung for rung in rungs if rung > rtc.n_controlled), reverse=True))


def _comfortable(state: TrackerState) -> bool:
    margin = state.matrices.margin
    if margin is None or not margin.accepted:
        return False
    return 1.0 - margin.worst_pole_radius >= MORE_MODES_MARGIN_RATIO * (1.0 - margin.bound)


def forget_limit(context: StepContext) -> None:
    """Forget how many modes could be controlled: the sensor is in another mode."""
    context.matrices = replace(context.matrices, mode_limit=None)


def note_limit(
    context: StepContext, record: ReconstructorRecord, asked: int, why_fewer: str
) -> None:
    """Note what a reconstructor asked to have ``asked`` modes says of how many are possible."""
    n_now = context.rtc.n_controlled if context.rtc is not None else record.n_modes
    if record.state is MatrixState.REFUSED:
        if asked > n_now:
            reason = record.gate.reason if record.gate is not None else record.reason
            limit_modes(context, n_now, reason)
        return
    if record.n_modes < asked:
        limit_modes(context, record.n_modes, why_fewer)
    text = f"{record.id} has {record.n_modes} modes, {n_now} are controlled"
    if record.n_modes < n_now:
        context.warn("modes.lowered", f"{text}: {why_fewer}")
        return
    if record.n_modes > n_now:
        context.log("modes.raised", text)
    limit = context.matrices.mode_limit
    if limit is not None and record.n_modes > limit.n_modes:
        # kept: a limit found again soon must be waited out longer
        context.matrices = replace(
            context.matrices, mode_limit=replace(limit, n_modes=record.n_modes)
        )


def limit_declined(
    context: StepContext, record: ReconstructorRecord, first_wait_s: float = FIRST_MODES_DELAY_S
) -> None:
    """Try no more modes for a while, longer each time, after a reconstructor was declined.

    If it has more modes than are controlled, that is what it was made for. An acquisition counts
    its own failures.
    """
    rtc = context.rtc or context.before.loop.rtc
    if rtc is None or context.acquisition.under_way:
        return
    if 0 < rtc.n_controlled < record.n_modes:
        reason = f"{record.id} was {record.state}: {record.reason}"
        limit_modes(context, rtc.n_controlled, reason, first_wait_s)


def limit_modes(
    context: StepContext, n_modes: int, reason: str, first_wait_s: float = FIRST_MODES_DELAY_S
) -> None:
    """Try no more than these for a while, longer each time that it is found again."""
    before, wait_s, now_ns = context.matrices.mode_limit, first_wait_s, context.now_ns
    if before is not None and now_ns - before.since_ns_utc < MODES_LIMIT_MEMORY_S * SECOND_NS:
        left_s = (before.until_ns_utc - now_ns) / SECOND_NS
        # The wait is doubled with each failure, up to 30 min (docs/decisions/0023-update-
        # policy.md).
        wait_s = max(first_wait_s, min(2.0 * before.wait_s, MAX_MODES_DELAY_S), left_s)
    limit = ModeLimit(
        n_modes=n_modes,
        since_ns_utc=now_ns,
        until_ns_utc=now_ns + round(wait_s * SECOND_NS),
        wait_s=wait_s,
        reason=reason,
    )
    context.matrices = replace(context.matrices, mode_limit=limit)
    context.log("modes.limited", f"no more than {n_modes} modes for {wait_s:.0f} s: {reason}")
