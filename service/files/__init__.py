"""Measured matrices in files, and what was found in them as JSON, text and figures.

The fit itself is ``service.fit``; nothing here decides anything about it. This module says what a
file cannot be before anything large is imported.
"""

from enum import StrEnum
from pathlib import Path

from service.errors import MatrixError

_HDF5_BEGINS = b"\x89HDF\r\n\x1a\n"

_FITS_BEGINS = (b"SIMPLE  =", b"\x1f\x8b")
"""First bytes of a FITS file, and of anything compressed with gzip, which FITS files often are."""

NUMPY_BEGINS = b"\x93NUMPY"

_OTHERS = {b"MATLAB 5": "a MATLAB file older than 7.3"}


class FileKind(StrEnum):
    """Files a measured matrix may be in."""

    HDF5 = "HDF5"
    FITS = "FITS"
    NUMPY = "NumPy"


def kind_of(path: Path) -> FileKind:
    """Return what kind a file is, by its content and not by its name.

    HDF5 may begin with a block of its user's, of 512 bytes or a power of two more.

    Raises
    ------
    MatrixError
        If it cannot be read, or is none of them.
    """
    try:
        with path.open("rb") as file:
            begins, offset = file.read(9), 512
            there = begins[:8]
            while there and there != _HDF5_BEGINS:
                file.seek(offset)
                there, offset = file.read(8), 2 * offset
    except OSError as error:
        raise MatrixError(f"{path}: cannot be read: {error.strerror or error}") from error
    if there:
        return FileKind.HDF5
    if begins.startswith(_FITS_BEGINS):
        return FileKind.FITS
    if begins.startswith(NUMPY_BEGINS):
        return FileKind.NUMPY
    kind = "something else" if begins else "an empty file"
    kind = next((words for first, words in _OTHERS.items() if begins.startswith(first)), kind)
    raise MatrixError(f"{path}: found {kind}, expected an HDF5, a FITS or a NumPy file")
