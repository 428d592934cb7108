"""From an interaction matrix to a reconstructor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError

MAX_CONDITION = 100.0
"""Singular values below the largest over this are left out: they would only amplify noise."""


_WELL = 1e3
"""Condition up to which the normal equations lose nothing: its square is far from 1e16."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inversion:
    """A reconstructor and what its interaction matrix was like."""

    matrix: NDArray[np.float32]
    """``(n_modes, n_slopes)`` metres per slope."""

    condition_number: float
    """Largest over smallest singular value, before truncation."""

    n_truncated: int
    """Singular values left out."""


def invert(
    interaction_matrix: NDArray[Any], n_modes: int, *, max_condition: float = MAX_CONDITION
) -> Inversion:
    """Return the truncated-SVD pseudo-inverse of the first ``n_modes`` columns.

    Raises
    ------
    ModelError
        If the matrix has fewer columns, fewer slopes than modes, or a number that is not finite.

    References
    ----------
    Heritier et al. 2018, section 2.2.
    """
    controlled = checked_columns(interaction_matrix, n_modes)
    power = np.linalg.eigvalsh(controlled.T @ controlled)
    if power[0] * min(max_condition, _WELL) ** 2 > power[-1]:
        # nothing is left out: the normal equations say the same at a third of the cost
        factor = scipy.linalg.cho_factor(controlled.T @ controlled)
        return Inversion(
            matrix=np.ascontiguousarray(
                scipy.linalg.cho_solve(factor, controlled.T), dtype=np.float32
            ),
            condition_number=float(np.sqrt(power[-1] / power[0])),
            n_truncated=0,
        )
    left, singular, right = scipy.linalg.svd(controlled, full_matrices=False)
    kept = singular > singular[0] / max_condition
    inverse = (right[kept].T / singular[kept]) @ left[:, kept].T
    return Inversion(
        matrix=np.ascontiguousarray(inverse, dtype=np.float32),
        condition_number=float(singular[0] / singular[-1]),
        n_truncated=int(np.count_nonzero(~kept)),
    )


def checked_columns(interaction_matrix: NDArray[Any], n_modes: int) -> NDArray[np.float64]:
    """Return the first ``n_modes`` columns, ``(n_slopes, n_modes)``, fit to be inverted.

    Raises
    ------
    ModelError
        If the matrix has fewer columns, fewer slopes than modes, or a number that is not finite.
    """
    n_slopes, n_columns = interaction_matrix.shape
    if not 0 < n_modes <= min(n_columns, n_slopes):
        raise ModelError(
            f"reconstructor: found {n_modes} modes to control; expected 1 to "
            f"{min(n_columns, n_slopes)} ({n_columns} modes, {n_slopes} slopes)"
        )
    columns = np.asarray(interaction_matrix[:, :n_modes], dtype=np.float64)
    if not np.all(np.isfinite(columns)):
        raise ModelError("reconstructor: the interaction matrix holds NaN or Inf")
    return columns
