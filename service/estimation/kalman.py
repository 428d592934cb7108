"""One Kalman filter for α and the bias of the passive estimate.

Under frozen flow the passive estimate measures ``α + b``: an estimate scatters by 0.3 to 0.5 % of a
subaperture and is biased by up to 9 % on the diffractive telescope, 24 % on the linear plant
(docs/results/tracking.md). The bias is constant until wind, flux or gain change. A dithered window
measures α alone. Between windows b is learnt, so that a sparse dither suffices.

b has four components. Those of rotation and magnification are small, but like those of the shifts
they do not average out over consecutive estimates as noise would. The scatter of each estimate
indicates how large b may be; an increase beyond all earlier values is new information, and may mean
that b has changed by as much.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.records.estimates import BIAS_FLOOR
from service.records.registration import Bias

Array = NDArray[np.float64]

JUMP_THRESHOLD = 23.5
"""Normalised innovation squared that four degrees of freedom exceed once in 10 000."""

JUMP_INFLATION = 10.0
"""Standard deviations of the innovation by which each parameter may have moved after a jump."""

STRETCH_SIGMA = 0.02
"""1 σ of an anamorphosis about the nominal one before anything was measured."""

STRETCH_RATE = 1e-4 / np.sqrt(60.0)
"""Random walk of the anamorphosis after one second. It changes slowly: optics are stretched where
they are mounted, not in the course of a night."""

SCATTER_LEARNING = 0.05
"""Weight of the newest estimate in the scatter of windows, and of passive estimates: about the last
twenty count."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Joint:
    """The random walk of α, and a bias that forgets itself."""

    mean: Array
    """``(n_alpha,)`` α in numeric units, then the four of the bias where there is one."""

    covariance: Array
    """Covariance of all parameters."""

    n_alpha: int = 4
    """Numbers of α: 6 with its anamorphosis."""

    bias: Bias | None = None
    """None if there was no passive estimate yet: the bias is none of the parameters then."""

    @property
    def alpha(self) -> Array:
        """``(4,)`` the registration."""
        return self.mean[:4]

    @property
    def stretches(self) -> Array:
        """``(2,)`` the anamorphosis; ``(0,)`` where it is not followed."""
        return self.mean[4 : self.n_alpha]

    @property
    def alpha_covariance(self) -> Array:
        """``(4, 4)`` of the registration alone."""
        return self.covariance[:4, :4]

    @property
    def place(self) -> slice:
        """Place of the bias among the parameters."""
        return slice(self.n_alpha, self.n_alpha + 4)

    @property
    def offset(self) -> Array:
        """``(4,)`` what a passive estimate reads more than α."""
        return self.mean[self.place]

    def observation_rows(self, *, passive: bool = True) -> Array:
        """Return the four rows a passive estimate sees, α and its bias, or all of α of a window."""
        if not passive:
            return np.eye(self.n_alpha, len(self.mean))
        sees = np.eye(4, len(self.mean))
        sees[:, self.place] = np.eye(4)
        return sees


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drift:
    """Rates of change of α and bias."""

    alpha_rate: Array
    """``(4,)`` random walk σ after one second, numeric units."""

    bias_memory_s: float = 3600.0
    """Time after which the information learnt about the bias has decayed to 1/e."""


def begin_joint(measured: Array, covariance: Array) -> Joint:
    """Return the estimate after a first dithered measurement: nothing is known of the bias."""
    return Joint(mean=measured, covariance=covariance, n_alpha=len(measured))


def with_stretches(joint: Joint, nominal: Array) -> Joint:
    """Return the estimate with an anamorphosis as it is expected, where it has none yet."""
    if joint.n_alpha > 4:
        return joint
    # Inserted between α and the bias; nothing correlates with them yet.
    at, expected = [4, 4], np.square(STRETCH_SIGMA) * np.eye(2)
    covariance = np.insert(np.insert(joint.covariance, at, 0.0, axis=0), at, 0.0, axis=1)
    covariance[4:6, 4:6] = expected
    return replace(joint, mean=np.insert(joint.mean, 4, nominal), covariance=covariance, n_alpha=6)


def expect_stretches(joint: Joint, nominal: Array) -> Joint:
    """Return the estimate after a first measurement, its anamorphosis as likely as it is expected.

    What was measured with it follows as far as it depends on it.
    """
    sees = np.eye(2, len(joint.mean), 4)
    return _update(joint, sees, nominal, np.square(STRETCH_SIGMA) * np.eye(2))


def forget(joint: Joint, excess: Array | None = None) -> Joint:
    """Reset the bias to unknown; α is unchanged.

    ``excess`` ``(4,)`` is the variance of the bias beyond its floor, indicated by the present
    estimate if there is one.
    """
    excess = np.zeros(4) if excess is None else excess
    n_more, place = 4 if joint.bias is None else 0, joint.place
    covariance = np.pad(joint.covariance, (0, n_more))
    # Correlations with α go as well: they were learnt with the bias.
    covariance[place] = covariance[:, place] = 0.0
    covariance[place, place] = np.diag(np.square(BIAS_FLOOR) + excess)
    mean = np.pad(joint.mean, (0, n_more))
    mean[place] = 0.0
    bias = replace(joint.bias or Bias(), excess=excess)
    return replace(joint, mean=mean, covariance=covariance, bias=bias)


def allow_scatter(joint: Joint, excess: Array) -> Joint:
    """Increase the covariance of the bias by the excess scatter.

    Only the excess beyond earlier values is added: a steady wind adds it once, and what was learnt
    about the bias is kept.
    """
    known, covariance = joint.bias or Bias(), joint.covariance.copy()
    more = np.maximum(excess - known.excess, 0.0)
    covariance[joint.place, joint.place] += np.diag(more)
    return replace(joint, covariance=covariance, bias=replace(known, excess=known.excess + more))


def predict_state(
    joint: Joint, drift: Drift, elapsed_s: float, flexure: Array | None = None
) -> Joint:
    """Bring the estimate forward: α walks, the bias decays towards knowing nothing of it.

    ``flexure`` ``(4,)`` is the 1 σ of what the telescope's own motion has added meanwhile.
    """
    elapsed = max(elapsed_s, 0.0)
    keep, growth = np.ones(len(joint.mean)), np.zeros(len(joint.mean))
    keep[joint.n_alpha :] = fading = float(np.exp(-elapsed / drift.bias_memory_s))
    growth[:4] = drift.alpha_rate**2 * elapsed
    growth[4 : joint.n_alpha] = STRETCH_RATE**2 * elapsed
    if flexure is not None:
        growth[:4] += flexure**2
    bias = joint.bias
    if bias is not None:
        # A first-order process: what has faded of the variance returns as the floor, so that the
        # variance of an unobserved bias tends to the floor and does not vanish.
        growth[joint.place] = np.square(BIAS_FLOOR) * (1.0 - fading**2)
        # The next passive estimate with an excess restores what fades here.
        bias = replace(bias, excess=fading**2 * bias.excess)
    covariance = joint.covariance * np.outer(keep, keep) + np.diag(growth)
    return replace(joint, mean=keep * joint.mean, covariance=covariance, bias=bias)


def innovation(prior: Joint, measured: Array, noise: Array, *, passive: bool = False) -> float:
    """Return the squared, normalised innovation of a measurement; its expectation is 4.

    It is that of a dithered window, or of a passive estimate.
    """
    sees = prior.observation_rows(passive=passive)[: len(measured)]
    difference = measured - sees @ prior.mean
    total = sees @ prior.covariance @ sees.T + noise
    return float(difference @ np.linalg.solve(total, difference))


def correct_state(prior: Joint, measured: Array, noise: Array, *, passive: bool = False) -> Joint:
    """Fold in a measurement ``(4,)`` with the covariance ``(4, 4)`` of its own scatter.

    A window's may be ``(6,)``: with its anamorphosis, where that is followed.
    """
    sees = prior.observation_rows(passive=passive)[: len(measured)]
    return _update(prior, sees, measured, noise)


def _update(prior: Joint, sees: Array, measured: Array, noise: Array) -> Joint:
    total = sees @ prior.covariance @ sees.T + noise
    # K = P Hᵀ S⁻¹ without an inverse: S and P are symmetric.
    gain = np.linalg.solve(total, sees @ prior.covariance).T
    keep = np.eye(len(prior.mean)) - gain @ sees
    # Joseph's form stays positive under rounding, unlike (I - K H) P.
    posterior = keep @ prior.covariance @ keep.T + gain @ noise @ gain.T
    return replace(
        prior,
        mean=prior.mean + gain @ (measured - sees @ prior.mean),
        covariance=(posterior + posterior.T) / 2,
    )


def update_scatter(joint: Joint, innovation: float) -> Joint:
    """Return the estimate after an innovation, 4 expected, with ``scatter`` learnt from it.

    In fast wind the bias changes between estimates, which then scatter by more than their σ.
    """
    known = joint.bias or Bias()
    return replace(joint, bias=replace(known, scatter=learnt(known.scatter, innovation)))


def learnt(scatter: float, innovation: float) -> float:
    """Return the ratio of the measurements' variance to the stated one, after one more.

    Parameters
    ----------
    scatter
        Ratio from the previous measurements, at least 1.
    innovation
        Squared innovation of the newest, normalised with that scatter included: 4 is expected.
    """
    # Limited: one jump must not make the filter expect a large scatter of all later windows.
    seen = min(innovation, JUMP_THRESHOLD) / 4.0
    return max(scatter * (1.0 + SCATTER_LEARNING * (seen - 1.0)), 1.0)


def widen_after_jump(prior: Joint, noise: Array) -> Joint:
    """Return the state after a jump of α, whose size the next measurement determines.

    The bias is kept: the wind has not moved with the mirror.
    """
    moved = np.zeros(len(prior.mean))
    # Only the four of α: the anamorphosis changes where optics are mounted, and the bias with the
    # wind.
    moved[:4] = np.diag(prior.covariance)[:4] + np.diag(noise)
    return replace(prior, covariance=prior.covariance + JUMP_INFLATION**2 * np.diag(moved))
