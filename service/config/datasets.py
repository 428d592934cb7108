"""Arrays that an instrument file refers to, relative to the file itself.

``file.h5:/dataset``, ``file.fits:EXTNAME``, ``file.fits:2`` or ``file.fits`` (its first image).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from service.config.strict import refuse
from service.errors import ConfigurationError, MatrixError
from service.files.container import Container, StoredArray, opened

_HDF5 = re.compile(r"(?P<path>.+):/(?P<name>.+)")
_FITS = re.compile(r"(?P<path>.+?\.(?:fits|fit|fts)(?:\.gz)?)(?::/?(?P<name>.+))?", re.IGNORECASE)


def read_dataset(reference: str, folder: Path, where: str) -> NDArray[Any]:
    """Return the numeric array behind ``reference``, in this machine's byte order.

    Parameters
    ----------
    reference
        ``path:/dataset``, ``path.fits:EXTNAME``; a relative path starts at ``folder``.
    folder
        Where the instrument file lies.
    where
        The file and key that hold the reference, for the messages.

    Raises
    ------
    ConfigurationError
        If the reference has another form, or the file or dataset is missing, damaged or not
        numeric.
    """
    parts = _FITS.fullmatch(reference) or _HDF5.fullmatch(reference)
    if parts is None:
        refuse(where, repr(reference), "path:/dataset of an HDF5 file, or path.fits:EXTNAME")
    try:
        with opened(folder / parts["path"]) as container:
            stored = _named(container, parts["name"], where)
            if stored.dtype.kind not in "biuf":
                refuse(where, f"type {stored.dtype} in {stored.where}", "numbers")
            values = stored.read()
    except MatrixError as error:
        raise ConfigurationError(f"{where}: {error}") from error
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _named(container: Container, name: str | None, where: str) -> StoredArray:
    found = container.find(name) if name else next(iter(container.arrays.values()), None)
    if found is None:
        missing = f"no dataset /{name.strip('/')}" if name else "no image"
        refuse(where, f"{missing} in {container.path}", f"one; it holds {container.listing()}")
    return found
