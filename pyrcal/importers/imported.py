"""Result of an importer, and the two files written from it: instrument file and arrays."""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.recorded import FLUX_FRAME
from service.errors import ConfigurationError, MatrixError, StorageError
from service.files.container import DATASET
from service.files.whole import write_whole
from service.instrument.reader import load_instrument
from service.model.instrument import Instrument
from service.model.pupil import rtc_valid_subapertures
from service.model.sensors.registry import kind_of

Array = NDArray[Any]
Tables = Mapping[str, Mapping[str, Any]]

INSTRUMENT_FILE, ARRAYS_FILE = "instrument.toml", "matrix.h5"

LARGEST_TELESCOPE_M = 100.0
"""Largest plausible diameter of a telescope, metres; a larger one is in another unit."""

UNKNOWN = "unknown"
"""Value in an instrument file for a number that is not known."""


def in_arrays_file(name: str) -> str:
    """Return the value of a key of the instrument file that refers to an array."""
    return f"{ARRAYS_FILE}:/{name}"


@dataclass(slots=True, kw_only=True, eq=False)
class Signals:
    """The sensor's part of an import."""

    table: dict[str, Any]
    """Keys of ``[wfs]`` except the optical parameters."""

    arrays: dict[str, Array]
    """The matrix, and the mask or the light."""

    obscuration_ratio: float = 0.0
    """Obscuration ratio measured on the mask or the light."""

    columns: int
    """Axis of the matrix that enumerates the modes."""

    has_mean_frame: bool = True
    """False if the matrix is of frames, and their light is only a mask or the response itself."""

    @property
    def n_columns(self) -> int:
        """Number of columns of the matrix."""
        return int(self.arrays[DATASET].shape[self.columns])

    @property
    def by_column(self) -> Array:
        """Matrix with the modes along the first axis."""
        return np.moveaxis(self.arrays[DATASET], self.columns, 0)

    def keep(self, columns: Array) -> None:
        """Remove all but these columns."""
        self.arrays[DATASET] = np.moveaxis(self.by_column[columns], 0, self.columns)


class Saved(NamedTuple):
    """Paths of a saved import."""

    instrument: Path
    matrix: Path
    """File with the interaction matrix and the other arrays of the instrument file."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Imported:
    """An instrument and its measured matrix in pyrcal's own representation."""

    source: str
    """Description of the origin."""

    tables: Tables
    """Tables of the instrument file, by name."""

    arrays: Mapping[str, Array]
    """Arrays by name; ``interaction_matrix`` is ``(n_slopes, n_modes)``, if there is one."""

    notes: tuple[str, ...] = ()
    """Notes on conversions, assumptions and unknown values, one sentence each."""

    centres_found: bool = False
    """True if ``wfs.pupil_centres_px`` was measured on the flux frame with circles through the
    edges of the pupil images."""

    inventory: tuple[str, ...] = ()
    """Files that were used, with their purpose; files that were ignored, with the reason."""

    def save(self, folder: str | Path) -> Saved:
        """Write both files into a folder, and read the instrument file once as a check.

        If anything fails, the folder is left unchanged.

        Raises
        ------
        ConfigurationError
            If the instrument file does not describe an instrument, or a telescope of 100 m.
        StorageError
            If writing fails.
        """
        diameter_m = float(self.tables["instrument"]["diameter_m"])
        if diameter_m > LARGEST_TELESCOPE_M:
            raise ConfigurationError(
                f"diameter_m: found {diameter_m:g}, expected metres, at most "
                f"{LARGEST_TELESCOPE_M:g}; give the pupil's diameter in metres"
            )
        place = Path(folder)
        saved = Saved(place / INSTRUMENT_FILE, place / ARRAYS_FILE)
        made: list[Path] = []
        try:
            made += (one for one in (place, *place.parents) if not one.exists())
            place.mkdir(parents=True, exist_ok=True)
            self._write(place)
        except BaseException as error:
            # Folders that were made here are removed again, the innermost first.
            for one in made:
                with contextlib.suppress(OSError):
                    one.rmdir()
            if isinstance(error, OSError):
                raise StorageError(f"{place}: cannot be written: {error}") from error
            raise
        return saved

    def _write(self, place: Path) -> None:
        """Write both files to a temporary folder, check them by reading, then move them."""
        for name in (INSTRUMENT_FILE, ARRAYS_FILE):
            if (place / name).is_dir():
                raise IsADirectoryError(f"{name}: found a folder, expected a file or none")
        with tempfile.TemporaryDirectory(dir=place, prefix=".import-") as name:
            draft = Saved(Path(name) / INSTRUMENT_FILE, Path(name) / ARRAYS_FILE)
            write_whole(draft.matrix, self._fill)
            draft.instrument.write_text(self.instrument_text(), encoding="utf-8")
            try:
                instrument = load_instrument(draft.instrument)
                self._check(instrument)
                if self.centres_found and FLUX_FRAME in self.arrays:
                    refined = self._with_refined_centres(instrument)
                    draft.instrument.write_text(refined.instrument_text(), encoding="utf-8")
            except ConfigurationError as error:
                # The message must not name the temporary folder, which is deleted by then.
                raise ConfigurationError(str(error).replace(name, str(place))) from error
            # The arrays first: an instrument file without the arrays it names would be refused.
            draft.matrix.replace(place / ARRAYS_FILE)
            draft.instrument.replace(place / INSTRUMENT_FILE)

    def _check(self, instrument: Instrument) -> None:
        """Raise if the matrix does not belong to the instrument."""
        matrix = self.arrays.get(DATASET)
        if matrix is None:
            return
        n_modes = len(self.arrays.get("modes", range(instrument.modes.n_modes)))
        if instrument.frames is not None:
            if matrix.ndim != 3 or len(matrix) != n_modes:
                raise MatrixError(
                    f"{DATASET}: found shape {matrix.shape}, expected (n_modes, ny, nx) of "
                    f"{n_modes} modes"
                )
            return
        n_slopes = instrument.slopes.order.kind.n_planes * rtc_valid_subapertures(instrument).sum()
        if matrix.shape != (n_slopes, n_modes):
            raise MatrixError(
                f"{DATASET}: found shape {matrix.shape}, expected (n_slopes, n_modes) = "
                f"({n_slopes}, {n_modes})"
            )

    def _with_refined_centres(self, instrument: Instrument) -> Imported:
        """Return it with the centres that a fit would use for ``pupil_centres_px = "auto"``."""
        centres = kind_of(instrument).image_centres(instrument, self.arrays[FLUX_FRAME])
        if centres is None:
            # The light is narrower than the file's pupil: the fitted circles are kept.
            return self
        wfs = {**self.tables["wfs"], "pupil_centres_px": np.round(centres, 3).tolist()}
        return replace(self, tables={**self.tables, "wfs": wfs})

    def with_notes(self, *notes: str) -> Imported:
        """Return the import with further notes."""
        return replace(self, notes=(*self.notes, *notes))

    def instrument_text(self) -> str:
        """Return the text of the instrument file, notes first."""
        lines = [f"# Imported from {self.source}.", *(f"# {note}" for note in self.notes)]
        for name, table in self.tables.items():
            lines += [
                "",
                f"[{name}]",
                *(f"{key} = {format_toml(value)}" for key, value in table.items()),
            ]
        return "\n".join(lines) + "\n"

    def _fill(self, file: h5py.File) -> None:
        file.attrs["source"] = self.source
        for name, values in self.arrays.items():
            file[name] = values


def format_toml(value: object) -> str:
    """Return a value in TOML notation."""
    if isinstance(value, Mapping):
        return (
            "{ " + ", ".join(f"{key} = {format_toml(each)}" for key, each in value.items()) + " }"
        )
    if isinstance(value, list | tuple):
        return "[" + ", ".join(format_toml(each) for each in value) + "]"
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False)
    return repr(float(value)) if isinstance(value, float | np.floating) else str(value)


def orient_matrix(
    values: Array,
    rows: int,
    columns: int | None,
    what: str,
    of: str,
    notes: list[str],
    *,
    broken_entries: bool = False,
) -> Array:
    """Return a matrix as ``(rows, columns)``.

    Parameters
    ----------
    values
        Matrix as found.
    rows, columns
        Required shape; ``columns`` None for any number.
    what
        Name of the matrix, for messages.
    of
        Description of the shape, like ``(n_slopes, n_modes)``.
    notes
        List to which a note is appended if it was transposed, or could have been.
    broken_entries
        True if numbers that are not finite are allowed.

    Raises
    ------
    MatrixError
        If it has neither shape, or contains a number that is not finite.
    """
    found = np.asarray(values)
    if found.ndim != 2 or found.dtype.kind not in "iuf":
        raise MatrixError(
            f"{what}: found shape {found.shape} of {found.dtype}, expected finite numbers {of}"
        )
    broken = np.argwhere(~np.isfinite(found))
    if len(broken) and not broken_entries:
        row, column = broken[0]
        raise MatrixError(
            f"{what}: found {found[row, column]} in row {row}, column {column}, expected finite "
            f"numbers {of}"
        )
    n_rows, n_columns = found.shape
    if n_rows == rows and columns in {None, n_columns}:
        # Nothing in a square matrix shows which of its axes is which.
        if n_rows == n_columns:
            notes.append(f"{what} is square, {n_rows} by {n_rows}: taken as {of}")
        return found
    if n_columns == rows and columns in {None, n_rows}:
        notes.append(f"{what} was listed the other way round: turned to {of}")
        return found.T
    wanted = f"({rows}, {'any' if columns is None else columns})"
    raise MatrixError(f"{what}: found shape {found.shape}, expected {of} = {wanted}")


matrix_of = partial(orient_matrix, what=DATASET, of="(n_slopes, n_modes)")
"""Return the interaction matrix with given numbers of slopes and modes."""
