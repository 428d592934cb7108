"""The light on the four pupil images, from a file: how even the beam is, and where it lies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import MatrixError
from service.fits.container import opened
from service.model.instrument import Instrument
from service.model.pupil import Illumination
from service.model.slopes import turned_mask
from service.registration.flux import CannotTell, PupilPosition, find_pupil
from service.registration.illumination import measured_illumination

FLUX = "flux"
"""Name of the array in its file."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Light:
    """What the light tells."""

    illumination: Illumination
    """For the model's pupil amplitude."""

    position: PupilPosition
    """Where the pupil images lie."""

    @property
    def note(self) -> str:
        """What somebody who fits should know of it, one sentence."""
        at = self.position
        return (
            f"the model is lit as the flux map says; by its light alone the pupil images lie at "
            f"x = {at.x_subap:.2f} ± {at.sigma_x_subap:.2f}, y = {at.y_subap:.2f} ± "
            f"{at.sigma_y_subap:.2f} subapertures"
        )


def read_light(path: Path, instrument: Instrument) -> Light:
    """Read mean counts ``(4, n, n)``, the images in row-major order of their place on the detector.

    They are in the RTC's own axes, as slopes are, so the instrument must know these.

    Raises
    ------
    MatrixError
        If there are no such counts in the file, their axes are not known, or they show no pupil.
    """
    if instrument.slopes.orientation is None:
        raise MatrixError(
            f'{path}: found slopes.orientation = "auto", expected it written down: which way a '
            "flux map lies it does not show; fit without it once, and copy what was found"
        )
    n = instrument.wfs.n_subapertures
    with opened(path) as container:
        stored = container.find(FLUX)
        if stored is None:
            raise MatrixError(f"{path}: no dataset {FLUX}; it holds {container.listing()}")
        if stored.shape != (4, n, n):
            raise MatrixError(f"{stored.where}: found shape {stored.shape}, expected {(4, n, n)}")
        counts = in_conventions(stored.numbers(), instrument)
    position = find_pupil(counts, instrument)
    if isinstance(position, CannotTell):
        raise MatrixError(f"{path}: {position.reason}")
    return Light(
        illumination=measured_illumination(counts, instrument, position), position=position
    )


def in_conventions(counts: NDArray[Any], instrument: Instrument) -> NDArray[Any]:
    """Return counts ``(4, n, n)`` in the RTC's axes, in those of conventions.md.

    A flip or a swap moves the images among one another, too.
    """
    n = counts.shape[-1]
    detector = counts.reshape(2, 2, n, n).transpose(0, 2, 1, 3).reshape(2 * n, 2 * n)
    turned = turned_mask(detector, instrument.slopes.assumed_orientation)
    return np.ascontiguousarray(turned.reshape(2, n, 2, n).transpose(0, 2, 1, 3)).reshape(4, n, n)
