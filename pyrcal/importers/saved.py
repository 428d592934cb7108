"""Arrays that were saved: NumPy's ``.npz``, whole and without anything to be unpickled."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

from pyrcal.importers.imported import Array
from service.errors import MatrixError
from service.files.container import MAX_BYTES, NUMPY_DAMAGE


def read_npz(path: Path, *, max_bytes: int | None = MAX_BYTES) -> dict[str, Array]:
    """Return the arrays of an ``.npz`` by name.

    Raises
    ------
    MatrixError
        If it is another kind of file, is damaged, contains Python objects, or unpacks to more than
        ``max_bytes`` (None for no limit).
    """
    try:
        with zipfile.ZipFile(path) as packed:
            # Sizes are in the archive's directory, so nothing is unpacked to learn them.
            n_bytes = sum(member.file_size for member in packed.infolist())
        if max_bytes is not None and n_bytes > max_bytes:
            raise MatrixError(
                f"{path}: found {n_bytes / 1e9:.1f} GB unpacked, expected at most "
                f"{max_bytes / 1e9:.2g} GB"
            )
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except OSError as error:
        raise MatrixError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (*NUMPY_DAMAGE, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise MatrixError(
            f"{path}: found {error}, expected arrays that np.savez wrote, and no Python objects"
        ) from error
