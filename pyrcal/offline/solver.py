"""The last steps of a fit, on the fine grid.

They are linear, and held back by what is usual: each is one more derivative in the projection, with
a prior of its own. A turn of the slope axes is always among them: a pyramid whose edges are turned
by a degree would otherwise turn the registration by 0.007 deg with 400 modes, and by 0.06 deg with
the lowest 40.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.models import FitModels, Optic
from service.estimation.solver import (
    LONGEST_STEP,
    SETTLED,
    Columns,
    Projection,
    within_limits,
)
from service.model.kinds import SignalKind
from service.model.misregistration import Misregistration
from service.model.slopes import signals_of_slopes, slopes_of

Array = NDArray[np.float64]

MAX_NEAR_STEPS = 6

SLOPE_TURN_SIGMA_RAD = np.deg2rad(1.5)
"""A pyramid is aligned to the pixels to a degree or two."""

GAIN_MAP_ORDER = 4
"""Of the polynomial in x and y that the gain over the pupil is."""

GAIN_MAP_SIGMA = 0.3
"""Of each coefficient of the gain map."""

ANAMORPHOSIS_SIGMA = 0.02
"""Half the stretch of the mirror's image along one axis over the other."""

OPTIC_SIGMA = {Optic.WIDTH: 0.25, Optic.SENSOR: 0.5}
"""How far what a file says of an instrument may be off, as a logarithm: a coupling of 0.35 might be
0.18 or 0.53."""

UNKNOWN_SIGMA = 1.0
"""The same of what a file says to be unknown."""

LONGEST_OPTIC_STEP = 0.4
"""A step of such a logarithm beyond this trusts the derivatives too far."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Nuisances:
    """The unknowns beside the registration, in their order."""

    maps: Array
    """``(n_maps, n_slopes)`` gain over the pupil of each coefficient of the gain map."""

    anamorphosis: bool
    """Whether the two stretches are unknown."""

    optics: tuple[tuple[Optic, float], ...] = ()
    """What of the instrument is unknown, and how far the models are already from what the file
    says, as a logarithm: the prior is about the file."""

    unknown: frozenset[Optic] = frozenset()
    """What of it the file says to be unknown."""

    @property
    def sigma(self) -> Array:
        """``(n_nuisances,)`` how large each may be, 1 σ."""
        stretches = [ANAMORPHOSIS_SIGMA] * (2 if self.anamorphosis else 0)
        optics = [
            UNKNOWN_SIGMA if optic in self.unknown else OPTIC_SIGMA[optic]
            for optic, _ in self.optics
        ]
        maps = [GAIN_MAP_SIGMA] * len(self.maps)
        return np.array([SLOPE_TURN_SIGMA_RAD, *stretches, *optics, *maps])

    @property
    def first_optic(self) -> int:
        """Index of the first unknown of the instrument among the nuisances."""
        return 3 if self.anamorphosis else 1

    def from_prior(self, values: Array) -> Array:
        """Return values ``(n_nuisances,)`` as distances from what is expected of them."""
        distance = values.astype(float)
        for k, (_, offset) in enumerate(self.optics, self.first_optic):
            distance[k] += offset
        return distance

    def changes(self, values: Array) -> dict[Optic, float]:
        """Return by how much each of the instrument's unknowns differs from the file, as ln."""
        distance = self.from_prior(values)
        return {
            optic: float(distance[k]) for k, (optic, _) in enumerate(self.optics, self.first_optic)
        }

    @property
    def prior(self) -> Array:
        """``(4 + n_nuisances,)`` reciprocal variances: the registration itself has no prior."""
        return np.concatenate([np.zeros(4), 1.0 / self.sigma**2])

    def derivatives(self, models: FitModels, alpha: Misregistration, matrix: NDArray[Any]) -> Array:
        """Return ``(n_nuisances, n_slopes, n_modes)``: change of the matrix with each of them."""
        model = models.cheap
        kind = model.instrument.slopes.kind
        along_x, along_y = slopes_of(matrix, kind)
        found = [signals_of_slopes(np.stack([-along_y, along_x]), kind)]
        if self.anamorphosis:
            found += list(model.stretch_derivatives(alpha))
        found += models.optics_derivatives(alpha, [optic for optic, _ in self.optics])
        found += [pattern[:, None] * matrix for pattern in self.maps]
        return np.array(found)

    def gain_map(self, values: Array, valid: NDArray[np.bool_]) -> Array | None:
        """Return the gain over the pupil ``(n, n)``, mean 1; None without a gain map."""
        if not len(self.maps):
            return None
        gain = np.full(valid.shape, np.nan)
        coefficients = values[len(values) - len(self.maps) :]
        gain[valid] = 1.0 + coefficients @ self.maps[:, : int(valid.sum())]
        return gain

    def stretches(self, values: Array) -> Array | None:
        """Return the two stretches; None when they are not unknown."""
        return values[1:3].copy() if self.anamorphosis else None


def nuisances_of(
    valid: NDArray[np.bool_],
    kind: SignalKind,
    *,
    gain_map: bool = False,
    anamorphosis: bool = False,
    optics: Sequence[Optic] = (),
    unknown: frozenset[Optic] = frozenset(),
) -> Nuisances:
    """Return the unknowns beside the registration: the turn of the axes, and those asked for."""
    as_told = tuple((optic, 0.0) for optic in optics)
    n = len(valid)
    y, x = (np.stack(np.nonzero(valid)) - (n - 1) / 2) / (n / 2)
    if not gain_map:
        none = np.empty((0, kind.n_planes * len(x)))
        return Nuisances(maps=none, anamorphosis=anamorphosis, optics=as_told, unknown=unknown)
    order = GAIN_MAP_ORDER
    powers = [x**i * y**j for i in range(order + 1) for j in range(order + 1 - i) if i + j > 0]
    centred = np.array(powers) - np.mean(powers, axis=1, keepdims=True)
    orthonormal, _ = np.linalg.qr(centred.T)
    maps = np.tile(orthonormal.T * np.sqrt(valid.sum()), kind.n_planes)
    return Nuisances(maps=maps, anamorphosis=anamorphosis, optics=as_told, unknown=unknown)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """Minimum on the fine grid."""

    vector: Array
    """``(4,)`` numeric units."""

    nuisances: Array
    """``(n_nuisances,)``."""

    matrix: NDArray[np.float32]
    """``(n_slopes, n_modes)`` the model there."""

    derivatives: NDArray[np.float32]
    """``(4, n_slopes, n_modes)`` of the model, taken nearby."""

    nuisance_derivatives: Array
    """``(n_nuisances, n_slopes, n_modes)`` the same of the unknowns beside the registration."""

    projection: Projection
    converged: bool


def refine(
    models: FitModels,
    columns: Columns,
    start: Array,
    nuisances: Nuisances,
    max_steps: int = MAX_NEAR_STEPS,
) -> Solution:
    """Return the minimum on the fine grid, with derivatives frozen on a cheaper one.

    Near the minimum the derivatives' own error only slows the last steps down: what decides is
    the residual, and that is the fine grid's.
    """
    vector, values = start.astype(float), np.zeros(len(nuisances.sigma))
    here = Misregistration.from_vector(vector)
    models.counter.n += 4
    frozen = models.cheap.derivatives(here)
    matrix = models.matrix(models.fine, vector)
    extra = nuisances.derivatives(models, here, matrix)
    every = np.concatenate([frozen, extra])
    seen, converged = columns.project(matrix, every), False
    for _ in range(max_steps):
        step = _bounded_step(seen, values, nuisances)
        if not within_limits(vector + step[:4]):
            break
        vector, values = vector + step[:4], values + step[4:]
        matrix = models.matrix(models.fine, vector)
        seen = columns.project(matrix + np.tensordot(values, extra, axes=1), every)
        if np.all(np.abs(_bounded_step(seen, values, nuisances)[:4]) < SETTLED):
            converged = True
            break
    return Solution(
        vector=vector,
        nuisances=values,
        matrix=matrix,
        derivatives=frozen,
        nuisance_derivatives=extra,
        projection=seen,
        converged=converged,
    )


def _bounded_step(seen: Projection, values: Array, nuisances: Nuisances) -> Array:
    """Return the step of the registration, then of the nuisances, these held by their prior."""
    noise = seen.chi / max(seen.residual.size - len(seen.gains), 1)
    prior = nuisances.prior * noise
    pull = prior * np.concatenate([np.zeros(4), nuisances.from_prior(values)])
    step = np.linalg.solve(seen.normal + np.diag(prior), seen.scores.sum(axis=1) - pull)
    excess = np.abs(step[:4]) / LONGEST_STEP
    first = 4 + nuisances.first_optic
    optics = np.abs(step[first : first + len(nuisances.optics)]) / LONGEST_OPTIC_STEP
    return np.asarray(step / max(1.0, float(np.max(np.concatenate([excess, optics])))))
