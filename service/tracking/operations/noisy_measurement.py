"""Noisy interaction matrices, measured on sky by random signs.

The sums are kept where the telemetry comes in; here is only how far each measurement is.
"""

from __future__ import annotations

from dataclasses import replace

from service.errors import CommandError
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.dither import request_dither, stop_running_dither
from service.tracking.dither_request import DEFAULT_RANDOM_RMS_M, cost_of, plan_random
from service.tracking.events import Event
from service.tracking.operation_records import MeasurementRecord, MeasureState
from service.tracking.operations.measurement import fail_measurement, store_measurement
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext, present
from service.wire import DitherRequest, Reply, Status

DEFAULT_DURATION_S = 30.0
"""Default duration: on a bright star an element is then as large as its noise."""

DITHER_END_TIMEOUT_S = 15.0
"""Time for the service's own dither to vanish from the RTC's status."""

FIT_TIMEOUT_S = 120.0
"""Time for the fit and the archive."""


def measure_noisy(context: StepContext, command: cmd.MeasureNoisy) -> None:
    """Measure a noisy interaction matrix after the running dither.

    Raises
    ------
    CommandError
        If it costs more than the budget, or names an id that was used before.
    """
    rtc = present(context.rtc)
    if context.state.measurement(command.id) is not None:
        raise CommandError(f"{command.id} was measured before; ids are never reused")
    duration_s = command.duration_s or DEFAULT_DURATION_S
    total = command.total_amplitude_m or min(DEFAULT_RANDOM_RMS_M, context.policy.dither_budget_m)
    cost_of(total, context.policy, over_budget=command.over_budget)
    dither = plan_random(
        rtc,
        context.policy,
        context.now_ns,
        dither_id=command.id,
        modes=command.modes,
        total_m=total,
        duration_s=duration_s,
    )
    record = MeasurementRecord(
        id=command.id,
        state=MeasureState.WAITING,
        pattern=None,
        modes=dither.request.modes,
        amplitude_m=dither.request.amplitude_m,
        duration_s=duration_s,
        window_s=dither.window_s,
        seed=dither.request.seed,
        asked_ns_utc=context.now_ns,
        basis_id=rtc.basis_id,
        config_id=rtc.config_id,
        cause=context.cause,
    )
    store_measurement(context, record)
    text = (
        f"{record.id}: {len(record.modes)} modes, {1e9 * record.total_m:.3g} nm RMS in all, "
        f"{duration_s:g} s"
    )
    context.log("noisy-matrix.asked", text)
    stop_running_dither(context)


def advance(context: StepContext, event: Event) -> None:
    """Go on with the one under way, if there is one."""
    record = context.state.noisy_measurement
    if record is not None:
        with context.because_of(record.cause):
            _go_on(context, record, event)


def _go_on(context: StepContext, record: MeasurementRecord, event: Event) -> None:
    """Start its dither, note that it plays, or that it is over."""
    rtc = context.rtc
    waited_s = (context.now_ns - (record.asked_ns_utc or 0)) / SECOND_NS
    match record.state:
        case MeasureState.WAITING if isinstance(event, cmd.StopDither):
            fail_noisy_measurement(context, "the operator stopped the dither")
        case MeasureState.WAITING:
            if rtc is not None and rtc.loop != "open" and rtc.dither_id is None:
                _begin_noisy(context, record, rtc)
            elif waited_s > DITHER_END_TIMEOUT_S:
                fail_noisy_measurement(
                    context, f"the dither that ran did not end within {DITHER_END_TIMEOUT_S:.0f} s"
                )
        case MeasureState.ASKED | MeasureState.RUNNING:
            _follow_playing(context, record, event)
        case _:
            # a simulated RTC may be ten times slower than its timestamps
            if waited_s >= 10.0 * (
                (record.duration_s or 0.0) + DITHER_END_TIMEOUT_S + FIT_TIMEOUT_S
            ):
                fail_noisy_measurement(context, "the worker did not answer")


def fail_noisy_measurement(context: StepContext, why: str) -> None:
    """End the one under way, if there is one, without a matrix."""
    record = context.state.noisy_measurement
    if record is not None:
        fail_measurement(context, record, why)


def _begin_noisy(context: StepContext, record: MeasurementRecord, rtc: Status) -> None:
    try:
        dither = plan_random(
            rtc,
            context.policy,
            context.now_ns,
            dither_id=record.id,
            modes=record.modes,
            total_m=record.total_m,
            duration_s=record.duration_s or DEFAULT_DURATION_S,
        )
    except CommandError as error:  # the RTC is another than when it was asked for
        fail_measurement(context, record, str(error))
        return
    window_s, seed = dither.window_s, dither.request.seed
    store_measurement(
        context, replace(record, state=MeasureState.ASKED, window_s=window_s, seed=seed)
    )
    request_dither(context, dither)


def _follow_playing(context: StepContext, record: MeasurementRecord, event: Event) -> None:
    match event:
        case ev.Answered(
            request=DitherRequest(id=record.id), reply=Reply(accepted=False, reason=reason)
        ):
            fail_measurement(context, record, f"the RTC refused the dither: {reason}")
            return
        case ev.JobFailed(effect=ev.Ask(request=DitherRequest(id=record.id)), text=text):
            fail_measurement(context, record, text)
            return
        case _:
            pass
    dither, asked = context.dither, record.state is MeasureState.ASKED
    if dither is not None and dither.id == record.id:
        if asked and dither.start_seq is not None:
            store_measurement(context, replace(record, state=MeasureState.RUNNING))
    elif asked:
        fail_measurement(context, record, "its dither never began")
    else:
        record = replace(record, state=MeasureState.FINISHING)
        store_measurement(context, record)
        context.ask(ev.FinishNoisy(record=record))
