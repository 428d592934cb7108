"""The watchdog: what ordinary telemetry, without a dither, says of the registration.

The turbulence that is left in the filtered commands biases the shifts by the wind, steadily, and no
integration removes it: docs/results/passive.md has by how much.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from service.telemetry.estimator import PASSIVE, Determines
from service.telemetry.highpass import high_pass
from service.telemetry.passivesums import Passive as Passive
from service.telemetry.passivesums import accumulate as accumulate

Array = NDArray[Any]

BIAS_FLOOR = np.array([0.10, 0.10, np.deg2rad(0.05), 0.001])
"""1 σ nobody may go below without a dither: the wind's bias, and the model's own error."""

BIAS_OVER_SCATTER = np.array([10.0, 10.0, 0.0, 0.0])
"""Where the loop's own noise hardly shows (a bright star in 25 m/s) the scatter grows, and the bias
with it: a quarter of a subaperture was seen at a scatter of 0.014."""

MIN_FRAMES_PER_MODE = 5
"""Fewer effective frames leave the command covariance too noisy to invert."""

MIN_SAMPLES = 8
"""Fewer filtered frames do not tell how noisy the slopes are."""

_RIDGE = 1e-6
_STILL_RIDGE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveEstimate:
    """What ordinary telemetry says of the registration."""

    alpha: Misregistration
    covariance: NDArray[np.float64]
    """``(4, 4)`` numeric units, of the scatter alone: the bias is not in it."""

    optical_gain: NDArray[np.float64]
    """``(n_modes,)`` free gain of each mode against the model."""

    misfit: float
    """Residual power over what the slopes' noise explains; 1: the model explains the data. NaN: too
    young to tell."""

    step: NDArray[np.float64]
    """``(4,)`` distance from the linearisation, numeric units."""

    @property
    def bias_excess(self) -> NDArray[np.float64]:
        """``(4,)`` variance that the scatter tells the bias to have beyond ``BIAS_FLOOR``."""
        return np.asarray(np.diag(self.covariance) * BIAS_OVER_SCATTER**2)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """``(4,)`` 1 σ in numeric units where nothing is known of the bias."""
        return np.asarray(np.sqrt(np.diag(self.covariance) + BIAS_FLOOR**2 + self.bias_excess))

    @property
    def determines(self) -> Determines:
        """Which of the four parameters it can tell."""
        return PASSIVE


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyMatrix:
    """What the telemetry makes of the interaction matrix."""

    matrix: NDArray[np.float64]
    """``(n_slopes, n_modes)`` of the controlled modes, slope per metre OPD."""

    shape: NDArray[np.float64]
    """``(n_modes, n_modes)`` covariance of the columns' errors, for slopes with noise of 1."""


def noisy_matrix(state: Passive) -> NoisyMatrix | None:
    """Return the noisy interaction matrix, or None when the telemetry is too young.

    ``D = (sum s z^T) (sum c z^T)^-1``, as z is independent of the noise of its frame. The errors of
    its columns go as ``X^-T (sum z z^T) X^-1`` with ``X = sum c z^T``.
    """
    if state.cross is None or state.moved is None or state.power is None:
        return None
    if state.n_effective < MIN_FRAMES_PER_MODE * state.n_modes:
        return None
    own = np.diag(state.power).astype(np.float64)
    if not own.any():
        return None
    # relative to each mode's own power, or the strongest would drown the weakest, with just
    # enough of the mean for a mode that never moves
    ridge = np.diag(_RIDGE * own + _STILL_RIDGE * own.mean())
    inverse = np.linalg.inv(state.moved.astype(np.float64) + ridge)
    return NoisyMatrix(
        matrix=state.cross.astype(np.float64) @ inverse,
        shape=inverse.T @ state.power.astype(np.float64) @ inverse,
    )


def fit(state: Passive, linearisation: Linearisation) -> PassiveEstimate | None:
    """Fit α and a free gain per mode to the noisy matrix; None when too few frames came.

    Variable projection (Kaufman 1975): ``g_j = D_j.Y_j / D_j.D_j``,
    ``J_jk = g_j (I - P_j) dD_j/dα_k``, each mode weighted by its noise. The errors of the columns
    are not independent (Q), nor are those of the slopes (S): fast turbulence looks like modes. With
    both, ``Cov = A^-1 (J w) (S x Q) (J w)^T A^-1``; the residual tells S.
    """
    found = noisy_matrix(state)
    if found is None:
        return None
    modes = slice(0, state.n_modes)
    matrix = linearisation.matrix[:, modes].astype(np.float64)
    noise = np.diag(found.shape)
    # a mode that never moves has no noise, and no weight
    least = noise[noise > 0.0].min()
    weight = np.where(noise > 0.0, least / np.maximum(noise, least), 0.0)
    norm = np.einsum("sm,sm->m", matrix, matrix)
    gains = np.einsum("sm,sm->m", matrix, found.matrix) / norm
    jacobian = []
    for derivative in linearisation.derivatives[:, :, modes].astype(np.float64):
        along = np.einsum("sm,sm->m", matrix, derivative) / norm
        jacobian.append((gains * (derivative - along * matrix)).ravel())
    flat = np.array(jacobian)
    heavy = (flat.reshape(4, *matrix.shape) * weight).reshape(4, -1)
    residual = (found.matrix - gains * matrix).ravel()
    normal = np.linalg.inv(flat @ heavy.T)
    step = normal @ (heavy @ residual)
    left = (residual - step @ flat).reshape(matrix.shape)
    freedom = (len(matrix) - 1) * (weight @ noise) - 4 * least
    variance = float(np.einsum("sm,sm,m->", left, left, weight) / freedom)
    scores = _patterns(left, noise).T @ heavy.reshape(4, *matrix.shape)
    spread = (scores @ found.shape).reshape(4, -1) @ scores.reshape(4, -1).T
    return PassiveEstimate(
        alpha=Misregistration.from_vector(linearisation.alpha.vector + step),
        covariance=variance * normal @ spread @ normal,
        optical_gain=gains,
        misfit=variance / _slope_variance(state, found.matrix),
        step=step,
    )


def _patterns(left: Array, noise: Array) -> Array:
    """Return what is left of every mode's column as patterns P of the slopes' errors: S = P P^T.

    Their trace is the number of slopes: errors without correlation would make the unit matrix.
    """
    moving = noise > 0.0
    patterns = left[:, moving] / np.sqrt(noise[moving])
    return np.asarray(patterns * np.sqrt(len(left) / np.sum(patterns**2)))


def _slope_variance(state: Passive, matrix: Array) -> float:
    """Return the variance of a slope's noise at the frequencies of the filter."""
    if len(state.samples) < MIN_SAMPLES:
        return float("nan")
    slopes = np.array([slopes for slopes, _ in state.samples])
    commands = np.array([commands for _, commands in state.samples])
    passed = float(np.sum(high_pass(state.delay_frames).taps ** 2))
    return float(np.mean((slopes - commands @ matrix.T) ** 2)) / passed
