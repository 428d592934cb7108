"""Matrices on the wire: reconstructors, acknowledgements, measurements."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Final, Self

import structlog
import zenoh
from typing_extensions import override

from service.errors import WireError
from service.files.recording import RecordedKind, RecordingWriter
from service.wire import (
    CHUNK_LIMIT,
    Acknowledgement,
    AckState,
    Encodings,
    Keys,
    Manifest,
    Role,
    decode,
    encode,
    split,
)
from service.wire.signing import UNSIGNED, Signatures
from sim_rtc.computer.feed import Background
from sim_rtc.computer.measure import Measurement, product
from sim_rtc.computer.reconstructors import Outcome, Staging
from sim_rtc.computer.telemetry import Reconstructor
from sim_rtc.faults import Fault, FaultKind, FaultPlan
from sim_rtc.link.replies import Computer, acknowledge

_log = structlog.get_logger("sim_rtc")

_POLL_S: Final = 0.2
_QUERY_TIMEOUT_S: Final = 2.0
_MOST_EVENTS: Final = 256
"""Events that wait for the thread; a burst beyond it is dropped, its chunks are asked for again."""


Event = Callable[[], None]


class Matrices(Background):
    """Handles matrices in a thread while its ``with`` block lasts.

    Asking for a matrix, solving one and sending it wait for the network or take up to half a
    second: telemetry must not wait with them.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        computer: Computer,
        *,
        signatures: Signatures = UNSIGNED,
        plan: FaultPlan | None = None,
        recorder: RecordingWriter | None = None,
    ) -> None:
        super().__init__("matrices")
        self._session = session
        self._keys = keys
        self._computer = computer
        self._signatures = signatures
        self._staging = Staging(computer.terms, limit_bytes=computer.largest_matrix_bytes)
        self._events: queue.Queue[Event] = queue.Queue(_MOST_EVENTS)
        self._rtc_session = computer.session
        self._asked_current = False
        self._plan = plan or FaultPlan()
        self._recorder = recorder
        self._refused: dict[Fault, int] = {}
        self._late: list[tuple[float, Reconstructor]] = []

    @override
    def __enter__(self) -> Self:
        self._declared = (
            self._session.declare_subscriber(self._keys.all_chunks, self._on_chunk),
            self._session.declare_subscriber(self._keys.all_commits, self._on_commit),
            self._session.liveliness().declare_subscriber(
                self._keys.alive(Role.SERVICE), self._on_service, history=True
            ),
        )
        return super().__enter__()

    def _on_chunk(self, sample: zenoh.Sample) -> None:
        if len(sample.payload) > CHUNK_LIMIT:
            return
        key, data = str(sample.key_expr), sample.payload.to_bytes()
        self._enqueue(lambda: self._chunk(key, data))

    def _on_commit(self, sample: zenoh.Sample) -> None:
        key, data = str(sample.key_expr), sample.payload.to_bytes()
        self._enqueue(lambda: self._commit(key, data))

    def look(self) -> None:
        """Send acknowledgements of swaps and measured matrices now."""
        self._enqueue(self._report)

    def _on_service(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._enqueue(self._ask_current)

    def _enqueue(self, event: Event) -> None:
        try:
            self._events.put_nowait(event)
        except queue.Full:
            _log.warning("reconstructor.overflow", waiting=_MOST_EVENTS)

    @override
    def _work(self) -> None:
        while not self._stopped.is_set():
            try:
                event = self._events.get(timeout=_POLL_S)
            except queue.Empty:
                event = None
            self._follow_session()
            if event is not None:
                event()
            self._carry_out(self._staging.poll(time.monotonic()))
            self._swap_late()

    def _report(self) -> None:
        """Report the loop's swaps and measurements since the last time."""
        for matrix_id, seq in self._computer.take_swaps():
            acknowledgement = self._staging.applied(matrix_id, seq)
            if acknowledgement is not None:
                self._acknowledge(acknowledgement)
        for measured in self._computer.take_measured():
            self._send(measured)

    def _follow_session(self) -> None:
        """Void matrices on their way when the computer has started a new session."""
        current = self._computer.session
        if current != self._rtc_session:
            self._rtc_session = current
            self._staging.void()
            self._late.clear()

    def _chunk(self, key: str, data: bytes) -> None:
        try:
            matrix_id, index = self._keys.matrix_id_of(key), self._keys.chunk_index_of(key)
        except WireError as error:
            _log.warning("reconstructor.refused", reason=str(error))
            return
        if index is not None:
            self._carry_out(self._staging.chunk(matrix_id, index, data))

    def _commit(self, key: str, data: bytes) -> None:
        if self._plan.active(FaultKind.DEAF):
            return
        try:
            self._signatures.check(key, data)
            manifest = decode(Manifest, data)
            if manifest.id != self._keys.matrix_id_of(key):
                raise WireError(f"id: {manifest.id} in the manifest at {key}")
        except WireError as error:
            self._acknowledge(self._staging.unreadable(str(error)))
            return
        if self._refuses():
            reason = "range: refused as a fault asked for"
            self._acknowledge(self._staging.answer(manifest, AckState.REJECTED, reason))
            return
        self._carry_out(self._staging.commit(manifest, time.monotonic()))

    def _refuses(self) -> bool:
        """Return whether a fault asks for one more refusal."""
        fault = self._plan.active(FaultKind.REFUSE)
        if fault is None or self._refused.get(fault, 0) >= fault.value("COUNT"):
            return False
        self._refused[fault] = self._refused.get(fault, 0) + 1
        return True

    def _ask_current(self) -> None:
        """Ask once for the matrix that the service wants in use, and take it if it fits."""
        if self._asked_current:
            return
        self._asked_current = True
        data = self._get(self._keys.current)
        if data is None:
            return
        try:
            self._signatures.check(self._keys.current, data)
            manifest = decode(Manifest, data)
        except WireError as error:
            _log.warning("reconstructor.refused", reason=str(error))
            return
        refusal = self._computer.terms().refusal(manifest)
        if refusal:
            _log.info("reconstructor.not-taken", id=manifest.id, reason=refusal)
            return
        if self._is_in_use(manifest):
            return
        self._carry_out(self._staging.commit(manifest, time.monotonic()))
        self._fetch(manifest.id, tuple(range(manifest.layout.n_chunks)))

    def _is_in_use(self, manifest: Manifest) -> bool:
        active = self._computer.reconstructor.manifest
        return (active.id, active.layout.sha256) == (manifest.id, manifest.layout.sha256)

    def _fetch(self, matrix_id: str, chunks: tuple[int, ...]) -> None:
        for index in chunks:
            data = self._get(f"{self._keys.matrix(matrix_id)}?chunk={index}")
            if data is not None:
                self._carry_out(self._staging.chunk(matrix_id, index, data))

    def _get(self, selector: str) -> bytes | None:
        """Return the first ordinary reply to a query, None when there is none in time."""
        for reply in self._session.get(selector, timeout=_QUERY_TIMEOUT_S):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            text = "" if reply.err is None else reply.err.payload.to_string()
            _log.info("query.refused", selector=selector, reason=text)
        return None

    def _carry_out(self, outcome: Outcome) -> None:
        for acknowledgement in outcome.said:
            self._acknowledge(acknowledgement)
        for reconstructor in outcome.staged:
            late = self._plan.active(FaultKind.LATE_SWAP)
            if late is None:
                self._computer.stage(reconstructor)
            else:
                self._late.append((self._plan.now_s + late.value("DELAY"), reconstructor))
        for matrix_id, chunks in outcome.missing:
            self._fetch(matrix_id, chunks)

    def _swap_late(self) -> None:
        while self._late and self._late[0][0] <= self._plan.now_s:
            self._computer.stage(self._late.pop(0)[1])

    def _acknowledge(self, acknowledgement: Acknowledgement) -> None:
        _log.info(
            "reconstructor." + acknowledgement.state,
            id=acknowledgement.id,
            reason=acknowledgement.reason,
            frame_seq=acknowledgement.frame_seq,
        )
        if self._plan.active(FaultKind.MUTE):
            return
        data = encode(acknowledgement)
        if self._recorder is not None:
            self._recorder.put(RecordedKind.ACKNOWLEDGEMENT, data)
        signed = self._signatures.sign(self._keys.acknowledgement, data)
        acknowledge(self._session, self._keys, signed)

    def _send(self, measured: Measurement) -> None:
        """Solve what was measured; send the matrix in parts, then its manifest."""
        manifest, matrix = product(measured, self._computer.identity, time.time_ns())
        parts = [] if matrix is None else split(matrix, manifest.layout.chunk_bytes)
        for index, part in enumerate(parts):
            self._session.put(
                self._keys.measured_chunk(manifest.id, index),
                part,
                encoding=Encodings.BYTES,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
            )
        key = self._keys.measured_commit(manifest.id)
        self._session.put(
            key,
            self._signatures.sign(key, encode(manifest)),
            encoding=Encodings.MEASURED_COMMIT,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.DATA_HIGH,
        )
        _log.info(
            "matrix.measured",
            id=manifest.id,
            pattern=str(manifest.pattern),
            shape=manifest.layout.shape,
            reason=manifest.reason or "",
        )
