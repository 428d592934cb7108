"""Whether to believe a fit: what is asked of it, what to do when it fails, what to know besides.

The residual alone does not decide. Uneven light leaves a third of the signal although the
registration is right, and a wrong stop leaves a tenth although it is wrong. So sets of modes must
agree, no other minimum may be nearly as good, no other instrument may explain the matrix better,
and the gains must be those of one basis. Remarks say what was overruled, and what looks odd.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.fit.methods import Landing
from service.fit.models import CHEAP, FitModels, Other
from service.fit.reference import Target
from service.fit.solver import Nuisances, Solution, refine
from service.fit.uncertainty import Uncertainty
from service.model.instrument import Instrument
from service.model.kinds import SlopeOrder
from service.model.misregistration import BOUNDARY_SCALE, Misregistration

Array = NDArray[np.float64]

MOST_RESIDUAL = 0.55
"""RMS share of the signal left over, by which even strongly uneven light is exceeded."""

MOST_TENSION = 5.0
"""Distance of a set of modes from the others, in its own σ."""

MOST_SCATTER = 0.35
"""Robust relative scatter of the gains; modes of another basis scatter by more than this."""

LARGEST_SIGMA = np.array([0.3, 0.3, np.deg2rad(3.0), 0.06])
"""Less certain than this is not determined (numeric units)."""

LEAVES_ALPHA = 0.5
"""Another instrument that moves the registration by less, in σ, is told and refuses nothing."""

BETTER = 0.95
"""Another instrument is believed when it leaves less than this share of χ². On the diffractive
telescope the right stop has left 0.83 to 0.94 of what the wrong one does, noise included, from a
shift of 0.08 subaperture on; at no shift the two differ by less than 0.01."""

SUSPICIOUS = 0.008
"""RMS residual below which no other instrument need be asked: a wrong stop leaves as much at a
shift of 0.03 subaperture."""

MOST_MODES = 60
"""Modes, spread over those fitted, that are compared."""

OPPOSITE = -0.5
"""Correlation with its model below which a column has the wrong sign."""

ANOTHERS = 0.7
"""Correlation with another mode's model above which a column is that mode's."""

OWN = 0.35
"""... unless its own model explains more than this of it."""

_NAMED = 12
_PASSES = 0.12
"""By which gains are off a factor of two, and scatter, that is forgotten in all of them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """All that a verdict rests on."""

    solution: Solution
    residual_fraction: float
    uncertainty: Uncertainty
    landing: Landing | None
    """Where the starts led; None for methods that do not search."""

    others: tuple[Alternative, ...]
    """Other instruments, the one that explains the matrix best first."""

    axes: str
    """Why the orientation cannot be told; empty: it can."""

    passes: int
    """How often the light is said to have met the mirror."""

    stroke_known: bool


def judged(evidence: Evidence) -> tuple[bool, str]:
    """Return whether the registration is accepted, and the verdict in one line."""
    for refusal in (
        evidence.axes,
        _unsettled(evidence),
        _undetermined(evidence),
        _unexplained(evidence),
        _another_minimum(evidence),
        _another_instrument(evidence),
        _another_basis(evidence),
        _another_unit(evidence),
        _divided(evidence),
    ):
        if refusal:
            return False, f"refused: {refusal}"
    return True, f"accepted: {_quality(evidence)}"


def _quality(evidence: Evidence) -> str:
    shares = f"residual {evidence.residual_fraction:.1%} of the signal"
    if len(evidence.uncertainty.subset_steps) < 2:
        return f"{shares}; too few modes to split into sets that check each other"
    tension = evidence.uncertainty.subset_tension
    n_sets = len(evidence.uncertainty.subset_steps)
    return f"{n_sets} sets of modes agree within {tension:.1f} sigma, {shares}"


def _unsettled(evidence: Evidence) -> str:
    if evidence.solution.converged:
        return ""
    return (
        "the steps did not come to rest: the start is outside the capture range, or the instrument "
        "file is another's; start closer (--start), or leave the start out"
    )


def _undetermined(evidence: Evidence) -> str:
    sigma = np.sqrt(np.diag(evidence.uncertainty.covariance))
    if np.all(sigma < LARGEST_SIGMA):
        return ""
    shown = sigma * BOUNDARY_SCALE
    return (
        f"the modes do not determine the registration (1 sigma: {shown[0]:.2g} and {shown[1]:.2g} "
        f"subaperture, {shown[2]:.2g} deg, {shown[3]:.2g}); measure more modes, or with less noise"
    )


def _unexplained(evidence: Evidence) -> str:
    if evidence.residual_fraction <= MOST_RESIDUAL:
        return ""
    return (
        f"the model leaves {evidence.residual_fraction:.0%} of the signal unexplained, expected at "
        f"most {MOST_RESIDUAL:.0%}: too much noise, a false minimum (start closer), or another "
        "basis or instrument than the file's"
    )


def _another_minimum(evidence: Evidence) -> str:
    if evidence.landing is None or not evidence.landing.rivals:
        return ""
    rival = Misregistration.from_vector(evidence.landing.rivals[0].vector).to_boundary()
    return (
        f"another minimum is nearly as good: shift {rival['shift_x_subap']:.2f}, "
        f"{rival['shift_y_subap']:.2f} subaperture, {rival['rotation_deg']:.1f} deg, "
        f"{rival['magnification']:.3f}; give a start near the right one (--start) or more modes"
    )


def harmless(evidence: Evidence) -> tuple[Alternative, ...]:
    """Return instruments that explain the matrix better and leave the registration where it is."""
    return tuple(r for r in evidence.others if r.share < BETTER and _leaves_alpha(r, evidence))


def _another_instrument(evidence: Evidence) -> str:
    for rival in evidence.others:
        if rival.share < BETTER and not _leaves_alpha(rival, evidence):
            return (
                f"another instrument explains the matrix better: with {rival.change.words} the "
                f"misfit is {rival.share:.0%} of what it is now; correct the instrument file"
            )
    return ""


def _leaves_alpha(rival: Alternative, evidence: Evidence) -> bool:
    return rival.moved is not None and _distance(rival.moved, evidence) < LEAVES_ALPHA


def _distance(moved: Array, evidence: Evidence) -> float:
    """Return how far another instrument moves the registration, in σ of that parameter."""
    return float(np.max(np.abs(moved) / np.sqrt(np.diag(evidence.uncertainty.covariance))))


def _another_basis(evidence: Evidence) -> str:
    gains = evidence.solution.projection.gains
    middle = float(np.median(gains))
    scatter = float(np.median(np.abs(gains - middle)) / abs(middle)) * 1.4826
    negative = int(np.sum(gains <= 0.0))
    if negative == 0 and (scatter <= MOST_SCATTER or not evidence.stroke_known):
        return ""
    if negative:
        return (
            f"{negative} of {len(gains)} modes answer with the wrong sign: signs of single modes, "
            "or the basis, are another's"
        )
    return (
        f"the gains of the modes scatter by {scatter:.0%} about {middle:.3g}: the modes are scaled "
        'another way or are another basis; say stroke = "unknown" if only their shapes are known'
    )


def _another_unit(evidence: Evidence) -> str:
    if not evidence.stroke_known:
        return ""
    gains = evidence.solution.projection.gains
    middle = float(np.median(gains))
    if not 1e-3 < middle < 1e3:
        return (
            f"the measured slopes are {middle:.1e} times the model's: the matrix is in another "
            "unit than slope per metre of OPD (per nanometre would be 1e-09)"
        )
    factor = factor_of_passes(evidence)
    if factor is None or float(np.std(gains) / middle) >= _PASSES:
        return ""
    words = "twice" if factor > 1.0 else "half"
    cause = (
        "the matrix is per metre of the mirror's surface, which is half the OPD: divide it by two, "
        'or write modes_kind = "surface" where the modes were measured'
        if (evidence.passes, factor) == (2, 2.0)
        else f"the light met the mirror {'twice' if factor > 1.0 else 'once'}; set double_pass = "
        f"{'true' if factor > 1.0 else 'false'}, or correct the unit (surface for OPD)"
    )
    return f"the measured slopes are {words} the model's in every mode ({middle:.2f}): {cause}"


def factor_of_passes(evidence: Evidence) -> float | None:
    """Return 2 or 0.5 where gains, uniform or not, look like a forgotten factor; else None.

    Half the slopes after one pass are what the sky leaves of them.
    """
    middle = float(np.median(evidence.solution.projection.gains))
    if not evidence.stroke_known:
        return None
    for factor in (2.0,) if evidence.passes == 1 else (2.0, 0.5):
        if abs(middle / factor - 1.0) < _PASSES:
            return factor
    return None


def _divided(evidence: Evidence) -> str:
    tension = evidence.uncertainty.subset_tension
    if tension <= MOST_TENSION:
        return ""
    scatter = evidence.uncertainty.subset_scatter * BOUNDARY_SCALE
    return (
        f"sets of modes disagree by {tension:.1f} sigma (scatter {scatter[0]:.2g} and "
        f"{scatter[1]:.2g} subaperture, {scatter[2]:.2g} deg, {scatter[3]:.2g}): the stop, the "
        "modulation, the modes or the mask are not those of the instrument file"
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alternative:
    """Another instrument that the matrix might come from."""

    change: Other
    """What to write into the file."""

    share: float
    """χ² that it leaves, over what this one leaves."""

    moved: Array | None
    """``(4,)`` by how much the registration is another when it is fitted with it, numeric units;
    None: not asked, or the fit did not come to rest."""


def alternatives(
    models: FitModels, target: Target, solution: Solution, nuisances: Nuisances
) -> tuple[Alternative, ...]:
    """Return other instruments, the one that explains the matrix best first.

    Each is allowed its own registration, to first order about the one found.
    """
    n_modes = target.n_modes
    modes = np.unique(np.linspace(0, n_modes - 1, min(MOST_MODES, n_modes)).astype(np.intp))
    few, subset = target.column_subset(modes), models.basis.subset(modes)
    here = Misregistration.from_vector(solution.vector)
    # derivatives hardly depend on the hypothesis: those of the instrument as it is serve all
    derivatives = solution.derivatives[:, :, modes]

    def left(instrument: Instrument) -> float:
        models.counter.n += 1
        matrix = models.model(CHEAP, subset, instrument).interaction_matrix(here)
        seen = few.project(matrix, derivatives)
        score = seen.scores.sum(axis=1)
        return seen.chi - float(score @ np.linalg.solve(seen.normal, score))

    own = left(models.instrument)
    found = []
    for change, other in models.others.items():
        share, moved = left(other) / own, None
        if share < BETTER and not change.says_what_moves:
            its_own = replace(models, instrument=other)
            there = refine(its_own, target, solution.vector, nuisances)
            moved = there.vector - solution.vector if there.converged else None
        found.append(Alternative(change=change, share=share, moved=moved))
    return tuple(sorted(found, key=lambda one: one.share))


def remarks(
    evidence: Evidence, target: Target, *, told: SlopeOrder, found: SlopeOrder
) -> tuple[str, ...]:
    """Return what should be known, one sentence each.

    Parameters
    ----------
    evidence, target
        Of the fit.
    told, found
        Order of the slopes, as the instrument file says it and as the matrix lists them.
    """
    return (
        *_order(told, found),
        *_rival(evidence),
        *_passes(evidence),
        *_columns(evidence.solution, target),
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
    middle = float(np.median(evidence.solution.projection.gains))
    yield (
        f"the gains' median is {middle:.2f} with {passes}: "
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
