"""Hold the last telemetry in memory, for recordings that include the time before their start.

Messages are joined in chunks of one megabyte in separate memory maps. On the heap, between
short-lived objects, messages that are kept for half a minute fragment it: 100 MB of unused pages
were held.
"""

from __future__ import annotations

import mmap
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Self

from service.files.recording import Message, RecordedKind

CHUNK_BYTES: Final = 1_000_000
"""Messages that are joined in one memory map."""

OVERHEAD_BYTES: Final = 200
"""Memory of a message besides its payload and attachment."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Chunk:
    """Consecutive messages in one memory map."""

    heads: tuple[Message, ...]
    """Time and kind of each message; payloads and attachments are empty."""

    sizes: tuple[tuple[int, int], ...]
    """Bytes of payload and attachment of each message."""

    data: mmap.mmap

    @classmethod
    def of(cls, messages: Iterable[Message]) -> Self:
        """Return a chunk of these messages."""
        joined = b"".join(part for one in messages for part in (one.payload, one.attachment))
        # A memory map cannot be empty.
        data = mmap.mmap(-1, max(len(joined), 1))
        data.write(joined)
        return cls(
            heads=tuple(Message(one.time_s, one.kind, b"") for one in messages),
            sizes=tuple((len(one.payload), len(one.attachment)) for one in messages),
            data=data,
        )

    @property
    def n_bytes(self) -> int:
        """Memory of the chunk, bytes."""
        return len(self.data) + OVERHEAD_BYTES * len(self.heads)

    @property
    def newest_s(self) -> float:
        """Time at which its last message came, monotonic seconds."""
        return self.heads[-1].time_s

    def __iter__(self) -> Iterator[Message]:
        """Yield the messages as they came."""
        start = 0
        for head, (payload, attachment) in zip(self.heads, self.sizes, strict=True):
            middle, end = start + payload, start + payload + attachment
            yield head._replace(payload=self.data[start:middle], attachment=self.data[middle:end])
            start = end


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Past:
    """Messages that came since some time, copied out of memory as they are iterated over."""

    chunks: Sequence[_Chunk]
    waiting: Sequence[Message]
    """Messages that came last and are in no chunk yet."""

    since_s: float
    """Monotonic seconds."""

    @property
    def start_s(self) -> float | None:
        """Time at which the first of them came, monotonic seconds; None if there are none."""
        heads = (one for chunk in self.chunks for one in chunk.heads)
        times = [one.time_s for one in (*heads, *self.waiting) if one.time_s >= self.since_s]
        return min(times, default=None)

    def __iter__(self) -> Iterator[Message]:
        """Yield them, oldest first."""
        held: list[Iterable[Message]] = [*self.chunks, self.waiting]
        for messages in held:
            yield from (one for one in messages if one.time_s >= self.since_s)


class LastTelemetry:
    """Holds messages until they are too old, or too many. Its methods are thread-safe.

    Parameters
    ----------
    seconds
        Age at which messages are dropped; 0 if none are to be held.
    max_bytes
        Memory beyond which the oldest messages are dropped; 0 if none are to be held.
    """

    def __init__(self, seconds: float, max_bytes: int) -> None:
        self._seconds = seconds if max_bytes > 0 else 0.0
        self._max_bytes = max_bytes
        self._chunks: deque[_Chunk] = deque()
        self._chunk_bytes = 0
        self._waiting: deque[Message] = deque()
        self._waiting_bytes = 0
        self._lock = threading.Lock()

    def put(self, kind: RecordedKind, payload: bytes, attachment: bytes = b"") -> None:
        """Take a message that has just come."""
        if self._seconds <= 0.0:
            return
        now = Message(time.monotonic(), kind, payload, attachment)
        with self._lock:
            self._waiting.append(now)
            self._waiting_bytes += now.n_bytes + OVERHEAD_BYTES
            if self._waiting_bytes >= CHUNK_BYTES:
                self._chunks.append(_Chunk.of(self._waiting))
                self._chunk_bytes += self._chunks[-1].n_bytes
                self._waiting.clear()
                self._waiting_bytes = 0
            self._drop(now.time_s - self._seconds)

    def since(self, before_s: float) -> Past:
        """Return the messages that came at most so many seconds ago."""
        with self._lock:
            since_s = time.monotonic() - min(before_s, self._seconds)
            # The chunks are immutable: they are read outside the lock, even after they were dropped
            # here.
            chunks = tuple(chunk for chunk in self._chunks if chunk.newest_s >= since_s)
            return Past(chunks=chunks, waiting=tuple(self._waiting), since_s=since_s)

    def _drop(self, oldest_s: float) -> None:
        """Drop messages that are too old, and the oldest while there are too many."""
        while self._chunks and (self._is_too_much or self._chunks[0].newest_s < oldest_s):
            self._chunk_bytes -= self._chunks.popleft().n_bytes
        while self._waiting and (self._is_too_much or self._waiting[0].time_s < oldest_s):
            self._waiting_bytes -= self._waiting.popleft().n_bytes + OVERHEAD_BYTES

    @property
    def _is_too_much(self) -> bool:
        return self._chunk_bytes + self._waiting_bytes > self._max_bytes
