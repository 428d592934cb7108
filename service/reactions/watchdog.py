"""The passive estimate between dithers: α and its bias from ordinary telemetry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service import events as ev
from service.estimation.passive import BIAS_FLOOR, PassiveEstimate
from service.estimation.wind import (
    JUMP_THRESHOLD,
    Joint,
    correlation_factor,
    forgotten,
    passive_innovation,
    with_passive,
)
from service.model.misregistration import Misregistration
from service.reactions.estimate import DISAGREES, bias_of, brought_forward, remembered
from service.reactions.journal import logged, with_alarm
from service.reactions.policy import SECOND_NS, Policy
from service.reactions.validity import aged, with_dither_due
from service.state import (
    HistoryEntry,
    Level,
    Registration,
    Source,
    TrackerState,
    Watchdog,
)

PASSIVE_MEMORY_S = 10.0
"""Time after which telemetry counts 1/e in the passive sums."""

Array = NDArray[np.float64]


def on_watchdog(
    state: TrackerState, event: ev.Watched, policy: Policy, now_ns: int
) -> TrackerState:
    """Fold the passive estimate in, its bias allowed for, or doubt α where it does not fit."""
    known = state.registration
    if known is None:
        return _shown(state, event, BIAS_FLOOR, np.zeros(4), "no dithered estimate to compare with")
    t_ns_utc = event.t_ns_utc if state.rtc is None else state.rtc.t_ns_utc
    prior = brought_forward(state, known, t_ns_utc, policy, now_ns)
    if known.candidate is not None or t_ns_utc <= known.passive_after_ns_utc:
        text = "not used: its telemetry may be from both sides of a jump"
        return _shown(state, event, _reading_sigma(event.estimate, prior), prior.bias, text)
    measured, noise = event.estimate.alpha.vector, _noise(event.estimate, known, t_ns_utc)
    innovation = passive_innovation(prior, measured, noise)
    if innovation > JUMP_THRESHOLD:
        return _barking(state, event, prior, innovation, t_ns_utc, policy, now_ns)
    joint = with_passive(prior, measured, noise)
    state = _entered(state, known, joint, t_ns_utc, now_ns)
    state = aged(state, policy, now_ns)
    if state.registration is not None:
        entry = HistoryEntry(
            t_ns_utc=t_ns_utc,
            measured=Misregistration.from_vector(measured - joint.bias),
            measured_sigma=_reading_sigma(event.estimate, prior),
            filtered=state.registration.alpha,
            filtered_sigma=state.registration.sigma,
            innovation=innovation,
            source=Source.PASSIVE,
        )
        state = remembered(state, entry)
    text = "agrees with α and with what is known of its own bias"
    return _shown(state, event, _reading_sigma(event.estimate, prior), joint.bias, text)


def _barking(
    state: TrackerState,
    event: ev.Watched,
    prior: Joint,
    innovation: float,
    t_ns_utc: int,
    policy: Policy,
    now_ns: int,
) -> TrackerState:
    """Forget the bias and doubt α: the wind has changed or the mirror has moved."""
    known = state.registration
    if known is None:
        raise ValueError("no α is known: there is nothing to doubt")
    text = (
        "ordinary telemetry disagrees: the wind has changed or the mirror has moved, and a "
        "dithered window must tell which"
    )
    state = _entered(state, known, forgotten(prior), t_ns_utc, now_ns)
    if state.registration is not None:
        state = replace(state, registration=replace(state.registration, doubt=text))
    detail = f"{text} (innovation {innovation:.0f}, expected 4)"
    state = logged(state, "registration.passive-jump", detail, now_ns, Level.WARNING)
    state = with_dither_due(with_alarm(state, DISAGREES, text, now_ns), text, now_ns)
    state = aged(state, policy, now_ns)
    return _shown(state, event, BIAS_FLOOR, np.zeros(4), text, consistent=False)


def _entered(
    state: TrackerState, known: Registration, joint: Joint, t_ns_utc: int, now_ns: int
) -> TrackerState:
    registration = replace(
        known,
        alpha=Misregistration.from_vector(joint.alpha),
        covariance=joint.alpha_covariance,
        t_ns_utc=max(t_ns_utc, known.t_ns_utc),
        arrived_ns_utc=now_ns,
        bias=bias_of(joint, t_ns_utc),
        pointing=state.pointing,
    )
    return replace(state, registration=registration)


def _noise(estimate: PassiveEstimate, known: Registration, t_ns_utc: int) -> Array:
    """Return the covariance of its scatter, larger for telemetry that was looked at before."""
    scatter = _scatter(estimate)
    if known.bias is None or known.bias.looked_ns_utc == 0:
        return scatter
    since_s = (t_ns_utc - known.bias.looked_ns_utc) / SECOND_NS
    # two looks at the very same telemetry: the second adds nothing
    return scatter * min(correlation_factor(since_s, PASSIVE_MEMORY_S), 1e12)


def _scatter(estimate: PassiveEstimate) -> Array:
    return estimate.covariance


def _reading_sigma(estimate: PassiveEstimate, prior: Joint) -> Array:
    """Return ``(4,)`` 1 σ of the estimate as a reading of α: its scatter, and that of its bias."""
    return np.sqrt(np.diag(_scatter(estimate)) + np.diag(prior.covariance)[4:])


def _shown(
    state: TrackerState,
    event: ev.Watched,
    sigma: Array,
    bias: Array,
    text: str,
    *,
    consistent: bool = True,
) -> TrackerState:
    watchdog = Watchdog(
        alpha=event.estimate.alpha,
        sigma=sigma,
        t_ns_utc=event.t_ns_utc,
        consistent=consistent,
        text=text,
        bias=bias,
    )
    return replace(state, watchdog=watchdog)
