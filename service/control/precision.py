"""How precise a window of dither is: a table to begin with, then what the windows show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TABLE_MAGNITUDES = np.array([7.0, 10.0, 12.5])

TABLE = (
    np.array(
        [
            [0.019, 0.019, np.deg2rad(0.084), 0.0042],
            [0.059, 0.059, np.deg2rad(0.37), 0.0074],
            [0.13, 0.13, np.deg2rad(0.53), 0.026],
        ]
    )
    * 1e-9
)
"""``(n_magnitudes, 4)`` κ of ``σ = κ / (A sqrt(T))``, numeric units times m sqrt(s), of four modes
on the diffractive telescope at 1 kHz: of what the design study and docs/results/night.md found,
the larger."""

MEMORY_WINDOWS = 8.0
"""Windows after which what was learnt is worth 1/e: fewer scatter, more are slow when the seeing
changes."""

RATIO_RANGE = (0.05, 20.0)
"""Of a single window over the table: beyond it is the window that is odd."""


def tabulated(magnitude: float | None) -> Array:
    """Return κ ``(4,)`` for a star before any window has been seen; None: the faintest row.

    The noise of a faint star goes on growing as it does between the last two rows.
    """
    m, logs = TABLE_MAGNITUDES, np.log(TABLE)
    star = m[-1] if magnitude is None else max(float(magnitude), m[0])
    row = min(int(np.searchsorted(m, star, side="right")) - 1, len(m) - 2)
    share = (star - m[row]) / (m[row + 1] - m[row])
    kappa: Array = np.exp(logs[row] + share * (logs[row + 1] - logs[row]))
    return kappa


def measured_ratio(
    covariance: Array, total_m: float, window_s: float, magnitude: float | None
) -> Array:
    """Return the κ ``(4,)`` that one window shows, over that of the table.

    Parameters
    ----------
    covariance
        ``(4, 4)`` of the window's estimate, from its own data, numeric units.
    total_m
        RMS of all lines together as they were on the mirror, metres OPD.
    window_s
        Length of the window, seconds.
    magnitude
        Of the star; None: not known.
    """
    kappa = np.sqrt(np.diag(covariance)) * total_m * np.sqrt(window_s)
    return np.asarray(np.clip(kappa / tabulated(magnitude), *RATIO_RANGE))


def forgetting_mean(mean: Array | None, n_windows: int, ratio: Array) -> Array:
    """Return the quadratic mean of the ratios after one more, ``n_windows`` having gone before."""
    if mean is None or n_windows == 0:
        return ratio
    share = max(1.0 / (n_windows + 1), 1.0 / MEMORY_WINDOWS)
    return np.asarray(np.sqrt((1.0 - share) * mean**2 + share * ratio**2))
