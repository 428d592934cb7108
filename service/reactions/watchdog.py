"""The passive estimate between dithers: α and its bias from ordinary telemetry.

Each look is at telemetry that no other has seen, so their errors are independent.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service import events as ev
from service.model.misregistration import Misregistration
from service.reactions.estimate import DISAGREES, bias_of, brought_forward, joint_of, remembered
from service.reactions.evidence import pointing_at, precedes, taken
from service.reactions.journal import logged, with_alarm
from service.reactions.policy import Policy
from service.reactions.surprise import Reading, look_surprise, sum_of
from service.reactions.validity import aged, with_dither_due
from service.reactions.windows import CAPTURE_RANGE, why_no_measurement
from service.state import (
    HistoryEntry,
    Level,
    Registration,
    Source,
    TrackerState,
    Watchdog,
)
from service.state.rtc import same_numbers
from service.telemetry.passive import PassiveEstimate
from service.telemetry.wind import (
    JUMP_THRESHOLD,
    Joint,
    allowing,
    forgotten,
    passive_innovation,
    with_passive,
)

Array = NDArray[np.float64]


def on_watchdog(
    state: TrackerState, event: ev.Watched, policy: Policy, now_ns: int
) -> TrackerState:
    """Fold the passive estimate in, its bias allowed for, or doubt α where it does not fit."""
    reason = _why_useless(state, event) or _why_known_already(state, event)
    if reason is not None:
        return replace(state, unwatched=f"a look was not used: {reason}")
    known = state.registration
    if known is None:
        return _alone(state, event, policy)
    excess = event.estimate.bias_excess
    known = _expecting(known, excess)
    prior = allowing(brought_forward(state, known, event.t_ns_utc, policy, now_ns), excess)
    if _mixed(known):
        text = "not used: its telemetry may be from both sides of a jump"
        bias = bias_of(joint_of(known), event.t_ns_utc, _loop(state, known))
        state = replace(state, registration=replace(known, bias=bias))
        return _shown(state, event, _reading_sigma(event.estimate, prior), prior.bias, text)
    measured = event.estimate.alpha.vector
    reading = Reading(
        value=measured,
        noise=event.estimate.covariance,
        t_ns_utc=event.t_ns_utc,
        pointing=pointing_at(state, event.t_ns_utc),
    )
    far = look_surprise(known, joint_of(known), reading, policy)
    if far > JUMP_THRESHOLD:
        return _barking(state, event, prior, far, policy, now_ns)
    innovation = passive_innovation(prior, measured, event.estimate.covariance)
    joint = with_passive(prior, measured, event.estimate.covariance)
    registration = _after(state, known, joint, event, now_ns)
    state = aged(replace(state, registration=registration), policy, now_ns)
    sigma = _reading_sigma(event.estimate, prior)
    entry = HistoryEntry(
        t_ns_utc=event.t_ns_utc,
        measured=Misregistration.from_vector(measured - joint.bias),
        measured_sigma=sigma,
        filtered=registration.alpha,
        filtered_sigma=registration.sigma,
        innovation=innovation,
        misfit=event.estimate.misfit,
        source=Source.PASSIVE,
    )
    text = "agrees with α and with what is known of its own bias"
    return _shown(remembered(state, entry), event, sigma, joint.bias, text)


def fit_begins_at(state: TrackerState) -> Misregistration | None:
    """Return about what a look is to be fitted: α, or the last look; None: the nominal rotation."""
    if state.registration is not None:
        return state.registration.alpha
    last = state.watchdog
    return last.alpha if last is not None and np.isfinite(last.sigma).all() else None


def _why_useless(state: TrackerState, event: ev.Watched) -> str | None:
    """Return why a look says nothing of the telescope as it is, or None."""
    of_loop = () if state.rtc is None else state.rtc.loop_numbers
    if event.loop and of_loop and not same_numbers(event.loop, of_loop):
        return "the loop has changed since"
    return why_no_measurement(state, taken(event.began_ns_utc, event.t_ns_utc))


def _why_known_already(state: TrackerState, event: ev.Watched) -> str | None:
    """Return which later telemetry has told more than a look that was long under way, or None."""
    known = state.registration
    if known is None or not known.window_began_ns_utc:
        return None
    since = taken(known.window_began_ns_utc, known.window_began_ns_utc)
    if precedes(state, since, event.t_ns_utc):
        return None
    return "a dithered window taken since has been fitted before it"


def _alone(state: TrackerState, event: ev.Watched, policy: Policy) -> TrackerState:
    """Show a look while α is not known: it is all there is, and no more than it says it is."""
    step = event.estimate.alpha.vector - policy.start.vector
    if np.any(np.abs(step) > CAPTURE_RANGE):
        text = (
            f"it cannot tell: {event.estimate.alpha.to_boundary()} is too far from where its fit "
            "begins, the nominal rotation; let the service acquire, or dither"
        )
        return _shown(state, event, np.full(4, np.inf), np.zeros(4), text)
    text = "no dithered estimate to compare with: nothing is made from this reading alone"
    return _shown(state, event, event.estimate.sigma, np.zeros(4), text)


def _expecting(known: Registration, excess: Array) -> Registration:
    """Return what is known with the bias as large as the first look at it says that it may be.

    A later look that says more is allowed for by the filter alone: whether the mirror has jumped is
    told with less patience.
    """
    if known.bias is not None and known.bias.looked_ns_utc:
        return known
    return replace(known, bias=bias_of(forgotten(joint_of(known), excess), 0, ()))


def _loop(state: TrackerState, known: Registration) -> tuple[float, ...]:
    """Return the loop that is looked at; while no RTC is there, the one of the last look."""
    if state.rtc is not None:
        return state.rtc.loop_numbers
    return () if known.bias is None else known.bias.loop


def _mixed(known: Registration) -> bool:
    """Return whether a look may be at telemetry from before a jump and from after it.

    It began no earlier than the one before it ended.
    """
    began_ns_utc = known.bias.looked_ns_utc if known.bias is not None else 0
    jumped_ns_utc = known.passive_after_ns_utc
    return known.candidate is not None or (jumped_ns_utc > 0 and began_ns_utc < jumped_ns_utc)


def _barking(
    state: TrackerState,
    event: ev.Watched,
    prior: Joint,
    far: float,
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
    gone = forgotten(prior, event.estimate.bias_excess)
    registration = _after(state, known, gone, event, now_ns)
    bias = bias_of(gone, event.t_ns_utc, _loop(state, known))
    since_ns = max(known.doubted_ns_utc if known.doubt else 0, event.t_ns_utc)
    registration = replace(registration, doubt=text, doubted_ns_utc=since_ns, bias=bias)
    state = replace(state, registration=registration)
    detail = f"{text} (innovation {far:.0f}, expected 4)"
    state = logged(state, "registration.passive-jump", detail, now_ns, Level.WARNING)
    state = with_dither_due(with_alarm(state, DISAGREES, text, now_ns), text, now_ns)
    state = aged(state, policy, now_ns)
    return _shown(state, event, event.estimate.sigma, np.zeros(4), text, consistent=False)


def _after(
    state: TrackerState, known: Registration, joint: Joint, event: ev.Watched, now_ns: int
) -> Registration:
    """Return the registration as the filter has it after a look."""
    return replace(
        known,
        alpha=Misregistration.from_vector(joint.alpha),
        covariance=joint.alpha_covariance,
        t_ns_utc=max(event.t_ns_utc, known.t_ns_utc),
        arrived_ns_utc=now_ns,
        bias=bias_of(joint, event.t_ns_utc, _loop(state, known), sum_of(known, joint_of(known))),
        pointing=pointing_at(state, event.t_ns_utc),
    )


def _reading_sigma(estimate: PassiveEstimate, prior: Joint) -> Array:
    """Return ``(4,)`` 1 σ of the estimate as a reading of α: its scatter, and that of its bias."""
    return np.sqrt(np.diag(estimate.covariance) + np.diag(prior.covariance)[4:])


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
        misfit=event.estimate.misfit,
        t_ns_utc=event.t_ns_utc,
        consistent=consistent,
        text=text,
        bias=bias,
    )
    return replace(state, watchdog=watchdog, unwatched="")
