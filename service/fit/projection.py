"""Variable projection: the gains leave the problem before it is solved.

Every mode has a gain of its own, which is linear and therefore known once the rest is:
``g_j = D_j·Y_j / D_j·D_j``. What remains is a problem in the registration alone, with the Jacobian
``J_jk = g_j (1 - P_j) dD_j/dα_k``, P_j the projection on D_j.

References
----------
Kaufman 1975, BIT 15, 49; Golub & Pereyra 2003, Inverse Problems 19, R1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.fit.target import Target

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Projection:
    """The measurement against the model at one registration, to first order about it."""

    gains: Array
    """``(n_modes,)`` best gain of each mode."""

    residual: Array
    """``(n_rows, n_modes)`` measurement less model, its gains applied."""

    jacobian: Array
    """``(n_unknowns, n_rows, n_modes)`` change of the model, its part along the mode removed."""

    weights: Array
    """``(n_modes,)`` of each mode in χ²."""

    @property
    def chi(self) -> float:
        """Weighted sum of squares of the residual."""
        return float(np.sum(self.residual**2, axis=0) @ self.weights)

    @property
    def scores(self) -> Array:
        """``(n_unknowns, n_modes)`` what each mode says each unknown should do."""
        along = np.einsum("ksm,sm->km", self.jacobian, self.residual)
        return np.asarray(along * self.weights)

    @property
    def normal(self) -> Array:
        """Normal matrix of all modes together, ``(n_unknowns, n_unknowns)``."""
        picked = self.jacobian * np.sqrt(self.weights)
        flat = picked.reshape(len(picked), -1)
        return np.asarray(flat @ flat.T)

    @property
    def normals(self) -> Array:
        """Normal matrix of every mode, ``(n_modes, n_unknowns, n_unknowns)``."""
        by_mode = self.jacobian.transpose(2, 0, 1)
        return np.asarray(by_mode @ by_mode.transpose(0, 2, 1) * self.weights[:, None, None])


def project(model: NDArray[Any], derivatives: NDArray[Any], target: Target) -> Projection:
    """Return the gains, residual and Jacobian of a model ``(n_slopes, n_modes)``.

    ``derivatives`` is ``(n_unknowns, n_slopes, n_modes)``. Slopes that do not count are left out.
    """
    matrix = np.asarray(model[target.rows], dtype=np.float64)
    measured = target.matrix[target.rows]
    power = np.sum(matrix**2, axis=0)
    gains = np.sum(matrix * measured, axis=0) / power
    jacobian = derivatives[:, target.rows].astype(np.float64)
    along = np.einsum("ksm,sm->km", jacobian, matrix) / power
    for k, part in enumerate(along):
        jacobian[k] -= matrix * part
    jacobian *= gains
    return Projection(
        gains=gains,
        residual=measured - matrix * gains,
        jacobian=jacobian,
        weights=target.weights,
    )


def weighted_misfit(model: NDArray[Any], target: Target) -> float:
    """Return χ² per unit weight at the best gains: 0 is perfect, 1 nothing in common.

    A mode whose best gain is negative has nothing in common with the model.
    """
    matrix = np.asarray(model[target.rows], dtype=np.float64)
    measured = target.matrix[target.rows]
    along = np.sum(matrix * measured, axis=0)
    power = np.sum(matrix**2, axis=0)
    explained = np.maximum(along, 0.0) ** 2 / power
    total = np.sum(measured**2, axis=0)
    return float((total - explained) @ target.weights / (total @ target.weights))
