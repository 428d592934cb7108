"""HDF5 files: opened on every file system, and written so that they are complete or absent."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import h5py

from service.errors import StorageError
from service.files.durable import flush

READ_ATTEMPTS: Final = 28
"""Readings of metadata of a growing file until its checksum is right. HDF5 makes 100 and waits
twice as long after each, 1 ns at first: centuries for a damaged file. 28 take 0.3 s."""


def open_hdf5(path: str | Path, mode: str = "r", **options: Any) -> h5py.File:  # noqa: ANN401 - h5py
    """Open an HDF5 file without locking it, as file systems without locks allow, NFS among them.

    No lock is needed: a file that pyrcal writes is created by one program alone, and is complete
    before it gets its name, or written so that it may be read meanwhile. All open it like this,
    for HDF5 refuses a file that one process opens with and without locks. ``options`` are those of
    ``h5py.File``.

    Raises
    ------
    FileExistsError
        If the mode is ``x`` and there is such a file.
    OSError
        If the file cannot be opened.
    """
    return h5py.File(path, mode, locking=False, **options)


def open_growing_hdf5(path: str | Path) -> h5py.File:
    """Open an HDF5 file that may still be written, in HDF5's single-writer mode, for reading.

    Raises
    ------
    OSError
        If the file cannot be opened. Reading from it, too, raises after ``READ_ATTEMPTS``.
    """
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_file_locking(False, False)  # as open_hdf5 does
    with contextlib.suppress(OSError, AttributeError):  # h5py does not offer this one
        limit = ctypes.CDLL(h5py.h5p.__file__).H5Pset_metadata_read_attempts
        limit.argtypes = [ctypes.c_int64, ctypes.c_uint]
        limit(access.id, READ_ATTEMPTS)
    flags = h5py.h5f.ACC_RDONLY | h5py.h5f.ACC_SWMR_READ
    return h5py.File(h5py.h5f.open(os.fsencode(path), flags, access))


def write_whole(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """Write a file that is complete or absent, and read-only.

    It is written under another name, flushed to the disk, then given its own name.

    Raises
    ------
    StorageError
        If the disk refuses.
    """
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with open_hdf5(part, "w") as file:
            fill(file)
        part.chmod(0o444)
        flush(part)
        part.rename(path)
        flush(path.parent)
    # h5py raises RuntimeError when a full disk refuses to close the file.
    except (OSError, RuntimeError) as error:
        part.unlink(missing_ok=True)
        raise StorageError(f"{path}: cannot be written: {error}") from error
