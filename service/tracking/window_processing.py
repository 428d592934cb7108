"""Windows, and looks at ordinary telemetry, become the registration, or a reason why not.

One window far out may be a jump or a mistake. It is held, nothing is made from α meanwhile, and
the next window decides: one that agrees with it makes it a jump, one that agrees with all before
makes it an outlier. A jump that one window alone cannot tell from noise is told by two together.
Where windows scatter by more than they say, they must agree for longer than turbulence is alike.
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
from service.estimation.random_dither import RandomEstimate
from service.estimation.windows import RefusalKind
from service.model.misregistration import Misregistration, step_text
from service.tracking import alarms, filtering, jumps, refusals, validity, void_intervals
from service.tracking import events as ev
from service.tracking.dither import note_found
from service.tracking.dither_plan import why_no_dither
from service.tracking.filtering import FilterUpdate, WindowEstimate
from service.tracking.jumps import Innovation
from service.tracking.operations.acquisition_stages import count_miss
from service.tracking.policy import SECOND_NS
from service.tracking.registration import (
    HistoryEntry,
    PassiveBias,
    PassiveState,
    PointedEstimate,
    PreviousEstimate,
    Purpose,
    Registration,
    Source,
    SuspectedJump,
    TimedEstimate,
)
from service.tracking.state import Level, TrackerState
from service.tracking.step_context import StepContext
from service.tracking.void_intervals import BEFORE_DOUBT, BOTH_SIDES, TelemetrySpan

Array = NDArray[Any]


def on_window(context: StepContext, event: ev.WindowFitted) -> None:
    """Fold one window's estimate into the registration, or refuse it with its reason."""
    estimate = event.estimate
    when = void_intervals.telemetry_span(event.began_ns_utc, estimate.t_ns_utc)
    why = filtering.why_no_window(context, estimate, when)
    if why is not None:
        kind, reason = why
        reject_window(context, reason, kind)
        return
    refusals.note_used(context)
    if void_intervals.is_since_alarm(context.state, alarms.DITHER_LOST, when):
        note_found(context)
    random = isinstance(estimate, RandomEstimate)
    for name in (alarms.MISALIGNED, *(() if random else (alarms.WRONG_ANSWER,))):
        if void_intervals.is_since_alarm(context.state, name, when):
            context.clear_alarm(name)
    registration = context.registration
    modes, gains, gain_sigma = filtering.gains_of(estimate)
    measured = WindowEstimate(
        alpha=estimate.alpha,
        covariance=estimate.covariance,
        t_ns_utc=estimate.t_ns_utc,
        pointing=validity.pointing_at(context.state, estimate.t_ns_utc),
        began_ns_utc=when.began_ns_utc,
        source=Source.RANDOM if random else Source.LOCK_IN,
        optical_gain=float(filtering.strong_gains(estimate).mean()),
        optical_gains=filtering.update_gains(
            () if registration is None else registration.optical_gains,
            modes,
            gains[: len(modes)],
            gain_sigma,
            estimate.t_ns_utc,
        ),
        floor=filtering.model_error_of(registration, estimate, context.policy),
        misfit=estimate.misfit,
    )
    process_window(context, measured)


def on_lost(context: StepContext, event: ev.WindowLost) -> None:
    """Count a window that nothing could be made of."""
    reject_window(context, event.refused.reason, event.refused.kind)


def reject_window(context: StepContext, reason: str, kind: RefusalKind = RefusalKind.OTHER) -> None:
    """Count a window that gave nothing, and say why."""
    count_miss(context, kind)
    if kind is RefusalKind.MISALIGNED:
        context.raise_alarm(alarms.MISALIGNED, reason)
    if kind is RefusalKind.MISTOLD:
        context.raise_alarm(alarms.WRONG_ANSWER, reason)
    level = Level.INFO if kind is RefusalKind.CUT_SHORT else Level.WARNING
    _note_refusal(context, reason, level)
    refusals.note_refused(context, reason, kind)


def _note_refusal(context: StepContext, reason: str, level: Level = Level.INFO) -> None:
    line = context.log("window.refused", reason, level)
    context.windows = replace(context.windows, refusal=line)


def process_window(context: StepContext, measured: WindowEstimate) -> None:
    """Fold a dithered window in, hold it, or have it decide about the one held before."""
    registration = context.registration
    if registration is None:
        joint = kalman.begin_joint(measured.alpha.vector, measured.covariance)
        filtering.accept(context, FilterUpdate(joint=joint, n_windows=1, innovation=0.0), measured)
        return
    first = jumps.previous_window(registration)
    both = jumps.pair_innovation(registration, measured, context.policy)
    if first is not None and both.is_outlier:
        if jumps.jump_lasts(registration, first, measured, both):
            _jump(context, registration, first, measured)
        else:
            _suspect_jump(context, registration, measured, both, first)
        return
    far = jumps.window_innovation(registration, measured, context.policy)
    too_early = void_intervals.why_void(context.state, measured.when, Purpose.SETTLE)
    if too_early is not None and not far.is_outlier:
        refusals.count_refused(context)
        _note_refusal(context, too_early)
        return
    if registration.suspected_jump is not None:
        text = (
            f"the window {_distance_text(registration.suspected_jump, registration)} from α was "
            f"not confirmed: the one after it lies {_distance_text(measured, registration)} away"
        )
        n_outlying = context.windows.outlying + 1
        context.windows = replace(context.windows, outlying=n_outlying)
        context.warn("window.outlier", text)
        registration = replace(
            registration, scatter=kalman.learnt(registration.scatter, kalman.JUMP_THRESHOLD)
        )
    if far.is_outlier:
        _suspect_jump(context, registration, measured, far)
        return
    prior = filtering.predict(context, registration, measured.t_ns_utc)
    update = FilterUpdate(
        joint=kalman.corrected(prior, measured.alpha.vector, measured.covariance),
        n_windows=filtering.n_agreeing(context, registration, prior),
        innovation=_innovation(prior, measured),
        scatter=kalman.learnt(registration.scatter, far.mahalanobis_squared),
    )
    filtering.accept(context, update, measured)


def _suspect_jump(
    context: StepContext,
    registration: Registration,
    measured: WindowEstimate,
    far: Innovation,
    first: TimedEstimate | None = None,
) -> None:
    """Put a window that is far out aside, and doubt α until another one has come.

    ``first``: the one before, which tells the same place; together they are so ``far``.
    """
    innovation = far.mahalanobis_squared
    text = (
        f"a window lies {_distance_text(measured, registration)} from α "
        f"(innovation {innovation:.0f}, expected 4, "
        f"rotation {np.sqrt(far.rotation):.1f} sigma): the next one decides; nothing is made or "
        "sent meanwhile"
    )
    candidate = SuspectedJump(
        alpha=measured.alpha,
        covariance=measured.covariance,
        t_ns_utc=measured.t_ns_utc,
        held_ns_utc=context.now_ns,
        began_ns_utc=(first or measured).began_ns_utc,
        text=text,
    )
    doubt = "a jump is suspected"
    validity.store_registration(
        context, replace(registration, doubt=doubt, doubt_voids=True, suspected_jump=candidate)
    )
    _cast_doubt(context, measured.t_ns_utc)
    filtering.add_history(
        context, filtering.history_entry(measured, registration, innovation, entered=False)
    )
    if first is None or registration.suspected_jump is None:
        context.warn("registration.jump-suspected", text)
    validity.request_window(context, doubt)
    validity.age_registration(context)


def _jump(
    context: StepContext, registration: Registration, first: TimedEstimate, measured: WindowEstimate
) -> None:
    """Go to the new place, which two windows have now seen.

    The first of them is used if it is wholly of the new place.
    """
    policy = context.policy
    prior = filtering.predict(context, registration, measured.t_ns_utc)
    noise = measured.covariance
    whole = jumps.wholly_after(first, measured, registration.alpha, policy)
    if whole:
        elapsed_s = max(measured.t_ns_utc - first.t_ns_utc, 0) / SECOND_NS
        noise = first.covariance + np.diag(policy.drift_rate**2 * elapsed_s)
    joint = kalman.widened(prior, noise)
    if whole:
        joint = kalman.corrected(joint, first.alpha.vector, noise)
    update = FilterUpdate(
        joint=kalman.corrected(joint, measured.alpha.vector, measured.covariance),
        n_windows=2 if whole else 1,
        innovation=_innovation(prior, measured),
        scatter=registration.scatter,
        jumped=True,
    )
    validity.store_registration(context, registration)
    void_intervals.void_until(context, first.t_ns_utc, BOTH_SIDES, Purpose.PASSIVE)
    both = whole and registration.suspected_jump is not None
    filtering.accept(context, update, measured, n_accepted=2 if both else 1)
    context.warn(
        "registration.jump",
        f"jumped by {_distance_text(measured, registration)}, as two windows have seen",
    )


def _cast_doubt(context: StepContext, since_ns_utc: int) -> None:
    """Let no window settle the doubt that began before what has cast it, or has done so before."""
    until_ns = max(void_intervals.end_of(context.state, BEFORE_DOUBT), since_ns_utc)
    void_intervals.void_until(context, until_ns, BEFORE_DOUBT, Purpose.SETTLE)


def _innovation(prior: Joint, measured: WindowEstimate) -> float:
    return kalman.innovation(prior, measured.alpha.vector, measured.covariance)


def _distance_text(window: TimedEstimate, registration: Registration) -> str:
    return step_text(window.alpha.vector - registration.alpha.vector)


def process_passive(context: StepContext, event: ev.PassiveFitted) -> None:
    """Fold the passive estimate in, its bias allowed for, or doubt α where it does not fit."""
    reason = _why_passive_unusable(context.state, event) or _why_known_already(context.state, event)
    if reason is not None:
        _note_unavailable(context, f"a look was not used: {reason}")
        return
    registration, estimate = context.registration, event.estimate
    if registration is None:
        _show_passive_alone(context, event)
        return
    block = estimate.bias
    registration = _with_first_bias(registration, estimate)
    forward = filtering.predict(context, registration, event.t_ns_utc)
    prior = kalman.allowing(forward, block, estimate.bias_excess)
    mixed = _why_of_two_places(context.state, registration, event)
    if mixed is not None:
        looked = _biases_after_look(
            context.state, registration, filtering.joint_of(registration), event
        )
        validity.store_registration(context, replace(registration, biases=looked))
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
    if far > jumps.PASSIVE_LIMIT:
        _ask_for_window(context, registration, event, prior, far)
        return
    joint = kalman.corrected(prior, measured, estimate.covariance, block)
    joint = kalman.scattered(joint, block, far)
    registration = _registration_after_passive(context, registration, joint, event)
    validity.store_registration(context, registration)
    validity.age_registration(context)
    sigma = _passive_sigma(estimate, prior)
    entry = HistoryEntry(
        t_ns_utc=event.t_ns_utc,
        measured=Misregistration.from_vector(measured - joint.bias(block)),
        measured_sigma=sigma,
        filtered=registration.alpha,
        filtered_sigma=registration.sigma,
        innovation=kalman.innovation(prior, measured, estimate.covariance, block),
        misfit=estimate.misfit,
        source=Source.PASSIVE,
    )
    filtering.add_history(context, entry)
    text = "agrees with α and with what is known of its own bias"
    _show_passive(context, event, sigma, joint.bias(block), text)


def on_passive_unavailable(context: StepContext, event: ev.PassiveUnavailable) -> None:
    """Note why ordinary telemetry says nothing of α now."""
    _note_unavailable(context, event.text)


def _note_unavailable(context: StepContext, why: str) -> None:
    context.alpha = replace(context.alpha, passive_unavailable_reason=why)


def fit_begins_at(state: TrackerState) -> Misregistration | None:
    """Return about what a look is to be fitted: α, or the last look; None: the nominal rotation."""
    if state.alpha.registration is not None:
        return state.alpha.registration.alpha
    last = state.alpha.passive
    return last.alpha if last is not None and np.isfinite(last.sigma).all() else None


def _why_passive_unusable(state: TrackerState, event: ev.PassiveFitted) -> str | None:
    """Return why a look says nothing of the telescope as it is, or None."""
    of_loop = loop_numbers(state.loop.rtc)
    if event.loop and of_loop and not same_numbers(event.loop, of_loop):
        return "the loop has changed since"
    return filtering.why_no_measurement(
        state, void_intervals.telemetry_span(event.began_ns_utc, event.t_ns_utc)
    )


def _why_known_already(state: TrackerState, event: ev.PassiveFitted) -> str | None:
    """Return which later telemetry has told more than a look that was long under way, or None."""
    registration = state.alpha.registration
    if registration is None or not registration.window_began_ns_utc:
        return None
    since = void_intervals.telemetry_span(
        registration.window_began_ns_utc, registration.window_began_ns_utc
    )
    if void_intervals.precedes(state, since, event.t_ns_utc):
        return None
    return "a dithered window taken since has been fitted before it"


def _show_passive_alone(context: StepContext, event: ev.PassiveFitted) -> None:
    """Show a look while α is not known: it is all there is, and no more than it says it is."""
    step = event.estimate.alpha.vector - context.policy.start.vector
    if np.any(np.abs(step) > filtering.CAPTURE_RANGE):
        text = (
            f"it cannot tell: {event.estimate.alpha.to_boundary()} is too far from where its fit "
            "begins, the nominal rotation; let the service acquire, or dither"
        )
        _show_passive(context, event, np.full(4, np.inf), np.zeros(4), text)
        return
    text = "no dithered estimate to compare with: nothing is made from this reading alone"
    _show_passive(context, event, event.estimate.sigma, np.zeros(4), text)


def _with_first_bias(registration: Registration, estimate: PassiveEstimate) -> Registration:
    """Return what is known with the bias as large as the first look at it says that it may be.

    A later look that says more is allowed for by the filter alone: whether the mirror has jumped is
    told with less patience.
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
    """Return the biases after a look, as the filter has them; ``previous``: what it saw it from."""
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
    """Return the loop that is looked at; while no RTC is there, the one of the last look."""
    if state.loop.rtc is not None:
        return loop_numbers(state.loop.rtc)
    bias = registration.bias(event.estimate.bias)
    return () if bias is None else bias.loop


def _why_of_two_places(
    state: TrackerState, registration: Registration, event: ev.PassiveFitted
) -> str | None:
    """Return why a passive estimate may be of telemetry from before a jump and after it, or None.

    It began no earlier than the one before it ended.
    """
    if registration.suspected_jump is not None:
        return BOTH_SIDES
    bias = registration.bias(event.estimate.bias)
    began_ns = 0 if bias is None else bias.looked_ns_utc
    span = TelemetrySpan(began_ns_utc=began_ns, ended_ns_utc=event.t_ns_utc)
    return void_intervals.why_void(state, span, Purpose.PASSIVE)


def _ask_for_window(
    context: StepContext,
    registration: Registration,
    event: ev.PassiveFitted,
    prior: Joint,
    far: float,
) -> None:
    """Forget the bias and want a dithered window: the wind has changed or the mirror has moved.

    A look alone is no match for windows: α stays valid, and nothing is made or sent until a window
    taken since has told. It is an alarm where none can, or none has when a second look disagrees.
    """
    text = (
        "ordinary telemetry disagrees: the wind has changed or the mirror has moved, and a "
        "dithered window must tell which"
    )
    registration = context.registration or registration
    waits, void = bool(registration.doubt), bool(registration.doubt) and registration.doubt_voids
    why_none = None if context.rtc is None else why_no_dither(context, context.rtc)
    gone = kalman.forget(prior, event.estimate.bias, event.estimate.bias_excess)
    after = _registration_after_passive(context, registration, gone, event)
    biases = _biases_after_look(context.state, registration, gone, event)
    doubted = replace(after, biases=biases, doubt=text, doubt_voids=void)
    validity.store_registration(context, doubted)
    _cast_doubt(context, event.t_ns_utc)
    context.warn("registration.passive-jump", f"{text} (innovation {far:.0f}, expected 4)")
    validity.request_window(context, text)
    if why_none is not None or waits:
        cannot = "none has since the last look that did" if why_none is None else why_none
        context.raise_alarm(alarms.DISAGREES, f"{text}: {cannot}; α stands as windows have it")
    validity.age_registration(context)
    _show_passive(context, event, event.estimate.sigma, np.zeros(4), text, consistent=False)


def _registration_after_passive(
    context: StepContext, registration: Registration, joint: Joint, event: ev.PassiveFitted
) -> Registration:
    """Return the registration as the filter has it after a look."""
    block, was = event.estimate.bias, None
    if registration.bias(block) is not None:
        was = jumps.sum_of(registration, filtering.joint_of(registration), block)
    return replace(
        registration,
        alpha=Misregistration.from_vector(joint.alpha),
        covariance=joint.alpha_covariance,
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
