"""Whether another reconstructor is worth a swap: what it would win, beyond noise, and how soon."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.control.expected_gain import explained_by_noise
from service.model.misregistration import BOUNDARY_SCALE
from service.reactions.policy import SECOND_NS, Policy
from service.state import Assessment, ReconstructorRecord, Registration, TrackerState

CALMING_S = 60.0
"""After an update the thresholds are doubled, and come down to their own over this time."""

SIGNIFICANT = 18.5
"""Squared distance, in σ, of a step of four parameters that noise makes once in a thousand."""

VERDICT_REACH = np.array([0.01, 0.01, np.deg2rad(0.02), 0.001])
"""A verdict of the gate is not for a registration further away than this (numeric units)."""


def why_worthwhile(
    state: TrackerState, in_use: ReconstructorRecord, policy: Policy, now_ns: int
) -> str | None:
    """Return why the reconstructor in use should be replaced now, or None."""
    known = state.registration
    if known is None:
        return None
    if in_use.alpha is None:
        return f"{in_use.id} was not made for a known registration"
    if state.margin is not None and not state.margin.accepted:
        return f"{in_use.id}: {state.margin.reason}"
    if moved(state, in_use, policy):
        step = (known.alpha.vector - in_use.alpha.vector) * BOUNDARY_SCALE
        return (
            f"moved by {step[0]:+.3f}, {step[1]:+.3f} subap, {step[2]:+.3f} deg, {step[3]:+.4f} "
            f"since {in_use.id}"
        )
    if _jumped(state, in_use, known):
        return f"{in_use.id} was made before the mirror jumped"
    last = state.assessment
    if last is None or last.id != in_use.id:
        return None
    return _why_gaining(last, in_use, known, policy, now_ns)


def _why_gaining(
    last: Assessment,
    in_use: ReconstructorRecord,
    known: Registration,
    policy: Policy,
    now_ns: int,
) -> str | None:
    """Return what a new one would win, where that is more than the threshold of now."""
    covariance = _of_step(in_use, known)
    if covariance is None or in_use.alpha is None:
        return None
    step = last.alpha.vector - in_use.alpha.vector
    if step @ np.linalg.solve(covariance, step) < SIGNIFICANT:
        return None
    found, raised = last.expected, _raised(in_use, now_ns)
    win_m = found.loss_m - explained_by_noise(found.loss_m, step, covariance)
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
    whole = 1.0 - last.expected.fresh_pole_radius
    return (1.0 - (1.0 - last.expected.pole_radius) / whole) if whole > 0.0 else 0.0


def _raised(in_use: ReconstructorRecord, now_ns: int) -> float:
    """Return by how much the thresholds are raised so soon after an update."""
    since_s = (now_ns - in_use.created_ns_utc) / SECOND_NS
    return 1.0 + max(0.0, 1.0 - since_s / CALMING_S)


def _of_step(in_use: ReconstructorRecord, known: Registration) -> NDArray[np.float64] | None:
    """Return the covariance of what separates two registrations, as both were measured.

    They share the model error; what drift may have added since is no error of either.
    """
    if in_use.sigma is None:
        return None
    then = np.maximum(in_use.sigma**2 - known.floor**2, 0.0)
    return np.asarray(known.covariance + np.diag(then))


def moved(state: TrackerState, record: ReconstructorRecord, policy: Policy) -> bool:
    """Return whether α is so far from what this reconstructor was made for that it must go.

    Whatever is expected of it: the linear model knows nothing of how a pyramid's gains change.
    """
    return _apart(state, record, policy.update_threshold)


def _jumped(state: TrackerState, in_use: ReconstructorRecord, known: Registration) -> bool:
    """Return whether the mirror has jumped since, further than the gate's verdict reaches.

    What a new one wins does not matter: what has jumped once may jump again.
    """
    since = known.jumped_ns_utc is not None and known.jumped_ns_utc > in_use.created_ns_utc
    return since and outdated(state, in_use)


def outdated(state: TrackerState, record: ReconstructorRecord) -> bool:
    """Return whether this reconstructor's verdict is of another registration than the present."""
    return _apart(state, record, VERDICT_REACH)


def _apart(
    state: TrackerState, record: ReconstructorRecord, threshold: NDArray[np.float64]
) -> bool:
    known = state.registration
    if known is None:
        return False
    if record.alpha is None or record.sigma is None:
        return True
    distance = np.abs(known.alpha.vector - record.alpha.vector)
    noise = np.sqrt(np.diag(known.covariance))
    return bool(np.any(distance > np.maximum(threshold, 3.0 * noise)))
