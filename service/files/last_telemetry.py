"""Hold the last telemetry in memory, for recordings that begin before now.

Messages are packed together: words of four zero bytes are held as bits. Of a frame of FLAO they are
a quarter, what the dither adds to modes that it leaves alone and modes that are not controlled; all
bytes come back. Packs lie beside the heap: in it, between what comes and goes in moments, each
would hold pages that nobody uses, 100 MB of them in half a minute.
"""

from __future__ import annotations

import mmap
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from service.files.recording import Message, RecordedKind

PACK_BYTES: Final = 1_000_000
"""Of messages that are packed together: it takes less than a millisecond."""

OVERHEAD_BYTES: Final = 200
"""Of a message in memory, besides what is in it."""

_WORD: Final = np.dtype("<u4")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pack:
    """Messages without their zeros."""

    heads: tuple[Message, ...]
    """The messages, of which only time and kind are kept."""

    sizes: tuple[tuple[int, int], ...]
    """Bytes of payload and attachment of each."""

    marks: bytes
    """A bit for every word of payloads and attachments, one after another: 0, it is zero."""

    words: mmap.mmap
    """The other words."""

    @classmethod
    def of(cls, messages: Sequence[Message]) -> Self:
        """Return messages packed."""
        data = b"".join(part for one in messages for part in (one.payload, one.attachment))
        every = np.frombuffer(data + bytes(-len(data) % _WORD.itemsize), _WORD)
        marked = every != 0
        some = every[marked]
        words = mmap.mmap(-1, max(some.nbytes, 1))
        words.write(some.data)
        return cls(
            heads=tuple(Message(one.time_s, one.kind, b"") for one in messages),
            sizes=tuple((len(one.payload), len(one.attachment)) for one in messages),
            marks=np.packbits(marked).tobytes(),
            words=words,
        )

    @property
    def n_bytes(self) -> int:
        """What it takes in memory."""
        return len(self.words) + len(self.marks) + OVERHEAD_BYTES * len(self.heads)

    @property
    def newest_s(self) -> float:
        """When its last message came."""
        return self.heads[-1].time_s

    def __iter__(self) -> Iterator[Message]:
        """Yield the messages as they came."""
        marked = np.unpackbits(np.frombuffer(self.marks, np.uint8)).astype(np.bool_)
        every = np.zeros(len(marked), _WORD)
        every[marked] = np.frombuffer(self.words, _WORD, count=int(np.count_nonzero(marked)))
        data, start = every.tobytes(), 0
        for head, (payload, attachment) in zip(self.heads, self.sizes, strict=True):
            middle, end = start + payload, start + payload + attachment
            yield head._replace(payload=data[start:middle], attachment=data[middle:end])
            start = end


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Past:
    """Messages that came since some time; unpacked as they are asked for."""

    packs: Sequence[_Pack]
    waiting: Sequence[Message]
    """Those that came last."""

    since_s: float
    """Monotonic seconds."""

    @property
    def start_s(self) -> float | None:
        """When the first of them came; None: there are none."""
        heads = (one for pack in self.packs for one in pack.heads)
        times = [one.time_s for one in (*heads, *self.waiting) if one.time_s >= self.since_s]
        return min(times, default=None)

    def __iter__(self) -> Iterator[Message]:
        """Yield them, oldest first."""
        held: list[Iterable[Message]] = [*self.packs, self.waiting]
        for messages in held:
            yield from (one for one in messages if one.time_s >= self.since_s)


class LastTelemetry:
    """Holds messages until they are too old, or too many; every method may be called anywhere.

    Parameters
    ----------
    seconds
        Older ones go; 0: none are held.
    max_bytes
        Beyond it the oldest go.
    """

    def __init__(self, seconds: float, max_bytes: int) -> None:
        self._seconds = seconds
        self._max_bytes = max_bytes
        self._packs: deque[_Pack] = deque()
        self._packed_bytes = 0
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
            if self._waiting_bytes >= PACK_BYTES:
                self._pack()
            self._drop(now.time_s - self._seconds)

    def since(self, before_s: float) -> Past:
        """Return those that came at most so many seconds ago."""
        with self._lock:
            since_s = time.monotonic() - min(before_s, self._seconds)
            packs = tuple(pack for pack in self._packs if pack.newest_s >= since_s)
            return Past(packs=packs, waiting=tuple(self._waiting), since_s=since_s)

    def _pack(self) -> None:
        self._packs.append(_Pack.of(self._waiting))
        self._packed_bytes += self._packs[-1].n_bytes
        self._waiting.clear()
        self._waiting_bytes = 0

    def _drop(self, oldest_s: float) -> None:
        """Let go what is too old or too much."""
        while self._packs and (self._is_too_much or self._packs[0].newest_s < oldest_s):
            self._packed_bytes -= self._packs.popleft().n_bytes
        while self._waiting and (self._is_too_much or self._waiting[0].time_s < oldest_s):
            self._waiting_bytes -= self._waiting.popleft().n_bytes + OVERHEAD_BYTES

    @property
    def _is_too_much(self) -> bool:
        return self._packed_bytes + self._waiting_bytes > self._max_bytes
