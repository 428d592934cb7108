"""Read the illumination of a sensor from a file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.light_rotation import Arms, LightRotation, find_rotation
from service.errors import MatrixError
from service.files.container import opened
from service.model.instrument import Instrument
from service.model.pupil import Illumination
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import CannotTell, Light, PupilPosition

FLUX = "flux"
"""Name of the array in its file."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenLight:
    """Measured illumination with its position and rotation."""

    illumination: Illumination
    """Illumination for the model's pupil amplitude."""

    position: PupilPosition
    turn: LightRotation | CannotTell | None = None
    """Rotation relative to the spider's arms at rotation 0, or to the illumination of another day;
    None without a reference."""

    @property
    def note(self) -> str:
        """Note on the illumination for the report of the fit, one sentence."""
        (x, y), (sigma_x, sigma_y) = self.position.at, self.position.sigma
        return (
            f"the model is lit as the flux map says; from the light alone the pupil images are at "
            f"x = {x:.2f} ± {sigma_x:.2f}, y = {y:.2f} ± {sigma_y:.2f} subapertures"
            f"{self._turn_note}"
        )

    @property
    def _turn_note(self) -> str:
        match self.turn:
            case None:
                return ""
            case CannotTell(reason=reason):
                return f"; their rotation is unknown: {reason}"
            case LightRotation(rotation_rad=rotation, sigma_rad=sigma):
                return (
                    f", turned by {np.rad2deg(rotation):+.1f} ± {np.rad2deg(sigma):.1f} deg "
                    "against the reference"
                )


def read_light(
    path: Path, instrument: Instrument, reference: Path | Arms | None = None
) -> SeenLight:
    """Read mean counts ``(4, n, n)`` of a pyramid, with the images as on the detector.

    The counts are in the axes of the RTC, like slopes, so the instrument must state these axes. A
    ``reference`` (the counts of another day, or the spider's arms at rotation 0) determines the
    rotation: over any angle with counts, and within half the arms' spacing around the mirror's
    nominal rotation with arms.

    Raises
    ------
    MatrixError
        If the file has no such counts, their axes are unknown, or they show no pupil.
    """
    light = _light_of(path, instrument)
    counts, position = _read(path, instrument, light)
    turn = None
    if reference is not None:
        turn = _turn(light.relative(counts, position), position, instrument, reference)
    illumination = light.illumination(counts, position)
    return SeenLight(illumination=illumination, position=position, turn=turn)


def _turn(
    light: tuple[NDArray[np.float64], NDArray[np.bool_]],
    position: PupilPosition,
    instrument: Instrument,
    reference: Path | Arms,
) -> LightRotation | CannotTell:
    if isinstance(reference, Path):
        return find_rotation(*light, position, _illumination(reference, instrument))
    nominal = instrument.start.rotation_rad
    there = replace(reference, angles_rad=tuple(a + nominal for a in reference.angles_rad))
    # Evenly spaced arms look the same after one spacing: only around a known rotation, and within
    # half of the spacing, is the result unambiguous.
    known = instrument.mirror.nominal_rotation_rad is not None
    within = np.pi / len(there.angles_rad) if known else 2 * np.pi
    found = find_rotation(*light, position, there, within_rad=within)
    if isinstance(found, CannotTell):
        return found
    return replace(found, rotation_rad=nominal + found.rotation_rad)


def _illumination(path: Path, instrument: Instrument) -> Illumination:
    light = _light_of(path, instrument)
    counts, position = _read(path, instrument, light)
    return light.illumination(counts, position)


def _light_of(path: Path, instrument: Instrument) -> Light:
    light = kind_of(instrument).light(instrument)
    if isinstance(light, CannotTell):
        raise MatrixError(f"{path}: {light.reason}")
    return light


def _read(
    path: Path, instrument: Instrument, light: Light
) -> tuple[NDArray[np.float64], PupilPosition]:
    """Return counts in the axes of conventions.md, and where they show the pupil."""
    if instrument.slopes.orientation is None:
        raise MatrixError(
            f'{path}: found slopes.orientation = "auto", expected a stated orientation: a '
            "flux map does not show its own; fit without it once, and copy the orientation found"
        )
    with opened(path) as container:
        stored = container.find(FLUX)
        if stored is None:
            raise MatrixError(f"{path}: no dataset {FLUX}; it holds {container.listing()}")
        if stored.shape != light.shape:
            raise MatrixError(f"{stored.where}: found shape {stored.shape}, expected {light.shape}")
        counts = light.orient_counts(stored.numbers())
    position = light.find_pupil(counts)
    if isinstance(position, CannotTell):
        raise MatrixError(f"{path}: {position.reason}")
    return counts, position
