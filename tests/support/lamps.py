"""Mean counts of a small and of the full instrument's images, lit in every way."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from service.instrument.reader import load_instrument
from service.model.instrument import Instrument
from service.model.kinds import Stop
from service.model.pupil import Illumination, instrument_pupil
from service.model.sensors.pyramid.optics import PyramidOptics
from tests.support.numerics import small_instrument

COUNTS = 400.0
"""Mean of a pixel, electrons."""


@cache
def flao() -> Instrument:
    return load_instrument("flao-lbt")


@cache
def small(stop: Stop = Stop.MIRROR) -> Instrument:
    return small_instrument(stop=stop)


def counts_of(
    instrument: Instrument,
    shift: tuple[float, float] = (0.0, 0.0),
    light: Illumination | None = None,
    *,
    n_frames: int = 1000,
    seed: int = 0,
) -> np.ndarray:
    """Photons averaged over frames, from a finer pupil than the flux map's own model."""
    pupil = instrument_pupil(instrument, 3)
    if light is not None:
        pupil = pupil.lit_by(light)
    images = PyramidOptics(wfs=instrument.wfs, pupil=pupil, n_nodes=2).images(shift)
    n = instrument.wfs.n_subapertures
    counts = images.transpose(0, 2, 1, 3).reshape(4, n, n)
    counts = counts * COUNTS / counts.mean()
    return np.random.default_rng(seed).poisson(counts * n_frames) / n_frames


def beam(intensity, size: int = 80, step: float = 0.5) -> Illumination:
    """Light given as a function of x and y, in subapertures from the beam's centre."""
    u = (np.arange(size) - (size - 1) / 2) * step
    return Illumination(coordinates=u, intensity=intensity(u[None, :], u[:, None]))


def gaussian(x, y):
    """A fibre's beam, off centre: half the light at the edge."""
    return np.exp(-((x - 2.0) ** 2 + (y + 1.0) ** 2) / 18.0**2)


def fringes(x, y):
    """Nothing that a low polynomial could describe."""
    return 1.0 + 0.3 * np.sin(2 * np.pi * (x + 0.4 * y) / 9.0)


def with_diameter(instrument: Instrument, diameter_subap: float) -> Instrument:
    return replace(instrument, wfs=replace(instrument.wfs, pupil_diameter_subap=diameter_subap))
