"""Interaction matrices that are measured: by the RTC alone, or on sky by a random dither.

Of a noisy one the sums are kept where the telemetry comes in; here is only how far each is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.errors import CommandError, UnknownIdError
from service.tracking import events as ev
from service.tracking.alarms import logged
from service.tracking.dither_plan import RANDOM_TOTAL_M, RandomChoice, plan_random, total_m
from service.tracking.events import Event, Step
from service.tracking.loop import DitherView, RtcView
from service.tracking.loop_commands import close_again
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.products import (
    MeasurementRecord,
    MeasurePattern,
    MeasureState,
    NoisyRecord,
    NoisyState,
)
from service.tracking.state import Level, TrackerState

NOISY_KEPT = 100

DURATION_S = 30.0
"""Where none is asked for: an element is worth its noise by then, on a bright star."""

FREE_WITHIN_S = 15.0
"""For the service's own dither to be gone from the RTC's status."""

MADE_WITHIN_S = 120.0
"""For the fit and the archive."""


def on_noisy(state: TrackerState, event: Event, policy: Policy, now_ns: int) -> Step:
    """Ask for a noisy interaction matrix, give one up, or note what came of it.

    Raises
    ------
    CommandError
        If none can be measured now, or the one to be given up is over.
    UnknownIdError
        If nobody has heard of the one to be given up.
    """
    match event:
        case ev.MeasureNoisy():
            return _ask_noisy(state, event, policy, now_ns)
        case ev.GiveUpNoisy(id=noisy_id):
            return _give_up_noisy(state, noisy_id, now_ns)
        case ev.NoisyMade(record=record):
            return _made(state, record, now_ns), ()
        case ev.JobFailed(effect=ev.FinishNoisy(record=record), text=text):
            return _noisy_failed(state, record, text, now_ns), ()
        case _:
            raise TypeError(f"no event of a noisy matrix: {event!r}")


def gather(state: TrackerState, event: Event, policy: Policy, now_ns: int) -> Step:
    """Go on with the one under way: start its dither, note that it plays, or that it is over."""
    record = state.gathering
    if record is None:
        return state, ()
    match record.state:
        case NoisyState.WAITING if isinstance(event, ev.StopDither):
            return cut_off(state, "the operator stopped the dither", now_ns), ()
        case NoisyState.WAITING:
            return _waiting(state, record, policy, now_ns)
        case NoisyState.ASKED | NoisyState.RUNNING:
            return _playing(state, record, event, now_ns)
        case _:
            return _overdue(state, record, now_ns), ()


def cut_off(state: TrackerState, why: str, now_ns: int) -> TrackerState:
    """Return the state without the one under way, which has lost its dither."""
    record = state.gathering
    return state if record is None else _noisy_failed(state, record, why, now_ns)


def awaits_its_dither(state: TrackerState) -> bool:
    """Return whether another dither has to end first: until then the service begins none."""
    record = state.gathering
    return record is not None and record.state is NoisyState.WAITING


def _ask_noisy(state: TrackerState, command: ev.MeasureNoisy, policy: Policy, now_ns: int) -> Step:
    rtc = _ready(state, command)
    duration_s, budget_m = command.duration_s or DURATION_S, policy.dither_budget_m
    total = command.total_m or min(RANDOM_TOTAL_M, budget_m)
    if total > budget_m * (1.0 + 1e-9) and not command.over_budget:
        raise CommandError(
            f"noisy matrix: {1e9 * total:.3g} nm RMS in all, budget {1e9 * budget_m:.3g} nm; say "
            "over_budget if that is meant"
        )
    asked = RandomChoice(id=command.id, modes=command.modes, total_m=total, duration_s=duration_s)
    dither = plan_random(asked, rtc, policy, now_ns)
    record = NoisyRecord(
        id=command.id,
        state=NoisyState.WAITING,
        modes=dither.modes,
        total_m=total_m(dither),
        duration_s=duration_s,
        window_s=dither.window_s or duration_s,
        seed=dither.seed or 0,
        asked_ns_utc=now_ns,
        basis_id=rtc.basis_id,
        config_id=rtc.config_id,
    )
    text = (
        f"{record.id}: {len(record.modes)} modes, {1e9 * record.total_m:.3g} nm RMS in all, "
        f"{duration_s:g} s"
    )
    state = logged(_with_noisy(state, record), "noisy-matrix.asked", text, now_ns)
    return _freed(state, record, rtc, policy, now_ns)


def _ready(state: TrackerState, command: ev.MeasureNoisy) -> RtcView:
    """Return the RTC, where it can play a dither now."""
    rtc = state.rtc
    if rtc is None or rtc.loop == "open":
        raise CommandError("noisy matrix: it needs an RTC with its loop closed")
    if state.noisy_matrix(command.id) is not None:
        text = f"{command.id} was measured before; ids are never reused"
        raise CommandError(f"noisy matrix: {text}")
    return rtc


def _freed(
    state: TrackerState, record: NoisyRecord, rtc: RtcView, policy: Policy, now_ns: int
) -> Step:
    """Stop the service's own dither, or, where none runs, begin."""
    own = state.dither
    if own is None and rtc.dither_id is None:
        return _begun(state, record, rtc, policy, now_ns)
    if own is not None:
        dithering = replace(state.dithering, stopped_id=own.id, ended_ns_utc=None)
        state = replace(state, dither=None, dithering=dithering)
    return state, (ev.AskNoDither(),)


def _waiting(state: TrackerState, record: NoisyRecord, policy: Policy, now_ns: int) -> Step:
    rtc = state.rtc
    if rtc is not None and rtc.loop != "open" and rtc.dither_id is None:
        return _begun(state, record, rtc, policy, now_ns)
    if now_ns - record.asked_ns_utc > FREE_WITHIN_S * SECOND_NS:
        text = f"the dither that ran did not end within {FREE_WITHIN_S:.0f} s"
        return _noisy_failed(state, record, text, now_ns), ()
    return state, ()


def _begun(
    state: TrackerState, record: NoisyRecord, rtc: RtcView, policy: Policy, now_ns: int
) -> Step:
    try:
        dither = plan_random(_asked(record), rtc, policy, now_ns)
    except CommandError as error:  # the RTC is another than when it was asked for
        return _noisy_failed(state, record, str(error), now_ns), ()
    record = replace(
        record,
        state=NoisyState.ASKED,
        window_s=dither.window_s or record.duration_s,
        seed=dither.seed or 0,
    )
    return replace(_with_noisy(state, record), dither=dither), (ev.AskDither(dither=dither),)


def _asked(record: NoisyRecord) -> RandomChoice:
    return RandomChoice(
        id=record.id, modes=record.modes, total_m=record.total_m, duration_s=record.duration_s
    )


def _playing(state: TrackerState, record: NoisyRecord, event: Event, now_ns: int) -> Step:
    match event:
        case ev.DitherAnswered(id=record.id, accepted=False, reason=reason):
            return _noisy_failed(state, record, f"the RTC refused the dither: {reason}", now_ns), ()
        case ev.JobFailed(effect=ev.AskDither(dither=DitherView(id=record.id)), text=text):
            return _noisy_failed(state, record, text, now_ns), ()
        case _:
            pass
    dither = state.dither
    if dither is None or dither.id != record.id:
        if record.state is NoisyState.ASKED:
            return _noisy_failed(state, record, "its dither never began", now_ns), ()
        record = replace(record, state=NoisyState.FINISHING)
        return _with_noisy(state, record), (ev.FinishNoisy(record=record),)
    if record.state is NoisyState.ASKED and dither.start_seq is not None:
        return _with_noisy(state, replace(record, state=NoisyState.RUNNING)), ()
    return state, ()


def _overdue(state: TrackerState, record: NoisyRecord, now_ns: int) -> TrackerState:
    longest_s = record.duration_s + FREE_WITHIN_S + MADE_WITHIN_S
    if now_ns - record.asked_ns_utc < 10.0 * longest_s * SECOND_NS:
        return state  # a simulated RTC may be ten times slower than its timestamps
    return _noisy_failed(state, record, "the worker did not answer", now_ns)


def _give_up_noisy(state: TrackerState, noisy_id: str, now_ns: int) -> Step:
    record = state.noisy_matrix(noisy_id)
    if record is None:
        raise UnknownIdError(f"noisy matrix {noisy_id}: nobody has heard of it")
    if not record.under_way:
        raise CommandError(f"{noisy_id} is {record.state}: there is nothing to give up")
    plays = state.dither is not None and state.dither.id == noisy_id
    record = replace(record, state=NoisyState.GIVEN_UP, reason="by the operator")
    state = logged(_with_noisy(state, record), "noisy-matrix.given-up", noisy_id, now_ns)
    if not plays:
        return state, ()
    return replace(state, dither=None), (ev.AskNoDither(),)


def _made(state: TrackerState, record: NoisyRecord, now_ns: int) -> TrackerState:
    known, found = state.noisy_matrix(record.id), record.finding
    if found is None or (known is not None and known.state is NoisyState.GIVEN_UP):
        return state
    text = f"{record.id}: {found.n_frames} frames, signal / noise of an element {found.snr:.2f}"
    return logged(_with_noisy(state, record), "noisy-matrix.stored", text, now_ns)


def _noisy_failed(state: TrackerState, record: NoisyRecord, text: str, now_ns: int) -> TrackerState:
    known = state.noisy_matrix(record.id)
    if known is not None and known.state is NoisyState.GIVEN_UP:
        return state
    state = _with_noisy(state, replace(record, state=NoisyState.FAILED, reason=text))
    return logged(state, "noisy-matrix.failed", f"{record.id}: {text}", now_ns, Level.WARNING)


def _with_noisy(state: TrackerState, record: NoisyRecord) -> TrackerState:
    others = tuple(r for r in state.noisy if r.id != record.id)
    return replace(state, noisy=(*others, record)[-NOISY_KEPT:])


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
            return _measurement_failed(state, current, "the RTC vanished", now_ns)
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
            return _ask_measurement(state, event, policy, now_ns)
        case ev.GiveUp(id=measurement_id):
            return _give_up_measurement(state, measurement_id, now_ns)
        case ev.MatrixMeasured(record=record):
            return _heard(state, record, now_ns), ()
        case ev.JobFailed(effect=ev.AskMeasurement(record=record), text=text):
            return _measurement_failed(state, record, text, now_ns), ()
        case _:
            raise TypeError(f"no event of a measurement: {event!r}")


def _ask_measurement(state: TrackerState, command: ev.Measure, policy: Policy, now_ns: int) -> Step:
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
    state = logged(_with_measurement(state, record), "measurement.asked", text, now_ns)
    return state, (ev.AskMeasurement(record=record),)


def _give_up_measurement(state: TrackerState, measurement_id: str, now_ns: int) -> Step:
    """Wait no longer; close the loop again if the measurement has opened it.

    The wire has no way to end a measurement: the RTC may go on, and until it is done refuse.
    """
    record = state.measurement(measurement_id)
    if record is None:
        raise UnknownIdError(f"measurement {measurement_id}: nobody has heard of it")
    if not record.under_way:
        raise CommandError(f"{measurement_id} is {record.state}: there is nothing to give up")
    text = "given up by the operator; the RTC may go on with it, what it sends is ignored"
    state = _with_measurement(state, replace(record, state=MeasureState.GIVEN_UP, reason=text))
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
        return _measurement_failed(state, record, record.reason, now_ns)
    text = {
        MeasureState.RUNNING: f"{record.id} starts at frame {record.start_seq}",
        MeasureState.REFUSED: f"{record.id}: the RTC refused: {record.reason}",
        MeasureState.STORED: f"{record.id}: {record.n_slopes} slopes, {len(record.modes)} modes",
    }.get(record.state, record.id)
    level = Level.WARNING if record.state is MeasureState.REFUSED else Level.INFO
    return logged(
        _with_measurement(state, record), f"measurement.{record.state}", text, now_ns, level
    )


def _watched(state: TrackerState, record: MeasurementRecord, now_ns: int) -> TrackerState:
    """Give up a matrix that does not come although everything looks as if it were over."""
    asked_ns, rtc = record.asked_ns_utc or now_ns, state.rtc
    if now_ns - asked_ns > LONGEST_S * SECOND_NS:
        return _measurement_failed(
            state, record, f"no matrix came within {LONGEST_S:.0f} s", now_ns
        )
    over = (
        record.opens_loop
        and rtc is not None
        and rtc.loop != "open"
        and record.start_seq is not None
    )
    if not over:
        return _with_measurement(state, replace(record, overdue_since_ns_utc=None))
    since_ns = record.overdue_since_ns_utc or now_ns
    if now_ns - since_ns > OVERDUE_S * SECOND_NS:
        text = f"the loop has been closed for {OVERDUE_S:.0f} s and no matrix came"
        return _measurement_failed(state, record, text, now_ns)
    return _with_measurement(state, replace(record, overdue_since_ns_utc=since_ns))


def _measurement_failed(
    state: TrackerState, record: MeasurementRecord, text: str, now_ns: int
) -> TrackerState:
    known = state.measurement(record.id)
    if known is not None and known.state is MeasureState.GIVEN_UP:
        return state
    state = _with_measurement(state, replace(record, state=MeasureState.FAILED, reason=text))
    return logged(state, "measurement.failed", f"{record.id}: {text}", now_ns, Level.WARNING)


def _with_measurement(state: TrackerState, record: MeasurementRecord) -> TrackerState:
    others = tuple(r for r in state.measurements if r.id != record.id)
    return replace(state, measurements=(*others, record)[-MEASUREMENTS_KEPT:])
