"""Order of subapertures in SPECULA's files, and its ``Intmat`` and ``Recmat`` written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.errors import MatrixError, StorageError
from service.files.container import Container, opened

Array = NDArray[np.floating[Any]]

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


def read_subapertures(container: Container) -> Subapertures:
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
        n = _image_width(container, "nx")
        lenslet = np.asarray(listed).reshape(-1)
        return Subapertures(lenslet // n, lenslet % n)
    image = indices[:, 0] if indices.shape[1] == 4 else indices[0]
    image = image[image >= 0]
    n_columns, n_rows = (_image_width(container, key) for key in ("fsizey", "fsizex"))
    if len(image) and image.max() >= n_columns * n_rows:
        raise MatrixError(
            f"{first.where}: found pixel {image.max()}, expected less than the {n_columns} x "
            f"{n_rows} pixels of fsizey and fsizex"
        )
    return Subapertures(image // n_columns, image % n_columns)


def _image_width(container: Container, key: str) -> int:
    """Return a number of pixels that indices are counted with."""
    value = container.facts.get(key)
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float | np.number)
        or not 1 <= value <= MAX_WIDTH_PX
    ):
        raise MatrixError(
            f"{container.path}: found {key} = {value!r}, expected 1 to {MAX_WIDTH_PX} pixels; "
            "indices cannot be read without it"
        )
    return int(value)


NANOMETRE_M = 1e-9

MAX_WIDTH_PX = 100_000


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
    with opened(places) as container:
        if "fsizex" not in container.facts and "np_sub" not in container.facts:
            raise MatrixError(
                f"{places}: found {container.listing()}, expected PupData or SubapData"
            )
        listed = read_subapertures(container)
    n_slopes = 2 * len(listed.rows)
    if len(matrix) != n_slopes:
        raise MatrixError(
            f"{places}: found {len(listed.rows)} subapertures, expected the {len(matrix) // 2} of "
            "the matrix"
        )
    # The inverse of the order in which the import sorted the subapertures.
    by_listing = np.argsort(listed.by_rows)
    order = np.concatenate([by_listing, by_listing + n_slopes // 2])
    unit_m = NANOMETRE_M if stroke_known else 1.0
    # One is slope per command and the other command per slope, so the unit enters inversely.
    for path, name, values in (
        (intmat, "INTMAT", matrix[order] * unit_m),
        (recmat, "RECMAT", reconstructor[:, order] / unit_m),
    ):
        header = {"PUP_TAG": "", "SA_TAG": "", "NORMFACT": 0.0}
        try:
            write_fits(path, header, **{name: values})
        except OSError as error:
            raise StorageError(f"{path}: cannot be written: {error}") from error


def write_fits(path: Path, header: Mapping[str, Any], **arrays: NDArray[Any]) -> None:
    """Write arrays as extensions of a FITS file, as SPECULA saves its objects."""
    from astropy.io import fits

    images = []
    for name, values in arrays.items():
        dtype = np.int64 if values.dtype.kind in "iu" else np.float32
        images.append(fits.ImageHDU(np.ascontiguousarray(values, dtype), name=name))
    first = fits.PrimaryHDU(header=fits.Header({"VERSION": 1, **header}))
    fits.HDUList([first, *images]).writeto(path, overwrite=True)
