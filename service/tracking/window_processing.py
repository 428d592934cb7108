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
from service.estimation.random_dither import RandomEstimate
from service.estimation.windows import RefusalKind
from service.model.misregistration import step_text
from service.tracking import alarms, filtering, jumps, pointing_law, validity
from service.tracking import events as ev
from service.tracking.alarms import Interlock
from service.tracking.dither import note_found
from service.tracking.filtering import FilterUpdate, WindowEstimate
from service.tracking.jumps import Innovation
from service.tracking.operations.acquisition_stages import count_miss
from service.tracking.operations.running import running_ramp
from service.tracking.policy import SECOND_NS
from service.tracking.registration import (
    Purpose,
    Registration,
    Source,
    SuspectedJump,
    TimedEstimate,
)
from service.tracking.state import Level
from service.tracking.step_context import StepContext, same_but_for_numbers
from service.tracking.validity import BOTH_SIDES

Array = NDArray[Any]

N_CONSECUTIVE_WINDOWS = 3
"""Windows refused one after the other that are no chance, and windows used that end it."""


MAX_TIME_WITHOUT_WINDOW_S = 60.0
"""Duration of a dither without an accepted window. A simulated RTC may be ten times slower than its
timestamps; a window then takes 20 s."""


HARMLESS_REFUSALS = (RefusalKind.CUT_SHORT, RefusalKind.VOID)
"""Kinds of refusals that are no fault, and say nothing of the windows before and after."""


def on_window(context: StepContext, event: ev.WindowFitted) -> None:
    """Fold one window's estimate into the registration, or refuse it with its reason."""
    estimate = event.estimate
    when = validity.telemetry_span(event.began_ns_utc, estimate.t_ns_utc)
    why = filtering.check_window(context, estimate, when)
    smeared = pointing_law.check_pointing_motion(
        context.state, when.began_ns_utc, when.ended_ns_utc
    )
    # Last, so that it replaces any other reason: what a smeared window says proves no fault.
    if smeared is not None:
        why = RefusalKind.VOID, smeared
    if why is not None:
        kind, reason = why
        reject_window(context, reason, kind)
        return
    # ``run`` counts accepted windows in a row as positive and refused ones as negative.
    context.windows = replace(context.windows, run=max(context.windows.run, 0) + 1)
    if validity.is_since_alarm(context.state, alarms.DITHER_LOST, when):
        note_found(context)
    random = isinstance(estimate, RandomEstimate)
    for name in (alarms.MISALIGNED, *(() if random else (alarms.WRONG_ANSWER,))):
        if validity.is_since_alarm(context.state, name, when):
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


def reject_window(context: StepContext, reason: str, kind: RefusalKind = RefusalKind.OTHER) -> None:
    """Count a window that gave nothing, and say why."""
    count_miss(context, kind)
    if kind is RefusalKind.MISALIGNED:
        context.raise_alarm(alarms.MISALIGNED, reason)
    if kind is RefusalKind.MISTOLD:
        context.raise_alarm(alarms.WRONG_ANSWER, reason)
    # The end of a dither cuts its last window: that is no fault.
    level = Level.INFO if kind is RefusalKind.CUT_SHORT else Level.WARNING
    _note_refusal(context, reason, level)
    if kind not in HARMLESS_REFUSALS:
        run = min(context.windows.run, 0) - 1
        context.windows = replace(context.windows, run=run, refused_because=reason)


def _note_refusal(context: StepContext, reason: str, level: Level = Level.INFO) -> None:
    line, n_refused = context.log("window.refused", reason, level), context.windows.refused + 1
    context.windows = replace(context.windows, refusal=line, refused=n_refused)


def process_window(context: StepContext, measured: WindowEstimate) -> None:
    """Fold a dithered window in, hold it, or have it decide about the one held before."""
    registration = context.registration
    if registration is None:
        joint = kalman.begin_joint(measured.numbers, measured.noise)
        if measured.with_stretches is not None:
            joint = kalman.expect_stretches(joint, context.nominal.stretches)
        filtering.accept(context, FilterUpdate(joint=joint, n_windows=1, innovation=0.0), measured)
        return
    first = jumps.previous_window(registration)
    both = jumps.pair_innovation(registration, measured, context.policy)
    if first is not None and both.is_outlier:
        if jumps.jump_lasts(registration, first, measured, both):
            _jump(context, registration, first, measured, both)
        else:
            _suspect_jump(context, registration, measured, both, first)
        return
    far = jumps.window_innovation(registration, measured, context.policy)
    too_early = validity.explain_void(context.state, measured.when, Purpose.SETTLE)
    # A window that began before the doubt and agrees with the old α cannot end the doubt. If it
    # disagrees, it counts.
    if too_early is not None and not far.is_outlier:
        _note_refusal(context, too_early)
        return
    if registration.suspected_jump is not None:
        text = (
            f"the window {_distance_text(registration.suspected_jump, registration)} from α was "
            f"not confirmed: the next one is {_distance_text(measured, registration)} away"
        )
        n_outlying = context.windows.outlying + 1
        context.windows = replace(context.windows, outlying=n_outlying)
        context.warn("window.outlier", text)
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


def explain_refusals(context: StepContext) -> str | None:
    """Return why windows are refused one after the other, or none comes; None: they are not.

    As many in a row as raise the alarm end it. One that is expected and does not come is as good as
    refused.
    """
    raised, run = context.alarm_text(alarms.WINDOWS_REFUSED), context.windows.run
    if run <= -N_CONSECUTIVE_WINDOWS:
        because = context.windows.refused_because
        text = f"windows are refused one after the other: {because}; α is not measured meanwhile"
        if raised is not None and same_but_for_numbers(raised, text):
            text = raised  # one cause is one text: of each window the log tells the numbers
    elif raised is not None and run < N_CONSECUTIVE_WINDOWS:
        text = raised
    else:
        text = _explain_missing_windows(context)
    return None if not text or _is_excused(context) else text


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
