"""A ring of the last seconds of telemetry."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.estimation.frames import FrameBlock
from service.wire import FrameBatch, FrameHeader

MISSING: Final = 0
HELD: Final = 1
VOID: Final = 2

LEAP: Final = "leap"
"""Reason for which frames are held back until more have arrived."""

MAX_LEAP_S: Final = 10.0
"""Longest leap of the sequence that is accepted at once, in seconds of frames; a longer one needs
more batches to confirm it."""

LEAP_CONFIRMATIONS: Final = 2
"""Batches that must go on where a leap has led."""

Places = slice | NDArray[np.int64]
"""Indices of frames; a slice, if they are contiguous, is much faster."""

FRAME_OUTCOMES: Final = (
    "received",
    "lost",
    "recovered",
    "duplicate",
    "late",
    "nonfinite",
    "overwritten",
)
"""Outcomes of frames; :class:`~service.link.statistics.LinkStatistics` describes each."""


class FrameRing:
    """Frames by sequence number modulo the capacity; not thread-safe.

    The reader's cursor and the head (one past the newest frame) bound what is undelivered.
    A place between them is held, missing (it may still come) or void (it came, with a number
    that is not finite). Numbers stay in the batches they came in until the reader passes them.
    """

    def __init__(self, header: FrameHeader, capacity: int, counts: Counter[str]) -> None:
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
        self._state = np.zeros(capacity, np.int8)
        self._seq = np.full(capacity, -1, np.int64)
        self._batch = np.full(capacity, None, object)
        self._noticed_s = np.zeros(capacity)
        self._newest_ns = header.t0_ns
        self._leapt: list[FrameBatch] = []

    def fits(self, header: FrameHeader) -> bool:
        """Return whether these frames belong here."""
        sizes = (self.n_slopes, self.n_modes)
        return self.session == header.session and sizes == (header.n_slopes, header.n_modes)

    @property
    def undelivered(self) -> int:
        """Frames that wait to be drained."""
        slots = np.arange(self._cursor, self._head) % self._capacity
        return int(np.count_nonzero(self._state[slots] == HELD))

    def why_not(self, header: FrameHeader) -> tuple[str, str] | None:
        """Return why frames have no place in this sequence, as a word and a text; None: they have.

        A number that was there before on a frame of a later time is no frame come late.
        """
        ahead = header.seq0 - self._head
        # A leap beyond the capacity would void all frames in the ring.
        far = min(round(MAX_LEAP_S * 1e9 / header.dt_ns), self._capacity)
        if ahead > far:
            return LEAP, (
                f"seq0 leaps from {self._head} to {header.seq0} in session {self.session}: it is "
                f"accepted when {LEAP_CONFIRMATIONS} more batches confirm it"
            )
        old = header.seq0 + header.n <= self._head
        # A late frame has an old number and an old time. A reused number with a new time is an
        # error of the RTC.
        again = old and header.t0_ns > self._newest_ns
        if again or (-ahead - header.n) * header.dt_ns > MAX_LEAP_S * 1e9:
            return "sequence", (
                f"seq0 goes back from {self._head} to {header.seq0} in session {self.session}: the "
                "RTC must begin a new session when its sequence starts over; restart it"
            )
        return None

    def leapt(self, batch: FrameBatch) -> list[FrameBatch]:
        """Return the batches of a leap that enough of them confirm, else none; keep this one."""
        before = self._leapt[-1].header if self._leapt else None
        header = batch.header
        # Some frames may be missing between the batches of a leap, but none may go back.
        if before is None or not 0 <= header.seq0 - before.seq0 - before.n <= self._capacity:
            self._leapt = []
        self._leapt.append(batch)
        if len(self._leapt) <= LEAP_CONFIRMATIONS:
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
            self._hold(batch)
            return
        slots = seq % self._capacity
        here = self._seq[slots] == seq
        free = here & (self._state[slots] == MISSING) & (seq >= self._cursor)
        duplicate = int(np.count_nonzero(here & (self._state[slots] != MISSING)))
        counts["duplicate"] += duplicate
        counts["late"] += header.n - duplicate - int(np.count_nonzero(free))
        counts["recovered"] += int(np.count_nonzero(free[:older]))
        # Runs of free places: with False at both ends every run has a start and a stop.
        edges = np.flatnonzero(np.diff(free, prepend=False, append=False)).tolist()
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            # copied: a few frames must not keep the memory of all that came with them
            self._hold(_part(batch, start, stop, copied=True))

    def skip(self, header: FrameHeader, now_s: float) -> None:
        """Pass the places of frames that are not used, and all that waits."""
        n_new = max(header.seq0 + header.n - self._head, 0)
        if n_new:
            self._newest_ns = header.t0_ns + (header.n - 1) * header.dt_ns
        self._leapt = []
        self._advance(self._head + n_new, now_s)
        self._counts["lost"] -= min(n_new, header.n)  # they have come
        self._cursor = self._head

    @property
    def head(self) -> int:
        """Number of the frame that comes next."""
        return self._head

    def take(
        self, now_s: float, patience_s: float, limit: int, end: int | None = None
    ) -> list[FrameBlock]:
        """Return copies of at most ``limit`` frames that are due, before ``end``, and pass them.

        Frames behind a missing one are held back until it comes or ``patience_s`` have gone by
        since it was missed. A hole, a clock step of more than half a period, another
        reconstructor, set of references, period or kind of row begins a new block.
        """
        last = min(self._head if end is None else end, self._head, self._cursor + limit)
        slots = np.arange(self._cursor, last) % self._capacity
        waiting = (self._state[slots] == MISSING) & (now_s - self._noticed_s[slots] < patience_s)
        if waiting.any():
            # argmax of booleans is the first True: what lies behind the first missing frame waits
            # with it.
            slots = slots[: int(np.argmax(waiting))]
        blocks: list[list[FrameBatch]] = []
        for part in self._held(self._cursor, self._cursor + len(slots)):
            if blocks and _goes_on(blocks[-1][-1].header, part.header):
                blocks[-1].append(part)
            else:
                blocks.append([part])
        self._cursor += len(slots)
        self._batch[slots] = None
        return [_block(parts) for parts in blocks]

    def due(self, now_s: float, patience_s: float, end: int | None = None) -> bool:
        """Return whether the next place can be passed now, and is one before ``end``."""
        if self._cursor >= min(self._head if end is None else end, self._head):
            return False
        slot = self._cursor % self._capacity
        waited_s = now_s - float(self._noticed_s[slot])
        return self._state[slot] != MISSING or waited_s >= patience_s

    def _advance(self, head: int, now_s: float) -> None:
        """Move the head, making places that are missing until they are filled."""
        if head <= self._head:
            return
        # The new frames need these places: what the reader has not taken by now is lost.
        cursor = max(self._cursor, head - self._capacity)
        if cursor > self._cursor:
            passed = np.arange(self._cursor, min(cursor, self._head)) % self._capacity
            self._counts["overwritten"] += int(np.count_nonzero(self._state[passed] == HELD))
        # All are lost at first; those that come are taken out again by _hold.
        self._counts["lost"] += head - self._head
        self._cursor = cursor
        # A leap of more than the capacity needs no more places than there are.
        first = max(self._head, head - self._capacity)
        slots = _span(first, head - first, self._capacity)
        self._seq[slots] = np.arange(first, head)
        self._state[slots] = MISSING
        self._batch[slots] = None
        self._noticed_s[slots] = now_s
        self._head = head

    def _hold(self, batch: FrameBatch) -> None:
        """Keep the frames of a batch, whose places are free."""
        finite = _finite(batch.rows)
        n_finite = int(np.count_nonzero(finite))
        self._counts["lost"] -= len(finite)
        self._counts["nonfinite"] += len(finite) - n_finite
        self._counts["received"] += n_finite
        slots = _span(batch.header.seq0, batch.header.n, self._capacity)
        self._state[slots] = np.where(finite, HELD, VOID)
        self._batch[slots] = batch

    def _held(self, seq: int, end: int) -> Iterator[FrameBatch]:
        """Yield the frames held between two places, run by run, each of one batch."""
        while seq < end:
            batch = self._batch[seq % self._capacity]
            if batch is None:
                seq += 1
                continue
            first = batch.header.seq0
            last = min(end, first + batch.header.n)
            held = self._state[_span(seq, last - seq, self._capacity)] == HELD
            n = len(held) if held.all() else int(np.argmin(held))
            if n:
                yield _part(batch, seq - first, seq - first + n)
            seq += max(n, 1)


def _part(batch: FrameBatch, start: int, stop: int, *, copied: bool = False) -> FrameBatch:
    """Return these rows of a batch as one of their own."""
    header = batch.header
    if stop - start == header.n:
        return batch
    rows, t0_ns = batch.rows[start:stop], header.t0_ns + start * header.dt_ns
    header = replace(header, seq0=header.seq0 + start, n=stop - start, t0_ns=t0_ns)
    return FrameBatch(header=header, rows=rows.copy() if copied else rows)


def _finite(rows: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return ``(n,)`` whether all numbers of a row are finite."""
    if math.isfinite(np.vdot(rows, rows)):  # as nearly always, and quicker than to look at each
        return np.ones(len(rows), np.bool_)
    return np.asarray(np.isfinite(rows).all(axis=1))


def _goes_on(before: FrameHeader, after: FrameHeader) -> bool:
    """Return whether frames may share a block with those before them."""
    late_ns = after.t0_ns - before.t0_ns - before.n * before.dt_ns
    # A block has one start time and one period: a smaller deviation is jitter, a larger one a step
    # of the clock.
    return (
        after.seq0 == before.seq0 + before.n
        and abs(late_ns) <= 0.5 * before.dt_ns
        and (after.dt_ns, after.dither, after.cm_id) == (before.dt_ns, before.dither, before.cm_id)
        and after.reference_name == before.reference_name
    )


def _block(parts: list[FrameBatch]) -> FrameBlock:
    """Return frames that go on one after the other as a block, copied."""
    header = parts[0].header
    # Copied: the batches' memory is returned as soon as the reader has passed them.
    together = FrameBatch(header=header, rows=np.concatenate([part.rows for part in parts]))
    return FrameBlock(
        session=header.session,
        first_seq=header.seq0,
        t0_ns_utc=header.t0_ns,
        dt_ns=header.dt_ns,
        slopes=together.slopes,
        commands_m=together.commands_m,
        dither_m=together.dither_m,
        cm_id=header.cm_id,
        reference_name=header.reference_name,
    )


def _span(seq: int, n: int, size: int) -> Places:
    """Return where ``n`` frames in sequence are, modulo the size."""
    first = seq % size
    return slice(first, first + n) if first + n <= size else np.arange(seq, seq + n) % size
