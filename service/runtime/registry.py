"""The registry of estimators and detectors, one line each.

The order is that in which they are fed: what one marks in a block, those after it see.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.estimation.control_law import ControlLawCheck
from service.estimation.dither_monitor import MAX_AMPLITUDE_RATIO, DitherMeasurement, DitherWatch
from service.estimation.dither_windows import DitherWindows
from service.estimation.estimator import LoopContext, Streaming
from service.estimation.health import (
    EdgeHealth,
    LoopHealth,
    PlayedCommands,
    Standstill,
    VibrationMonitor,
)
from service.estimation.held_shape import MeanCommands
from service.estimation.loopcheck import LoopCheck
from service.estimation.passive import Passive
from service.estimation.probation import Comparison
from service.estimation.residual import Rejection
from service.records import alarms
from service.records import events as ev
from service.records.events import Event
from service.records.products import ReferencesRecord
from service.records.state import TrackerState
from service.tracking.dither import MISSING_DITHER_ALARM_S
from service.tracking.policy import SECOND_NS
from service.tracking.references import mean_gain

Array = NDArray[np.float64]

Changes = Callable[[Any, Any, LoopContext, TrackerState], list[Event]]
"""Returns the tracker's events of a detector, from its state before these blocks and after."""


def _dither(
    before: DitherWatch, watch: DitherWatch, loop: LoopContext, state: TrackerState
) -> list[Event]:
    """Return the event that a dither is missing, twice a second, or differs from its request."""
    found: list[Event] = []
    if loop.dither is None:
        return found
    silent_s = watch.silent_s
    if silent_s >= MISSING_DITHER_ALARM_S and int(2 * silent_s) > int(2 * before.silent_s):
        found.append(ev.DitherSilent(id=loop.dither.id, silent_s=silent_s))
    if watch.measurement is not None:
        found += _other_dither(loop.dither.id, watch.measurement, state)
        found += _report_response(watch.measurement, loop, state)
    return found


def _other_dither(
    dither_id: str, measurement: DitherMeasurement, state: TrackerState
) -> list[Event]:
    """Return a finding on the dither when it is new or over."""
    policy = state.dithers.policy
    raised = state.alarm(alarms.NOT_AS_ASKED) or state.alarm(alarms.OVER_BUDGET)
    louder = measurement.found_m > MAX_AMPLITUDE_RATIO * policy.mismatched_m
    news = policy.mismatched_id != dither_id or louder if measurement.text else raised
    if not news:
        return []
    return [
        ev.DitherMeasured(
            id=dither_id,
            found_m=measurement.found_m,
            asked_m=measurement.asked_m,
            text=measurement.text,
        )
    ]


def _report_response(
    measurement: DitherMeasurement, loop: LoopContext, state: TrackerState
) -> list[Event]:
    """Return that the slopes do not answer the dither, or do so again.

    Of an open loop, and of one that is being closed, the optical gain may be next to nothing.
    """
    found = measurement.unanswered
    raised = state.alarm(alarms.MIRROR_SILENT) is not None
    closed = len(loop.in_loop) > 0 and not state.operations.acquisition.under_way
    if found is None or not closed or not (found or raised):
        return []
    text, t_ns = found or "the slopes answer the dither again", loop.received_ns_utc
    return [
        ev.ConditionChanged(name=alarms.MIRROR_SILENT, text=text, over=not found, t_ns_utc=t_ns)
    ]


def _vibrations(
    _: VibrationMonitor, monitor: VibrationMonitor, loop: LoopContext, state: TrackerState
) -> list[Event]:
    lines = monitor.lines_hz
    return [] if lines == state.loop.vibrations_hz else [ev.Vibrations(lines_hz=lines)]


def _held(_: Rejection, now: Rejection, loop: LoopContext, state: TrackerState) -> list[Event]:
    holds = now.holds
    return [] if holds is None or holds is state.loop.holds else [ev.LoopHeld(holds=holds)]


def _report_opposite(
    before: LoopCheck, now: LoopCheck, loop: LoopContext, state: TrackerState
) -> list[Event]:
    opposite = now.opposite_id
    return [] if opposite in {None, before.opposite_id} else [ev.MatrixMisapplied(id=opposite)]


def _report_comparison(
    _: Comparison, now: Comparison, loop: LoopContext, state: TrackerState
) -> list[Event]:
    judged, trial = now.found, state.operations.probation
    awaited = trial is not None and judged is not None and trial.awaits(judged.before, judged.after)
    return [ev.Compared(finding=judged)] if judged is not None and awaited else []


MAX_DEPARTURE = 0.5
"""Largest relative difference between a former shape and what the mirror held of it. With more,
the former references are not compared."""


def _report_held(
    before: MeanCommands, now: MeanCommands, loop: LoopContext, state: TrackerState
) -> list[Event]:
    """Return how much of the shape of new references the mirror holds."""
    record = state.references_of(now.name)
    if record is None or not now.is_due(before):
        return []
    shapes_m: dict[str, Array] = {}
    for name in (now.name, *dict(now.before)):
        one = state.references_of(name)
        shape_m = shapes_m[name] = np.zeros(loop.description.n_modes)
        if one is not None:
            shape_m[: len(one.coefficients_m)] = one.coefficients_m
            held = (one.held_ratio or 1.0, _expect_ratio(one, state))
            if name != now.name and max(abs(ratio - 1.0) for ratio in held) > MAX_DEPARTURE:
                del shapes_m[name]
    found = now.measure(shapes_m, _expect_ratio(record, state))
    if found is None:
        return []
    began_ns = loop.received_ns_utc - round(now.duration_s * SECOND_NS)
    return [ev.ShapeHeld(id=record.id, began_ns_utc=began_ns, **found._asdict())]


def _expect_ratio(record: ReferencesRecord, state: TrackerState) -> float:
    """Return how much of its shape a loop holds by references for another gain than today's."""
    registration = state.alpha.registration
    if registration is None or not registration.optical_gains or not record.gain:
        return 1.0
    return record.gain / mean_gain(record.coefficients_m, registration.optical_gains)


@dataclass(frozen=True, slots=True)
class Entry:
    """One estimator or detector."""

    kind: type[Streaming]
    alarms: Mapping[str, str] = field(default_factory=dict)
    """Alarms of its conditions, in their order, with the text for the end of each."""

    events: Changes | None = None
    """Returns its other events."""

    def conditions(self, member: Streaming) -> list[tuple[str, str | None, str]]:
        """Return name, text (None: all is well) and its text when it is over, of each alarm."""
        found = zip(self.alarms.items(), member.conditions, strict=True)
        return [(name, text, over) for (name, over), text in found]


_IN_METRES = "commands are what a mirror can play"

REGISTRY: Final = (
    Entry(Standstill, {alarms.SLOPES_STAND: "the slopes change again"}),
    Entry(DitherWatch, events=_dither),
    Entry(VibrationMonitor, events=_vibrations),
    Entry(
        LoopHealth,
        {
            alarms.WRONG_UNIT: _IN_METRES,
            alarms.DIVERGING: "the high modes are calm",
            alarms.LOST: "the high modes are calm",
        },
    ),
    Entry(ControlLawCheck, {alarms.WRONG_LOOP: "the loop follows its status again"}),
    Entry(EdgeHealth, {alarms.EDGE_SLIP: "the outer ring is back"}),
    Entry(PlayedCommands, {alarms.NOT_PLAYED: "the slopes answer the commands again"}),
    Entry(LoopCheck, {alarms.OFF_LOOP: "commands obey the loop equation again"}, _report_opposite),
    Entry(Rejection, events=_held),
    Entry(Comparison, events=_report_comparison),
    Entry(MeanCommands, events=_report_held),
    Entry(Passive),
    Entry(DitherWindows),
)
