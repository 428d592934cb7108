"""From arrays in files to an instrument and its matrix: layouts are told by shape, and checked.

What the arrays are is told by role: the matrix, the valid subapertures, the modes. What no file
says is told by whoever imports, or is unknown, and then said as unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.importers.imported import (
    UNKNOWN,
    Array,
    Dataset,
    Imported,
    matrix_of,
    oriented,
)
from pyrcal.offline.pupil_width import answers_of, seen_pupil
from service.errors import MatrixError

UNITS_M = {"m": 1.0, "um": 1e-6, "nm": 1e-9}
"""Metres of OPD in a unit of the commands."""

ROLES = {
    "matrix": ("interaction_matrix", "im", "imat", "intmat", "D", "matrix"),
    "valid": ("valid_subapertures", "valid", "mask", "valid_sub_aps", "subap_mask"),
    "modes": ("modes", "influence_functions", "cube", "ifunc", "mode_shapes"),
    "mode_to_actuator": ("mode_to_actuator", "M2C", "m2c"),
    "positions": ("positions", "xy_m", "coordinates"),
}
"""What arrays are for, and the names by which they are known in a file of several."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reported:
    """What no array says."""

    diameter_m: float
    """Of the pupil; cubes of modes are as wide, edge to edge."""

    sensor: str
    """``pyramid`` or ``shack-hartmann``."""

    stop: str
    """``telescope`` or ``mirror``."""

    obscuration_ratio: float = 0.0
    """Linear, of the pupil."""

    wavelength_m: float | None = None
    """None: unknown."""

    modulation_lambda_over_d: float | None = None
    """None: unknown; of a pyramid only."""

    pupil_diameter_subap: float | None = None
    """Of the pupil's image; None: as wide as the mask."""

    centroid: str | None = None
    """Of a Shack-Hartmann; None: not told, as the instrument file takes it."""

    order: str = "xy"
    """Of the slopes, as its user would list them; the fit finds another."""

    unit: str | None = None
    """Of the commands, OPD; None: unknown, so that only shapes are compared."""


def from_arrays(source: str, arrays: Mapping[str, Array], reported: Reported) -> Imported:
    """Return an instrument and its matrix from arrays by role.

    Raises
    ------
    MatrixError
        If a role is missing, or a shape fits no layout, or several.
    """
    notes: list[str] = []
    for role in ("matrix", "valid"):
        if role not in arrays and not (role == "valid" and arrays["matrix"].ndim > 2):
            raise MatrixError(
                f"{source}: found no {role}; expected an array named {' or '.join(ROLES[role])}, "
                "or a file of its own"
            )
    given, found = arrays.get("valid"), np.asarray(arrays["matrix"])
    valid = None if given is None else mask_of(given, notes)
    if found.ndim > 2:
        maps = maps_of(found, None if valid is None else len(valid), notes)
        valid = _lit(maps, notes) if valid is None else valid
        found = maps[:, valid].reshape(-1, maps.shape[-1])
    if valid is None:
        raise MatrixError(f"{source}: found no valid subapertures, expected a mask (n, n)")
    mirror, kept, n_modes = _mirror(source, arrays, reported, notes)
    matrix, turned = matrix_of(found, 2 * int(valid.sum()), _columns(found, valid, n_modes))
    notes += turned
    if n_modes > matrix.shape[1]:
        notes.append(f"the matrix is of the first {matrix.shape[1]} of {n_modes} modes")
        kept["modes"] = np.arange(matrix.shape[1])
    if reported.unit is None:
        mirror["stroke"] = UNKNOWN
        notes.append("the unit of the commands is unknown: only shapes are compared")
    else:
        matrix = matrix / UNITS_M[reported.unit]
    sensor = _sensor(reported, valid, matrix, notes)
    return Imported(
        source=source,
        tables={
            "instrument": {
                "name": "bench",
                "diameter_m": reported.diameter_m,
                "obscuration_ratio": reported.obscuration_ratio,
                "stop": reported.stop,
            },
            "wfs": sensor,
            "mirror": mirror,
            "slopes": {"order": reported.order, "orientation": "auto"},
        },
        arrays={
            "interaction_matrix": matrix,
            "valid_subapertures": valid.astype(np.uint8),
            **kept,
        },
        notes=(*notes, *(f"{key} is unknown" for key, v in sensor.items() if v == UNKNOWN)),
    )


def _columns(matrix: Array, valid: NDArray[np.bool_], n_modes: int) -> int:
    """Return how many columns are expected: all modes, or as many of them as the matrix has."""
    others = [n for n in matrix.shape if n != 2 * int(valid.sum())]
    return others[0] if len(others) == 1 and others[0] < n_modes else n_modes


def _sensor(
    reported: Reported, valid: NDArray[np.bool_], matrix: Array, notes: list[str]
) -> dict[str, Any]:
    """Return ``[wfs]``."""
    table: dict[str, Any] = {
        "kind": reported.sensor,
        "n_subapertures": len(valid),
        "wavelength_m": reported.wavelength_m or UNKNOWN,
        "valid_subapertures": Dataset("valid_subapertures"),
    }
    if reported.sensor == "pyramid":
        modulation = reported.modulation_lambda_over_d
        table["modulation_lambda_over_d"] = UNKNOWN if modulation is None else modulation
    elif reported.centroid is not None:
        table["centroid"] = reported.centroid
    if reported.pupil_diameter_subap is not None:
        return {**table, "pupil_diameter_subap": reported.pupil_diameter_subap}
    notes += _narrow(matrix, valid)
    return table


def _narrow(matrix: Array, valid: NDArray[np.bool_]) -> list[str]:
    """Return that the mask is wider than the pupil's image, if it looks so."""
    power = np.einsum("ij,ij->i", matrix, matrix)
    seen = seen_pupil(answers_of(power, np.ones(len(power)), valid), len(valid))
    if seen is None:
        return []
    return [
        f"{seen.words}, the mask has {len(valid)}: say --pupil-subap, unless the mirror does not "
        "reach these"
    ]


# --- the mirror


def _mirror(
    source: str, arrays: Mapping[str, Array], reported: Reported, notes: list[str]
) -> tuple[dict[str, Any], dict[str, Array], int]:
    """Return ``[mirror]``, its arrays, and how many modes it has."""
    strokes = arrays.get("mode_to_actuator")
    if "positions" in arrays:
        places, turned = oriented(
            arrays["positions"], _longer(arrays["positions"]), 2, "positions", "(n_actuators, 2)"
        )
        notes += turned
        n_modes, table, kept = _of_actuators(len(places), strokes, notes)
        table |= {"layout": "positions", "positions": Dataset("positions")}
        return (
            {**table, "influence": "gaussian", "coupling": UNKNOWN},
            {
                "positions": places,
                **kept,
            },
            n_modes,
        )
    if "modes" not in arrays:
        raise MatrixError(
            f"{source}: found neither modes nor positions of actuators, expected one of the two"
        )
    cube = cube_of(arrays["modes"], notes)
    pitch = {"modes_pitch_m": reported.diameter_m / cube.shape[1]}
    if strokes is None:
        return {"modes": Dataset("mode_shapes"), **pitch}, {"mode_shapes": cube}, len(cube)
    n_modes, table, kept = _of_actuators(len(cube), strokes, notes)
    table |= {"influence_functions": Dataset("influence_functions"), **pitch}
    return table, {"influence_functions": cube, **kept}, n_modes


def _of_actuators(
    n_actuators: int, strokes: Array | None, notes: list[str]
) -> tuple[int, dict[str, Any], dict[str, Array]]:
    if strokes is None:
        return n_actuators, {"basis": "zonal"}, {}
    commands, turned = oriented(
        strokes, n_actuators, None, "mode_to_actuator", "(n_actuators, n_modes)"
    )
    notes += turned
    if commands.shape[1] > n_actuators:
        raise MatrixError(
            f"mode_to_actuator: found {commands.shape[1]} modes of {n_actuators} actuators, "
            "expected no more modes than actuators"
        )
    key = "mode_to_actuator"
    return commands.shape[1], {key: Dataset(key)}, {key: commands}


def _longer(values: Array) -> int:
    return max(np.shape(values), default=0)


# --- layouts


def mask_of(values: Array, notes: list[str]) -> NDArray[np.bool_]:
    """Return a mask ``(n, n)`` of subapertures.

    Raises
    ------
    MatrixError
        If it is none: of another shape, with other values than 0 and 1, or empty. One that lists
        the same mask for x and for y, ``(2n, n)`` or ``(n, 2n)``, is taken once.
    """
    mask = np.asarray(values)
    if mask.ndim == 2 and max(mask.shape) == 2 * min(mask.shape):
        of_x, of_y = np.split(mask, 2, axis=int(np.argmax(mask.shape)))
        if np.array_equal(of_x, of_y):
            notes.append("valid: listed twice, for x and y: taken once")
            mask = of_x
    if mask.ndim != 2 or mask.shape[0] != mask.shape[1] or not np.isin(mask, (0, 1)).all():
        raise MatrixError(
            f"valid: found shape {mask.shape} of {mask.dtype}, expected a mask (n, n) of 0 and 1"
        )
    if not mask.any():
        raise MatrixError("valid: found no valid subaperture, expected some")
    return mask.astype(bool)


def maps_of(values: Array, n: int | None, notes: list[str]) -> Array:
    """Return slopes that are listed as maps as ``(2, n, n, n_modes)``, Sx then Sy.

    They may come as ``(2, n, n)`` maps or as one map of both, side by side ``(n, 2n)`` or one above
    the other ``(2n, n)``; modes first or last.

    Raises
    ------
    MatrixError
        If they fit no layout, or several.
    """
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


def _lit(maps: Array, notes: list[str]) -> NDArray[np.bool_]:
    """Return the subapertures that answer to any mode: in maps the others are 0 or not finite."""
    lit = np.nan_to_num(maps).any(axis=(0, -1))
    notes.append(f"valid: no mask: the {int(lit.sum())} subapertures that answer to any mode")
    return np.asarray(lit)


def cube_of(values: Array, notes: list[str]) -> NDArray[np.float32]:
    """Return shapes as ``(n_modes, ny, nx)``: the two axes of equal length are the map's.

    Raises
    ------
    MatrixError
        If no two axes are, or it cannot be told which two.
    """
    cube = np.asarray(values)
    if cube.ndim != 3 or cube.dtype.kind not in "iuf":
        raise MatrixError(
            f"modes: found shape {cube.shape} of {cube.dtype}, expected numbers (n_modes, n, n)"
        )
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


def by_role(arrays: Mapping[str, Array], where: str) -> dict[str, Array]:
    """Return the arrays of a file by what they are for, as their names say.

    Raises
    ------
    MatrixError
        If two have names of the same role.
    """
    found: dict[str, Array] = {}
    for role, names in ROLES.items():
        there = [name for name in names if name in arrays]
        if len(there) > 1:
            raise MatrixError(f"{where}: found {' and '.join(there)}, expected one {role}")
        if there:
            found[role] = arrays[there[0]]
    return found
