"""Invariants of the state after every step.

:data:`INVARIANTS` is the list; tests ask :func:`find_violations` after each step of theirs, of the
golden nights and of random nights. In operation nothing asks: what a violated invariant would need
there is an alarm, and :mod:`service.tracking.transitions` has that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from enum import StrEnum
from itertools import pairwise
from typing import Final

import numpy as np

from service.records.operations import DitherPurpose
from service.records.products import MatrixState
from service.records.state import TrackerState
from service.tracking.transitions import TABLES
from service.wire import Loop


def _repeated(ids: Iterable[str]) -> list[str]:
    return [one for one, n in Counter(ids).items() if n > 1]


def _applied(state: TrackerState) -> list[str]:
    return [r.id for r in state.matrices.reconstructors if r.state is MatrixState.APPLIED]


def _ids_are_unique(state: TrackerState) -> object:
    return (
        _repeated(r.id for r in state.matrices.reconstructors)
        + _repeated(r.id for r in state.references.records)
        + _repeated(r.id for r in state.operations.measurements)
        + _repeated(alarm.name for alarm in state.alarms.active)
    )


def _one_is_applied(state: TrackerState) -> object:
    return _applied(state)[1:]


def _used_is_applied(state: TrackerState) -> object:
    used = state.used
    return used and used.state not in {MatrixState.APPLIED, MatrixState.FAILED} and used.state


def _applied_is_used(state: TrackerState) -> object:
    used = state.matrices.in_use
    return used is not None and [one for one in _applied(state) if one != used]


def _references_in_use_are_applied(state: TrackerState) -> object:
    kept = state.references
    return [
        r.id for r in kept.records if (r.state is MatrixState.APPLIED) is not (r.id == kept.used_id)
    ]


def _one_measures(state: TrackerState) -> object:
    return [r.id for r in state.operations.measurements if r.under_way][1:]


def _one_has_the_mirror(state: TrackerState) -> object:
    return state.operations.acquisition.under_way and state.measuring


def _open_loop_is_not_dithered(state: TrackerState) -> object:
    rtc, dither = state.loop.rtc, state.dithers.dither
    if dither is None or rtc is None or dither.asked_ns_utc <= rtc.t_ns:
        return None
    if dither.purpose is DitherPurpose.ACQUIRE:
        return not state.operations.acquisition.under_way
    closed_only = dither.purpose.automatic or dither.purpose is DitherPurpose.NOISY
    return closed_only and rtc.loop is Loop.OPEN and dither


def _alpha_is_finite(state: TrackerState) -> object:
    known = state.alpha.registration
    if known is None:
        return None
    numbers = np.concatenate([known.alpha.vector, known.covariance.ravel(), known.grown])
    return not np.isfinite(numbers).all() or (np.diag(known.total_covariance) < 0.0).any()


def _is_in_order(state: TrackerState) -> object:
    return [later for before, later in pairwise(state.alpha.pointings) if later[0] < before[0]]


def _what_waits_can_go_on(state: TrackerState) -> object:
    operations = state.operations
    waiting: list[StrEnum] = [r.state for r in state.matrices.reconstructors if r.on_its_way]
    waiting += [r.state for r in state.references.records if r.on_its_way]
    waiting += [r.state for r in operations.measurements if r.under_way]
    waiting += [operations.acquisition.stage] if operations.acquisition.under_way else []
    if operations.probation is not None and operations.probation.under_way:
        waiting.append(operations.probation.state)
    return [one for one in waiting if not TABLES[type(one)][one]]


INVARIANTS: Final[dict[str, Callable[[TrackerState], object]]] = {
    "reconstructors, references, measurements and alarms have an id of their own": _ids_are_unique,
    "at most one matrix is applied": _one_is_applied,
    "the matrix in use is applied or, with other numbers, failed": _used_is_applied,
    "no matrix but the one in use is applied": _applied_is_used,
    "references are applied if, and only if, they are in use": _references_in_use_are_applied,
    "at most one interaction matrix is measured at a time": _one_measures,
    "an acquisition and a measurement by the RTC exclude each other": _one_has_the_mirror,
    "only an acquisition has the service dither an open loop": _open_loop_is_not_dithered,
    "α and its covariance are finite, and no variance is negative": _alpha_is_finite,
    "pointings are in the order of their time": _is_in_order,
    "nothing waits in a state from which no transition leads on": _what_waits_can_go_on,
}
"""Functions that return violations, or something empty, by the invariant in words."""


def find_violations(state: TrackerState) -> list[str]:
    """Return each invariant that is violated, with what violates it; empty if none is."""
    found = ((words, find(state)) for words, find in INVARIANTS.items())
    return [f"violated: {words}; found {violation}" for words, violation in found if violation]
