"""Imported by Python as it starts: clock and disk of :class:`pyrcal_studies.machine.Machine`."""

import mmap
import os
import struct
import time
from pathlib import Path
from typing import Any

with Path(os.environ["STUDY_MACHINE"]).open("rb") as _file:
    _like = mmap.mmap(_file.fileno(), 0, access=mmap.ACCESS_READ)
_time, _time_ns, _fsync = time.time, time.time_ns, os.fsync


def _told(offset: int) -> float:
    (seconds,) = struct.unpack_from("<d", _like, offset)
    return float(seconds)


def _slow_fsync(fd: Any) -> None:  # noqa: ANN401 - whatever has a descriptor
    time.sleep(_told(8))
    _fsync(fd)


time.time = lambda: _time() + _told(0)
time.time_ns = lambda: _time_ns() + round(_told(0) * 1e9)
os.fsync = _slow_fsync
