"""Find the services that run on this machine, and their folders.

A service leaves a note for as long as it runs, locked: what is locked by nobody is of one that has
ended, however it did.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import structlog

from service.errors import ConfigurationError


class RunningService(NamedTuple):
    """A running service, by its note."""

    data_dir: Path
    url: str


def notes_folder() -> Path:
    """Return where the services of this user leave their notes."""
    own = os.environ.get("XDG_RUNTIME_DIR")
    return Path(own) / "pyrcal" if own else Path(tempfile.gettempdir()) / f"pyrcal-{os.getuid()}"


@contextlib.contextmanager
def announced(data_dir: Path, url: str) -> Iterator[None]:
    """Leave a note while the block lasts; log if the machine takes none."""
    folder = notes_folder()
    path = folder / f"{os.getpid()}.json"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_own(folder):
            raise PermissionError(f"{folder}: others may write there")
        note = path.with_suffix(".part").open("w", encoding="utf-8")
    except OSError as error:
        structlog.get_logger().info("service.not-announced", text=str(error))
        yield
        return
    with note:
        fcntl.flock(note, fcntl.LOCK_EX)
        json.dump({"data_dir": str(data_dir.absolute()), "url": url}, note)
        note.flush()
        Path(note.name).rename(path)  # whoever finds it finds it locked
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def running_services() -> tuple[RunningService, ...]:
    """Return the services of this user that run now, and remove what others have left behind."""
    folder, found = notes_folder(), []
    if not _is_own(folder):
        return ()
    for path in sorted(folder.glob("*.json")):
        with contextlib.suppress(OSError, ValueError, KeyError), path.open() as note:
            try:
                fcntl.flock(note, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                told = json.load(note)
                found.append(RunningService(Path(told["data_dir"]), told["url"]))
            else:
                path.unlink(missing_ok=True)
    return tuple(found)


def data_dir_of_the_one() -> Path | None:
    """Return the folder of the only service that runs; None: none does.

    Raises
    ------
    ConfigurationError
        If there are several: somebody has to say which is meant.
    """
    every = running_services()
    if len({one.data_dir for one in every}) > 1:
        which = "; ".join(f"{one.data_dir} ({one.url})" for one in every)
        raise ConfigurationError(
            f"found {len(every)} services that run here, expected --data-dir to say which: {which}"
        )
    return every[0].data_dir if every else None


def _is_own(folder: Path) -> bool:
    """Return whether a folder exists that only this user can write into."""
    try:
        known = folder.stat()
    except OSError:
        return False
    return known.st_uid == os.getuid() and not known.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
