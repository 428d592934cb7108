"""The shelf of reconstructors inside the state."""

from __future__ import annotations

from dataclasses import replace

from service.errors import UnknownIdError
from service.state import MatrixState, ReconstructorRecord, TrackerState

RECONSTRUCTORS_KEPT = 200

RETURNS_KEPT = 100
"""Newest of those that have been in use before: what an operator may want to go back to."""

UNSENT_KEPT = 50
"""Newest of those that were never sent: enough to see what is being refused, and why."""

_UNSENT = frozenset({MatrixState.REFUSED, MatrixState.DISCARDED})
_SPARE = frozenset({MatrixState.REJECTED, MatrixState.FAILED, MatrixState.SUPERSEDED})

_RESTARTED = {
    MatrixState.PUBLISHED: MatrixState.FAILED,
    MatrixState.STAGED: MatrixState.FAILED,
    MatrixState.PROPOSED: MatrixState.DISCARDED,
}


def restored(records: tuple[ReconstructorRecord, ...]) -> tuple[ReconstructorRecord, ...]:
    """Return what a restarted service takes over from its archive.

    Only its own: what the RTC brought is fetched anew, for nobody can say it is the same as last
    time. What was under way has failed; a proposal's verdict is of another day.
    """
    own = [record for record in records if record.parent is not None]
    taken_over = [
        replace(record, state=_RESTARTED[record.state], reason="the service restarted")
        if record.state in _RESTARTED
        else record
        for record in own
    ]
    return _thinned(taken_over, None)


def with_record(state: TrackerState, record: ReconstructorRecord) -> TrackerState:
    """Return the state with one more reconstructor; what is needed least gives way."""
    shelf = [*(r for r in state.reconstructors if r.id != record.id), record]
    return replace(state, reconstructors=_thinned(shelf, state.in_use))


def _thinned(
    shelf: list[ReconstructorRecord], in_use: str | None
) -> tuple[ReconstructorRecord, ...]:
    """Return as many as are kept, oldest first.

    First to go is what was never sent, however new what is worth going back to: a flood of
    proposals that nobody wants must not wash away the way back.
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


def with_changed(state: TrackerState, record: ReconstructorRecord) -> TrackerState:
    """Return the state with the record of the same id replaced."""
    return replace(
        state,
        reconstructors=tuple(record if r.id == record.id else r for r in state.reconstructors),
    )


def known_record(state: TrackerState, matrix_id: str) -> ReconstructorRecord:
    """Return the record of this id.

    Raises
    ------
    UnknownIdError
        If there is none.
    """
    record = state.reconstructor(matrix_id)
    if record is None:
        raise UnknownIdError(f"no reconstructor {matrix_id}")
    return record


def with_state(state: TrackerState, matrix_id: str, to: MatrixState, reason: str) -> TrackerState:
    """Return the state with one reconstructor further on its way."""
    return with_changed(state, replace(known_record(state, matrix_id), state=to, reason=reason))


def with_in_use(state: TrackerState, matrix_id: str) -> TrackerState:
    """Mark one reconstructor as applied; whichever was, has been superseded."""
    if state.in_use == matrix_id and known_record(state, matrix_id).state is MatrixState.APPLIED:
        return state
    for record in state.reconstructors:
        if record.id != matrix_id and record.state is MatrixState.APPLIED:
            state = with_state(state, record.id, MatrixState.SUPERSEDED, f"{matrix_id} is in use")
    state = with_state(state, matrix_id, MatrixState.APPLIED, known_record(state, matrix_id).reason)
    return replace(state, in_use=matrix_id, margin=None, assessment=None, judged_ns_utc=None)
