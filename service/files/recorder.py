"""Telemetry onto the disk: what the RTC sent, byte for byte, in HDF5 that survives a ``kill -9``.

The layout is :mod:`service.files.recording`'s, which reads it. Everything grows by appending; the
file is written in HDF5's single-writer mode and flushed twice a second.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Self

import h5py
import numpy as np
import structlog

from service.errors import ConfigurationError
from service.files.last_telemetry import Arrived
from service.files.recording import FORMAT, VERSION, Message, RecordedKind

_log = structlog.get_logger()

FLUSH_S: Final = 0.5
"""Most that a killed process loses, beside the time the disk needs."""

BACKLOG_BYTES: Final = 64_000_000
"""What may wait for the disk; beyond it messages are dropped and counted."""

PART_BYTES: Final = 16_000_000
"""Of what was there before that is written at once."""

_ROW: Final = np.dtype(
    [
        ("time_s", "<f8"),
        ("kind", "u1"),
        ("start", "<u8"),
        ("payload_bytes", "<u4"),
        ("attachment_bytes", "<u4"),
    ]
)


class RecordingWriter:
    """Writes messages in a thread while its ``with`` block lasts; ``put`` never waits."""

    def __init__(self, path: Path, *, system: str, backlog_bytes: int = BACKLOG_BYTES) -> None:
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._path = path
        self._system = system
        self._backlog_bytes = backlog_bytes
        self._past: deque[Arrived] = deque()
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
            self._file = h5py.File(self._path, "x", libver="latest")
        except OSError as error:
            reason = "it exists already" if self._path.exists() else str(error)
            raise ConfigurationError(f"{self._path}: cannot be created: {reason}") from error
        self._file.attrs.update(
            format=FORMAT, version=VERSION, system=self._system, created_ns=time.time_ns()
        )
        self._bytes = _growing(self._file, "bytes", np.dtype("u1"), 1 << 20)
        self._rows = _growing(self._file, "messages", _ROW, 4096)
        self._dropped = self._file.create_dataset("dropped", data=np.zeros(1, np.int64))
        self._file.swmr_mode = True
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Write what waits and close the file."""
        self._stopped.set()
        self._thread.join()
        self._file.close()
        _log.info("record.end", file=str(self._path), dropped=self.n_dropped)

    def begin_with(self, past: Sequence[Arrived]) -> None:
        """Write these first; call it before anything is put. They need no room in the backlog."""
        with self._lock:
            self._past.extend(past)
            self._start_s = min(self._start_s, *(one.at_s for one in past[:1]), math.inf)
            self.n_bytes += sum(len(one.payload) + len(one.attachment) for one in past)

    def put(self, kind: RecordedKind, payload: bytes, attachment: bytes = b"") -> None:
        """Hand over a message that has just been sent, from any thread."""
        time_s = time.monotonic() - self._start_s
        message = Message(time_s=time_s, kind=kind, payload=payload, attachment=attachment)
        size = len(payload) + len(attachment)
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
        except OSError as error:
            _log.error("record.failed", file=str(self._path), reason=str(error))
            with self._lock:
                self.n_dropped += len(self._waiting)
                self._waiting.clear()
                self.trouble = str(error)

    def _write(self) -> None:
        """Append what waits: first of what was there before the recording, bit by bit."""
        while self._past:
            part, size = [], 0
            while self._past and size < PART_BYTES:
                kind, payload, attachment = (one := self._past.popleft())[1:]
                size += len(payload) + len(attachment)
                time_s = max(0.0, one.at_s - self._start_s)
                part.append(
                    Message(time_s=time_s, kind=kind, payload=payload, attachment=attachment)
                )
            self._append(part)
        with self._lock:
            messages, self._waiting = list(self._waiting), deque()
            n_dropped = self.n_dropped
        if n_dropped != self._dropped[0]:
            self._dropped[0] = n_dropped
            self._dropped.flush()
        n_bytes = self._append(messages)
        with self._lock:
            self._waiting_bytes -= n_bytes

    def _append(self, messages: list[Message]) -> int:
        """Write bytes before the rows that point to them, both to the disk; return how many."""
        if not messages:
            return 0
        data = np.frombuffer(b"".join(m.payload + m.attachment for m in messages), dtype="u1")
        sizes = np.array([(len(m.payload), len(m.attachment)) for m in messages])
        rows = np.empty(len(messages), dtype=_ROW)
        rows["time_s"] = [m.time_s for m in messages]
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


def _growing(file: Any, name: str, kind: np.dtype[Any], chunk: int) -> Any:  # noqa: ANN401 - h5py
    """Return a new dataset without rows that may grow for ever."""
    return file.create_dataset(name, shape=(0,), maxshape=(None,), chunks=(chunk,), dtype=kind)
