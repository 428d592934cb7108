"""Measured influence functions that end, or are cropped: each a patch of the whole table."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError
from service.files.container import MAX_BYTES
from service.files.toml import refuse
from service.instrument.schema import MirrorTable, Section
from service.model.instrument import LocalFunctions
from service.model.surface import NEGLIGIBLE_HEIGHT

_MIN_CROPPED_FUNCTIONS = 1000
"""Influence functions from which on cropping them saves time: with 663 it took twice as long."""

_MAX_MEAN_COVERAGE = 0.1
"""Mean share of the pupil that a function may cover for cropping to save time."""

_CUT = 0.01
"""Share of the height that a function may have at the rim of its crop."""


def local_functions(
    file: Section[MirrorTable],
    heights: NDArray[np.floating],
    strokes: NDArray[np.floating] | None,
    known: NDArray[np.bool_] | None = None,
) -> tuple[LocalFunctions, NDArray[np.bool_]] | None:
    """Return functions that end, and where the table is known; None: they cover it all, or are few.

    ``heights`` are crops ``(n_actuators, p, q)`` or, with ``known`` ``(ny, nx)``, whole tables.

    Raises
    ------
    ConfigurationError
        As :func:`modes_of_crops`, but for the size.
    """
    if len(heights) < _MIN_CROPPED_FUNCTIONS:
        return None
    if known is None:
        shape = _table_of(file, heights)
        known, parts = np.zeros(shape, np.bool_), []
        for at, part in _place_crops(heights, _origins(file, heights, shape), shape):
            known[at] = True
            parts.append((at, part))
    else:
        whole = (slice(0, known.shape[0]), slice(0, known.shape[1]))
        parts = [(whole, np.where(known, one, one.dtype.type(0))) for one in heights]
    found, places = [], []
    for (rows, columns), part in parts:
        row, column = np.nonzero(np.abs(part) > NEGLIGIBLE_HEIGHT * np.abs(part).max())
        found.append(part[row, column])
        places.append((row + rows.start) * known.shape[1] + column + columns.start)
    ends = np.concatenate([[0], np.cumsum([len(one) for one in places])]).astype(np.intp)
    # Functions that cover much of the pupil are cheaper as whole tables.
    if ends[-1] > _MAX_MEAN_COVERAGE * len(heights) * known.sum():
        return None
    local = LocalFunctions(
        heights=np.concatenate(found),
        places=np.concatenate(places),
        ends=ends,
        strokes=None if strokes is None else strokes.astype(np.float64),
        floor=NEGLIGIBLE_HEIGHT,
    )
    return local, known


def modes_of_crops(
    file: Section[MirrorTable],
    crops: NDArray[np.floating],
    strokes: NDArray[np.floating] | None,
) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Return modes ``(n_modes, ny, nx)`` of crops ``(n_actuators, p, q)``, and where one is given.

    ``strokes`` are ``(n_actuators, n_modes)``; None: each function is a mode.

    Raises
    ------
    ConfigurationError
        One line: the table or a place in it is missing or wrong, or the modes are too large.
    """
    shape = _table_of(file, crops)
    n_modes = len(crops) if strokes is None else strokes.shape[1]
    # Refused before the memory is taken.
    n_bytes = n_modes * shape[0] * shape[1] * crops.dtype.itemsize
    if n_bytes > MAX_BYTES:
        file.refuse(
            "influence_table",
            f"{n_modes} modes over {shape[0]} x {shape[1]} points, {n_bytes / 1e9:.1f} GB",
            f"at most {MAX_BYTES / 1e9:.2g} GB: a coarser table, or fewer modes",
        )
    modes, known = np.zeros((n_modes, *shape), crops.dtype), np.zeros(shape, np.bool_)
    for k, (at, part) in enumerate(_place_crops(crops, _origins(file, crops, shape), shape)):
        known[at] = True
        if strokes is None:
            modes[k][at] = part
        else:
            # Crop by crop: whole tables of all functions would take far more memory.
            modes[:, *at] += np.multiply.outer(strokes[k].astype(crops.dtype), part)
    return modes, known


def _table_of(file: Section[MirrorTable], crops: NDArray[np.floating]) -> tuple[int, int]:
    """Return the shape of the table that finite crops are part of."""
    shape = file.table.influence_table
    if shape is None:
        raise ConfigurationError(
            f"{file.where('influence_table')}: missing; mirror.influence_origin requires it"
        )
    if not np.isfinite(crops).all():
        file.refuse("influence_functions", "a height that is not finite", "numbers alone")
    return shape


def remarks_on_crops(file: Section[MirrorTable], crops: NDArray[np.floating]) -> tuple[str, ...]:
    """Return a note where functions are cut before they have come down to nothing."""
    if file.table.influence_origin is None:
        return ()
    rim = np.abs(crops)
    # Never zero, so that crops of nothing but zeros do not divide by it.
    highest = max(float(rim.max()), float(np.finfo(rim.dtype).tiny))
    rim[:, 1:-1, 1:-1] = 0
    left = float(rim.max()) / highest
    if left <= _CUT:
        return ()
    return (
        f"{file.where('influence_functions')}: cut where a function still has {left:.0%} of its "
        "height: the surface has steps there; crop less",
    )


def _origins(
    file: Section[MirrorTable], crops: NDArray[np.floating], shape: tuple[int, int]
) -> NDArray[np.intp]:
    """Return the row and column at which each crop begins, ``(n_actuators, 2)``."""
    where, origins = file.where("influence_origin"), file.array("influence_origin")
    if origins.shape != (len(crops), 2):
        refuse(where, f"shape {origins.shape}", f"({len(crops)}, 2): row and column for each")
    # Between two points of the table a crop would have to be interpolated.
    if not np.array_equal(origins, np.rint(origins)):
        refuse(where, "rows or columns that are no whole numbers", "points of the table")
    outside = np.any((origins >= shape) | (origins + crops.shape[1:] <= 0), axis=1)
    if outside.any():
        row, column = origins[outside][0]
        refuse(
            where,
            f"function {int(np.argmax(outside))} at row {row:g}, column {column:g}",
            f"all of them on the table of {shape[0]} x {shape[1]} points",
        )
    return origins.astype(np.intp)


def _place_crops(
    crops: NDArray[np.floating], origins: NDArray[np.intp], shape: tuple[int, int]
) -> Iterator[tuple[tuple[slice, slice], NDArray[np.floating]]]:
    """Yield the position of each crop on the table, and the part of it that is inside."""
    for crop, (row, column) in zip(crops, origins.tolist(), strict=True):
        rows = slice(max(row, 0), min(row + crop.shape[0], shape[0]))
        columns = slice(max(column, 0), min(column + crop.shape[1], shape[1]))
        seen = (
            slice(rows.start - row, rows.stop - row),
            slice(columns.start - column, columns.stop - column),
        )
        yield (rows, columns), crop[seen]
