"""Measurements of α become the registration: the joint filter, its jumps and its outliers.

One window far out may be a jump or a mistake. It is held, nothing is made from α meanwhile, and
the next window decides: one that agrees with it makes it a jump, one that agrees with all before
makes it an outlier.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.estimation.wind import (
    JUMP_THRESHOLD,
    Drift,
    Joint,
    begin_joint,
    dithered_innovation,
    predicted,
    widened,
    with_dithered,
)
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.reactions.journal import logged, with_alarm, without_alarm
from service.reactions.policy import SECOND_NS, Policy
from service.reactions.validity import (
    aged,
    flexure,
    slewed_deg,
    with_dither_due,
    without_dither_due,
)
from service.state import (
    Candidate,
    HistoryEntry,
    Level,
    ModeGain,
    PassiveBias,
    Registration,
    Source,
    TrackerState,
)

HISTORY_LENGTH = 5000

SUSPECTED = "jump-suspected"
"""Alarm while a window far out waits for the one that decides about it."""

PASSIVE_BLIND_S = 30.0
"""After a jump: three times what the passive sums remember, so that 5 % of it are left in them."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measured:
    """What one dithered window says of α."""

    alpha: Misregistration
    covariance: Array
    """``(4, 4)`` numeric units, from its own data."""

    t_ns_utc: int
    """End of the window, the RTC's clock."""

    source: Source
    optical_gain: float
    """Mean modulus of the gains of the dithered modes."""

    optical_gains: tuple[ModeGain, ...]
    """Those of every mode known, this window's included."""


def with_window(
    state: TrackerState, measured: Measured, policy: Policy, now_ns: int
) -> TrackerState:
    """Fold a dithered window in, hold it, or have it decide about the one held before."""
    known = state.registration
    if known is None:
        joint = begin_joint(measured.alpha.vector, measured.covariance)
        return _accepted(state, joint, measured, policy, now_ns, n_windows=1, innovation=0.0)
    prior = brought_forward(state, known, measured.t_ns_utc, policy, now_ns)
    innovation = dithered_innovation(prior, measured.alpha.vector, measured.covariance)
    if known.candidate is not None:
        return _decided(state, prior, measured, innovation, policy, now_ns)
    if innovation > JUMP_THRESHOLD:
        return _held(state, known, measured, innovation, policy, now_ns)
    joint = with_dithered(prior, measured.alpha.vector, measured.covariance)
    return _accepted(
        state,
        joint,
        measured,
        policy,
        now_ns,
        n_windows=_counted(state, known, prior, policy),
        innovation=innovation,
    )


def brought_forward(
    state: TrackerState, known: Registration, t_ns_utc: int, policy: Policy, now_ns: int
) -> Joint:
    """Return what is known at a time of the RTC's clock, drift and flexure since then added."""
    elapsed_ns = t_ns_utc - known.t_ns_utc
    if elapsed_ns < -int(policy.window_s * SECOND_NS):
        # a clock that was set back, or another night played again: the service's own must do
        elapsed_ns = now_ns - known.arrived_ns_utc
    drift = Drift(alpha_rate=policy.drift_rate, bias_memory_s=policy.bias_memory_s)
    bent = flexure(known.pointing, state.pointing, policy)
    return predicted(joint_of(known), drift, elapsed_ns / SECOND_NS, bent)


def joint_of(known: Registration) -> Joint:
    """Return the filter's state that a registration holds."""
    fresh = begin_joint(known.alpha.vector, known.covariance)
    bias = known.bias
    if bias is None:
        return fresh
    covariance = fresh.covariance.copy()
    covariance[4:, 4:] = bias.covariance
    covariance[4:, :4], covariance[:4, 4:] = bias.shared, bias.shared.T
    return Joint(mean=np.concatenate([known.alpha.vector, bias.offset]), covariance=covariance)


def bias_of(joint: Joint, looked_ns_utc: int) -> PassiveBias:
    """Return what the filter knows of the passive estimate's bias."""
    return PassiveBias(
        offset=joint.bias,
        covariance=joint.covariance[4:, 4:],
        shared=joint.covariance[4:, :4],
        looked_ns_utc=looked_ns_utc,
    )


def remembered(state: TrackerState, entry: HistoryEntry) -> TrackerState:
    """Return the state with one more line in its history."""
    return replace(state, history=(*state.history, entry)[-HISTORY_LENGTH:])


def _counted(state: TrackerState, known: Registration, prior: Joint, policy: Policy) -> int:
    """Return how many windows agree after this one: it stands alone where α had gone stale."""
    sigma = np.sqrt(np.diag(prior.alpha_covariance) + known.floor**2)
    alone = slewed_deg(state, known) > policy.slew_limit_deg or np.any(sigma > policy.stale_sigma)
    return 1 if alone else known.n_windows + 1


def _accepted(
    state: TrackerState,
    joint: Joint,
    measured: Measured,
    policy: Policy,
    now_ns: int,
    *,
    n_windows: int,
    innovation: float,
) -> TrackerState:
    """Return the state whose registration is what the filter says after a window."""
    known = state.registration
    looked_ns_utc = known.bias.looked_ns_utc if known is not None and known.bias is not None else 0
    registration = Registration(
        alpha=Misregistration.from_vector(joint.alpha),
        covariance=joint.alpha_covariance,
        floor=policy.floor,
        t_ns_utc=measured.t_ns_utc,
        arrived_ns_utc=now_ns,
        n_windows=n_windows,
        window_ns_utc=now_ns,
        optical_gain=measured.optical_gain,
        optical_gains=measured.optical_gains,
        bias=bias_of(joint, looked_ns_utc),
        passive_after_ns_utc=known.passive_after_ns_utc if known is not None else 0,
        pointing=state.pointing,
        window_pointing=state.pointing,
        restored_ns_utc=known.restored_ns_utc if known is not None else None,
        basis_id=state.basis_id,
        config_id=state.config_id,
    )
    state = replace(state, registration=registration, windows_accepted=state.windows_accepted + 1)
    state = without_alarm(without_dither_due(state), SUSPECTED, now_ns)
    state = without_alarm(state, "watchdog", now_ns)
    state = remembered(state, _entry(measured, registration, innovation))
    return aged(state, policy, now_ns)


def _entry(
    measured: Measured, registration: Registration, innovation: float, *, entered: bool = True
) -> HistoryEntry:
    return HistoryEntry(
        t_ns_utc=measured.t_ns_utc,
        measured=measured.alpha,
        measured_sigma=np.sqrt(np.diag(measured.covariance)),
        filtered=registration.alpha,
        filtered_sigma=registration.sigma,
        innovation=innovation,
        source=measured.source,
        entered=entered,
    )


def _held(
    state: TrackerState,
    known: Registration,
    measured: Measured,
    innovation: float,
    policy: Policy,
    now_ns: int,
) -> TrackerState:
    """Put a window that is far out aside, and doubt α until another one has come."""
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
        replace(state, registration=doubted), _entry(measured, known, innovation, entered=False)
    )
    state = logged(state, "registration.jump-suspected", text, now_ns, Level.WARNING)
    state = with_dither_due(with_alarm(state, SUSPECTED, text, now_ns), doubted.doubt, now_ns)
    return aged(state, policy, now_ns)


def _decided(
    state: TrackerState,
    prior: Joint,
    measured: Measured,
    innovation: float,
    policy: Policy,
    now_ns: int,
) -> TrackerState:
    """Return what a window makes of the one held before it, whichever of both places it is at."""
    known = state.registration
    if known is None or known.candidate is None:
        raise ValueError("no window is held: there is nothing to decide")
    candidate = known.candidate
    aside = _distance(candidate, measured, policy)
    if aside <= JUMP_THRESHOLD and aside < innovation:
        return _jumped(state, known, candidate, prior, measured, policy, now_ns)
    state = replace(state, windows_outlying=state.windows_outlying + 1)
    text = (
        f"the window {_step(candidate, known)} from α was not confirmed: the one after it lies "
        f"{_step(measured, known)} away"
    )
    state = logged(state, "window.outlier", text, now_ns, Level.WARNING)
    if innovation > JUMP_THRESHOLD:
        return _held(state, known, measured, innovation, policy, now_ns)
    joint = with_dithered(prior, measured.alpha.vector, measured.covariance)
    n_windows = _counted(state, known, prior, policy)
    return _accepted(
        state, joint, measured, policy, now_ns, n_windows=n_windows, innovation=innovation
    )


def _jumped(
    state: TrackerState,
    known: Registration,
    candidate: Candidate,
    prior: Joint,
    measured: Measured,
    policy: Policy,
    now_ns: int,
) -> TrackerState:
    """Return the state at the new place, which two windows have now seen."""
    noise = candidate.covariance + _walked(candidate, measured, policy)
    joint = with_dithered(widened(prior, noise), candidate.alpha.vector, noise)
    joint = with_dithered(joint, measured.alpha.vector, measured.covariance)
    state = replace(
        state,
        windows_accepted=state.windows_accepted + 1,
        registration=replace(
            known, passive_after_ns_utc=candidate.t_ns_utc + round(PASSIVE_BLIND_S * SECOND_NS)
        ),
    )
    state = _accepted(
        state,
        joint,
        measured,
        policy,
        now_ns,
        n_windows=2,
        innovation=dithered_innovation(prior, measured.alpha.vector, measured.covariance),
    )
    text = f"jumped by {_step(measured, known)}, as two windows have seen"
    return logged(state, "registration.jump", text, now_ns, Level.WARNING)


def _distance(candidate: Candidate, measured: Measured, policy: Policy) -> float:
    """Return how far two windows lie apart: squared, normalised, expected 4."""
    difference = measured.alpha.vector - candidate.alpha.vector
    walked = _walked(candidate, measured, policy)
    total = candidate.covariance + measured.covariance + walked
    return float(difference @ np.linalg.solve(total, difference))


def _walked(candidate: Candidate, measured: Measured, policy: Policy) -> Array:
    """Return ``(4, 4)`` what α may have drifted from one window to the other."""
    elapsed_s = max(measured.t_ns_utc - candidate.t_ns_utc, 0) / SECOND_NS
    return np.diag(policy.drift_rate**2 * elapsed_s)


def _step(measured: Measured | Candidate, known: Registration) -> str:
    step = (measured.alpha.vector - known.alpha.vector) * BOUNDARY_SCALE
    return f"{step[0]:+.3f}, {step[1]:+.3f} subap, {step[2]:+.3f} deg, {step[3]:+.4f}"
