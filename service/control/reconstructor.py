"""Inversion of an interaction matrix into a reconstructor (control matrix).

There are two methods. Truncated least squares (Heritier et al. 2018, section 2.1) needs the matrix
alone. The MAP estimator, a Gauss-Markov estimator with a prior, also uses the covariances of modes
and noise: ``R = (D^T Cn^-1 D + Cφ^-1)^-1 D^T Cn^-1``. It estimates all modes of the basis, also
those that the loop does not control, so that their slopes do not alias into the controlled modes.
Without noise, and with as many modes as are controlled, it is the least-squares inverse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError

Array = NDArray[np.float64]

MAX_CONDITION = 100.0
"""Largest over smallest singular value that is inverted; smaller ones would amplify noise."""


_MAX_NORMAL_CONDITION = 1e3
"""Condition number up to which the normal equations are used.

They square it, and 1e6 is far enough from the 1e16 of double precision to lose nothing.
"""

_N_MODES_FOR_EIGENVECTORS = 1000
"""Number of modes from which eigenvectors of the normal equations replace the SVD (4 x faster)."""

_SLOPES_PER_BLOCK = 2048
"""Columns of a reconstructor solved for at once, which bounds the memory for ELT matrices."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inversion:
    """Reconstructor, with the condition of the interaction matrix that was inverted."""

    matrix: NDArray[np.float32]
    """Reconstructor ``(n_modes, n_slopes)``, metres per slope."""

    condition_number: float
    """Largest over smallest singular value, before truncation."""

    n_truncated: int
    """Number of singular values that were left out."""


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
    Heritier et al. 2018, section 2.1, equation 2.
    """
    controlled = select_columns(interaction_matrix, n_modes)
    normal = controlled.T @ controlled
    power = np.linalg.eigvalsh(normal)
    if power[0] * min(max_condition, _MAX_NORMAL_CONDITION) ** 2 > power[-1]:
        # Nothing is truncated. The normal equations then give the same inverse at a third of the
        # cost of the SVD.
        factor = scipy.linalg.cho_factor(normal, overwrite_a=True)
        return Inversion(
            matrix=_solve_in_blocks(
                controlled, lambda some: scipy.linalg.cho_solve(factor, some.T)
            ),
            condition_number=_condition_from_power(power),
            n_truncated=0,
        )
    if n_modes >= _N_MODES_FOR_EIGENVECTORS and max_condition <= _MAX_NORMAL_CONDITION:
        return _invert_by_eigenvectors(controlled, normal, max_condition)
    # The SVD is exact for any condition number; the normal equations above square it.
    left, singular, right = scipy.linalg.svd(controlled, full_matrices=False)
    kept = singular > singular[0] / max_condition
    inverse = (right[kept].T / singular[kept]) @ left[:, kept].T
    return Inversion(
        matrix=np.ascontiguousarray(inverse, dtype=np.float32),
        condition_number=float(singular[0] / singular[-1]),
        n_truncated=int(np.count_nonzero(~kept)),
    )


def _invert_by_eigenvectors(controlled: Array, normal: Array, max_condition: float) -> Inversion:
    """Return the truncated inverse from the eigenvectors of the normal equations ``D^T D``.

    Their eigenvalues are the squares of the singular values of D.
    """
    power, axes = np.linalg.eigh(normal)
    kept = power * max_condition**2 > power[-1]
    inverse = (axes[:, kept] / power[kept]) @ axes[:, kept].T
    return Inversion(
        matrix=_solve_in_blocks(controlled, lambda some: inverse @ some.T),
        condition_number=_condition_from_power(power),
        n_truncated=int(np.count_nonzero(~kept)),
    )


def _solve_in_blocks(controlled: Array, solve: Callable[[Array], Array]) -> NDArray[np.float32]:
    """Return the reconstructor from ``solve``, which maps ``(n, n_modes)`` to ``(n_modes, n)``.

    It is called on blocks of slopes, so that no second matrix of full size is in memory.
    """
    matrix = np.empty(controlled.shape[::-1], np.float32)
    for start in range(0, len(controlled), _SLOPES_PER_BLOCK):
        part = slice(start, start + _SLOPES_PER_BLOCK)
        matrix[:, part] = solve(controlled[part])
    return matrix


def _condition_number(controlled: Array) -> float:
    """Return the largest over the smallest singular value of a matrix."""
    if controlled.shape[1] < _N_MODES_FOR_EIGENVECTORS:
        singular = scipy.linalg.svdvals(controlled)
        return float(singular[0] / singular[-1])
    return _condition_from_power(np.linalg.eigvalsh(controlled.T @ controlled))


def _condition_from_power(power: NDArray[np.floating]) -> float:
    """Return the condition number of D from the rising eigenvalues of ``D^T D``; at most 1e8."""
    # Eigenvalues are exact to 1e-16 of the largest, so smaller ones are rounding errors and may
    # even be negative. A condition number above 1e8 cannot be computed this way.
    return float(np.sqrt(power[-1] / max(power[0], np.finfo(np.float64).eps * power[-1])))


def select_columns(interaction_matrix: NDArray[Any], n_modes: int) -> NDArray[np.float64]:
    """Return the first ``n_modes`` columns ``(n_slopes, n_modes)`` in double precision.

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """Prior variance of the modes and noise of the slopes, for the MAP estimator."""

    variance_m2: Array
    """``(n_basis,)`` expected variance of each mode, metres² OPD; part of a KL basis."""

    slope_noise: Array
    """``(n_slopes,)`` 1 σ of each slope in one frame, above 0."""

    def __post_init__(self) -> None:
        """Check that all values are positive, because they are divided by.

        Raises
        ------
        ModelError
            If a variance or a noise is not finite and positive.
        """
        for name, values in (("variance_m2", self.variance_m2), ("slope_noise", self.slope_noise)):
            bad = np.flatnonzero(~(np.isfinite(values) & (values > 0.0)))
            if values.ndim != 1 or len(bad):
                where = f", first at {bad[0]}" if len(bad) else ""
                raise ModelError(
                    f"prior: {name}: found shape {values.shape} and {len(bad)} values that are not "
                    f"positive{where}; expected one positive number each"
                )


def invert_with_prior(interaction_matrix: NDArray[Any], n_modes: int, prior: Prior) -> Inversion:
    """Return the MAP reconstructor of the first ``n_modes`` modes.

    As many modes are estimated as both the matrix and the prior have. Each row is scaled so that
    the diagonal of ``R D`` is 1. A MAP estimate is biased towards 0 for noisy modes; without the
    scaling the loop gain of such a mode would be lower than the RTC's setting says.

    Raises
    ------
    ModelError
        As :func:`invert`; also if the prior has another number of slopes, or fewer modes.

    References
    ----------
    Gilles 2005, Appl. Opt. 44, 993; Correia et al. 2013, JOSA A 30, 1726.
    """
    n_estimated = min(interaction_matrix.shape[1], len(prior.variance_m2))
    controlled = select_columns(interaction_matrix, n_modes)
    if n_modes > n_estimated or len(prior.slope_noise) != len(controlled):
        raise ModelError(
            f"reconstructor: found a prior of {len(prior.variance_m2)} modes and "
            f"{len(prior.slope_noise)} slopes; expected at least {n_modes} and {len(controlled)}"
        )
    matrix = select_columns(interaction_matrix, n_estimated)
    amplitude = np.sqrt(prior.variance_m2[:n_estimated])
    # In units of the noise and of the prior both matrices are of order one, whatever the units of
    # the slopes; unscaled variances in m² would be lost in rounding.
    white = matrix * amplitude / prior.slope_noise[:, None]
    system = scipy.linalg.cho_factor(white.T @ white + np.eye(n_estimated))
    estimate = scipy.linalg.cho_solve(system, white.T)[:n_modes] * amplitude[:n_modes, None]
    estimate /= prior.slope_noise
    estimate /= np.einsum("ij,ji->i", estimate, controlled)[:, None]
    return Inversion(
        matrix=np.ascontiguousarray(estimate, dtype=np.float32),
        condition_number=_condition_number(controlled),
        n_truncated=0,
    )


class InversionMethod(StrEnum):
    """Ways to invert an interaction matrix."""

    SVD = "svd"
    """Truncated least squares."""

    MAP = "map"
    """Least squares weighted by noise, with the turbulence as prior."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recipe:
    """Settings for the inversion of an interaction matrix."""

    n_modes: int
    """Number of modes to control, the first ones of the basis."""

    max_condition: float = MAX_CONDITION
    """Largest over smallest singular value that is inverted; not used with a prior."""

    prior: Prior | None = None
    """Variance of modes and noise; None for truncated least squares."""

    @property
    def method(self) -> InversionMethod:
        """Method: MAP if there is a prior, else truncated least squares."""
        return InversionMethod.SVD if self.prior is None else InversionMethod.MAP


def reconstruct(interaction_matrix: NDArray[Any], recipe: Recipe) -> Inversion:
    """Return the reconstructor of a single-pass interaction matrix ``(n_slopes, n_columns)``.

    Raises
    ------
    ModelError
        If the matrix cannot be inverted; see :func:`invert` and :func:`invert_with_prior`.
    """
    if recipe.prior is not None:
        return invert_with_prior(interaction_matrix, recipe.n_modes, recipe.prior)
    return invert(interaction_matrix, recipe.n_modes, max_condition=recipe.max_condition)
