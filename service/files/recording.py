"""Recordings of telemetry: write, read back, byte for byte.

Layout (version 1), HDF5. Everything grows by appending; nothing is ever rewritten::

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
in use, its payload the float32 matrix, its attachment the manifest.

The file survives a ``kill -9``: it is written in HDF5's single-writer mode and flushed twice a
second. Read it with ``h5py.File(path, "r", swmr=True)``, also while it is being written.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import h5py
import numpy as np
import structlog

from service.errors import ConfigurationError
from service.files.whole import open_growing_hdf5, open_hdf5

_log = structlog.get_logger()

FORMAT: Final = "pyrcal-telemetry"
VERSION: Final = 1

_SLAB_ROWS = 256

FLUSH_S: Final = 0.5
"""Longest telemetry that a killed process loses, in addition to the time the disk needs."""

BACKLOG_BYTES: Final = 64_000_000
"""Size of the messages that may wait for the disk; beyond it they are dropped and counted."""

PAST_PART_BYTES: Final = 16_000_000
"""Bytes of earlier telemetry that are written to the disk at once."""

_ROW: Final = np.dtype(
    [
        ("time_s", "<f8"),
        ("kind", "u1"),
        ("start", "<u8"),
        ("payload_bytes", "<u4"),
        ("attachment_bytes", "<u4"),
    ]
)


class RecordedKind(IntEnum):
    """Kinds of recorded messages."""

    FRAMES = 0
    STATUS = 1
    ACKNOWLEDGEMENT = 2
    LIVELINESS = 3
    MATRIX = 4


_KINDS = frozenset(int(kind) for kind in RecordedKind)


class Message(NamedTuple):
    """One message as it was sent."""

    time_s: float
    """Seconds since the recording began; of one in memory, monotonic seconds."""

    kind: RecordedKind
    payload: bytes
    attachment: bytes = b""

    @property
    def n_bytes(self) -> int:
        """Size of payload and attachment."""
        return len(self.payload) + len(self.attachment)


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
            self._file = open_growing_hdf5(self._path)
        except OSError as error:
            raise ConfigurationError(f"{self._path}: cannot be read: {error}") from error
        reason = self._check()
        if reason:
            self._file.close()
            raise ConfigurationError(f"{self._path}: {reason}")
        return self

    def _check(self) -> str:
        """Return why the open file is no recording that can be read; empty if it is one."""
        try:
            attributes = dict(self._file.attrs)
            found = (str(attributes.get("format")), str(attributes.get("version", 0)))
            if found != (FORMAT, str(VERSION)):
                return f"is {found}, expected {(FORMAT, VERSION)}"
            if not isinstance(attributes.get("system"), str):
                return "found no attribute system, expected the name of the system"
            expected = {"messages": _ROW, "bytes": np.dtype("u1"), "dropped": np.dtype("i8")}
            for name, kind in expected.items():
                there = self._file.get(name)
                if not isinstance(there, h5py.Dataset) or (there.ndim, there.dtype) != (1, kind):
                    return f"damaged: found no {name} of type {kind}, one for each message"
        except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
            return f"damaged: {error}"
        return ""

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
            try:
                slab = rows[first : first + _SLAB_ROWS]
                # int64, because the sum of two uint32 may wrap around.
                lengths = slab["payload_bytes"].astype(np.int64) + slab["attachment_bytes"]
                start, end = int(slab["start"][0]), int(slab["start"][-1]) + int(lengths[-1])
                chunk = data[start : max(start, end)].tobytes()
            except _REFUSED as error:
                raise ConfigurationError(f"{self._path}: damaged: {error}") from error
            for number, (row, length) in enumerate(zip(slab, lengths, strict=True), first):
                at = int(row["start"]) - start
                # A killed writer may have left rows whose bytes are not all on the disk.
                if at + int(length) > len(chunk):
                    return
                if at < 0 or int(row["kind"]) not in _KINDS or not np.isfinite(row["time_s"]):
                    raise ConfigurationError(
                        f"{self._path}: damaged: message {number} is of kind {row['kind']} at "
                        f"{row['time_s']} s, {at} bytes on; expected a known kind at a finite time"
                    )
                middle = at + int(row["payload_bytes"])
                yield Message(
                    time_s=float(row["time_s"]),
                    kind=RecordedKind(int(row["kind"])),
                    payload=chunk[at:middle],
                    attachment=chunk[middle : at + int(length)],
                )


_REFUSED = (OSError, RuntimeError, ValueError)
"""Exceptions of h5py when the disk refuses; a flush or a close raises a RuntimeError."""


class RecordingWriter:
    """Writes messages in a thread while its ``with`` block lasts; ``put`` never waits."""

    def __init__(self, path: Path, *, system: str, backlog_bytes: int = BACKLOG_BYTES) -> None:
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._path = path
        self._system = system
        self._backlog_bytes = backlog_bytes
        self._past: Iterator[Message] = iter(())
        self._waiting: deque[Message] = deque()
        self._waiting_bytes = 0
        self._lock = threading.Lock()
        self._start_s = time.monotonic()
        self.n_dropped = 0
        """Messages that were not written."""

        self.n_bytes = 0
        """Taken so far."""

        self.trouble = ""
        """Why nothing is written any more; empty: all is."""

    def __enter__(self) -> Self:
        """Create the file.

        Raises
        ------
        ConfigurationError
            If it exists already, or cannot be created.
        """
        try:
            # Single-writer mode needs the latest file format.
            self._file = open_hdf5(self._path, "x", libver="latest")
        except OSError as error:
            exists = isinstance(error, FileExistsError)
            reason = "it exists already" if exists else str(error)
            raise ConfigurationError(f"{self._path}: cannot be created: {reason}") from error
        self._file.attrs.update(
            format=FORMAT, version=VERSION, system=self._system, created_ns=time.time_ns()
        )
        self._bytes = _create_growing(self._file, "bytes", np.dtype("u1"), 1 << 20)
        self._rows = _create_growing(self._file, "messages", _ROW, 4096)
        self._dropped = self._file.create_dataset("dropped", data=np.zeros(1, np.int64))
        # After all datasets and attributes: HDF5 creates none in single-writer mode.
        self._file.swmr_mode = True
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Write what waits and close the file."""
        self._stopped.set()
        self._thread.join()
        try:
            self._file.close()
        except _REFUSED as error:
            self._failed(error)
        _log.info("record.end", file=str(self._path), dropped=self.n_dropped)

    def begin_with(self, past: Iterable[Message], start_s: float) -> None:
        """Write these first, the first of which came at ``start_s``, monotonic seconds.

        Call it before anything is put. They need no room in the backlog.
        """
        with self._lock:
            self._start_s = min(self._start_s, start_s)
            self._past = iter(past)

    def put(self, kind: RecordedKind, payload: bytes, attachment: bytes = b"") -> None:
        """Hand over a message that has just been sent, from any thread."""
        message = Message(time.monotonic(), kind, payload, attachment)
        size = message.n_bytes
        with self._lock:
            if self.trouble or self._waiting_bytes + size > self._backlog_bytes:
                self.n_dropped += 1
                return
            self._waiting.append(message)
            self._waiting_bytes += size
            self.n_bytes += size

    def _work(self) -> None:
        try:
            while not self._stopped.wait(FLUSH_S):
                self._write()
            self._write()
        except _REFUSED as error:
            self._failed(error)

    def _failed(self, error: Exception) -> None:
        _log.error("record.failed", file=str(self._path), reason=str(error))
        with self._lock:
            self.n_dropped += len(self._waiting)
            self._waiting.clear()
            # The first reason counts: later ones follow from it.
            self.trouble = self.trouble or str(error) or type(error).__name__

    def _write(self) -> None:
        """Append what waits: first of what was there before the recording, bit by bit."""
        # In parts, because a minute of telemetry may be gigabytes.
        while part := self._part_of_past():
            n_bytes = self._append(part)
            with self._lock:
                self.n_bytes += n_bytes
        with self._lock:
            messages, self._waiting = list(self._waiting), deque()
            n_dropped = self.n_dropped
        if n_dropped != self._dropped[0]:
            self._dropped[0] = n_dropped
            self._dropped.flush()
        n_bytes = self._append(messages)
        with self._lock:
            self._waiting_bytes -= n_bytes

    def _part_of_past(self) -> list[Message]:
        part: list[Message] = []
        size = 0
        for message in self._past:
            part.append(message)
            size += message.n_bytes
            if size >= PAST_PART_BYTES:
                break
        return part

    def _append(self, messages: list[Message]) -> int:
        """Write bytes before the rows that point to them, both to the disk; return how many."""
        if not messages:
            return 0
        data = np.frombuffer(b"".join(m.payload + m.attachment for m in messages), dtype="u1")
        sizes = np.array([(len(m.payload), len(m.attachment)) for m in messages])
        rows = np.empty(len(messages), dtype=_ROW)
        rows["time_s"] = [max(0.0, m.time_s - self._start_s) for m in messages]
        rows["kind"] = [m.kind for m in messages]
        rows["payload_bytes"], rows["attachment_bytes"] = sizes.T
        ends = np.cumsum(sizes.sum(axis=1))
        rows["start"] = len(self._bytes) + ends - sizes.sum(axis=1)
        for dataset, new in ((self._bytes, data), (self._rows, rows)):
            before = len(dataset)
            dataset.resize(before + len(new), axis=0)
            dataset[before:] = new
            dataset.flush()
        return len(data)


def _create_growing(file: Any, name: str, kind: np.dtype[Any], chunk: int) -> Any:  # noqa: ANN401 - h5py
    """Return a new dataset without rows that may grow for ever."""
    return file.create_dataset(name, shape=(0,), maxshape=(None,), chunks=(chunk,), dtype=kind)
