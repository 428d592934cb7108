"""Check whether a measured interaction matrix can be fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import MatrixError, list_first
from service.estimation.reference import Reference
from service.model.defects import find_defects
from service.model.misregistration import unit_like
from service.model.slopes import likely_kind

Array = NDArray[Any]

DEAD_COLUMN_RATIO = 1e-4
"""Norm of a column over the median below which it is not a measurement."""

DEAD_ROW_SHARE = 0.5
"""Share of columns with a value that is not finite above which a slope belongs to a dead
subaperture; below it the columns are at fault."""

LARGEST_VALUE = 1e60
"""Value above which an entry counts as not finite: its fourth power would overflow, and a file that
is not damaged holds slopes per metre of 1e7."""

PLAUSIBLE_UNIT_RATIO = 1e-4
"""Smallest plausible RMS slope per metre of OPD times the wavelength, and the reciprocal of the
largest; nanometres and micrometres give 1e-9 and 1e-6."""

MIN_COMPARED_COLUMNS = 9
"""Smallest number of columns at which equal rows count as copies: in a few low orders many rows are
equal."""

_UNIT_DECADES = 1.5
"""Powers of ten around a unit within which it is recognised."""


def check_reference(
    reference: Reference,
    *,
    n_slopes: int,
    n_modes: int,
    wavelength_m: float,
    stroke_known: bool = True,
) -> Reference:
    """Return the usable columns of a reference for an instrument, with notes on the others.

    Parameters
    ----------
    reference
        As it was read.
    n_slopes, n_modes
        Of the instrument.
    wavelength_m
        Of the sensor: it sets how large slopes per metre can be.
    stroke_known
        Whether the size of the columns means anything.

    Raises
    ------
    MatrixError
        If the shape is another instrument's or transposed, if nothing usable is left, or if the
        unit is not the metre.
    """
    _check_shape(reference, n_slopes, n_modes)
    # In double precision, because in single precision the limit itself would be infinite.
    damaged = np.abs(reference.matrix) > np.float64(LARGEST_VALUE)
    if damaged.any():
        reference = replace(
            reference,
            matrix=np.where(damaged, np.nan, reference.matrix),
            left_out=(
                *reference.left_out,
                f"{damaged.sum()} values above {LARGEST_VALUE:.0e} are taken as not finite",
            ),
        )
    # Before the columns: a dead subaperture would make each of them not finite.
    reference, silenced = _remove_dead_rows(reference)
    kept, left_out = _find_usable(reference)
    exact = replace(reference, matrix=np.asarray(reference.matrix, dtype=np.float64))
    usable = exact.column_subset(kept, *silenced, *left_out)
    if stroke_known:
        _check_unit(usable.matrix, wavelength_m)
    return usable


def _check_shape(reference: Reference, n_slopes: int, n_modes: int) -> None:
    matrix, columns = reference.matrix, reference.columns
    expected = f"({n_slopes} slopes, up to {n_modes} modes)"
    if matrix.ndim != 2:
        raise MatrixError(f"reference: found {matrix.ndim} axes; expected 2, {expected}")
    if matrix.shape[0] != n_slopes:
        # A reconstructor has the same shape as a transposed matrix.
        turned = matrix.shape[1] == n_slopes
        hint = ": it is transposed, or a reconstructor" if turned else ""
        expected += likely_kind(matrix.shape[0], n_slopes)
        raise MatrixError(f"reference: found shape {matrix.shape}{hint}; expected {expected}")
    if columns.shape != (matrix.shape[1],):
        raise MatrixError(
            f"reference: found {len(columns)} mode numbers for {matrix.shape[1]} columns"
        )
    if len(np.unique(columns)) != len(columns):
        raise MatrixError("reference: found a mode twice; expected every mode once")
    if columns.size and (columns.min() < 0 or columns.max() >= n_modes):
        raise MatrixError(
            f"reference: found modes {columns.min()} to {columns.max()}; the instrument's basis "
            f"has 0 to {n_modes - 1}"
        )
    if reference.noise is not None and reference.noise.shape != (matrix.shape[1],):
        raise MatrixError(
            f"reference: found noise of shape {reference.noise.shape}; expected "
            f"({matrix.shape[1]},), one number for each column"
        )


def _remove_dead_rows(reference: Reference) -> tuple[Reference, tuple[str, ...]]:
    """Return the reference with unusable slopes as 0, and sentences that name them.

    A dead subaperture gives NaN, or 0, in every column. Slopes of 0 do not count in a fit, so that
    it costs two rows and not all columns. Of equal rows only the first is a measurement.
    """
    unknown = ~np.isfinite(reference.matrix)
    # A column without any value would count against every slope.
    measured = ~unknown.all(axis=0)
    if not measured.any():
        return reference, ()
    dead = unknown[:, measured].mean(axis=1) > DEAD_ROW_SHARE
    rows = np.where(unknown, 0.0, reference.matrix)
    rows[dead] = 0.0
    kinds = find_defects(rows) if rows.shape[1] >= MIN_COMPARED_COLUMNS else {}
    copies = {row: first for row, first in kinds.items() if isinstance(first, int)}
    silent = ~rows.any(axis=1) & ~dead
    if not (dead.any() or copies or silent.any()):
        return reference, ()
    matrix = np.array(reference.matrix)
    matrix[np.ix_(dead, measured)] = 0.0
    reasons = []
    if dead.any():
        reasons.append(f"not finite: {_format_numbers(np.flatnonzero(dead), 'slope')}")
    if silent.any():
        reasons.append(f"zero in every column: {_format_numbers(np.flatnonzero(silent), 'slope')}")
    if copies:
        matrix[np.ix_(np.array(list(copies)), measured)] = 0.0
        reasons.append(f"copies: {_describe_copies(copies, np.arange(len(matrix)), 'slope')}")
    return replace(reference, matrix=matrix), tuple(reasons)


def _find_usable(reference: Reference) -> tuple[NDArray[np.bool_], tuple[str, ...]]:
    """Return the columns that are measurements, and a sentence for each kind that is not."""
    finite = np.isfinite(reference.matrix).all(axis=0)
    size = np.linalg.norm(np.where(finite, reference.matrix, 0.0), axis=0)
    typical = float(np.median(size[finite])) if finite.any() else 0.0
    alive = size > DEAD_COLUMN_RATIO * typical
    left_out = []
    if not finite.all():
        left_out.append(f"not finite: {_format_numbers(reference.columns[~finite])}")
    if not alive[finite].all():
        left_out.append(
            f"dead (no response): {_format_numbers(reference.columns[finite & ~alive])}"
        )
    kept = finite & alive
    places = np.flatnonzero(kept)
    # Only usable columns, so that none is listed as a copy of a column that is left out itself.
    equal = find_defects(np.ascontiguousarray(reference.matrix.T[kept])) if len(places) else {}
    copies = {
        int(places[column]): int(places[first])
        for column, first in equal.items()
        if isinstance(first, int)
    }
    if copies:
        kept[list(copies)] = False
        left_out.append(f"copies: {_describe_copies(copies, reference.columns)}")
    if not kept.any():
        raise MatrixError(
            f"reference: no usable column among {len(kept)} ({'; '.join(left_out) or 'empty'}); "
            "expected finite slopes that answer the mirror"
        )
    return kept, tuple(left_out)


def _describe_copies(
    copies: Mapping[int, int], numbers: NDArray[np.intp], what: str = "mode"
) -> str:
    """Return a text on entries that repeat an earlier one."""
    first = numbers[list(copies.values())]
    listed = _format_numbers(numbers[list(copies)], what)
    return f"{listed} (of {', '.join(str(number) for number in first[:8])})"


def _format_numbers(numbers: NDArray[np.intp], what: str = "mode") -> str:
    return f"{what}{'s' if len(numbers) > 1 else ''} {list_first(numbers, 8)}"


def _check_unit(matrix: Array, wavelength_m: float) -> None:
    """Raise if a matrix is per nanometre, micrometre, wave or radian.

    Tilting a wavefront by one wavelength RMS changes slopes by a few units, whatever the
    instrument.
    """
    typical = float(np.median(np.sqrt(np.mean(matrix**2, axis=0)))) * wavelength_m
    if PLAUSIBLE_UNIT_RATIO < typical < 1.0 / PLAUSIBLE_UNIT_RATIO:
        return
    unit = unit_like(1.0 / typical, _UNIT_DECADES).removesuffix("s")
    hint = f": it looks like slope per {unit}" if unit else ""
    # a wave and a radian lie between a nanometre and a micrometre: nothing but the size tells them
    phase = {
        "per wave of OPD (then divide it by the wavelength)": 1.0,
        "per radian of phase (then multiply it by 2 pi over the wavelength)": 2.0 * np.pi,
    }
    for words, per_wave in phase.items():
        if abs(np.log10(typical / wavelength_m * per_wave)) < _UNIT_DECADES:
            hint += f", or {words}" if hint else f": it looks like slope {words}"
    raise MatrixError(
        f"reference: found {typical / wavelength_m:.3g} as the typical slope per metre{hint}; "
        f"expected about {1.0 / wavelength_m:.1g}. Multiply the matrix, or say stroke = "
        '"unknown" in the instrument file'
    )
