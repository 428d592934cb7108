"""Find the mask of valid subapertures where no file has one, and centre its grid."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal.importers.imported import Array
from service.errors import MatrixError
from service.model.aperture import OFF_CENTRE_SUBAP, SMALLEST_HOLE

_MIN_COHERENCE = 0.5
"""Smallest correlation of a lit subaperture's response with that of its neighbours. An influence
function spans several subapertures, so lit neighbours respond alike; noise does not."""

_SMALLEST_SHARE = 0.1
"""Smallest plausible share of lit subapertures on the grid."""


def find_lit(maps: Array, notes: list[str]) -> NDArray[np.bool_]:
    """Return the subapertures ``(n, n)`` that respond, from maps ``(2, n, n, n_modes)``.

    If dark subapertures are exactly 0 or not finite, all others are lit. If dark ones contain
    noise, those are lit whose response is correlated with that of their neighbours.

    Raises
    ------
    MatrixError
        If no subaperture responds, or lit and dark ones cannot be distinguished.
    """
    numbers = np.nan_to_num(maps)
    lit = numbers.any(axis=(0, -1))
    if not lit.any():
        raise MatrixError("matrix: found no subaperture that responds, expected some")
    if not lit.all():
        notes.append(f"valid: no mask: the {int(lit.sum())} subapertures that answer to any mode")
        return np.asarray(lit)
    coherent = _largest_piece(_coherence(numbers) > _MIN_COHERENCE)
    if coherent.sum() < _SMALLEST_SHARE * coherent.size:
        raise MatrixError(
            "matrix: found no mask, and noise in every subaperture: lit and dark ones cannot be "
            "distinguished; expected a mask of valid subapertures"
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
    piece = labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    # A single dark subaperture in the pupil is noise; a telescope's central hole is larger.
    gaps, _ = scipy.ndimage.label(scipy.ndimage.binary_fill_holes(piece) & ~piece)
    small = np.bincount(gaps.ravel()) < SMALLEST_HOLE
    return np.asarray(piece | (small[gaps] & (gaps > 0)))


def centre_grid(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask on the smallest square grid that centres its pupil.

    Subapertures keep their order, so the order of the slopes does not change.
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
        if best is None or off < best[0] - OFF_CENTRE_SUBAP:
            best = off, side, start
    if best is None:
        return valid
    _, side, start = best
    grid = np.zeros((side, side), dtype=bool)
    grid[tuple((np.argwhere(valid) - start).T)] = True
    return grid
