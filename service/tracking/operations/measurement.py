"""Interaction matrices measured by the RTC, and noisy ones measured on sky by random signs.

The sums of a noisy one are kept where the telemetry comes in; here is only how far each is.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from service.errors import CommandError
from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import DitherPurpose, MeasurementRecord, MeasureState
from service.tracking.dither import request_dither, stop_running_dither
from service.tracking.dither_request import DEFAULT_RANDOM_RMS_M, check_modes, cost_of, plan_random
from service.tracking.operator import begin_closing
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext, present
from service.tracking.transitions import is_declared, move
from service.wire import DitherRequest, MatrixStrokes, MeasureRequest, Pattern, Reply, Status

MEASUREMENTS_KEPT = 300

PUSH_PULL_RMS_M = 20e-9
"""RMS of a push or pull, metres OPD: small enough for a pyramid, far above its noise."""

TONE_RMS_M = 5e-9
"""RMS of each mode of a sine, metres OPD, where the settings fix no amplitude of the dither."""

N_AVERAGE = 10
N_TONES = 40
"""Modes of a sine measurement that names none."""

TONE_BAND = (0.05, 0.45)
"""Range of the tones as a fraction of the frame rate: above the loop's bandwidth and below half the
rate."""

DEFAULT_TONES_DURATION_S = 10.0

MAX_MATRIX_DELAY_S = 15.0
"""Time for the matrix to arrive after the loop is closed again."""

MAX_MEASUREMENT_S = 3600.0
"""Longest measurement."""

MEASURING = "an interaction matrix is being measured: these frames are no ordinary telemetry"


DEFAULT_NOISY_DURATION_S = 30.0
"""On a bright star an element of a noisy matrix is then as large as its noise."""

DITHER_END_TIMEOUT_S = 15.0
"""Time for the service's own dither to vanish from the RTC's status."""

FIT_TIMEOUT_S = 120.0
"""Time for the fit and the archive."""


def measure(context: StepContext, command: cmd.Measure) -> None:
    """Request a measured interaction matrix.

    Raises
    ------
    CommandError
        If it names a mode that the basis does not have, or an id that was used before.
    """
    rtc = present(context.rtc)
    _require_new(context, command.id)
    record = _plan_measurement(context, command, rtc)
    check_modes(record.modes, rtc)
    store_measurement(context, record)
    context.log("measurement.asked", f"{record.id}: {record.pattern} of {len(record.modes)} modes")
    strokes = {field.name: getattr(record, field.name) for field in fields(MatrixStrokes)}
    request = MeasureRequest(pattern=command.pattern, n_average=record.n_average, **strokes)
    context.ask(ev.Ask(request=request))


def _require_new(context: StepContext, measurement_id: str) -> None:
    if context.state.measurement(measurement_id) is not None:
        raise CommandError(f"{measurement_id} was measured before; ids are never reused")


def give_up_on_command(context: StepContext, command: cmd.GiveUp) -> None:
    """Stop waiting for a matrix by order."""
    give_up(context, command.id)


def give_up(context: StepContext, measurement_id: str) -> None:
    """Wait no longer for a matrix; its random signs end, a loop that it has opened is closed again.

    The wire has no way to end a measurement by the RTC: it may go on, and until it is done refuse.
    """
    record = context.state.measurement(measurement_id)
    if record is None:
        return
    given_up = replace(record, state=MeasureState.GIVEN_UP)
    if record.pattern is None:
        store_measurement(context, replace(given_up, reason="given up by the operator"))
        context.log("noisy-matrix.given-up", record.id)
        if context.dither is not None and context.dither.id == record.id:
            stop_running_dither(context)
        return
    text = "given up by the operator; the RTC may go on with it, what it sends is ignored"
    store_measurement(context, replace(given_up, reason=text))
    context.log("measurement.given-up", f"{record.id}: {text}")
    if record.opens_loop and record.closed_before:
        begin_closing(context)
        return
    since_s = (context.now_ns - (record.asked_ns_utc or context.now_ns)) / SECOND_NS
    left_s = max((record.duration_s or 0.0) - since_s, 0.0)
    # the RTC has no hand free for a dither, nor can windows tell of α
    context.put_off(dither_s=left_s, make_s=left_s)


def on_vanished(context: StepContext, _: ev.RtcVanished) -> None:
    """Give up a matrix whose RTC has gone."""
    fail_measurement(context, context.state.measuring, "the RTC vanished")


def on_dither_stop(context: StepContext, _: cmd.StopDither) -> None:
    """Give up a noisy matrix that waits for another dither to end."""
    record = context.state.noisy_measurement
    if record is not None and record.state is MeasureState.WAITING:
        fail_measurement(context, record, "the operator stopped the dither")


def on_answer(context: StepContext, request: MeasureRequest, reply: Reply) -> None:
    """Note that the RTC has begun to measure, or why it would not."""
    record = context.state.measurement(request.id)
    if record is not None:
        state = MeasureState.RUNNING if reply.accepted else MeasureState.REFUSED
        answered = replace(record, state=state, reason=reply.reason, start_seq=reply.start_seq)
        _update(context, answered)


def on_measured(context: StepContext, event: ev.MatrixMeasured) -> None:
    """Store the progress of a measurement."""
    before = context.state.measurement(event.record.id)
    with context.because_of("" if before is None else before.cause):
        _update(context, event.record)


def _update(context: StepContext, record: MeasurementRecord) -> None:
    """Take over how far a measurement is; one that is over does not begin again."""
    before = context.state.measurement(record.id)
    if before is not None:
        if not is_declared(before.state, record.state):
            return
        # The manifest of a matrix does not repeat what the service has asked for.
        record = replace(
            record,
            frequency_hz=before.frequency_hz,
            duration_s=before.duration_s,
            asked_ns_utc=before.asked_ns_utc,
            closed_before=before.closed_before,
            cause=before.cause,
            start_seq=before.start_seq if record.start_seq is None else record.start_seq,
        )
    if record.state is MeasureState.FAILED:
        fail_measurement(context, record, record.reason)
        return
    store_measurement(context, record)
    name, found = f"{_kind(record)}.{record.state}", record.finding
    match record.state:
        case MeasureState.RUNNING:
            context.log(name, f"{record.id} starts at frame {record.start_seq}")
        case MeasureState.REFUSED:
            context.warn(name, f"{record.id}: the RTC refused: {record.reason}")
        case MeasureState.STORED if found is not None:
            text = f"{found.n_frames} frames, signal / noise of an element {found.snr:.2f}"
            context.log(name, f"{record.id}: {text}")
        case MeasureState.STORED:
            n_slopes, n_modes = record.n_slopes, len(record.modes)
            context.log(name, f"{record.id}: {n_slopes} slopes, {n_modes} modes")
        case _:
            context.log(name, record.id)


def on_dither_answer(context: StepContext, request: DitherRequest, reply: Reply) -> None:
    """Give up a noisy matrix whose dither the RTC refuses."""
    if not reply.accepted:
        on_dither_failed(context, request, f"the RTC refused the dither: {reply.reason}")


def on_too_strong(context: StepContext, event: ev.DitherMeasured) -> None:
    """Give up a noisy matrix whose dither was too strong."""
    if event.text and event.id == context.dither_policy.loud_id:
        fail_noisy_measurement(context, f"its dither was too strong: {event.text}")


def on_dither_failed(context: StepContext, request: DitherRequest, text: str) -> None:
    """Give up a noisy matrix whose dither does not begin."""
    record = context.state.noisy_measurement
    if record is not None and record.id == request.id:
        fail_measurement(context, record, text)


def on_failure(context: StepContext, request: MeasureRequest, text: str) -> None:
    """Give up a matrix whose request did not reach the RTC."""
    fail_measurement(context, context.state.measurement(request.id), text)


def on_finish_failed(context: StepContext, effect: ev.FinishNoisy, text: str) -> None:
    """Give up a noisy matrix that could not be fitted."""
    fail_measurement(context, effect.record, text)


def fail_measurement(context: StepContext, record: MeasurementRecord | None, text: str) -> None:
    """Record why there is no matrix, unless the measurement was already ended."""
    before = None if record is None else context.state.measurement(record.id)
    if record is not None and (before is None or is_declared(before.state, MeasureState.FAILED)):
        store_measurement(context, replace(record, state=MeasureState.FAILED, reason=text))
        with context.because_of(record.cause):
            context.warn(f"{_kind(record)}.failed", f"{record.id}: {text}")


def _kind(record: MeasurementRecord) -> str:
    """Return the first word of its lines in the log."""
    return "noisy-matrix" if record.pattern is None else "measurement"


def give_up_overdue(context: StepContext) -> None:
    """Give up a matrix that does not arrive although the RTC seems done."""
    record, rtc = context.state.measuring, context.rtc
    if record is None:
        return
    closed = rtc is not None and rtc.loop != "open"
    asked_ns = record.asked_ns_utc or context.now_ns
    if context.now_ns - asked_ns > MAX_MEASUREMENT_S * SECOND_NS:
        fail_measurement(context, record, f"no matrix came within {MAX_MEASUREMENT_S:.0f} s")
    elif not (record.opens_loop and closed and record.start_seq is not None):
        store_measurement(context, replace(record, overdue_since_ns_utc=None))
    else:
        since_ns = record.overdue_since_ns_utc or context.now_ns
        if context.now_ns - since_ns > MAX_MATRIX_DELAY_S * SECOND_NS:
            text = f"the loop has been closed for {MAX_MATRIX_DELAY_S:.0f} s and no matrix came"
            fail_measurement(context, record, text)
        else:
            store_measurement(context, replace(record, overdue_since_ns_utc=since_ns))


def _plan_measurement(context: StepContext, command: cmd.Measure, rtc: Status) -> MeasurementRecord:
    sine = command.pattern is Pattern.SINE
    modes = command.modes or tuple(range(rtc.n_controlled))
    if sine and command.modes is None:
        # Every so many modes, rounded up: the tones span the basis, and are never too many.
        modes = modes[:: -(-len(modes) // N_TONES)]
    tone_m = context.policy.dither_amplitude_m or TONE_RMS_M
    stroke_m = command.amplitude_m or (tone_m if sine else PUSH_PULL_RMS_M)
    duration_s = (command.duration_s or DEFAULT_TONES_DURATION_S) if sine else None
    lines = command.frequency_hz
    if duration_s is not None and lines is None:
        # Whole periods in the duration, so that the lines do not leak into one another.
        band_hz = np.linspace(*TONE_BAND, len(modes)) * rtc.frame_rate_hz
        lines = tuple((np.round(band_hz * duration_s) / duration_s).tolist())
    return MeasurementRecord(
        id=command.id,
        state=MeasureState.ASKED,
        pattern=command.pattern,
        modes=modes,
        amplitude_m=(stroke_m,) * len(modes),
        n_average=None if sine else command.n_average or N_AVERAGE,
        frequency_hz=lines,
        duration_s=duration_s,
        asked_ns_utc=context.now_ns,
        closed_before=rtc.loop != "open",
        cause=context.cause,
    )


def store_measurement(context: StepContext, record: MeasurementRecord) -> None:
    """Keep what is known of a measurement in place of what was known before."""
    record = move(context, context.state.measurement(record.id), record)
    others = tuple(r for r in context.operations.measurements if r.id != record.id)
    context.operations = replace(
        context.operations, measurements=(*others, record)[-MEASUREMENTS_KEPT:]
    )


def measure_noisy(context: StepContext, command: cmd.MeasureNoisy) -> None:
    """Measure a noisy interaction matrix after the running dither.

    Raises
    ------
    CommandError
        If it costs more than the budget, or names an id that was used before.
    """
    rtc = present(context.rtc)
    _require_new(context, command.id)
    duration_s = command.duration_s or DEFAULT_NOISY_DURATION_S
    total = command.total_amplitude_m or min(DEFAULT_RANDOM_RMS_M, context.policy.dither_budget_m)
    cost_of(total, context.policy, over_budget=command.over_budget)
    dither = plan_random(
        rtc,
        context.policy,
        context.now_ns,
        purpose=DitherPurpose.NOISY,
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


def advance_noisy(context: StepContext) -> None:
    """Take a noisy interaction matrix further, if one is being measured."""
    record = context.state.noisy_measurement
    if record is not None:
        with context.because_of(record.cause):
            _go_on(context, record)


def _go_on(context: StepContext, record: MeasurementRecord) -> None:
    """Start its dither, note that it plays, or that it is over."""
    rtc = context.rtc
    waited_s = (context.now_ns - (record.asked_ns_utc or 0)) / SECOND_NS
    match record.state:
        case MeasureState.WAITING:
            if rtc is not None and rtc.loop != "open" and rtc.dither_id is None:
                _begin_noisy(context, record, rtc)
            elif waited_s > DITHER_END_TIMEOUT_S:
                fail_noisy_measurement(
                    context, f"the dither that ran did not end within {DITHER_END_TIMEOUT_S:.0f} s"
                )
        case MeasureState.ASKED | MeasureState.RUNNING:
            _follow_playing(context, record)
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
            purpose=DitherPurpose.NOISY,
            dither_id=record.id,
            modes=record.modes,
            total_m=record.total_m,
            duration_s=record.duration_s or DEFAULT_NOISY_DURATION_S,
        )
    except CommandError as error:  # the RTC is another than when it was asked for
        fail_measurement(context, record, str(error))
        return
    window_s, seed = dither.window_s, dither.request.seed
    store_measurement(
        context, replace(record, state=MeasureState.ASKED, window_s=window_s, seed=seed)
    )
    request_dither(context, dither)


def _follow_playing(context: StepContext, record: MeasurementRecord) -> None:
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
