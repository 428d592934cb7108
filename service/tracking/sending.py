"""Decide whether a reconstructor may be sent now."""

from __future__ import annotations

from service.estimation.loop import NO_RTC
from service.tracking import alarms, update_policy
from service.tracking.alarms import Alarm, Interlock, alarm_blocks, blocking_alarm
from service.tracking.mode_proof import check_proven
from service.tracking.products import ReconstructorRecord
from service.tracking.state import Mode, TrackerState

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
    before = state.alarms.active if swapped_ns_utc is None else _not_of_swap(state, swapped_ns_utc)
    alarm = next((alarm for alarm in before if alarm_blocks(alarm, interlock)), None)
    if alarm is not None:
        return alarm.text
    unread = explain_unread_matrix(state, state.loop.rtc.cm_id)
    return unread if unread or was_used else check_proven(state, record)


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


def _not_of_swap(state: TrackerState, swapped_ns_utc: int) -> tuple[Alarm, ...]:
    """Return the alarms that a matrix applied then cannot have caused."""
    return tuple(
        alarm
        for alarm in state.alarms.active
        if alarm.name not in _OF_A_SWAP or alarm.since_ns_utc < swapped_ns_utc
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
    if (
        blocking_alarm(state.alarms.active, Interlock.DECIDE) is not None
        or check_return(state) is not None
    ):
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
