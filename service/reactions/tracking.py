"""Measurements of α become the registration: the joint filter, its jumps and its outliers.

One window far out may be a jump or a mistake. It is held, nothing is made from α meanwhile, and
the next window decides: one that agrees with it makes it a jump, one that agrees with all before
makes it an outlier. A jump that one window alone cannot tell from noise is told by two together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

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
from service.reactions.evidence import pointing_at, precedes
from service.reactions.journal import logged, with_alarm
from service.reactions.policy import SECOND_NS, Policy
from service.reactions.surprise import (
    Distance,
    Reading,
    pair_surprise,
    wholly_after,
    window_before,
    window_surprise,
)
from service.reactions.validity import aged, with_dither_due
from service.state import Candidate, Level, Registration, Seen, TrackerState
from service.telemetry.wind import (
    Joint,
    begin_joint,
    dithered_innovation,
    widened,
    with_dithered,
)

TOO_EARLY = (
    "it began before α came into doubt and agrees with what was known then: only one taken since "
    "can tell"
)


def with_window(
    state: TrackerState, measured: Measured, policy: Policy, now_ns: int
) -> TrackerState:
    """Fold a dithered window in, hold it, or have it decide about the one held before."""
    known = state.registration
    if known is None:
        joint = begin_joint(measured.alpha.vector, measured.covariance)
        folded = Folded(joint=joint, n_windows=1, innovation=0.0)
        return accepted(state, folded, measured, policy, now_ns)
    reading = _reading(measured, state)
    first = window_before(known)
    if first is not None and pair_surprise(known, reading, policy).far:
        return _jumped(state, first, measured, policy, now_ns)
    far = window_surprise(known, reading, policy)
    if known.doubt and not far.far and precedes(state, measured.when, known.doubted_ns_utc):
        state = replace(state, windows_refused=state.windows_refused + 1)
        return logged(state, "window.refused", TOO_EARLY, now_ns)
    if known.candidate is not None:
        state = _outlier(state, known.candidate, measured, now_ns)
    if far.far:
        return _held(state, measured, far, policy, now_ns)
    prior = brought_forward(state, known, measured.t_ns_utc, policy, now_ns)
    folded = Folded(
        joint=with_dithered(prior, measured.alpha.vector, measured.covariance),
        n_windows=counted(state, known, prior, policy),
        innovation=_innovation(prior, measured),
    )
    return accepted(state, folded, measured, policy, now_ns)


def _held(
    state: TrackerState, measured: Measured, far: Distance, policy: Policy, now_ns: int
) -> TrackerState:
    """Put a window that is far out aside, and doubt α until another one has come."""
    known, innovation = _known(state), far.innovation
    text = (
        f"a window lies {_step(measured, known)} from α (innovation {innovation:.0f}, expected 4, "
        f"rotation {np.sqrt(far.rotation):.1f} sigma): the next one decides; nothing is made or "
        "sent meanwhile"
    )
    candidate = Candidate(
        alpha=measured.alpha,
        covariance=measured.covariance,
        t_ns_utc=measured.t_ns_utc,
        held_ns_utc=now_ns,
        innovation=innovation,
    )
    since_ns = max(known.doubted_ns_utc if known.doubt else 0, measured.t_ns_utc)
    doubted = replace(
        known, candidate=candidate, doubt="a jump is suspected", doubted_ns_utc=since_ns
    )
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
    state: TrackerState, first: Seen, measured: Measured, policy: Policy, now_ns: int
) -> TrackerState:
    """Return the state at the new place, which two windows have now seen.

    The first of them is used if it is wholly of the new place.
    """
    known = _known(state)
    prior = brought_forward(state, known, measured.t_ns_utc, policy, now_ns)
    noise = measured.covariance
    whole = wholly_after(first, _reading(measured, state), known.alpha.vector, policy)
    if whole:
        elapsed_s = max(measured.t_ns_utc - first.t_ns_utc, 0) / SECOND_NS
        noise = first.covariance + np.diag(policy.drift_rate**2 * elapsed_s)
    joint = widened(prior, noise)
    if whole:
        joint = with_dithered(joint, first.alpha.vector, noise)
    joint = with_dithered(joint, measured.alpha.vector, measured.covariance)
    state = replace(
        state,
        windows_accepted=state.windows_accepted + (whole and known.candidate is not None),
        registration=replace(known, passive_after_ns_utc=first.t_ns_utc),
    )
    folded = Folded(
        joint=joint,
        n_windows=2 if whole else 1,
        innovation=_innovation(prior, measured),
        jumped=True,
    )
    state = accepted(state, folded, measured, policy, now_ns)
    text = f"jumped by {_step(measured, known)}, as two windows have seen"
    return logged(state, "registration.jump", text, now_ns, Level.WARNING)


def _reading(measured: Measured, state: TrackerState) -> Reading:
    return Reading(
        value=measured.alpha.vector,
        noise=measured.covariance,
        t_ns_utc=measured.t_ns_utc,
        pointing=pointing_at(state, measured.t_ns_utc),
    )


def _known(state: TrackerState) -> Registration:
    if state.registration is None:
        raise ValueError("no α is known: there is nothing to doubt")
    return state.registration


def _innovation(prior: Joint, measured: Measured) -> float:
    return dithered_innovation(prior, measured.alpha.vector, measured.covariance)


def _step(measured: Measured | Candidate, known: Registration) -> str:
    step = (measured.alpha.vector - known.alpha.vector) * BOUNDARY_SCALE
    return f"{step[0]:+.3f}, {step[1]:+.3f} subap, {step[2]:+.3f} deg, {step[3]:+.4f}"
