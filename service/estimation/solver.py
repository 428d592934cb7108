"""Fit the registration to measured columns: variable projection.

Every mode has a gain of its own. The fit is linear in the gains, so they follow from the other
unknowns: ``g_j = D_j·Y_j / D_j·D_j``. What remains is a problem in the registration alone, with the
Jacobian ``J_jk = g_j (1 - P_j) dD_j/dα_k``, P_j the projection on D_j. Measured matrices and the
responses in telemetry are fitted alike.

All four parameters are fitted together: first on few modes and a coarse grid, then on all modes.
The slopes of the lowest modes change smoothly over more than a subaperture, which gives them a wide
capture range. High modes are precise, and cannot be used beyond half their own wavelength.

References
----------
Kaufman 1975, BIT 15, 49; Golub & Pereyra 2003, Inverse Problems 19, R1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration

Array = NDArray[np.float64]

MAX_STEP = np.array([0.8, 0.8, np.deg2rad(4.0), 0.04])
"""Longest step; the derivatives do not hold beyond it (numeric units)."""

COARSE_STEP_LIMIT = np.array([0.02, 0.02, np.deg2rad(0.05), 1e-3])
"""Step on the coarse grid below which the fit has converged there."""

SETTLED_STEP = np.array([5e-4, 5e-4, np.deg2rad(5e-4), 1e-5])
"""Step on the fine grid below which the fit has converged."""

MAX_DISTANCE = np.array([4.0, 4.0, np.inf, 0.25])
"""Largest distance from the nominal registration (numeric units; rotation is not limited)."""

MAX_FAR_STEPS = 12
_HALVINGS = 3

_ROWS_AT_ONCE = 64
"""Slopes that are weighted at once: a copy of all would not stay in the cache."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Columns:
    """Measured columns of an interaction matrix, and how much each counts."""

    matrix: Array
    """``(n_slopes, n_columns)`` slope per unit command."""

    weights: Array
    """``(n_columns,)`` weight of each column in χ²."""

    rows: NDArray[np.bool_]
    """``(n_slopes,)`` True for slopes that are used."""

    signed: bool = True
    """True if a gain may be negative. Otherwise such a column has no response in common with the
    model and does not enter."""

    def project(
        self,
        model: NDArray[Any],
        derivatives: NDArray[Any],
        dtype: type[np.float32] | type[np.float64] = np.float64,
    ) -> Projection:
        """Return the gains, residual and Jacobian of a model ``(n_slopes, n_columns)``.

        ``derivatives`` is ``(n_unknowns, n_slopes, n_columns)``, ``dtype`` the precision of the
        Jacobian.
        """
        matrix = np.asarray(model[self.rows], dtype=np.float64)
        measured = self.matrix[self.rows]
        power = _power(matrix)
        gains = np.sum(matrix * measured, axis=0) / power
        if not self.signed:
            gains = np.maximum(gains, 0.0)
        # one unknown at a time, which stays in the cache
        jacobian = np.empty((len(derivatives), *matrix.shape), dtype)
        shape: NDArray[Any] = matrix.astype(dtype, copy=False)
        for k, rates in enumerate(derivatives):
            counted: NDArray[Any] = np.asarray(
                rates if self.rows.all() else rates[self.rows], dtype
            )
            along = np.einsum("sm,sm->m", counted, shape) / power
            np.multiply(shape, along.astype(dtype), out=jacobian[k])
            np.subtract(counted, jacobian[k], out=jacobian[k])
            jacobian[k] *= gains.astype(dtype)
        return Projection(
            gains=gains,
            residual=measured - matrix * gains,
            jacobian=jacobian,
            weights=self.weights,
        )

    def misfit(self, model: NDArray[Any]) -> float:
        """Return the share of χ² that is left at the best gains, 0 to 1.

        A column whose best gain is negative counts as not explained at all.
        """
        matrix = np.asarray(model[self.rows], dtype=np.float64)
        measured = self.matrix[self.rows]
        along = np.sum(matrix * measured, axis=0)
        explained = np.maximum(along, 0.0) ** 2 / _power(matrix)
        total = np.sum(measured**2, axis=0)
        return float((total - explained) @ self.weights / (total @ self.weights))


def _power(matrix: Array) -> Array:
    """Return the sum of squares of each column, never 0.

    A mode that a far registration moves off the pupil changes no slope: its gain is 0 then.
    """
    return np.asarray(np.maximum(np.sum(matrix**2, axis=0), np.finfo(float).tiny))


@dataclass(frozen=True, kw_only=True, eq=False)
class Projection:
    """Residual and Jacobian of the measurement at one registration: the problem to first order."""

    gains: Array
    """``(n_modes,)`` best gain of each mode."""

    residual: Array
    """``(n_rows, n_modes)`` measurement less the model with its gains."""

    jacobian: Array
    """``(n_unknowns, n_rows, n_modes)`` derivatives of the model with its gains, without the part
    along the mode that the free gain describes."""

    weights: Array
    """``(n_modes,)`` weight of each mode in χ²."""

    @property
    def chi(self) -> float:
        """Weighted sum of squares of the residual."""
        return float(np.sum(self.residual**2, axis=0) @ self.weights)

    @property
    def chi_at_best(self) -> float:
        """χ² at the best step to first order."""
        return self.chi - float(self.scores.sum(axis=1) @ self.best_step)

    @cached_property
    def best_step(self) -> Array:
        """``(n_unknowns,)`` step to the minimum of χ², to first order."""
        # A ridge far below noise keeps unknowns apart that the columns do not distinguish.
        held = self.normal + 1e-9 * np.diag(np.diag(self.normal))
        return np.linalg.solve(held, self.scores.sum(axis=1))

    @cached_property
    def scores(self) -> Array:
        """``(n_unknowns, n_modes)`` negative half gradient of χ² by each unknown, of each mode."""
        residual = self.residual.astype(self.jacobian.dtype, copy=False)
        along = np.einsum("ksm,sm->km", self.jacobian, residual)
        return np.asarray(along * self.weights)

    @cached_property
    def normal(self) -> Array:
        """Normal matrix of all modes together, ``(n_unknowns, n_unknowns)``."""
        n_unknowns, n_rows, _ = self.jacobian.shape
        root = np.sqrt(self.weights).astype(self.jacobian.dtype)
        total = np.zeros((n_unknowns, n_unknowns))
        for start in range(0, n_rows, _ROWS_AT_ONCE):
            flat = (self.jacobian[:, start : start + _ROWS_AT_ONCE] * root).reshape(n_unknowns, -1)
            total += flat @ flat.T
        return total

    @cached_property
    def normals(self) -> Array:
        """Normal matrix of every mode, ``(n_modes, n_unknowns, n_unknowns)``."""
        by_mode = np.ascontiguousarray(self.jacobian.transpose(2, 0, 1))
        return np.asarray(by_mode @ by_mode.transpose(0, 2, 1) * self.weights[:, None, None])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Approach:
    """Minimum on the coarse grid."""

    alpha: Misregistration
    misfit: float
    """Share of χ² that is left, 0..1."""

    converged: bool
    n_matrices: int = 0
    """Number of interaction matrices computed, those for derivatives included."""


def within_limits(vector: Array) -> bool:
    """Return True if a registration is plausible."""
    return bool(np.all(np.abs(vector - [0.0, 0.0, 0.0, 1.0]) < MAX_DISTANCE))


def shorten(step: Array) -> Array:
    """Return a step limited to ``MAX_STEP``; one factor for all four keeps its direction."""
    return step / max(1.0, float(np.max(np.abs(step) / MAX_STEP)))


def approach(
    model: InteractionModel,
    columns: Columns,
    start: Misregistration,
    *,
    approached: Array = COARSE_STEP_LIMIT,
    allowed: Callable[[Array], bool] = within_limits,
) -> Approach:
    """Return the minimum that Gauss-Newton steps on few modes reach from a start.

    A step that increases the misfit is halved. The fit has not converged if no step decreases the
    misfit, or if the model explains no column at the start.
    """
    vector = start.vector
    matrix = model.interaction_matrix(start)
    misfit, n = columns.misfit(matrix), 1
    converged = False
    for _ in range(MAX_FAR_STEPS):
        derivatives = model.derivatives(start.with_vector(vector))
        # Four derivatives cost as much as four matrices.
        seen, n = columns.project(matrix, derivatives), n + 4
        if not seen.gains.any():
            break
        damped = seen.normal + 1e-6 * np.diag(np.diag(seen.normal))
        step = np.linalg.solve(damped, seen.scores.sum(axis=1))
        step = shorten(step)
        converged, tried = bool(np.all(np.abs(step) < approached)), step
        for _ in range(_HALVINGS):
            if allowed(vector + tried):
                found = model.interaction_matrix(start.with_vector(vector + tried))
                left, n = columns.misfit(found), n + 1
                # At the minimum rounding may make the misfit slightly larger.
                if left <= misfit * (1.0 + 1e-9):
                    vector, matrix, misfit = vector + tried, found, left
                    break
            tried = tried / 2.0
        else:
            break
        if converged:
            break
    alpha = start.with_vector(vector)
    return Approach(alpha=alpha, misfit=misfit, converged=converged, n_matrices=n)


def vertex(before: float, at: float, after: float) -> float:
    """Return the vertex of a parabola through three equidistant values, in steps from the middle.

    0 for a straight line.
    """
    bend = before + after - 2.0 * at
    return float((before - after) / (2.0 * bend)) if bend else 0.0
