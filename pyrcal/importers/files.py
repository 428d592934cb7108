"""Build an instrument and its matrix from arrays in files, recognised and checked by shape.

Each array has a role: the matrix, the valid subapertures, the modes. Parameters missing from the
files can be given as options. Otherwise they are read from the mask or marked unknown. Files of
pyRTC are such arrays; since its version 2.0 they have a record of their role.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.pupil_width import compute_responses, measure_pupil
from pyrcal.fitting.recorded import FLUX_FRAME
from pyrcal.importers.actuators import Mirror, read_mirror
from pyrcal.importers.frames import Frames, describe_frames, frames_of
from pyrcal.importers.imported import UNKNOWN, Array, Imported, Signals, in_arrays_file, matrix_of
from pyrcal.importers.layouts import ROLES, find_lit, maps_of, mask_of, plane_of
from service.errors import ConfigurationError, MatrixError, list_first
from service.model.aperture import OFF_CENTRE_SUBAP, measure_aperture
from service.model.defects import explain_defects, find_defects

RECORD, DATA, FORMAT = "pyrtc_calibration", "data", 2
KINDS = {"interaction_matrix": "matrix", "valid_sub_aps": "valid"}
"""Roles by the kind in pyRTC's record."""


def calibration_of(arrays: Mapping[str, Array], where: str) -> tuple[str, Array]:
    """Return the role and the array of a calibration file of pyRTC 2.

    Raises
    ------
    MatrixError
        If it has no record, or one that is newer or of another calibration.
    """
    try:
        record = json.loads(str(np.asarray(arrays[RECORD])[()]))
        kind, version, values = record["kind"], int(record["format"]), arrays[DATA]
    except (KeyError, TypeError, ValueError) as error:
        raise MatrixError(
            f"{where}: found no record of pyRTC 2 ({RECORD}), expected one, or ROLE=FILE"
        ) from error
    # A newer format may mean something else by the same names.
    if version > FORMAT or kind not in KINDS:
        raise MatrixError(
            f"{where}: found {kind} of format {version}, expected {' or '.join(KINDS)} of format "
            f"{FORMAT}"
        )
    return KINDS[kind], values


UNITS_M = {"m": 1.0, "um": 1e-6, "nm": 1e-9}
"""Metres of OPD in a unit of the commands."""

MIN_WIDTH_DIFFERENCE_SUBAP = 0.75
"""Difference of the widths of grid and pupil above which the pupil's width is recorded."""

MIN_SHOWN_SUBAP = 12
"""Smallest grid whose rows and columns show a narrower pupil: a disc of 8 subapertures that lacks a
row and a column looks like one of 7."""

MAX_ROWS_DIFFERENCE_SUBAP = 0.5
"""Difference of the diameter by area from the number of rows below which the rows count."""

MIN_OBSCURATION = 0.05
"""Smallest obscuration ratio that is read from a mask."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reported:
    """Parameters that no array contains."""

    diameter_m: float
    """Diameter of the pupil, metres; cubes of modes have the same width, edge to edge."""

    sensor: str | None = None
    """``pyramid`` or ``shack-hartmann``; None for that of the files, or a pyramid."""

    stop: str = "telescope"
    """Aperture stop: ``telescope`` or ``mirror``."""

    obscuration_ratio: float | None = None
    """Linear obscuration of the pupil; None to read it from the mask."""

    wavelength_m: float | None = None
    """Sensing wavelength, metres; None if unknown."""

    modulation_lambda_over_d: float | None = None
    """Modulation of a pyramid, λ/D; None if unknown."""

    pupil_diameter_subap: float | None = None
    """Diameter of the pupil image, subapertures; None for the width of the mask."""

    pixels_per_subaperture: int | None = None
    """Binning of camera frames; None for the largest that keeps two subapertures per actuator."""

    centroid: str | None = None
    """Centroid algorithm of a Shack-Hartmann; None for the default of the instrument file."""

    order: str = "xy"
    """Order of the slope components as assumed by the user; the fit may find another."""

    unit: str | None = None
    """Unit of the commands, OPD; None if unknown, so that only shapes are compared."""

    columns: Array | None = None
    """``(n_columns,)`` basis index of each column; None for the first ones."""

    basis: str | None = None
    """Meaning of columns if positions come without ``mode_to_actuator``: ``zonal`` for single
    actuators, ``KL`` for modes that pyrcal computes. None for zonal if the numbers agree."""

    @property
    def kind(self) -> str:
        """Kind of the sensor."""
        return self.sensor or "pyramid"


def from_arrays(
    source: str,
    arrays: Mapping[str, Array],
    reported: Reported,
    column_numbers: Array | None = None,
) -> Imported:
    """Return an instrument and its matrix from arrays by role.

    ``column_numbers`` are the numbers of the columns in their file, for messages and for the record
    of what was kept; None if all columns are present.

    Raises
    ------
    MatrixError
        If a role is missing, or a shape fits no layout, or several.
    """
    notes: list[str] = []
    if "matrix" not in arrays:
        raise MatrixError(
            f"{source}: found no matrix; expected an array named {' or '.join(ROLES['matrix'])}, "
            "or a file of its own"
        )
    # First, because the number of modes shows which axis of the matrix is theirs.
    mirror = read_mirror(source, arrays, reported.diameter_m, notes)
    frames = read_frames(source, arrays, reported.kind)
    if frames is None:
        signals = read_slopes(source, arrays, mirror.n_modes, notes)
    else:
        pixels = reported.pixels_per_subaperture
        signals = describe_frames(frames, mirror.n_actuators, pixels, source, notes)
    turbulence = _make_own_modes(source, signals, mirror, reported)
    modes = usable_modes(signals, mirror, reported.columns, notes, column_numbers)
    apply_unit(reported.unit, signals, mirror, notes)
    sensor = _sensor(reported, signals, notes)
    pupil = _read_pupil(arrays, notes)
    obscuration = reported.obscuration_ratio
    if obscuration is None and not pupil:
        seen = signals.obscuration_ratio
        obscuration = round(seen, 3) if seen > MIN_OBSCURATION else 0.0
        if obscuration:
            notes.append(f"obscuration_ratio = {obscuration}: read from the hole in the mask")
    hole = {"obscuration_ratio": obscuration or 0.0}
    return Imported(
        source=source,
        tables={
            "instrument": {
                "name": "bench",
                "diameter_m": reported.diameter_m,
                **({"pupil": in_arrays_file("pupil")} if pupil else hole),
                "stop": reported.stop,
            },
            "wfs": sensor,
            "mirror": mirror.table,
            **turbulence,
            "slopes": {
                # Slopes that pyrcal computes from frames have its own order.
                **({} if frames else {"order": reported.order}),
                "orientation": "auto",
            },
        },
        arrays={**signals.arrays, **modes, **mirror.arrays, **pupil},
        centres_found=frames is not None,
        notes=(*notes, *(f"{key} is unknown" for key, v in sensor.items() if v == UNKNOWN)),
    )


def apply_unit(unit: str | None, signals: Signals, mirror: Mirror, notes: list[str]) -> None:
    """Make the response one per metre of OPD, or mark the strokes as unknown."""
    light = signals.arrays.get(FLUX_FRAME)
    # A mask suffices to compare shapes. The response is no light: slopes divided by it are wrong.
    is_mask = unit is None and light is not None and len(np.unique(light)) <= 2
    if not signals.has_mean_frame and not is_mask:
        signals.table["input"] = "normalised-frames"
        del signals.arrays[FLUX_FRAME]
        notes.append(
            "no mean frame (light=FILE): the frames are taken as divided by the sum of the "
            "whole detector"
        )
    if unit is None:
        mirror.table["stroke"] = UNKNOWN
        notes.append("the unit of the commands is unknown: only shapes are compared")
    else:
        # Not in place: the matrix may be that of the caller.
        signals.arrays["interaction_matrix"] = signals.arrays["interaction_matrix"] / UNITS_M[unit]


def _read_pupil(arrays: Mapping[str, Array], notes: list[str]) -> dict[str, Array]:
    """Return the map of the pupil for the file of arrays; empty if there is none."""
    if "pupil" not in arrays:
        return {}
    pupil = plane_of(arrays["pupil"])
    if pupil.ndim != 2 or pupil.shape[0] != pupil.shape[1]:
        raise MatrixError(f"pupil: found shape {pupil.shape}, expected a map (n, n)")
    notes.append(f"pupil: map of {len(pupil)} points, as wide as --diameter-m from edge to edge")
    return {"pupil": np.asarray(pupil, np.float32)}


def _make_own_modes(
    source: str, signals: Signals, mirror: Mirror, reported: Reported
) -> dict[str, dict[str, int]]:
    """Return ``[modes]`` if the columns are pyrcal's Karhunen-Loeve modes, else nothing.

    Raises
    ------
    MatrixError
        If there are fewer columns than actuators and nothing says what they are.
    """
    n_columns, columns = signals.n_columns, reported.columns
    if not mirror.is_zonal:
        if reported.basis is not None:
            raise MatrixError(
                f"{source}: --basis: found it with modes of the mirror, expected it only with "
                "positions of actuators"
            )
        return {}
    if reported.basis == "KL":
        n_modes = n_columns if columns is None else int(max(columns)) + 1
        mirror.become_modal(n_modes)
        return {"modes": {"n_modes": n_modes}}
    if reported.basis is None and columns is None and n_columns < mirror.n_actuators:
        raise MatrixError(
            f"{source}: matrix: found {n_columns} columns of {mirror.n_actuators} actuators, "
            "expected one for each; give mode_to_actuator=FILE for modes of your own, --basis KL "
            "for pyrcal's Karhunen-Loeve modes, or --basis zonal --modes LIST for some actuators"
        )
    return {}


def read_frames(source: str, arrays: Mapping[str, Array], kind: str) -> Frames | None:
    """Return the response as camera frames; None if it consists of slopes."""
    matrix = np.asarray(arrays["matrix"])
    light, valid = arrays.get("light"), arrays.get("valid")
    if matrix.ndim == 3:
        # Maps of slopes have three axes, too: what fits their layout is not taken as frames.
        with contextlib.suppress(MatrixError):
            maps_of(matrix, None if valid is None else min(np.shape(valid)), [])
            return None
    frames = frames_of(
        matrix,
        None if light is None else plane_of(light),
        None if valid is None else plane_of(valid),
    )
    if frames is not None and kind != "pyramid":
        raise MatrixError(
            f"{source}: matrix: found shape {matrix.shape}, camera frames; of a {kind} "
            "only slopes are read"
        )
    return frames


def read_slopes(
    source: str, arrays: Mapping[str, Array], n_modes: int, notes: list[str]
) -> Signals:
    """Return a matrix of slopes and its mask.

    Raises
    ------
    MatrixError
        If there is no mask and the matrix is no cube of maps, or a shape fits no layout.
    """
    given, found = arrays.get("valid"), np.asarray(arrays["matrix"])
    valid = None if given is None else mask_of(given, notes)
    if found.ndim > 2:
        maps = maps_of(found, None if valid is None else len(valid), notes)
        if valid is None:
            valid = find_lit(maps, notes)
        found = maps[:, valid].reshape(-1, maps.shape[-1])
    if valid is None:
        rows = found.shape[0] if found.ndim else 0
        side = round(rows**0.5)
        frames = (
            f"; {rows} = {side} x {side} values look like camera frames: give the mean frame "
            "(light=FILE) or the mask of lit pixels (valid=FILE)"
            if side**2 == rows
            else ""
        )
        raise MatrixError(
            f"{source}: found no valid; expected an array named {' or '.join(ROLES['valid'])}, or "
            f"a file of its own{frames}"
        )
    n_rows = 2 * int(valid.sum())
    n_columns = _count_columns(found, n_rows, n_modes)
    # NaN are allowed: a dead subaperture or a failed poke is left out below, with its number.
    matrix = matrix_of(found, n_rows, n_columns, notes=notes, broken_entries=True)
    matrix, valid = _remove_dead_rows(matrix, valid, notes)
    aperture = measure_aperture(valid)
    notes.append(f"valid: {int(valid.sum())} subapertures, {aperture.words}")
    width: dict[str, Any] = {}
    across = aperture.diameter_subap
    # Without a dark ring around it a mask may only lack a part of its rim.
    dark_ring = not (valid[[0, -1]].any() or valid[:, [0, -1]].any())
    narrower = len(valid) - across > MIN_WIDTH_DIFFERENCE_SUBAP or (
        len(valid) >= MIN_SHOWN_SUBAP and aperture.n_across < len(valid)
    )
    if dark_ring or (aperture.is_round and narrower):
        # A flux threshold changes the area rather than the number of rows.
        if abs(aperture.n_across - across) < MAX_ROWS_DIFFERENCE_SUBAP:
            across = aperture.n_across
        width = {"pupil_diameter_subap": round(across, 2)}
    return Signals(
        table={
            "n_subapertures": len(valid),
            "valid_subapertures": in_arrays_file("valid_subapertures"),
            **width,
        },
        arrays={"interaction_matrix": matrix, "valid_subapertures": valid.astype(np.uint8)},
        obscuration_ratio=aperture.obscuration_ratio,
        columns=1,
    )


def _remove_dead_rows(
    matrix: Array, valid: NDArray[np.bool_], notes: list[str]
) -> tuple[Array, NDArray[np.bool_]]:
    """Return matrix and mask without subapertures that are NaN or 0 for all modes."""
    planes = matrix.reshape(2, len(matrix) // 2, matrix.shape[1])
    dead = (~np.isfinite(planes) | (planes == 0.0)).all(axis=2).any(axis=0)
    # Where all are dead there is no response at all: the columns are refused with their numbers.
    if not dead.any() or dead.all():
        return matrix, valid
    places = np.argwhere(valid)[dead]
    listed = list_first((f"({row}, {column})" for row, column in places), 12)
    notes.append(
        f"valid: the subapertures at (row, column) {listed} give NaN or 0 in all columns: left out"
    )
    kept = valid.copy()
    kept[tuple(places.T)] = False
    return planes[:, ~dead].reshape(-1, matrix.shape[1]), kept


def _count_columns(matrix: Array, n_rows: int, n_modes: int) -> int:
    """Return the expected number of columns: all modes, or fewer if the matrix has fewer."""
    others = [n for n in matrix.shape if n != n_rows]
    return others[0] if len(others) == 1 and others[0] < n_modes else n_modes


def usable_modes(
    signals: Signals,
    mirror: Mirror,
    columns: Array | None,
    notes: list[str],
    numbers: Array | None = None,
) -> dict[str, Array]:
    """Remove unusable columns and modes; return the basis index of each remaining column.

    Parameters
    ----------
    signals, mirror
        Changed in place.
    columns
        ``(n_columns,)`` basis index of each column; None for the first ones.
    notes
        List to which notes on removed columns are appended.
    numbers
        Numbers of the columns in their file; None to count from 0.

    Raises
    ------
    ConfigurationError
        If ``columns`` are not of the matrix and the basis.
    MatrixError
        If no column is left.
    """
    n_columns, n_modes = signals.n_columns, mirror.n_modes
    if not n_columns:
        raise MatrixError("matrix: found no column, expected the response to each mode")
    indices = _indices(columns, n_columns, n_modes, notes)
    dead, shapes = find_defects(signals.by_column), mirror.defects
    notes += explain_defects(dead, "column", numbers)
    notes += explain_defects(shapes, "actuator" if mirror.is_zonal else "mode")
    unusable = set(shapes)
    # A mode that was not measured can be controlled all the same. A single actuator whose poke
    # failed is taken as broken, and left out of the mirror.
    if mirror.is_zonal and mirror.per_mode:
        unusable |= {int(indices[k]) for k in dead}
    kept = np.array([n for n in range(n_modes) if n not in unusable], dtype=np.intp)
    measured = np.array(
        [k for k in range(n_columns) if k not in dead and int(indices[k]) not in shapes],
        dtype=np.intp,
    )
    if not len(measured):
        raise MatrixError("matrix: found no column that can be used, expected some")
    if len(measured) < n_columns:
        signals.keep(measured)
    arrays: dict[str, Array] = {}
    if len(kept) < n_modes or numbers is not None:
        name = "kept_actuators" if mirror.is_zonal else "kept_modes"
        arrays[name] = kept if numbers is None else np.asarray(numbers)[kept]
        mirror.keep(kept)
    position = {int(n): k for k, n in enumerate(kept)}
    # Counted again, because unusable ones are removed from the basis as well.
    left = np.array([position[int(indices[k])] for k in measured])
    if not np.array_equal(left, np.arange(len(kept))):
        arrays["modes"] = left
    return arrays


def _indices(columns: Array | None, n_columns: int, n_modes: int, notes: list[str]) -> Array:
    """Return the basis index of each column."""
    if columns is None:
        if n_columns > n_modes:
            raise MatrixError(f"matrix: found {n_columns} columns, expected at most {n_modes}")
        if n_modes > n_columns:
            notes.append(
                f"the matrix is of the first {n_columns} of {n_modes} modes; --modes if of others"
            )
        return np.arange(n_columns)
    if len(columns) != n_columns:
        raise ConfigurationError(
            f"--modes: found {len(columns)} numbers, expected one for each of the {n_columns} "
            "columns of the matrix"
        )
    if max(columns) >= n_modes:
        raise ConfigurationError(
            f"--modes: found {max(columns)}, expected numbers below {n_modes}, the number of modes"
        )
    return columns


def _sensor(reported: Reported, signals: Signals, notes: list[str]) -> dict[str, Any]:
    """Return the keys of ``[wfs]``."""
    table: dict[str, Any] = {
        "kind": reported.kind,
        **signals.table,
        "wavelength_m": reported.wavelength_m or UNKNOWN,
    }
    if reported.kind == "pyramid":
        modulation = reported.modulation_lambda_over_d
        table["modulation_lambda_over_d"] = UNKNOWN if modulation is None else modulation
    elif reported.centroid is not None:
        table["centroid"] = reported.centroid
    # A stated diameter is not questioned.
    if reported.pupil_diameter_subap is not None:
        return {**table, "pupil_diameter_subap": reported.pupil_diameter_subap}
    if "pupil_diameter_subap" in table and table.get("input", "slopes") == "slopes":
        notes.append(
            f"pupil_diameter_subap = {table['pupil_diameter_subap']:g}: read from the mask, to "
            "half a subaperture; the magnification is relative to it: say --pupil-subap if known"
        )
    if table.get("input", "slopes") == "slopes":
        valid = signals.arrays["valid_subapertures"].astype(bool)
        x, y = measure_aperture(valid).centre
        if "pupil_diameter_subap" not in table and np.hypot(x, y) > OFF_CENTRE_SUBAP:
            notes.append(
                f"pupil_diameter_subap = {len(valid)}: the width of the grid, although the mask is "
                f"{x:+.2f}, {y:+.2f} off its middle: say --pupil-subap if the pupil is narrower"
            )
        notes += _check_width(signals.arrays["interaction_matrix"], valid)
    return table


def _check_width(matrix: Array, valid: NDArray[np.bool_]) -> list[str]:
    """Return a note if the mask seems wider than the pupil image."""
    power = np.einsum("ij,ij->i", matrix, matrix)
    seen = measure_pupil(compute_responses(power, np.ones(len(power)), valid), len(valid))
    if seen is None:
        return []
    return [
        f"{seen.words}, the mask has {len(valid)}: say --pupil-subap, unless the mirror does not "
        "reach these"
    ]
