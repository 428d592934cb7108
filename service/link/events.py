"""What the link reports besides frames, the bounded queue it waits in, and who is woken by it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.wire import Acknowledgement, MeasuredManifest, Status

QUEUE_LENGTH: Final = 1024
"""Events kept; when more wait, the oldest are dropped and counted."""

BURST_S: Final = 10.0
"""The same complaint is reported once in this time, however often it is counted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusReceived:
    """The RTC's account of its loop."""

    status: Status


@dataclass(frozen=True, slots=True, kw_only=True)
class AcknowledgementReceived:
    """The RTC's word on a reconstructor."""

    acknowledgement: Acknowledgement
    known: bool
    """Whether this process has published or offered a matrix of that id."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionChanged:
    """The RTC starts over: windows, pending commands and staged matrices are void."""

    old: str | None
    """None: the first session seen."""

    new: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RtcAppeared:
    """The RTC's liveliness token is there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RtcVanished:
    """The RTC's liveliness token is gone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondRtc:
    """Two sessions send at the same time: one RTC too many in this system."""

    current: str
    other: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ServicesChanged:
    """Other services of this system came or went, or who drives has changed."""

    drives: bool
    """Whether this service drives the RTC."""

    others: tuple[str, ...]
    """The others, the first one first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IdsAdopted:
    """Nothing was pinned, so the first basis and configuration seen are expected from now on."""

    basis_id: str
    config_id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class BasisMismatch:
    """The RTC works with another basis or sensor configuration than expected."""

    expected: tuple[str, str]
    """Basis and configuration."""

    found: tuple[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class MalformedMessage:
    """A message that broke the contract and was not used; one event for a burst of them."""

    kind: str
    """frames, status, ack, im, reply."""

    text: str
    """What was found and what was expected."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredMatrix:
    """An interaction matrix the RTC has measured, or why it could not."""

    manifest: MeasuredManifest
    matrix: NDArray[np.float32] | None
    """``(n_slopes, n_modes_measured)``, slope per metre OPD; None: see the manifest's reason."""


LinkEvent = (
    StatusReceived
    | AcknowledgementReceived
    | SessionChanged
    | RtcAppeared
    | RtcVanished
    | SecondRtc
    | ServicesChanged
    | IdsAdopted
    | BasisMismatch
    | MalformedMessage
    | MeasuredMatrix
)


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
