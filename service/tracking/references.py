"""Reference slopes from a loaded shape to in use: made, proposed, sent, read back, followed.

They go the way of a reconstructor, with the same states. The RTC names those that it uses in its
status; what it subtracts is read back. Nothing else depends on them: α, session, matrices and
probation stay (docs/decisions/0101-references-may-change.md).
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import lru_cache

import numpy as np

from service.control.gains import gain_table
from service.control.references import holding_gain
from service.errors import CommandError, UnknownIdError
from service.estimation.loop import NO_RTC
from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import Interlock, blocking_alarm
from service.records.products import MatrixState, ReferencesRecord, Shape, ShapeKind
from service.records.registration import ModeGain, Registration, Validity
from service.records.state import Level, Mode, Orders, TrackerState
from service.tracking.filtering import check_measurable
from service.tracking.policy import SECOND_NS
from service.tracking.step_context import StepContext, present
from service.tracking.transitions import move
from service.tracking.update_policy import MIN_PROPOSAL_LIFETIME_S, is_settled
from service.wire import ReferencesRequest, Reply, Status

MAX_GAIN_CHANGE = 0.05
"""Relative change of the mean gain after which others are made: 5 nm of a shape of 100 nm."""

MAX_ALPHA_CHANGE = np.array([0.1, 0.1, np.deg2rad(0.5), 0.005])
"""``(4,)`` change of α after which others are made, numeric units. 0.3 subapertures cost 9 nm of a
shape of 100 nm."""

FOLLOW_INTERVAL_S = 10.0
"""Least time between two sets of references, which each end a window of telemetry."""

RETRY_INTERVAL_S = 60.0
"""Time before others are made after the RTC has refused some or has not used them."""

READ_BACK_INTERVAL_S = 30.0
"""Interval between two requests for the numbers of references that are not verified."""

CONFIRMATION_TIMEOUT_S = 10.0
"""Time after the ramp within which a status names the references: three attempts of a command."""

COMPUTATION_TIMEOUT_S = 60.0
"""References that take longer to compute were lost with their worker."""

MIN_LOG_ODDS = 8.0
"""References are reported as wrongly applied if a wrong way is e^8 times as likely as the right
one. Of 240 changes that were applied as sent, each judged eleven times, the largest ratio was e^6.5
(docs/results/reliability.md).
"""

RECORDS_KEPT = 50

OWN = "the RTC's own references"


def explain_waiting(state: TrackerState) -> str:
    """Return why no references are made or followed now; empty if they are."""
    kept, registration, rtc = state.references, state.alpha.registration, state.loop.rtc
    if kept.shape is None:
        return "no shape is loaded"
    if kept.paused:
        return kept.paused
    if state.operator.mode is Mode.HOLD:
        return "mode is hold: no references are made"
    if rtc is None or not rtc.in_loop:
        return "the loop is not closed: close it"
    if not _is_sure(registration):
        return "α is not fresh: references wait for a dithered window"
    if registration is None or not registration.optical_gains:
        return "no optical gain is measured yet: references wait for a dithered window"
    return ""


def check_sending(state: TrackerState, record: ReferencesRecord) -> str | None:
    """Return why references may not be sent now, or None; those in use before may always return."""
    if state.loop.rtc is None:
        return NO_RTC
    if state.references.unsupported:
        return state.references.unsupported
    known = record.shape is None or record.parent is not None
    interlock = Interlock.SEND_KNOWN if known else Interlock.SEND_NEW
    alarm = blocking_alarm(state.alarms.active, interlock)
    return None if alarm is None else alarm.text


def require_references(state: TrackerState, reference_id: str) -> ReferencesRecord:
    """Return the record of these references.

    Raises
    ------
    UnknownIdError
        If there is none.
    """
    record = state.references_of(reference_id)
    if record is None:
        raise UnknownIdError(f"unknown references {reference_id}")
    return record


@lru_cache(maxsize=8)
def mean_gain(coefficients_m: tuple[float, ...], measured: tuple[ModeGain, ...]) -> float:
    """Return the mean gain that holds a shape, weighted by the power of the shape in each mode."""
    power = np.square(coefficients_m)
    gains = holding_gain(gain_table(measured, len(power)).optical_gain)
    return float(power @ gains / power.sum())


# --- orders


def load_shape(context: StepContext, command: cmd.LoadShape) -> None:
    """Hold another shape from now on.

    Raises
    ------
    CommandError
        If it belongs to another basis, sensor or number of slopes than the RTC has.
    """
    rtc, values = present(context.rtc), command.values_m
    slopes = command.kind is ShapeKind.SLOPES
    for name, found, expected in (
        ("basis_id", command.basis_id, rtc.basis_id),
        ("config_id", command.config_id, rtc.config_id),
        ("slopes", len(values) if slopes else None, rtc.n_slopes),
    ):
        if found not in {None, expected}:
            raise CommandError(f"{name}: found {found}, expected {expected} as the RTC has")
    if command.kind is ShapeKind.MODES and any(values[rtc.n_controlled :]):
        highest = int(np.flatnonzero(values)[-1])
        raise CommandError(
            f"found mode {highest}, expected modes below {rtc.n_controlled}: only controlled modes "
            "can hold a shape"
        )
    shape = Shape(
        id=ev.new_id("shape", context.now_ns),
        kind=command.kind,
        frame=command.frame,
        values=values,
        source=command.source,
        by=command.by,
        loaded_ns_utc=context.now_ns,
    )
    _discard_proposals(context, f"{shape.id} was loaded")
    former = (context.references.shape, context.references.paused)
    context.references = replace(
        context.references, shape=shape, former=former, paused="", not_before_ns_utc=0
    )
    context.log("references.shape", f"{shape.id} loaded {command.signed}: {_describe(command)}")


def clear_shape(context: StepContext, command: cmd.ClearShape) -> None:
    """Hold no shape any more; have the RTC return to its own references."""
    context.references = replace(context.references, shape=None, paused="")
    _discard_proposals(context, "the shape was cleared")
    context.log("references.cleared", f"no shape is held any more, {command.signed}")
    if _is_offset(context.state):
        _send_again(context, None, command.reason or "the shape was cleared", command.by)


def approve(context: StepContext, command: cmd.ApproveReferences) -> None:
    """Send proposed references."""
    _send(context, require_references(context.state, command.id), command.by or "an operator")


def reject(context: StepContext, command: cmd.RejectReferences) -> None:
    """Discard proposed references, and make no others until a shape is loaded."""
    record = require_references(context.state, command.id)
    _store(context, replace(record, state=MatrixState.DISCARDED, reason=command.reason))
    _pause(context, f"{record.id} was rejected {command.signed}: load the shape again to go on")


def roll_back(context: StepContext, command: cmd.RollBackReferences) -> None:
    """Send the references in use before, or zeros, and make no others until a shape is loaded."""
    _pause(context, f"references were rolled back {command.signed}: load the shape again to go on")
    _discard_proposals(context, "references were rolled back")
    _send_again(context, find_previous(context.state), "rolled back", command.by or "an operator")


def find_previous(state: TrackerState) -> ReferencesRecord | None:
    """Return the references in use before the present ones; None for the RTC's own."""
    superseded = (
        r for r in reversed(state.references.records) if r.state is MatrixState.SUPERSEDED
    )
    before = max(superseded, key=lambda record: record.applied_ns_utc or 0, default=None)
    return None if before is None or before.shape is None else before


def restore_shape(context: StepContext, orders: Orders) -> None:
    """Take over the shape of the service before."""
    context.references = replace(
        context.references, shape=orders.shape, paused=orders.references_paused
    )


# --- decisions


def decide_references(context: StepContext) -> None:
    """Have references made where the shape, α or the gains need others; send them in auto."""
    state, kept = context.state, context.references
    # First of all, because most services hold no shape: this is asked after every event.
    if kept.shape is None or kept.computing_since_ns_utc is not None:
        return
    if context.now_ns < kept.not_before_ns_utc or explain_waiting(state):
        return
    if state.on_probation or context.blocking_alarm(Interlock.SEND_NEW) is not None:
        return
    newest = next((r for r in reversed(kept.records) if _is_made_for(r, kept.shape)), None)
    if newest is None:
        _request(context)
    elif not newest.on_its_way:
        _follow(context, newest)


def _follow(context: StepContext, newest: ReferencesRecord) -> None:
    """Send references that wait in auto; have others made where these do not fit any more."""
    state, proposed = context.state, newest.state is MatrixState.PROPOSED
    moved = _has_moved(state, newest)
    if proposed and not moved and state.operator.mode is Mode.AUTO:
        if check_sending(state, newest) is None:
            _send(context, newest)
        return
    wait_s = MIN_PROPOSAL_LIFETIME_S if proposed else FOLLOW_INTERVAL_S
    overdue = context.now_ns >= newest.created_ns_utc + round(wait_s * SECOND_NS)
    if overdue and (moved or _is_lost(state, newest)):
        _request(context)


def read_back(context: StepContext) -> None:
    """Ask the RTC for the offset of references that it has not shown yet."""
    kept, interval_ns = context.references, round(READ_BACK_INTERVAL_S * SECOND_NS)
    if kept.used_id in {None, kept.verified_id}:
        return
    if context.now_ns - kept.asked_ns_utc >= interval_ns:
        context.references = replace(kept, asked_ns_utc=context.now_ns)
        context.ask(ev.FetchReferences())


def give_up_overdue(context: StepContext) -> None:
    """Give up what has been waited for too long."""
    timeout_s = CONFIRMATION_TIMEOUT_S + context.policy.references_ramp_s
    for record in context.references.records:
        sent_ns = record.published_ns_utc or context.now_ns
        if record.on_its_way and context.now_ns - sent_ns > timeout_s * SECOND_NS:
            text = f"{record.id}: no status has named them {timeout_s:.0f} s after they were sent"
            with context.because_of(record.cause):
                _fail(context, record, text)
    since_ns = context.references.computing_since_ns_utc
    if since_ns is not None and context.now_ns - since_ns > COMPUTATION_TIMEOUT_S * SECOND_NS:
        on_making_failed(context, None, "")


# --- what happened


def on_made(context: StepContext, made: ev.ReferencesMade) -> None:
    """Keep new references; send them in auto, if nothing speaks against it."""
    record, shape = replace(made.record, cause=context.cause), context.references.shape
    context.references = replace(context.references, computing_since_ns_utc=None)
    if shape is None or record.shape != shape.id or context.references.paused:
        record = replace(record, state=MatrixState.DISCARDED, reason="the shape is held no longer")
    if record.state is not MatrixState.DISCARDED:
        _discard_proposals(context, f"{record.id} replaces them")
    first = not any(other.shape == record.shape for other in context.references.records)
    _store(context, record)
    if record.state is MatrixState.REFUSED:
        context.warn("references.refused", f"{record.id}: {record.reason}")
        if first:
            # Else it would be sent unasked once the gain makes its slopes small enough.
            former, paused = context.references.former
            context.references = replace(context.references, shape=former, paused=paused)
    else:
        text = f"{1e9 * record.rms_m:.0f} nm RMS, scaled with {record.gain or 1.0:.2f}"
        left = (
            f", {record.unexplained_ratio:.0%} unexplained"
            if record.unexplained_ratio > 0.01
            else ""
        )
        context.log("references.made", f"{record.id} {record.state}: {text}{left}")


def on_making_failed(context: StepContext, _: ev.Effect | None, __: str) -> None:
    """Make no others for a while."""
    context.references = replace(context.references, computing_since_ns_utc=None)
    _wait(context)


def on_sending_failed(context: StepContext, effect: ev.SendReferences, text: str) -> None:
    """Note that references may not have reached the RTC."""
    record = context.state.references_of(effect.id)
    if record is not None and record.on_its_way:
        _fail(context, record, text)


def on_answer(context: StepContext, request: ReferencesRequest, reply: Reply) -> None:
    """Note that the RTC has refused references; that it uses them is in its status."""
    record = context.state.references_of(request.reference_id)
    if record is None or reply.accepted:
        return
    text = f"the RTC refused {record.id}: {reply.reason}"
    if reply.is_unsupported:
        text += ". Another program can apply them: pyrcal export references, or topic references"
        context.references = replace(context.references, unsupported=text)
    _store(context, replace(record, state=MatrixState.REJECTED, reason=text))
    context.warn("references.rejected", text)
    context.fail(text)
    _wait(context)


def on_fetched(context: StepContext, fetched: ev.ReferencesFetched) -> None:
    """Compare what the RTC subtracts with what was sent."""
    shown = fetched.in_use
    record = context.state.references_of(context.references.used_id)
    # During a ramp the RTC shows another name, and an offset on the way.
    if record is None or shown.reference_id != record.id:
        return
    # Zeros of either sign are the RTC's own references.
    same = not shown.offset.any() if record.shape is None else shown.sha256 == record.sha256
    if not same:
        text = (
            f"the RTC subtracts other numbers as {record.id}: sha256 {shown.sha256}, sent were "
            f"{record.sha256}"
        )
        _distrust(context, record, text)
    elif context.references.verified_id != record.id:
        context.references = replace(context.references, verified_id=record.id, difference="")
        context.log("references.verified", f"the RTC subtracts {record.id} as they were sent")


def on_held(context: StepContext, held: ev.ShapeHeld) -> None:
    """Keep how much of the shape the mirror holds; name references that are applied otherwise."""
    record = context.state.references_of(held.id)
    # After wrong ones the way back to the RTC's own changes the mirror by another shape.
    if record is None or record.id != context.references.used_id or record.shape is None:
        return
    # A loop that slips holds much besides the shape.
    if check_measurable(context.state, held.began_ns_utc) is not None:
        return
    record = replace(record, held_ratio=held.ratio, held_sigma=held.sigma)
    _store(context, record)
    if held.log_odds > MIN_LOG_ODDS and not context.references.difference:
        text = (
            f"the mirror holds {held.ratio:.2f} ± {held.sigma:.2f} times the shape of {record.id}, "
            f"by the mean of the commands: they are applied {held.other}, not as they were sent"
        )
        _distrust(context, record, text)


def follow_status(context: StepContext, rtc: Status, *, returned: bool) -> None:
    """Note which references the RTC names; ``returned`` if it is seen for the first time."""
    kept, name = context.references, rtc.reference_name
    if not kept.records or name == kept.used_id:
        return
    record = context.state.references_of(name.removesuffix("~"))
    if record is not None and name.endswith("~"):
        if record.state is MatrixState.PUBLISHED:
            _store(context, replace(record, state=MatrixState.STAGED))
        return
    for other in kept.records:
        if other.state is MatrixState.APPLIED and other is not record:
            reason = f"the RTC uses {name}"
            _store(context, replace(other, state=MatrixState.SUPERSEDED, reason=reason))
    context.references = replace(
        context.references,
        used_id=None if record is None else record.id,
        verified_id=None,
        asked_ns_utc=0,
    )
    if record is not None:
        used = replace(
            record,
            state=MatrixState.APPLIED,
            # What ended an earlier use of them is over.
            reason=record.reason if record.on_its_way else "",
            applied_ns_utc=record.applied_ns_utc or context.now_ns,
        )
        _store(context, used)
        with context.because_of(record.cause):
            context.log("references.applied", f"the RTC uses {record.id}")
    elif kept.used_id is not None and not returned:
        # Another program changes them: two that do it in turn would cost every window.
        _pause(context, f"the RTC uses {name}, which were not sent: load the shape again to go on")


def forget_session(context: StepContext) -> None:
    """Note that the RTC has begun a new session; references that it keeps are read again."""
    for record in context.references.records:
        if record.on_its_way:
            _store(
                context, replace(record, state=MatrixState.FAILED, reason="the RTC has restarted")
            )
    context.references = replace(
        context.references, verified_id=None, asked_ns_utc=0, unsupported="", difference=""
    )


# --- steps of these


def _is_sure(registration: Registration | None) -> bool:
    if registration is None or not is_settled(registration):
        return False
    return registration.validity.level is Validity.FRESH


def _is_made_for(record: ReferencesRecord, shape: Shape) -> bool:
    return record.shape == shape.id and record.parent is None


def _is_lost(state: TrackerState, record: ReferencesRecord) -> bool:
    """Return whether references were sent and the RTC does not use them."""
    if record.state is MatrixState.REJECTED:
        return not state.references.unsupported
    return record.state in {MatrixState.SUPERSEDED, MatrixState.FAILED, MatrixState.DISCARDED}


def _has_moved(state: TrackerState, record: ReferencesRecord) -> bool:
    """Return whether references no longer fit α or the optical gains."""
    registration = state.alpha.registration
    if registration is None or record.alpha is None or not record.gain:
        return False
    if np.any(registration.alpha.distance(record.alpha) > MAX_ALPHA_CHANGE):
        return True
    gains = registration.optical_gains
    now = mean_gain(record.coefficients_m, gains)
    # In the first window after a change of seeing no gain is known well: the next one decides.
    sigma = min((gain.sigma / gain.gain for gain in gains), default=np.inf)
    return abs(now / record.gain - 1.0) > max(MAX_GAIN_CHANGE, sigma)


def _is_offset(state: TrackerState) -> bool:
    """Return whether the RTC subtracts, or is about to subtract, references of the service."""
    kept = state.references
    used = state.references_of(kept.used_id)
    going = any(record.on_its_way for record in kept.records)
    return going or (used is not None and used.shape is not None)


def _request(context: StepContext) -> None:
    context.references = replace(context.references, computing_since_ns_utc=context.now_ns)
    name = ev.new_id("ref", context.now_ns)
    seeing = context.policy.worst_seeing_arcsec
    context.ask(ev.MakeReferences(id=name, worst_seeing_arcsec=seeing))


def _send(context: StepContext, record: ReferencesRecord, by: str = "") -> None:
    """Have the RTC use references.

    Raises
    ------
    CommandError
        If they cannot be sent now.
    """
    reason = check_sending(context.state, record)
    if reason is not None:
        raise CommandError(f"{record.id} cannot be sent: {reason}")
    for other in context.references.records:
        if other.on_its_way:
            overtaken = f"{record.id} was sent after them"
            _store(context, replace(other, state=MatrixState.FAILED, reason=overtaken))
    sent = replace(
        record,
        state=MatrixState.PUBLISHED,
        published_ns_utc=context.now_ns,
        by=by,
        cause=context.cause,
    )
    _store(context, sent)
    context.log("references.published", f"{record.id} sent to the RTC")
    context.ask(ev.SendReferences(id=record.id, ramp_s=context.policy.references_ramp_s))


def _send_again(
    context: StepContext, source: ReferencesRecord | None, reason: str, by: str
) -> None:
    """Send earlier references, or zeros for the RTC's own, under a new id."""
    name, n_slopes = ev.new_id("ref", context.now_ns), present(context.rtc).n_slopes
    own = ReferencesRecord(
        id=name,
        state=MatrixState.PROPOSED,
        created_ns_utc=context.now_ns,
        sha256=hashlib.sha256(bytes(4 * n_slopes)).hexdigest(),
    )
    copy = source and replace(
        source,
        id=name,
        state=MatrixState.PROPOSED,
        created_ns_utc=context.now_ns,
        parent=source.parent or source.id,
        applied_ns_utc=None,
    )
    record = replace(copy or own, reason=f"{reason}: {source.id if source else OWN}")
    _store(context, record)
    _send(context, record, by)


def _distrust(context: StepContext, record: ReferencesRecord, text: str) -> None:
    """Report references that the RTC applies wrongly; in auto return to the RTC's own.

    The RTC's own references are an offset of zeros, which no wrong sign or scale changes.
    """
    context.references = replace(context.references, difference=text, verified_id=None)
    _pause(context, f"{text}. Mend the RTC, then load the shape again")
    automatic = context.operator.mode is Mode.AUTO and record.shape is not None
    if automatic and check_sending(context.state, record) is None:
        _send_again(context, None, "they were applied otherwise than sent", "")


def _fail(context: StepContext, record: ReferencesRecord, text: str) -> None:
    _store(context, replace(record, state=MatrixState.FAILED, reason=text))
    context.warn("references.failed", text)
    context.fail(text)
    _wait(context)


def _wait(context: StepContext) -> None:
    until_ns = context.now_ns + round(RETRY_INTERVAL_S * SECOND_NS)
    context.references = replace(context.references, not_before_ns_utc=until_ns)


def _pause(context: StepContext, text: str) -> None:
    context.references = replace(context.references, paused=text)
    context.log("references.paused", text, Level.WARNING)


def _discard_proposals(context: StepContext, reason: str) -> None:
    for record in context.references.records:
        if record.state is MatrixState.PROPOSED:
            _store(context, replace(record, state=MatrixState.DISCARDED, reason=reason))


def _store(context: StepContext, record: ReferencesRecord) -> None:
    """Keep a record in its new state, if that may follow; the oldest ones not in use go."""
    kept = context.references
    record = move(context, context.state.references_of(record.id), record)
    records = [record if r.id == record.id else r for r in kept.records]
    if record not in records:
        records.append(record)
    spare = [r.id for r in records if r.id not in {kept.used_id, record.id}]
    gone = frozenset(spare[: max(len(records) - RECORDS_KEPT, 0)])
    context.references = replace(
        context.references, records=tuple(r for r in records if r.id not in gone)
    )


def _describe(command: cmd.LoadShape) -> str:
    size = f"{len(command.values)} slopes"
    if command.kind is not ShapeKind.SLOPES:
        size = f"{1e9 * command.rms_m:.3g} nm RMS"
    return f"{size} as {command.kind}" + (f" from {command.source}" if command.source else "")
