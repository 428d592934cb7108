"""The registration as a random walk, updated by each window's estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

JUMP_THRESHOLD = 23.5
"""Normalised innovation squared that four degrees of freedom exceed once in 10 000."""

JUMP_INFLATION = 10.0
"""After a jump each parameter may have moved by this many σ of the innovation."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Filtered:
    """The estimate after one update."""

    mean: Array
    """``(4,)`` numeric units."""

    covariance: Array
    """``(4, 4)``."""

    innovation: float
    """Normalised innovation squared, expected value 4; 0 for a first measurement."""

    jumped: bool
    """Whether the innovation was too large for the random walk: the mirror has moved at once."""


def begin(measured: Array, covariance: Array) -> Filtered:
    """Return the estimate after a first measurement."""
    return Filtered(mean=measured, covariance=covariance, innovation=0.0, jumped=False)


def update(
    mean: Array,
    covariance: Array,
    measured: Array,
    noise: Array,
    *,
    drift_rate: Array,
    elapsed_s: float,
) -> Filtered:
    """Predict over ``elapsed_s`` and fold one measurement in.

    ``drift_rate`` ``(4,)`` is the random walk's σ after one second. A measurement beyond
    ``JUMP_THRESHOLD`` inflates the prior, so that the estimate follows the jump at once instead
    of averaging two places.
    """
    prior = covariance + np.diag(drift_rate**2 * max(elapsed_s, 0.0))
    difference = measured - mean
    innovation = float(difference @ np.linalg.solve(prior + noise, difference))
    jumped = innovation > JUMP_THRESHOLD
    if jumped:
        prior = prior + JUMP_INFLATION**2 * np.diag(np.diag(prior + noise))
    gain = np.linalg.solve(prior + noise, prior).T
    keep = np.eye(len(mean)) - gain
    posterior = keep @ prior @ keep.T + gain @ noise @ gain.T
    return Filtered(
        mean=mean + gain @ difference,
        covariance=(posterior + posterior.T) / 2,
        innovation=innovation,
        jumped=jumped,
    )
