"""Measure the pupil that a mask of valid subapertures shows, and compare it with the described one.

The mask and the pupil of an instrument file come from different sources. Where they disagree,
slopes of dark subapertures are fitted or those of lit ones are missing, and the fit takes the
difference for another stop or another mirror.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model.instrument import Instrument
from service.model.kinds import Stop
from service.model.pupil import lit_subapertures
from service.model.slopes import rtc_mask

SMALLEST_HOLE = 4
"""Subapertures of the smallest central hole: fewer are dead ones."""

OFF_CENTRE_SUBAP = 0.25
"""Offset of a mask from the middle of its grid that is mentioned."""

MAX_WIDTH_DIFFERENCE_SUBAP = 1.25
"""Difference of the diameters of mask and pupil that is mentioned. Flux thresholds from 0.1 to 0.9
of a full subaperture change the diameter of a mask by 0.8 either way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Aperture:
    """Size and position of the pupil that a mask of subapertures shows."""

    diameter_subap: float
    """Diameter of a disc that has the area of the mask and its central hole together, subapertures.
    """

    hole_subap: float
    """Diameter of a disc that has the area of the central hole, subapertures; 0 without a hole."""

    centre: tuple[float, float]
    """Offset along x and y from the middle of the grid, subapertures."""

    @property
    def obscuration_ratio(self) -> float:
        """Diameter of the hole over that of the pupil."""
        return self.hole_subap / self.diameter_subap

    @property
    def words(self) -> str:
        """Diameter, hole and centre, in words."""
        x, y = self.centre
        is_off = float(np.hypot(x, y)) > OFF_CENTRE_SUBAP
        at = f", centred {x:+.2f}, {y:+.2f} from the middle of the grid" if is_off else ""
        hole = f", a central hole of {self.hole_subap:.1f}" if self.hole_subap else ", no hole"
        return f"{self.diameter_subap:.1f} subapertures across{hole}{at}"


def measure_aperture(valid: NDArray[np.bool_]) -> Aperture:
    """Return the pupil that a mask ``(n, n)`` shows."""
    # Without its holes, so that dead subapertures do not narrow the pupil.
    filled = scipy.ndimage.binary_fill_holes(valid)
    labels, _ = scipy.ndimage.label(filled & ~valid, np.ones((3, 3)))
    middle = (np.array(valid.shape) - 1) / 2.0
    centre = np.argwhere(filled).mean(axis=0)
    row, column = np.rint(centre).astype(int)
    # The hole nearest to the centre: dead subapertures elsewhere are holes, too.
    around = labels[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    hole = int(np.sum(labels == around.max())) if around.max() else 0
    offset = centre - middle
    return Aperture(
        diameter_subap=float(np.sqrt(4.0 * filled.sum() / np.pi)),
        hole_subap=float(np.sqrt(4.0 * hole / np.pi)) if hole >= SMALLEST_HOLE else 0.0,
        centre=(float(offset[1]), float(offset[0])),
    )


def check_mask(
    instrument: Instrument, shift_subap: tuple[float, float] | None = None
) -> str | None:
    """Return how the mask of an instrument differs from its pupil, or None if it does not.

    Parameters
    ----------
    instrument
        Of which only a mask of its own is compared; one made by flux is that of its pupil.
    shift_subap
        Shift of the mirror on the sensor, with which the pupil moves where the mirror is the stop.
        None if it is unknown: centres are then compared with the telescope as stop only.
    """
    own = instrument.wfs.valid_subapertures
    if own is None:
        return None
    lit = rtc_mask(lit_subapertures(instrument), instrument.slopes.assumed_orientation)
    if not lit.any():
        return None
    mask, pupil = measure_aperture(own), measure_aperture(lit)
    by_mirror = instrument.stop is Stop.MIRROR
    # With the mirror as stop the pupil is where α puts it; without α its place is not compared.
    moved = shift_subap if by_mirror else instrument.pupil_shift_subap or (0.0, 0.0)
    wide = abs(mask.diameter_subap - pupil.diameter_subap) > MAX_WIDTH_DIFFERENCE_SUBAP
    # lengths alone are compared: which way the grid lies may be unknown
    lies = None if moved is None else float(np.hypot(*np.add(pupil.centre, moved)))
    off = lies is not None and abs(float(np.hypot(*mask.centre)) - lies) > OFF_CENTRE_SUBAP
    if not wide and not off:
        return None
    at = f"{mask.centre[0]:+.2f}, {mask.centre[1]:+.2f} from the middle of its grid"
    found = (
        f"wfs.valid_subapertures: the mask is {mask.diameter_subap:.1f} subapertures across, "
        f"centred {at}; the pupil lights {pupil.diameter_subap:.1f} subapertures across"
    )
    if lies is not None:
        found += f", centred {lies:.2f} from the middle"
    if wide:
        # a mask shows the diameter to a few per cent: its number is no value to be copied
        return (
            f"{found}: correct wfs.pupil_diameter_subap (pupil's image, subapertures) or the mask"
        )
    return f"{found}: put the pupil into the middle of the mask's grid"
