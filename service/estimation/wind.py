"""The registration and the wind's bias of its passive estimate, followed together.

Under frozen flow the passive watchdog reads ``α + b``: it scatters by 0.1 to 0.3 % of a subaperture
and is wrong by up to 16 %, steadily, until wind, flux or gain change. A dithered window reads α
alone. Between them b is learnt, and a sparse dither then suffices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.estimation.kalman import JUMP_INFLATION, JUMP_THRESHOLD

Array = NDArray[np.float64]

N_BIAS = 2
"""Shifts are biased by the wind; rotation and magnification hardly."""

BIAS_SIGMA_SUBAP = 0.10
"""1 σ of the bias while nothing is known of it: 16 % of a subaperture at 25 m/s at most."""

PASSIVE_FLOOR = np.array([0.0, 0.0, np.deg2rad(0.02), 0.0007])
"""1 σ that no integration removes from a passive estimate, besides b (numeric units)."""

_DITHERED = np.hstack([np.eye(4), np.zeros((4, N_BIAS))])
_PASSIVE = np.hstack([np.eye(4), np.eye(4)[:, :N_BIAS]])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Joint:
    """The random walk of α, and the bias that forgets itself."""

    mean: Array
    """``(6,)`` α in numeric units, then the bias of the two shifts, subapertures."""

    covariance: Array
    """``(6, 6)``."""

    t_s: float
    """When it was last brought forward."""

    innovation: float = 0.0
    """Normalised innovation squared of the last measurement, expected value 4."""

    jumped: bool = False
    """Whether that was too large: α has moved at once, or the wind has."""

    @property
    def alpha(self) -> Array:
        """``(4,)`` the registration."""
        return self.mean[:4]

    @property
    def alpha_covariance(self) -> Array:
        """``(4, 4)`` of the registration alone."""
        return self.covariance[:4, :4]

    @property
    def bias_subap(self) -> Array:
        """``(2,)`` what the wind adds to the passive shifts."""
        return self.mean[4:]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drift:
    """How fast what is followed may change."""

    alpha_rate: Array
    """``(4,)`` random walk σ after one second, numeric units."""

    bias_memory_s: float = 3600.0
    """Time after which what was learnt of the wind's bias is worth 1/e."""


def begin_joint(measured: Array, covariance: Array, t_s: float) -> Joint:
    """Return the estimate after a first dithered measurement: nothing is known of the bias."""
    full = np.zeros((4 + N_BIAS, 4 + N_BIAS))
    full[:4, :4] = covariance
    full[4:, 4:] = BIAS_SIGMA_SUBAP**2 * np.eye(N_BIAS)
    return Joint(mean=np.concatenate([measured, np.zeros(N_BIAS)]), covariance=full, t_s=t_s)


def predicted(joint: Joint, drift: Drift, t_s: float) -> Joint:
    """Bring the estimate forward: α walks, the bias decays towards knowing nothing of it."""
    elapsed = max(t_s - joint.t_s, 0.0)
    keep = np.ones(4 + N_BIAS)
    keep[4:] = np.exp(-elapsed / drift.bias_memory_s)
    growth = np.zeros(4 + N_BIAS)
    growth[:4] = drift.alpha_rate**2 * elapsed
    growth[4:] = BIAS_SIGMA_SUBAP**2 * (1.0 - keep[4:] ** 2)
    covariance = joint.covariance * np.outer(keep, keep) + np.diag(growth)
    return replace(joint, mean=keep * joint.mean, covariance=covariance, t_s=max(t_s, joint.t_s))


def with_dithered(
    joint: Joint, measured: Array, noise: Array, *, drift: Drift, t_s: float
) -> Joint:
    """Fold in a dithered window ``(4,)`` with its covariance ``(4, 4)``.

    After a jump of α the bias is kept: the wind has not moved with the mirror.
    """
    prior = predicted(joint, drift, t_s)
    return _corrected(prior, measured, noise, _DITHERED)


def with_passive(
    joint: Joint, measured: Array, scatter: Array, *, drift: Drift, t_s: float
) -> Joint:
    """Fold in a passive estimate ``(4,)`` with the covariance of its scatter ``(4, 4)``.

    An innovation that is too large is not believed, for it may be the wind: what was learnt of the
    bias is forgotten, α keeps its value, and ``jumped`` asks for a dither.
    """
    prior = predicted(joint, drift, t_s)
    noise = scatter + np.diag(PASSIVE_FLOOR**2)
    innovation = _innovation(prior, measured, noise, _PASSIVE)
    if innovation <= JUMP_THRESHOLD:
        return _corrected(prior, measured, noise, _PASSIVE)
    forgotten = prior.covariance.copy()
    forgotten[4:] = forgotten[:, 4:] = 0.0
    forgotten[4:, 4:] = BIAS_SIGMA_SUBAP**2 * np.eye(N_BIAS)
    mean = np.concatenate([prior.alpha, np.zeros(N_BIAS)])
    return replace(prior, mean=mean, covariance=forgotten, innovation=innovation, jumped=True)


def _innovation(prior: Joint, measured: Array, noise: Array, sees: Array) -> float:
    difference = measured - sees @ prior.mean
    total = sees @ prior.covariance @ sees.T + noise
    return float(difference @ np.linalg.solve(total, difference))


def _corrected(prior: Joint, measured: Array, noise: Array, sees: Array) -> Joint:
    innovation = _innovation(prior, measured, noise, sees)
    jumped, covariance = innovation > JUMP_THRESHOLD, prior.covariance
    if jumped:
        moved = np.zeros(4 + N_BIAS)
        moved[:4] = np.diag(prior.covariance)[:4] + np.diag(noise)
        covariance = covariance + JUMP_INFLATION**2 * np.diag(moved)
    total = sees @ covariance @ sees.T + noise
    gain = np.linalg.solve(total, sees @ covariance).T
    keep = np.eye(4 + N_BIAS) - gain @ sees
    posterior = keep @ covariance @ keep.T + gain @ noise @ gain.T
    return replace(
        prior,
        mean=prior.mean + gain @ (measured - sees @ prior.mean),
        covariance=(posterior + posterior.T) / 2,
        innovation=innovation,
        jumped=jumped,
    )
