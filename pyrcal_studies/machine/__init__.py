"""The machine that a service under study believes it runs on: its clock can leap, its disk be slow.

:mod:`sitecustomize` beside this, on the service's ``PYTHONPATH``, reads what is written here.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

FOLDER = Path(__file__).parent
WHERE = "STUDY_MACHINE"
"""The environment variable with the file's path."""

FORM = struct.Struct("<2d")
"""Seconds that the clock is ahead, seconds that each flush to the disk takes."""


class Machine:
    """A file with what the machine is like, which programs on it map into their memory."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.write_bytes(FORM.pack(0.0, 0.0))

    @property
    def environment(self) -> dict[str, str]:
        """What a program needs to run on this machine."""
        return {"PYTHONPATH": str(FOLDER), WHERE: str(self._path)}

    def be(self, *, ahead_s: float = 0.0, flush_s: float = 0.0) -> None:
        """Be like this from now on."""
        with self._path.open("r+b", buffering=0) as file:
            os.pwrite(file.fileno(), FORM.pack(ahead_s, flush_s), 0)
