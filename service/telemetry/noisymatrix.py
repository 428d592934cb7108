"""The noisy interaction matrix of a random dither, and the registration in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from service.telemetry.estimator import RANDOM, Determines
from service.telemetry.randomdither import Correlated, Correlations
from service.telemetry.span import WindowRefused

Array = NDArray[Any]

N_STEPS = 4
"""Gauss-Newton steps inside one linearisation: gains and α are multiplied with one another."""

SIGNIFICANT = 5.0
"""σ of a response that counts as seen."""

WHITE_PARTS = 24
"""What is known beforehand of the scatter, that noise is nearly white, counts as so many parts."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyMatrix:
    """An interaction matrix as measured, with the noise of each of its elements.

    For fits and for looking at: at magnitude 10 its elements are no larger than their noise.
    """

    modes: tuple[int, ...]
    """0-based basis index of each column."""

    matrix: NDArray[np.float64]
    """``(n_slopes, n_dithered)`` slope per metre OPD, optical gain included."""

    noise: NDArray[np.float64]
    """``(n_slopes, n_dithered)`` 1 σ of each element, from the slopes' own scatter."""

    slope_memory: float
    """Lag-1 correlation of the slopes that was taken out before correlating, -1..1."""

    @property
    def snr_of_modes(self) -> NDArray[np.float64]:
        """``(n_dithered,)`` RMS signal of a column's elements over their noise; 0: none seen."""
        power = np.mean((self.matrix / self.noise) ** 2, axis=0) - 1.0
        return np.asarray(np.sqrt(np.maximum(power, 0.0)))

    @property
    def snr(self) -> float:
        """RMS signal of an element over its noise, over the whole matrix."""
        power = float(np.mean((self.matrix / self.noise) ** 2)) - 1.0
        return float(np.sqrt(max(power, 0.0)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RandomEstimate:
    """What one window of random dither says of the registration."""

    alpha: Misregistration
    covariance: NDArray[np.float64]
    """``(4, 4)`` numeric units, from the scatter of the window's parts; no model error in it."""

    optical_gain: NDArray[np.float64]
    """``(n_dithered,)`` gain of each mode against the model."""

    gain_sigma: NDArray[np.float64]
    """``(n_dithered,)`` 1 σ of it."""

    lag_frames: NDArray[np.float64]
    """``(1,)`` share of the response that comes one frame late; 0 when the columns are aligned."""

    misfit: float
    """Residual power over what the elements' noise explains; 1: the model explains the data."""

    step: NDArray[np.float64]
    """``(4,)`` distance from the linearisation to the estimate, numeric units."""

    t_ns_utc: int
    """End of the window."""

    cm_id: str | None
    session: str
    modes: tuple[int, ...]
    """0-based basis index of each gain."""

    @property
    def determines(self) -> Determines:
        """Which of the four parameters it can tell."""
        return RANDOM

    def gains_by_group(self, n_groups: int) -> tuple[tuple[int, ...], Array, Array]:
        """Return modes, gains and their 1 σ of at most so many groups of neighbours, in order.

        One mode among hundreds says little of its gain, and neighbours have nearly the same: they
        are averaged by their noise, and the middle one stands for all.
        """
        order = np.argsort(self.modes)
        groups = [g for g in np.array_split(order, min(n_groups, len(order))) if len(g)]
        weights = self.gain_sigma**-2.0
        gains = [float(np.average(self.optical_gain[g], weights=weights[g])) for g in groups]
        sigma = [float(weights[g].sum() ** -0.5) for g in groups]
        modes = tuple(self.modes[g[len(g) // 2]] for g in groups)
        return modes, np.array(gains), np.array(sigma)


def noisy_matrix(window: Correlated) -> NoisyMatrix:
    """Return the interaction matrix that a window's correlations hold.

    ``D = sum e[k] u[k]^T (sum u u^T)^-1`` with ``e[k] = s[k] - ρ s[k-1]``, in which most of the
    turbulence is gone.
    """
    sums = window.sums
    power = np.linalg.inv(sums.dither_power.sum(axis=0))
    noise = np.sqrt(np.outer(_noise_variance(sums), np.diag(power)))
    return NoisyMatrix(
        modes=window.plan.modes,
        matrix=sums.response.sum(axis=0, dtype=float) @ power,
        noise=noise,
        slope_memory=sums.memory,
    )


def fit_random(window: Correlated, linearisation: Linearisation) -> RandomEstimate | WindowRefused:
    """Estimate α and a free gain per mode from one window, to first order.

    Variable projection (Kaufman 1975) on the noisy matrix, each slope weighted by its noise. The
    covariance is from the scatter of the scores of the window's batches or, where there are many
    modes, of the modes: turbulence correlated over slopes then counts for what it is. Refused when
    the mirror answers a frame late: the columns are then misaligned and the matrix is not clean.
    """
    noisy, sums = noisy_matrix(window), window.sums
    columns = list(noisy.modes)
    uncertain = np.diag(np.linalg.inv(sums.dither_power.sum(axis=0)))
    problem = _Problem(
        matrix=linearisation.matrix[:, columns].astype(float),
        derivatives=linearisation.derivatives[:, :, columns].astype(float),
        variance=_noise_variance(sums),
        power=1.0 / uncertain,
    )
    seen = _Seen.of(window, noisy, problem)
    if seen.trouble is not None:
        return WindowRefused(reason=seen.trouble, t_ns_utc=window.t_end_ns_utc)
    step = np.zeros(4)
    for _ in range(N_STEPS):
        gains, jacobian, residual = problem.at(step, noisy.matrix)
        normal, score = problem.equations(jacobian, residual)
        step = step + np.linalg.solve(normal, score)
    gains, jacobian, residual = problem.at(step, noisy.matrix)
    n_free = residual.size - len(gains) - len(step)
    inverse = np.linalg.inv(normal)
    parts = [residual]
    if window.plan.n_batches > 1:
        parts = _residuals_of_batches(sums, gains * problem.response(step))
    spread = _scatter(_scores(parts, jacobian, problem.weight), normal)
    return RandomEstimate(
        alpha=Misregistration.from_vector(linearisation.alpha.vector + step),
        covariance=inverse @ spread @ inverse.T,
        optical_gain=gains,
        gain_sigma=_gain_sigma(parts, problem, step),
        lag_frames=np.array([seen.lag_frames]),
        misfit=float(np.sum(problem.weight * residual**2) / n_free),
        step=step,
        t_ns_utc=window.t_end_ns_utc,
        cm_id=window.cm_id,
        session=window.session,
        modes=noisy.modes,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Problem:
    """Weighted separable least squares: α is common, a gain is each mode's own."""

    matrix: Array
    derivatives: Array
    variance: Array
    """``(n_slopes,)`` of a slope's noise in one frame."""

    power: Array
    """``(n_dithered,)`` sum of the square of each mode's dither, of what no other mode's explains
    of it, metres²."""

    @property
    def weight(self) -> Array:
        """``(n_slopes, n_dithered)`` inverse variance of each element."""
        return np.outer(1.0 / self.variance, self.power)

    def response(self, step: Array) -> Array:
        return np.asarray(self.matrix + np.tensordot(step, self.derivatives, axes=1))

    def at(self, step: Array, measured: Array) -> tuple[Array, Array, Array]:
        """Return gains, the projected Jacobian ``(4, n_slopes, n_modes)`` and the residual."""
        response = self.response(step)
        weighted = self.weight * response
        norm = np.einsum("sm,sm->m", response, weighted)
        gains = np.einsum("sm,sm->m", weighted, measured) / norm
        along = np.einsum("sm,jsm->jm", weighted, self.derivatives) / norm
        jacobian = gains * (self.derivatives - along[:, None] * response)
        return gains, jacobian, measured - gains * response

    def equations(self, jacobian: Array, residual: Array) -> tuple[Array, Array]:
        """Return the normal matrix ``(4, 4)`` and the score ``(4,)``."""
        flat = (jacobian * np.sqrt(self.weight)).reshape(len(jacobian), -1)
        return flat @ flat.T, flat @ (residual * np.sqrt(self.weight)).ravel()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Seen:
    """How strongly the slopes answer the dither, and when."""

    lag_frames: float
    trouble: str | None
    """Why lag 0 is not the first that responds; None: it is."""

    @classmethod
    def of(cls, window: Correlated, noisy: NoisyMatrix, problem: _Problem) -> _Seen:
        """Compare the answers in the dither's own row and in the next, on a few of the modes.

        A loop of less than two frames answers the next row itself, against the mirror: a negative
        share is its reply, and no lag.
        """
        sums, some = window.sums, window.plan.late_columns
        power = np.diag(sums.dither_power.sum(axis=0))[some]
        matrix, weight = problem.matrix[:, some], problem.weight[:, some]
        along = weight * matrix
        norm = float(np.vdot(along, matrix))
        at_once = float(np.vdot(along, noisy.matrix[:, some])) / norm
        later = float(np.vdot(along, sums.late / power)) / norm
        whole = float(np.einsum("sm,sm,sm->", problem.matrix, problem.weight, noisy.matrix))
        seen = whole / np.sqrt(
            np.einsum("sm,sm,sm->", problem.matrix, problem.weight, problem.matrix)
        )
        # the late response was not whitened: its noise is that of the slopes as they are
        louder = np.sqrt(sums.slope_power.sum() / sums.noise_power.sum())
        late = later * np.sqrt(norm) / louder
        lag = max(later / (at_once + later), 0.0) if at_once + later > 0.0 else 0.0
        return cls(lag_frames=min(lag, 1.0), trouble=_trouble(seen, late))


def _trouble(seen: float, late: float) -> str | None:
    """Return why there is nothing to fit, from the significance of both answers, in σ."""
    if seen > SIGNIFICANT:
        return None
    if late > SIGNIFICANT:
        return (
            f"columns misaligned: the slopes answer the dither one frame late ({late:.0f} sigma, "
            f"{seen:.0f} in the same row)"
        )
    return (
        f"the dither is not seen in the slopes ({seen:.1f} sigma): raise its amplitude or the "
        "window's length"
    )


def _noise_variance(sums: Correlations) -> Array:
    """Return ``(n_slopes,)`` variance of what the dither does not explain of ``s[k] - ρ s[k-1]``.

    A silent slope gets the mean.
    """
    power, response = sums.dither_power.sum(axis=0), sums.response.sum(axis=0, dtype=float)
    explained = np.einsum("sm,ms->s", response, np.linalg.solve(power, response.T))
    left = sums.noise_power - explained
    # of a noise-free sensor nothing but rounding is left
    left = np.maximum(left, 1e-12 * sums.noise_power)
    variance = np.where(left > 0.0, left, left.mean()) / max(sums.n_pairs - len(power), 1)
    return np.asarray(variance)


def _residuals_of_batches(sums: Correlations, explained: Array) -> list[Array]:
    """Return each batch's part of the whole window's residual, ``(n_slopes, n_dithered)``."""
    total = np.linalg.inv(sums.dither_power.sum(axis=0))
    return [
        (response - explained @ power) @ total
        for response, power in zip(sums.response, sums.dither_power, strict=True)
    ]


def _scores(parts: list[Array], jacobian: Array, weight: Array) -> Array:
    """Return independent parts of the score, ``(n, 4)``: of the batches, or of the modes."""
    if len(parts) == 1:
        return np.asarray(np.einsum("jsm,sm,sm->mj", jacobian, weight, parts[0]))
    weighted = jacobian * weight
    return np.array([np.einsum("jsm,sm->j", weighted, part) for part in parts])


def _scatter(scores: Array, normal: Array) -> Array:
    """Return the covariance ``(4, 4)`` of the sum of independent scores ``(n, 4)``.

    The shape of the covariance of so few is itself uncertain: it is drawn toward that of white
    noise, which is ``normal``.
    """
    n, own = len(scores), scores - scores.mean(axis=0)
    found = own.T @ own * n / (n - 1)
    inflation = float(np.trace(np.linalg.solve(normal, found))) / len(normal)
    return np.asarray((WHITE_PARTS * inflation * normal + n * found) / (WHITE_PARTS + n))


def _gain_sigma(parts: list[Array], problem: _Problem, step: Array) -> Array:
    """Return 1 σ of each mode's gain, ``(n_dithered,)``.

    Turbulence looks like modes: it is louder along a mode's own slopes than its white part says.
    The noise of every column is of the same kind, so all of them show how loud it is there.
    """
    response, root = problem.response(step), np.sqrt(problem.power)
    along = response / problem.variance[:, None]
    seen = np.zeros((len(root), len(root)))
    for part in parts:
        seen += (along.T @ (part * root)) ** 2
    if len(parts) == 1:
        # a column's own gain has taken out what it had along its own slopes
        np.fill_diagonal(seen, np.nan)
    norm = np.einsum("sm,sm->m", along, response)
    return np.asarray(np.sqrt(np.nanmean(seen, axis=1)) / (root * norm))
