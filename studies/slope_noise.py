"""How noisy slopes are, by the light in the images."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.control.expected_gain import READ_NOISE_ELECTRONS
from service.errors import ModelError


def noise_of_counts(
    counts: NDArray[Any],
    valid: NDArray[np.bool_],
    *,
    read_noise_electrons: float = READ_NOISE_ELECTRONS,
    excess_noise: float = 1.0,
) -> NDArray[np.float64]:
    """Return 1 σ of each slope ``(n_slopes,)`` from the mean electrons per frame of the images.

    ``counts`` is ``(4, n, n)``, ``valid`` ``(n, n)``. A slope is a difference of four pixels over
    the mean flux of a subaperture: its variance is that of the four pixels, x and y alike.
    ``excess_noise`` is the variance of the photon noise over Poisson's: 2 for an
    electron-multiplying CCD.

    Raises
    ------
    ModelError
        If the images and the mask differ in size, or there is no light on the valid ones.
    """
    if counts.shape != (4, *valid.shape):
        raise ModelError(f"slope noise: found counts {counts.shape}; expected {(4, *valid.shape)}")
    own = counts.sum(axis=0, dtype=np.float64)[valid]
    mean = float(own.mean())
    if not np.isfinite(mean) or mean <= 0.0:
        raise ModelError(f"slope noise: found {mean:g} electrons per subaperture; expected > 0")
    variance = excess_noise * np.maximum(own, 0.0) + 4 * read_noise_electrons**2
    return np.asarray(np.sqrt(np.tile(variance, 2)) / mean)
