"""Accept a window or a passive estimate into the registration, or reject it.

One window far from α may be a jump or an error. It is held, nothing is computed from α meanwhile,
and the next window decides: if it agrees with the held one, it is a jump; if it agrees with all
earlier ones, the held one is an outlier. A jump that one window cannot distinguish from noise is
detected by two together. If windows scatter by more than they predict, they must agree for longer
than turbulence is correlated.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.estimation import kalman
from service.estimation.kalman import Joint
from service.estimation.loop import loop_numbers, same_numbers
from service.model.misregistration import Misregistration, step_text
from service.records import alarms
from service.records import events as ev
from service.records.alarms import Interlock
from service.records.estimates import PassiveEstimate, RandomEstimate, RefusalKind
from service.records.messages import Message, as_message, compose
from service.records.registration import (
    Bias,
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
from service.records.state import Level, TrackerState
from service.tracking import filtering, jumps, pointing_law, validity
from service.tracking.dither import note_found
from service.tracking.dither_plan import check_dither_allowed
from service.tracking.filtering import FilterUpdate, WindowEstimate
from service.tracking.jumps import Innovation
from service.tracking.operations.acquisition import count_miss
from service.tracking.operations.measurement import MEASURING
from service.tracking.operations.running import running_ramp
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext
from service.tracking.validity import BOTH_SIDES, without_previous

Array = NDArray[Any]

N_CONSECUTIVE_WINDOWS = 3
"""Windows refused one after the other that are no chance, and windows used that end it."""


MAX_TIME_WITHOUT_WINDOW_S = 60.0
"""Duration of a dither without an accepted window. A simulated RTC may be ten times slower than its
timestamps; a window then takes 20 s."""


HARMLESS_REFUSALS = (RefusalKind.CUT_SHORT, RefusalKind.VOID)
"""Kinds of refusals that are no fault, and say nothing of the windows before and after."""


def on_window(context: StepContext, event: ev.WindowFitted) -> None:
    """Fold one window's estimate into the registration, or refuse it with its reason.

    An acquisition counts a refused window as a miss.
    """
    if context.state.measuring is not None:
        reject_window(context, MEASURING)
        return
    estimate = event.estimate
    # A window whose beginning is not known counts as short.
    began_ns = event.began_ns_utc or estimate.t_ns_utc
    estimate = validity.at_present(context.state, estimate, began_ns, estimate.t_ns_utc)
    why = filtering.check_window(context, estimate, began_ns)
    smeared = pointing_law.check_pointing_motion(context.state, began_ns, estimate.t_ns_utc)
    # Last, so that it replaces any other reason: what a smeared window says proves no fault.
    if smeared is not None:
        why = RefusalKind.VOID, smeared
    if why is not None:
        kind, reason = why
        reject_window(context, reason, kind)
        return
    # ``run`` counts accepted windows in a row as positive and refused ones as negative.
    context.windows = replace(context.windows, run=max(context.windows.run, 0) + 1)
    if validity.is_since_alarm(context.state, alarms.DITHER_LOST, began_ns):
        note_found(context)
    random = isinstance(estimate, RandomEstimate)
    for name in (alarms.MISALIGNED, *(() if random else (alarms.WRONG_ANSWER,))):
        if validity.is_since_alarm(context.state, name, began_ns):
            context.clear_alarm(name)
    registration = context.registration
    modes, gains, gain_sigma = filtering.gains_of(estimate)
    measured = WindowEstimate(
        alpha=estimate.alpha,
        covariance=estimate.covariance,
        t_ns_utc=estimate.t_ns_utc,
        pointing=validity.pointing_at(context.state, estimate.t_ns_utc),
        began_ns_utc=began_ns,
        source=Source.RANDOM if random else Source.LOCK_IN,
        optical_gain=float(filtering.strong_gains(estimate).mean()),
        optical_gains=filtering.update_gains(
            () if registration is None else registration.optical_gains,
            modes,
            gains[: len(modes)],
            gain_sigma,
            estimate.t_ns_utc,
        ),
        floor=filtering.model_error_of(
            registration, estimate, context.policy, context.matrices.mode_proof.own_model_error
        ),
        misfit=estimate.misfit,
        with_stretches=estimate.with_stretches,
    )
    process_window(context, measured)


def on_lost(context: StepContext, event: ev.WindowLost) -> None:
    """Count a window that could not be evaluated."""
    reject_window(context, event.refused.reason, event.refused.kind)


def reject_window(
    context: StepContext, reason: str | Message, kind: RefusalKind = RefusalKind.OTHER
) -> None:
    """Count a window that gave nothing, and say why."""
    reason = as_message("window.failed", reason)
    count_miss(context, kind)
    if kind is RefusalKind.MISALIGNED:
        context.raise_alarm(alarms.MISALIGNED, reason)
    if kind is RefusalKind.MISDESCRIBED:
        context.raise_alarm(alarms.WRONG_ANSWER, reason)
    # The end of a dither cuts its last window: that is no fault.
    level = Level.INFO if kind is RefusalKind.CUT_SHORT else Level.WARNING
    _note_refusal(context, reason, level)
    if kind not in HARMLESS_REFUSALS:
        pointing_law.change_side(context)
        run = min(context.windows.run, 0) - 1
        context.windows = replace(context.windows, run=run, refused_because=reason)


def _note_refusal(context: StepContext, reason: Message, level: Level = Level.INFO) -> None:
    line, n_refused = context.log("window.refused", reason, level), context.windows.refused + 1
    context.windows = replace(context.windows, refusal=line, refused=n_refused)


def process_window(context: StepContext, measured: WindowEstimate) -> None:
    """Fold a dithered window in, hold it, or have it decide about the one held before."""
    pointing_law.decide_leap(context, measured)
    registration = context.registration
    if registration is None:
        joint = kalman.begin_joint(measured.numbers, measured.noise)
        if measured.with_stretches is not None:
            joint = kalman.expect_stretches(joint, context.nominal.stretches)
        filtering.accept(context, FilterUpdate(joint=joint, n_windows=1, innovation=0.0), measured)
        return
    first, own = jumps.previous_window(registration), context.matrices.mode_proof.own_model_error
    both = jumps.pair_innovation(registration, measured, context.policy, own)
    if first is not None and both.is_outlier:
        if jumps.jump_lasts(registration, first, measured, both):
            _jump(context, registration, first, measured, both)
        else:
            _suspect_jump(context, registration, measured, both, first)
        return
    far = jumps.window_innovation(registration, measured, context.policy, own)
    too_early = validity.explain_void(context.state, measured.began_ns_utc, Purpose.SETTLE)
    # A window that began before the doubt and agrees with the old α cannot end the doubt. If it
    # disagrees, it counts.
    if too_early is not None and not far.is_outlier:
        _note_refusal(context, as_message("window.void", too_early))
        return
    if registration.suspected_jump is not None:
        n_outlying = context.windows.outlying + 1
        context.windows = replace(context.windows, outlying=n_outlying)
        message = compose(
            "window.not-confirmed",
            first=_distance_text(registration.suspected_jump, registration),
            second=_distance_text(measured, registration),
        )
        context.warn("window.outlier", message)
        # The rejected window shows that windows scatter: it counts with the most that one may.
        registration = replace(
            registration, scatter=kalman.learnt(registration.scatter, kalman.JUMP_THRESHOLD)
        )
    if far.is_outlier:
        _suspect_jump(context, registration, measured, far)
        return
    prior = filtering.predict_for(context, registration, measured)
    update = FilterUpdate(
        joint=kalman.correct_state(prior, measured.numbers, measured.noise),
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
    """Hold a window that is far from α, and mark α as in doubt until another one has arrived.

    ``first`` is the previous window if it agrees; ``far`` is the distance of both together.
    """
    innovation = far.mahalanobis_squared
    text = (
        f"a window is {_distance_text(measured, registration)} from α "
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
    validity.cast_doubt(context, measured.t_ns_utc)
    filtering.add_history(
        context, filtering.history_entry(measured, registration, innovation, entered=False)
    )
    if first is None or registration.suspected_jump is None:
        context.warn("registration.jump-suspected", text)
    validity.request_window(context, doubt)
    validity.age_registration(context)


def _jump(
    context: StepContext,
    registration: Registration,
    first: TimedEstimate,
    measured: WindowEstimate,
    both: Innovation,
) -> None:
    """Go to the new place, which two windows have now seen, ``both`` together so far.

    The first of them is used if it is wholly of the new place. Beyond all turbulence it confirms
    the second wherever the jump fell in it: the loop suffers, and a third would cost seconds.
    """
    policy = context.policy
    prior = filtering.predict_for(context, registration, measured)
    noise = measured.covariance
    whole = jumps.is_after_jump(first, measured, registration.alpha, policy)
    if whole:
        elapsed_s = max(measured.t_ns_utc - first.t_ns_utc, 0) / SECOND_NS
        # The first window is older: α has drifted between the two.
        noise = first.covariance + np.diag(policy.drift_rate**2 * elapsed_s)
    # The earlier estimates contain no information on the new registration.
    joint = kalman.widen_after_jump(prior, noise)
    if whole:
        joint = kalman.correct_state(joint, first.alpha.vector, noise)
    update = FilterUpdate(
        joint=kalman.correct_state(joint, measured.numbers, measured.noise),
        # Two windows are required before a matrix is made (docs/decisions/0025-jumps.md).
        n_windows=2 if whole or both.excess > jumps.MAX_TURBULENCE_EXCESS else 1,
        innovation=_innovation(prior, measured),
        scatter=registration.scatter,
        jumped=True,
    )
    # Ordinary telemetry summed until now mixes both registrations.
    validity.void_until(context, first.t_ns_utc, BOTH_SIDES, Purpose.PASSIVE)
    # A window that was held was not counted when it came; one that had entered was.
    held = whole and registration.suspected_jump is not None
    filtering.accept(context, update, measured, n_accepted=2 if held else 1)
    context.warn(
        "registration.jump",
        f"jumped by {_distance_text(measured, registration)}, as two windows have seen",
    )


def _innovation(prior: Joint, measured: WindowEstimate) -> float:
    return kalman.innovation(prior, measured.alpha.vector, measured.covariance)


def _distance_text(window: TimedEstimate, registration: Registration) -> str:
    return step_text(window.alpha.vector - registration.alpha.vector)


def reset_run(context: StepContext) -> None:
    """Restart the count of consecutive windows when none is expected any more."""
    if context.windows.run < 0 and _is_excused(context):
        context.windows = replace(context.windows, run=0)


def explain_refusals(context: StepContext) -> str | Message | None:
    """Return why windows are refused one after the other, or none comes; None: they are not.

    As many in a row as raise the alarm end it. One that is expected and does not come is as good as
    refused.
    """
    alarm, run = context.state.alarm(alarms.WINDOWS_REFUSED), context.windows.run
    raised, because = None if alarm is None else alarm.message, context.windows.refused_because
    found: str | Message
    if run <= -N_CONSECUTIVE_WINDOWS and because is not None:
        found = compose("window.refused-in-a-row", because.key, reason=str(because))
        if raised is not None and raised.key == found.key:
            found = raised  # One cause has one text: the log has the numbers of each window.
    elif raised is not None and run < N_CONSECUTIVE_WINDOWS:
        found = raised
    else:
        found = _explain_missing_windows(context)
    return None if not found or _is_excused(context) else found


def _explain_missing_windows(context: StepContext) -> str:
    registration, dither, rtc = context.registration, context.dither, context.rtc
    if dither is None or dither.start_seq is None or rtc is None:
        return ""
    since_ns = max(registration.window_ns_utc if registration else 0, dither.asked_ns_utc)
    patience_s = max(MAX_TIME_WITHOUT_WINDOW_S, 3.0 * (dither.window_s or 0.0))
    if context.now_ns - since_ns < patience_s * SECOND_NS:
        return ""
    # an RTC in slow motion has not played a window yet
    played_s = None if rtc.seq is None else (rtc.seq - dither.start_seq) / rtc.frame_rate_hz
    if played_s is not None and played_s < 3.0 * (dither.window_s or 0.0):
        return ""
    return f"no window was accepted for {patience_s:.0f} s although a dither runs"


def _is_excused(context: StepContext) -> bool:
    """Return whether windows are refused for what is known already, or none is wanted."""
    state, rtc = context.state, context.rtc
    if rtc is None or not rtc.in_loop or state.dithers.stopped or state.operator.stopped_because:
        return True
    if context.acquisition.under_way or state.measuring is not None:
        return True
    return (
        running_ramp(state, context.now_ns) is not None
        or context.blocking_alarm(Interlock.MEASURE) is not None
        or context.blocking_alarm(Interlock.ASK) is not None
    )


def process_passive(context: StepContext, event: ev.PassiveFitted) -> None:
    """Update α by the passive estimate and its bias, or mark α as doubtful."""
    reason = _check_passive_estimate(context.state, event)
    if reason is not None:
        text = f"the passive estimate was not used: {reason}"
        context.alpha = replace(context.alpha, passive_unavailable_reason=text)
        return
    began_ns = event.began_ns_utc or event.t_ns_utc
    estimate = validity.at_present(context.state, event.estimate, began_ns, event.t_ns_utc)
    registration, event = context.registration, replace(event, estimate=estimate)
    if registration is None:
        _show_passive_alone(context, event)
        return
    registration = _with_first_bias(registration, estimate)
    forward = filtering.predict(context, registration, event.t_ns_utc)
    prior = kalman.allow_scatter(forward, estimate.bias_excess)
    mixed = _check_single_registration(context.state, registration, event)
    if mixed is not None:
        joint = filtering.joint_of(registration)
        bias = _bias_after_look(context.state, registration, joint, event)
        validity.store_registration(context, replace(registration, bias=bias))
        sigma = _passive_sigma(estimate, prior)
        _show_passive(context, event, sigma, prior.offset, f"not used: {mixed}")
        return
    measured = estimate.alpha.vector
    window = PointedEstimate(
        alpha=estimate.alpha,
        covariance=(prior.bias or Bias()).scatter * estimate.covariance,
        t_ns_utc=event.t_ns_utc,
        pointing=validity.pointing_at(context.state, event.t_ns_utc),
    )
    far = jumps.passive_innovation(
        registration, filtering.joint_of(registration), window, context.policy
    )
    # A passive estimate never moves α far by itself: wind and a moved mirror look alike in it
    # (docs/decisions/0020-filter-and-passive-estimate.md).
    if far > jumps.MAX_PASSIVE_INNOVATION:
        _ask_for_window(context, registration, event, prior, far)
        return
    joint = kalman.correct_state(prior, measured, estimate.covariance, passive=True)
    joint = kalman.update_scatter(joint, far)
    registration = _registration_after_passive(context, registration, joint, event)
    validity.store_registration(context, registration)
    validity.age_registration(context)
    sigma = _passive_sigma(estimate, prior)
    entry = HistoryEntry(
        t_ns_utc=event.t_ns_utc,
        measured=Misregistration.from_vector(measured - joint.offset),
        measured_sigma=sigma,
        filtered=registration.alpha,
        filtered_sigma=registration.shown_sigma,
        innovation=kalman.innovation(prior, measured, estimate.covariance, passive=True),
        misfit=estimate.misfit,
        source=Source.PASSIVE,
    )
    filtering.add_history(context, entry)
    text = "agrees with α and with what is known of its own bias"
    _show_passive(context, event, sigma, joint.offset, text)


def on_passive_unavailable(context: StepContext, event: ev.PassiveUnavailable) -> None:
    """Store why there is no passive estimate."""
    context.alpha = replace(context.alpha, passive_unavailable_reason=event.text)


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
    of_loop, registration = loop_numbers(state.loop.rtc), state.alpha.registration
    # The bias belongs to the loop in which it was measured.
    if event.loop and of_loop and not same_numbers(event.loop, of_loop):
        return "the loop has changed since"
    reason = filtering.check_measurable(state, event.began_ns_utc or event.t_ns_utc)
    if reason is not None or registration is None or not registration.window_began_ns_utc:
        return reason
    # Later telemetry supersedes a delayed estimate.
    if validity.precedes(state, registration.window_began_ns_utc, event.t_ns_utc):
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
    if registration.bias is not None and registration.bias.looked_ns_utc:
        return registration
    joint = kalman.forget(filtering.joint_of(registration), estimate.bias_excess)
    return replace(registration, bias=filtering.bias_of(joint))


def _bias_after_look(
    state: TrackerState,
    registration: Registration,
    joint: Joint,
    event: ev.PassiveFitted,
    previous: PreviousEstimate | None = None,
) -> PassiveBias | None:
    """Return the bias after a passive estimate; ``previous``: what the filter saw it from."""
    loop, before, bias = loop_numbers(state.loop.rtc), registration.bias, filtering.bias_of(joint)
    if state.loop.rtc is None and before is not None:
        loop = before.loop
    return bias and replace(
        bias, looked_ns_utc=event.t_ns_utc, loop=loop, previous_estimate=previous
    )


def _check_single_registration(
    state: TrackerState, registration: Registration, event: ev.PassiveFitted
) -> str | None:
    """Return why a passive estimate may be of telemetry from before a jump and after it, or None.

    It began no earlier than the one before it ended.
    """
    if registration.suspected_jump is not None:
        return BOTH_SIDES
    bias = registration.bias
    # Passive estimates share no telemetry, so this one began after the last one ended.
    began_ns = 0 if bias is None else bias.looked_ns_utc
    return validity.explain_void(state, began_ns, Purpose.PASSIVE)


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
    was_doubted = bool(registration.doubt)
    why_none = None if context.rtc is None else check_dither_allowed(context, context.rtc)
    # In another wind the bias is another one.
    gone = kalman.forget(prior, event.estimate.bias_excess)
    after = _registration_after_passive(context, registration, gone, event)
    voids = was_doubted and registration.doubt_voids
    bias = without_previous(after.bias)
    doubted = replace(after, bias=bias, doubt=text, doubt_voids=voids)
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
    was = None
    if registration.bias is not None:
        was = jumps.sum_of(registration, filtering.joint_of(registration))
    return replace(
        registration,
        alpha=filtering.alpha_of(joint, registration.alpha),
        covariance=joint.alpha_covariance,
        stretches=filtering.stretches_of(joint),
        # A passive fit may end after that of a window with newer telemetry.
        t_ns_utc=max(event.t_ns_utc, registration.t_ns_utc),
        arrived_ns_utc=context.now_ns,
        bias=_bias_after_look(context.state, registration, joint, event, was),
        pointing=validity.pointing_at(context.state, event.t_ns_utc),
    )


def _passive_sigma(estimate: PassiveEstimate, prior: Joint) -> Array:
    """Return ``(4,)`` 1 σ of the estimate as a reading of α: its scatter, and that of its bias."""
    return np.sqrt(np.diag(estimate.covariance) + np.diag(prior.covariance)[prior.place])


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
    )
    context.alpha = replace(context.alpha, passive=watchdog, passive_unavailable_reason="")
