"""The detector: how many photons a star gives, and what their noise does to the slopes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from service.model.instrument import Instrument

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


_FRAMES_TOGETHER = 50
"""Frames of noise drawn at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Band, throughput and read noise of the sensor's detector."""

    zero_point_photons: float = 2.1e10
    """Photons per second and square metre above the atmosphere from a star of R = 0.

    7.0e6 photons per second, square metre and nanometre in Johnson R (Bessell 1979), over the
    300 nm of the sensor's band, 600 to 900 nm.
    """

    throughput: float = 0.25
    """Atmosphere, telescope, sensor optics and quantum efficiency together, 0..1."""

    read_noise_electrons: float = 4.0
    """RMS per pixel and read; a subaperture is one pixel in each of the four images."""

    excess_noise: float = 1.0
    """Variance of the photon noise over Poisson's: 2 for an electron-multiplying CCD."""

    def electrons_per_frame(
        self, instrument: Instrument, *, magnitude: float, frame_rate_hz: float
    ) -> float:
        """Return the electrons of a star in all four images together."""
        area_m2 = np.pi / 4 * instrument.diameter_m**2 * (1 - instrument.obscuration_ratio**2)
        flux = self.zero_point_photons * 10 ** (-0.4 * magnitude) * area_m2
        return float(flux * self.throughput / frame_rate_hz)


class Detector:
    """Photon and read noise of the slopes, as Gaussian noise per subaperture from its own flux."""

    def __init__(
        self,
        instrument: Instrument,
        *,
        images: Array,
        valid: NDArray[np.bool_],
        magnitude: float,
        frame_rate_hz: float,
        camera: Camera | None = None,
        silent: NDArray[np.bool_] | None = None,
    ) -> None:
        """Take the share of the light that each pixel detects, ``images`` ``(2, n, 2, n)``.

        ``silent`` ``(n_valid,)`` are subapertures that read 0, noise included.
        """
        camera = camera or Camera()
        self.electrons_per_frame: float = camera.electrons_per_frame(
            instrument, magnitude=magnitude, frame_rate_hz=frame_rate_hz
        )
        """Detected in all four images together while no pixel is dead."""
        own = images.sum(axis=(0, 2))[valid] * self.electrons_per_frame
        variance = camera.excess_noise * own + 4 * camera.read_noise_electrons**2
        variance /= own.mean() ** 2
        self.sigma: Array32 = np.sqrt(np.tile(variance, 2)).astype(np.float32)
        """``(n_slopes,)`` 1 σ of a slope in one frame."""
        if silent is not None:
            self.sigma[np.tile(silent, 2)] = 0.0
        # Drawn from by number, in a third of the time of a normal deviate; they end at 4.3 sigma.
        self._normal = _normal_values(2**16)

    def counts(self, images: Array) -> Array32:
        """Return ``(4, n, n)`` electrons per frame of these images ``(2, n, 2, n)``.

        In row-major order of the images' place on the detector.
        """
        n = images.shape[1]
        electrons = images * self.electrons_per_frame
        return electrons.transpose(0, 2, 1, 3).reshape(4, n, n).astype(np.float32)

    def noise(self, n_frames: int, rng: np.random.Generator) -> Array32:
        """Return slope noise ``(n_frames, n_slopes)``.

        The x and y slopes of a subaperture use the same four pixels with signs that make their
        noise uncorrelated.
        """
        noise = np.empty((n_frames, len(self.sigma)), dtype=np.float32)
        for start in range(0, n_frames, _FRAMES_TOGETHER):
            some = noise[start : start + _FRAMES_TOGETHER]
            drawn = rng.integers(0, len(self._normal), some.shape, dtype=np.uint16)
            np.take(self._normal, drawn, out=some, mode="clip")
            some *= self.sigma
        return noise


def _normal_values(n: int) -> Array32:
    """Return n equally probable values of a normal distribution, of variance 1."""
    values = ndtri((np.arange(n) + 0.5) / n)
    return np.asarray(values / values.std(), dtype=np.float32)
