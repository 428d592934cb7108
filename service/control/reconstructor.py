"""From an interaction matrix to a reconstructor.

Two ways to invert. Truncated least squares (Heritier et al. 2018, section 2.1) needs nothing but
the matrix. MAP, or generalised SVD, knows how strong each mode and the noise are:
``R = (D^T Cn^-1 D + Cφ^-1)^-1 D^T Cn^-1`` (Gauss-Markov with a prior). It estimates every mode of
the basis, also those the loop does not control: what they show in the slopes is then explained by
them and does not alias into the controlled ones. With no noise and as many modes as are controlled
it is the least-squares inverse.
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
"""Singular values below the largest over this are left out: they would only amplify noise."""


_WELL = 1e3
"""Condition up to which the normal equations lose nothing: its square is far from 1e16."""

_MANY = 1000
"""Modes from which on their eigenvectors are used rather than singular ones: four times as fast."""

_SLOPES_AT_ONCE = 2048
"""Columns of a reconstructor that are solved for together: thousands of modes fit in memory."""


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
    Heritier et al. 2018, section 2.1, equation 2.
    """
    controlled = checked_columns(interaction_matrix, n_modes)
    normal = controlled.T @ controlled
    power = np.linalg.eigvalsh(normal)
    if power[0] * min(max_condition, _WELL) ** 2 > power[-1]:
        # nothing is left out: the normal equations say the same at a third of the cost
        factor = scipy.linalg.cho_factor(normal, overwrite_a=True)
        return Inversion(
            matrix=_by_slopes(controlled, lambda some: scipy.linalg.cho_solve(factor, some.T)),
            condition_number=_condition_of(power),
            n_truncated=0,
        )
    if n_modes >= _MANY and max_condition <= _WELL:
        return _of_eigenvectors(controlled, normal, max_condition)
    left, singular, right = scipy.linalg.svd(controlled, full_matrices=False)
    kept = singular > singular[0] / max_condition
    inverse = (right[kept].T / singular[kept]) @ left[:, kept].T
    return Inversion(
        matrix=np.ascontiguousarray(inverse, dtype=np.float32),
        condition_number=float(singular[0] / singular[-1]),
        n_truncated=int(np.count_nonzero(~kept)),
    )


def _of_eigenvectors(controlled: Array, normal: Array, max_condition: float) -> Inversion:
    """Return the truncated inverse by the eigenvectors of the normal equations.

    Their eigenvalues are the squares of the singular values.
    """
    power, axes = np.linalg.eigh(normal)
    kept = power * max_condition**2 > power[-1]
    inverse = (axes[:, kept] / power[kept]) @ axes[:, kept].T
    return Inversion(
        matrix=_by_slopes(controlled, lambda some: inverse @ some.T),
        condition_number=_condition_of(power),
        n_truncated=int(np.count_nonzero(~kept)),
    )


def _by_slopes(controlled: Array, solve: Callable[[Array], Array]) -> NDArray[np.float32]:
    """Return what ``solve`` makes of rows ``(n, n_modes)``, ``(n_modes, n)``, for all of them."""
    matrix = np.empty(controlled.shape[::-1], np.float32)
    for start in range(0, len(controlled), _SLOPES_AT_ONCE):
        part = slice(start, start + _SLOPES_AT_ONCE)
        matrix[:, part] = solve(controlled[part])
    return matrix


def _condition(controlled: Array) -> float:
    """Return the largest over the smallest singular value."""
    if controlled.shape[1] < _MANY:
        singular = scipy.linalg.svdvals(controlled)
        return float(singular[0] / singular[-1])
    return _condition_of(np.linalg.eigvalsh(controlled.T @ controlled))


def _condition_of(power: NDArray[np.floating]) -> float:
    """Return the same of the normal equations' rising eigenvalues, good to 1e-16 of the largest.

    A condition beyond 1e8 cannot be told, and is told as that.
    """
    return float(np.sqrt(power[-1] / max(power[0], np.finfo(np.float64).eps * power[-1])))


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """Sizes of the modes and noise of the slopes, known beforehand."""

    variance_m2: Array
    """``(n_basis,)`` expected variance of each mode, metres² OPD; a KL basis knows it."""

    slope_noise: Array
    """``(n_slopes,)`` 1 σ of each slope in one frame; 0 nowhere."""

    def __post_init__(self) -> None:
        """Refuse what cannot be divided by.

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

    As many modes are estimated as both matrix and prior know. Each row is scaled so that its own
    mode comes back whole (the diagonal of ``R D`` is 1): a loop gain then means what it means with
    any other reconstructor, and how much to trust a mode remains the gain's business.

    Raises
    ------
    ModelError
        As :func:`invert`; also if the prior is of other slopes or of fewer modes.

    References
    ----------
    Gilles 2005, Appl. Opt. 44, 993; Correia et al. 2013, JOSA A 30, 1726.
    """
    n_estimated = min(interaction_matrix.shape[1], len(prior.variance_m2))
    controlled = checked_columns(interaction_matrix, n_modes)
    if n_modes > n_estimated or len(prior.slope_noise) != len(controlled):
        raise ModelError(
            f"reconstructor: found a prior of {len(prior.variance_m2)} modes and "
            f"{len(prior.slope_noise)} slopes; expected at least {n_modes} and {len(controlled)}"
        )
    matrix = checked_columns(interaction_matrix, n_estimated)
    amplitude = np.sqrt(prior.variance_m2[:n_estimated])
    # in units of noise and of the prior both matrices are of order one: nothing overflows
    white = matrix * amplitude / prior.slope_noise[:, None]
    system = scipy.linalg.cho_factor(white.T @ white + np.eye(n_estimated))
    estimate = scipy.linalg.cho_solve(system, white.T)[:n_modes] * amplitude[:n_modes, None]
    estimate /= prior.slope_noise
    estimate /= np.einsum("ij,ji->i", estimate, controlled)[:, None]
    return Inversion(
        matrix=np.ascontiguousarray(estimate, dtype=np.float32),
        condition_number=_condition(controlled),
        n_truncated=0,
    )


class InversionMethod(StrEnum):
    """Ways to invert an interaction matrix."""

    SVD = "svd"
    """Least squares; singular values too weak are left out."""

    MAP = "map"
    """Least squares weighted by noise, with the turbulence as prior."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recipe:
    """How to invert an interaction matrix."""

    n_modes: int
    """Modes to control: the first ones of the basis."""

    max_condition: float = MAX_CONDITION
    """SVD: singular values below the largest over this are left out."""

    prior: Prior | None = None
    """What is known of modes and noise; None: nothing."""

    @property
    def method(self) -> InversionMethod:
        """The method: MAP if there is a prior."""
        return InversionMethod.SVD if self.prior is None else InversionMethod.MAP


def reconstruct(interaction_matrix: NDArray[Any], recipe: Recipe) -> Inversion:
    """Return the reconstructor of a single-pass interaction matrix ``(n_slopes, n_columns)``.

    Raises
    ------
    ModelError
        If the matrix cannot be inverted so: see the methods.
    """
    if recipe.prior is not None:
        return invert_with_prior(interaction_matrix, recipe.n_modes, recipe.prior)
    return invert(interaction_matrix, recipe.n_modes, max_condition=recipe.max_condition)
