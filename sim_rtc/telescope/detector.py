"""Photon noise, read noise and pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model.instrument import Instrument
from service.model.kinds import SignalKind
from service.model.sensors.registry import KINDS, kind_of
from service.model.sensors.sensor import CannotTell

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
AnyArray = NDArray[Any]

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
    """RMS per pixel and read; a pyramid's subaperture is four pixels."""

    excess_noise: float = 1.0
    """Variance of the photon noise over Poisson's: 2 for an electron-multiplying CCD."""

    def electrons_per_frame(
        self, instrument: Instrument, *, magnitude: float, frame_rate_hz: float
    ) -> float:
        """Return the electrons of a star on all pixels together."""
        area_m2 = instrument.collecting_area_m2
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
        reports_light: bool = True,
    ) -> None:
        """Take the share of the light that each pixel detects, ``images`` in the sensor's shape.

        ``silent`` ``(n_valid,)`` are subapertures that read 0, noise included. If ``reports_light``
        is False, the status carries no flux.
        """
        camera = camera or Camera()
        self.electrons_per_frame: float = camera.electrons_per_frame(
            instrument, magnitude=magnitude, frame_rate_hz=frame_rate_hz
        )
        """Detected on all pixels together while none is dead."""
        kind, sensor = instrument.slopes.kind, kind_of(instrument)
        self._light = sensor.light(instrument) if reports_light else None
        pixels = images.reshape(-1)[sensor.pixels(instrument, valid)]
        own = pixels.sum(axis=0) * self.electrons_per_frame
        if kind is SignalKind.XY:
            lights, n_pixels = np.tile(own, 2), len(pixels)
        else:
            lights, n_pixels = pixels.reshape(-1) * self.electrons_per_frame, 1
        if KINDS[instrument.wfs.kind].normalised:
            variance = camera.excess_noise * lights + n_pixels * camera.read_noise_electrons**2
            # The slopes are normalised by the mean light of all valid subapertures (global
            # normalisation).
            sigma = np.sqrt(variance) / own.mean()
        else:
            of_photons, of_pixels = sensor.noise_terms(instrument)
            photons = camera.excess_noise * of_photons * lights
            sigma = np.sqrt(photons + of_pixels * camera.read_noise_electrons**2) / lights
        self.sigma: Array32 = sigma.astype(np.float32)
        """``(n_slopes,)`` 1 σ of a slope, or of a normalised pixel, in one frame."""
        if silent is not None:
            self.sigma[np.tile(silent, kind.n_planes)] = 0.0
        # Drawn from by number, in a third of the time of a normal deviate; they end at 4.3 sigma.
        self._normal = _normal_values(2**16)

    def flux(self, images: Array) -> bytes | None:
        """Return electrons per frame as a status reports them; None if there are none."""
        if self._light is None or isinstance(self._light, CannotTell):
            return None
        counts = self._light.counts(images * self.electrons_per_frame)
        return counts.astype("<f4").tobytes()

    def noise(self, n_frames: int, rng: np.random.Generator) -> Array32:
        """Return slope noise ``(n_frames, n_slopes)``.

        The x and y slopes of a subaperture use the same four pixels with signs that make their
        noise uncorrelated.
        """
        noise = np.empty((n_frames, len(self.sigma)), dtype=np.float32)
        for start in range(0, n_frames, _FRAMES_TOGETHER):
            some = noise[start : start + _FRAMES_TOGETHER]
            # the numbers that integers() would draw, in half the time
            bits = rng.bit_generator.random_raw(-(-some.size // 4)).view(np.uint16)
            np.take(self._normal, bits[: some.size].reshape(some.shape), out=some, mode="clip")
            some *= self.sigma
        return noise


def _normal_values(n: int) -> Array32:
    """Return n equally probable values of a normal distribution, of variance 1."""
    values = scipy.special.ndtri((np.arange(n) + 0.5) / n)
    return np.asarray(values / values.std(), dtype=np.float32)


_MANY = 30.0
"""Electrons from which a Poisson number is drawn as a normal one: skewness below 0.18."""


class PixelDetector:
    """Turns the light on the pixels into read-out counts."""

    def __init__(self, *, electrons_per_light: float, camera: Camera | None = None) -> None:
        """Take the electrons that a frame collects from a unit of light."""
        self._camera = camera or Camera()
        self._electrons_per_light = np.float32(electrons_per_light)

    def read(self, light: AnyArray, rng: np.random.Generator) -> Array32:
        """Return electrons, shaped like ``light``, with photon, excess and read noise in them."""
        expected = (light * self._electrons_per_light).astype(np.float32, copy=False)
        excess = np.float32(self._camera.excess_noise)
        variance = excess * expected
        few = expected < _MANY
        faint = bool(few.any())
        if faint:
            # Their photons are drawn below; only the read noise is added as a normal number.
            variance[few] = 0.0
        variance += np.float32(self._camera.read_noise_electrons**2)
        read = rng.standard_normal(expected.shape, dtype=np.float32)
        read *= np.sqrt(variance)
        if faint:
            read[few] += _arrivals(expected[few], float(excess), rng)
            read[~few] += expected[~few]
            return read
        read += expected
        return read


def _arrivals(expected: Array32, excess: float, rng: np.random.Generator) -> Array32:
    """Return Poisson numbers, multiplied by a gain register that adds noise if ``excess`` > 1.

    A sum of n exponential gains has a gamma distribution; its shape is chosen so that the
    variance of the result is ``excess`` times that of the photons.
    """
    # Rounding in the propagation can make dark pixels slightly negative.
    photons = rng.poisson(np.maximum(expected, 0.0))
    if excess == 1.0:
        return photons.astype(np.float32)
    spread = excess - 1.0
    return np.asarray(rng.standard_gamma(photons / spread) * spread, dtype=np.float32)
