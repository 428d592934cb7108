"""Diagrams and tables of the declared transitions, for docs/developer/tracker.md.

Both come from ``service.tracking.transitions``; ``python -m pyrcal_studies.pages`` writes them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from html import escape
from typing import Final

from pyrcal.instruments.schema_texts import described
from service.records.operations import AcquisitionStage, MeasureState, ProbationState
from service.records.products import MatrixState
from service.tracking.transitions import TABLES

_BOX_WIDTH, _BOX_HEIGHT, _ROW = 130, 28, 58
_LANE = 15
"""Distance of two arrows that are side by side, pixels."""

_FORWARD, _BACK = "#2166ac", "#b2502f"


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """One kind of state, and what an operator sees of each of its states."""

    title: str
    picture: str
    """File in docs/developer."""

    states: type[StrEnum]
    first: tuple[StrEnum, ...]
    """States of a new record."""

    seen: dict[StrEnum, str]
    """What page, ``pyrcal status`` and ``GET /v1/state`` show in each state."""


MACHINES: Final = (
    Machine(
        title="A reconstructor",
        picture="states-reconstructor.svg",
        states=MatrixState,
        first=(MatrixState.PROPOSED, MatrixState.REFUSED, MatrixState.APPLIED),
        seen={
            MatrixState.REFUSED: "its row with the gate's reason; a warning in the log",
            MatrixState.PROPOSED: "buttons Approve and Reject, and what it is expected to gain",
            MatrixState.DISCARDED: "its row, with who or what replaced it",
            MatrixState.PUBLISHED: "“is on its way to the RTC; wait for it”; other orders wait",
            MatrixState.STAGED: "the same: the RTC has it and has not swapped yet",
            MatrixState.APPLIED: "the id as matrix in use, with its margin; a probation begins",
            MatrixState.SUPERSEDED: "its row; `pyrcal reconstructors rollback` can return to it",
            MatrixState.REJECTED: "its row with the RTC's reason; a warning in the log",
            MatrixState.FAILED: "its row with the reason; alarm `no-acknowledgement`, "
            "`wrong-matrix` or `probation`",
        },
    ),
    Machine(
        title="An acquisition",
        picture="states-acquisition.svg",
        states=AcquisitionStage,
        first=(AcquisitionStage.IDLE,),
        seen={
            AcquisitionStage.IDLE: "nothing",
            AcquisitionStage.OPENING: "operation Acquiring, “opening the loop” and the reason",
            AcquisitionStage.COARSE: "operation Acquiring; the loop is open",
            AcquisitionStage.CONFIRMING: "the α that was found with its σ; the loop is open",
            AcquisitionStage.PARTIAL: "the α that was confirmed; a matrix is made and sent",
            AcquisitionStage.WIDENING: "the loop is closed; the number of modes grows",
            AcquisitionStage.TRACKING: "“tracking after N s” and the number of modes",
            AcquisitionStage.FAILED: "alarm `acquisition` with reason and remedy",
            AcquisitionStage.ABORTED: "who ended it, and how the loop was left",
            AcquisitionStage.INTERRUPTED: "alarm `acquisition`: what it waits for",
        },
    ),
    Machine(
        title="The probation of a reconstructor",
        picture="states-probation.svg",
        states=ProbationState,
        first=(ProbationState.RUNNING, ProbationState.NOT_JUDGED),
        seen={
            ProbationState.RUNNING: "“compared with” the matrix before",
            ProbationState.OVERDUE: "“telemetry is late”; other matrices may be sent",
            ProbationState.PASSED: "the ratio of the residuals after and before",
            ProbationState.ROLLING_BACK: "alarm `probation`; mode hold",
            ProbationState.WATCHED: "alarm `probation`; the matrix before under its new id",
            ProbationState.ROLLED_BACK: "alarm `probation`; mode hold until an operator sets one",
            ProbationState.KEPT: "alarm `probation`: why there was no way back, and what to do",
            ProbationState.OPENING: "alarm `loop-opened`: the RTC is asked to open the loop",
            ProbationState.OPENED: "alarm `loop-opened`; the loop is open",
            ProbationState.ACQUIRING: "an acquisition begins; the earlier mode returns",
            ProbationState.NOT_CONFIRMED: "the swap was not the cause; the earlier mode returns",
            ProbationState.NOT_JUDGED: "why nothing could be compared",
        },
    ),
    Machine(
        title="A measured interaction matrix",
        picture="states-measurement.svg",
        states=MeasureState,
        first=(
            MeasureState.WAITING,
            MeasureState.ASKED,
            MeasureState.STORED,
            MeasureState.FAILED,
        ),
        seen={
            MeasureState.WAITING: "operation Measuring; the service's dither is being stopped",
            MeasureState.ASKED: "operation Measuring; the RTC has not answered",
            MeasureState.RUNNING: "operation Measuring; the first frame with a stroke",
            MeasureState.FINISHING: "operation Measuring; the matrix is being fitted",
            MeasureState.REFUSED: "its row with the RTC's reason; a warning in the log",
            MeasureState.FAILED: "its row with the reason; a warning in the log",
            MeasureState.STORED: "its row; `pyrcal measurements` lists it for export and fit",
            MeasureState.GIVEN_UP: "its row; a loop that it opened is closed again",
        },
    ),
)


def sections() -> Iterator[str]:
    """Yield the paragraphs of the four machines: diagram, then a line for each state."""
    yield "## States and their transitions"
    yield (
        "From `service/tracking/transitions.py`. A transition that is not drawn is not made: it is "
        "logged with both states and the cause, and raises `undeclared-transition`. Blue arrows "
        "lead on, red ones back; a thick frame marks the states of a new record."
    )
    for machine in MACHINES:
        yield f"### {machine.title}"
        yield f"![Diagram: {machine.title.lower()}, its states and transitions]({machine.picture})"
        texts = described(machine.states)
        rows = [
            f"| `{state}` | {texts[state.name]} | {machine.seen[state]} |"
            for state in machine.states
        ]
        yield "\n".join(
            ("| State | Meaning | What an operator sees |", "| --- | --- | --- |", *rows)
        )


def draw(machine: Machine) -> str:
    """Return the diagram of a machine as SVG: its states below each other, arrows at the sides."""
    table = TABLES[machine.states]
    order = list(machine.states)
    arrows = [(order.index(start), order.index(end)) for start in order for end in table[start]]
    right = _lanes([arrow for arrow in arrows if arrow[1] > arrow[0]])
    left = _lanes([arrow for arrow in arrows if arrow[1] < arrow[0]])
    margin = _LANE * (max(left.values(), default=0) + 2)
    width = margin + _BOX_WIDTH + _LANE * (max(right.values(), default=0) + 2)
    height = _ROW * len(order) + 10
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" font-family="sans-serif">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for lanes, side, colour in ((right, 1, _FORWARD), (left, -1, _BACK)):
        edge = margin + (_BOX_WIDTH if side > 0 else 0)
        for (start, end), lane in lanes.items():
            parts += _arrow(edge, side, lane, (start, end), colour)
    for k, state in enumerate(order):
        stroke = 2.6 if state in machine.first else 1
        y = _ROW * k + 15
        parts += [
            f'<rect x="{margin}" y="{y}" width="{_BOX_WIDTH}" height="{_BOX_HEIGHT}" rx="6" '
            f'fill="#eef3f8" stroke="#1d2433" stroke-width="{stroke}"/>',
            f'<text x="{margin + _BOX_WIDTH // 2}" y="{y + 19}" font-size="14" fill="#1d2433" '
            f'text-anchor="middle">{escape(state)}</text>',
        ]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _lanes(arrows: list[tuple[int, int]]) -> dict[tuple[int, int], int]:
    """Return a lane for each arrow, short arrows inside: no two arrows share a piece of a lane."""
    lanes: dict[tuple[int, int], int] = {}
    for arrow in sorted(arrows, key=lambda one: (abs(one[1] - one[0]), one)):
        taken = {
            lane
            for other, lane in lanes.items()
            if max(min(other), min(arrow)) < min(max(other), max(arrow))
        }
        lanes[arrow] = next(k for k in range(len(arrows)) if k not in taken)
    return lanes


def _arrow(edge: int, side: int, lane: int, ends: tuple[int, int], colour: str) -> Iterator[str]:
    """Yield an arrow from the lower part of a box's side to the upper part of another's."""
    start, end = ends
    # Arrows that leave a box are apart from those that arrive at it.
    leave, arrive = (21, 7) if side > 0 else (7, 21)
    y1, y2 = _ROW * start + 15 + leave, _ROW * end + 15 + arrive
    x = edge + side * _LANE * (lane + 1)
    tip = edge + side * 6
    yield (
        f'<path d="M{edge},{y1} H{x} V{y2} H{tip}" fill="none" stroke="{colour}" '
        'stroke-width="1.3" stroke-linejoin="round"/>'
    )
    yield f'<path d="M{edge},{y2} l{8 * side},-4 v8 z" fill="{colour}"/>'
