"""All four parameters together: far steps on few modes and a coarse grid, near ones on all.

The lowest modes lead from afar: their slopes change smoothly over more than a subaperture. High
modes are precise, and blind beyond half their own wavelength.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.fit.nuisance import Nuisances
from service.fit.projection import Projection, project, weighted_misfit
from service.fit.target import Target
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration

Array = NDArray[np.float64]

LONGEST_STEP = np.array([0.8, 0.8, np.deg2rad(4.0), 0.04])
"""A step further than this trusts the derivatives too far (numeric units)."""

APPROACHED = np.array([0.02, 0.02, np.deg2rad(0.05), 1e-3])
"""A coarse step shorter than this leaves the rest to the fine grid."""

SETTLED = np.array([5e-4, 5e-4, np.deg2rad(5e-4), 1e-5])
"""A fine step shorter than this is the last."""

LIMIT = np.array([4.0, 4.0, np.inf, 0.25])
"""No registration lies further from the nominal one (numeric units; any rotation may)."""

MOST_FAR_STEPS = 12
MOST_NEAR_STEPS = 6
_HALVINGS = 3


@dataclass(slots=True)
class Counter:
    """Interaction matrices computed so far."""

    n: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Approach:
    """Where a start led on the coarse grid."""

    vector: Array
    """``(4,)`` numeric units."""

    misfit: float
    """Share of χ² not explained, 0..1."""

    converged: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """Where the fine grid came to rest."""

    vector: Array
    """``(4,)`` numeric units."""

    nuisances: Array
    """``(n_nuisances,)``."""

    matrix: NDArray[np.float32]
    """``(n_slopes, n_modes)`` the model there."""

    derivatives: NDArray[np.float32]
    """``(4, n_slopes, n_modes)`` of the model, taken nearby."""

    projection: Projection
    converged: bool


def approach(model: InteractionModel, target: Target, start: Array, counter: Counter) -> Approach:
    """Return where Gauss-Newton steps on few modes lead from a start.

    A step that makes the misfit worse is halved; a start from which none makes it better has
    failed.
    """
    vector = start.astype(float)
    misfit = weighted_misfit(_matrix(model, vector, counter), target)
    for _ in range(MOST_FAR_STEPS):
        here = Misregistration.from_vector(vector)
        counter.n += 4
        seen = project(model.interaction_matrix(here), model.derivatives(here), target)
        normal = seen.normal
        scale = np.sqrt(np.diag(normal))
        damped = normal + np.diag(1e-6 * scale**2)
        step = np.linalg.solve(damped, seen.scores.sum(axis=1))
        step /= max(1.0, float(np.max(np.abs(step) / LONGEST_STEP)))
        vector, misfit, moved = _best_of_halved(model, target, vector, step, misfit, counter)
        if not moved:
            return Approach(
                vector=vector, misfit=misfit, converged=bool(np.all(np.abs(step) < APPROACHED))
            )
        if np.all(np.abs(step) < APPROACHED):
            return Approach(vector=vector, misfit=misfit, converged=True)
    return Approach(vector=vector, misfit=misfit, converged=False)


def refine(
    fine: InteractionModel,
    cheap: InteractionModel,
    target: Target,
    start: Array,
    nuisances: Nuisances,
    counter: Counter,
) -> Solution:
    """Return the minimum on the fine grid, with derivatives frozen on a cheaper one.

    Near the minimum the derivatives' own error only slows the last steps down: what decides is
    the residual, and that is the fine grid's.
    """
    vector = start.astype(float)
    values = np.zeros(len(nuisances.sigma))
    here = Misregistration.from_vector(vector)
    counter.n += 4
    frozen = cheap.derivatives(here)
    matrix = _matrix(fine, vector, counter)
    extra = nuisances.derivatives(cheap, here, matrix)
    converged = False
    seen = project(matrix, np.concatenate([frozen, extra]), target)
    for _ in range(MOST_NEAR_STEPS):
        step, change = _bounded_step(seen, values, nuisances.sigma)
        if not within_limits(vector + step):
            break
        vector, values = vector + step, values + change
        matrix = _matrix(fine, vector, counter)
        whole = matrix + np.tensordot(values, extra, axes=1)
        seen = project(whole, np.concatenate([frozen, extra]), target)
        step, _ = _bounded_step(seen, values, nuisances.sigma)
        if np.all(np.abs(step) < SETTLED):
            converged = True
            break
    return Solution(
        vector=vector,
        nuisances=values,
        matrix=matrix,
        derivatives=frozen,
        projection=seen,
        converged=converged,
    )


def stand(
    fine: InteractionModel,
    cheap: InteractionModel,
    target: Target,
    vector: Array,
    nuisances: Nuisances,
    counter: Counter,
) -> Solution:
    """Return the fine model at a registration that was found otherwise: no step is taken."""
    counter.n += 4
    here = Misregistration.from_vector(vector)
    derivatives = cheap.derivatives(here)
    matrix = _matrix(fine, vector, counter)
    extra = nuisances.derivatives(cheap, here, matrix)
    seen = project(matrix, np.concatenate([derivatives, extra]), target)
    return Solution(
        vector=vector,
        nuisances=np.zeros(len(nuisances.sigma)),
        matrix=matrix,
        derivatives=derivatives,
        projection=seen,
        converged=within_limits(vector),
    )


def within_limits(vector: Array) -> bool:
    """Return whether a registration is one that an instrument could have."""
    return bool(np.all(np.abs(vector - [0.0, 0.0, 0.0, 1.0]) < LIMIT))


def prior_of(sigma: Array) -> Array:
    """Return the reciprocal variance of every unknown: the registration itself has no prior."""
    return np.concatenate([np.zeros(4), 1.0 / sigma**2])


def _bounded_step(seen: Projection, values: Array, sigma: Array) -> tuple[Array, Array]:
    """Return the step of the registration and of the nuisances, these held by their prior."""
    noise = seen.chi / max(seen.residual.size - len(seen.gains), 1)
    prior = prior_of(sigma) * noise
    pull = prior * np.concatenate([np.zeros(4), values])
    normal = seen.normal + np.diag(prior)
    step = np.linalg.solve(normal, seen.scores.sum(axis=1) - pull)
    step /= max(1.0, float(np.max(np.abs(step[:4]) / LONGEST_STEP)))
    return step[:4], step[4:]


def _best_of_halved(
    model: InteractionModel,
    target: Target,
    vector: Array,
    step: Array,
    misfit: float,
    counter: Counter,
) -> tuple[Array, float, bool]:
    for _ in range(_HALVINGS):
        tried = vector + step
        if within_limits(tried):
            found = weighted_misfit(_matrix(model, tried, counter), target)
            if found <= misfit * (1.0 + 1e-9):
                return tried, found, True
        step = step / 2.0
    return vector, misfit, False


def _matrix(model: InteractionModel, vector: Array, counter: Counter) -> NDArray[np.float32]:
    counter.n += 1
    return np.asarray(
        model.interaction_matrix(Misregistration.from_vector(vector)), dtype=np.float32
    )
