"""Measured matrices and telemetry in files.

The fit is in ``pyrcal.fitting``; this module decides nothing about it. It checks a request, in the
words of the command line and of REST, and the type of a file, before anything large is imported, so
that a mistake is reported at once.
"""

from __future__ import annotations

import math
import re
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from service.errors import MatrixError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from service.model.misregistration import Misregistration


_HDF5_BEGINS = b"\x89HDF\r\n\x1a\n"

_FITS_BEGINS = (b"SIMPLE  =", b"\x1f\x8b")
"""First bytes of a FITS file, and of anything compressed with gzip, which FITS files often are."""

NUMPY_BEGINS = b"\x93NUMPY"

_OTHERS = {
    b"PK\x03\x04": (
        "a zip archive, as np.savez writes",
        "save the matrix alone with np.save, or read it with pyrcal import files",
    ),
    b"\x80": ("objects that Python pickled", "save the matrix alone with np.save"),
}
"""First bytes of what else comes, what it is, and what to do with it."""

_SHOWN_BYTES = 16
"""First bytes of an unknown file that the refusal repeats."""


class FileKind(StrEnum):
    """Files a measured matrix may be in."""

    HDF5 = "HDF5"
    FITS = "FITS"
    NUMPY = "NumPy"
    MATLAB = "MATLAB"
    """Version 5 to 7, or the HDF5 of version 7.3, with its axes reversed."""


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
            begins, offset = file.read(_SHOWN_BYTES), 512
            there = begins[:8]
            while there and there != _HDF5_BEGINS:
                file.seek(offset)
                there, offset = file.read(8), 2 * offset
    except OSError as error:
        raise MatrixError(f"{path}: cannot be read: {error.strerror or error}") from error
    if begins.startswith(b"MATLAB "):
        return FileKind.MATLAB
    if there:
        return FileKind.HDF5
    if begins.startswith(_FITS_BEGINS):
        return FileKind.FITS
    if begins.startswith(NUMPY_BEGINS):
        return FileKind.NUMPY
    kind, advice = _other_kind(begins)
    raise MatrixError(f"{path}: found {kind}, expected HDF5, FITS, NumPy or MATLAB; {advice}")


def _other_kind(begins: bytes) -> tuple[str, str]:
    """Return what a file is that is none of these, and what to do with it."""
    if not begins:
        return "an empty file", "write it again"
    for first, known in _OTHERS.items():
        if begins.startswith(first):
            return known
    if not any(byte < 0x20 and byte not in b"\t\n\r" for byte in begins):
        shown = begins.decode("ascii", "replace")
        return f"text that begins {shown!r}", "np.save(path, np.loadtxt(file)) makes one of a table"
    return f"a file that begins with the bytes {begins[:8].hex(' ')}", "np.save or h5py writes one"


# --- what is asked of a fit


MAX_MODES = 100_000
"""Number that the modes of a request must be below."""

_PART = re.compile(r"(\d+)(?::(\d+)(?::(\d+))?)?")


def parse_modes(text: str) -> NDArray[np.intp]:
    """Return the basis indices that ``0:400``, ``0:400:2``, ``3,5,9`` or a list of these mean.

    A range ends before its second number, as in Python.

    Raises
    ------
    ValueError
        If the text means something else, nothing, or a mode twice.
    """
    expected = "expected first:end, first:end:step, or numbers with commas, like 0:400 or 3,5,9"
    indices: list[int] = []
    for part in text.replace(" ", "").split(","):
        match = _PART.fullmatch(part)
        if match is None:
            raise ValueError(f"found {text!r}, {expected}")
        first, end, step = match.groups()
        last = int(end) if end is not None else int(first) + 1
        # Before the range is made: a request must not fill the memory.
        if last > MAX_MODES or step == "0":
            raise ValueError(f"found {text!r}, expected modes below {MAX_MODES} and a step above 0")
        indices.extend(range(int(first), last, int(step or 1)))
    if not indices:
        raise ValueError(f"found {text!r}, which is no mode at all; {expected}")
    if len(set(indices)) < len(indices):
        raise ValueError(f"found {text!r}, expected no mode twice")
    # Imported late, so that a mistake in the command line is reported at once.
    import numpy as np

    return np.array(indices, dtype=np.intp)


def parse_alpha(text: str) -> Misregistration:
    """Return the registration ``X,Y,ROT,MAG``: subapertures, degrees, ratio.

    Two numbers more are its anamorphosis, along x and along 45 deg.

    Raises
    ------
    ValueError
        If it is not four or six finite numbers, or the magnification is not positive.
    """
    values = numbers_in(text)
    if len(values) not in {4, 6} or values[3] <= 0.0:
        expected = "expected X,Y,ROT,MAG: subapertures, degrees, ratio, like 0.3,-0.1,65,0.98"
        raise ValueError(f"found {text.strip()!r}, {expected}")
    import numpy as np

    from service.model.misregistration import PARAMETERS, Misregistration

    alpha = Misregistration.from_boundary(dict(zip(PARAMETERS, values[:4], strict=True)))
    return alpha if len(values) == 4 else alpha.with_anamorphosis(np.array(values[4:]))


def numbers_in(text: str) -> list[float]:
    """Return the finite numbers that a text lists; none where something else is among them."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        return []
    return values if all(math.isfinite(value) for value in values) else []
