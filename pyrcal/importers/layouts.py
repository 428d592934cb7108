"""Recognise the layout of arrays by shape: masks, maps of slopes, cubes of modes.

An array that fits no layout, or several, is rejected. Where no file has a mask, the maps show which
subapertures are lit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal.importers.imported import Array
from service.errors import MatrixError
from service.model.aperture import SMALLEST_HOLE

_NUMBERED = re.compile(r"(?:_\d{1,6})+$")

ROLES = {
    "matrix": ("interaction_matrix", "im", "imat", "intmat", "int_mat", "D", "matrix"),
    "valid": (
        *("valid_subapertures", "valid", "mask", "valid_sub_aps", "subap_mask"),
        *("valid_pixel", "valid_pixels", "validI4Q"),
    ),
    "light": ("flux_frame", "light", "wfsref", "reference_frame", "referenceIntensity"),
    "modes": ("modes", "influence_functions", "cube", "ifunc", "mode_shapes"),
    "mode_to_actuator": ("mode_to_actuator", "M2C"),
    "positions": ("positions", "xy_m", "coordinates"),
    "pupil": ("pupil",),
}
"""Names of arrays by role, in a file with several arrays."""

_ROLE_OF_NAME = {name.lower(): role for role, names in ROLES.items() for name in names}
"""Roles by name, in lower case: FITS has capitals only."""

_MIN_COHERENCE = 0.5
"""Smallest correlation of a lit subaperture's response with that of its neighbours. An influence
function spans several subapertures, so lit neighbours respond alike; noise does not."""

_SMALLEST_SHARE = 0.1
"""Smallest plausible share of lit subapertures on the grid."""


def mask_of(values: Array, notes: list[str]) -> NDArray[np.bool_]:
    """Return a mask ``(n, n)`` of subapertures.

    Raises
    ------
    MatrixError
        If it is none: of another shape, with other values than 0 and 1, or empty. One that lists
        the same mask for x and for y, ``(2n, n)`` or ``(n, 2n)``, is taken once.
    """
    mask = np.asarray(values)
    if is_listed_twice(mask):
        notes.append("valid: listed twice, for x and y: taken once")
        mask = np.split(mask, 2, axis=int(np.argmax(mask.shape)))[0]
    if mask.ndim != 2 or mask.shape[0] != mask.shape[1]:
        raise MatrixError(
            f"valid: found shape {mask.shape} of {mask.dtype}, expected a mask (n, n) of 0 and 1"
        )
    check_binary(mask, "valid")
    if not mask.any():
        raise MatrixError("valid: found no valid subaperture, expected some")
    return mask.astype(bool)


def plane_of(values: Array) -> Array:
    """Return an image, also if a FITS file has it as a cube with a single plane."""
    found = np.asarray(values)
    return found[0] if found.ndim == 3 and len(found) == 1 else found


def is_listed_twice(mask: Array) -> bool:
    """Return True if a mask contains the same subapertures twice, for x and for y."""
    if mask.ndim != 2 or max(mask.shape) != 2 * min(mask.shape):
        return False
    of_x, of_y = np.split(mask, 2, axis=int(np.argmax(mask.shape)))
    return bool(np.array_equal(of_x, of_y))


def check_binary(mask: Array, what: str) -> None:
    """Raise if a mask has values other than 0 and 1, and quote two of them.

    Raises
    ------
    MatrixError
        If it has such values.
    """
    other = np.unique(mask[~np.isin(mask, (0, 1))])
    if other.size:
        quoted = " and ".join(f"{value:g}" for value in other[:2])
        # FITS stores unsigned bytes less 128: a reader that ignores BZERO leaves -128 and -127.
        hint = ": was BZERO applied?" if np.any(other == -128) else ""
        raise MatrixError(f"{what}: found values {quoted}, expected a mask of 0 and 1{hint}")


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


def maps_of(values: Array, n: int | None, notes: list[str]) -> Array:
    """Return slopes listed as maps as ``(2, n, n, n_modes)``, Sx then Sy.

    Accepted are ``(2, n, n)`` maps, or one map of both, next to each other ``(n, 2n)`` or one above
    the other ``(2n, n)``; modes first or last.

    Raises
    ------
    MatrixError
        If they fit no layout, or several.
    """
    # All layouts are tried: a shape that fits two of them must not be taken for the first.
    ways: dict[str, Array] = {}
    for first in (True, False):
        modes_last = np.moveaxis(values, 0, -1) if first else values
        shape, where = modes_last.shape[:-1], "first" if first else "last"
        if len(shape) == 3 and shape[0] == 2 and shape[1] == shape[2]:
            ways[f"(2, n, n), modes {where}"] = modes_last
        elif len(shape) == 2 and shape[1] == 2 * shape[0]:
            ways[f"(n, 2n), modes {where}"] = np.stack(np.split(modes_last, 2, axis=1))
        elif len(shape) == 2 and shape[0] == 2 * shape[1]:
            ways[f"(2n, n), modes {where}"] = np.stack(np.split(modes_last, 2, axis=0))
    ways = {way: maps for way, maps in ways.items() if n in {None, maps.shape[1]}}
    if len(ways) != 1:
        raise MatrixError(
            f"matrix: found shape {values.shape}, expected maps of slopes: (2, n, n), (n, 2n) or "
            f"(2n, n), modes first or last; it fits {' and '.join(ways) or 'none of them'}"
        )
    ((way, maps),) = ways.items()
    notes.append(f"matrix: maps of slopes, {way}: the first half taken as Sx")
    return maps


def cube_of(values: Array, notes: list[str]) -> NDArray[np.float32]:
    """Return shapes as ``(n_modes, ny, nx)``: the map has the two axes of equal length.

    Raises
    ------
    MatrixError
        If it is unclear which two axes are the map's.
    """
    cube = _unfold(np.asarray(values), notes)
    if cube.ndim != 3 or cube.dtype.kind not in "iuf":
        raise MatrixError(
            f"modes: found shape {cube.shape} of {cube.dtype}, expected numbers (n_modes, n, n)"
        )
    # Modes are rendered on square maps: the two equal axes are the map's, unless all three are.
    first, _, last = cube.shape
    if first == last or (first != cube.shape[1] and cube.shape[1] != last):
        raise MatrixError(
            f"modes: found shape {cube.shape}, expected (n_modes, n, n) or (n, n, n_modes) with "
            "n_modes other than n"
        )
    if first == cube.shape[1]:
        notes.append("modes: listed last, (n, n, n_modes): turned to (n_modes, n, n)")
        cube = np.moveaxis(cube, -1, 0)
    return np.ascontiguousarray(cube, dtype=np.float32)


def _unfold(values: Array, notes: list[str]) -> Array:
    """Return shapes that are listed with one axis for all points of a square map as a cube.

    OOPAO lists its influence functions so. A map has more points than there are modes.
    """
    points = max(values.shape, default=0)
    side = math.isqrt(points)
    if values.ndim != 2 or side**2 != points or min(values.shape) == points:
        return values
    notes.append(f"modes: {points} points each: taken as maps of {side} x {side}")
    by_mode = values if values.shape[1] == points else values.T
    return by_mode.reshape(-1, side, side)


def by_role(arrays: Mapping[str, Array], where: str) -> dict[str, Array]:
    """Return the arrays of a file by role, recognised by name in any letter case.

    Of a name with dots, such as a field of a MATLAB struct has, the last part counts. A single
    number, such as the diameter ``tel.D``, has no role.

    Raises
    ------
    MatrixError
        If two have names of the same role.
    """
    names: dict[str, str] = {}
    for name in (one for one, values in arrays.items() if np.size(values) > 1):
        role = _ROLE_OF_NAME.get(name.rpartition(".")[2].lower())
        if role is not None and names.setdefault(role, name) != name:
            raise MatrixError(f"{where}: found {names[role]} and {name}, expected one {role}")
    return {role: arrays[name] for role, name in names.items()}


def role_of_name(name: str) -> str | None:
    """Return the role for an array or file name; None if the name is unknown.

    Numbers may follow the name, as in ``int_mat_1_5_10``.
    """
    return _ROLE_OF_NAME.get(_NUMBERED.sub("", name).lower())


def numbers_of_name(name: str) -> list[int]:
    """Return the numbers at the end of a name like ``int_mat_1_5_10``."""
    match = _NUMBERED.search(name)
    return [] if match is None else [int(number) for number in match[0].split("_")[1:]]
