"""Matrices on the link: reconstructors in, acknowledgements and measured matrices out."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Final, Self

import structlog
import zenoh
from typing_extensions import override

from pyrcal.rtc.background import Background
from pyrcal.rtc.identity import Reconstructor
from pyrcal.rtc.replies import Computer, FinishedMeasurement
from pyrcal.rtc.staging import Replies, Staging
from service import wire
from service.errors import WireError
from service.wire.signing import UNSIGNED, Signatures

_log = structlog.get_logger("rtc")

_POLL_S: Final = 0.2
"""Longest time until a timeout of a missing chunk is noticed."""

_QUERY_TIMEOUT_S: Final = 2.0

_MAX_QUEUED_EVENTS: Final = 256
"""Messages waiting for the thread. Chunks of a larger burst are dropped and requested again."""

Event = Callable[[], None]


class Matrices(Background):
    """Exchanges matrices with the service in its own thread for the duration of a ``with`` block.

    Fetching a matrix, solving a measured one and sending it wait for the network or take up to
    half a second. They have their own thread, so that telemetry does not wait.

    Parameters
    ----------
    session, keys
        Open zenoh session, and the keys of the system.
    computer
        The RTC.
    signatures
        Signs acknowledgements and verifies commits, on a link with a shared secret.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: wire.Keys,
        computer: Computer,
        *,
        signatures: Signatures = UNSIGNED,
    ) -> None:
        super().__init__("matrices")
        self._session = session
        self._keys = keys
        self._computer = computer
        self._signatures = signatures
        self._staging = Staging(computer.terms, limit_bytes=computer.largest_matrix_bytes)
        self._events: queue.Queue[Event] = queue.Queue(_MAX_QUEUED_EVENTS)
        self._rtc_session = computer.session
        self._current_requested = False

    @override
    def __enter__(self) -> Self:
        self._declared = (
            self._session.declare_subscriber(self._keys.all_chunks, self._on_chunk),
            self._session.declare_subscriber(self._keys.all_commits, self._on_commit),
            self._session.liveliness().declare_subscriber(
                self._keys.alive(wire.Role.SERVICE), self._on_service, history=True
            ),
        )
        return super().__enter__()

    def report(self) -> None:
        """Send acknowledgements of swaps and measured matrices now."""
        self._enqueue(self._report)

    def _on_chunk(self, sample: zenoh.Sample) -> None:
        # Refused before it is copied.
        if len(sample.payload) > wire.CHUNK_LIMIT:
            return
        key, data = str(sample.key_expr), sample.payload.to_bytes()
        self._enqueue(lambda: self._add_chunk(key, data))

    def _on_commit(self, sample: zenoh.Sample) -> None:
        key, data = str(sample.key_expr), sample.payload.to_bytes()
        self._enqueue(lambda: self._commit(key, data))

    def _on_service(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._enqueue(self._request_current)

    def _enqueue(self, event: Event) -> None:
        try:
            self._events.put_nowait(event)
        except queue.Full:
            _log.warning("reconstructor.overflow", waiting=_MAX_QUEUED_EVENTS)

    @override
    def _work(self) -> None:
        while not self._stopped.is_set():
            try:
                event = self._events.get(timeout=_POLL_S)
            except queue.Empty:
                event = None
            # First, so that a matrix of the new session is not voided with the old ones.
            self._follow_session()
            if event is not None:
                event()
            self._execute(self._staging.poll(time.monotonic()))

    def _report(self) -> None:
        for matrix_id, seq in self._computer.take_swaps():
            acknowledgement = self._staging.applied(matrix_id, seq)
            if acknowledgement is not None:
                self._acknowledge(acknowledgement)
        for measured in self._computer.take_measured():
            self._send(measured)

    def _follow_session(self) -> None:
        """Void the matrices that are not applied yet if the RTC has begun a new session."""
        current = self._computer.session
        if current != self._rtc_session:
            self._rtc_session = current
            self._void()

    def _void(self) -> None:
        self._staging.void()

    def _add_chunk(self, key: str, data: bytes) -> None:
        try:
            matrix_id, index = self._keys.matrix_id_of(key), self._keys.chunk_index_of(key)
        except WireError as error:
            _log.warning("reconstructor.refused", reason=str(error))
            return
        if index is not None:
            self._execute(self._staging.chunk(matrix_id, index, data))

    def _commit(self, key: str, data: bytes) -> None:
        try:
            self._signatures.check(key, data)
            manifest = wire.decode(wire.Manifest, data)
            if manifest.id != self._keys.matrix_id_of(key):
                raise WireError(f"id: {manifest.id} in the manifest at {key}")
        except WireError as error:
            self._acknowledge(self._staging.unreadable(str(error)))
            return
        refusal = self._refusal()
        if refusal:
            self._acknowledge(self._staging.answer(manifest, wire.AckState.REJECTED, refusal))
            return
        self._execute(self._staging.commit(manifest, time.monotonic()))

    def _refusal(self) -> str:
        """Return the reason to reject every matrix at present, or an empty string."""
        return ""

    def _request_current(self) -> None:
        """Request the matrix that the service has selected, once, and stage it if it fits.

        Without this, an RTC that starts after the service would keep its own matrix until the next
        update.
        """
        if self._current_requested:
            return
        self._current_requested = True
        data = self._get(self._keys.current)
        if data is None:
            return
        try:
            self._signatures.check(self._keys.current, data)
            manifest = wire.decode(wire.Manifest, data)
        except WireError as error:
            _log.warning("reconstructor.refused", reason=str(error))
            return
        refusal = self._computer.terms().refusal(manifest)
        if refusal:
            _log.info("reconstructor.not-taken", id=manifest.id, reason=refusal)
            return
        active = self._computer.reconstructor.manifest
        # The same matrix is in use already, so there is nothing to swap.
        if (active.id, active.layout.sha256) == (manifest.id, manifest.layout.sha256):
            return
        self._execute(self._staging.commit(manifest, time.monotonic()))
        self._fetch(manifest.id, tuple(range(manifest.layout.n_chunks)))

    def _fetch(self, matrix_id: str, chunks: tuple[int, ...]) -> None:
        for index in chunks:
            data = self._get(f"{self._keys.matrix(matrix_id)}?chunk={index}")
            if data is not None:
                self._execute(self._staging.chunk(matrix_id, index, data))

    def _get(self, selector: str) -> bytes | None:
        """Return the first successful reply to a query, or None if there is none in time."""
        for reply in self._session.get(selector, timeout=_QUERY_TIMEOUT_S):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            text = "" if reply.err is None else reply.err.payload.to_string()
            _log.info("query.refused", selector=selector, reason=text)
        return None

    def _execute(self, outcome: Replies) -> None:
        for acknowledgement in outcome.acknowledgements:
            self._acknowledge(acknowledgement)
        for reconstructor in outcome.staged:
            self._stage(reconstructor)
        for matrix_id, chunks in outcome.missing:
            self._fetch(matrix_id, chunks)

    def _stage(self, reconstructor: Reconstructor) -> None:
        self._computer.stage(reconstructor)

    def _acknowledge(self, acknowledgement: wire.Acknowledgement) -> None:
        _log.info(
            "reconstructor." + acknowledgement.state,
            id=acknowledgement.id,
            reason=acknowledgement.reason,
            frame_seq=acknowledgement.frame_seq,
        )
        self._put_acknowledgement(wire.encode(acknowledgement))

    def _put_acknowledgement(self, data: bytes) -> None:
        signed = self._signatures.sign(self._keys.acknowledgement, data)
        acknowledge(self._session, self._keys, signed)

    def _send(self, measured: FinishedMeasurement) -> None:
        """Solve a measurement; send the matrix in chunks, then its manifest."""
        manifest, matrix = measured.product(self._computer.identity, time.time_ns())
        parts = [] if matrix is None else wire.split(matrix, manifest.layout.chunk_bytes)
        for index, part in enumerate(parts):
            self._session.put(
                self._keys.measured_chunk(manifest.id, index),
                part,
                encoding=wire.Encodings.BYTES,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
            )
        # The manifest follows at a higher priority and may overtake chunks.
        key = self._keys.measured_commit(manifest.id)
        self._session.put(
            key,
            self._signatures.sign(key, wire.encode(manifest)),
            encoding=wire.Encodings.MEASURED_COMMIT,
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


def acknowledge(session: zenoh.Session, keys: wire.Keys, data: bytes) -> None:
    """Send an encoded acknowledgement."""
    session.put(
        keys.acknowledgement,
        data,
        encoding=wire.Encodings.ACKNOWLEDGEMENT,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.DATA_HIGH,
    )
