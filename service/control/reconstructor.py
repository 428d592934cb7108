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
