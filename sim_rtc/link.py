"""The RTC's side of the wire: telemetry and status out, commands and reconstructors in.

One thread publishes, another looks after reconstructors; the loop only drops batches into a
bounded queue. The service may come before, after or in the middle.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import structlog
import zenoh
import zenoh.ext
from numpy.typing import NDArray

from service.errors import WireError
from service.wire import (
    CommandKind,
    Encodings,
    FrameHeader,
    Keys,
    Reply,
    Role,
    Status,
    command_id,
    decode_command,
    encode_manifest,
    encode_reply,
    encode_status,
    split,
)
from sim_rtc.clock import FrameClock
from sim_rtc.computer import RealTimeComputer
from sim_rtc.desk import CommandDesk
from sim_rtc.detector import Detector
from sim_rtc.faults import FaultPlan
from sim_rtc.feed import BATCH_FRAMES
from sim_rtc.intake import Intake
from sim_rtc.outlet import Outlet
from sim_rtc.record import Kind, Recorder
from sim_rtc.telemetry import Batch
from sim_rtc.wire_faults import WireFaults

_OPEN_TIMEOUT_MS = 1000
_LEASE_MS = 2000
_WAIT_BEFORE_DROP_US = 20_000
_QUEUED_MESSAGES = 16
_RETRY = {"period_init_ms": 200, "period_increase_factor": 1.5, "period_max_ms": 1000}
_CACHE_S = 5.0
_HEARTBEAT_S = 0.2
_STATUS_PERIOD_S = 0.2
_BACKLOG_BATCHES = 100
"""Batches that wait for the publishing thread; beyond it the oldest is dropped and counted."""

_log = structlog.get_logger("sim_rtc")


def client_config(endpoint: str) -> zenoh.Config:
    """Return the settings of a zenoh client of the service's router, as the wire page asks."""
    settings: dict[str, object] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": _OPEN_TIMEOUT_MS,
        "connect/retry": _RETRY,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        "transport/link/tx/queue/size/data": _QUEUED_MESSAGES,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _WAIT_BEFORE_DROP_US,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def frames_publisher(
    session: zenoh.Session, keys: Keys, batches_per_s: float
) -> zenoh.ext.AdvancedPublisher:
    """Return the publisher of telemetry: what the service missed it can ask for again."""
    return zenoh.ext.declare_advanced_publisher(
        session,
        keys.frames,
        encoding=Encodings.FRAMES,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA,
        cache=zenoh.ext.CacheConfig(math.ceil(_CACHE_S * batches_per_s)),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(
            heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None
        ),
        publisher_detection=True,
    )


def status_publisher(session: zenoh.Session, keys: Keys) -> zenoh.Publisher:
    """Return the publisher of status messages."""
    return session.declare_publisher(
        keys.status,
        encoding=Encodings.STATUS,
        congestion_control=zenoh.CongestionControl.DROP,
    )


class Token:
    """The RTC's liveliness token, which may go and come back while the ``with`` block lasts."""

    def __init__(self, session: zenoh.Session, keys: Keys, recorder: Recorder | None) -> None:
        self._session = session
        self._key = keys.alive(Role.RTC)
        self._recorder = recorder
        self._token: zenoh.LivelinessToken | None = None

    def __enter__(self) -> Token:
        self.show(visible=True)
        return self

    def __exit__(self, *_: object) -> None:
        self.show(visible=False)

    def show(self, *, visible: bool) -> None:
        """Declare or withdraw the token, unless that is how it is."""
        if visible is (self._token is not None):
            return
        if self._recorder is not None:
            self._recorder.put(Kind.LIVELINESS, bytes([visible]))
        if self._token is None:
            self._token = self._session.liveliness().declare_token(self._key)
        else:
            self._token.undeclare()  # type: ignore[no-untyped-call]
            self._token = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Rehearsal:
    """What is done to the link on request."""

    plan: FaultPlan
    """Faults."""

    recorder: Recorder | None = None
    """Where everything that is sent is written, too."""

    seed: int | None = None
    """Of the faults' randomness."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Outgoing:
    """A batch that waits to be published."""

    batch: Batch
    t0_ns: int
    time_s: float
    """Loop time."""


class Link:
    """Connects a computer to the service for as long as the ``with`` block lasts."""

    def __init__(
        self,
        computer: RealTimeComputer,
        *,
        endpoint: str,
        clock: FrameClock,
        detector: Detector,
        magnitude: float,
        rehearsal: Rehearsal | None = None,
    ) -> None:
        rehearsal = rehearsal or Rehearsal(plan=FaultPlan())
        self._plan = rehearsal.plan
        self._recorder = rehearsal.recorder
        self._faults = WireFaults(self._plan, np.random.default_rng(rehearsal.seed))
        self._absent = threading.Event()
        self._recorded_cm_id: str | None = None
        self._computer = computer
        self._endpoint = endpoint
        self._clock = clock
        self._detector = detector
        self._magnitude = magnitude
        self._keys = Keys(computer.identity.system)
        self._desk = CommandDesk(computer.execute)
        self._backlog: deque[_Outgoing] = deque()
        self._ready = threading.Condition()
        self._stopped = threading.Event()
        self._dropped = 0
        self._thread = threading.Thread(target=self._run, name="link", daemon=True)

    def __enter__(self) -> Link:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        with self._ready:
            self._ready.notify()
        self._thread.join()

    @property
    def n_dropped_batches(self) -> int:
        """Batches that were never published: the thread was behind, or there was no service yet."""
        return self._dropped

    def offer(self, batch: Batch) -> None:
        """Queue a batch for publication; never waits."""
        with self._ready:
            if len(self._backlog) >= _BACKLOG_BATCHES:
                self._backlog.popleft()
                self._dropped += 1
            self._backlog.append(
                _Outgoing(
                    batch=batch,
                    t0_ns=self._clock.end_of_exposure_ns(batch.seq0),
                    time_s=self._plan.now_s,
                )
            )
            self._ready.notify()

    @contextmanager
    def absence(self) -> Iterator[None]:
        """Withdraw the liveliness token and send no status while the ``with`` block lasts."""
        self._absent.set()
        try:
            yield
        finally:
            self._absent.clear()

    def _run(self) -> None:
        session = self._open()
        if session is None:
            return
        with session:
            self._declare_queryables(session)
            with self._ready:
                # What has waited for a service is old: it would only arrive as a burst.
                self._backlog.clear()
            with (
                Intake(
                    session,
                    self._keys,
                    self._computer,
                    plan=self._plan,
                    recorder=self._recorder,
                ),
                Outlet(session, self._keys, self._computer),
                Token(session, self._keys, self._recorder) as token,
            ):
                _log.info("link.open", endpoint=self._endpoint, system=self._keys.system)
                self._publish(session, token)

    def _open(self) -> zenoh.Session | None:
        """Open the session, waiting for the service's router for as long as it takes."""
        waiting = False
        while not self._stopped.is_set():
            try:
                return zenoh.open(client_config(self._endpoint))
            except zenoh.ZError:
                if not waiting:
                    _log.warning("link.waiting", endpoint=self._endpoint)
                waiting = True
                self._stopped.wait(_RETRY["period_init_ms"] / 1000)
        return None

    def _publish(self, session: zenoh.Session, token: Token) -> None:
        rate_hz = 1e9 / self._clock.dt_ns
        frames = frames_publisher(session, self._keys, rate_hz / BATCH_FRAMES)
        status = status_publisher(session, self._keys)
        next_status_s = 0.0
        while not self._stopped.is_set():
            outgoing = self._next()
            if outgoing is not None:
                self._note_matrix(outgoing.batch.cm_id)
                header, rows = self._frames(outgoing)
                for payload, attachment in self._faults.messages(header, rows, outgoing.time_s):
                    frames.put(payload, attachment=attachment)
                    self._record(Kind.FRAMES, payload, attachment)
            token.show(visible=not self._absent.is_set())
            now_s = time.monotonic()
            if now_s >= next_status_s and not self._absent.is_set():
                data = encode_status(self._status())
                status.put(data)
                self._record(Kind.STATUS, data)
                next_status_s = now_s + _STATUS_PERIOD_S

    def _note_matrix(self, cm_id: str) -> None:
        """Record a matrix when the first frames that it multiplies are sent."""
        if self._recorder is None or cm_id == self._recorded_cm_id:
            return
        self._recorded_cm_id = cm_id
        active = self._computer.snapshot().reconstructor
        matrix = b"".join(split(active.matrix, active.manifest.layout.chunk_bytes))
        self._record(Kind.MATRIX, matrix, encode_manifest(active.manifest))

    def _record(self, kind: Kind, payload: bytes, attachment: bytes = b"") -> None:
        if self._recorder is not None:
            self._recorder.put(kind, payload, attachment)

    def _next(self) -> _Outgoing | None:
        with self._ready:
            if not self._backlog:
                self._ready.wait(_STATUS_PERIOD_S / 2)
            return self._backlog.popleft() if self._backlog else None

    def _frames(self, outgoing: _Outgoing) -> tuple[FrameHeader, NDArray[np.float32]]:
        batch = outgoing.batch
        columns = [batch.slopes, batch.commands_m]
        if batch.dither_m is not None:
            columns.append(batch.dither_m)
        header = FrameHeader(
            session=batch.session,
            seq0=batch.seq0,
            n=len(batch.slopes),
            t0_ns=outgoing.t0_ns,
            dt_ns=self._clock.dt_ns,
            n_slopes=batch.slopes.shape[1],
            n_modes=batch.commands_m.shape[1],
            dither=batch.dither_m is not None,
            cm_id=batch.cm_id,
            basis_id=self._computer.identity.basis_id,
            config_id=self._computer.identity.config_id,
        )
        return header, np.hstack(columns)

    def _status(self) -> Status:
        snapshot = self._computer.snapshot()
        settings, manifest = snapshot.settings, snapshot.reconstructor.manifest
        return Status(
            session=snapshot.session,
            seq=snapshot.seq,
            t_ns=self._clock.end_of_exposure_ns(snapshot.seq),
            loop=snapshot.loop,
            frame_rate_hz=settings.frame_rate_hz,
            delay_frames=float(settings.delay_frames),
            gains=snapshot.gains,
            leak=settings.leak,
            n_slopes=manifest.layout.shape[1],
            n_modes=len(snapshot.gains),
            n_controlled=manifest.layout.shape[0],
            cm_id=manifest.id,
            basis_id=self._faults.basis_id(self._computer.identity.basis_id, self._plan.now_s),
            config_id=self._computer.identity.config_id,
            dither=snapshot.dither,
            max_dither_m=snapshot.limits.largest_m,
            max_dither_modes=snapshot.limits.most_modes,
            magnitude=self._magnitude,
            flux=self._detector.counts(snapshot.images).astype("<f4").tobytes(),
        )

    def _declare_queryables(self, session: zenoh.Session) -> None:
        for kind in CommandKind:
            session.declare_queryable(self._keys.command(kind), self._answering(kind))
        session.declare_queryable(self._keys.applied, self._answer_applied)

    def _answering(self, kind: CommandKind) -> Callable[[zenoh.Query], None]:
        def answer(query: zenoh.Query) -> None:
            with query:
                data = b"" if query.payload is None else query.payload.to_bytes()
                try:
                    reply = self._desk.handle(decode_command(kind, data), time.monotonic())
                except WireError as error:
                    reply = Reply(
                        id=command_id(data), accepted=False, reason=str(error), start_seq=None
                    )
                _log.info(
                    "command",
                    kind=str(kind),
                    id=reply.id,
                    accepted=reply.accepted,
                    reason=reply.reason,
                )
                query.reply(
                    self._keys.command(kind),
                    encode_reply(reply),
                    encoding=Encodings.REPLY,
                )

        return answer

    def _answer_applied(self, query: zenoh.Query) -> None:
        with query:
            active = self._computer.snapshot().reconstructor
            wanted = query.parameters.get("chunk")
            if wanted is None:
                query.reply(
                    self._keys.applied, encode_manifest(active.manifest), encoding=Encodings.COMMIT
                )
                return
            chunks = split(active.matrix, active.manifest.layout.chunk_bytes)
            if not wanted.isdecimal() or int(wanted) >= len(chunks):
                query.reply_err(f"range: chunk {wanted}, expected 0 to {len(chunks) - 1}")
                return
            query.reply(self._keys.applied, chunks[int(wanted)], encoding=Encodings.BYTES)
