"""Files that a power cut leaves whole: the one before, or the new one; and locks on files."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path
from typing import IO, Final

from service.errors import StorageError

NO_LOCKS: Final = frozenset({errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP})
"""Error numbers of a file system without locks, as NFS without a lock service is."""


def lock_file(file: IO[str] | int, path: Path, *, wait: bool = False, shared: bool = False) -> None:
    """Lock an open file for as long as it is open.

    Raises
    ------
    BlockingIOError
        If another program has locked it, and ``wait`` is false.
    StorageError
        If its file system has no locks; the text names ``path`` and the remedy.
    """
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(file, kind if wait else kind | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        raise StorageError(
            f"{path}: its file system has no file locks ({error.strerror}), without which two "
            "programs could spoil each other's files. Put data_dir on a local disk, or mount it "
            "with locks (NFS: a lock service, or the mount option local_lock=all)"
        ) from error


def replace_file(path: Path, text: bytes, mode: int = 0o666) -> None:
    """Replace a file; when this returns the new one is on the disk, including its name.

    It is first written to a ``.part`` file, with this mode (less the process's umask).

    Raises
    ------
    OSError
        If the disk refuses; the previous file is kept, and no ``.part`` file is left.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.unlink(missing_ok=True)  # with whatever rights somebody left it
        with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        # A new name is on the disk only when its folder is.
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
