"""One sentence on what to do with a fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.alternatives import Alternative, moved_words, preference
from pyrcal.offline.fitted import Fit
from pyrcal.offline.left_over import left_over
from pyrcal.offline.verdict import CANNOT_TELL, MOST_STRUCTURE, Refusal

Array = NDArray[np.float64]

ENOUGH_SUBAP = 0.03
"""1 σ of where the mirror is seen at the pupil's edge: three of them are the tenth of a subaperture
beyond which a loop begins to suffer (Heritier et al. 2018, section 3)."""

FEWEST_SETS = 2
"""Sets of modes that can check each other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grounds:
    """What a recommendation rests on beside the fit's own numbers."""

    refusal: Refusal | None
    """Why it was refused; None: it was accepted."""

    structure: float
    """RMS share of the signal that is left over and is no noise."""

    n_sets: int
    """Disjoint sets of modes that were fitted alone."""

    columns: tuple[str, ...] = ()
    """What is wrong with columns: signs, places."""

    gains: tuple[str, ...] = ()
    """Causes of gains that are far from 1."""


class Advice(StrEnum):
    """What to do with a fit."""

    USE = "use it"
    MEASURE_MORE = "measure more"
    DO_NOT_USE = "do not use it"


def explained(fit: Fit, tried: tuple[Alternative, ...], grounds: Grounds) -> Fit:
    """Return a fit with what else was tried, what stands out, and what to do with it."""
    preferred = (
        preference(one, fit.sigma)
        for one in tried
        if one.preferred and one.words not in fit.verdict
    )
    said = (*fit.remarks, *grounds.gains, *preferred)
    size = np.linalg.norm(np.asarray(fit.measured, dtype=np.float64), axis=0)
    left = left_over(
        fit.residual_map, fit.residual_by_mode, valid=fit.valid, modes=fit.modes, size=size
    )
    fit = replace(fit, alternatives=tried, remarks=said, left_over=left)
    return replace(fit, recommendation=recommendation(fit, grounds))


def with_displaced(fit: Fit, columns: tuple[str, ...]) -> Fit:
    """Return a refused fit with the cause that all its columns stand elsewhere."""
    if not columns:
        return fit
    advised = f"{Advice.DO_NOT_USE}: {columns[0]}"
    return replace(fit, remarks=(*fit.remarks, *columns), recommendation=advised)


def recommendation(fit: Fit, grounds: Grounds) -> str:
    """Return what to do with a fit, in one sentence, and why."""
    if grounds.refusal is not None:
        return _of_refused(fit, grounds)
    radius = _radius(fit)
    edge = float(_at_edge(fit.sigma, radius))
    if edge > ENOUGH_SUBAP:
        return (
            f"{Advice.MEASURE_MORE}: at the pupil's edge the mirror is known to {edge:.3f} "
            f"subapertures (1 sigma), {ENOUGH_SUBAP:g} is enough; average more, or push more modes"
        )
    for other in fit.alternatives:
        if other.undecided and _at_edge(other.moved, radius) > ENOUGH_SUBAP:
            return (
                f"{Advice.MEASURE_MORE}: the matrix cannot tell {other.words} from what the file "
                f"says, which would move {moved_words(other.moved)}; push more modes"
            )
    if grounds.n_sets < FEWEST_SETS:
        return (
            f"{Advice.MEASURE_MORE}: too few modes ({len(fit.modes)}) to check each other; push "
            "six or more"
        )
    if grounds.columns:
        return f"{Advice.USE} for the registration alone: {'; '.join(grounds.columns)}"
    known = f"the mirror is known to {edge:.2g} subapertures at the pupil's edge (1 sigma)"
    corrections = ", ".join(_corrections(fit))
    if corrections:
        return f"{Advice.USE}, and correct the instrument file ({corrections}): {known}"
    return f"{Advice.USE}: {known}"


def _of_refused(fit: Fit, grounds: Grounds) -> str:
    match grounds.refusal:
        case Refusal.UNDETERMINED:
            return f"{Advice.MEASURE_MORE}: the modes do not determine the registration"
        case Refusal.ANOTHER_MINIMUM:
            return (
                f"{Advice.MEASURE_MORE}: two registrations explain the matrix nearly as well; push "
                "more modes, or say where the mirror is (--start)"
            )
        case Refusal.UNEXPLAINED if grounds.structure <= MOST_STRUCTURE:
            return (
                f"{Advice.MEASURE_MORE}: {fit.residual_fraction:.0%} of the signal is noise; "
                "average more, or push further"
            )
    return f"{Advice.DO_NOT_USE}: {_cause(fit, grounds)}"


def _cause(fit: Fit, grounds: Grounds) -> str:
    """Return the likeliest cause of a refusal: what is more definite than the verdict first."""
    if grounds.refusal in {Refusal.ANOTHER_BASIS, Refusal.ANOTHER_UNIT} and grounds.gains:
        return grounds.gains[0]
    if grounds.columns and grounds.refusal is not Refusal.AXES:
        return "; ".join(grounds.columns)
    best = next((one for one in fit.alternatives if one.preferred and one.share is not None), None)
    if best is not None and grounds.refusal in {Refusal.ANOTHER_INSTRUMENT, Refusal.NO_CAUSE}:
        if CANNOT_TELL in fit.verdict:
            return fit.verdict.rpartition("better: ")[2]
        return (
            f"with {best.words} the misfit is {best.share:.0%} of what it is; correct that and fit "
            "again"
        )
    left = fit.left_over
    if grounds.refusal is Refusal.NO_CAUSE and left is not None and left.subapertures:
        return left.words
    if grounds.refusal is Refusal.DIVIDED and left is not None and left.modes:
        return f"{left.words}; measure these again, or leave them out (--modes)"
    return fit.verdict.removeprefix("refused: ").partition(";")[0]


def _corrections(fit: Fit) -> Iterator[str]:
    """Yield what the matrix says of the instrument file, as the file would write it."""
    for one in fit.origins:
        if one.correct:
            yield f"{one.key} = {one.found}"


def _radius(fit: Fit) -> float:
    """Return the radius of the pupil, in subapertures."""
    return float(np.sqrt(fit.valid.sum() / np.pi))


def _at_edge(step: Array, radius: float) -> float:
    """Return how far a step of α moves what is seen at the pupil's edge, subapertures."""
    return float(np.sqrt(np.max(step[:2] ** 2) + radius**2 * np.sum(step[2:] ** 2)))
