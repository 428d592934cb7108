"""Telemetry and status out, commands and reconstructors in.

One thread publishes, another looks after reconstructors; the loop only drops batches into a
bounded queue. The service may come before, after or in the middle.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np
import structlog
from typing_extensions import override

from pyrcal.rtc.background import Background
from pyrcal.rtc.link import STATUS_PERIOD_S, RtcConnection, RtcLink
from service.files.recording import RecordedKind, RecordingWriter
from service.wire import encode, split
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.telemetry import Batch, FrameClock, frames_of
from sim_rtc.faults import FaultPlan, WireFaults
from sim_rtc.link.matrices import FaultyMatrices
from sim_rtc.options import Options
from sim_rtc.telescope.detector import Detector

_log = structlog.get_logger("sim_rtc")

_BACKLOG_S = 1.0
"""Telemetry that may wait for the publishing thread, seconds. Beyond it the oldest is dropped and
counted."""


class Link(Background):
    """Connects a computer to the service for as long as the ``with`` block lasts."""

    def __init__(
        self,
        computer: RealTimeComputer,
        options: Options,
        detector: Detector,
        *,
        clock: FrameClock,
        plan: FaultPlan,
        recorder: RecordingWriter | None = None,
    ) -> None:
        """Take the plan of faults, and the recorder of everything sent."""
        super().__init__("link")
        self._plan = plan
        self._recorder = recorder
        self._faults = WireFaults(plan, np.random.default_rng(options.seed))
        self._absent = threading.Event()
        self._recorded_cm_id: str | None = None
        self._computer = computer
        self._options = options
        self._clock = clock
        self._detector = detector
        self._backlog: deque[tuple[Batch, int, float]] = deque()
        """Batches, when their first exposure ended, nanoseconds, and at what loop time."""
        self._ready = threading.Condition()
        self._dropped = 0

    @override
    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        with self._ready:
            self._ready.notify()
        super().__exit__()

    @property
    def n_dropped_frames(self) -> int:
        """Frames that were never published: the thread was behind, or there was no service yet."""
        return self._dropped

    def offer(self, batch: Batch) -> None:
        """Queue a batch for publication; never waits."""
        with self._ready:
            if len(self._backlog) * len(batch.slopes) * self._clock.dt_ns >= _BACKLOG_S * 1e9:
                self._dropped += len(self._backlog.popleft()[0].slopes)
            # Now, in the loop's thread: a fault may step the clock before the batch is sent.
            t0_ns = self._clock.end_of_exposure_ns(batch.seq0)
            self._backlog.append((batch, t0_ns, self._plan.now_s))
            self._ready.notify()

    @contextmanager
    def absence(self) -> Iterator[None]:
        """Withdraw the liveliness token and send no status while the ``with`` block lasts."""
        self._absent.set()
        try:
            yield
        finally:
            self._absent.clear()

    @override
    def _work(self) -> None:
        connection = RtcConnection(
            self._computer,
            self._options.router,
            batches_per_s=self._options.frame_rate_hz / self._computer.batch_frames,
            matrices=partial(FaultyMatrices, plan=self._plan, recorder=self._recorder),
            on_token=lambda visible: self._record(RecordedKind.LIVELINESS, bytes([visible])),
        )
        while not self._stopped.is_set():
            with connection.open(self._stopped) as link:
                if link is not None:
                    self._publish(link)

    def _publish(self, link: RtcLink) -> None:
        """Publish telemetry and status until the link is lost or the program ends."""
        endpoint, system = self._options.router.endpoint, self._computer.identity.system
        _log.info("link.open", endpoint=endpoint, system=system)
        with self._ready:
            # Frames that waited for a service are old: they would arrive as one burst.
            self._backlog.clear()
        next_status_s = 0.0
        while not self._stopped.is_set():
            outgoing = self._next()
            if outgoing is not None:
                batch, t0_ns, time_s = outgoing
                self._note_matrix(batch.cm_id)
                header, rows = frames_of(batch, t0_ns, self._clock.dt_ns)
                for payload, attachment in self._faults.messages(header, rows, time_s):
                    link.publish_encoded_frames(payload, attachment)
                    self._record(RecordedKind.FRAMES, payload, attachment)
            if self._computer.has_news:
                link.report_matrices()
            link.token.show(visible=not self._absent.is_set())
            now_s = time.monotonic()
            if now_s >= next_status_s and not self._absent.is_set():
                data = self._status()
                link.publish_encoded_status(data)
                self._record(RecordedKind.STATUS, data)
                next_status_s = now_s + STATUS_PERIOD_S
                if link.is_lost():
                    return

    def _note_matrix(self, cm_id: str) -> None:
        """Record a matrix when the first frames that it multiplies are sent."""
        if self._recorder is None or cm_id == self._recorded_cm_id:
            return
        self._recorded_cm_id = cm_id
        active = self._computer.reconstructor
        matrix = b"".join(split(active.matrix, active.manifest.layout.chunk_bytes))
        self._record(RecordedKind.MATRIX, matrix, encode(active.manifest))

    def _record(self, kind: RecordedKind, payload: bytes, attachment: bytes = b"") -> None:
        if self._recorder is not None:
            self._recorder.put(kind, payload, attachment)

    def _next(self) -> tuple[Batch, int, float] | None:
        with self._ready:
            if not self._backlog:
                # Shorter than the period of the status, which is sent without frames, too.
                self._ready.wait(STATUS_PERIOD_S / 2)
            return self._backlog.popleft() if self._backlog else None

    def _status(self) -> bytes:
        time_s = self._plan.now_s
        status = self._clock.stamp_status(self._computer.status())
        return encode(
            replace(
                status,
                basis_id=self._faults.basis_id(status.basis_id, time_s),
                magnitude=self._options.magnitude,
                flux=self._detector.flux(self._computer.images),
                pointing=self._options.elevation.at(time_s),
            )
        )
