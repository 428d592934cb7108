"""From a start, or from many, to the one minimum that explains the matrix."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from service.fit.bench import Bench
from service.fit.joint import Approach, Solution, approach, refine, stand
from service.fit.nuisance import Nuisances
from service.fit.target import Target
from service.model.misregistration import Misregistration

Array = NDArray[np.float64]

GOOD = 0.10
"""Share of χ² that even uneven light and another mirror leave to the smooth shapes; a false
minimum leaves several times as much."""

SAME = np.array([0.15, 0.15, np.deg2rad(0.5), 0.01])
"""Minima nearer than this are one (numeric units)."""

NEARLY_AS_GOOD = 1.3
"""A minimum with less than this times the least misfit is a rival."""

_SHIFTS = (-1.3, 1.3)
_TURNS_RAD = np.deg2rad([-6.0, 6.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landing:
    """Where the starts led."""

    best: Approach
    rivals: tuple[Approach, ...]
    """Other minima nearly as good."""

    n_starts: int


def land(bench: Bench, target: Target, start: Array) -> Landing:
    """Return where a start leads; if that explains little, where the best of many leads."""
    low = bench.lowest.target(target)
    first = approach(bench.far, low, start, bench.counter)
    if first.converged and first.misfit < GOOD:
        return Landing(best=first, rivals=(), n_starts=1)
    found = [first]
    for other in _other_starts(start):
        found.append(approach(bench.far, low, other, bench.counter))
        if found[-1].converged and found[-1].misfit < GOOD:
            break
    best = min(found, key=lambda one: (not one.converged, one.misfit))
    rivals = [
        one
        for one in found
        if one.converged
        and one.misfit < NEARLY_AS_GOOD * best.misfit
        and np.any(np.abs(one.vector - best.vector) > SAME)
    ]
    return Landing(best=best, rivals=tuple(rivals), n_starts=len(found))


def settle(
    bench: Bench, target: Target, start: Array, nuisances: Nuisances
) -> tuple[Solution, Target]:
    """Return the minimum on the fine grid, and the target without slopes of unknown surface.

    A table of modes ends somewhere, and where depends on the registration: the slopes near its
    edge are left out, and the fit is done again if that changed anything.
    """
    unknown = bench.fine.unknown_rows(Misregistration.from_vector(start))
    seen = target.without(unknown)
    solution = refine(bench.fine, bench.cheap, seen, start, nuisances, bench.counter)
    there = bench.fine.unknown_rows(Misregistration.from_vector(solution.vector))
    if np.array_equal(there, unknown):
        return solution, seen
    seen = target.without(there)
    again = refine(bench.fine, bench.cheap, seen, solution.vector, nuisances, bench.counter)
    return again, seen


def settle_at(
    bench: Bench, target: Target, vector: Array, nuisances: Nuisances
) -> tuple[Solution, Target]:
    """Return the model as it stands at a registration that another method has found."""
    seen = target.without(bench.fine.unknown_rows(Misregistration.from_vector(vector)))
    return stand(bench.fine, bench.cheap, seen, vector, nuisances, bench.counter), seen


def _other_starts(start: Array) -> list[Array]:
    """Return starts about one that led nowhere: corners of the range, and turns."""
    corners = [np.array([x, y, 0.0, 0.0]) for x, y in product(_SHIFTS, _SHIFTS)]
    turns = [np.array([0.0, 0.0, turn, 0.0]) for turn in _TURNS_RAD]
    nominal = np.array([0.0, 0.0, start[2], 1.0])
    return [nominal, *(nominal + step for step in [*turns, *corners])]
