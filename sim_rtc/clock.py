"""When frames happen: their timestamps, and the pace at which they are made."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass


@dataclass(slots=True, kw_only=True)
class FrameClock:
    """Timestamps of the frames: they follow the sequence, never the machine's clock.

    Only the loop's thread changes it, between two batches.
    """

    start_ns_utc: int
    """Start of the exposure of frame 0."""

    dt_ns: int
    """Frame period, nanoseconds."""

    def end_of_exposure_ns(self, seq: int) -> int:
        """Return the end of exposure of frame ``seq``, nanoseconds since the Unix epoch, UTC."""
        return self.start_ns_utc + (seq + 1) * self.dt_ns

    def step(self, by_ns: int) -> None:
        """Let all frames to come be later by this much."""
        self.start_ns_utc += by_ns

    def restart(self, now_ns_utc: int) -> None:
        """Begin the exposure of frame 0 again, now."""
        self.start_ns_utc = now_ns_utc


class Pace:
    """Holds the loop to real time, or to a multiple of it; late frames are made up for."""

    def __init__(self, *, batch_s: float, batch_frames: int = 1) -> None:
        """Take a batch's wall-clock duration, 0: as fast as it goes; and how many frames it has."""
        self._batch_s = batch_s
        self._batch_frames = batch_frames
        self._start_s: float | None = None
        self._batches = 0
        self.late_frames = 0
        """Frames of batches that were finished after the next one was due."""

        self.behind_s = 0.0
        """How late the last batch was, seconds."""

    def wait(self, stopped: threading.Event) -> None:
        """Wait until the next batch has been exposed."""
        if self._start_s is None:
            self._start_s = time.perf_counter()
        self._batches += 1
        if self._batch_s > 0.0:
            left_s = self._start_s + self._batches * self._batch_s - time.perf_counter()
            if left_s > 0.0:
                stopped.wait(left_s)

    def forgive(self, seconds: float) -> None:
        """Make up for nothing of the last ``seconds``."""
        if self._start_s is not None:
            self._start_s += seconds

    def done(self) -> None:
        """Note that the batch is finished."""
        if self._batch_s == 0.0 or self._start_s is None:
            return
        due_s = self._start_s + self._batches * self._batch_s
        self.behind_s = time.perf_counter() - due_s
        if self.behind_s > self._batch_s:
            self.late_frames += self._batch_frames
