"""Split the residual of a fit into noise and structure.

Noise is independent in every element, whereas an error of the instrument file appears in many
elements at once. The singular values of pure noise follow the Marchenko-Pastur distribution, and
their median gives the noise level whatever structure the largest values contain.

References
----------
Marchenko & Pastur 1967, Math. USSR Sb. 1, 457; Gavish & Donoho 2014, IEEE Trans. Inf. Theory 60,
5040.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_N_POINTS = 4001
"""Number of points of the distribution whose median is computed."""


def measure_structure(residual: Array, power: Array, noise: Array | None) -> float:
    """Return the RMS of the structured residual over the RMS of the measurement.

    Structure that is spread evenly over all directions is indistinguishable from noise and counts
    as noise.

    Parameters
    ----------
    residual
        ``(n_rows, n_modes)`` residual of the fit.
    power
        ``(n_modes,)`` sum of squares of each measured column.
    noise
        ``(n_modes,)`` 1 σ of one element of each column from repeated measurements; None if
        unknown.
    """
    n_rows = len(residual)
    # share of each column's power in the residual
    left = np.sum(residual**2, axis=0) / power
    # With one stroke for all modes, noise is equal in slopes; with strokes that give equal slopes,
    # it is equal in relative terms. The larger estimate is used; in no column may it exceed the
    # residual.
    alike_in_slopes = np.minimum(noise_sigma(residual) ** 2 * n_rows / power, left)
    alike_in_shares = noise_sigma(residual / np.sqrt(power)) ** 2 * n_rows
    known = np.zeros(1) if noise is None else n_rows * noise**2 / power
    most = max(np.mean(alike_in_slopes), alike_in_shares, np.mean(known))
    return float(np.sqrt(max(np.mean(left) - most, 0.0)))


def noise_sigma(matrix: Array) -> float:
    """Return 1 σ of the noise in each element of a matrix that also contains structure."""
    few, many = sorted(matrix.shape)
    wide = matrix if matrix.shape[0] == few else matrix.T
    squares = np.linalg.eigvalsh(
        wide @ wide.T
    )  # precise enough, because the median eigenvalue is not small
    return float(np.sqrt(max(np.median(squares), 0.0) / (many * _median_square(few / many))))


@cache
def _median_square(aspect: float) -> float:
    """Return the median of squared singular values of unit noise, over the longer side."""
    low, high = (1.0 - np.sqrt(aspect)) ** 2, (1.0 + np.sqrt(aspect)) ** 2
    # equal steps of the angle, because the density diverges at 0 for a square matrix
    angle = (np.arange(_N_POINTS) + 0.5) / _N_POINTS * np.pi
    square = (low + high) / 2.0 - (high - low) / 2.0 * np.cos(angle)
    share = np.cumsum(np.sin(angle) ** 2 / square)
    return float(np.interp(0.5, share / share[-1], square))
