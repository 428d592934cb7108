"""Measurements of interaction matrices by the RTC."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from service.errors import CommandError
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.dither import stop_running_dither
from service.tracking.dither_request import check_modes
from service.tracking.events import Event
from service.tracking.operation_records import MeasurementRecord, MeasureState
from service.tracking.operator import begin_closing
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.step_context import StepContext, present
from service.wire import MatrixStrokes, MeasureRequest, Pattern, Reply, Status

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


def measure(context: StepContext, command: cmd.Measure) -> None:
    """Request a measured interaction matrix.

    Raises
    ------
    CommandError
        If it names a mode that the basis does not have, or an id that was used before.
    """
    rtc = present(context.rtc)
    if context.state.measurement(command.id) is not None:
        raise CommandError(f"{command.id} was measured before; ids are never reused")
    record = replace(
        _plan_measurement(command, rtc, context.policy, context.now_ns), cause=context.cause
    )
    check_modes(record.modes, rtc)
    store_measurement(context, record)
    context.log("measurement.asked", f"{record.id}: {record.pattern} of {len(record.modes)} modes")
    strokes = {field.name: getattr(record, field.name) for field in fields(MatrixStrokes)}
    context.ask(
        ev.Ask(
            request=MeasureRequest(pattern=command.pattern, n_average=record.n_average, **strokes)
        )
    )


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
        store_measurement(context, replace(given_up, reason="by the operator"))
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


def give_up_lost(context: StepContext, event: Event) -> None:
    """Give up a matrix that cannot come any more, before anybody else sees the event."""
    record, rtc = context.state.measuring, context.rtc
    if record is None:
        return
    if isinstance(event, ev.RtcVanished):
        fail_measurement(context, record, "the RTC vanished")
    elif isinstance(event, ev.Tick):
        closed = rtc is not None and rtc.loop != "open"
        _give_up_overdue(context, record, closed=closed)


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
        given_up = before.state is MeasureState.GIVEN_UP
        if given_up or (record.under_way and not before.under_way):
            return
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


def fail_measurement(context: StepContext, record: MeasurementRecord | None, text: str) -> None:
    """Record why there is no matrix, unless the measurement was already ended."""
    before = None if record is None else context.state.measurement(record.id)
    if record is not None and (before is None or before.state is not MeasureState.GIVEN_UP):
        store_measurement(context, replace(record, state=MeasureState.FAILED, reason=text))
        with context.because_of(record.cause):
            context.warn(f"{_kind(record)}.failed", f"{record.id}: {text}")


def _kind(record: MeasurementRecord) -> str:
    """Return the first word of its lines in the log."""
    return "noisy-matrix" if record.pattern is None else "measurement"


def _give_up_overdue(context: StepContext, record: MeasurementRecord, *, closed: bool) -> None:
    """Give up a matrix that does not arrive although the RTC seems done."""
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


def _plan_measurement(
    command: cmd.Measure, rtc: Status, policy: Policy, now_ns: int
) -> MeasurementRecord:
    sine = command.pattern is Pattern.SINE
    modes = command.modes or tuple(range(rtc.n_controlled))
    if sine and command.modes is None:
        modes = modes[:: -(-len(modes) // N_TONES)]
    tone_m = policy.dither_amplitude_m or TONE_RMS_M
    stroke_m = command.amplitude_m or (tone_m if sine else PUSH_PULL_RMS_M)
    duration_s = (command.duration_s or DEFAULT_TONES_DURATION_S) if sine else None
    lines = command.frequency_hz
    if duration_s is not None and lines is None:
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
        asked_ns_utc=now_ns,
        closed_before=rtc.loop != "open",
    )


def store_measurement(context: StepContext, record: MeasurementRecord) -> None:
    """Keep what is known of a measurement in place of what was known before."""
    others = tuple(r for r in context.operations.measurements if r.id != record.id)
    context.operations = replace(
        context.operations, measurements=(*others, record)[-MEASUREMENTS_KEPT:]
    )
