"""A reconstructor from made to in use: may it be sent? Then judged, sent, acknowledged."""

from __future__ import annotations

from dataclasses import replace

from service.errors import CommandError, UnknownIdError
from service.estimation.loop import NO_RTC, extend_gains, last_seq, select_gains
from service.records import alarms
from service.records import events as ev
from service.records.alarms import Interlock, alarm_blocks, blocking_alarm
from service.records.messages import compose
from service.records.products import Assessment, MatrixState, ReconstructorRecord
from service.records.state import Level, Mode, TrackerState
from service.tracking import update_policy
from service.tracking.mode_proof import check_proven
from service.tracking.step_context import StepContext
from service.tracking.transitions import is_declared, move
from service.wire import Acknowledgement, AckState, Status

_OF_A_SWAP = (
    *(alarms.DIVERGING, alarms.EDGE_SLIP, alarms.OFF_LOOP, alarms.WRONG_LOOP, alarms.WRONG_UNIT),
    *(alarms.WRONG_MATRIX, alarms.WRONG_ANSWER),
)
"""Alarms that telemetry raises when a wrong matrix multiplies its slopes."""


def check_sendable(
    state: TrackerState, record: ReconstructorRecord, swapped_ns_utc: int | None = None
) -> str | None:
    """Return why a reconstructor may not be published now, by anybody, or None.

    ``swapped_ns_utc`` is the time until which it was in use. Alarms since then are consequences of
    the swap and no reason against a rollback.
    """
    if state.loop.rtc is None:
        return NO_RTC
    if record.config_id not in {None, state.loop.config_id}:
        return (
            f"it is for the sensor's mode {record.config_id}, which is now "
            f"{state.loop.config_id}: have another one made, or change the mode back"
        )
    was_used, registration = _was_in_use(state, record), state.alpha.registration
    if registration is not None and not was_used:  # one must be able to go back
        if registration.suspected_jump is not None:
            return "a jump is suspected: the next window of telemetry decides"
        if registration.doubt:
            now = "invalid" if registration.doubt_voids else "in question"
            return f"α is {now} ({registration.doubt})"
    interlock = Interlock.SEND_KNOWN if was_used else Interlock.SEND_NEW
    for alarm in state.alarms.active:
        of_swap = swapped_ns_utc is not None and alarm.since_ns_utc >= swapped_ns_utc
        if alarm_blocks(alarm, interlock) and not (of_swap and alarm.name in _OF_A_SWAP):
            return alarm.text
    unread = explain_unread_matrix(state, state.loop.rtc.cm_id)
    return unread if unread or was_used else _check_renaming(state) or check_proven(state, record)


def _check_renaming(state: TrackerState) -> str | None:
    """Return that nothing has shown the sensor to be the same under another name, or None."""
    if state.loop.renamed_ns_utc is None or state.loop.rtc is None:
        return None
    return (
        f"the RTC's config_id is {state.loop.rtc.config_id}, it was another: no window has shown "
        "yet that the sensor is the same"
    )


def check_approved(
    state: TrackerState, record: ReconstructorRecord, swapped_ns_utc: int | None = None
) -> str | None:
    """Return the same where the gate's verdict counts: one that says no comes first."""
    if record.gate is not None and not record.gate.accepted:
        return record.gate.reason
    return check_sendable(state, record, swapped_ns_utc)


def check_return(state: TrackerState) -> str | None:
    """Return why the matrix in use could not be sent back after another one, or None."""
    rtc = state.loop.rtc
    # A rollback sends numbers: an id whose numbers were not seen in this session is not enough.
    if rtc is None or (rtc.cm_id or state.matrices.in_use) in state.matrices.verified_ids:
        return None
    name = "its matrix" if rtc.cm_id is None else rtc.cm_id
    why = (
        state.matrices.read_back_error
        or explain_unread_matrix(state, rtc.cm_id)
        or "its status does not name it"
    )
    return (
        f"there would be no way back: the RTC has not shown {name} on rtc/cm/applied ({why}); "
        "have it offered there, or approve what is proposed and watch the loop"
    )


def explain_unread_matrix(state: TrackerState, matrix_id: str | None) -> str | None:
    """Return why the numbers of this matrix of the RTC's are unknown, or None."""
    if matrix_id is None or matrix_id in state.matrices.verified_ids:
        return None
    if matrix_id == state.matrices.mismatched_id:
        return f"the RTC holds other numbers as {matrix_id}"
    if state.matrices.read_back_error:
        return None  # an RTC need not offer its matrix; its id is believed then
    return f"the RTC's matrix {matrix_id} is being read back: wait some seconds"


def may_follow(state: TrackerState) -> bool:
    """Return whether a reconstructor may be sent without an order."""
    rtc, registration = state.loop.rtc, state.alpha.registration
    if state.operator.mode is not Mode.AUTO or state.on_probation or rtc is None or not rtc.in_loop:
        return False
    if blocking_alarm(state.alarms.active, Interlock.DECIDE) or check_return(state) is not None:
        return False
    return registration is not None and update_policy.is_settled(registration)


def beyond_judging(state: TrackerState, record: ReconstructorRecord) -> bool:
    """Return whether neither the judged gains nor the present ones are known."""
    opened = state.loop.rtc is not None and state.loop.rtc.loop == "open"
    return opened and record.gate is not None and record.judged is None


def _was_in_use(state: TrackerState, record: ReconstructorRecord) -> bool:
    """Return whether the very numbers of this reconstructor have been in use before."""
    same = (r for r in state.matrices.reconstructors if r.sha256 == record.sha256)
    # Empty checksums are unknown ones and do not make two matrices the same.
    return bool(record.sha256) and any(r.was_used for r in same)


MAX_SWAP_DELAY_S = 0.5
"""A status of a frame that is so much later than the one from which a matrix is reported applied
must name it (R-69); one before may have been made while the matrices were swapped."""

RECONSTRUCTORS_KEPT = 200

RETURNS_KEPT = 100
"""Number of previously used reconstructors that are kept for a rollback, the newest."""

UNSENT_KEPT = 50
"""Newest of those that were never sent: enough to see what is being refused, and why."""

_DECLINED = frozenset({MatrixState.REFUSED, MatrixState.REJECTED, MatrixState.FAILED})
"""States after a rejection by the gate, when it judged again, or by the RTC."""

_UNSENT = frozenset({MatrixState.REFUSED, MatrixState.DISCARDED})
_SPARE = frozenset({MatrixState.REJECTED, MatrixState.FAILED, MatrixState.SUPERSEDED})


def require_record(state: TrackerState, matrix_id: str) -> ReconstructorRecord:
    """Return the record of this id.

    Raises
    ------
    UnknownIdError
        If there is none.
    """
    record = state.reconstructor(matrix_id)
    if record is None:
        raise UnknownIdError(f"unknown reconstructor {matrix_id}")
    return record


def store_reconstructor(context: StepContext, record: ReconstructorRecord) -> None:
    """Keep one more reconstructor; what is needed least gives way."""
    record = move(context, context.state.reconstructor(record.id), record)
    records = [*(r for r in context.matrices.reconstructors if r.id != record.id), record]
    kept = prune(records, context.matrices.in_use)
    context.matrices = replace(context.matrices, reconstructors=kept)


def replace_record(context: StepContext, record: ReconstructorRecord) -> bool:
    """Replace the record of the same id and return True, unless its state may not follow."""
    records = tuple(
        move(context, r, record) if r.id == record.id else r
        for r in context.matrices.reconstructors
    )
    before = context.state.reconstructor(record.id)
    context.matrices = replace(context.matrices, reconstructors=records)
    if record not in records:
        return False
    changed = before is not None and before.state is not record.state
    if changed and record.state in _DECLINED:
        update_policy.limit_declined(context, record)
    return True


def change_state(context: StepContext, matrix_id: str, to: MatrixState, reason: str) -> None:
    """Take one reconstructor further on its way."""
    replace_record(
        context, replace(require_record(context.state, matrix_id), state=to, reason=reason)
    )


def mark_applied(context: StepContext, matrix_id: str) -> None:
    """Mark one reconstructor as applied; whichever was, has been superseded."""
    record = require_record(context.state, matrix_id)
    # Each status names the matrix in use: a repetition must not discard its verdict.
    if context.matrices.in_use == matrix_id and record.state is MatrixState.APPLIED:
        return
    for other in context.matrices.reconstructors:
        # The RTC multiplies with one matrix only.
        if other.id != matrix_id and other.state is MatrixState.APPLIED:
            change_state(context, other.id, MatrixState.SUPERSEDED, f"{matrix_id} is in use")
    replace_record(context, replace(record, state=MatrixState.APPLIED))
    context.matrices = replace(
        context.matrices, in_use=matrix_id, margin=None, assessment=None, judged_ns_utc=None
    )


def forget_verdict(context: StepContext) -> None:
    """Forget the margin of the matrix in use: what it was judged at is not so any more."""
    context.matrices = replace(context.matrices, margin=None)


def forget_when_judged(context: StepContext) -> None:
    """Have the matrix in use judged again, whenever that was done last."""
    context.matrices = replace(context.matrices, judged_ns_utc=None)


def forget_session(context: StepContext) -> None:
    """Note that the RTC has begun a new session: its matrix is unknown."""
    for record in context.matrices.reconstructors:
        if record.on_its_way:
            change_state(context, record.id, MatrixState.FAILED, "the RTC restarted")
    context.matrices = replace(
        context.matrices,
        # A restarted RTC may hold other numbers under a known id, so that nothing is verified any
        # more (docs/decisions/0026-gate-verdict-read-back.md).
        in_use=None,
        verified_ids=frozenset(),
        mismatched_id=None,
        unconfirmed_id=None,
        applied_asked_ns_utc=0,
        read_back_error="",
        margin=None,
        assessment=None,
        judged_ns_utc=None,
    )


def verify_again(context: StepContext) -> None:
    """Have the matrix in use read again before anything new is sent."""
    context.matrices = replace(
        context.matrices, verified_ids=frozenset(), applied_asked_ns_utc=0, read_back_error=""
    )


def discard_proposals(context: StepContext, why: str) -> None:
    """Discard proposals that wait for an operator because they are out of date."""
    for record in context.matrices.reconstructors:
        if record.state is MatrixState.PROPOSED:
            change_state(context, record.id, MatrixState.DISCARDED, why)


def request_applied(context: StepContext, rtc: Status) -> None:
    """Ask the RTC for the matrix it uses."""
    context.matrices = replace(context.matrices, applied_asked_ns_utc=context.now_ns)
    context.ask(ev.FetchMatrix(id=rtc.cm_id))


def request_matrix(context: StepContext, effect: ev.MakeMatrix | ev.RepublishMatrix) -> None:
    """Have a reconstructor computed, or copied."""
    context.matrices = replace(context.matrices, making_since_ns_utc=context.now_ns)
    context.ask(effect)


def note_none_made(context: StepContext) -> None:
    """Note that no reconstructor is being computed."""
    context.matrices = replace(context.matrices, making_since_ns_utc=None)


def on_judging_failed(context: StepContext, _: ev.Effect, __: str) -> None:
    """Make and judge nothing for a while."""
    # Without a pause a worker that fails at once would be asked in every step.
    context.put_off(make_s=5.0)


def on_making_failed(context: StepContext, effect: ev.Effect, text: str) -> None:
    """Note that no reconstructor comes, and make none for a while."""
    note_none_made(context)
    on_judging_failed(context, effect, text)


def on_send_failed(context: StepContext, effect: ev.SendMatrix, text: str) -> None:
    """Note that a reconstructor has not reached the RTC."""
    change_state(context, effect.id, MatrixState.FAILED, text)


def on_fetch_failed(context: StepContext, _: ev.FetchMatrix, text: str) -> None:
    """Note why the RTC's matrix is not known."""
    context.matrices = replace(context.matrices, read_back_error=text)


def request_verdict(context: StepContext, matrix_id: str) -> None:
    """Have the matrix in use judged."""
    context.matrices = replace(context.matrices, judged_ns_utc=context.now_ns)
    context.ask(ev.JudgeMatrix(id=matrix_id))


def on_matrix(context: StepContext, made: ev.MatrixMade) -> None:
    """Keep a new reconstructor; send it if it passed the gate and needs no approval.

    One that an operator published or went back to needs no approval and no mode auto; others,
    a refit among them, are sent only to a closed loop without alarms, and if α is valid.
    """
    record, wanted = made.record, made.wanted
    # A matrix that was being made when a jump was confirmed is for the registration before it. One
    # that an operator ordered is judged again instead.
    overtaken = not wanted and _has_jumped_since(context.state, record)
    propose(context, record)
    if made.asked_modes is not None:
        update_policy.note_limit(context, record, made.asked_modes, made.why_fewer)
    if record.state is MatrixState.REFUSED:
        return
    if overtaken:
        text = f"{record.id}: the mirror jumped while it was made"
        change_state(context, record.id, MatrixState.DISCARDED, text)
        context.log("reconstructor.discarded", text)
        return
    held = check_sendable(context.state, record) or beyond_judging(context.state, record)
    # In auto no matrix is sent without a way back from it: probation must be able to send the
    # previous one.
    unasked = context.operator.mode is Mode.AUTO and not wanted
    no_return = check_return(context.state) if unasked else None
    if not held and no_return is not None:
        context.log("reconstructor.kept-back", f"{record.id} is proposed and not sent: {no_return}")
    elif not held and made.anyway:
        send(context, record.id)
    elif not held and (wanted or may_follow(context.state)):
        send_once_judged(context, record.id, wanted=wanted)


def propose(context: StepContext, record: ReconstructorRecord) -> None:
    """Keep a new reconstructor in place of any proposal."""
    note_none_made(context)
    discard_proposals(context, f"{record.id} replaces it")
    store_reconstructor(context, replace(record, cause=context.cause))
    verdict = record.gate.reason if record.gate is not None else record.reason
    if record.state is MatrixState.REFUSED:
        context.warn("reconstructor.refused", f"{record.id}: {verdict}")
    else:
        context.log("reconstructor.made", f"{record.id}, {record.n_modes} modes, {verdict}")


def send_once_judged(context: StepContext, matrix_id: str, *, wanted: bool = True) -> None:
    """Send a reconstructor; where its verdict is not of the present loop and α, judge it first.

    Raises
    ------
    CommandError
        If it cannot be sent now, whatever the gate would say.
    """
    record, rtc = _sendable(context, matrix_id)
    gains = select_gains(rtc, record.n_modes)
    stale = update_policy.verdict_invalid_reason(context.state, record.judged, gains)
    # A rollback into an open loop cannot be judged and is sent all the same
    # (docs/decisions/0026-gate-verdict-read-back.md).
    if stale is None or (rtc.loop == "open" and record.gate is None):
        send(context, matrix_id)
        return
    # An open loop's status does not contain the gains that it will close with: those of the last
    # verdict are used.
    if rtc.loop == "open" and record.judged is not None:
        gains = record.judged.gains
    text = f"{matrix_id} is judged again before it is sent: {stale}"
    context.log("reconstructor.judged-again", text)
    replace_record(context, replace(record, cause=context.cause))
    context.ask(ev.JudgeProposal(id=matrix_id, gains=gains, wanted=wanted))


def on_proposal_judged(context: StepContext, event: ev.ProposalJudged) -> None:
    """Send a reconstructor that has passed the gate again, if nothing changed."""
    record, rtc = context.state.reconstructor(event.id), context.rtc
    if record is None or record.state is not MatrixState.PROPOSED:
        return
    verdict = event.verdict
    record = replace(record, gate=verdict, judged=event.judged)
    if not verdict.accepted:
        replace_record(context, replace(record, state=MatrixState.REFUSED, reason=verdict.reason))
        context.warn("reconstructor.refused", f"{record.id}: {verdict.reason}")
        return
    replace_record(context, record)
    reason = check_sendable(context.state, record)
    # The verdict takes a second: mode, loop and α may have changed meanwhile.
    if reason is None and not event.wanted and not may_follow(context.state):
        alarm = context.blocking_alarm(Interlock.DECIDE)
        reason = f"{alarm.name}: {alarm.text}" if alarm else "the mode, the loop or α has changed"
    if rtc is not None and reason is None:
        reason = update_policy.verdict_invalid_reason(
            context.state, record.judged, select_gains(rtc, record.n_modes)
        )
    if reason is None:
        send(context, record.id)
        return
    text = f"{record.id} was not sent: while it was judged, {reason}; approve it again"
    context.warn("reconstructor.not-sent", text)
    context.fail(text)


def send(
    context: StepContext,
    matrix_id: str,
    swapped_ns_utc: int | None = None,
    gains: tuple[float, ...] | None = None,
) -> None:
    """Mark a reconstructor as published and request to send it, with gains or those in force.

    ``swapped_ns_utc`` requests a rollback behind the swap of that time, see :func:`check_sendable`.

    Raises
    ------
    CommandError
        If no RTC is there, it may be the wrong one, or the gate's latest verdict is no.
    """
    record, rtc = _sendable(context, matrix_id, swapped_ns_utc)
    # Gains travel with the matrix only where the number of modes changes: the RTC keeps its own.
    if gains is None and record.n_modes != rtc.n_controlled:
        gains = extend_gains(rtc, record.n_modes)
    unjudged = _explain_missing_verdict(record)
    sent = replace(
        record,
        state=MatrixState.PUBLISHED,
        published_ns_utc=context.now_ns,
        reason=unjudged,
        cause=context.cause,
    )
    if not replace_record(context, sent):
        return
    text = f"{record.id} sent to the RTC{'; ' if unjudged else ''}{unjudged}"
    context.log("reconstructor.published", text, Level.WARNING if unjudged else Level.INFO)
    context.ask(ev.SendMatrix(id=record.id, n_modes=record.n_modes, gains=gains))


def on_acknowledgement(context: StepContext, event: Acknowledgement) -> None:
    """Process the RTC's acknowledgement, also a late one.

    A rejection without an id is of a commit that the RTC could not read. It says nothing of a
    matrix of this service that is on its way: anyone may have sent that commit, and one of the
    service's own is given up after ``ACKNOWLEDGEMENT_TIMEOUT_S`` without an answer.
    """
    if event.id is None:
        _warn_of_unreadable_commit(context, event)
        return
    record = context.state.reconstructor(event.id)
    if record is None:
        context.warn("acknowledgement.unknown", compose("acknowledgement.not-ours", id=event.id))
        return
    if not _is_old(context.state, record, event):
        with context.because_of(record.cause):
            _on_state(context, record, event)


def _on_state(context: StepContext, record: ReconstructorRecord, event: Acknowledgement) -> None:
    """Take a reconstructor further on its way, or note why the RTC holds other numbers."""
    reason, state = event.reason, MatrixState(event.state.value)
    other_numbers = bool(record.sha256) and event.sha256 not in {None, record.sha256}
    rejected = state is MatrixState.REJECTED
    # R-72 has the RTC reject a commit that reuses an id, whoever sent it. That says nothing of the
    # matrix that has the id, nor does a rejection of one that it has applied.
    if rejected and (other_numbers or not is_declared(record.state, state)):
        text = f"the RTC rejected a commit with the id of {record.id}, which is {record.state}"
        context.warn("acknowledgement.other-commit", f"{text}: {reason or 'no reason given'}")
        return
    # The id alone does not prove that the numbers have arrived unchanged.
    if other_numbers:
        _distrust(context, record, state, event.sha256)
        return
    if state in {MatrixState.APPLIED, MatrixState.STAGED}:
        reason = reason or _explain_missing_verdict(record)
    if state is MatrixState.APPLIED:
        _trust(context, record.id)
        record = replace(record, applied_frame_seq=event.frame_seq, reason=reason)
        replace_record(context, record)
        if context.matrices.in_use != record.id and event.frame_seq is not None:
            context.matrices = replace(context.matrices, unconfirmed_id=record.id)
        mark_applied(context, record.id)
        gains = () if context.rtc is None else select_gains(context.rtc, record.n_modes)
        of_other = update_policy.verdict_doubtful_reason(context.state, record.judged, gains)
        context.matrices = replace(
            context.matrices,
            # The gate's verdict is the margin only while loop and α are those that it judged.
            margin=None if of_other else record.gate,
            judged_ns_utc=None if of_other else context.now_ns,
        )
        context.log("reconstructor.applied", f"{record.id} applied from frame {event.frame_seq}")
        return
    change_state(context, record.id, state, reason)
    if rejected:
        context.warn("reconstructor.rejected", f"the RTC rejected {record.id}: {event.reason}")


def on_fetched(context: StepContext, fetched: ev.MatrixFetched) -> None:
    """Store the RTC's own matrix, or recognise one of the service.

    Ids are not sufficient: a restarted RTC may order its slopes differently, and use a different
    matrix under a known id.
    """
    context.matrices = replace(context.matrices, read_back_error="")
    record = fetched.record
    before = context.state.reconstructor(record.id)
    if before is not None and before.sha256 not in {"", record.sha256}:
        _distrust(context, before, MatrixState.APPLIED, record.sha256)
        return
    _trust(context, record.id)
    # After _trust: the numbers are verified now, even where the id is no news.
    if context.matrices.in_use == record.id or not _check_swap(context, record.id):
        return
    if before is None:
        store_reconstructor(context, record)
    context.log("reconstructor.adopted", f"the RTC uses {record.id}, {record.n_modes} modes")
    apply_named(context, record.id)


def apply_named(context: StepContext, matrix_id: str) -> None:
    """Take the reconstructor that the RTC's status names for applied, acknowledged or not.

    Only once its numbers are known to be the RTC's, or are not to be had.
    """
    record = context.state.reconstructor(matrix_id)
    if record is None or explain_unread_matrix(context.state, matrix_id):
        return
    if not _check_swap(context, matrix_id):
        return
    mark_applied(context, matrix_id)
    if record.state is MatrixState.FAILED:
        # The acknowledgement may be lost or late; the status is repeated.
        text = f"{matrix_id} is in use after all, by the RTC's status, without an acknowledgement"
        change_state(context, matrix_id, MatrixState.APPLIED, text)
        context.log("reconstructor.applied", text)


def _check_swap(context: StepContext, named: str) -> bool:
    """Return False if the matrix that is named may be that from before an acknowledged swap.

    One that is named long after the swap proves that it has not happened.
    """
    sent, rtc = context.state.reconstructor(context.matrices.unconfirmed_id), context.rtc
    if sent is None or rtc is None:
        return True
    since, text = sent.applied_frame_seq or 0, context.matrices.misapplied
    if named != sent.id:
        if last_seq(rtc) <= since + MAX_SWAP_DELAY_S * rtc.frame_rate_hz:
            return False
        text = (
            f"the RTC applies another matrix than it says: it acknowledged {sent.id} from frame "
            f"{since}, and its status of frame {rtc.seq} still names {named}. Nothing more is "
            "sent: see why the RTC does not swap, then set the mode"
        )
        change_state(context, sent.id, MatrixState.FAILED, text)
    context.matrices = replace(context.matrices, unconfirmed_id=None, misapplied=text)
    return True


def on_misapplied(context: StepContext, event: ev.MatrixMisapplied) -> None:
    """Note that the RTC multiplies with other numbers; nothing more is sent by itself."""
    text = (
        f"the RTC applies another matrix than it says: the first commands with {event.id} are the "
        "opposite of what its numbers require, so the RTC turns the sign of the matrix. Nothing "
        "more is sent: mend the RTC, then set the mode"
    )
    context.matrices = replace(context.matrices, misapplied=text, misapplied_id=event.id)


def forget_misapplied(context: StepContext) -> None:
    """Trust what the RTC says of its swaps again: an operator has set the mode."""
    context.matrices = replace(context.matrices, misapplied="", misapplied_id=None)


def on_margin(context: StepContext, event: ev.MarginJudged) -> None:
    """Store margin and loss of the matrix in use."""
    record, verdict, judged = context.state.reconstructor(event.id), event.verdict, event.judged
    if record is None:
        return
    used = event.id == context.matrices.in_use
    gains = () if context.rtc is None else context.rtc.gains[: record.n_modes]
    if judged and update_policy.verdict_doubtful_reason(context.state, judged, gains) is not None:
        if used:
            forget_when_judged(context)
        return
    replace_record(context, replace(record, gate=verdict, judged=judged))
    if not used:
        return
    assessment = None
    if event.alpha is not None and event.expected is not None:
        assessment = Assessment(
            id=event.id, alpha=event.alpha, expected=event.expected, t_ns_utc=context.now_ns
        )
    context.matrices = replace(context.matrices, margin=verdict, assessment=assessment)


def _sendable(
    context: StepContext, matrix_id: str, swapped_ns_utc: int | None = None
) -> tuple[ReconstructorRecord, Status]:
    """Return a reconstructor that may be sent, and to whom.

    Raises
    ------
    CommandError
        If it cannot be sent now.
    """
    record, rtc = require_record(context.state, matrix_id), context.rtc
    reason = check_approved(context.state, record, swapped_ns_utc)
    if rtc is None or reason is not None:
        raise CommandError(f"{matrix_id} cannot be sent: {reason}")
    return record, rtc


def _distrust(
    context: StepContext, record: ReconstructorRecord, state: MatrixState, sha256: str | None
) -> None:
    """Conclude that the RTC's matrix differs from the one known by its id: nothing is sent."""
    before = "sent were" if record.parent is not None else "it was, when it was read before,"
    text = (
        f"the RTC has {state} other numbers as {record.id}: sha256 {sha256}, {before} "
        f"{record.sha256}; nothing is published until it holds those (rtc/cm/applied), or another "
        "matrix under an id of its own: open the loop if it suffers, see the RTC's log"
    )
    change_state(context, record.id, MatrixState.FAILED, text)
    if state is MatrixState.APPLIED:
        context.matrices = replace(context.matrices, in_use=None, margin=None, assessment=None)
    context.matrices = replace(
        context.matrices,
        verified_ids=context.matrices.verified_ids - {record.id},
        mismatched_id=record.id,
        applied_asked_ns_utc=context.now_ns,
    )


def _trust(context: StepContext, matrix_id: str) -> None:
    """Note that the RTC holds the numbers that it should."""
    kept = {record.id for record in context.matrices.reconstructors} & context.matrices.verified_ids
    context.matrices = replace(context.matrices, verified_ids=frozenset({*kept, matrix_id}))
    if context.matrices.mismatched_id is not None:
        context.matrices = replace(context.matrices, mismatched_id=None)
        context.log("reconstructor.right", f"the RTC holds {matrix_id} as it was sent")


def _has_jumped_since(state: TrackerState, record: ReconstructorRecord) -> bool:
    """Return True if a jump was found since its request: the verdict is out of date."""
    registration, began_ns = state.alpha.registration, state.matrices.making_since_ns_utc
    if registration is None or registration.jumped_ns_utc is None or began_ns is None:
        return False
    # A jump that is smaller than the range of the verdict leaves it valid.
    return registration.jumped_ns_utc >= began_ns and update_policy.is_outdated(state, record)


def _explain_missing_verdict(record: ReconstructorRecord) -> str:
    """Return why the gate has reported nothing on one on its way to the RTC; empty: it has."""
    going = record.on_its_way or record.state is MatrixState.PROPOSED
    return record.reason if record.gate is None and going else ""


def _warn_of_unreadable_commit(context: StepContext, event: Acknowledgement) -> None:
    sent = context.state.sent
    text = f"the RTC rejected a commit that it could not read: {event.reason or 'no reason given'}"
    if sent is None:
        text += ". This service has sent none: another program sends commits to the RTC"
    else:
        text += f". {sent.id} is on its way: if the RTC does not apply it, this may be why"
    context.warn("acknowledgement.unreadable-commit", text)


def _is_old(state: TrackerState, record: ReconstructorRecord, event: Acknowledgement) -> bool:
    """Return whether an acknowledgement is of something overtaken."""
    if state.loop.rtc is not None and event.session != state.loop.rtc.session:
        return True
    if event.state is AckState.STAGED:
        # An acknowledgement that arrives after "applied" must not set the record back to "staged".
        return record.state is not MatrixState.PUBLISHED
    # A rollback applies a superseded matrix again, from another frame: only the same frame means
    # the same acknowledgement.
    repeated = record.applied_frame_seq == event.frame_seq
    return record.state is MatrixState.SUPERSEDED and repeated


def prune(shelf: list[ReconstructorRecord], in_use: str | None) -> tuple[ReconstructorRecord, ...]:
    """Return the records that are kept, oldest first.

    Matrices that were never sent are dropped first, however new they are: many unused proposals
    must not displace the matrices for a rollback.
    """
    excess = len(shelf) - RECONSTRUCTORS_KEPT
    if excess <= 0:
        return tuple(shelf)
    unsent = [r.id for r in shelf if r.state in _UNSENT and r.id != in_use]
    used = [r.id for r in shelf if r.state is MatrixState.SUPERSEDED]
    kept = frozenset((*used[-RETURNS_KEPT:], in_use))
    spare = [r.id for r in shelf if r.state in _SPARE and r.id not in kept]
    first_to_go = [*unsent[:-UNSENT_KEPT], *spare, *unsent[-UNSENT_KEPT:]]
    gone = frozenset(first_to_go[:excess])
    return tuple(r for r in shelf if r.id not in gone)
