"""HDF5 files that are complete or absent."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py

from service.errors import StorageError
from service.files.durable import flush


def write_whole(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """Write a file that is complete or absent, and read-only.

    It is written under another name, flushed to the disk, then given its own name.

    Raises
    ------
    StorageError
        If the disk refuses.
    """
    part = path.with_name(path.name + ".part")
    try:
        with h5py.File(part, "w") as file:
            fill(file)
        part.chmod(0o444)
        flush(part)
        part.rename(path)
        flush(path.parent)
    except (OSError, RuntimeError) as error:
        part.unlink(missing_ok=True)
        raise StorageError(f"{path}: cannot be written: {error}") from error
