"""Interaction matrices the RTC measures: asked for by an operator, waited for, kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service import events as ev
from service.errors import CommandError, UnknownIdError
from service.events import Event
from service.reactions.journal import logged
from service.reactions.loop import close_again
from service.reactions.matrices import Step
from service.reactions.policy import SECOND_NS, Policy
from service.state import (
    Level,
    MeasurementRecord,
    MeasurePattern,
    MeasureState,
    RtcView,
    TrackerState,
)

MEASUREMENTS_KEPT = 200

STROKE_M = 20e-9
"""RMS of a push or pull, metres OPD: small enough for a pyramid, far above its noise."""

TONE_M = 5e-9
"""RMS of each mode of a sine, metres OPD, where the settings fix no amplitude of the dither."""

N_AVERAGE = 10
N_TONES = 40
"""Modes of a sine measurement that names none."""

TONE_BAND = (0.05, 0.45)
"""Of the frame rate: above the loop's bandwidth and below half the rate."""

TONES_LAST_S = 10.0

OVERDUE_S = 15.0
"""For the matrix to come once the loop is closed again."""

LONGEST_S = 3600.0
"""Of any measurement."""

MEASURING = "an interaction matrix is being measured: these frames are no ordinary telemetry"

_OVER = (
    MeasureState.REFUSED,
    MeasureState.FAILED,
    MeasureState.STORED,
    MeasureState.GIVEN_UP,
)


def meanwhile(state: TrackerState, event: Event, now_ns: int) -> TrackerState:
    """Return the state as a measurement under way sees this event, before anybody else does."""
    current = state.measuring
    if current is None:
        return state
    match event:
        case ev.RtcVanished():
            return _failed(state, current, "the RTC vanished", now_ns)
        case ev.Tick():
            return _watched(state, current, now_ns)
        case _:
            return state


def on_measurement(state: TrackerState, event: Event, policy: Policy, now_ns: int) -> Step:
    """Ask for a matrix, note how far one is, or wait for it no longer.

    Raises
    ------
    CommandError
        If none can be measured now, or the one to be given up is over.
    UnknownIdError
        If nobody has heard of the one to be given up.
    """
    match event:
        case ev.Measure():
            return _ask(state, event, policy, now_ns)
        case ev.GiveUp(id=measurement_id):
            return _give_up(state, measurement_id, now_ns)
        case ev.MatrixMeasured(record=record):
            return _heard(state, record, now_ns), ()
        case ev.JobFailed(effect=ev.AskMeasurement(record=record), text=text):
            return _failed(state, record, text, now_ns), ()
        case _:
            raise TypeError(f"no event of a measurement: {event!r}")


def _ask(state: TrackerState, command: ev.Measure, policy: Policy, now_ns: int) -> Step:
    rtc = state.rtc
    if rtc is None:
        raise CommandError("measure: no RTC is there")
    if state.measurement(command.id) is not None:
        raise CommandError(f"measure: {command.id} was measured before; ids are never reused")
    record = _planned(command, rtc, policy, now_ns)
    if max(record.modes) >= rtc.n_modes:
        raise CommandError(
            f"measure: found mode {max(record.modes)}; expected 0 to {rtc.n_modes - 1}"
        )
    text = f"{record.id}: {record.pattern} of {len(record.modes)} modes"
    state = logged(_with(state, record), "measurement.asked", text, now_ns)
    return state, (ev.AskMeasurement(record=record),)


def _give_up(state: TrackerState, measurement_id: str, now_ns: int) -> Step:
    """Wait no longer; close the loop again if the measurement has opened it.

    The wire has no way to end a measurement: the RTC may go on, and until it is done refuse.
    """
    record = state.measurement(measurement_id)
    if record is None:
        raise UnknownIdError(f"measurement {measurement_id}: nobody has heard of it")
    if not record.under_way:
        raise CommandError(f"{measurement_id} is {record.state}: there is nothing to give up")
    text = "given up by the operator; the RTC may go on with it, what it sends is ignored"
    state = _with(state, replace(record, state=MeasureState.GIVEN_UP, reason=text))
    state = logged(state, "measurement.given-up", f"{measurement_id}: {text}", now_ns)
    if record.opens_loop and record.closed_before:
        return close_again(replace(state, close_since_ns_utc=now_ns), now_ns)
    lasts_ns = round((record.duration_s or 0.0) * SECOND_NS)
    until_ns = (record.asked_ns_utc or now_ns) + lasts_ns
    # the RTC has no hand free for a dither, nor can windows tell of α
    retries = state.retries.later(dither_ns_utc=until_ns, make_ns_utc=until_ns)
    return replace(state, retries=retries), ()


def _planned(command: ev.Measure, rtc: RtcView, policy: Policy, now_ns: int) -> MeasurementRecord:
    sine = command.pattern is MeasurePattern.SINE
    modes = command.modes or tuple(range(rtc.n_controlled))
    if sine and command.modes is None:
        modes = modes[:: -(-len(modes) // N_TONES)]
    tone_m = policy.dither_amplitude_m or TONE_M
    stroke_m = command.amplitude_m or (tone_m if sine else STROKE_M)
    duration_s = (command.duration_s or TONES_LAST_S) if sine else None
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


def _heard(state: TrackerState, record: MeasurementRecord, now_ns: int) -> TrackerState:
    """Take over how far a measurement is; one that is over does not begin again."""
    known = state.measurement(record.id)
    if known is not None:
        given_up = known.state is MeasureState.GIVEN_UP
        if given_up or (known.state in _OVER and record.state not in _OVER):
            return state
        record = replace(
            record,
            frequency_hz=known.frequency_hz,
            duration_s=known.duration_s,
            asked_ns_utc=known.asked_ns_utc,
            closed_before=known.closed_before,
            start_seq=known.start_seq if record.start_seq is None else record.start_seq,
        )
    if record.state is MeasureState.FAILED:
        return _failed(state, record, record.reason, now_ns)
    text = {
        MeasureState.RUNNING: f"{record.id} starts at frame {record.start_seq}",
        MeasureState.REFUSED: f"{record.id}: the RTC refused: {record.reason}",
        MeasureState.STORED: f"{record.id}: {record.n_slopes} slopes, {len(record.modes)} modes",
    }.get(record.state, record.id)
    level = Level.WARNING if record.state is MeasureState.REFUSED else Level.INFO
    return logged(_with(state, record), f"measurement.{record.state}", text, now_ns, level)


def _watched(state: TrackerState, record: MeasurementRecord, now_ns: int) -> TrackerState:
    """Give up a matrix that does not come although everything looks as if it were over."""
    asked_ns, rtc = record.asked_ns_utc or now_ns, state.rtc
    if now_ns - asked_ns > LONGEST_S * SECOND_NS:
        return _failed(state, record, f"no matrix came within {LONGEST_S:.0f} s", now_ns)
    over = (
        record.opens_loop
        and rtc is not None
        and rtc.loop != "open"
        and record.start_seq is not None
    )
    if not over:
        return _with(state, replace(record, overdue_since_ns_utc=None))
    since_ns = record.overdue_since_ns_utc or now_ns
    if now_ns - since_ns > OVERDUE_S * SECOND_NS:
        text = f"the loop has been closed for {OVERDUE_S:.0f} s and no matrix came"
        return _failed(state, record, text, now_ns)
    return _with(state, replace(record, overdue_since_ns_utc=since_ns))


def _failed(state: TrackerState, record: MeasurementRecord, text: str, now_ns: int) -> TrackerState:
    known = state.measurement(record.id)
    if known is not None and known.state is MeasureState.GIVEN_UP:
        return state
    state = _with(state, replace(record, state=MeasureState.FAILED, reason=text))
    return logged(state, "measurement.failed", f"{record.id}: {text}", now_ns, Level.WARNING)


def _with(state: TrackerState, record: MeasurementRecord) -> TrackerState:
    others = tuple(r for r in state.measurements if r.id != record.id)
    return replace(state, measurements=(*others, record)[-MEASUREMENTS_KEPT:])
