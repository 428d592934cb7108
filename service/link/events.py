"""What the link reports besides frames, the bounded queue it waits in, and who is woken by it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.tracking.events import Event
from service.wire import Acknowledgement, MeasuredManifest, Status

QUEUE_LENGTH: Final = 1024
"""Events kept; when more wait, the oldest are dropped and counted."""

BURST_S: Final = 10.0
"""The same complaint is reported once in this time, however often it is counted."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredMatrix:
    """An interaction matrix the RTC has measured, or why it could not."""

    manifest: MeasuredManifest
    matrix: NDArray[np.float32] | None
    """``(n_slopes, n_modes_measured)``, slope per metre OPD; None: see the manifest's reason."""


LinkEvent = Status | Acknowledgement | MeasuredMatrix | Event
"""What the RTC says of itself and of reconstructors, or what that means to the tracker."""


class Bursts:
    """Lets the first of a burst of equal complaints through."""

    __slots__ = ("_last",)

    def __init__(self) -> None:
        self._last: dict[str, float] = {}

    def opens(self, kind: str, now_s: float) -> bool:
        """Return whether this complaint is due again."""
        last = self._last.get(kind)
        if last is not None and now_s - last < BURST_S:
            return False
        self._last = {k: s for k, s in self._last.items() if now_s - s < BURST_S}
        self._last[kind] = now_s
        return True


class EventQueue:
    """Events on their way from zenoh's threads to the consumer; the oldest give way."""

    __slots__ = ("_events", "_lock", "dropped")

    def __init__(self, length: int = QUEUE_LENGTH) -> None:
        self._events: deque[LinkEvent] = deque(maxlen=length)
        self._lock = threading.Lock()
        self.dropped = 0

    def put(self, event: LinkEvent) -> None:
        """Add an event."""
        with self._lock:
            self.dropped += len(self._events) == self._events.maxlen
            self._events.append(event)

    def take(self) -> list[LinkEvent]:
        """Return what has come since the last call, oldest first."""
        with self._lock:
            events = list(self._events)
            self._events.clear()
        return events


class Wakeup:
    """Rings at most once between two visits of the consumer, from whatever thread."""

    __slots__ = ("_callback", "_rung")

    def __init__(self) -> None:
        self._callback: Callable[[], object] | None = None
        self._rung = False

    def connect(self, callback: Callable[[], object] | None) -> None:
        """Call ``callback`` from now on; None: nothing."""
        self._callback = callback
        self._rung = False

    def ring(self) -> None:
        """Say that something new is there."""
        callback = self._callback
        if callback is not None and not self._rung:
            self._rung = True
            callback()

    def answer(self) -> None:
        """Say that the consumer is about to look: what comes from now on rings again."""
        self._rung = False
