"""Try another obscuration and pupil size.

Neither is fitted beside the registration: a pupil that is told wrong shows at its edges only, and
there uneven light looks alike. What would explain the matrix far better is named instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.methods import Settled, spread
from pyrcal.offline.models import BETTER, CHEAP, FitModels
from pyrcal.offline.solver import nuisances_of
from pyrcal.offline.uncertainty import pupil_regions
from service.estimation.solver import Projection
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel

Array = NDArray[np.float64]

LEAST_EXPLAINED = 0.03
"""RMS share of the signal below which what a pupil explains may be the model's own error."""

_STEPS = 2
"""Towards the value that explains most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PupilNumber:
    """A number of the instrument file that describes the pupil."""

    key: str
    """In the file."""

    reported: float
    """What the file says."""

    power: int
    """Light goes with this power of it: the step of an area is straight."""

    step: float
    """Of that power, for the difference that stands for a derivative."""

    range: tuple[float, float]
    """No file is wrong by more."""

    notable: float
    """Less is not worth a word: simulators round their pupils to whole points."""

    def changed(self, about: Instrument, light: float) -> Instrument:
        """Return the instrument with another value, given by its power."""
        value = light ** (1.0 / self.power)
        if self.key == "obscuration_ratio":
            return replace(about, obscuration_ratio=value)
        return replace(about, wfs=replace(about.wfs, pupil_diameter_subap=value))

    def rate(self, few: Few) -> Array:
        """Return how D of the file's value changes with its power, ``(n_slopes, n_few)``."""
        beside = self.reported**self.power + self.step
        there = few.matrix(few.of(self.changed(few.models.instrument, beside)))
        return np.asarray((there - few.own) / self.step)

    def near(self, few: Few) -> tuple[float, Lead, Array]:
        """Return the value that explains most, its lead, α's move; to first order."""
        light, rate = self.reported**self.power, self.rate(few)
        if not few.tells(few.own, rate):
            return self.reported, Lead(share=1.0, sigma=0.0), np.zeros(4)
        step = few.step(few.own, rate)
        low, high = (limit**self.power for limit in self.range)
        value = float(np.clip(light + step[-1], low, high)) ** (1.0 / self.power)
        return value, few.lead(few.own, rate), step[:4] - few.step(few.own)[:4]

    def far(self, few: Few) -> tuple[float, Lead, Array]:
        """Return the same with D of the value itself."""
        value, matrix = self.found(few)
        return value, few.lead(matrix), few.step(matrix)[:4] - few.step(few.own)[:4]

    def found(self, few: Few) -> tuple[float, Array]:
        """Return the value that explains most, and D of it ``(n_slopes, n_few)``.

        A second step takes its rate from the first, unless that was too short to tell one.
        """
        light, matrix, rate = self.reported**self.power, few.own, self.rate(few)
        low, high = (limit**self.power for limit in self.range)
        for _ in range(_STEPS):
            if not few.tells(matrix, rate):
                break
            before, left = light, matrix
            light += float(few.step(matrix, rate)[-1])
            light = float(np.clip(light, low, high))
            if light == before:
                break
            matrix = few.matrix(few.of(self.changed(few.models.instrument, light)))
            if abs(light - before) > self.step:
                rate = (matrix - left) / (light - before)
        return light ** (1.0 / self.power), matrix


def _numbers(about: Instrument) -> tuple[PupilNumber, ...]:
    size, hole = about.wfs.pupil_diameter, about.obscuration_ratio
    width = PupilNumber(
        key="pupil_diameter_subap",
        reported=size,
        power=1,
        step=0.01 * size,
        range=(0.94 * size, 1.06 * size),
        notable=0.01 * size,
    )
    if about.pupil is not None:
        return (width,)  # its map has the obscuration
    inner = PupilNumber(
        key="obscuration_ratio",
        reported=hole,
        power=2,
        step=0.01,
        range=(0.0, max(0.6, hole)),
        notable=0.03,
    )
    return inner, width


@dataclass(frozen=True, slots=True, kw_only=True)
class Lead:
    """How much better or worse another explanation is than the fit."""

    share: float
    """χ² that it leaves over what the fit leaves."""

    sigma: float
    """1 σ of that share, from how it differs between modes and between regions of the pupil."""

    @property
    def significance(self) -> float:
        """Number of σ by which the other explanation is better; negative where it is worse."""
        gained = 1.0 - self.share
        if self.sigma > 0.0:
            return gained / self.sigma
        return float(np.copysign(np.inf, gained)) if gained else 0.0


class Few:
    """Some of the modes of a fit at its solution, on the cheap grid."""

    def __init__(self, settled: Settled) -> None:
        solution, self.models = settled.solution, settled.models
        self.residual_fraction = settled.share
        self.modes = spread(settled.target.n_modes)
        self.target = settled.target.column_subset(self.modes)
        self.here = solution.alpha
        known = np.concatenate([solution.derivatives, solution.nuisance_derivatives])
        self.derivatives = np.asarray(known[:, :, self.modes], dtype=np.float64)
        """Of the instrument as it is: they hardly depend on the hypothesis."""

    @cached_property
    def model(self) -> InteractionModel:
        """Of the instrument as it is, these modes only."""
        return self.models.cheap.of_modes(self.models.basis.subset(self.modes))

    @cached_property
    def own(self) -> Array:
        """D of the instrument as it is, ``(n_slopes, n_few)``."""
        return self._at_solution(self.model)

    def of(self, about: Instrument) -> FitModels:
        """Return the models of another instrument with the same modes."""
        return replace(self.models, instrument=about)

    def matrix(self, tried: FitModels) -> Array:
        """Return D of an instrument, ``(n_slopes, n_few)``."""
        own = tried.basis is self.models.basis
        basis = self.model.basis if own else tried.basis.subset(self.modes)
        return self._at_solution(tried.model(CHEAP, basis, once=True))

    def left(self, matrix: Array, *more: Array) -> float:
        """Return χ² at the best unknowns, those given by a derivative included."""
        return float(self.seen(matrix, *more).chi_at_best)

    def lead(self, matrix: Array, *more: Array) -> Lead:
        """Return by how much another matrix explains more than the instrument as it is.

        Squares of both residuals are compared mode by mode and region by region: noise and errors
        that both have in common cancel, and what is left scatters as much as it scatters between
        modes and between regions.
        """
        own, other = self._own_left, self._left_at_best(self.seen(matrix, *more))
        gained = own - other
        by_mode = gained.sum(axis=0)
        by_region = np.bincount(self._regions, gained.sum(axis=1))
        return Lead(
            share=float(other.sum() / own.sum()) if own.any() else 1.0,
            sigma=float(
                max(
                    np.std(parts, ddof=1) * np.sqrt(len(parts)) if len(parts) > 1 else 0.0
                    for parts in (by_mode, by_region)
                )
                / own.sum()
            )
            if own.any()
            else 0.0,
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
        """Return the weighted squares that the best step leaves, ``(n_rows, n_few)``."""
        left = seen.residual - np.tensordot(seen.best_step, seen.jacobian, axes=1)
        return np.asarray(left**2 * seen.weights)

    def tells(self, matrix: Array, rate: Array) -> bool:
        """Return whether what was measured depends on a number: it may cut no subaperture."""
        return bool(self.target.project(matrix, rate[None]).normal[0, 0] > 0.0)

    def step(self, matrix: Array, *more: Array) -> Array:
        """Return the best step of all of them."""
        return self.seen(matrix, *more).best_step

    def seen(self, matrix: Array, *more: Array) -> Projection:
        """Return what was measured against a matrix; of the instrument as it is once for all."""
        if matrix is self.own and not more:
            return self._own_seen
        return self.target.project(matrix, self._with(more))

    @cached_property
    def _own_seen(self) -> Projection:
        return self.target.project(self.own, self.derivatives)

    def _at_solution(self, model: InteractionModel) -> Array:
        self.models.counter.n += 1
        return np.asarray(model.interaction_matrix(self.here), dtype=np.float64)

    def _with(self, more: tuple[Array, ...]) -> Array:
        return np.concatenate([self.derivatives, np.array(more)]) if more else self.derivatives


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TriedPupil:
    """Another obscuration or diameter, at the value that explains most."""

    words: str
    """What to write into the file."""

    lead: Lead
    """How much better it explains the matrix than the file's pupil."""

    moved: Array
    """``(4,)`` by how much α would be another, numeric units."""

    explains: bool
    """Whether it explains enough of the signal to be worth a word."""


def tried_pupils(few: Few) -> tuple[TriedPupil, ...]:
    """Return other pupils, each at the value that explains most.

    Where less is left over than a pupil would have to explain, to first order.
    """
    found = []
    little = few.residual_fraction < LEAST_EXPLAINED
    for number in _numbers(few.models.instrument):
        value, lead, moved = number.near(few) if little else number.far(few)
        explained = few.residual_fraction * np.sqrt(max(1.0 - lead.share, 0.0))
        notable = abs(value - number.reported) >= number.notable and explained >= LEAST_EXPLAINED
        found.append(
            TriedPupil(
                words=f"{number.key} = {value:.3g}",
                lead=lead,
                moved=moved,
                explains=notable and lead.share < BETTER,
            )
        )
    return tuple(found)


def left_by_light(few: Few) -> float:
    """Return χ² that a smooth gain over the pupil, common to all modes, leaves, over what is."""
    own = few.own
    return few.left(own, *(pattern[:, None] * own for pattern in gain_maps(few))) / few.left(own)


def gain_maps(few: Few) -> Array:
    """Return the shapes of a smooth gain over the pupil, ``(n_maps, n_slopes)``."""
    kind = few.models.instrument.slopes.kind
    return nuisances_of(few.target.valid, kind, gain_map=True).maps
