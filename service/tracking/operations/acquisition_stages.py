"""The stages of an acquisition, and their dithers."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from service.control.dither import (
    COARSE_BAND,
    FINE_BAND,
    FIRST_LOOP_MODES,
    MIN_LINES,
    Band,
    spread_lines,
    spread_modes,
)
from service.estimation.loop import NO_RTC
from service.estimation.windows import RefusalKind
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking import validity
from service.tracking.alarms import LOST, Interlock, alarm_blocks, blocking_alarm
from service.tracking.dither import request_dither, request_stop, stop_running_dither
from service.tracking.dither_request import ACQUIRING_DITHER, Dither
from service.tracking.operation_records import (
    Acquisition,
    AcquisitionStage,
    LoopFound,
    ProbationState,
)
from service.tracking.operator import set_loop
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.reconstructors import forget_verdict
from service.tracking.registration import Registration
from service.tracking.state import Level, Mode, TrackerState
from service.tracking.step_context import StepContext
from service.tracking.update_policy import (
    forget_limit,
    half_of_modes,
    is_beyond_verdict,
    limit_modes,
)
from service.wire import DitherKind, DitherRequest, Status

FAR_WINDOW_S = 2.0
"""Telemetry in one estimate with the loop open, seconds."""

FAR_DITHER_DURATION_S = 6.0
"""Duration of a dither, seconds: two windows and the time until they are fitted; short, so that it
ends soon after a crashed service."""

CLOSING_GAIN = 0.3
"""Gain of every mode if the loop was open at the start: its status does not contain the gains."""

MAX_DIVERGENCE_S = 2.0
"""Duration of an alarm of a diverging loop after which the service opens the loop itself. A lost
loop is opened at once, unless the service is rolling back to the previous matrix, which takes less
than this."""

MISSES_BEFORE_ACQUISITION = 3
"""Consecutive windows without a registration after which the service acquires by itself."""

MISSES_WHILE_TRACKING = 10
"""Consecutive windows without a registration, while α is known, after which the service acquires:
bad telemetry alone opens no loop."""

MAX_ATTEMPTS = 3
"""Largest number of times that one acquisition opens the loop."""

HELD_OFF_TEXT = (
    "; none starts by itself until windows agree in a closed loop, the mode is set again, or an "
    "operator orders one"
)
"""End of the text of an acquisition that an operator ended."""

_MEASURED_STAGES = (
    AcquisitionStage.PARTIAL,
    AcquisitionStage.WIDENING,
    AcquisitionStage.INTERRUPTED,
)
"""Stages in which α, if it is known, was measured by this acquisition."""

MAX_ESTIMATE_DIFFERENCE = 23.5
"""χ² of the difference of two estimates (4 degrees of freedom) that one in 10^4 exceeds."""

MAX_STAGE_MISSES = 4
"""Failed windows of a stage after which the loop is opened again."""

STOP_STATUS_DELAY_S = 2.0
"""Longest time until the status shows the end of a dither that was stopped."""


def band_of(stage: AcquisitionStage) -> Band:
    """Return the band of modes that is dithered in a stage with the loop open."""
    return COARSE_BAND if stage is AcquisitionStage.COARSE else FINE_BAND


def wide_capture_dither(
    stage: AcquisitionStage, rtc: Status, policy: Policy, now_ns: int
) -> Dither | str:
    """Return the dither of a stage with the loop open, or why there is none.

    It is strong: an open loop leaves the pyramid little response, and nothing is observed
    meanwhile that could be spoilt.
    """
    modes, lines = _wide_capture_modes(stage, rtc)
    reason = _check_mode_number(modes, rtc)
    if reason is not None:
        return reason
    request = DitherRequest(
        id=f"{ACQUIRING_DITHER}{now_ns}",
        kind=DitherKind.SINE,
        modes=modes,
        amplitude_m=(min(policy.acquisition_amplitude_m, rtc.max_dither_m),) * len(modes),
        frequency_hz=lines[: len(modes)],
        duration_s=FAR_DITHER_DURATION_S,
    )
    return Dither(request=request, asked_ns_utc=now_ns, window_s=FAR_WINDOW_S)


def _wide_capture_modes(
    stage: AcquisitionStage, rtc: Status
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return the modes dithered in a stage with the loop open, and lines for them, Hz."""
    # With the loop open a dithered line is a measured column of D, so any mode of the basis can be
    # used.
    lines = _lines(rtc.frame_rate_hz, rtc.max_dither_modes)
    return spread_modes(band_of(stage), rtc.n_modes, len(lines)) if lines else (), lines


@lru_cache(maxsize=4)
def _lines(frame_rate_hz: float, n_lines: int) -> tuple[float, ...]:
    """Return the lines of an RTC; whether there are enough is asked with every state shown."""
    return spread_lines(frame_rate_hz, FAR_WINDOW_S, n_lines)


def _check_mode_number(modes: tuple[int, ...], rtc: Status) -> str | None:
    if len(modes) >= MIN_LINES:
        return None
    return (
        f"found room for {len(modes)} dithered modes; expected at least {MIN_LINES}: the "
        f"RTC plays {rtc.max_dither_modes} at once, at {rtc.frame_rate_hz:g} Hz, and its basis "
        f"has {rtc.n_modes}"
    )


def loop_found(state: TrackerState, rtc: Status, policy: Policy) -> LoopFound:
    """Return the loop as it is, and as it shall be closed again."""
    closed = rtc.loop != "open"
    out_of_hand = blocking_alarm(state.alarms.active, Interlock.HOLD) is not None
    goal = rtc.n_controlled or policy.wanted_modes(rtc)
    # The status of an open loop does not contain the gains with which it was closed.
    gains = rtc.gains if closed else (CLOSING_GAIN,) * goal
    return LoopFound(
        closed=closed,
        gains=gains,
        n_controlled=goal,
        leak=rtc.leak,
        held=closed and not out_of_hand,
    )


def acquisition_left_open(state: TrackerState, rtc: Status) -> Acquisition | None:
    """Return the interrupted acquisition, if the loop is as it left it.

    Opening a loop begins a session: the same session means that the loop was not closed in between.
    """
    left = state.operations.acquisition.interruption
    if left is None or left.session != rtc.session or rtc.loop != "open":
        return None
    return state.operations.acquisition


def gains_for(found: LoopFound, n_modes: int, of_basis: int) -> tuple[float, ...]:
    """Return the gains ``(of_basis,)`` with which so many modes are closed."""
    return (*found.gains[:n_modes], *(0.0,) * (of_basis - n_modes))


def begin_acquisition(context: StepContext, rtc: Status, *, why: str, commanded: bool) -> None:
    """Begin one: nothing is known of α any more."""
    left = acquisition_left_open(context.state, rtc)
    found = left.found if left is not None else None
    found = found or loop_found(context.state, rtc, context.policy)
    set_acquisition(
        context,
        Acquisition(
            stage=AcquisitionStage.OPENING,
            text=f"opening the loop: {why}",
            started_ns_utc=context.now_ns,
            since_ns_utc=context.now_ns,
            commanded=commanded,
            attempt=1,
            found=found,
            n_modes=min(found.n_controlled, FIRST_LOOP_MODES),
            sent=left is not None and left.sent,
            cause=context.cause,
        ),
    )
    # A window that began before the loop is opened would mix two loops.
    validity.invalidate_telemetry(context, "the acquisition had not begun")
    validity.forget_registration(context)
    forget_verdict(context)


def may_acquire(state: TrackerState, policy: Policy) -> bool:
    """Return whether the service may acquire by itself in mode auto, if it has a reason to."""
    rtc, acquisition = state.loop.rtc, state.operations.acquisition
    if not policy.acquires or rtc is None or rtc.loop == "open":
        return False
    if not policy.dither_enabled or state.dithers.stopped or state.measuring is not None:
        return False
    failed = acquisition.stage is AcquisitionStage.FAILED
    blocked = blocking_alarm(state.alarms.active, Interlock.SEND_NEW) is not None
    return not (failed or acquisition.held_off or blocked)


def explain_acquisition(state: TrackerState, policy: Policy, now_ns: int) -> str | None:
    """Return why the service should acquire by itself, or None."""
    if state.operator.mode is not Mode.AUTO or not may_acquire(state, policy):
        return None
    trial = state.operations.probation
    if trial is not None and trial.state is ProbationState.ACQUIRING:
        return f"the loop is lost with {trial.id} and with {trial.before}"
    for alarm in state.alarms.active:
        lasted_ns = now_ns - alarm.since_ns_utc
        # During a rollback the loop is given the time in which the previous matrix can recover it.
        waits_s = 0.0 if alarm.name == LOST and not _goes_back(state) else MAX_DIVERGENCE_S
        if alarm_blocks(alarm, Interlock.HOLD) and lasted_ns >= waits_s * SECOND_NS:
            return f"{alarm.name} for {lasted_ns / SECOND_NS:.0f} s"
    # Bad telemetry alone also refuses windows. Only a loop that has stopped correcting is opened
    # for it.
    if has_missed_enough(state) and not state.loop.holds:
        return f"{state.operations.acquisition.misses} windows in a row found no registration"
    return None


def _goes_back(state: TrackerState) -> bool:
    """Return whether the matrix before is on its way to the RTC, or has just come there."""
    trial = state.operations.probation
    return trial is not None and trial.state in {
        ProbationState.ROLLING_BACK,
        ProbationState.WATCHED,
    }


def has_missed_enough(state: TrackerState) -> bool:
    """Return whether so many windows in a row found no registration that it is no chance."""
    is_known = state.alpha.registration is not None and state.alpha.registration.usable
    return state.operations.acquisition.misses >= (
        MISSES_WHILE_TRACKING if is_known else MISSES_BEFORE_ACQUISITION
    )


def count_miss(context: StepContext, kind: RefusalKind) -> None:
    """Count a refused window, if α was out of its reach and no acquisition is under way."""
    if not context.acquisition.under_way and kind is RefusalKind.OUT_OF_REACH:
        set_acquisition(
            context, replace(context.acquisition, misses=context.acquisition.misses + 1)
        )


def check_acquisition(state: TrackerState, policy: Policy) -> str | None:
    """Return why no acquisition can begin now, or None."""
    if state.loop.rtc is None:
        return NO_RTC
    if not policy.dither_enabled:
        return "the settings forbid any dither"
    alarm = blocking_alarm(state.alarms.active, Interlock.SEND_NEW)
    if alarm is not None:
        return f"{alarm.name}: {alarm.text}"
    modes, _ = _wide_capture_modes(AcquisitionStage.COARSE, state.loop.rtc)
    return _check_mode_number(modes, state.loop.rtc)


def sigma_of(acquisition: Acquisition) -> str:
    """Return 1 σ of the α found, for a person."""
    if acquisition.covariance is None:
        return "not known"
    x, y, rotation, magnification = np.sqrt(np.diag(acquisition.covariance))
    return f"{x:.3f}, {y:.3f} subap, {np.rad2deg(rotation):.2f} deg, {magnification:.3f} (1 sigma)"


def set_acquisition(context: StepContext, acquisition: Acquisition) -> None:
    """Note how far it has come."""
    context.operations = replace(context.operations, acquisition=acquisition)


def enter_stage(context: StepContext, stage: AcquisitionStage, text: str) -> None:
    """Begin a stage."""
    set_acquisition(
        context,
        replace(
            context.acquisition,
            stage=stage,
            text=text,
            since_ns_utc=context.now_ns,
            misses=0,
            command=None,
        ),
    )
    level = Level.WARNING if stage is AcquisitionStage.FAILED else Level.INFO
    context.log(f"acquisition.{stage}", text, level)


def request_loop(context: StepContext, command: cmd.SetLoop) -> None:
    """Ask the RTC to change its loop, and remember having asked."""
    set_loop(context, command)
    asked = context.loop.command
    set_acquisition(
        context, replace(context.acquisition, command=None if asked is None else asked.id)
    )


def restart_acquisition(context: StepContext, reason: str, *, slipped: bool = False) -> None:
    """Restart with the loop opened again, at once, a few times; then give up.

    A loop that has slipped is closed on half as many modes next time.
    """
    acquisition = context.acquisition
    if acquisition.attempt >= MAX_ATTEMPTS:
        fail_acquisition(context, f"{reason}, after {acquisition.attempt} attempts")
        return
    most = acquisition.max_modes
    lost_with = acquisition.lost_with
    if slipped:
        # Fewer modes tolerate a larger misregistration.
        most, lost_with = half_of_modes(acquisition.n_modes), None
        limit_modes(context, most, reason)
    goal = acquisition.n_modes if acquisition.found is None else acquisition.found.n_controlled
    validity.invalidate_telemetry(context, "the acquisition had not restarted")
    stop_running_dither(context)
    validity.forget_registration(context)
    set_acquisition(
        context,
        replace(
            acquisition,
            attempt=acquisition.attempt + 1,
            alpha=None,
            covariance=None,
            matrix=None,
            max_modes=most,
            lost_with=lost_with,
            n_modes=min(acquisition.n_modes, most or goal),
        ),
    )
    enter_stage(context, AcquisitionStage.OPENING, f"opening the loop again: {reason}")
    if context.rtc is not None and context.rtc.loop != "open":
        request_loop(context, cmd.SetLoop(loop="open"))


def fail_acquisition(context: StepContext, reason: str) -> None:
    """Give up: the loop stays as it is, but one that is out of hand is opened."""
    closed = context.rtc is not None and context.rtc.loop != "open"
    out_of_hand = context.blocking_alarm(Interlock.HOLD) is not None
    stop_running_dither(context)
    validity.forget_registration(context)
    set_acquisition(context, replace(context.acquisition, windows=context.windows.accepted))
    if closed and out_of_hand:
        request_loop(context, cmd.SetLoop(loop="open"))
    text = (
        f"no registration was acquired: {reason}; see the log, then acquire again, or close the "
        "loop on a matrix of your own"
    )
    enter_stage(context, AcquisitionStage.FAILED, text)


def abort_acquisition(context: StepContext, why: str, *, held_off: bool = False) -> None:
    """End it at once: the loop as it was found, if it held then and nothing was sent; else as is.

    As is means open, or closed on a reconstructor that has passed the gate. ``held_off``: none
    begins by itself for now, though what made this one begin may last.
    """
    stop_running_dither(context)
    # In the other stages a second set of modes has not confirmed α.
    if context.acquisition.stage not in _MEASURED_STAGES:
        validity.forget_registration(context)
    left, found = "left as it is", _to_give_back(context.state)
    if found is not None:
        left = "closed as it was found"
        request_loop(context, cmd.SetLoop(loop="closed", leak=found.leak))
    text = f"ended {why}; the loop is {left}{HELD_OFF_TEXT if held_off else ''}"
    over = replace(context.acquisition, held_off=held_off, windows=context.windows.accepted)
    set_acquisition(context, over)
    enter_stage(context, AcquisitionStage.ABORTED, text)


def wide_capture_stage(context: StepContext, rtc: Status) -> None:
    """Open the loop, then keep the dither of the stage running."""
    acquisition = context.acquisition
    if acquisition.stage is AcquisitionStage.OPENING:
        if rtc.loop != "open":
            if acquisition.command is None:
                request_loop(context, cmd.SetLoop(loop="open"))
            return
        text = "looking for the registration with the loop open, on smooth modes"
        enter_stage(context, AcquisitionStage.COARSE, text)
    elif rtc.loop != "open":
        restart_acquisition(context, "the loop was closed from outside")
        return
    _keep_dithering(context, rtc)


def on_wide_capture(context: StepContext, event: ev.WideCaptureFitted) -> None:
    """Take over where a window puts the mirror, or hold it against where another one did."""
    rtc, before, estimate = context.rtc, context.acquisition, event.found.estimate
    if (
        validity.explain_void(
            context.state, validity.telemetry_span(event.began_ns_utc, estimate.t_ns_utc)
        )
        is not None
    ):
        return
    if rtc is None or not before.uses_wide_capture or estimate.session != rtc.session:
        return
    if not _is_of_stage(context, rtc, estimate.modes):
        return
    covariance = estimate.covariance + np.diag(band_of(before.stage).floor ** 2)
    set_acquisition(context, replace(before, alpha=estimate.alpha, covariance=covariance))
    place = f"{estimate.alpha} +- {sigma_of(context.acquisition)}"
    if before.stage is AcquisitionStage.COARSE or before.alpha is None or before.covariance is None:
        stop_running_dither(context)
        enter_stage(context, AcquisitionStage.CONFIRMING, f"{place}: other modes must confirm it")
        return
    difference = estimate.alpha.vector - before.alpha.vector
    chi2 = float(difference @ np.linalg.solve(covariance + before.covariance, difference))
    # Two sets of modes must agree before α is used (docs/decisions/0019-acquisition.md).
    if chi2 > MAX_ESTIMATE_DIFFERENCE:
        set_acquisition(context, before)
        reason = (
            f"two sets of modes disagree: {before.alpha} and {estimate.alpha}, "
            f"chi2 {chi2:.0f}, expected at most {MAX_ESTIMATE_DIFFERENCE}"
        )
        restart_acquisition(context, reason)
        return
    registration = Registration(
        alpha=estimate.alpha,
        covariance=covariance,
        floor=context.policy.floor,
        image_floor=context.policy.image_floor,
        t_ns_utc=estimate.t_ns_utc,
        arrived_ns_utc=context.now_ns,
        n_windows=1,
        basis_id=context.loop.basis_id,
        config_id=context.loop.config_id,
        nominal=context.alpha.law.nominal,
    )
    validity.store_registration(context, registration)
    _lift_limit_of_jump(context)
    stop_running_dither(context)
    enter_stage(context, AcquisitionStage.PARTIAL, f"{place}: closing the loop")


def _lift_limit_of_jump(context: StepContext) -> None:
    """Allow all modes again where the loop was lost because the mirror had jumped.

    The matrix that lost it was made for another registration, beyond what the gate had judged it
    at: the loss says nothing of how many modes hold at this one.
    """
    acquisition = context.acquisition
    record = context.state.reconstructor(acquisition.lost_with)
    if record is None or acquisition.found is None:
        return
    if not is_beyond_verdict(context.state, record):
        return
    n_modes = acquisition.found.n_controlled
    first = min(n_modes, FIRST_LOOP_MODES)
    set_acquisition(context, replace(acquisition, max_modes=None, n_modes=first, lost_with=None))
    forget_limit(context)
    context.log("modes.limit-lifted", f"the mirror has moved since {record.id}: {n_modes} modes")


def on_missed(context: StepContext, reason: str) -> None:
    """Count a window without a result; after a few, restart."""
    misses = context.acquisition.misses + 1
    if misses >= MAX_STAGE_MISSES:
        restart_acquisition(context, reason)
    else:
        set_acquisition(context, replace(context.acquisition, misses=misses))


def _keep_dithering(context: StepContext, rtc: Status) -> None:
    """Ask for the dither of the stage once no other one runs."""
    if context.dither is not None or context.now_ns < context.dithers.no_dither_before_ns_utc:
        return
    if rtc.dither_id is not None:
        stopping = rtc.dither_id == context.dither_policy.stopped_id
        since_s = (context.now_ns - context.acquisition.since_ns_utc) / SECOND_NS
        if not (stopping and since_s < STOP_STATUS_DELAY_S):
            context.put_off(dither_s=STOP_STATUS_DELAY_S)
            request_stop(context)
        return
    dither = wide_capture_dither(context.acquisition.stage, rtc, context.policy, context.now_ns)
    if isinstance(dither, str):
        fail_acquisition(context, dither)
    else:
        request_dither(context, dither)


def _to_give_back(state: TrackerState) -> LoopFound | None:
    """Return the loop as it was found, if it held then and its matrix is still in the RTC."""
    acquisition, rtc = state.operations.acquisition, state.loop.rtc
    found = acquisition.found
    if rtc is None or found is None or acquisition.sent or not (found.closed and found.held):
        return None
    if acquisition.interruption is not None and acquisition_left_open(state, rtc) is None:
        return None
    return found


def _is_of_stage(context: StepContext, rtc: Status, modes: tuple[int, ...]) -> bool:
    """Return whether these are the modes of the present stage."""
    dither = wide_capture_dither(context.acquisition.stage, rtc, context.policy, 0)
    return not isinstance(dither, str) and dither.request.modes == modes
