"""Link of the service to the RTC over zenoh: telemetry in, commands and matrices out.

zenoh's threads put frames into a bounded ring, from which :meth:`Bridge.drain` returns copies. All
other messages are queued as events. The bridge makes no decisions: the tracker does, from these
events.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Self, TypeVar

import numpy as np
import structlog
from numpy.typing import NDArray

from service import wire
from service.errors import LinkError, UnknownIdError, WireError
from service.estimation.frames import FrameBlock
from service.files.last_telemetry import LastTelemetry
from service.files.recording import Message, RecordedKind, RecordingWriter
from service.link import session as link
from service.link.guard import LinkGuard, count_waiting
from service.link.intake import Intake
from service.link.leader_election import Standby
from service.link.matrices import LinkEvent, MeasuredIntake, Offer, Outbox
from service.link.session import Endpoint
from service.link.statistics import LinkStatistics
from service.wire.signing import Signatures

if TYPE_CHECKING:
    import zenoh
    import zenoh.ext

__all__ = ["Bridge", "Endpoint"]

_T = TypeVar("_T")


class Bridge:
    """Link of one system; a context manager, or opened and closed by ``open`` and ``close``.

    Every method may be called from any thread. The asynchronous ones do their blocking work in a
    thread of their own, not on the event loop.
    """

    def __init__(self, endpoint: Endpoint, last: LastTelemetry | None = None) -> None:
        self._endpoint = endpoint
        self._last = last or LastTelemetry(0.0, 0)
        self._handing_over = threading.Lock()
        self._keys = wire.Keys(endpoint.system)
        self._log = structlog.get_logger().bind(system=endpoint.system)
        self._intake = Intake(endpoint)
        self._measured = MeasuredIntake(self._keys)
        self._outbox = Outbox(endpoint.offer_s)
        self._signatures = Signatures(endpoint.security.secret, wire.Role.SERVICE)
        self.guard = LinkGuard(endpoint.security)
        """Record of the programs on a secured link, and of what they were refused."""
        self._session: zenoh.Session | None = None
        self._closed = False
        self._missing = "the link is being opened"
        self._recorder: RecordingWriter | None = None
        self._publishers: dict[str, zenoh.ext.AdvancedPublisher] = {}
        self._held: list[object] = []
        self._standby = Standby(self._keys, drive=self._drive, report=self._intake.event)

    def __enter__(self) -> Self:
        """Open the link."""
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        """Close the link."""
        self.close()

    def open(self) -> None:
        """Open the zenoh session and declare the service's liveliness token.

        The queryables are declared before the token, so that an RTC that sees the token can send
        its queries.

        Raises
        ------
        ConfigurationError
            If zenoh does not understand an endpoint.
        LinkError
            If the port is busy, no router answers, or the link is open already.
        """
        if self._session is not None:
            raise LinkError(f"the link of {self._endpoint.system} is open already")
        self._closed = False
        self._open()

    def _open(self) -> None:
        try:
            self._session = session = link.open_session(self._endpoint)
            self._declare(session)
        except BaseException as error:
            self._leave()
            self._missing = str(error)
            raise
        self._missing = ""
        self._log.info("link.opened", listen=self._endpoint.listen, connect=self._endpoint.connect)

    def close(self) -> None:
        """Close the zenoh session, after which the process can exit; closing twice does nothing."""
        self._closed = True
        self._intake.set_wakeup(None)
        if self._leave():
            self._log.info("link.closed")

    def _leave(self) -> bool:
        """Undeclare everything and close the session; return True if there was one."""
        session, self._session = self._session, None
        self._standby.leave()
        self._publishers.clear()
        self._held.clear()
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        return session is not None

    def reopen(self) -> None:
        """Open the session, or close it and open another, so that RTCs have to connect again.

        Does nothing after :meth:`close`.

        Raises
        ------
        ConfigurationError
            If zenoh does not understand an endpoint.
        LinkError
            If the port is busy, or no router answers; the session is then closed.
        """
        if self._leave():
            self._intake.liveliness(alive=False)
        if not self._closed:
            self._open()
        # close() in another thread may have come between the two tests; the new session would
        # otherwise stay open.
        if self._closed:
            self.close()

    def expect(
        self, basis_id: str | None, config_id: str | None, modes: Collection[str] = ()
    ) -> None:
        """Refuse frames of another basis or sensor configuration; None adopts the first received.

        ``modes`` are the configurations between which the RTC may change.
        """
        self._intake.expect(basis_id, config_id, modes)

    def set_wakeup(self, callback: Callable[[], object] | None, *, for_frames: bool = True) -> None:
        """Set the function that zenoh's threads call when something new has come; None for none.

        It is called once until the next :meth:`drain` or :meth:`events`, so a consumer must call
        both. A typical callback is ``lambda: loop.call_soon_threadsafe(event.set)``. A consumer
        that polls sets ``for_frames`` to False. Frames that waited in vain for missing ones are
        released without a call, so a consumer must also poll a few times a second.
        """
        self._intake.set_wakeup(callback, for_frames=for_frames)

    def drain(self, *, before_events: bool = False) -> list[FrameBlock]:
        """Return copies of the frames since the last call, in order.

        Each block is contiguous and has one reconstructor. Frames after missing ones are held back
        as long as these may still be recovered. With ``before_events`` only frames that came before
        the oldest event in the queue are returned.
        """
        return self._intake.drain(before_events=before_events)

    def events(self) -> list[LinkEvent]:
        """Return the events since the last call, oldest first."""
        self._standby.look_again()
        return self._intake.events()

    def statistics(self) -> LinkStatistics:
        """Return all counters of the link."""
        return replace(
            self._intake.statistics(),
            missing=self._missing,
            refusals=self.guard.refusals(),
            ending_certificates=self.guard.ending(),
            waiting_connections=count_waiting(self._endpoint.listen),
        )

    def keep(self, recorder: RecordingWriter | None, before_s: float = 0.0) -> float:
        """Record all messages of the RTC from now on; None ends the recording.

        The recording begins with the reconstructor in use, if this service has it, and with up to
        ``before_s`` seconds of earlier telemetry. Returns the number of seconds that were held.
        """
        offer, alive = self._outbox.current, self._intake.statistics().rtc_alive
        with self._handing_over:
            self._recorder = recorder
            if recorder is None:
                return 0.0
            now_s = time.monotonic()
            past = self._last.since(before_s)
            since_s = now_s if past.start_s is None else past.start_s
            first = []
            if alive:
                first.append(Message(since_s, RecordedKind.LIVELINESS, b"\x01"))
            if offer is not None:
                matrix = b"".join(offer.parts)
                first.append(Message(since_s, RecordedKind.MATRIX, matrix, offer.commit))
            recorder.begin_with(chain(first, past), since_s)
            return now_s - since_s

    def _record_matrix(self) -> None:
        offer = self._outbox.current
        if offer is not None:
            self._record(RecordedKind.MATRIX, b"".join(offer.parts), offer.commit)

    def _record(self, kind: RecordedKind, payload: bytes, attachment: bytes = b"") -> None:
        with self._handing_over:
            self._last.put(kind, payload, attachment)
            if self._recorder is not None:
                self._recorder.put(kind, payload, attachment)

    def offer(self, manifest: wire.Manifest, matrix: NDArray[np.float32]) -> None:
        """Answer an RTC's queries for a reconstructor, without sending it.

        Raises
        ------
        WireError
            If the manifest does not describe the matrix, or its id belongs to another one.
        """
        self._prepare(manifest, matrix)

    def set_current(self, matrix_id: str | None) -> None:
        """Set the reconstructor that an RTC without one should use; None for none.

        An acknowledgement of an applied reconstructor does the same.

        Raises
        ------
        UnknownIdError
            If no reconstructor with this id was offered or published.
        """
        self._outbox.set_current(matrix_id)
        self._record_matrix()

    async def publish(self, manifest: wire.Manifest, matrix: NDArray[np.float32]) -> None:
        """Send a reconstructor: its chunks, then the commit on which the RTC stages and swaps.

        Parameters
        ----------
        manifest
            Manifest with the layout of the matrix in chunks.
        matrix
            ``(n_controlled, n_slopes)``, metres per slope, without the loop gain.

        Raises
        ------
        WireError
            If the manifest does not describe the matrix, or its id belongs to another one.
        LinkError
            If the link is not open, or the last message came from another session than the current
            one; no commit is sent then.
        """
        await asyncio.to_thread(self._publish, manifest, matrix)

    async def command(self, command: wire.Command) -> wire.Reply:
        """Send a command and return the RTC's reply, accepted or not.

        Raises
        ------
        WireError
            If the command breaks the contract.
        LinkError
            If the RTC does not reply, not even to a repetition with the same id. It is then unknown
            whether it has carried out the command.
        """
        return await asyncio.to_thread(self._command, command)

    async def fetch_applied(self) -> tuple[wire.Manifest, NDArray[np.float32]]:
        """Return the reconstructor in use; see :func:`service.link.session.fetch_applied`."""
        read_back = link.fetch_applied
        return await asyncio.to_thread(
            read_back, self._require_session(), self._keys, self._signatures
        )

    async def fetch_references(self) -> wire.ReferencesInUse:
        """Return the offset in use; see :func:`service.link.session.fetch_references`."""
        read_back = link.fetch_references
        return await asyncio.to_thread(
            read_back, self._require_session(), self._keys, self._signatures
        )

    def publish_state(self, message: wire.StateMessage) -> None:
        """Publish the service's state; it is dropped if the network is congested or not there."""
        self._publish_last(self._keys.state, wire.encode(message), wire.Encodings.STATE)

    def publish_alarm(self, message: wire.AlarmMessage) -> None:
        """Publish an alarm that began or ended; it is dropped like a state."""
        self._publish_last(self._keys.alarm, wire.encode(message), wire.Encodings.ALARM)

    def publish_gains(self, message: wire.GainsMessage) -> None:
        """Publish the optical gains; they are dropped like a state."""
        self._publish_last(self._keys.gains, wire.encode(message), wire.Encodings.GAINS)

    def _declare(self, session: zenoh.Session) -> None:
        keys = self._keys
        for key in (keys.state, keys.alarm, keys.gains, keys.references):
            self._publishers[key] = link.last_value(session, key)
        self._held += self._standby.join(
            session, self._catch_errors, wait=bool(self._endpoint.connect)
        )
        if self._endpoint.security.zenoh:
            self._held.append(link.watch_links(session, self.guard.on_link))
        # zenoh undeclares objects when Python collects them, so all must be kept in a list.
        self._held += [
            link.subscribe(session, keys.acknowledgement, self._catch_errors("ack", self._on_ack)),
            link.subscribe(session, keys.status, self._catch_errors("status", self._on_status)),
            link.subscribe(session, keys.all_measured, self._catch_errors("im", self._on_measured)),
            link.watch(
                session, keys.alive(wire.Role.RTC), self._catch_errors("alive", self._on_alive)
            ),
            link.subscribe_frames(
                session, keys.frames, self._catch_errors("frames", self._on_frames)
            ),
        ]

    def _drive(self, session: zenoh.Session) -> list[object]:
        """Declare the queryable and token of the service that drives this system."""
        return [
            link.serve(session, self._keys.all_matrices, self._answer),
            link.announce(session, self._keys.alive(wire.Role.SERVICE)),
        ]

    def _catch_errors(self, kind: str, take: Callable[[_T], None]) -> Callable[[_T], None]:
        """Return a callback that counts and logs all errors instead of raising them."""

        def callback(item: _T) -> None:
            try:
                take(item)
            except WireError as error:
                self._intake.malformed(kind, error)
            except Exception:  # noqa: BLE001 - zenoh's thread would discard it without a trace
                if self._intake.failed(kind):
                    self._log.exception("link.callback_failed", kind=kind)

        return callback

    def _on_frames(self, sample: zenoh.Sample) -> None:
        session, attachment = self._session, sample.attachment
        if session is None:
            return
        payload = link.bytes_of(sample.payload, wire.BATCH_LIMIT, "a frame batch")
        header = None
        if attachment is not None:
            header = link.bytes_of(attachment, wire.ATTACHMENT_LIMIT, "an attachment")
        self._signatures.check(self._keys.frames, header or b"", payload)
        self._record(RecordedKind.FRAMES, payload, header or b"")
        self._intake.frames(
            payload,
            header,
            recoverable=sample.source_info is not None,
            latency_s=link.latency_s(session, sample, time.time_ns()),
        )

    def _on_status(self, sample: zenoh.Sample) -> None:
        data = link.bytes_of(sample.payload, wire.STATUS_LIMIT, "a status")
        self._signatures.check(self._keys.status, data)
        self._record(RecordedKind.STATUS, data)
        self._intake.status(data)

    def _on_ack(self, sample: zenoh.Sample) -> None:
        data = link.bytes_of(sample.payload, wire.MESSAGE_LIMIT, "an acknowledgement")
        self._signatures.check(self._keys.acknowledgement, data)
        self._record(RecordedKind.ACKNOWLEDGEMENT, data)
        acknowledgement = wire.decode(wire.Acknowledgement, data)
        matrix_id = acknowledgement.id
        known = matrix_id is None or self._outbox.knows(matrix_id)
        if matrix_id is not None and acknowledgement.state is wire.AckState.APPLIED:
            self._outbox.adopt(matrix_id, acknowledgement.sha256)
        self._intake.acknowledgement(acknowledgement, known=known)

    def _on_measured(self, sample: zenoh.Sample) -> None:
        data = link.bytes_of(sample.payload, wire.CHUNK_LIMIT, "a measured matrix")
        key = str(sample.key_expr)
        if self._keys.chunk_index_of(key) is None:
            self._signatures.check(key, data)
        if (event := self._measured.take(key, data)) is not None:
            self._intake.event(event)

    def _on_alive(self, token: tuple[str, bool]) -> None:
        self._record(RecordedKind.LIVELINESS, bytes([token[1]]))
        self._intake.liveliness(alive=token[1])

    def _answer(self, query: zenoh.Query) -> None:
        """Answer a query for a reconstructor, with an error text if there is none."""
        with query:
            key, part = str(query.key_expr), query.parameters.get("chunk")
            try:
                data = self._outbox.asked(self._keys, key, part, time.monotonic())
            except (UnknownIdError, WireError) as error:
                query.reply_err(str(error).encode())
            else:
                if part is None:
                    signed = self._signatures.sign(key, data)
                    query.reply(key, signed, encoding=wire.Encodings.COMMIT)
                else:  # not signed: the signed manifest has the checksum of all chunks
                    query.reply(key, data, encoding=wire.Encodings.BYTES)

    def _prepare(self, manifest: wire.Manifest, matrix: NDArray[np.float32]) -> Offer:
        layout = wire.layout_of(matrix, manifest.layout.chunk_bytes)
        if layout != manifest.layout:
            raise WireError(f"range: manifest {manifest.id} says {manifest.layout}, found {layout}")
        if manifest.system != self._endpoint.system:
            raise WireError(
                f"id: manifest {manifest.id} is of system {manifest.system}, "
                f"expected {self._endpoint.system}"
            )
        offer = Offer.of(manifest, matrix)
        self._outbox.add(offer)
        return offer

    def _publish(self, manifest: wire.Manifest, matrix: NDArray[np.float32]) -> None:
        session = self._require_lead()
        offer = self._prepare(manifest, matrix)
        keys, name = self._keys, manifest.id
        for index, part in enumerate(offer.parts):
            link.put(session, keys.chunk(name, index), part, wire.Encodings.BYTES, urgent=False)
        other = self._intake.other_session
        # An RTC in another session may use another slope order or configuration.
        if other is not None:
            raise LinkError(f"{name} was not sent: the RTC may have begun session {other}")
        signed = self._signatures.sign(keys.commit(name), offer.commit)
        link.put(session, keys.commit(name), signed, wire.Encodings.COMMIT, urgent=True)
        self._log.info("reconstructor.sent", id=manifest.id, n_chunks=len(offer.parts))

    def _command(self, command: wire.Command) -> wire.Reply:
        if isinstance(command, wire.ReferencesRequest):
            # For a program that applies references in the place of an RTC that cannot.
            key = self._keys.references
            signed = self._signatures.sign(key, wire.encode(command))
            self._publish_last(key, signed, wire.Encodings.REFERENCES)
        answer = link.send_command(self._require_lead(), self._endpoint, command, self._signatures)
        try:
            reply = wire.decode(wire.Reply, answer)
        except WireError as error:
            self._intake.malformed("reply", error)
            raise LinkError(f"the reply to command {command.id} is unusable: {error}") from error
        if reply.id not in {None, command.id}:
            raise LinkError(f"the RTC answered command {command.id} with a reply to {reply.id}")
        return reply

    def _publish_last(self, key: str, data: bytes, encoding: str) -> None:
        publisher = self._publishers.get(key)
        if publisher is not None and self._standby.drives:
            link.put_last(publisher, data, encoding)

    def _require_lead(self) -> zenoh.Session:
        """Return the session if this service may send commands and matrices.

        This is the last of several checks that two services never command one RTC.
        """
        session = self._require_session()
        if not self._standby.drives:
            raise LinkError("another service drives the RTC, and this one is in standby")
        return session

    def _require_session(self) -> zenoh.Session:
        if self._session is None:
            raise LinkError(f"the link of {self._endpoint.system} is not open")
        return self._session
