"""Measure how many frames commands follow the slopes that they were computed from.

An integrator changes its commands by a linear combination of the slopes ``delay_frames`` earlier,
whatever its reconstructor. The delay at which slopes predict changes of commands is therefore seen
without a reconstructor. Streams that were recorded without frame numbers and stored some frames
apart show another delay; taken as they are they look like slopes of another sign.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_FRAMES: Final = 3000
"""Largest number of frames used."""

MIN_FRAMES: Final = 400
"""Smallest number of frames for a measurement."""

MAX_APART_FRAMES: Final = 6
"""Largest offset of the streams that is recognised, frames."""

MAX_COMPONENTS: Final = 200
"""Largest number of principal components of the slopes used as predictors."""

FRAMES_PER_COMPONENT: Final = 4

N_MODES: Final = 16
"""Number of modes whose commands are predicted: those with the largest changes."""

MIN_PREDICTED_SHARE: Final = 0.3
"""Smallest share of the variance of changes that slopes predict at the true delay. Measured at the
true delay: 0.84 to 0.95; at all others below 0."""

MIN_MODES: Final = 2
"""Smallest number of predicted modes: a dither of one frequency predicts itself at any delay."""

MIN_SHARE_RATIO: Final = 1.5
"""Smallest ratio of the predicted shares at the true delay and at any other that is not its
neighbour."""


def measure_delay(slopes: Array, commands: Array, delay_frames: float) -> int | None:
    """Return the delay from slopes to commands in frames, or None if it is not measurable.

    Parameters
    ----------
    slopes
        ``(n_frames, n_slopes)``, without gaps.
    commands
        ``(n_frames, n_modes)``, without the dither if it is known.
    delay_frames
        Stated delay, frames; delays within ``MAX_APART_FRAMES`` of it are tried.
    """
    # The delay does not change during a night, so the first seconds are enough.
    n = min(len(slopes), MAX_FRAMES)
    if n < MIN_FRAMES:
        return None
    seen = _components(slopes[:n], n // (2 * FRAMES_PER_COMPONENT))
    changes = np.diff(commands[:n], axis=0)
    strongest = np.argsort(-changes.std(axis=0))[:N_MODES]
    changes = changes[:, strongest] - changes[:, strongest].mean(axis=0)
    if not changes.std(axis=0).any():
        return None
    stated = round(delay_frames)
    delays = np.arange(stated - MAX_APART_FRAMES, stated + MAX_APART_FRAMES + 1)
    shares = np.array([_predict_share(seen, changes, int(delay)) for delay in delays])
    strengths = np.where(shares > MIN_PREDICTED_SHARE, shares, 0.0).sum(axis=1)
    best = int(np.argmax(strengths))
    # Neighbours are left out of the comparison: turbulence is alike from one frame to the next.
    others = np.delete(strengths, slice(max(best - 1, 0), best + 2))
    if (
        np.sum(shares[best] > MIN_PREDICTED_SHARE) < MIN_MODES
        or strengths[best] < MIN_SHARE_RATIO * others.max()
    ):
        return None
    return int(delays[best])


def _components(slopes: Array, n_most: int) -> Array:
    """Return the slopes by their strongest principal components, ``(n_frames, n_components)``."""
    centred = slopes - slopes.mean(axis=0)
    if centred.shape[1] <= min(n_most, MAX_COMPONENTS):
        return np.asarray(centred)
    # From some of the frames: the covariance of all slopes would be far larger than needed.
    some = centred[: 5 * MAX_COMPONENTS]
    _, along = np.linalg.eigh(some @ some.T)
    strongest = along[:, -min(n_most, MAX_COMPONENTS) :]
    axes, _ = np.linalg.qr(some.T @ strongest)
    return np.asarray(centred @ axes)


def _predict_share(seen: Array, changes: Array, delay: int) -> Array:
    """Return the share of each mode's changes that slopes of an earlier frame predict.

    The first half of the frames gives the weights, the second half tests them.
    """
    first, last = max(1, delay), min(len(seen), len(seen) + delay)
    causes, effects = seen[first - delay : last - delay], changes[first - 1 : last - 1]
    half = len(causes) // 2
    normal = causes[:half].T @ causes[:half]
    # A small ridge, because slopes of modes that are not excited are nearly dependent.
    normal += 1e-6 * np.trace(normal) / len(normal) * np.eye(len(normal))
    weights = np.linalg.solve(normal, causes[:half].T @ effects[:half])
    left = np.sum((effects[half:] - causes[half:] @ weights) ** 2, axis=0)
    power = np.sum(effects[half:] ** 2, axis=0)
    return np.asarray(np.where(power > 0.0, 1.0 - left / np.where(power > 0.0, power, 1.0), 0.0))
