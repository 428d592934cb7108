"""A recording of telemetry, read back: the wire's messages, byte for byte, as HDF5.

Layout (version 1). Everything grows by appending; nothing is ever rewritten::

    /            attributes: format "pyrcal-telemetry", version, system, created_ns
    /bytes       uint8   payloads and attachments of all messages, one after another
    /messages    one row a message, in the order of sending:
                   time_s            seconds since the recording began, by the sender's clock
                   kind              0 frames, 1 status, 2 acknowledgement, 3 liveliness, 4 matrix
                   start             of its payload in /bytes
                   payload_bytes
                   attachment_bytes  of the attachment, right behind the payload
    /dropped     int64 [1]  messages that were not written: the disk was too slow, or full

Frames, status and acknowledgements are as the wire contract has them; liveliness is one byte,
1 when the RTC's token came and 0 when it went; a matrix is a reconstructor from the moment it is
in use, its payload the float32 matrix, its attachment the manifest. The file is written in HDF5's
single-writer mode and flushed twice a second: read it with ``h5py.File(path, "r", swmr=True)``,
also while it is being written.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Final, Self

import h5py
import numpy as np

from service.errors import ConfigurationError

FORMAT: Final = "pyrcal-telemetry"
VERSION: Final = 1

_SLAB_ROWS = 256


class RecordedKind(IntEnum):
    """What a recorded message is."""

    FRAMES = 0
    STATUS = 1
    ACKNOWLEDGEMENT = 2
    LIVELINESS = 3
    MATRIX = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """One message as it was sent."""

    time_s: float
    """Seconds since the recording began."""

    kind: RecordedKind
    payload: bytes
    attachment: bytes = b""


class Recording:
    """A recorded file, read from its beginning; a context manager."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> Self:
        """Open the file.

        Raises
        ------
        ConfigurationError
            If it cannot be read or is no recording of a version this code knows.
        """
        try:
            self._file = h5py.File(self._path, "r", swmr=True)
        except OSError as error:
            raise ConfigurationError(f"{self._path}: cannot be read: {error}") from error
        found = (self._file.attrs.get("format"), int(self._file.attrs.get("version", 0)))
        if found != (FORMAT, VERSION):
            self._file.close()
            raise ConfigurationError(f"{self._path}: is {found}, expected {(FORMAT, VERSION)}")
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def system(self) -> str:
        """The ``{system}`` of the keys it was sent on."""
        return str(self._file.attrs["system"])

    @property
    def n_dropped(self) -> int:
        """Messages that are not in it although they were sent."""
        return int(self._file["dropped"][0])

    def messages(self) -> Iterator[Message]:
        """Yield the messages in the order of sending; what a killed writer left half is not one."""
        rows, data = self._file["messages"], self._file["bytes"]
        for first in range(0, len(rows), _SLAB_ROWS):
            slab = rows[first : first + _SLAB_ROWS]
            start = int(slab["start"][0])
            lengths = slab["payload_bytes"].astype(np.int64) + slab["attachment_bytes"]
            chunk = data[start : int(slab["start"][-1]) + int(lengths[-1])].tobytes()
            for row, length in zip(slab, lengths, strict=True):
                at = int(row["start"]) - start
                if at + int(length) > len(chunk):
                    return
                middle = at + int(row["payload_bytes"])
                yield Message(
                    time_s=float(row["time_s"]),
                    kind=RecordedKind(int(row["kind"])),
                    payload=chunk[at:middle],
                    attachment=chunk[middle : at + int(length)],
                )
