"""How noisy a slope is: from the light on the four images, or from the star.

A slope is a difference of four pixels over the mean flux of a subaperture (global normalisation):
its variance is that of the four pixels, x and y alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """What of a star's light is counted, and what counting costs."""

    zero_point_photons: float = 2.1e10
    """Photons per second and square metre from a star of magnitude 0 in the sensor's band."""

    throughput: float = 0.25
    """Atmosphere, telescope, sensor and quantum efficiency together, 0..1."""

    read_noise_electrons: float = 4.0
    """RMS per pixel and read."""

    excess_noise: float = 1.0
    """Variance of the photon noise over Poisson's: 2 for an electron-multiplying CCD."""


def noise_of_counts(
    counts: NDArray[Any], valid: NDArray[np.bool_], camera: Camera | None = None
) -> Array:
    """Return 1 σ of each slope ``(n_slopes,)`` from the mean electrons per frame of the images.

    ``counts`` is ``(4, n, n)``, ``valid`` ``(n, n)``.

    Raises
    ------
    ModelError
        If the images and the mask differ in size, or there is no light on the valid ones.
    """
    camera = camera or Camera()
    if counts.shape != (4, *valid.shape):
        raise ModelError(f"slope noise: found counts {counts.shape}; expected {(4, *valid.shape)}")
    own = counts.sum(axis=0, dtype=np.float64)[valid]
    mean = float(own.mean())
    if not np.isfinite(mean) or mean <= 0.0:
        raise ModelError(f"slope noise: found {mean:g} electrons per subaperture; expected > 0")
    variance = camera.excess_noise * np.maximum(own, 0.0) + 4 * camera.read_noise_electrons**2
    return np.asarray(np.sqrt(np.tile(variance, 2)) / mean)


def noise_of_star(
    instrument: Instrument,
    *,
    magnitude: float,
    frame_rate_hz: float,
    n_valid: int,
    camera: Camera | None = None,
) -> Array:
    """Return 1 σ of each slope ``(2 n_valid,)`` of a star whose light falls evenly.

    Light diffracted out of the images counts as lost with ``throughput``.
    """
    camera = camera or Camera()
    area_m2 = np.pi / 4 * instrument.diameter_m**2 * (1 - instrument.obscuration_ratio**2)
    flux = camera.zero_point_photons * 10 ** (-0.4 * magnitude) * area_m2
    own = flux * camera.throughput / frame_rate_hz / n_valid
    variance = camera.excess_noise * own + 4 * camera.read_noise_electrons**2
    return np.full(2 * n_valid, np.sqrt(variance) / own)
