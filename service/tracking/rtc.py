"""React to the RTC: status, session, silence, failures."""

from __future__ import annotations

from dataclasses import replace

from service.estimation.loop import loop_numbers, same_loop, same_numbers
from service.records import alarms
from service.records import events as ev
from service.records.events import Effect
from service.records.products import MatrixState
from service.records.registration import Source
from service.records.state import ModelState
from service.tracking import (
    dither,
    mode_proof,
    pointing_law,
    reconstructors,
    references,
    update_policy,
    validity,
)
from service.tracking.operator import end_ramp
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext, log_bursts
from service.wire import Command as Request
from service.wire import LoopRequest, Reply, Status

ACKNOWLEDGEMENT_TIMEOUT_S = 3.0
"""An RTC applies within 2 s of the commit, or it has failed."""

_SAME_LINE_HZ = 2.5

COMPUTATION_TIMEOUT_S = 60.0
"""A reconstructor that takes longer was lost with its worker."""


def give_up_overdue(context: StepContext) -> None:
    """Give up what has been waited for too long."""
    for record in context.matrices.reconstructors:
        # Without a time of publication nothing is overdue.
        sent_ns = record.published_ns_utc or context.now_ns
        if record.on_its_way and context.now_ns - sent_ns > ACKNOWLEDGEMENT_TIMEOUT_S * SECOND_NS:
            text = (
                f"{record.id} was not applied within {ACKNOWLEDGEMENT_TIMEOUT_S:.0f} s; the RTC "
                "keeps the old one: see the RTC's log, then publish again"
            )
            reconstructors.change_state(context, record.id, MatrixState.FAILED, text)
            with context.because_of(record.cause):
                context.raise_alarm(alarms.NOT_ACKNOWLEDGED, text)
    since_ns = context.matrices.making_since_ns_utc
    if since_ns is not None and context.now_ns - since_ns > COMPUTATION_TIMEOUT_S * SECOND_NS:
        reconstructors.note_none_made(context)
        text = f"no reconstructor came within {COMPUTATION_TIMEOUT_S:.0f} s"
        context.warn("reconstructor.lost", text)
    log_bursts(context)


def on_status(context: StepContext, rtc: Status) -> None:
    """Take over the RTC's report and what follows from it.

    That is a new sensor mode, basis or set of references, the matrix that it names as applied, and
    the dither that it shows.
    """
    # First, because all below takes α to be in the subapertures of the present mode.
    if rtc.config_id != context.loop.config_id and rtc.config_id in context.policy.sensor_modes:
        _enter_sensor_mode(context, rtc.config_id)
    before, registration = context.rtc, context.registration
    if before is not None and not same_loop(before, rtc):
        # the margin is not what it was
        reconstructors.forget_when_judged(context)
    bias = None if registration is None else registration.bias
    elsewhere = bias is not None and not same_numbers(bias.loop, loop_numbers(rtc))
    if registration is not None and bias is not None and bias.looked_ns_utc and elsewhere:
        # it was learnt in another loop, in whichever session
        validity.store_registration(context, replace(registration, bias=None))
    pending = context.loop.commanded_modes
    context.loop = replace(
        context.loop,
        rtc=rtc,
        commanded_modes=None if pending == rtc.n_controlled else pending,
        # Pinned by the instrument file or the first status: a later one does not replace them.
        basis_id=context.loop.basis_id or rtc.basis_id,
        config_id=context.loop.config_id or rtc.config_id,
    )
    _note_references(context, rtc)
    references.follow_status(context, rtc, returned=before is None)
    _note_renaming(context, before, rtc)
    validity.note_pointing(context, rtc.pointing)
    _drop_other_basis(context)
    mode_proof.believe_restored(context, rtc)
    _log_partial_loop(context, before, rtc)
    if rtc.cm_id is not None:
        reconstructors.apply_named(context, rtc.cm_id)
    dither.follow_status(context, rtc)


def on_vibrations(context: StepContext, event: ev.Vibrations) -> None:
    """Store vibrations, which the next dither avoids."""
    before, lines = context.loop.vibrations_hz, event.lines_hz
    context.loop = replace(context.loop, vibrations_hz=lines)
    # a line between two bins of the spectrum shows now in one, now in the other
    if not all(any(abs(line - known) < _SAME_LINE_HZ for known in before) for line in lines):
        context.log("vibrations", f"vibrations at {', '.join(f'{f:.0f}' for f in lines)} Hz")


def on_loop_held(context: StepContext, event: ev.LoopHeld) -> None:
    """Store whether the loop is stable."""
    context.loop = replace(context.loop, holds=event.holds)


def on_modes_commanded(context: StepContext, event: ev.ModesCommanded) -> None:
    """Store the number of modes until a status shows it: the status lags behind the answer."""
    context.loop = replace(context.loop, commanded_modes=event.n_modes)


def on_loop_answer(context: StepContext, request: LoopRequest, reply: Reply) -> None:
    """Store the number of modes that an order has set."""
    if reply.accepted and request.n_controlled is not None:
        context.loop = replace(context.loop, commanded_modes=request.n_controlled)


def on_modes_unknown(context: StepContext, _: Effect | Request, __: str) -> None:
    """Take the number of modes from the next status: the RTC may have accepted what failed."""
    context.loop = replace(context.loop, commanded_modes=None)


def on_model_changed(context: StepContext, event: ev.ModelChanged) -> None:
    """Store what a job of the worker has made of the model."""
    # The job may have begun before the sensor's mode changed: its results belong to that mode.
    if event.model.sensor_mode == context.model.sensor_mode:
        context.model = event.model


def _log_partial_loop(context: StepContext, before: Status | None, rtc: Status) -> None:
    """Say how many modes are in the loop where it is not all that are controlled."""
    n_before = rtc.n_controlled if before is None else len(before.in_loop)
    n_now = len(rtc.in_loop)
    if rtc.loop != "open" and n_now not in {n_before, rtc.n_controlled}:
        text = f"{n_now} of {rtc.n_controlled} controlled modes have a gain: the others are let be"
        context.log("loop.partial", text)


def _note_references(context: StepContext, rtc: Status) -> None:
    """Record new reference slopes; they end windows under way, and α and matrices stay."""
    before, name = context.loop.reference_id, rtc.reference_name
    if name == before:
        return
    context.loop = replace(context.loop, reference_id=name)
    if before is not None:
        context.loop = replace(context.loop, reference_since_ns_utc=context.now_ns)
        before, name = before.removesuffix("~"), name.removesuffix("~")
        # The name of a ramp and that of its end are one change.
        if name != before:
            text = f"the RTC subtracts the reference slopes {name}, they were {before}"
            context.log("references.changed", text)


def _note_renaming(context: StepContext, before: Status | None, rtc: Status) -> None:
    """Let matrix and response show that a sensor is the same under another ``config_id``.

    The link refuses one that the instrument file fixes, and one that comes with other sizes.
    """
    known = context.loop.config_id if before is None else before.config_id
    if rtc.config_id == known:
        _prove_sensor(context, rtc)
        return
    context.loop = replace(context.loop, renamed_ns_utc=rtc.t_ns)
    reconstructors.verify_again(context)
    validity.request_window(context, "the RTC has another config_id")
    text = (
        f"the RTC's config_id has changed from {known} to {rtc.config_id} with the same number of "
        "slopes and modes: R-31 allows that for another mask, slope recipe, binning or modulation "
        "only. It is taken for new reference slopes: have the RTC name them by reference_id"
    )
    context.raise_alarm(alarms.RENAMED, context.alarm_text(alarms.RENAMED) or text)


def _prove_sensor(context: StepContext, rtc: Status) -> None:
    """Take a renamed sensor for the same once matrix and response have shown it."""
    renamed_ns = context.loop.renamed_ns_utc
    windows = (
        entry.t_ns_utc
        for entry in reversed(context.alpha.history)
        if entry.entered and entry.source is not Source.PASSIVE
    )
    # A window that ended later began later, too: it is cut where the name changes.
    if renamed_ns is None or next(windows, 0) <= renamed_ns:
        return
    contradicted = {alarms.WRONG_MATRIX, alarms.WRONG_ANSWER} & {
        alarm.name for alarm in context.alarms.active
    }
    if reconstructors.explain_unread_matrix(context.state, rtc.cm_id) or contradicted:
        return
    context.loop = replace(context.loop, renamed_ns_utc=None)
    context.log("sensor.same", f"matrix and response are the model's with {rtc.config_id}, too")


def _drop_other_basis(context: StepContext) -> None:
    """Drop an α that was restored from a night with another basis or configuration."""
    registration, loop = context.registration, context.loop
    if registration is None or registration.basis_id is None or registration.config_id is None:
        return
    if (registration.basis_id, registration.config_id) != (loop.basis_id, loop.config_id):
        validity.forget_registration(context)
        text = (
            f"α was measured with {registration.basis_id}, {registration.config_id}; the RTC has "
            f"{loop.basis_id}, {loop.config_id}"
        )
        context.log("registration.void", text)


def _enter_sensor_mode(context: StepContext, config_id: str) -> None:
    """Keep α in the subapertures of the sensor's new mode; matrices and gains were of the old."""
    before = context.loop.config_id
    _begin_anew(context, "the sensor was in another mode")
    reconstructors.discard_proposals(context, f"the sensor's mode is {config_id} now")
    update_policy.forget_limit(context)
    # An RTC that does not name its references is named by its mode: that says nothing of them.
    context.loop = replace(context.loop, config_id=config_id, reference_id=None)
    # Order and signs of the slopes are those of every mode; all else is measured again.
    context.model = ModelState(sensor_mode=config_id, slopes=context.model.slopes)
    pointing_law.begin_law(context)
    kept, scale = "", context.policy.alpha_scale(before, config_id)
    if scale is not None and context.registration is not None:
        # α is kept, because the mirror has not moved; windows of this mode must confirm it.
        scaled = validity.in_subapertures(context.registration, scale, config_id)
        validity.store_registration(context, replace(scaled, n_windows=0))
        validity.age_registration(context)
        kept = f"; α is kept, {scaled.alpha} in its subapertures"
    context.log("sensor.mode", f"the sensor's mode is {config_id}, it was {before}{kept}")


def on_new_session(context: StepContext, started: ev.SessionStarted) -> None:
    """Void the old session; α stays, to be confirmed."""
    _begin_anew(context, "the RTC was in another session")
    context.log("rtc.session", f"the RTC started session {started.session}")


def _begin_anew(context: StepContext, because: str) -> None:
    """Void what belonged to the loop until now."""
    reconstructors.forget_session(context)
    references.forget_session(context)
    mode_proof.forget_session(context)
    validity.invalidate_telemetry(context, because)
    dither.forget_dither(context)
    end_ramp(context)
    # α belongs to the telescope and is kept, but windows must confirm it.
    validity.require_new_windows(context)
    context.retry_all()
    context.loop = replace(context.loop, rtc=None, holds=False, commanded_modes=None)
    dither.note_found(context)
    context.clear_alarm(alarms.MIRROR_SILENT)
    dither.forget_unwanted(context)


def on_vanished(context: StepContext, _: ev.RtcVanished) -> None:
    """Forget the state of the RTC."""
    dither.forget_dither(context)
    context.loop = replace(context.loop, rtc=None)
    dither.note_found(context)
    dither.forget_unwanted(context)
    text = (
        "the RTC's token is gone: it has ended, stood still for over 2 s or lost the network; α "
        "and every reconstructor are kept; it comes back by itself if it runs, else restart it"
    )
    context.raise_alarm(alarms.VANISHED, text)


def on_services(context: StepContext, event: ev.ServicesMet) -> None:
    """Enter or leave standby; report services in standby."""
    who = " and ".join(event.others)
    stood_by = context.state.alarm(alarms.STANDING_BY) is not None
    if not event.others:
        context.clear_alarm(alarms.SECOND_SERVICE)
    else:
        does = "drives the RTC" if event.drives else "stands by"
        text = (
            f"more than one service of system {context.state.system}: besides this one, which "
            f"{does}, {who}: end all but one"
        )
        context.raise_alarm(alarms.SECOND_SERVICE, text)
    if not event.drives:
        dither.forget_dither(context)
        text = (
            f"another service drives the RTC: {who}; this one asks and sends nothing until that "
            "one has gone: end one of them"
        )
        context.raise_alarm(alarms.STANDING_BY, text)
        return
    if stood_by:
        text = "the service that drove the RTC has gone: this one drives it from now on"
        context.warn("service.takes-over", text)
    validity.end_alarm(context, alarms.STANDING_BY)


def fail_order(context: StepContext, effect: Effect | Request, text: str) -> None:
    """Log the failure, and note it under the id of the order that led to it."""
    context.fail(text)
    log_failure(context, effect, text)


def log_failure(context: StepContext, _: Effect | Request, text: str) -> None:
    """Log the failure; a request that is still needed is sent again."""
    context.warn("job.failed", text)
