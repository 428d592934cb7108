"""Judge and count what the RTC sends, and queue it for the service."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from statistics import median
from typing import Final

from service import wire
from service.errors import WireError
from service.estimation.frames import FrameBlock
from service.link.leader_election import SessionWatch
from service.link.matrices import LinkEvent
from service.link.ring import FRAME_OUTCOMES, LEAP, FrameRing
from service.link.session import Endpoint
from service.link.statistics import (
    MALFORMED,
    MAX_AGE_S,
    USED,
    Counters,
    LinkStatistics,
    TelemetryAge,
)
from service.records import events as ev
from service.records.alarms import OTHER_BASIS, SECOND_RTC
from service.records.messages import compose
from service.records.state import Level

MAX_QUEUED_EVENTS: Final = 1024
"""Events kept; when more wait, the oldest are dropped and counted."""

COMPLAINT_INTERVAL_S: Final = 10.0
"""The same complaint is reported once in this time, however often it is counted."""

N_LATENCY_BATCHES: Final = 1024
"""Batches the median latency is taken over."""

FRAMES_PER_COPY: Final = 512
"""Frames copied under one hold of the lock, so that ingest never waits for long."""

MAX_UNDECODED_BATCHES: Final = 16
"""Batches that are kept undecoded until they are needed; decoding many in a row is far quicker."""

STATUS_INTERVAL_S: Final = 0.45
"""Interval between two statuses of the same content; of more frequent ones only the latest is used.
"""

MAX_CHANGED_STATUSES: Final = 10
"""Statuses that say something else each, which are taken within that time all the same."""

COALESCED: Final = "spared"
"""Outcome of a status that a later one made superfluous."""

OLD: Final = "old"
"""Outcome of frames that took too long to arrive."""

PLACEMENT_TEXTS: Final = {
    "duplicate": "they had come before",
    "late": "their place in the sequence had been passed",
    "nonfinite": "a slope or a command is not finite",
}
"""Outcomes of frames in the sequence other than being used, with their description."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Arrived:
    """A batch of telemetry, not decoded yet."""

    payload: bytes
    attachment: bytes | None
    recoverable: bool
    latency_s: float | None
    at_s: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Put:
    """An event that waits to be fetched."""

    event: LinkEvent
    ring: FrameRing | None
    """Ring with the frames of that time; None if there were none."""

    end: int
    """Frames before this one came before it."""


class Intake:
    """Takes what zenoh's threads bring; every method may be called from any thread."""

    def __init__(self, endpoint: Endpoint, clock: Callable[[], float] = time.monotonic) -> None:
        """Keep the settings; memory for frames is allocated with the first batch.

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
        self._events: deque[_Put] = deque(maxlen=MAX_QUEUED_EVENTS)
        self._callback: Callable[[], object] | None = None
        self._rung = False
        self._rings_for_frames = True
        self._arrived: deque[_Arrived] = deque()
        self._complained_s: dict[str, float] = {}
        self._sessions = SessionWatch()
        self._ring: FrameRing | None = None
        self._patience_s = endpoint.reorder_s
        self._basis_id: str | None = None
        self._config_id: str | None = None
        self._may_rename = True
        self._modes: Collection[str] = ()
        self._shape: tuple[int, int] | None = None
        self._counts: Counter[str] = Counter()
        self._counted: Counter[str] = Counter()
        self._counters = Counters()
        self._rtc_alive = False
        self._begun_s = clock()
        self._last_frame_s: float | None = None
        self._last_status_s: float | None = None
        self._essentials: tuple[object, ...] = ()
        self._changes = 0
        self._coalesced: bytes | None = None
        self._latency_s: deque[float] = deque(maxlen=N_LATENCY_BATCHES)
        self._age = TelemetryAge()

    def expect(
        self, basis_id: str | None, config_id: str | None, modes: Collection[str] = ()
    ) -> None:
        """Use only what names these; None: adopt the first one seen.

        ``modes`` are configurations that the RTC may change between. Without them, and without a
        ``config_id``, an RTC may have another one for each set of reference slopes.
        """
        with self._up_to_date():
            self._basis_id, self._config_id, self._modes = basis_id, config_id, modes
            self._may_rename = config_id is None and not modes

    def set_wakeup(self, callback: Callable[[], object] | None, *, for_frames: bool = True) -> None:
        """Call ``callback``, from zenoh's threads, when something new is there."""
        self._callback, self._rung, self._rings_for_frames = callback, False, for_frames

    def _wake(self) -> None:
        """Say that something new is there, at most once between two visits of the consumer."""
        callback = self._callback
        if callback is not None and not self._rung:
            # The consumer resets it when it visits. A message in between needs no second call
            # across threads.
            self._rung = True
            callback()

    def frames(
        self,
        payload: bytes,
        attachment: bytes | None,
        *,
        recoverable: bool = False,
        latency_s: float | None = None,
    ) -> None:
        """Take a batch of telemetry; it is checked when the consumer drains.

        Parameters
        ----------
        payload, attachment
            As they arrived.
        recoverable
            Whether zenoh may still bring what is missing before these frames.
        latency_s
            Put-to-callback, None when the publisher does not stamp its messages.
        """
        # Without the lock: zenoh's thread must not wait while frames are copied. A deque appends
        # atomically.
        self._arrived.append(
            _Arrived(
                payload=payload,
                attachment=attachment,
                recoverable=recoverable,
                latency_s=latency_s,
                at_s=self._clock(),
            )
        )
        # Decoding many batches in a row is faster, but zenoh's thread must not fall behind.
        if len(self._arrived) >= MAX_UNDECODED_BATCHES:
            with self._up_to_date():
                pass
        if self._rings_for_frames:
            self._wake()

    @contextlib.contextmanager
    def _up_to_date(self) -> Iterator[None]:
        """Hold the lock, all frames that have come in their places."""
        with self._lock:
            while self._arrived:
                # Under the lock, so that batches are placed in the order of arrival, whichever
                # thread decodes them.
                arrived = self._arrived.popleft()
                try:
                    self._take_frames(arrived)
                except WireError as error:
                    self._complain("frames", error, arrived.at_s)
            yield

    def _take_frames(self, arrived: _Arrived) -> None:
        batch = wire.decode_frames(arrived.payload, arrived.attachment)
        endpoint = self._endpoint
        # Missing frames that zenoh can recover are requested again, which takes longer than
        # reordering.
        self._patience_s = endpoint.recovery_s if arrived.recoverable else endpoint.reorder_s
        if arrived.latency_s is not None:
            self._latency_s.append(arrived.latency_s)
        if self._belongs(batch.header, arrived.at_s):
            self._store(batch, arrived.at_s, arrived.latency_s)

    def status(self, data: bytes) -> None:
        """Take the RTC's account of its loop; of a flood of them as many as are of use.

        Raises
        ------
        WireError
            If it breaks the contract.
        """
        found = wire.essentials(data)
        now_s = self._clock()
        with self._lock:
            if self._superfluous(found, now_s):
                # Kept and not dropped: if the flood ends here, it is the RTC's last word.
                self._coalesced = data
                self._counters.add("status", COALESCED, 1, now_s)
                return
            # This status is newer than the one that was put aside.
            self._coalesced = None
        self._take_status(data, found)
        self._wake()

    def _superfluous(self, found: tuple[object, ...], now_s: float) -> bool:
        """Return whether a status may give way to the next one."""
        last_s = self._last_status_s
        if last_s is None or now_s - last_s >= STATUS_INTERVAL_S:
            self._changes = 0
            return False
        if found == self._essentials:
            return True
        self._changes += 1
        return self._changes > MAX_CHANGED_STATUSES

    def _take_status(self, data: bytes, found: tuple[object, ...]) -> None:
        status = wire.decode(wire.Status, data)
        now_s = self._clock()
        with self._up_to_date():
            if not self._admit("status", status.session, 1, now_s):
                return
            self._counters.add("status", USED, 1, now_s)
            self._essentials = found
            self._last_status_s = now_s
            self._age.add_status(status, now_s)
            self._check_ids(status, now_s)
            self._shape = (status.n_slopes, status.n_modes)
            self._put(status)

    def acknowledgement(self, acknowledgement: wire.Acknowledgement, *, known: bool) -> None:
        """Take the RTC's word on a reconstructor."""
        # Events keep the order in which the RTC sent them.
        self._take_coalesced(at_once=True)
        now_s = self._clock()
        with self._up_to_date():
            self._counted["unknown"] += not known
            if self._admit("ack", acknowledgement.session, 1, now_s):
                self._counters.add("ack", USED, 1, now_s)
                self._put(acknowledgement)
        self._wake()

    def liveliness(self, *, alive: bool) -> None:
        """Take the appearance or disappearance of the RTC's token."""
        self._take_coalesced(at_once=True)
        with self._up_to_date():
            self._rtc_alive = alive
            if not alive:
                self._sessions.leave()
                # A connection of its own, perhaps of another machine, has other delays.
                self._age = TelemetryAge()
        appeared = ev.LogEvent(name="rtc.appeared", text="the RTC is there")
        self.event(appeared if alive else ev.RtcVanished())

    def malformed(self, kind: str, error: WireError) -> None:
        """Count a message that was not used, and report the first of a burst."""
        with self._up_to_date():
            self._complain(kind, error, self._clock())
        self._wake()

    def _complain(self, kind: str, error: WireError, now_s: float) -> None:
        self._counters.add(kind, MALFORMED, 1, now_s, str(error))
        if self._is_new(f"malformed {kind}", now_s):
            text = compose("message.broken", kind, error=str(error))
            self._put(ev.LogEvent(name="message.malformed", text=text, level=Level.WARNING))

    def failed(self, kind: str) -> bool:
        """Count a fault of the service itself; return whether it is the first of a burst."""
        with self._lock:
            self._counted["failed"] += 1
            return self._is_new(f"failed {kind}", self._clock())

    def event(self, event: LinkEvent) -> None:
        """Queue an event and wake the consumer."""
        self._take_coalesced(at_once=True)
        with self._up_to_date():
            self._put(event)
        self._wake()

    def _put(self, event: LinkEvent) -> None:
        # The deque drops its oldest event silently.
        self._counted["dropped"] += len(self._events) == MAX_QUEUED_EVENTS
        ring = self._ring
        # The position in the ring orders the event among the frames: see ``drain``.
        self._events.append(_Put(event=event, ring=ring, end=0 if ring is None else ring.head))

    def _is_new(self, complaint: str, now_s: float) -> bool:
        """Return whether a complaint is the first of a burst of equal ones."""
        if now_s - self._complained_s.get(complaint, -math.inf) < COMPLAINT_INTERVAL_S:
            return False
        # Expired complaints are forgotten here, because their texts name sessions and ids of any
        # sender.
        recent = {
            kind: s for kind, s in self._complained_s.items() if now_s - s < COMPLAINT_INTERVAL_S
        }
        self._complained_s = recent | {complaint: now_s}
        return True

    def drain(self, *, before_events: bool = False) -> list[FrameBlock]:
        """Return copies of the frames that are due, in order; see :meth:`FrameRing.take`.

        With ``before_events``, only those that arrived before the oldest pending event. The event
        does not apply to them: it may be the end of the dither that they contain.
        """
        self._rung = False
        blocks: list[FrameBlock] = []
        while True:
            with self._up_to_date():
                ring, end = self._ring, None
                if before_events and self._events:
                    first = self._events[0]
                    # A new ring means a new session or new sizes: its frames came after the event.
                    ring, end = (ring, first.end) if first.ring is ring else (None, None)
                if ring is None:
                    return blocks
                # The lock is released between two copies, so that zenoh's threads can store frames
                # meanwhile.
                more = ring.take(self._clock(), self._patience_s, FRAMES_PER_COPY, end)
                waiting = ring.due(self._clock(), self._patience_s, end)
            blocks += more
            if not waiting:
                return blocks

    def events(self) -> list[LinkEvent]:
        """Return what has happened since the last call, oldest first."""
        self._rung = False
        self._take_coalesced()
        with self._up_to_date():
            events = [put.event for put in self._events]
            self._events.clear()
        return events

    def _take_coalesced(self, *, at_once: bool = False) -> None:
        """Process the last of a flood of statuses once it is due, or before the RTC's next message.

        A status older than the last acknowledgement, or than the end of the session, would revert
        the state.
        """
        with self._lock:
            data, last_s = self._coalesced, self._last_status_s
            due = at_once or (last_s or 0.0) + STATUS_INTERVAL_S <= self._clock()
            if data is None or not due:
                return
            self._coalesced, self._changes = None, 0
        try:
            self._take_status(data, wire.essentials(data))
        except WireError as error:
            self.malformed("status", error)

    @property
    def other_session(self) -> str | None:
        """A session that spoke after the last word of the one that counts, or None."""
        with self._up_to_date():
            return self._sessions.other

    def statistics(self) -> LinkStatistics:
        """Return all counters as they are now."""
        with self._up_to_date():
            now_s, tally = self._clock(), self._counters
            malformed = {k: n for (k, fate), n in tally.totals.items() if fate == MALFORMED}
            return LinkStatistics(
                rtc_alive=self._rtc_alive,
                session=self._sessions.current,
                basis_id=self._basis_id,
                config_id=self._config_id,
                batches_received=self._counted["batches"],
                **{f"frames_{name}": self._counts[name] for name in FRAME_OUTCOMES},
                frames_refused=tally.of("frames", but=(USED, MALFORMED, *PLACEMENT_TEXTS)),
                messages_malformed=malformed,
                statuses_received=sum(tally.of("status", but=(MALFORMED,)).values()),
                acknowledgements_received=sum(tally.of("ack", but=(MALFORMED,)).values()),
                acknowledgements_unknown=self._counted["unknown"],
                events_dropped=self._counted["dropped"],
                callback_errors=self._counted["failed"],
                missing="",
                waiting_connections={},
                frame_age_s=_age_s(self._last_frame_s, now_s),
                telemetry_age_s=self._age.age_s,
                dispositions=tally.dispositions(now_s),
                status_age_s=_age_s(self._last_status_s, now_s),
                session_age_s=now_s - self._begun_s,
                session_waiting=self._sessions.waiting(now_s),
                refusals=(),
                ending_certificates=(),
                latency_p50_s=median(self._latency_s) if self._latency_s else None,
            )

    def _belongs(self, header: wire.FrameHeader, now_s: float) -> bool:
        """Return whether frames are of the session, basis, configuration and shape that count."""
        if not self._admit("frames", header.session, header.n, now_s):
            return False
        wrong = self._check_ids(header, now_s) or self._check_shape(header)
        if wrong:
            reason, text = wrong
            self._counters.add("frames", reason, header.n, now_s, text)
        return not wrong

    def _check_shape(self, header: wire.FrameHeader) -> tuple[str, str] | None:
        """Return why frames are not of the sizes that the status says; None: they are."""
        found, expected = (header.n_slopes, header.n_modes), self._shape
        if expected is None or found == expected:
            return None
        return "shape", (
            f"{found[0]} slopes and {found[1]} modes, expected {expected[0]} and {expected[1]} as "
            "the RTC's status says"
        )

    def _store(self, batch: wire.FrameBatch, now_s: float, latency_s: float | None) -> None:
        header = batch.header
        self._counted["batches"] += 1
        self._last_frame_s = now_s
        if self._ring is None or not self._ring.fits(header):
            if self._ring is not None:
                # Undelivered frames of the previous session are lost with their ring, but counted.
                self._counts["overwritten"] += self._ring.undelivered
            self._ring = FrameRing(header, self._capacity(header), self._counts)
        batches, wrong = [batch], self._ring.why_not(header)
        if wrong is not None:
            reason, text = wrong
            # A single wrong number must not make all later frames late: a leap counts only when
            # more batches continue from it (docs/decisions/0031-sessions-and-services.md).
            batches = self._ring.leapt(batch) if reason == LEAP else []
            if not batches:
                self._counters.add("frames", reason, header.n, now_s, text)
        for each in batches:
            age_s = self._age.add_frames(each.header, now_s, latency_s)
            if age_s > MAX_AGE_S:
                self._ring.skip(each.header, now_s)
                self._counters.add("frames", OLD, each.header.n, now_s, f"{age_s:.1f} s old")
            else:
                self._place(self._ring, each, now_s)

    def _place(self, ring: FrameRing, batch: wire.FrameBatch, now_s: float) -> None:
        """Put frames in their places, and count what became of them."""
        counts = self._counts
        before = counts.copy()
        ring.store(batch, now_s)
        self._counters.add("frames", USED, counts["received"] - before["received"], now_s)
        for name, text in PLACEMENT_TEXTS.items():
            self._counters.add("frames", name, counts[name] - before[name], now_s, text)

    def _capacity(self, header: wire.FrameHeader) -> int:
        # Dither columns included, although they come only while a dither plays.
        row_bytes = 4 * (header.n_slopes + 2 * header.n_modes)
        wanted = int(self._endpoint.ring_seconds * 1e9 / header.dt_ns)
        # At least two batches, or a single one would overwrite itself, whatever the limit on
        # memory.
        return max(2 * wire.FRAMES_PER_BATCH, min(wanted, self._endpoint.ring_bytes // row_bytes))

    def _admit(self, kind: str, session: str, n: int, now_s: float) -> bool:
        """Return whether ``n`` of a kind are of the session that counts, or count them."""
        current = self._sessions.current
        admission = self._sessions.admit(session, now_s)
        if admission.changed:
            # A new session may have other sizes; its first status says them.
            self._shape, self._begun_s = None, now_s
            # The first status of a session is never superfluous.
            self._last_status_s, self._essentials = None, ()
            self._counters.begin()
            self._put(ev.SessionStarted(session=session))
        if not admission.accepted:
            text = f"session {session}, while session {current} sends"
            self._counters.add(kind, "session", n, now_s, text)
        rival = admission.other_session
        if rival is not None and current and self._is_new(f"second {rival}", now_s):
            trouble = f"two RTCs send at once, sessions {current} and {rival}: stop one of them"
            self._put(ev.ConditionChanged(name=SECOND_RTC, text=trouble))
        return admission.accepted

    def _check_ids(
        self, message: wire.FrameHeader | wire.Status, now_s: float
    ) -> tuple[str, str] | None:
        """Return which id is not the expected one, None: both are; adopt where none is."""
        basis_id, config_id = message.basis_id, message.config_id
        if self._basis_id is None or self._config_id is None:
            self._basis_id = self._basis_id or basis_id
            self._config_id = self._config_id or config_id
            text = f"basis {self._basis_id}, configuration {self._config_id}"
            self._put(ev.LogEvent(name="ids.adopted", text=text))
        # The RTC may change the sensor's mode during a session; all modes of the instrument file
        # are expected. An RTC of version 1 may have named its reference slopes by this id: with
        # other sizes it is another sensor, and else the tracker decides (``tracking/rtc.py``).
        same_sizes = self._shape in {None, (message.n_slopes, message.n_modes)}
        known = config_id in self._modes or (self._may_rename and same_sizes)
        if basis_id == self._basis_id and known:
            self._config_id = config_id
        expected, found = (self._basis_id, self._config_id), (basis_id, config_id)
        if found == expected:
            return None
        if self._is_new("ids", now_s):
            text = (
                f"the RTC's basis and configuration are {' and '.join(found)}, expected "
                f"{' and '.join(expected)}: no estimate, no publication until they agree"
            )
            if self._modes and config_id not in self._modes:
                text += (
                    f"; the instrument file has the modes {', '.join(self._modes)}: set the RTC to "
                    f"one of them, or add [[wfs.mode]] config_id = {config_id!r} to the file"
                )
            self._put(ev.ConditionChanged(name=OTHER_BASIS, text=text))
        which = "basis" if basis_id != self._basis_id else "config"
        return which, f"{' and '.join(found)}, expected {' and '.join(expected)}"


def _age_s(then_s: float | None, now_s: float) -> float | None:
    return None if then_s is None else now_s - then_s
