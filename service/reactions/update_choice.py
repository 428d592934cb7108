"""When the reconstructor in use is judged, and when another is made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.events import JudgeMatrix, MakeMatrix
from service.model.misregistration import BOUNDARY_SCALE
from service.reactions.matrices import Step
from service.reactions.policy import SECOND_NS, Policy
from service.state import MatrixState, Mode, ReconstructorRecord, RtcView, TrackerState

MIN_WINDOWS = 2
"""Windows that must agree before anything is made from them."""

JUDGE_INTERVAL_S = 10.0
"""Least time between two looks at the margin of the matrix in use."""

_SENT = (MatrixState.PUBLISHED, MatrixState.STAGED)


def judge_in_use(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Look at the margin of the matrix in use once α is known, and now and then."""
    if state.registration is None or state.in_use is None:
        return state, ()
    if state.registration.n_windows < MIN_WINDOWS or state.making_since_ns_utc is not None:
        return state, ()
    waited = state.judged_ns_utc is None or (
        now_ns - state.judged_ns_utc > JUDGE_INTERVAL_S * SECOND_NS
    )
    if not waited:
        return state, ()
    return replace(state, judged_ns_utc=now_ns), (JudgeMatrix(id=state.in_use),)


def choose_update(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Compute a reconstructor when the one in use no longer fits α, or could command more modes."""
    registration = state.registration
    if state.mode is Mode.HOLD or registration is None or registration.n_windows < MIN_WINDOWS:
        return state, ()
    if not registration.usable:
        return state, ()
    if rtc.loop != "closed" or state.making_since_ns_utc is not None:
        return state, ()
    if _busy(state, policy) or now_ns < max(_next_attempt_ns(state, policy), state.retry_ns_utc):
        return state, ()
    in_use = state.reconstructor(state.in_use) if state.in_use else None
    if in_use is None:
        return state, ()
    target = min(policy.n_modes_target, rtc.n_modes)
    if moved(state, in_use, policy):
        effect = MakeMatrix(n_modes=rtc.n_controlled, why=_why_moved(state, in_use))
    elif rtc.n_controlled < target:
        effect = MakeMatrix(n_modes=target, why=f"{rtc.n_controlled} of {target} modes controlled")
    else:
        return state, ()
    return replace(state, making_since_ns_utc=now_ns), (effect,)


def moved(state: TrackerState, record: ReconstructorRecord, policy: Policy) -> bool:
    """Return whether α has moved from what this reconstructor was made for, beyond noise."""
    if state.registration is None:
        return False
    if record.alpha is None or record.sigma is None:
        return True
    distance = np.abs(state.registration.alpha.vector - record.alpha.vector)
    noise = np.sqrt(np.diag(state.registration.covariance))
    return bool(np.any(distance > np.maximum(policy.update_threshold, 3.0 * noise)))


def _why_moved(state: TrackerState, record: ReconstructorRecord) -> str:
    if record.alpha is None or state.registration is None:
        return f"{record.id} was not made for a known registration"
    step = (state.registration.alpha.vector - record.alpha.vector) * BOUNDARY_SCALE
    return (
        f"moved by {step[0]:+.3f}, {step[1]:+.3f} subap, {step[2]:+.3f} deg, {step[3]:+.4f} "
        f"since {record.id}"
    )


def _busy(state: TrackerState, policy: Policy) -> bool:
    """Return whether a reconstructor is on its way, or one that fits α awaits an operator.

    In auto nobody is going to decide on a proposal left from another mode or an absent RTC.
    """
    return any(
        r.state in _SENT
        or (
            r.state is MatrixState.PROPOSED
            and state.mode is not Mode.AUTO
            and not moved(state, r, policy)
        )
        for r in state.reconstructors
    )


def _next_attempt_ns(state: TrackerState, policy: Policy) -> int:
    """Return before when no reconstructor is computed by itself."""
    own = [r for r in state.reconstructors if r.parent is not None]
    if not own:
        return 0
    last = own[-1]
    failed = (MatrixState.REFUSED, MatrixState.REJECTED, MatrixState.FAILED, MatrixState.DISCARDED)
    wait_s = policy.refused_interval_s if last.state in failed else policy.minimum_interval_s
    return last.created_ns_utc + int(wait_s * SECOND_NS)
