"""Take a passive estimate into the registration, or doubt α.

A passive estimate alone is no match for dithered windows: where it disagrees it asks for one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.estimation import kalman
from service.estimation.estimate import PassiveEstimate
from service.estimation.kalman import Joint
from service.estimation.loop import loop_numbers, same_numbers
from service.model.misregistration import Misregistration
from service.tracking import alarms, filtering, jumps, validity
from service.tracking import events as ev
from service.tracking.dither_plan import check_dither_allowed
from service.tracking.registration import (
    HistoryEntry,
    PassiveBias,
    PassiveState,
    PointedEstimate,
    PreviousEstimate,
    Purpose,
    Registration,
    Source,
)
from service.tracking.state import TrackerState
from service.tracking.step_context import StepContext
from service.tracking.validity import BOTH_SIDES, TelemetrySpan

Array = NDArray[Any]


def process_passive(context: StepContext, event: ev.PassiveFitted) -> None:
    """Update α by the passive estimate and its bias, or mark α as doubtful."""
    reason = _check_passive_estimate(context.state, event) or _find_later_telemetry(
        context.state, event
    )
    if reason is not None:
        _note_unavailable(context, f"the passive estimate was not used: {reason}")
        return
    registration, estimate = context.registration, event.estimate
    if registration is None:
        _show_passive_alone(context, event)
        return
    block = estimate.bias
    registration = _with_first_bias(registration, estimate)
    forward = filtering.predict(context, registration, event.t_ns_utc)
    prior = kalman.allow_scatter(forward, block, estimate.bias_excess)
    mixed = _check_single_registration(context.state, registration, event)
    if mixed is not None:
        biases = _biases_after_look(
            context.state, registration, filtering.joint_of(registration), event
        )
        validity.store_registration(context, replace(registration, biases=biases))
        sigma = _passive_sigma(estimate, prior)
        _show_passive(context, event, sigma, prior.bias(block), f"not used: {mixed}")
        return
    measured = estimate.alpha.vector
    window = PointedEstimate(
        alpha=estimate.alpha,
        covariance=prior.bias_of(block).scatter * estimate.covariance,
        t_ns_utc=event.t_ns_utc,
        pointing=validity.pointing_at(context.state, event.t_ns_utc),
    )
    far = jumps.passive_innovation(
        registration, filtering.joint_of(registration), block, window, context.policy
    )
    # A passive estimate never moves α far by itself: wind and a moved mirror look alike in it
    # (docs/decisions/0020-filter-and-passive-estimate.md).
    if far > jumps.MAX_PASSIVE_INNOVATION:
        _ask_for_window(context, registration, event, prior, far)
        return
    joint = kalman.correct_state(prior, measured, estimate.covariance, block)
    joint = kalman.update_scatter(joint, block, far)
    registration = _registration_after_passive(context, registration, joint, event)
    validity.store_registration(context, registration)
    validity.age_registration(context)
    sigma = _passive_sigma(estimate, prior)
    entry = HistoryEntry(
        t_ns_utc=event.t_ns_utc,
        measured=Misregistration.from_vector(measured - joint.bias(block)),
        measured_sigma=sigma,
        filtered=registration.alpha,
        filtered_sigma=registration.shown_sigma,
        innovation=kalman.innovation(prior, measured, estimate.covariance, block),
        misfit=estimate.misfit,
        source=Source.PASSIVE,
    )
    filtering.add_history(context, entry)
    text = "agrees with α and with what is known of its own bias"
    _show_passive(context, event, sigma, joint.bias(block), text)


def on_passive_unavailable(context: StepContext, event: ev.PassiveUnavailable) -> None:
    """Store why there is no passive estimate."""
    _note_unavailable(context, event.text)


def _note_unavailable(context: StepContext, why: str) -> None:
    context.alpha = replace(context.alpha, passive_unavailable_reason=why)


def fit_begins_at(state: TrackerState) -> Misregistration | None:
    """Return where the next passive fit begins: α, or the last such estimate; None: nominal."""
    if state.alpha.registration is not None:
        return state.alpha.registration.alpha
    if state.alpha.law.nominal is not None:
        return state.alpha.law.nominal
    last = state.alpha.passive
    return last.alpha if last is not None and np.isfinite(last.sigma).all() else None


def _check_passive_estimate(state: TrackerState, event: ev.PassiveFitted) -> str | None:
    """Return why a passive estimate says nothing of the telescope as it is, or None."""
    of_loop = loop_numbers(state.loop.rtc)
    # The bias belongs to the loop in which it was measured.
    if event.loop and of_loop and not same_numbers(event.loop, of_loop):
        return "the loop has changed since"
    return filtering.check_measurable(
        state, validity.telemetry_span(event.began_ns_utc, event.t_ns_utc)
    )


def _find_later_telemetry(state: TrackerState, event: ev.PassiveFitted) -> str | None:
    """Return the later telemetry that supersedes a delayed estimate, in words, or None."""
    registration = state.alpha.registration
    if registration is None or not registration.window_began_ns_utc:
        return None
    since = validity.telemetry_span(
        registration.window_began_ns_utc, registration.window_began_ns_utc
    )
    if validity.precedes(state, since, event.t_ns_utc):
        return None
    return "a dithered window taken since has been fitted before it"


def _show_passive_alone(context: StepContext, event: ev.PassiveFitted) -> None:
    """Show a passive estimate while α is not known: nothing is made from it alone."""
    step = event.estimate.alpha.vector - context.start_of_fits.vector
    if np.any(np.abs(step) > filtering.CAPTURE_RANGE):
        text = (
            f"no estimate: {event.estimate.alpha} is too far from the start of its fit, "
            "the nominal rotation; let the service acquire, or dither"
        )
        _show_passive(context, event, np.full(4, np.inf), np.zeros(4), text)
        return
    text = "no dithered estimate to compare with: nothing is made from this reading alone"
    # α has the model's own error anyway: that of a coarse mirror is larger than any bias
    sigma = np.hypot(event.estimate.sigma, context.policy.floor)
    _show_passive(context, event, sigma, np.zeros(4), text)


def _with_first_bias(registration: Registration, estimate: PassiveEstimate) -> Registration:
    """Return what is known with the bias as large as the first estimate says that it may be.

    A later estimate that says more is allowed for by the filter alone: a jump of the mirror is then
    found with less patience.
    """
    bias = registration.bias(estimate.bias)
    if bias is not None and bias.looked_ns_utc:
        return registration
    joint = kalman.forget(filtering.joint_of(registration), estimate.bias, estimate.bias_excess)
    return replace(registration, biases=filtering.biases_of(joint))


def _biases_after_look(
    state: TrackerState,
    registration: Registration,
    joint: Joint,
    event: ev.PassiveFitted,
    previous: PreviousEstimate | None = None,
) -> tuple[PassiveBias, ...]:
    """Return the biases after a passive estimate; ``previous``: what the filter saw it from."""
    name, loop = event.estimate.bias.name, _loop(state, registration, event)
    return tuple(
        replace(bias, looked_ns_utc=event.t_ns_utc, loop=loop, previous_estimate=previous)
        if bias.block.name == name
        else bias
        for bias in filtering.biases_of(joint)
    )


def _loop(
    state: TrackerState, registration: Registration, event: ev.PassiveFitted
) -> tuple[float, ...]:
    """Return the loop the telemetry is of; while no RTC is there, that of the last estimate."""
    if state.loop.rtc is not None:
        return loop_numbers(state.loop.rtc)
    bias = registration.bias(event.estimate.bias)
    return () if bias is None else bias.loop


def _check_single_registration(
    state: TrackerState, registration: Registration, event: ev.PassiveFitted
) -> str | None:
    """Return why a passive estimate may be of telemetry from before a jump and after it, or None.

    It began no earlier than the one before it ended.
    """
    if registration.suspected_jump is not None:
        return BOTH_SIDES
    bias = registration.bias(event.estimate.bias)
    # Passive estimates share no telemetry, so this one began after the last one ended.
    began_ns = 0 if bias is None else bias.looked_ns_utc
    span = TelemetrySpan(began_ns_utc=began_ns, ended_ns_utc=event.t_ns_utc)
    return validity.explain_void(state, span, Purpose.PASSIVE)


def _ask_for_window(
    context: StepContext,
    registration: Registration,
    event: ev.PassiveFitted,
    prior: Joint,
    far: float,
) -> None:
    """Reset the bias and request a dithered window: the wind has changed or the mirror has moved.

    α stays valid, but nothing is computed or sent until a window taken since has decided. An alarm
    is raised if no window is possible, or if there was none when a second passive estimate
    disagrees.
    """
    text = (
        "ordinary telemetry disagrees: the wind has changed or the mirror has moved, and a "
        "dithered window must decide which"
    )
    registration = context.registration or registration
    was_doubted, void = (
        bool(registration.doubt),
        bool(registration.doubt) and registration.doubt_voids,
    )
    why_none = None if context.rtc is None else check_dither_allowed(context, context.rtc)
    # In another wind the bias is another one.
    gone = kalman.forget(prior, event.estimate.bias, event.estimate.bias_excess)
    after = _registration_after_passive(context, registration, gone, event)
    biases = _biases_after_look(context.state, registration, gone, event)
    doubted = replace(after, biases=biases, doubt=text, doubt_voids=void)
    validity.store_registration(context, doubted)
    validity.cast_doubt(context, event.t_ns_utc)
    context.warn("registration.passive-jump", f"{text} (innovation {far:.0f}, expected 4)")
    validity.request_window(context, text)
    # Normally a dithered window decides within seconds, and no operator need act.
    if why_none is not None or was_doubted:
        cannot = "no window since the last disagreement" if why_none is None else why_none
        context.raise_alarm(alarms.DISAGREES, f"{text}: {cannot}; α stays as measured by windows")
    validity.age_registration(context)
    _show_passive(context, event, event.estimate.sigma, np.zeros(4), text, consistent=False)


def _registration_after_passive(
    context: StepContext, registration: Registration, joint: Joint, event: ev.PassiveFitted
) -> Registration:
    """Return the registration as the filter has it after a passive estimate."""
    block, was = event.estimate.bias, None
    if registration.bias(block) is not None:
        was = jumps.sum_of(registration, filtering.joint_of(registration), block)
    return replace(
        registration,
        alpha=filtering.alpha_of(joint, registration.alpha),
        covariance=joint.alpha_covariance,
        stretches=filtering.stretches_of(joint),
        # A passive fit may end after that of a window with newer telemetry.
        t_ns_utc=max(event.t_ns_utc, registration.t_ns_utc),
        arrived_ns_utc=context.now_ns,
        biases=_biases_after_look(context.state, registration, joint, event, was),
        pointing=validity.pointing_at(context.state, event.t_ns_utc),
    )


def _passive_sigma(estimate: PassiveEstimate, prior: Joint) -> Array:
    """Return ``(4,)`` 1 σ of the estimate as a reading of α: its scatter, and that of its bias."""
    place = prior.place(estimate.bias)
    return np.sqrt(np.diag(estimate.covariance) + np.diag(prior.covariance)[place])


def _show_passive(
    context: StepContext,
    event: ev.PassiveFitted,
    sigma: Array,
    bias: Array,
    text: str,
    *,
    consistent: bool = True,
) -> None:
    watchdog = PassiveState(
        alpha=event.estimate.alpha,
        sigma=sigma,
        misfit=event.estimate.misfit,
        t_ns_utc=event.t_ns_utc,
        consistent=consistent,
        text=text,
        bias=bias,
        estimator=event.estimate.bias.name,
    )
    context.alpha = replace(context.alpha, passive=watchdog, passive_unavailable_reason="")
