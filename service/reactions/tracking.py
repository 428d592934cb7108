"""Measurements of α become the registration: the joint filter, its jumps and its outliers.

One window far out may be a jump or a mistake. It is held, nothing is made from α meanwhile, and
the next window decides: one that agrees with it makes it a jump, one that agrees with all before
makes it an outlier.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.estimation.wind import (
    JUMP_THRESHOLD,
    Joint,
    begin_joint,
    dithered_innovation,
    widened,
    with_dithered,
)
from service.model.misregistration import BOUNDARY_SCALE
from service.reactions.estimate import (
    SUSPECTED,
    Folded,
    Measured,
    accepted,
    brought_forward,
    counted,
    entry_of,
    remembered,
)
from service.reactions.journal import logged, with_alarm
from service.reactions.policy import SECOND_NS, Policy
from service.reactions.surprise import VARYING, Reading, window_surprise
from service.reactions.validity import aged, with_dither_due
from service.state import Candidate, Level, Registration, TrackerState

Array = NDArray[np.float64]


def with_window(
    state: TrackerState, measured: Measured, policy: Policy, now_ns: int
) -> TrackerState:
    """Fold a dithered window in, hold it, or have it decide about the one held before."""
    known = state.registration
    if known is None:
        joint = begin_joint(measured.alpha.vector, measured.covariance)
        folded = Folded(joint=joint, n_windows=1, innovation=0.0)
        return accepted(state, folded, measured, policy, now_ns)
    prior = brought_forward(state, known, measured.t_ns_utc, policy, now_ns)
    far = window_surprise(known, _reading(measured, state), policy)
    if known.candidate is not None:
        aside = _distance(known.candidate, measured, policy)
        if aside <= JUMP_THRESHOLD and aside < far:
            return _jumped(state, prior, measured, policy, now_ns)
        state = _outlier(state, known.candidate, measured, now_ns)
    if far > JUMP_THRESHOLD:
        return _held(state, measured, far, policy, now_ns)
    folded = Folded(
        joint=with_dithered(prior, measured.alpha.vector, measured.covariance),
        n_windows=counted(state, known, prior, policy),
        innovation=_innovation(prior, measured),
    )
    return accepted(state, folded, measured, policy, now_ns)


def _held(
    state: TrackerState, measured: Measured, innovation: float, policy: Policy, now_ns: int
) -> TrackerState:
    """Put a window that is far out aside, and doubt α until another one has come."""
    known = _known(state)
    text = (
        f"a window lies {_step(measured, known)} from α (innovation {innovation:.0f}, expected 4): "
        "the next one decides; nothing is made or sent meanwhile"
    )
    candidate = Candidate(
        alpha=measured.alpha,
        covariance=measured.covariance,
        t_ns_utc=measured.t_ns_utc,
        held_ns_utc=now_ns,
        innovation=innovation,
    )
    doubted = replace(known, candidate=candidate, doubt="a jump is suspected")
    state = remembered(
        replace(state, registration=doubted), entry_of(measured, known, innovation, entered=False)
    )
    state = logged(state, "registration.jump-suspected", text, now_ns, Level.WARNING)
    state = with_dither_due(with_alarm(state, SUSPECTED, text, now_ns), doubted.doubt, now_ns)
    return aged(state, policy, now_ns)


def _outlier(
    state: TrackerState, candidate: Candidate, measured: Measured, now_ns: int
) -> TrackerState:
    """Count the window held before: the one after it has not confirmed it."""
    known = _known(state)
    text = (
        f"the window {_step(candidate, known)} from α was not confirmed: the one after it lies "
        f"{_step(measured, known)} away"
    )
    state = replace(state, windows_outlying=state.windows_outlying + 1)
    return logged(state, "window.outlier", text, now_ns, Level.WARNING)


def _jumped(
    state: TrackerState, prior: Joint, measured: Measured, policy: Policy, now_ns: int
) -> TrackerState:
    """Return the state at the new place, which two windows have now seen."""
    known = _known(state)
    candidate = known.candidate
    if candidate is None:
        raise ValueError("no window is held: nothing has jumped")
    noise = candidate.covariance + _walked(candidate, measured, policy)
    joint = with_dithered(widened(prior, noise), candidate.alpha.vector, noise)
    joint = with_dithered(joint, measured.alpha.vector, measured.covariance)
    state = replace(
        state,
        windows_accepted=state.windows_accepted + 1,
        registration=replace(known, passive_after_ns_utc=candidate.t_ns_utc),
    )
    folded = Folded(joint=joint, n_windows=2, innovation=_innovation(prior, measured))
    state = accepted(state, folded, measured, policy, now_ns)
    text = f"jumped by {_step(measured, known)}, as two windows have seen"
    return logged(state, "registration.jump", text, now_ns, Level.WARNING)


def _reading(measured: Measured, state: TrackerState) -> Reading:
    return Reading(
        value=measured.alpha.vector,
        noise=measured.covariance,
        t_ns_utc=measured.t_ns_utc,
        pointing=state.pointing,
    )


def _known(state: TrackerState) -> Registration:
    if state.registration is None:
        raise ValueError("no α is known: there is nothing to doubt")
    return state.registration


def _innovation(prior: Joint, measured: Measured) -> float:
    return dithered_innovation(prior, measured.alpha.vector, measured.covariance)


def _distance(candidate: Candidate, measured: Measured, policy: Policy) -> float:
    """Return how far two windows lie apart: squared, normalised, expected 4."""
    difference = measured.alpha.vector - candidate.alpha.vector
    walked = _walked(candidate, measured, policy)
    varied = np.diag(2.0 * (VARYING * policy.floor) ** 2)
    total = candidate.covariance + measured.covariance + walked + varied
    return float(difference @ np.linalg.solve(total, difference))


def _walked(candidate: Candidate, measured: Measured, policy: Policy) -> Array:
    """Return ``(4, 4)`` what α may have drifted from one window to the other."""
    elapsed_s = max(measured.t_ns_utc - candidate.t_ns_utc, 0) / SECOND_NS
    return np.diag(policy.drift_rate**2 * elapsed_s)


def _step(measured: Measured | Candidate, known: Registration) -> str:
    step = (measured.alpha.vector - known.alpha.vector) * BOUNDARY_SCALE
    return f"{step[0]:+.3f}, {step[1]:+.3f} subap, {step[2]:+.3f} deg, {step[3]:+.4f}"
