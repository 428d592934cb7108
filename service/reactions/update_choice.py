"""When the reconstructor in use is judged, and when another is made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.events import JudgeMatrix, MakeMatrix
from service.reactions.alarms import Act, forbidding
from service.reactions.matrices import Step
from service.reactions.mode_ladder import fewer_than, more_to_try
from service.reactions.policy import SECOND_NS, Policy
from service.reactions.verdicts import settled
from service.reactions.worth import outdated, why_worthwhile
from service.state import (
    MatrixState,
    Mode,
    ReconstructorRecord,
    Registration,
    RtcView,
    TrackerState,
)

JUDGE_INTERVAL_S = 15.0
"""Least time between two looks at the margin of the matrix in use, while α stays: with 594 modes
it takes 2.4 s of a core."""

JUDGE_AGAIN_S = 2.0
"""The same when α has moved."""

NOTICED = np.array([0.01, 0.01, np.deg2rad(0.02), 0.001])
"""A move of α that calls for a look at once (numeric units), if it is more than 1 σ."""

_SENT = (MatrixState.PUBLISHED, MatrixState.STAGED)


def judge_in_use(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Look at the margin of the matrix in use once α is known, when it moves, and now and then."""
    known = state.registration
    if known is None or state.in_use is None or not settled(known):
        return state, ()
    if state.making_since_ns_utc is not None or not _judgement_due(state, known, now_ns):
        return state, ()
    return replace(state, judged_ns_utc=now_ns), (JudgeMatrix(id=state.in_use),)


def _judgement_due(state: TrackerState, known: Registration, now_ns: int) -> bool:
    if state.judged_ns_utc is None:
        return True
    waited_s = (now_ns - state.judged_ns_utc) / SECOND_NS
    last = state.assessment
    if waited_s > JUDGE_INTERVAL_S or last is None:
        return waited_s > JUDGE_INTERVAL_S
    moved = np.abs(known.alpha.vector - last.alpha.vector)
    noise = np.sqrt(np.diag(known.covariance))
    return waited_s > JUDGE_AGAIN_S and bool(np.any(moved > np.maximum(NOTICED, noise)))


def choose_update(state: TrackerState, rtc: RtcView, policy: Policy, now_ns: int) -> Step:
    """Compute a reconstructor when it is worthwhile, or could command more modes."""
    known = state.registration
    if state.mode is Mode.HOLD or known is None or not settled(known):
        return state, ()
    if not rtc.in_loop or state.making_since_ns_utc is not None:
        return state, ()
    if forbidding(state, Act.SEND_NEW) is not None:
        return state, ()
    first_ns = max(_next_attempt_ns(state, rtc, policy), state.retries.make_ns_utc)
    if _busy(state) or now_ns < first_ns:
        return state, ()
    in_use = state.reconstructor(state.in_use) if state.in_use else None
    if in_use is None:
        return state, ()
    why, n_now = why_worthwhile(state, in_use, policy, now_ns), rtc.n_controlled
    more = () if why is not None else more_to_try(state, rtc, policy, now_ns)
    if why is not None:
        effect = MakeMatrix(n_modes=n_now, why=why, fewer=fewer_than(n_now))
    elif more:
        why = f"{n_now} of {more[0]} modes controlled"
        effect = MakeMatrix(n_modes=more[0], why=why, fewer=more[1:])
    else:
        return state, ()
    return replace(state, making_since_ns_utc=now_ns), (effect,)


def _busy(state: TrackerState) -> bool:
    """Return whether a reconstructor is on its way, or one that fits α awaits an operator.

    In auto nobody is going to decide on a proposal left from another mode or an absent RTC.
    """
    return any(
        r.state in _SENT
        or (
            r.state is MatrixState.PROPOSED
            and state.mode is not Mode.AUTO
            and not outdated(state, r)
        )
        for r in state.reconstructors
    )


def _next_attempt_ns(state: TrackerState, rtc: RtcView, policy: Policy) -> int:
    """Return before when no reconstructor is computed by itself.

    One refused for another α, or for more modes than are controlled, holds back no other.
    """
    own = [r for r in state.reconstructors if r.parent is not None and not _overtaken(state, r)]
    if not own:
        return 0
    last = own[-1]
    failed = (MatrixState.REFUSED, MatrixState.REJECTED, MatrixState.FAILED, MatrixState.DISCARDED)
    again = last.state in failed and not outdated(state, last) and last.n_modes <= rtc.n_controlled
    wait_s = policy.refused_interval_s if again else policy.minimum_interval_s
    return last.created_ns_utc + int(wait_s * SECOND_NS)


def _overtaken(state: TrackerState, record: ReconstructorRecord) -> bool:
    """Return whether a reconstructor was never sent, and α is elsewhere by now."""
    return record.state is MatrixState.DISCARDED and outdated(state, record)
