"""One Kalman filter for α and the bias of passive estimates.

Under frozen flow the passive watchdog reads ``α + b``: a look scatters by 0.3 to 0.5 % of a
subaperture and is wrong by up to 9 % on the diffractive telescope, 24 % on the linear plant
(docs/results/passive.md), steadily, until wind, flux or gain change. A dithered window reads α
alone. Between them b is learnt, and a sparse dither then suffices.

b has four parts. Those of rotation and magnification are small, but no more than the shifts' do
they average out over consecutive looks, as a noise would. How large b may be each look's own
scatter tells: what it tells beyond all looks before is new, and may have changed b by as much.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from service.estimation.estimate import BIAS_FLOOR

Array = NDArray[np.float64]

JUMP_THRESHOLD = 23.5
"""Normalised innovation squared that four degrees of freedom exceed once in 10 000."""

JUMP_INFLATION = 10.0
"""After a jump each parameter may have moved by this many σ of the innovation."""

SCATTER_LEARNING = 0.05
"""Weight of the newest in how much windows, and looks, scatter: twenty are remembered."""

DITHERED = np.hstack([np.eye(4), np.zeros((4, 4))])
"""What a dithered window sees of the mean, ``(4, 8)``: α."""

PASSIVE = np.hstack([np.eye(4), np.eye(4)])
"""What a look at ordinary telemetry sees: α and the bias together."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Joint:
    """The random walk of α, and the bias that forgets itself."""

    mean: Array
    """``(8,)`` α in numeric units, then the bias of the passive estimate."""

    covariance: Array
    """``(8, 8)``."""

    excess: Array = field(default_factory=lambda: np.zeros(4))
    """``(4,)`` variance of the bias beyond ``BIAS_FLOOR`` that looks have told of, and that is in
    the covariance or has been learnt away since."""

    scatter: float = 1.0
    """How much more looks scatter than their covariances say, in variance; never less than 1."""

    @property
    def alpha(self) -> Array:
        """``(4,)`` the registration."""
        return self.mean[:4]

    @property
    def alpha_covariance(self) -> Array:
        """``(4, 4)`` of the registration alone."""
        return self.covariance[:4, :4]

    @property
    def bias(self) -> Array:
        """``(4,)`` what a passive estimate reads more than α."""
        return self.mean[4:]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drift:
    """Rates of change of α and bias."""

    alpha_rate: Array
    """``(4,)`` random walk σ after one second, numeric units."""

    bias_memory_s: float = 3600.0
    """Time after which what was learnt of the bias is worth 1/e."""


def begin_joint(measured: Array, covariance: Array) -> Joint:
    """Return the estimate after a first dithered measurement: nothing is known of the bias."""
    full = np.zeros((8, 8))
    full[:4, :4] = covariance
    return forget(Joint(mean=np.concatenate([measured, np.zeros(4)]), covariance=full))


def forget(joint: Joint, excess: Array | None = None) -> Joint:
    """Return the estimate with nothing known of the bias any more; α stands.

    ``excess`` ``(4,)`` is the bias' variance beyond ``BIAS_FLOOR`` by the look at hand, if any.
    """
    excess = np.zeros(4) if excess is None else excess
    covariance = joint.covariance.copy()
    covariance[4:] = covariance[:, 4:] = 0.0
    covariance[4:, 4:] = np.diag(BIAS_FLOOR**2 + excess)
    mean = np.concatenate([joint.alpha, np.zeros(4)])
    return replace(joint, mean=mean, covariance=covariance, excess=excess)


def allowing(joint: Joint, excess: Array) -> Joint:
    """Return the estimate with its covariance enlarged by so much excess scatter.

    Only what is more than looks before have told is added: a steady wind adds it once, and what
    has been learnt of the bias stays learnt.
    """
    more = np.maximum(excess - joint.excess, 0.0)
    covariance = joint.covariance.copy()
    covariance[4:, 4:] += np.diag(more)
    return replace(joint, covariance=covariance, excess=joint.excess + more)


def predicted(joint: Joint, drift: Drift, elapsed_s: float, flexure: Array | None = None) -> Joint:
    """Bring the estimate forward: α walks, the bias decays towards knowing nothing of it.

    ``flexure`` ``(4,)`` is the 1 σ of what the telescope's own motion has added meanwhile.
    """
    elapsed = max(elapsed_s, 0.0)
    keep = np.ones(8)
    keep[4:] = np.exp(-elapsed / drift.bias_memory_s)
    growth = np.zeros(8)
    growth[:4] = drift.alpha_rate**2 * elapsed
    if flexure is not None:
        growth[:4] += flexure**2
    growth[4:] = BIAS_FLOOR**2 * (1.0 - keep[4:] ** 2)
    covariance = joint.covariance * np.outer(keep, keep) + np.diag(growth)
    # what fades of the excess the next look that tells of it brings back
    excess = keep[4:] ** 2 * joint.excess
    return replace(joint, mean=keep * joint.mean, covariance=covariance, excess=excess)


def innovation(prior: Joint, measured: Array, noise: Array, sees: Array = DITHERED) -> float:
    """Return how far a measurement lies from the prior: squared, normalised, expected 4."""
    difference = measured - sees @ prior.mean
    total = sees @ prior.covariance @ sees.T + noise
    return float(difference @ np.linalg.solve(total, difference))


def corrected(prior: Joint, measured: Array, noise: Array, sees: Array = DITHERED) -> Joint:
    """Fold in a measurement ``(4,)`` with the covariance ``(4, 4)`` of its own scatter."""
    total = sees @ prior.covariance @ sees.T + noise
    gain = np.linalg.solve(total, sees @ prior.covariance).T
    keep = np.eye(8) - gain @ sees
    posterior = keep @ prior.covariance @ keep.T + gain @ noise @ gain.T
    return replace(
        prior,
        mean=prior.mean + gain @ (measured - sees @ prior.mean),
        covariance=(posterior + posterior.T) / 2,
    )


def scattered(joint: Joint, innovation: float) -> Joint:
    """Return the estimate after an innovation, 4 expected, with ``scatter`` learnt from it.

    In fast wind the bias swings from look to look, and looks scatter by more than they say.
    """
    return replace(joint, scatter=learnt(joint.scatter, innovation))


def learnt(scatter: float, innovation: float) -> float:
    """Return how much more measurements scatter than they say, in variance, after one more.

    Parameters
    ----------
    scatter
        What those before have told; never less than 1.
    innovation
        Of the newest, squared and normalised with that much scatter allowed for: 4 is expected.
    """
    seen = min(innovation, JUMP_THRESHOLD) / 4.0
    return max(scatter * (1.0 + SCATTER_LEARNING * (seen - 1.0)), 1.0)


def widened(prior: Joint, noise: Array) -> Joint:
    """Return the state after a jump of α; the next measurement must say how far.

    The bias is kept: the wind has not moved with the mirror.
    """
    moved = np.zeros(8)
    moved[:4] = np.diag(prior.covariance)[:4] + np.diag(noise)
    return replace(prior, covariance=prior.covariance + JUMP_INFLATION**2 * np.diag(moved))
