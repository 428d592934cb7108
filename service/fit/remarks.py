"""What should be known of a fit beside its verdict: what was overruled, and what looks odd."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from service.fit.joint import Solution
from service.fit.target import Target
from service.fit.verdict import Evidence, factor_of_passes, harmless
from service.model.slopes import SlopeOrder

Array = NDArray[np.float64]

OPPOSITE = -0.5
"""Correlation with its model below which a column has the wrong sign."""

ANOTHERS = 0.7
"""Correlation with another mode's model above which a column is that mode's."""

OWN = 0.35
"""... unless its own model explains more than this of it."""

_NAMED = 12


def remarks(
    evidence: Evidence, solution: Solution, target: Target, *, told: SlopeOrder, found: SlopeOrder
) -> tuple[str, ...]:
    """Return what should be known, one sentence each.

    Parameters
    ----------
    evidence, solution, target
        Of the fit.
    told, found
        Order of the slopes, as the instrument file says it and as the matrix lists them.
    """
    return (
        *_order(told, found),
        *_rival(evidence),
        *_passes(evidence),
        *_columns(solution, target),
    )


def _order(told: SlopeOrder, found: SlopeOrder) -> Iterator[str]:
    if told is not found:
        yield (
            f'the instrument file says order = "{told}", the matrix lists its slopes "{found}": '
            f'taken as found; write order = "{found}" into [slopes]'
        )


def _rival(evidence: Evidence) -> Iterator[str]:
    for rival in harmless(evidence):
        yield (
            f"with {rival.change.words} the misfit would be {rival.share:.0%} of what it is, the "
            "registration hardly another: look whether the instrument file is right"
        )


def _passes(evidence: Evidence) -> Iterator[str]:
    factor = factor_of_passes(evidence)
    if factor is None:
        return
    passes = f"double_pass = {str(evidence.passes == 2).lower()}"
    cause = {
        (1, 2.0): "double_pass = true if the light meets the mirror twice",
        (2, 2.0): 'per metre of surface? Then divide it by two, or write modes_kind = "surface"',
        (2, 0.5): "double_pass = false if the light meets the mirror once",
    }[evidence.passes, factor]
    yield (
        f"the gains' median is {float(np.median(evidence.gains)):.2f} with {passes}: "
        f"{'twice' if factor > 1.0 else 'half'} what was expected; {cause}"
    )


def _columns(solution: Solution, target: Target) -> Iterator[str]:
    """Yield which columns have the wrong sign, and which are other modes'."""
    measured = _unit(target.matrix[target.rows])
    alike = measured.T @ _unit(np.asarray(solution.matrix, dtype=np.float64)[target.rows])
    own = np.diag(alike)
    turned = target.modes[own < OPPOSITE]
    if len(turned):
        yield f"columns of the wrong sign: {_named(turned)}"
    likest = np.argmax(np.abs(alike), axis=1)
    columns = np.arange(len(own))
    strange = (np.abs(alike[columns, likest]) > ANOTHERS) & (np.abs(own) < OWN)
    exchanged, moved = [], []
    for column in np.flatnonzero(strange):
        other = likest[column]
        pair = target.modes[column], target.modes[other]
        if not (strange[other] and likest[other] == column):
            moved.append(f"{pair[0]} is mode {pair[1]}'s")
        elif column < other:
            exchanged.append(f"{pair[0]} and {pair[1]}")
    if exchanged:
        yield f"columns that have changed places: {_named(exchanged, '; ')}"
    if moved:
        yield f"columns that are another mode's: {_named(moved, '; ')}"


def _unit(columns: Array) -> Array:
    return np.asarray(columns / np.linalg.norm(columns, axis=0))


def _named(what: Sequence[object] | NDArray[np.intp], between: str = ", ") -> str:
    more = f" and {len(what) - _NAMED} more" if len(what) > _NAMED else ""
    return between.join(str(one) for one in what[:_NAMED]) + more
