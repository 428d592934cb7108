"""The noisy interaction matrix of one window of random dither, and the registration in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.estimation.lockin import WindowRefused
from service.estimation.randomdither import Correlated, Correlations
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration

Array = NDArray[Any]

N_STEPS = 4
"""Gauss-Newton steps inside one linearisation: gains and α are multiplied with one another."""

SIGNIFICANT = 5.0
"""σ of a response that counts as seen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyMatrix:
    """An interaction matrix as measured, with the noise of each of its elements."""

    modes: tuple[int, ...]
    """0-based basis index of each column."""

    matrix: NDArray[np.float64]
    """``(n_slopes, n_dithered)`` slope per metre OPD, optical gain included."""

    noise: NDArray[np.float64]
    """``(n_slopes, n_dithered)`` 1 σ of each element, from the slopes' own scatter."""

    slope_memory: float
    """Lag-1 correlation of the slopes that was taken out before correlating, -1..1."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RandomEstimate:
    """What one window of random dither says of the registration."""

    alpha: Misregistration
    covariance: NDArray[np.float64]
    """``(4, 4)`` numeric units, from the scatter of the window's batches; no model error in it."""

    optical_gain: NDArray[np.float64]
    """``(n_dithered,)`` gain of each mode against the model."""

    misfit: float
    """Residual power over what the elements' noise explains; 1: the model explains the data."""

    step: NDArray[np.float64]
    """``(4,)`` distance from the linearisation to the estimate, numeric units."""

    t_ns_utc: int
    """End of the window."""

    cm_id: str | None
    session: str


def noisy_matrix(window: Correlated) -> NoisyMatrix:
    """Return the interaction matrix that a window's correlations hold.

    ``e[k] = s[k] - ρ s[k-1]`` with ρ the lag-1 correlation of the slopes whitens the turbulence;
    then ``D = sum e[k] u[k]^T (sum u u^T)^-1``.
    """
    sums = window.sums
    memory = _memory(sums)
    power = np.linalg.inv(sums.dither_power.sum(axis=0))
    cross = sums.same.sum(axis=0, dtype=float) - memory * sums.before.sum(axis=0, dtype=float)
    noise = np.sqrt(np.outer(_whitened_variance(sums, memory), np.diag(power)))
    return NoisyMatrix(
        modes=window.plan.modes, matrix=cross @ power, noise=noise, slope_memory=memory
    )


def fit_random(window: Correlated, linearisation: Linearisation) -> RandomEstimate | WindowRefused:
    """Estimate α and a free gain per mode from one window, to first order.

    Variable projection (Kaufman 1975) on the noisy matrix, each slope weighted by its noise. The
    covariance is that of the scores of the window's batches, so that turbulence correlated over
    slopes and frames counts for what it is. Refused when the mirror answers a frame late: the
    columns are then misaligned and the matrix is not clean.
    """
    noisy, sums = noisy_matrix(window), window.sums
    columns = list(noisy.modes)
    power = sums.dither_power.sum(axis=0)
    problem = _Problem(
        matrix=linearisation.matrix[:, columns].astype(float),
        derivatives=linearisation.derivatives[:, :, columns].astype(float),
        weight=np.outer(1.0 / _whitened_variance(sums, noisy.slope_memory), np.diag(power)),
    )
    late = _why_late(sums, noisy, problem)
    if late is not None:
        return WindowRefused(reason=late, t_ns_utc=window.t_end_ns_utc)
    step = np.zeros(4)
    for _ in range(N_STEPS):
        gains, jacobian, residual = problem.at(step, noisy.matrix)
        normal = np.einsum("jsm,sm,ism->ji", jacobian, problem.weight, jacobian)
        score = np.einsum("jsm,sm,sm->j", jacobian, problem.weight, residual)
        step = step + np.linalg.solve(normal, score)
    gains, jacobian, residual = problem.at(step, noisy.matrix)
    explained = gains * problem.response(step)
    n_free = residual.size - len(gains) - len(step)
    inverse = np.linalg.inv(normal)
    spread = _scatter_of_batches(sums, noisy.slope_memory, explained, jacobian, problem.weight)
    return RandomEstimate(
        alpha=Misregistration.from_vector(linearisation.alpha.vector + step),
        covariance=inverse @ spread @ inverse.T,
        optical_gain=gains,
        misfit=float(np.sum(problem.weight * residual**2) / n_free),
        step=step,
        t_ns_utc=window.t_end_ns_utc,
        cm_id=window.cm_id,
        session=window.session,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Problem:
    """Weighted separable least squares: α is common, a gain is each mode's own."""

    matrix: Array
    derivatives: Array
    weight: Array

    def response(self, step: Array) -> Array:
        return np.asarray(self.matrix + np.tensordot(step, self.derivatives, axes=1))

    def at(self, step: Array, measured: Array) -> tuple[Array, Array, Array]:
        """Return gains, the projected Jacobian ``(4, n_slopes, n_modes)`` and the residual."""
        response = self.response(step)
        norm = np.einsum("sm,sm,sm->m", response, self.weight, response)
        gains = np.einsum("sm,sm,sm->m", response, self.weight, measured) / norm
        along = np.einsum("sm,sm,jsm->jm", response, self.weight, self.derivatives) / norm
        jacobian = gains * (self.derivatives - along[:, None] * response)
        return gains, jacobian, measured - gains * response


def _memory(sums: Correlations) -> float:
    return float(sums.slope_memory.sum() / sums.slope_power.sum())


def _whitened_variance(sums: Correlations, memory: float) -> Array:
    """Return ``(n_slopes,)`` variance of ``s[k] - ρ s[k-1]``; a silent slope gets the mean."""
    power = (1.0 + memory**2) * sums.slope_power - 2.0 * memory * sums.slope_memory
    return np.where(power > 0.0, power, power.mean()) / sums.n_pairs


def _scatter_of_batches(
    sums: Correlations, memory: float, explained: Array, jacobian: Array, weight: Array
) -> Array:
    """Return the covariance of the whole window's score from that of its batches, ``(4, 4)``."""
    total = np.linalg.inv(sums.dither_power.sum(axis=0))
    scores = []
    for same, before, power in zip(sums.same, sums.before, sums.dither_power, strict=True):
        residual = (same - memory * before - explained @ power) @ total
        scores.append(np.einsum("jsm,sm,sm->j", jacobian, weight, residual))
    own = np.array(scores) - np.mean(scores, axis=0)
    n = len(own)
    return np.asarray(own.T @ own * n / (n - 1))


def _why_late(sums: Correlations, noisy: NoisyMatrix, problem: _Problem) -> str | None:
    """Return why lag 0 is not the first that responds, or None."""
    power = np.linalg.inv(sums.dither_power.sum(axis=0))
    late = (sums.after - noisy.slope_memory * sums.same.sum(axis=0)) @ power
    norm = np.einsum("sm,sm,sm->", problem.matrix, problem.weight, problem.matrix)
    at_once, later = (
        float(np.einsum("sm,sm,sm->", problem.matrix, problem.weight, d) / np.sqrt(norm))
        for d in (noisy.matrix, late)
    )
    if at_once > SIGNIFICANT:
        return None
    if later > SIGNIFICANT:
        return (
            f"columns misaligned: the slopes answer the dither one frame late ({later:.0f} sigma, "
            f"{at_once:.0f} in the same row)"
        )
    return (
        f"the dither is not seen in the slopes ({at_once:.1f} sigma): raise its amplitude or the "
        "window's length"
    )
