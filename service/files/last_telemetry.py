"""The last telemetry that came, in memory: so that what somebody saw go wrong can still be kept."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import NamedTuple

from service.files.recording import RecordedKind

OVERHEAD_BYTES = 200
"""Of a message in memory, besides what is in it."""


class Arrived(NamedTuple):
    """A message, and when it came."""

    at_s: float
    """Monotonic seconds."""

    kind: RecordedKind
    payload: bytes
    attachment: bytes = b""

    @property
    def n_bytes(self) -> int:
        """What it takes in memory."""
        return len(self.payload) + len(self.attachment) + OVERHEAD_BYTES


class LastTelemetry:
    """Holds messages until they are too old, or too many; every method may be called anywhere.

    Messages are held as they came: nothing is copied.

    Parameters
    ----------
    seconds
        Older ones go; 0: none are held.
    most_bytes
        Beyond it the oldest go.
    """

    def __init__(self, seconds: float, max_bytes: int) -> None:
        self._seconds = seconds
        self._max_bytes = max_bytes
        self._held: deque[Arrived] = deque()
        self._n_bytes = 0
        self._lock = threading.Lock()

    def put(self, kind: RecordedKind, payload: bytes, attachment: bytes = b"") -> None:
        """Take a message that has just come."""
        if self._seconds <= 0.0:
            return
        now = Arrived(time.monotonic(), kind, payload, attachment)
        with self._lock:
            self._held.append(now)
            self._n_bytes += now.n_bytes
            while self._held and (
                self._n_bytes > self._max_bytes or now.at_s - self._held[0].at_s > self._seconds
            ):
                self._n_bytes -= self._held.popleft().n_bytes

    def since(self, before_s: float) -> list[Arrived]:
        """Return those that came at most so many seconds ago, oldest first."""
        first_s = time.monotonic() - before_s
        with self._lock:
            return [one for one in self._held if one.at_s >= first_s]
