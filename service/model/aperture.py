"""Measure the pupil that a mask of valid subapertures shows, and compare it with the described one.

The mask and the pupil of an instrument file come from different sources. Where they disagree,
slopes of dark subapertures are fitted or those of lit ones are missing, and the fit takes the
difference for another stop or another mirror.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model.instrument import Instrument
from service.model.kinds import Stop
from service.model.pupil import lit_subapertures
from service.model.slopes import rtc_mask

SMALLEST_HOLE = 4
"""Subapertures of the smallest central hole: fewer are dead ones."""

RIM_SUBAP = 0.25
"""Typical distance of the steps of a mask's rim from a circle."""

OFF_CENTRE_SUBAP = 0.25
"""Offset of a mask from the middle of its grid that is mentioned."""

MAX_RIM_SCATTER_SUBAP = 0.3
"""Largest RMS distance of a whole rim from a circle: discs on a grid have 0.13 to 0.28, those of 12
subapertures or more that lack a row and a column 0.33."""

MAX_WIDTH_DIFFERENCE_SUBAP = 1.25
"""Difference of the diameters of mask and pupil that is mentioned. Flux thresholds from 0.1 to 0.9
of a full subaperture change the diameter of a mask by 0.8 either way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Aperture:
    """Size and position of the pupil that a mask of subapertures shows."""

    diameter_subap: float
    """Diameter of a disc that has the area of the mask, its central hole and missing parts of its
    rim together, subapertures."""

    n_across: int
    """Rows or columns of subapertures across that disc, whichever are more."""

    hole_subap: float
    """Diameter of a disc that has the area of the central hole, subapertures; 0 without a hole."""

    centre: tuple[float, float]
    """Offset along x and y from the middle of the grid, subapertures."""

    is_round: bool
    """True if the whole rim is on a circle, so that nothing of it is missing."""

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
    # With what its rim lacks, so that missing columns do not move the pupil.
    disc, scatter = _find_disc(filled)
    filled |= disc
    centre = np.argwhere(filled).mean(axis=0)
    row, column = np.rint(centre).astype(int)
    # The hole nearest to the centre: dead subapertures elsewhere are holes, too.
    around = labels[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    hole = int(np.sum(labels == around.max())) if around.max() else 0
    offset = centre - middle
    return Aperture(
        diameter_subap=float(np.sqrt(4.0 * filled.sum() / np.pi)),
        n_across=int(max(filled.any(axis=axis).sum() for axis in (0, 1))),
        hole_subap=float(np.sqrt(4.0 * hole / np.pi)) if hole >= SMALLEST_HOLE else 0.0,
        centre=(float(offset[1]), float(offset[0])),
        is_round=scatter < MAX_RIM_SCATTER_SUBAP,
    )


def _find_disc(filled: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], float]:
    """Return the subapertures ``(n, n)`` inside the circle that most of a mask's rim is on.

    The second value is the RMS distance of the whole rim from it.
    """
    steps = [np.argwhere(np.diff(np.pad(filled, 1), axis=axis)) for axis in (0, 1)]
    rim = np.concatenate([steps[0] - [0.5, 1.0], steps[1] - [1.0, 0.5]])
    low, high = rim.min(axis=0), rim.max(axis=0)

    def beyond(circle: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.hypot(*(rim - circle[:2]).T) - circle[2])

    start = [*(low + high) / 2.0, np.max(high - low) / 2.0]
    # The loss of far points hardly grows, so that missing columns do not move the circle.
    found = scipy.optimize.least_squares(beyond, start, loss="cauchy", f_scale=RIM_SUBAP).x
    rows, columns = np.indices(filled.shape)
    inside = np.hypot(rows - found[0], columns - found[1]) < found[2]
    return np.asarray(inside), float(np.sqrt(np.mean(beyond(found) ** 2)))


def find_offset(valid: NDArray[np.bool_], diameter_subap: float) -> tuple[float, float] | None:
    """Return where a mask shows a pupil of a known diameter, (x, y) from the middle of its grid.

    None if it is in the middle, or if the mask does not show the whole pupil.
    """
    seen = _measure_packed(valid.tobytes(), len(valid))
    whole = seen.is_round and abs(seen.diameter_subap - diameter_subap) < MAX_WIDTH_DIFFERENCE_SUBAP
    return seen.centre if whole and float(np.hypot(*seen.centre)) > OFF_CENTRE_SUBAP else None


@lru_cache(maxsize=8)
def _measure_packed(packed: bytes, n: int) -> Aperture:
    # Every evaluation of a model needs the result.
    return measure_aperture(np.frombuffer(packed, dtype=np.bool_).reshape(n, n))


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
        None if it is unknown: centres are then not compared.
    """
    own = instrument.wfs.valid_subapertures
    if own is None:
        return None
    lit = rtc_mask(lit_subapertures(instrument), instrument.slopes.assumed_orientation)
    if not lit.any():
        return None
    mask, pupil = measure_aperture(own), measure_aperture(lit)
    by_mirror = instrument.stop is Stop.MIRROR
    # With the mirror as stop the pupil is where α puts it. With the telescope as stop it is where
    # the mask or the fit shows it, unless its place is known.
    moved = shift_subap if by_mirror else instrument.pupil_shift_subap
    wider = abs(mask.diameter_subap - pupil.diameter_subap) > MAX_WIDTH_DIFFERENCE_SUBAP
    # A low flux threshold on a grid as wide as the pupil adds area but no rows.
    wide = wider and mask.n_across != pupil.n_across
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
    return f"{found}: correct the mask, or instrument.stop"
