"""Declared transitions: which states of a record may follow which.

The tables are the only place that says so. A transition that they do not contain is logged with
both states and the cause, raises an alarm and is not made, and the service goes on. An RTC may
report anything: what receives its reports asks :func:`is_declared` first.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final, TypeVar

from service.records import alarms
from service.records.operations import (
    Acquisition,
    AcquisitionStage,
    MeasurementRecord,
    MeasureState,
    Probation,
    ProbationState,
)
from service.records.products import MatrixState, ReconstructorRecord, ReferencesRecord
from service.tracking.step_context import StepContext

Record = Acquisition | MeasurementRecord | Probation | ReconstructorRecord | ReferencesRecord
RecordT = TypeVar("RecordT", bound=Record)


def _read(kind: type[StrEnum], text: str) -> dict[StrEnum, tuple[StrEnum, ...]]:
    """Return the states that may follow each state from lines ``state: states after it``."""
    lines = (line.partition(":") for line in text.split("\n") if line)
    return {kind(state): tuple(map(kind, after.split())) for state, _, after in lines}


_LINES: Final[dict[type[StrEnum], str]] = {
    # The RTC alone says which matrix multiplies its slopes, and with which numbers: it may name
    # any as applied, and any may be found to have failed. Its answer may come late.
    MatrixState: """
proposed: published refused discarded applied failed
published: staged rejected applied failed
staged: rejected applied failed
applied: superseded failed
superseded: applied failed
failed: applied rejected
rejected: applied failed
refused: applied failed
discarded: applied failed
""",
    AcquisitionStage: """
idle: opening
opening: coarse failed aborted interrupted
coarse: confirming opening failed aborted interrupted
confirming: partial opening failed aborted interrupted
partial: widening opening failed aborted interrupted
widening: tracking opening failed aborted interrupted
tracking: opening
failed: idle opening
aborted: idle opening
interrupted: opening failed aborted
""",
    # An alarm soon after a good verdict still takes the matrix back; the copy of the matrix before
    # may be applied after it was given up.
    ProbationState: """
running: overdue passed not-judged rolling-back kept opening
overdue: passed not-judged rolling-back kept opening
passed: rolling-back kept opening
rolling-back: watched kept opening
watched: rolled-back not-confirmed acquiring opening kept not-judged
kept: watched
opening: opened kept
opened: rolled-back
acquiring: not-confirmed
rolled-back:
not-confirmed:
not-judged:
""",
    # A matrix that comes although it was refused, or not in time, is kept.
    MeasureState: """
waiting: asked failed given-up
asked: running refused stored failed given-up
running: finishing stored failed given-up
finishing: stored failed given-up
refused: stored
failed: stored
stored:
given-up:
""",
}

TABLES: Final = {kind: _read(kind, text) for kind, text in _LINES.items()}
"""States that may follow each state, by the kind of state. A record may always stay in its state;
values of different kinds may be equal, such as ``failed``."""


def is_declared(before: StrEnum, after: StrEnum) -> bool:
    """Return whether a record may go from one state to another, or stay in it."""
    return after is before or after in TABLES[type(before)][before]


def move(context: StepContext, before: RecordT | None, after: RecordT) -> RecordT:
    """Return a record in its new state, or as it was if that transition is not declared.

    A record without one before it is returned as it is.
    """
    if before is None or is_declared(_state_of(before), _state_of(after)):
        return after
    report_undeclared(context, before, _state_of(after))
    return before


def report_undeclared(context: StepContext, record: Record, to: StrEnum) -> None:
    """Log a transition that was not made, and raise its alarm."""
    text = (
        f"{_name_of(record)} is {_state_of(record)} and was to become {to}, which no table "
        f"declares: it stays {_state_of(record)}. The cause is {context.cause or 'unknown'}"
    )
    context.warn("transition.undeclared", text)
    context.raise_alarm(alarms.UNDECLARED, text)


def _state_of(record: Record) -> StrEnum:
    return record.stage if isinstance(record, Acquisition) else record.state


def _name_of(record: Record) -> str:
    if isinstance(record, Acquisition):
        return "the acquisition"
    return f"the probation of {record.id}" if isinstance(record, Probation) else record.id
