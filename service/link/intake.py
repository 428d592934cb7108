"""Everything the RTC sends, judged, counted and put where the consumer finds it."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import asdict
from statistics import median
from typing import Final

from service.errors import WireError
from service.estimation.frames import FrameBlock
from service.link.endpoint import Endpoint
from service.link.events import (
    AcknowledgementReceived,
    BasisMismatch,
    Bursts,
    EventQueue,
    IdsAdopted,
    LinkEvent,
    MalformedMessage,
    RtcAppeared,
    RtcVanished,
    SecondRtc,
    SessionChanged,
    StatusReceived,
    WrongShape,
)
from service.link.ring import FrameCounts, FrameRing
from service.link.sessions import SessionWatch
from service.link.statistics import LinkStatistics
from service.link.wakeup import Wakeup
from service.wire import (
    FRAMES_PER_BATCH,
    Acknowledgement,
    FrameBatch,
    FrameHeader,
    decode_frames,
    decode_status,
)

LATENCIES: Final = 1024
"""Batches the median latency is taken over."""

TAKE_FRAMES: Final = 256
"""Frames copied under one hold of the lock, so that ingest never waits for long."""


class Intake:
    """Takes what zenoh's threads bring; every method may be called from any thread."""

    def __init__(self, endpoint: Endpoint, clock: Callable[[], float] = time.monotonic) -> None:
        """Keep the settings; memory for frames is taken when the first batch tells their size.

        Parameters
        ----------
        endpoint
            Settings of the link.
        clock
            Monotonic seconds.
        """
        self._endpoint = endpoint
        self._clock = clock
        self._lock = threading.Lock()
        self._queue = EventQueue()
        self._bursts = Bursts()
        self._wakeup = Wakeup()
        self._sessions = SessionWatch()
        self._ring: FrameRing | None = None
        self._patience_s = endpoint.reorder_s
        self._basis_id: str | None = None
        self._config_id: str | None = None
        self._shape: tuple[int, int] | None = None
        self._counts = FrameCounts()
        self._tally: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._malformed: Counter[str] = Counter()
        self._rtc_alive = False
        self._last_frame_s: float | None = None
        self._latency_s: deque[float] = deque(maxlen=LATENCIES)

    def expect(self, basis_id: str | None, config_id: str | None) -> None:
        """Use only what names these; None: adopt the first one seen."""
        with self._lock:
            self._basis_id, self._config_id = basis_id, config_id

    def set_wakeup(self, callback: Callable[[], object] | None) -> None:
        """Call ``callback``, from zenoh's threads, when something new is there."""
        self._wakeup.connect(callback)

    def frames(
        self,
        payload: bytes,
        attachment: bytes | None,
        *,
        recoverable: bool = False,
        latency_s: float | None = None,
    ) -> None:
        """Take a batch of telemetry.

        Parameters
        ----------
        payload, attachment
            As they arrived.
        recoverable
            Whether zenoh may still bring what is missing before these frames.
        latency_s
            Put-to-callback, None when the publisher does not stamp its messages.

        Raises
        ------
        WireError
            If they break the contract.
        """
        batch = decode_frames(payload, attachment)
        now_s = self._clock()
        with self._lock:
            self._patience_s = (
                self._endpoint.recovery_s if recoverable else self._endpoint.reorder_s
            )
            if latency_s is not None:
                self._latency_s.append(latency_s)
            if self._belongs(batch.header, now_s):
                self._store(batch, now_s)
        self._wakeup.ring()

    def status(self, data: bytes) -> None:
        """Take the RTC's account of its loop.

        Raises
        ------
        WireError
            If it breaks the contract.
        """
        status = decode_status(data)
        now_s = self._clock()
        with self._lock:
            self._tally["statuses"] += 1
            if self._admit(status.session, now_s):
                self._expected(status.basis_id, status.config_id, now_s)
                self._shape = (status.n_slopes, status.n_modes)
                self._queue.put(StatusReceived(status=status))
        self._wakeup.ring()

    def acknowledgement(self, acknowledgement: Acknowledgement, *, known: bool) -> None:
        """Take the RTC's word on a reconstructor."""
        with self._lock:
            self._tally["acknowledgements"] += 1
            self._tally["unknown"] += not known
        self.event(AcknowledgementReceived(acknowledgement=acknowledgement, known=known))

    def liveliness(self, *, alive: bool) -> None:
        """Take the appearance or disappearance of the RTC's token."""
        with self._lock:
            self._rtc_alive = alive
        self.event(RtcAppeared() if alive else RtcVanished())

    def malformed(self, kind: str, error: WireError) -> None:
        """Count a message that was not used, and report the first of a burst."""
        with self._lock:
            self._malformed[kind] += 1
            due = self._bursts.opens(f"malformed {kind}", self._clock())
        if due:
            self.event(MalformedMessage(kind=kind, text=str(error)))

    def failed(self, kind: str) -> bool:
        """Count a fault of the service itself; return whether it is the first of a burst."""
        with self._lock:
            self._tally["failed"] += 1
            return self._bursts.opens(f"failed {kind}", self._clock())

    def event(self, event: LinkEvent) -> None:
        """Queue an event and wake the consumer."""
        self._queue.put(event)
        self._wakeup.ring()

    def drain(self) -> list[FrameBlock]:
        """Return copies of the frames that are due, in order; see :meth:`FrameRing.take`."""
        self._wakeup.answer()
        blocks: list[FrameBlock] = []
        while True:
            with self._lock:
                if self._ring is None:
                    return blocks
                more = self._ring.take(self._clock(), self._patience_s, TAKE_FRAMES)
                waiting = self._ring.due(self._clock(), self._patience_s)
            blocks += more
            if not waiting:
                return blocks

    def events(self) -> list[LinkEvent]:
        """Return what has happened since the last call, oldest first."""
        self._wakeup.answer()
        return self._queue.take()

    def statistics(self) -> LinkStatistics:
        """Return all counters as they are now."""
        with self._lock:
            latency, tally = list(self._latency_s), self._tally
            last, counts = self._last_frame_s, asdict(self._counts)
            return LinkStatistics(
                rtc_alive=self._rtc_alive,
                session=self._sessions.current,
                basis_id=self._basis_id,
                config_id=self._config_id,
                batches_received=tally["batches"],
                **{f"frames_{name}": value for name, value in counts.items()},
                frames_refused=dict(self._refused),
                messages_malformed=dict(self._malformed),
                statuses_received=tally["statuses"],
                acknowledgements_received=tally["acknowledgements"],
                acknowledgements_unknown=tally["unknown"],
                events_dropped=self._queue.dropped,
                callback_errors=tally["failed"],
                frame_age_s=None if last is None else self._clock() - last,
                latency_p50_s=median(latency) if latency else None,
            )

    def _belongs(self, header: FrameHeader, now_s: float) -> bool:
        """Return whether frames are of the session, basis, configuration and shape that count."""
        if not self._admit(header.session, now_s):
            self._refused["session"] += header.n
            return False
        wrong = self._expected(header.basis_id, header.config_id, now_s)
        wrong = wrong or self._misshapen(header, now_s)
        if wrong:
            self._refused[wrong] += header.n
        return not wrong

    def _misshapen(self, header: FrameHeader, now_s: float) -> str:
        """Return "shape" for frames of other sizes than the status says, else an empty string."""
        found = (header.n_slopes, header.n_modes)
        if self._shape is None or found == self._shape:
            return ""
        if self._bursts.opens("shape", now_s):
            self._queue.put(WrongShape(expected=self._shape, found=found))
        return "shape"

    def _store(self, batch: FrameBatch, now_s: float) -> None:
        header = batch.header
        self._tally["batches"] += 1
        self._last_frame_s = now_s
        if self._ring is None or not self._ring.fits(header):
            if self._ring is not None:
                self._counts.overwritten += self._ring.undelivered
            self._ring = FrameRing(header, self._capacity(header), self._counts)
        self._ring.store(batch, now_s)

    def _capacity(self, header: FrameHeader) -> int:
        row_bytes = 4 * (header.n_slopes + 2 * header.n_modes)
        wanted = int(self._endpoint.ring_seconds * 1e9 / header.dt_ns)
        return max(2 * FRAMES_PER_BATCH, min(wanted, self._endpoint.ring_bytes // row_bytes))

    def _admit(self, session: str, now_s: float) -> bool:
        current = self._sessions.current
        admission = self._sessions.admit(session, now_s)
        if admission.changed:
            self._shape = None
            self._queue.put(SessionChanged(old=admission.previous, new=session))
        if admission.second and current and self._bursts.opens("second", now_s):
            self._queue.put(SecondRtc(current=current, other=session))
        return admission.accepted

    def _expected(self, basis_id: str, config_id: str, now_s: float) -> str:
        """Return which id is not the expected one, or an empty string; adopt where none is."""
        if self._basis_id is None or self._config_id is None:
            self._basis_id = self._basis_id or basis_id
            self._config_id = self._config_id or config_id
            self._queue.put(IdsAdopted(basis_id=self._basis_id, config_id=self._config_id))
        expected = (self._basis_id, self._config_id)
        if (basis_id, config_id) == expected:
            return ""
        if self._bursts.opens("ids", now_s):
            self._queue.put(BasisMismatch(expected=expected, found=(basis_id, config_id)))
        return "basis" if basis_id != self._basis_id else "config"
