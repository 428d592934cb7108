"""Import SPECULA's FITS files, which SynIM also writes, and export to them.

Files are recognised by their contents. Neither program is imported. The layouts were read from
SPECULA 1.1.0 and SynIM 2.0.0:

- ``Intmat`` is ``[slopes, modes]``, in older files ``[modes, slopes]``; the number of subapertures
  distinguishes them. Slopes are all x, then all y, unless the file has ``INTRLVD``.
- Subapertures are in the order of ``PupData.ind_pup`` or ``SubapData.idxs``, which may differ from
  that of the mask's rows.
- Commands are nanometres, and ``sign = -1`` of its mirrors is one sign of all slopes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pyrcal.importers.files import Reported, from_arrays
from pyrcal.importers.imported import Array, Imported, orient_matrix
from service.errors import MatrixError, StorageError
from service.files.container import Container, opened

UNIT = "nm"
"""Unit of SPECULA's commands."""

LENSLETS = (
    "slopes of lenslets are shares of half their field, which these files do not give: the strokes "
    "are taken as unknown"
)


MAX_WIDTH = 4096
"""Largest width of a sensor, subapertures; indices with a larger range are damaged."""


class Subapertures(NamedTuple):
    """Positions of the subapertures in their listed order."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """``(n, n)`` mask on the smallest square that holds them, centred."""
        n = int(max(np.ptp(self.rows), np.ptp(self.columns))) + 1 if len(self.rows) else 0
        if not 0 < n <= MAX_WIDTH:
            raise MatrixError(
                f"indices: found {len(self.rows)} subapertures {n} across, expected at most "
                f"{MAX_WIDTH} across"
            )
        mask = np.zeros((n, n), dtype=bool)
        row, column = ((n - 1 - np.ptp(each)) // 2 for each in (self.rows, self.columns))
        mask[self.rows - self.rows.min() + row, self.columns - self.columns.min() + column] = True
        return mask

    @property
    def by_rows(self) -> NDArray[np.intp]:
        """Order that sorts the subapertures row by row."""
        return np.lexsort((self.columns, self.rows))


def from_specula(paths: Sequence[Path], reported: Reported, source: str = "SPECULA") -> Imported:
    """Import an ``Intmat``, its ``PupData`` or ``SubapData``, and an ``IFunc``.

    With an ``M2C`` among the files, modes are combined from the influence functions.

    Raises
    ------
    MatrixError
        If one of them is missing or present twice, or a file is something else.
    """
    found: dict[str, Array] = {}
    places: Subapertures | None = None
    kind = reported.kind
    interleaved, notes = False, list[str]()
    for path in paths:
        with opened(path) as container:
            if "fsizex" in container.facts or "np_sub" in container.facts:
                places = _subapertures(container)
                kind = "shack-hartmann" if "np_sub" in container.facts else "pyramid"
                continue
            role, values, turned = _role_of(container)
            if role in found:
                raise MatrixError(f"{path}: found a second {role}, expected one")
            found[role] = values
            notes += turned
            interleaved |= bool(container.facts.get("intrlvd", False))
    if places is None or "matrix" not in found:
        missing = "PupData or SubapData" if places is None else "Intmat"
        raise MatrixError(f"{source}: found no {missing}, expected one among the files")
    matrix, turned = orient_matrix(
        found["matrix"], 2 * len(places.rows), None, "Intmat", "(n_slopes, n_modes)"
    )
    notes += turned
    components = matrix.reshape(-1, 2, matrix.shape[1]) if interleaved else None
    both = (
        np.moveaxis(components, 1, 0) if components is not None else np.stack(np.split(matrix, 2))
    )
    found["matrix"] = both[:, places.by_rows].reshape(matrix.shape)
    found["valid"] = places.mask
    if reported.sensor not in {None, kind}:
        raise MatrixError(
            f"{source}: found the subapertures of a {kind}, expected those of a {reported.sensor}, "
            "as --sensor says"
        )
    # SPECULA's pyramid counts x along the rows of its mask
    order = "yx" if kind == "pyramid" else "xy"
    if kind != "pyramid" and reported.unit is not None:
        notes.append(LENSLETS)
        reported = replace(reported, unit=None)
    imported = from_arrays(source, found, replace(reported, order=order, sensor=kind))
    if not np.array_equal(places.by_rows, np.arange(len(places.rows))):
        notes.append("subapertures were not listed row by row: sorted")
    return imported.with_notes(*notes)


def _role_of(container: Container) -> tuple[str, Array, tuple[str, ...]]:
    """Return the role of a file's array, its numbers, and notes."""
    matrix, functions = container.find("INTMAT"), container.find("INFLUENCE_FUNCTION")
    if matrix is not None:
        return "matrix", matrix.numbers(), ()
    if functions is not None:
        return "modes", *_cube(container, functions.numbers())
    arrays = [stored for stored in container.arrays.values() if len(stored.shape) == 2]
    if len(arrays) != 1:
        raise MatrixError(
            f"{container.path}: found {container.listing()}, expected SPECULA's Intmat, PupData, "
            "SubapData, IFunc or M2C"
        )
    return "mode_to_actuator", arrays[0].numbers(), ()


def _cube(container: Container, functions: Array) -> tuple[Array, tuple[str, ...]]:
    """Return an ``IFunc`` as maps with NaN outside its mask: it holds only the points inside."""
    stored = container.find("MASK_INF_FUNC")
    if stored is None:
        raise MatrixError(
            f"{container.path}: found INFLUENCE_FUNCTION without MASK_INF_FUNC, expected both"
        )
    inside = stored.numbers() > 0.0
    values, turned = orient_matrix(
        functions, int(inside.sum()), None, "INFLUENCE_FUNCTION", "(n_points, n_functions)"
    )
    cube = np.full((values.shape[1], *inside.shape), np.nan, dtype=np.float32)
    cube[:, inside] = values.T
    return cube, turned


def _subapertures(container: Container) -> Subapertures:
    """Return the positions of a ``PupData``'s first image or of a ``SubapData``'s lenslets."""
    first = container.find("1")
    if first is None:
        raise MatrixError(f"{container.path}: found no indices of pixels, expected them first")
    if len(first.shape) != 2:
        raise MatrixError(f"{first.where}: found shape {first.shape}, expected two axes of indices")
    with np.errstate(invalid="ignore"):
        indices = first.numbers().astype(np.intp)
    if "np_sub" in container.facts:  # stored as (pixels, subapertures); its map says which lenslet
        shown = container.find("2")
        listed = indices.T if shown is None else shown.numbers().astype(np.intp)
        n = int(container.facts["nx"])
        lenslet = np.asarray(listed).reshape(-1)
        return Subapertures(lenslet // n, lenslet % n)
    image = indices[:, 0] if indices.shape[1] == 4 else indices[0]
    image = image[image >= 0]
    n_columns = int(container.facts["fsizey"])
    return Subapertures(image // n_columns, image % n_columns)


NANOMETRE_M = 1e-9


def write_specula(
    places: Path,
    intmat: Path,
    recmat: Path,
    matrix: Array,
    reconstructor: Array,
    *,
    stroke_known: bool,
) -> None:
    """Write a matrix and its reconstructor as SPECULA's ``Intmat`` and ``Recmat``.

    Subapertures are in the order of ``places``, all x first, commands are nanometres. ``Intmat`` is
    ``[slopes, modes]`` and ``Recmat`` ``[modes, slopes]``, as SPECULA 1.1.0 has them.

    Parameters
    ----------
    places
        ``PupData`` or ``SubapData`` with which the matrix was imported.
    intmat, recmat
        Files to write; existing ones are replaced.
    matrix
        ``(n_slopes, n_modes)`` matrix, slopes in the order of `from_specula`.
    reconstructor
        ``(n_modes, n_slopes)`` reconstructor.
    stroke_known
        True if commands are metres, False if they are in SPECULA's own unit.

    Raises
    ------
    MatrixError
        If the subapertures differ.
    StorageError
        If writing fails.
    """
    from astropy.io import fits

    with opened(places) as container:
        if "fsizex" not in container.facts and "np_sub" not in container.facts:
            raise MatrixError(
                f"{places}: found {container.listing()}, expected PupData or SubapData"
            )
        listed = _subapertures(container)
    n_slopes = 2 * len(listed.rows)
    if len(matrix) != n_slopes:
        raise MatrixError(
            f"{places}: found {len(listed.rows)} subapertures, expected the {len(matrix) // 2} of "
            "the matrix"
        )
    by_listing = np.argsort(listed.by_rows)
    order = np.concatenate([by_listing, by_listing + n_slopes // 2])
    unit_m = NANOMETRE_M if stroke_known else 1.0
    for path, name, values in (
        (intmat, "INTMAT", matrix[order] * unit_m),
        (recmat, "RECMAT", reconstructor[:, order] / unit_m),
    ):
        header = fits.Header({"VERSION": 1, "PUP_TAG": "", "SA_TAG": "", "NORMFACT": 0.0})
        arrays = fits.ImageHDU(np.ascontiguousarray(values, dtype=np.float32), name=name)
        try:
            fits.HDUList([fits.PrimaryHDU(header=header), arrays]).writeto(path, overwrite=True)
        except OSError as error:
            raise StorageError(f"{path}: cannot be written: {error}") from error
