"""The diffractive telescope of the study, by night or by day, and what comes to it.

Everything that runs of the same occasion share (basis, plant, turbulence) is kept by the process
that made it: a run then costs its frames and little else.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.instrument import load_instrument
from service.model.instrument import Instrument, Mirror
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis, karhunen_loeve_basis
from sim_rtc.assembly import build_plant, build_sky
from sim_rtc.options import Options, parse_options
from sim_rtc.telescope.detector import Detector, PixelDetector
from sim_rtc.telescope.diffractive import DiffractiveOptics, DiffractivePlant
from sim_rtc.telescope.mirror import DrawnSurface, PlantSurface
from sim_rtc.telescope.sky import DAYTIME_LINES, Sky

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

INSTRUMENT = "flao-lbt"

DRAWN = "drawn"
"""Beside the simulator's named sets: nothing differs from the model but the optics' computation."""

_UNEVEN = f"{DRAWN}-uneven-"
"""Before a number: the light departs from its mean by so much, and nothing else differs."""

_PLANT, _SKY, _PHOTONS, _MEASURING = range(4)
"""Children of an occasion's seed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Occasion:
    """One telescope at one time: what is random about it follows from the seed."""

    daytime: bool
    """Fibre and retro-reflector, the mirror seen twice, instead of a star."""

    seed: int
    imperfections: str = "usual"
    """How far the telescope is from the model: a named set of the simulator, ``DRAWN``, or
    ``DRAWN`` in uneven light."""

    vibrations: bool = False
    """By day: whether anything shakes it."""

    magnitude: float = 7.0
    """Of the star or the fibre, in R."""

    seeing_arcsec: float = 1.0
    """By day: of the turbulence played on the mirror, as the sensor sees it."""

    @property
    def passes(self) -> int:
        """How often the light meets the mirror."""
        return 2 if self.daytime else 1

    @property
    def still(self) -> Occasion:
        """The same telescope when nothing shakes it: it has the same parts."""
        return Occasion(
            daytime=self.daytime,
            seed=self.seed,
            imperfections=self.imperfections,
            magnitude=self.magnitude,
            seeing_arcsec=self.seeing_arcsec,
        )

    def rng(self, child: int) -> np.random.Generator:
        """Return a fresh generator of one of the things that are random."""
        return np.random.default_rng(self.seed).spawn(4)[child]

    def options(self) -> Options:
        """Return the simulator's options for it."""
        words = ["--plant=diffractive", f"--seed={self.seed}", f"--mag={self.magnitude}"]
        departures = self.imperfections
        if departures.startswith(_UNEVEN):
            words.append(f"--unevenness={departures.removeprefix(_UNEVEN)}")
            departures = DRAWN
        if departures == DRAWN:
            departures = "ideal"
        words += [f"--seeing={self.seeing_arcsec}", f"--imperfections={departures}"]
        words += self.vibration_words
        words.append("--scene=daytime" if self.daytime else "--scene=onsky")
        return parse_options(words)

    @property
    def vibration_words(self) -> list[str]:
        """The simulator's options for what shakes it."""
        return ["--vibration=none"] if self.daytime and not self.vibrations else []


@dataclass(frozen=True, slots=True, kw_only=True)
class ShakenOccasion(Occasion):
    """An occasion by day with stronger vibrations than the simulated dome's."""

    times: float
    """Amplitude over that of the simulated dome."""

    @property
    @override
    def vibration_words(self) -> list[str]:
        return [
            f"--vibration={line.shape}:{line.frequency_hz:g}:{self.times * line.rms_m * 1e9:g}"
            for line in DAYTIME_LINES
        ]


class DrawnPlant(DiffractivePlant):
    """A telescope whose mirror has the influence functions of the service's model.

    It is to a synthetic matrix what the paper's simulator is to its own: the same model.
    """

    @override
    def _own_surface(self, mirror: Mirror, strokes: Array) -> tuple[PlantSurface, Array]:
        surface = DrawnSurface(mirror=mirror, subaperture_m=self._instrument.subaperture_m)
        return surface, strokes


@lru_cache(maxsize=1)
def instrument() -> Instrument:
    """Return the paper's telescope."""
    return load_instrument(INSTRUMENT)


@lru_cache(maxsize=1)
def basis() -> ModalBasis:
    """Return its modes; takes seconds the first time."""
    return karhunen_loeve_basis(instrument())


def actuators_subap() -> Array:
    """Return the actuators ``(n_actuators, 2)`` x and y on the mirror, in subapertures."""
    mirror = instrument().mirror
    if not isinstance(mirror, Mirror):
        raise TypeError(f"study: found {type(mirror).__name__}; expected actuators")
    return np.asarray(mirror.positions_m / instrument().subaperture_m)


def beyond_actuators_subap(magnification: float) -> float:
    """Return how far the pupil reaches beyond the outermost actuators, in subapertures."""
    outermost = float(np.hypot(*actuators_subap().T).max())
    return instrument().wfs.pupil_diameter / 2 - magnification * outermost


def plant(occasion: Occasion) -> DiffractivePlant:
    """Return the telescope of an occasion."""
    return _plant(occasion.still)


@lru_cache(maxsize=4)
def _plant(occasion: Occasion) -> DiffractivePlant:
    options, rng = occasion.options(), occasion.rng(_PLANT)
    if occasion.imperfections.startswith(DRAWN):
        return DrawnPlant(
            instrument(),
            basis(),
            rng=rng,
            imperfections=options.imperfections,
            scene=options.scene,
        )
    built = build_plant(options, instrument(), basis(), rng)
    if not isinstance(built, DiffractivePlant):
        raise TypeError(f"study: found {type(built).__name__}; expected --plant diffractive")
    return built


def optics(occasion: Occasion, alpha: Misregistration) -> DiffractiveOptics:
    """Return the telescope's optics with its mirror lying there."""
    return _optics(occasion.still, alpha)


@lru_cache(maxsize=3)
def _optics(occasion: Occasion, alpha: Misregistration) -> DiffractiveOptics:
    return _plant(occasion).optics(alpha)


@lru_cache(maxsize=2)
def incoming(occasion: Occasion, n_frames: int) -> tuple[Array32, Array32 | None]:
    """Return ``(n_frames, n_points)`` OPD that comes in and ``(n_frames, n_modes)`` played, metres.

    None: nothing is played on the mirror. The same for every mirror and reconstructor.
    """
    options = occasion.options()
    time_s = np.arange(n_frames) / options.frame_rate_hz
    return sky(occasion).seen(time_s)


def sky(occasion: Occasion) -> Sky:
    """Return the sky from the first frame on."""
    telescope = plant(occasion)
    options = occasion.options()
    return build_sky(options, instrument(), basis(), telescope, occasion.rng(_SKY))


def detector(occasion: Occasion, seen: DiffractiveOptics) -> Detector:
    """Return what is known of the detector's noise."""
    options = occasion.options()
    return Detector(
        instrument(),
        images=seen.images,
        valid=seen.valid,
        magnitude=options.magnitude,
        frame_rate_hz=options.frame_rate_hz,
        camera=options.camera,
    )


def pixels(occasion: Occasion, seen: DiffractiveOptics) -> PixelDetector:
    """Return the detector itself."""
    return PixelDetector(
        electrons_per_light=detector(occasion, seen).electrons_per_frame,
        camera=occasion.options().camera,
    )


def photons(occasion: Occasion) -> np.random.Generator:
    """Return the randomness of the photons of a closed loop."""
    return occasion.rng(_PHOTONS)


def measuring(occasion: Occasion, part: int) -> np.random.Generator:
    """Return the randomness of one part of a measurement of the interaction matrix."""
    return occasion.rng(_MEASURING).spawn(part + 1)[part]


def forget() -> None:
    """Let go of everything that was kept: another instrument follows."""
    for kept in (_plant, _optics, incoming):
        kept.cache_clear()
