"""The last seconds of one session's telemetry, each frame in its place."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.telemetry.frames import FrameBlock
from service.wire import FrameBatch, FrameHeader

MISSING: Final = 0
HELD: Final = 1
VOID: Final = 2

LEAP: Final = "leap"
"""In a word, why frames are kept until more have come."""

LEAP_S: Final = 10.0
"""Of frames: a longer leap of the sequence is believed only when more batches confirm it."""

ROOM: Final = 1024
"""Frames there is memory for while the reader keeps up; one that falls behind needs more."""

CONFIRMATIONS: Final = 2
"""Batches that must go on where a leap has led."""


Places = slice | NDArray[np.int64]
"""Where frames are; a slice, where they lie in a row, is much quicker."""


@dataclass(slots=True)
class FrameCounts:
    """What has become of the frames of all sessions so far."""

    received: int = 0
    """Frames stored, recovered ones included."""

    lost: int = 0
    """Sequence numbers that have not come (yet): a recovered frame is taken off again."""

    recovered: int = 0
    """Frames that came after later ones and still found their place."""

    duplicate: int = 0
    late: int = 0
    """Frames that came when their place had been passed; they stay among the lost."""

    nonfinite: int = 0
    overwritten: int = 0
    """Frames nobody drained in time, or that a new session made void."""


class FrameRing:
    """Frames by sequence number modulo the capacity; not thread-safe.

    The reader's cursor and the head (one past the newest frame) bound what is undelivered.
    A place between them is held, missing (it may still come) or void (it came, with a number
    that is not finite). Numbers are kept modulo the room, which grows up to the capacity
    and is given back when the reader has caught up.
    """

    def __init__(self, header: FrameHeader, capacity: int, counts: FrameCounts) -> None:
        """Allocate the ring.

        Parameters
        ----------
        header
            Of the first batch: gives session, sizes and the first sequence number.
        capacity
            Frames kept.
        counts
            Where to count; outlives the ring.
        """
        self.session = header.session
        self.n_slopes = header.n_slopes
        self.n_modes = header.n_modes
        self._counts = counts
        self._capacity = capacity
        self._cursor = self._head = header.seq0
        self._least_room = min(capacity, ROOM)
        self._allocate(self._least_room)
        self._state = np.zeros(capacity, np.int8)
        self._seq = np.full(capacity, -1, np.int64)
        self._t_ns = np.zeros(capacity, np.int64)
        self._dt_ns = np.zeros(capacity, np.int64)
        self._has_dither = np.zeros(capacity, np.bool_)
        self._cm_id = np.full(capacity, None, object)
        self._noticed_s = np.zeros(capacity)
        self._newest_ns = header.t0_ns
        self._leapt: list[FrameBatch] = []

    def fits(self, header: FrameHeader) -> bool:
        """Return whether these frames belong here."""
        sizes = (self.n_slopes, self.n_modes)
        return self.session == header.session and sizes == (header.n_slopes, header.n_modes)

    @property
    def undelivered(self) -> int:
        """Frames held that nobody has drained."""
        slots = np.arange(self._cursor, self._head) % self._capacity
        return int(np.count_nonzero(self._state[slots] == HELD))

    def why_not(self, header: FrameHeader) -> tuple[str, str] | None:
        """Return why frames have no place in this sequence, as a word and a text; None: they have.

        A number that was there before on a frame of a later time is no frame come late.
        """
        ahead = header.seq0 - self._head
        far = min(round(LEAP_S * 1e9 / header.dt_ns), self._capacity)
        if ahead > far:
            return LEAP, (
                f"seq0 leaps from {self._head} to {header.seq0} in session {self.session}: it is "
                f"believed when {CONFIRMATIONS} more batches confirm it"
            )
        old = header.seq0 + header.n <= self._head
        again = old and header.t0_ns > self._newest_ns
        if again or (-ahead - header.n) * header.dt_ns > LEAP_S * 1e9:
            return "sequence", (
                f"seq0 goes back from {self._head} to {header.seq0} in session {self.session}: the "
                "RTC must begin a new session when its sequence starts over; restart it"
            )
        return None

    def leapt(self, batch: FrameBatch) -> list[FrameBatch]:
        """Return the batches of a leap that enough of them confirm, else none; keep this one."""
        before = self._leapt[-1].header if self._leapt else None
        header = batch.header
        if before is None or not 0 <= header.seq0 - before.seq0 - before.n <= self._capacity:
            self._leapt = []
        self._leapt.append(batch)
        if len(self._leapt) <= CONFIRMATIONS:
            return []
        found, self._leapt = self._leapt, []
        return found

    def store(self, batch: FrameBatch, now_s: float) -> None:
        """Put the frames of a batch in their places.

        The first of two frames with the same number wins; a frame that is not finite leaves a
        place that nothing will fill.
        """
        header, counts = batch.header, self._counts
        self._leapt = []
        follows, seq = header.seq0 == self._head, np.arange(header.seq0, header.seq0 + header.n)
        older = int(np.count_nonzero(seq < self._head))
        if header.seq0 + header.n > self._head:
            self._newest_ns = header.t0_ns + (header.n - 1) * header.dt_ns
        self._advance(header.seq0 + header.n, now_s)
        if follows:  # as nearly always: every place is free
            self._fill(batch, np.arange(header.n), _span(header.seq0, header.n, self._capacity))
            return
        slots = seq % self._capacity
        here = self._seq[slots] == seq
        free = here & (self._state[slots] == MISSING) & (seq >= self._cursor)
        duplicate = int(np.count_nonzero(here & (self._state[slots] != MISSING)))
        counts.duplicate += duplicate
        counts.late += header.n - duplicate - int(np.count_nonzero(free))
        counts.recovered += int(np.count_nonzero(free[:older]))
        self._fill(batch, np.flatnonzero(free), slots[free])

    def take(self, now_s: float, patience_s: float, limit: int) -> list[FrameBlock]:
        """Return copies of at most ``limit`` frames that are due, and pass them.

        Frames behind a missing one are held back until it comes or ``patience_s`` have gone by
        since it was missed. A hole, a clock step of more than half a period, another
        reconstructor, period or kind of row begins a new block.
        """
        slots = np.arange(self._cursor, min(self._head, self._cursor + limit)) % self._capacity
        waiting = (self._state[slots] == MISSING) & (now_s - self._noticed_s[slots] < patience_s)
        if waiting.any():
            slots = slots[: int(np.argmax(waiting))]
        blocks = [
            self._block(slots[start:stop])
            for start, stop in self._runs(slots)
            if self._state[slots[start]] == HELD
        ]
        self._cursor += len(slots)
        if self._cursor == self._head and self._room > self._least_room:
            self._allocate(self._least_room)
        return blocks

    def due(self, now_s: float, patience_s: float) -> bool:
        """Return whether the next place can be passed now."""
        if self._cursor == self._head:
            return False
        slot = self._cursor % self._capacity
        waited_s = now_s - float(self._noticed_s[slot])
        return self._state[slot] != MISSING or waited_s >= patience_s

    def _advance(self, head: int, now_s: float) -> None:
        """Move the head, making places that are missing until they are filled."""
        if head <= self._head:
            return
        cursor = max(self._cursor, head - self._capacity)
        if cursor > self._cursor:
            passed = np.arange(self._cursor, min(cursor, self._head)) % self._capacity
            self._counts.overwritten += int(np.count_nonzero(self._state[passed] == HELD))
        self._counts.lost += head - self._head
        self._make_room(cursor, head)
        self._cursor = cursor
        first = max(self._head, head - self._capacity)
        slots = _span(first, head - first, self._capacity)
        self._seq[slots] = np.arange(first, head)
        self._state[slots] = MISSING
        self._noticed_s[slots] = now_s
        self._head = head

    def _allocate(self, room: int) -> None:
        """Take memory for the numbers of so many frames, in which there are none yet."""
        self._room = room
        self._slopes = np.empty((room, self.n_slopes), np.float32)
        self._commands = np.empty((room, self.n_modes), np.float32)
        self._dither = np.empty((room, self.n_modes), np.float32)

    def _make_room(self, cursor: int, head: int) -> None:
        """Have memory for the numbers of all places from the cursor to the head."""
        if head - cursor <= self._room:
            return
        kept = np.arange(cursor, self._head)
        before, old = kept % self._room, (self._slopes, self._commands, self._dither)
        self._allocate(min(self._capacity, 2 * (head - cursor)))
        for new, numbers in zip((self._slopes, self._commands, self._dither), old, strict=True):
            new[kept % self._room] = numbers[before]

    def _fill(self, batch: FrameBatch, rows: NDArray[np.intp], slots: Places) -> None:
        """Put these rows of a batch into these places."""
        header = batch.header
        whole = len(rows) == header.n  # views instead of copies
        chosen: slice | NDArray[np.intp] = slice(None) if whole else rows
        finite = np.isfinite(batch.rows[chosen]).all(axis=1)
        n_finite = int(np.count_nonzero(finite))
        self._state[slots] = np.where(finite, HELD, VOID)
        self._counts.lost -= len(rows)
        self._counts.nonfinite += len(rows) - n_finite
        self._counts.received += n_finite
        room = self._room
        places = _span(header.seq0, header.n, room) if whole else (header.seq0 + rows) % room
        self._slopes[places] = batch.slopes[chosen]
        self._commands[places] = batch.commands_m[chosen]
        dither = batch.dither_m
        if dither is not None:
            self._dither[places] = dither[chosen]
        self._has_dither[slots] = header.dither
        self._t_ns[slots] = header.t0_ns + rows * header.dt_ns
        self._dt_ns[slots] = header.dt_ns
        self._cm_id[slots] = header.cm_id

    def _runs(self, slots: NDArray[np.int64]) -> list[tuple[int, int]]:
        """Return the bounds of rows that may share a block; runs of missing rows are among them."""
        if not len(slots):
            return []
        held = self._state[slots] == HELD
        t_ns, dt_ns = self._t_ns[slots], self._dt_ns[slots]
        cm_id, has_dither = self._cm_id[slots], self._has_dither[slots]
        step = np.abs(np.diff(t_ns) - dt_ns[:-1]) > 0.5 * dt_ns[:-1]
        changed = (dt_ns[1:] != dt_ns[:-1]) | (has_dither[1:] != has_dither[:-1])
        other_matrix = (cm_id[1:] != cm_id[:-1]).astype(np.bool_)
        cut = ~(held[1:] & held[:-1]) | step | changed | other_matrix
        bounds = [0, *(np.flatnonzero(cut) + 1).tolist(), len(slots)]
        return list(pairwise(bounds))

    def _block(self, slots: NDArray[np.int64]) -> FrameBlock:
        first = slots[0]
        places = self._seq[slots] % self._room
        return FrameBlock(
            session=self.session,
            first_seq=int(self._seq[first]),
            t0_ns_utc=int(self._t_ns[first]),
            dt_ns=int(self._dt_ns[first]),
            slopes=self._slopes[places],
            commands_m=self._commands[places],
            dither_m=self._dither[places] if self._has_dither[first] else None,
            cm_id=self._cm_id[first],
        )


def _span(seq: int, n: int, size: int) -> Places:
    """Return where ``n`` frames in sequence are, modulo the size."""
    first = seq % size
    return slice(first, first + n) if first + n <= size else np.arange(seq, seq + n) % size
