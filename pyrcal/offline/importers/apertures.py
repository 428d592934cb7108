"""Describe the mask of valid subapertures, and find it where no file has one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal.offline.importers.imported import Array
from service.errors import MatrixError

_SMALLEST_HOLE = 4
"""Subapertures of the smallest central hole: fewer are dead ones."""

_OFF_CENTRE_SUBAP = 0.25
"""Offset of a mask from the middle of its grid that is mentioned."""

_COHERENT = 0.5
"""Least correlation of a lit subaperture's response with that of its neighbours. An influence
function spans several subapertures, so lit neighbours respond alike; noise does not."""

_SMALLEST_SHARE = 0.1
"""Least share of the grid that is believed to be lit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Aperture:
    """Size and position of the pupil that a mask of subapertures shows."""

    diameter_subap: float
    """Of the disc with the area of the mask and its hole."""

    hole_subap: float
    """Of the disc with the area of the central hole; 0 where there is none."""

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
        at = f", centred {x:+.2f}, {y:+.2f} from the middle of the grid" if self.is_off else ""
        hole = f", a central hole of {self.hole_subap:.1f}" if self.hole_subap else ", no hole"
        return f"{self.diameter_subap:.1f} subapertures across{hole}{at}"

    @property
    def is_off(self) -> bool:
        """Whether the pupil does not lie in the middle of the grid."""
        return float(np.hypot(*self.centre)) > _OFF_CENTRE_SUBAP


def measure_aperture(valid: NDArray[np.bool_]) -> Aperture:
    """Return the pupil that a mask ``(n, n)`` shows."""
    filled = scipy.ndimage.binary_fill_holes(valid)
    labels, _ = scipy.ndimage.label(filled & ~valid, np.ones((3, 3)))
    middle = (np.array(valid.shape) - 1) / 2.0
    centre = np.argwhere(filled).mean(axis=0)
    row, column = np.rint(centre).astype(int)
    around = labels[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    hole = int(np.sum(labels == around.max())) if around.max() else 0
    offset = centre - middle
    return Aperture(
        diameter_subap=float(np.sqrt(4.0 * filled.sum() / np.pi)),
        hole_subap=float(np.sqrt(4.0 * hole / np.pi)) if hole >= _SMALLEST_HOLE else 0.0,
        centre=(float(offset[1]), float(offset[0])),
    )


def find_lit(maps: Array, notes: list[str]) -> NDArray[np.bool_]:
    """Return the subapertures ``(n, n)`` that respond, of maps ``(2, n, n, n_modes)``.

    Where dark subapertures are exactly 0 or not finite they are left out. Where they hold noise,
    those are lit whose response is correlated with that of their neighbours.

    Raises
    ------
    MatrixError
        If no subaperture responds, or lit and dark ones cannot be told apart.
    """
    numbers = np.nan_to_num(maps)
    lit = numbers.any(axis=(0, -1))
    if not lit.any():
        raise MatrixError("matrix: found no subaperture that responds, expected some")
    if not lit.all():
        notes.append(f"valid: no mask: the {int(lit.sum())} subapertures that answer to any mode")
        return np.asarray(lit)
    coherent = _largest_piece(_coherence(numbers) > _COHERENT)
    if coherent.sum() < _SMALLEST_SHARE * coherent.size:
        raise MatrixError(
            "matrix: found no mask, and noise in every subaperture: lit and dark ones cannot be "
            "told apart; expected a mask of valid subapertures"
        )
    if coherent.all():
        notes.append("valid: no mask: all subapertures of the grid respond")
    else:
        notes.append(
            f"valid: no mask, and noise in dark subapertures: {int(coherent.sum())} of "
            f"{coherent.size} respond as their neighbours do and are taken as lit"
        )
    return coherent


def _coherence(maps: Array) -> Array:
    """Return the correlation ``(n, n)`` of each subaperture with the mean of its neighbours."""
    padded = np.pad(maps.astype(np.float64), ((0, 0), (1, 1), (1, 1), (0, 0)))
    here = padded[:, 1:-1, 1:-1]
    around = padded[:, :-2, 1:-1] + padded[:, 2:, 1:-1] + padded[:, 1:-1, :-2] + padded[:, 1:-1, 2:]
    power = np.square(here).sum(axis=(0, -1)) * np.square(around).sum(axis=(0, -1))
    return np.asarray((here * around).sum(axis=(0, -1)) / np.sqrt(np.maximum(power, 1e-300)))


def _largest_piece(lit: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the largest connected piece, without gaps smaller than a central hole."""
    labels, n_pieces = scipy.ndimage.label(lit)
    if not n_pieces:
        return lit
    sizes = scipy.ndimage.sum_labels(lit, labels, np.arange(1, n_pieces + 1))
    piece = labels == 1 + int(np.argmax(sizes))
    gaps, n_gaps = scipy.ndimage.label(~piece)
    for number in range(1, n_gaps + 1):
        gap = gaps == number
        if gap.sum() < _SMALLEST_HOLE and not _touches_edge(gap):
            piece |= gap
    return np.asarray(piece)


def _touches_edge(region: NDArray[np.bool_]) -> bool:
    edges = (region[0], region[-1], region[:, 0], region[:, -1])
    return any(bool(edge.any()) for edge in edges)


def centre_grid(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask on the smallest square grid in whose middle its pupil lies.

    Subapertures keep their order, so slopes listed by the one are listed by the other.
    """
    rows, columns = np.flatnonzero(valid.any(axis=1)), np.flatnonzero(valid.any(axis=0))
    filled = scipy.ndimage.binary_fill_holes(valid)
    centre = np.argwhere(filled).mean(axis=0)
    first, last = np.array([rows[0], columns[0]]), np.array([rows[-1], columns[-1]])
    best: tuple[float, int, NDArray[np.intp]] | None = None
    least = int(np.max(last - first)) + 1
    for side in range(least, least + 3):
        start = np.rint(centre - (side - 1) / 2.0).astype(np.intp)
        if np.any(start > first) or np.any(start + side - 1 < last):
            continue
        off = float(np.hypot(*(centre - start - (side - 1) / 2.0)))
        if best is None or off < best[0] - _OFF_CENTRE_SUBAP:
            best = off, side, start
    if best is None:
        return valid
    _, side, start = best
    grid = np.zeros((side, side), dtype=bool)
    grid[tuple((np.argwhere(valid) - start).T)] = True
    return grid
