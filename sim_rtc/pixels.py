"""The detector pixel by pixel: photons arrive one by one, and reading them costs noise.

Also how a bright-star sensor is set up for a faint star: slower, and with its pixels binned, which
makes larger subapertures of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError
from service.model.instrument import Instrument
from sim_rtc.detector import Camera

Array = NDArray[Any]
Array32 = NDArray[np.float32]

_MANY = 30.0
"""Electrons from which a Poisson number is drawn as a normal one: skewness below 0.18."""


class PixelDetector:
    """Turns the light on the pixels into what is read from them."""

    def __init__(self, *, electrons_per_light: float, camera: Camera | None = None) -> None:
        """Take the electrons that a frame collects from a unit of light."""
        self._camera = camera or Camera()
        self._electrons_per_light = np.float32(electrons_per_light)

    def read(self, light: Array, rng: np.random.Generator) -> Array32:
        """Return electrons, shaped like ``light``, with photon, excess and read noise in them."""
        expected = (light * self._electrons_per_light).astype(np.float32, copy=False)
        excess = np.float32(self._camera.excess_noise)
        variance = excess * expected
        few = expected < _MANY
        faint = bool(few.any())
        if faint:
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Preset:
    """How the sensor is run for stars down to a magnitude."""

    faintest: float
    """R magnitude of the faintest star it is for."""

    frame_rate_hz: float
    binning: int
    """Detector pixels per side of a subaperture, in pixels of the finest one."""

    n_controlled: int
    """Modes the loop corrects with."""


FLAO_PRESETS = (
    Preset(faintest=10.0, frame_rate_hz=1000.0, binning=1, n_controlled=400),
    Preset(faintest=11.0, frame_rate_hz=800.0, binning=1, n_controlled=400),
    Preset(faintest=13.0, frame_rate_hz=800.0, binning=2, n_controlled=153),
    Preset(faintest=14.5, frame_rate_hz=500.0, binning=3, n_controlled=66),
    Preset(faintest=16.5, frame_rate_hz=200.0, binning=5, n_controlled=36),
)
"""After FLAO's practice: 30, 15, 10 and few subapertures across as the star gets fainter."""


def preset_for(magnitude: float) -> Preset:
    """Return the way FLAO would look at a star of this magnitude.

    Raises
    ------
    ConfigurationError
        If the star is fainter than any that the sensor can use.
    """
    for preset in FLAO_PRESETS:
        if magnitude <= preset.faintest:
            return preset
    raise ConfigurationError(
        f"--preset flao: found magnitude {magnitude:g}; "
        f"expected a star of {FLAO_PRESETS[-1].faintest:g} or brighter"
    )


def binned(instrument: Instrument, binning: int) -> Instrument:
    """Return the instrument with this many detector pixels to a side of a subaperture.

    Raises
    ------
    ConfigurationError
        If the subapertures do not divide by it, or the mask of valid ones is given.
    """
    if binning == 1:
        return instrument
    wfs = instrument.wfs
    if binning < 1 or wfs.n_subapertures % binning or wfs.valid_subapertures is not None:
        raise ConfigurationError(
            f"binning: found {binning}; {wfs.n_subapertures} subapertures must divide by it, and "
            "their mask must be found by flux"
        )
    return replace(
        instrument,
        wfs=replace(
            wfs,
            n_subapertures=wfs.n_subapertures // binning,
            pupil_separation_subap=wfs.pupil_separation_subap / binning,
            pupil_diameter_subap=wfs.pupil_diameter / binning,
        ),
    )


def _arrivals(expected: Array32, excess: float, rng: np.random.Generator) -> Array32:
    """Return Poisson numbers, multiplied by a gain register that adds noise if ``excess`` > 1.

    A sum of n exponential gains has a gamma distribution; its shape is chosen so that the
    variance of the result is ``excess`` times that of the photons.
    """
    photons = rng.poisson(np.maximum(expected, 0.0))
    if excess == 1.0:
        return photons.astype(np.float32)
    spread = excess - 1.0
    return np.asarray(rng.standard_gamma(photons / spread) * spread, dtype=np.float32)
