"""Other explanations of a matrix: the record, and the comparison with a fit on a few modes."""

from __future__ import annotations

import operator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.disjoint_sets import SIGNIFICANT
from pyrcal.fitting.methods import Settled, spread
from pyrcal.fitting.models import FitModels
from pyrcal.fitting.solver import nuisances_of, pupil_regions, refine
from service.estimation.solver import Projection
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.sensors.registry import kind_of

Array = NDArray[np.float64]

OTHER_SHARE = 0.5
"""Probability of an instrument that explains a matrix as well as the file's."""

MIN_EXPLAINED = 0.01
"""RMS share of the signal that another instrument must explain to be preferred. Models of one
instrument differ by about as much: with HCIPy's lenslets 1.0 % is left over, and another stop
explains 0.7 % by coincidence with model errors."""

EXCLUSION_SIGMA = 3.0
"""Number of σ by which an alternative must be worse to be excluded."""

EXCLUSION_RATIO = 10.0
"""χ² over that of the fit above which an alternative is excluded whatever its scatter. Misfit that
is concentrated in a few modes or at one side scatters as much as it grows: Gaussian influence
functions left 94 times the χ² of a matrix of HCIPy, and with 2.9 σ they made σ ten times wider."""

OFFSET_STEP_SUBAP = 0.05
"""Step of the pupil offset for the finite difference that approximates its derivative."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alternative:
    """Another explanation of the matrix than the fit, or another weighting of it.

    A trial (``pyrcal.fitting.alternatives.TRIALS``) yields one with its misfit and the change of
    the registration; :meth:`FitSubset.judge` says whether the matrix prefers it.
    """

    words: str = ""
    """Description of the change, in the notation of the instrument file if it has a key."""

    key: str = ""
    """Entry for the instrument file, or option of the command; empty if there is none."""

    share: float | None
    """χ² that it leaves over that of the fit, to first order; None if weights or modes differ, so
    that the two are not comparable."""

    share_sigma: float = 0.0
    """1 σ of that share, from its scatter between modes and between regions of the pupil."""

    moved: Array
    """``(4,)`` change of the registration, numeric units."""

    max_share: float = 0.0
    """Share below which it is preferred; 0 if it never is."""

    preferred: bool = False
    """True if it explains the matrix better, by χ²."""

    undecided: bool = False
    """True if the matrix does not distinguish it from the fit."""

    counts: bool = False
    """True if its change of α is an error of the registration until it is excluded; False for other
    weights and sets of modes."""

    is_number: bool = False
    """True if it is a number at its best-fitting value, for which the fit has another value."""

    is_instrument: bool = False
    """True if it is another instrument: the fit is refused where it is preferred and moves the
    registration."""

    @property
    def misfit(self) -> float:
        """Its ``share``; infinite if it is not comparable with the fit."""
        return np.inf if self.share is None else self.share

    @property
    def significance(self) -> float:
        """Number of σ by which it is better than the fit; negative if it is worse."""
        gained = 1.0 - self.misfit
        if self.share_sigma > 0.0:
            return gained / self.share_sigma
        return float(np.copysign(np.inf, gained)) if gained else 0.0

    @property
    def is_open(self) -> bool:
        """True if it is not excluded: it is not significantly worse."""
        return self.misfit < EXCLUSION_RATIO and self.significance > -EXCLUSION_SIGMA

    def explained(self, residual_fraction: float) -> float:
        """Return the RMS share of the signal that it explains and the fit does not."""
        return residual_fraction * float(np.sqrt(max(1.0 - self.misfit, 0.0)))

    def weight(self, residual_fraction: float) -> float:
        """Return the weight of the square of its change of α in σ, 0 to 1.

        An explanation that the matrix prefers counts in full, one that is not excluded by its
        probability, which is smaller the larger its misfit is. Models of one instrument differ by
        ``MIN_EXPLAINED`` of the signal, and any additional fitted number explains some of that by
        coincidence: smaller improvements are no evidence for it.
        """
        if not self.counts or not (self.preferred or self.undecided):
            return 0.0
        explained = self.explained(residual_fraction) if self.is_number else residual_fraction
        probability = 1.0 if self.preferred else OTHER_SHARE / max(self.misfit, 1.0) ** 2
        return probability * min(1.0, explained / MIN_EXPLAINED) ** 2


class FitSubset:
    """A subset of a fit's modes at its solution, on the coarse grid."""

    def __init__(self, settled: Settled) -> None:
        self.settled, solution, self.models = settled, settled.solution, settled.models
        self.residual_fraction = settled.share
        self.modes = spread(settled.target.n_modes)
        self.target = settled.target.column_subset(self.modes)
        self.here = solution.alpha
        self._images = settled.nuisances.images
        self.derivatives = solution.derivatives[:, :, self.modes]
        """Derivatives of the unchanged instrument; they hardly depend on the alternative."""

        self._last: tuple[tuple[Array, ...], Projection] | None = None

    @cached_property
    def model(self) -> InteractionModel:
        """Model of the unchanged instrument with these modes only."""
        return self.models.cheap.of_modes(self.models.basis.subset(self.modes))

    @cached_property
    def own(self) -> Array:
        """D of the unchanged instrument, ``(n_slopes, n_few)``."""
        return self._at_solution(self.model)

    @property
    def has_free_pupil(self) -> bool:
        """True if a displacement of the pupil is among the unknowns, by its images together."""
        return bool(np.any(self._images.reshape(-1, 2, 4).sum(axis=2)))

    @cached_property
    def pupil_rates(self) -> Array:
        """``(2, n_slopes, n_few)`` derivatives of D by the pupil's position, the mirror unmoved."""
        about = self.models.instrument
        if about.stop is Stop.MIRROR:  # the pupil is displaced together with the mirror
            return np.asarray(self.derivatives[:2] - self.model.mirror_shift_derivatives(self.here))
        known = about.pupil_shift_subap or kind_of(about).pupil_offset(about)
        place, rates = np.array(known or (0.0, 0.0)), []
        for step in np.eye(2) * OFFSET_STEP_SUBAP:
            displaced = replace(about, pupil_shift_subap=tuple(place + step))
            rates.append((self.matrix_of(displaced) - self.own) / OFFSET_STEP_SUBAP)
        return np.array(rates)

    def matrix_of(self, about: Instrument) -> Array:
        """Return D of another instrument with the same modes, ``(n_slopes, n_few)``."""
        return self.matrix(replace(self.models, instrument=about))

    @cached_property
    def uneven_light(self) -> Alternative:
        """The fit with a smooth gain over the pupil that is common to all modes."""
        kind = self.models.instrument.slopes.kind
        maps = nuisances_of(self.target.valid, kind, gain_map=True).maps
        return self.compare(self.own, *(pattern[:, None] * self.own for pattern in maps))

    def fit_again(self, about: Instrument, rate: Array) -> tuple[float, float, Array]:
        """Return the fit with another instrument and one further number of it.

        All modes are fitted on the fine grid: on the coarse one, with two points per subaperture,
        arms turned by one degree moved a rotation by half of what they do, and were found 0.4 to
        0.8 deg beyond their places.

        Parameters
        ----------
        about
            The instrument, at a value near the best one.
        rate
            ``(n_slopes, n_few)`` derivative of D by that value.

        Returns
        -------
        The step to the best value, χ² over that of the fit, and the change of α ``(4,)``.
        """
        settled = self.settled
        models, own = replace(settled.models, instrument=about), settled.solution
        there = refine(models, settled.target, own.alpha, settled.nuisances)
        known = np.concatenate([there.derivatives[:, :, self.modes], rate[None]])
        seen = self.target.project(there.matrix[:, self.modes], known)
        share = there.projection.chi / own.projection.chi * seen.chi_at_best / seen.chi
        step = seen.best_step
        return float(step[-1]), float(share), there.vector + step[:4] - own.vector

    def matrix(self, tried: FitModels) -> Array:
        """Return D of an instrument, ``(n_slopes, n_few)``."""
        own = tried.basis is self.models.basis
        basis = self.model.basis if own else tried.basis.subset(self.modes)
        model = tried.model(self.models.cheap_sampling, basis, once=True)
        model.share_modes(self.model)
        return self._at_solution(model)

    def left(self, matrix: Array, *more: Array) -> float:
        """Return χ² at the best unknowns, including those of further derivatives."""
        return float(self.seen(matrix, *more).chi_at_best)

    def compare(self, matrix: Array, *more: Array) -> Alternative:
        """Return another matrix, and unknowns with further derivatives, against the fit's own.

        Squares of both residuals are compared mode by mode and region by region: common noise and
        errors cancel, and the rest scatters between modes and between regions.
        """
        own, other = self._own_left, self._left_at_best(self.seen(matrix, *more))
        gained, total = own - other, float(own.sum())
        parts = gained.sum(axis=0), np.bincount(self._regions, gained.sum(axis=1))
        scatter = max(
            np.std(one, ddof=1) * np.sqrt(len(one)) if len(one) > 1 else 0.0 for one in parts
        )
        return Alternative(
            share=float(other.sum() / total) if total else 1.0,
            share_sigma=float(scatter / total) if total else 0.0,
            # Both steps are from the same grid, so that its error cancels in their difference.
            moved=self.step(matrix, *more)[:4] - self.step(self.own)[:4],
            counts=True,
        )

    def judge(
        self,
        found: Alternative,
        words: str,
        max_share: float = 0.0,
        *,
        key: str = "",
        notable: bool = True,
        min_explained: float = 0.0,
        is_number: bool = False,
        is_instrument: bool = False,
    ) -> Alternative:
        """Return a comparison with its name and verdict.

        It is preferred if it is ``notable``, leaves less than ``max_share``, by more than chance,
        and explains more than ``min_explained`` (RMS share of the signal) that the fit does not.
        """
        better = found.misfit < max_share and found.significance > SIGNIFICANT
        explains = found.explained(self.residual_fraction) > min_explained
        preferred = bool(notable and better and explains)
        return replace(
            found,
            words=words,
            key=key,
            max_share=max_share,
            preferred=preferred,
            undecided=found.is_open and not preferred,
            is_number=is_number,
            is_instrument=is_instrument,
        )

    @cached_property
    def _own_left(self) -> Array:
        return self._left_at_best(self.seen(self.own))

    @cached_property
    def _regions(self) -> NDArray[np.intp]:
        n_planes = self.models.instrument.slopes.kind.n_planes
        return pupil_regions(self.target.valid, n_planes)[self.target.rows]

    @staticmethod
    def _left_at_best(seen: Projection) -> Array:
        """Return the weighted squares of the residual after the best step ``(n_rows, n_few)``."""
        step = seen.best_step.astype(seen.jacobian.dtype)
        left = seen.residual - np.tensordot(step, seen.jacobian, axes=1)
        return np.asarray(left**2 * seen.weights)

    def depends_on(self, matrix: Array, rate: Array) -> bool:
        """Return True if a quantity changes the slopes; a border may cut no subaperture."""
        return bool(self.target.project(matrix, rate[None]).normal[0, 0] > 0.0)

    def step(self, matrix: Array, *more: Array) -> Array:
        """Return the best step of all unknowns."""
        return self.seen(matrix, *more).best_step

    def seen(self, matrix: Array, *more: Array) -> Projection:
        """Return the projection of the measurement on a matrix and further derivatives.

        That of the unchanged instrument and the last one are cached, because both the step and the
        misfit of an alternative are taken from it.
        """
        if matrix is self.own and not more:
            return self._own_seen
        given = (matrix, *more)
        if self._last is not None:
            known, seen = self._last
            if len(known) == len(given) and all(map(operator.is_, known, given)):
                return seen
        self._last = None  # its memory is needed for the next one
        seen = self.target.project(matrix, self._with(more), np.float32)
        self._last = given, seen
        return seen

    @cached_property
    def _own_seen(self) -> Projection:
        return self.target.project(self.own, self.derivatives, np.float32)

    def _at_solution(self, model: InteractionModel) -> Array:
        self.models.counter.n += 1
        return np.asarray(model.interaction_matrix(self.here), dtype=np.float64)

    def _with(self, more: tuple[Array, ...]) -> Array:
        if not more:
            return self.derivatives
        return np.concatenate([self.derivatives, np.array(more, self.derivatives.dtype)])
