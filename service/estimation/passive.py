"""The watchdog: registration from ordinary telemetry, without a dither.

First differences of slopes and commands of the same frame give a noisy interaction matrix. It is
a measurement to fit a model to, never a matrix to control with. Differencing once is the most a
two-frame delay allows: more lets slope noise re-enter through the loop. Frozen flow biases the
shifts by 1.6 % of a subaperture at 8 m/s and 16 % at 25 m/s, and no integration removes it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from service.estimation.frames import FrameBlock
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration

Array = NDArray[Any]

BIAS_FLOOR = np.array([0.10, 0.10, np.deg2rad(0.05), 0.001])
"""1 σ nobody may go below without a dither: the wind's bias of the shifts, measured otherwise."""

MIN_FRAMES_PER_MODE = 5
"""Fewer effective frames leave the command covariance too noisy to invert."""

_RIDGE = 1e-6
_STILL_RIDGE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Passive:
    """Forgetting sums over first differences: feed it blocks with ``accumulate``."""

    n_modes: int
    """Controlled modes: the only ones that move by themselves."""

    memory_frames: float
    """Frames after which a sample's weight has fallen to 1/e."""

    command_power: NDArray[np.float32] | None = None
    """``(n_modes, n_modes)`` sum of dc dc^T, metres²."""

    cross: NDArray[np.float32] | None = None
    """``(n_slopes, n_modes)`` sum of ds dc^T, metres."""

    slope_power: float = 0.0
    """Sum of |ds|²."""

    n_effective: float = 0.0
    """Frames in the sums, forgetting included."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveEstimate:
    """What ordinary telemetry says of the registration."""

    alpha: Misregistration
    sigma: NDArray[np.float64]
    """``(4,)`` numeric units, never below ``BIAS_FLOOR``."""

    gains: NDArray[np.float64]
    """``(n_modes,)`` free gain of each mode against the model."""

    step: NDArray[np.float64]
    """``(4,)`` distance from the linearisation."""


def accumulate(state: Passive, block: FrameBlock) -> Passive:
    """Add a block of frames; no difference spans two blocks."""
    if block.n_frames < 2:
        return state
    commands = np.diff(block.commands_m[:, : state.n_modes], axis=0)
    slopes = np.diff(block.slopes, axis=0)
    n = len(commands)
    fade = float(np.exp(-n / state.memory_frames))
    power, cross = commands.T @ commands, slopes.T @ commands
    if state.command_power is not None and state.cross is not None:
        power += np.float32(fade) * state.command_power
        cross += np.float32(fade) * state.cross
    return replace(
        state,
        command_power=power,
        cross=cross,
        slope_power=fade * state.slope_power + float(np.vdot(slopes, slopes)),
        n_effective=fade * state.n_effective + n,
    )


def interaction_matrix(state: Passive) -> Array | None:
    """Return the noisy interaction matrix ``(n_slopes, n_modes)``, or None when too young."""
    found = _noisy_matrix(state)
    return None if found is None else found[0]


def _noisy_matrix(state: Passive) -> tuple[Array, Array] | None:
    """Return the noisy matrix and the relative noise variance ``(n_modes,)`` of its columns.

    The residual slopes are as noisy for every column, so a column's noise is what the inverse of
    the command covariance makes of it: the diagonal of that inverse.
    """
    if state.command_power is None or state.cross is None:
        return None
    if state.n_effective < MIN_FRAMES_PER_MODE * state.n_modes:
        return None
    power = _invertible_power(state.command_power)
    if power is None:
        return None
    lower, _ = factor = cho_factor(power, lower=True)
    half = solve_triangular(lower, np.eye(len(power)), lower=True)
    matrix = cho_solve(factor, state.cross.T.astype(np.float64)).T
    return np.asarray(matrix), np.einsum("km,km->m", half, half)


def _invertible_power(command_power: Array) -> Array | None:
    """Return the command covariance with a ridge; None when no mode has moved at all.

    The ridge is relative to each mode's own power, or the strongest would drown the weakest, with
    just enough of the mean for a mode that never moves.
    """
    power = command_power.astype(np.float64)
    own = np.diag(power)
    if not own.any():
        return None
    return np.asarray(power + np.diag(_RIDGE * own + _STILL_RIDGE * own.mean()))


def fit(state: Passive, linearisation: Linearisation) -> PassiveEstimate | None:
    """Fit α and a free gain per mode to the noisy matrix; None when too few frames came.

    Variable projection (Kaufman 1975): ``g_j = D_j.Y_j / D_j.D_j``,
    ``J_jk = g_j (I - P_j) dD_j/dα_k``, each mode weighted by its noise.
    """
    found = _noisy_matrix(state)
    if found is None:
        return None
    measured, noise = found
    weight = 1.0 / (np.mean(np.einsum("sm,sm->m", measured, measured)) * noise)
    modes = slice(0, state.n_modes)
    matrix = linearisation.matrix[:, modes].astype(np.float64)
    norm = np.einsum("sm,sm->m", matrix, matrix)
    gains = np.einsum("sm,sm->m", matrix, measured) / norm
    residual = measured - gains * matrix
    jacobian = []
    for derivative in linearisation.derivatives[:, :, modes].astype(np.float64):
        along = np.einsum("sm,sm->m", matrix, derivative) / norm
        jacobian.append(gains * (derivative - along * matrix))
    flat = np.array([(j * np.sqrt(weight)).ravel() for j in jacobian])
    target = (residual * np.sqrt(weight)).ravel()
    normal = flat @ flat.T
    step = np.linalg.solve(normal, flat @ target)
    left = target - step @ flat
    scatter = np.linalg.inv(normal) * (left @ left) / (left.size - state.n_modes - 4)
    return PassiveEstimate(
        alpha=Misregistration.from_vector(linearisation.alpha.vector + step),
        sigma=np.sqrt(np.diag(scatter) + BIAS_FLOOR**2),
        gains=gains,
        step=step,
    )
