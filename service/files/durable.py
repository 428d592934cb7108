"""Files that a power cut leaves whole: the one before, or the new one."""

from __future__ import annotations

import os
from pathlib import Path


def replace_file(path: Path, text: bytes, mode: int = 0o666) -> None:
    """Replace a file; the new one is on the disk when this returns, its name included.

    It is written beside, as ``.part``, with these rights (less the process's mask).

    Raises
    ------
    OSError
        If the disk refuses; the file before stays, and nothing lies beside it.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.unlink(missing_ok=True)  # with whatever rights somebody left it
        with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        flush(path.parent)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def flush(path: Path) -> None:
    """Return when a file, or a folder's names, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
