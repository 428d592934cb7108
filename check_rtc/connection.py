"""Connection of the checker to an RTC, in the role of the service."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from numpy.typing import NDArray

from service.errors import LinkError, UnknownIdError, WireError
from service.link import session as link
from service.link.matrices import Offer, Outbox
from service.link.session import Endpoint
from service.wire import (
    Command,
    CommandKind,
    Encodings,
    Keys,
    Manifest,
    ReferencesInUse,
    Reply,
    Role,
    decode,
)
from service.wire.signing import Signatures

if TYPE_CHECKING:
    import zenoh

MAX_QUEUED_MESSAGES: Final = 20_000
"""Largest number of received messages in the queue; beyond it the oldest are dropped."""

OFFER_DURATION_S: Final = 600.0
"""Time for which the RTC can query a matrix that was sent."""

ANSWER_TIMEOUT_S: Final = 2.0
"""Time to wait for the reply to a query."""


class Topic(StrEnum):
    """Kind of key on which a message came."""

    FRAMES = "frames"
    STATUS = "status"
    ACK = "ack"
    MEASURED = "im"
    ALIVE = "alive"
    QUERY = "query"
    """A query of the RTC for a matrix; the key names the matrix and the chunk."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedMessage:
    """Message received from an RTC."""

    topic: Topic
    key: str
    at_s: float
    """Time of arrival on a monotonic clock, seconds."""

    data: bytes = b""
    attachment: bytes | None = None
    recoverable: bool = False
    """True if its publisher has a cache from which lost messages can be recovered."""

    alive: bool = False
    """True if a liveliness token appeared, False if it disappeared; used for tokens only."""

    refused: str = ""
    """Reason for which its signature is not accepted; empty if it is, or none is required."""


def find_systems_with_rtc(endpoint: Endpoint, wait_s: float) -> list[str]:
    """Return the names of systems whose RTC is at a router, waiting at most ``wait_s``.

    Raises
    ------
    LinkError
        If no router answers.
    """
    session = link.open_session(endpoint)
    end_s = time.monotonic() + wait_s
    try:
        # Asked again and again: an RTC that waits for its router connects within a second.
        while not (found := link.tokens(session, Keys.all_alive(Role.RTC))):
            if time.monotonic() >= end_s:
                return []
            time.sleep(0.2)
    finally:
        session.close()  # type: ignore[no-untyped-call]
    return sorted({Keys.system_of(key) for key in found})


class RtcConnection:
    """Connection to an RTC, a context manager; messages are queued until :meth:`take`.

    If no service is on the link, the connection takes its role: it declares the service's
    liveliness token and answers queries for matrices.
    """

    def __init__(self, endpoint: Endpoint, *, as_service: bool = True) -> None:
        self._endpoint = endpoint
        self.keys = Keys(endpoint.system)
        self._signatures = Signatures(endpoint.security.secret, Role.SERVICE)
        self._as_service = as_service
        self._outbox = Outbox(OFFER_DURATION_S)
        self._messages: deque[ReceivedMessage] = deque(maxlen=MAX_QUEUED_MESSAGES)
        self._session: zenoh.Session | None = None
        self._held: list[object] = []
        self._ids = itertools.count()
        self.other_service = False
        """True if a service is connected to this RTC; the checker then only listens."""

    def __enter__(self) -> Self:
        """Open the connection."""
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self.close()

    def open(self) -> None:
        """Subscribe to the messages of the RTC, and declare the service's token.

        Raises
        ------
        LinkError
            If the port is busy or no router answers.
        """
        self._session = session = link.open_session(self._endpoint)
        keys = self.keys
        # Read before the own token is declared, which would be found as well.
        self.other_service = bool(link.tokens(session, keys.alive(Role.SERVICE)))
        self._held = [
            link.subscribe(session, keys.acknowledgement, self._on_message(Topic.ACK)),
            link.subscribe(session, keys.status, self._on_message(Topic.STATUS)),
            link.subscribe(session, keys.all_measured, self._on_message(Topic.MEASURED)),
            link.watch(session, keys.alive(Role.RTC), self._on_token),
            link.subscribe_frames(session, keys.frames, self._on_message(Topic.FRAMES)),
        ]
        if self._as_service and not self.other_service:
            self._held += [
                link.serve(session, keys.all_matrices, self._answer),
                link.announce(session, keys.alive(Role.SERVICE)),
            ]

    def close(self) -> None:
        """Leave the network. Closing twice does nothing."""
        session, self._session = self._session, None
        self._held.clear()
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]

    def take(self) -> list[ReceivedMessage]:
        """Return the messages since the last call, oldest first."""
        taken: list[ReceivedMessage] = []
        while self._messages:
            taken.append(self._messages.popleft())
        return taken

    @property
    def own_router(self) -> bool:
        """True if this program is the router to which the RTC connects."""
        return not self._endpoint.connect

    def new_id(self, what: str) -> str:
        """Return an id that was never used before, not even by an earlier run."""
        return f"check-{what}-{time.time_ns()}-{next(self._ids)}"

    def command(self, command: Command) -> Reply:
        """Send a command and return the RTC's reply.

        Raises
        ------
        LinkError
            If there is no reply, or it breaks the contract.
        """
        answer = link.send_command(self._require_session, self._endpoint, command, self._signatures)
        try:
            return decode(Reply, answer)
        except WireError as error:
            raise LinkError(f"the reply is unusable: {error}") from error

    @property
    def has_secret(self) -> bool:
        """True if RTC and checker share a secret for signatures."""
        return self._endpoint.security.secret is not None

    def sign(self, kind: CommandKind, payload: bytes) -> bytes:
        """Return the bytes of a command with its signature."""
        return self._signatures.sign(self.keys.command(kind), payload)

    def ask(
        self, kind: CommandKind, payload: bytes, *, is_signed: bool = False
    ) -> tuple[bytes | None, float]:
        """Send the bytes of a command; return the reply, None if there is none, and its delay.

        The bytes are signed if there is a secret, unless ``is_signed`` says that they are already,
        or are meant to be sent unsigned.

        Raises
        ------
        LinkError
            If the reply is an error reply.
        """
        began_s = time.monotonic()
        selector = self.keys.command(kind)
        signed = payload if is_signed else self.sign(kind, payload)
        answer = link.ask(
            self._require_session, selector, ANSWER_TIMEOUT_S, signed, Encodings.COMMAND
        )
        return answer, time.monotonic() - began_s

    def fetch_applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return manifest and numbers of the matrix in use, as the RTC reports them.

        Raises
        ------
        WireError
            If the answer breaks the contract, or the checksum differs.
        LinkError
            If there is no answer.
        """
        return link.fetch_applied(self._require_session, self.keys, self._signatures)

    def fetch_references(self) -> ReferencesInUse:
        """Return the offset of the reference slopes, as the RTC reports it.

        Raises
        ------
        WireError
            If the answer breaks the contract.
        LinkError
            If there is no answer.
        """
        return link.fetch_references(self._require_session, self.keys, self._signatures)

    def offer(self, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        """Answer queries for this matrix from now on, and for no other one.

        The numbers may be others than the manifest says, and its id a used one: an RTC must notice.
        """
        # A new outbox, because that of the service refuses other numbers under a used id.
        self._outbox = Outbox(OFFER_DURATION_S)
        self._outbox.add(Offer.of(manifest, matrix))

    def put_chunk(self, matrix_id: str, index: int, data: bytes) -> None:
        """Send one chunk of a matrix."""
        key = self.keys.chunk(matrix_id, index)
        link.put(self._require_session, key, data, Encodings.BYTES, urgent=False)

    def put_commit(self, matrix_id: str, data: bytes) -> None:
        """Send the bytes of a manifest, which may be malformed on purpose."""
        key = self.keys.commit(matrix_id)
        signed = self._signatures.sign(key, data)
        link.put(self._require_session, key, signed, Encodings.COMMIT, urgent=True)

    @property
    def _require_session(self) -> zenoh.Session:
        if self._session is None:
            raise LinkError("the link is not open")
        return self._session

    def _on_message(self, topic: Topic) -> Callable[[zenoh.Sample], None]:
        def on_sample(sample: zenoh.Sample) -> None:
            key, data = str(sample.key_expr), sample.payload.to_bytes()
            attachment = None if sample.attachment is None else sample.attachment.to_bytes()
            self._messages.append(
                ReceivedMessage(
                    topic=topic,
                    key=key,
                    at_s=time.monotonic(),
                    data=data,
                    attachment=attachment,
                    refused=self._check_signature(topic, key, data, attachment),
                    # Only an advanced publisher numbers its messages.
                    recoverable=sample.source_info is not None,
                )
            )

        return on_sample

    def _check_signature(
        self, topic: Topic, key: str, data: bytes, attachment: bytes | None
    ) -> str:
        try:
            if topic is Topic.FRAMES:
                self._signatures.check(key, attachment or b"", data)
            # Chunks are not signed: the signed manifest has their checksum.
            elif topic is not Topic.MEASURED or self.keys.chunk_index_of(key) is None:
                self._signatures.check(key, data)
        except WireError as error:
            return str(error)
        return ""

    def _on_token(self, token: tuple[str, bool]) -> None:
        key, alive = token
        self._messages.append(
            ReceivedMessage(topic=Topic.ALIVE, key=key, at_s=time.monotonic(), alive=alive)
        )

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            key, part = str(query.key_expr), query.parameters.get("chunk")
            selector = key if part is None else f"{key}?chunk={part}"
            self._messages.append(
                ReceivedMessage(topic=Topic.QUERY, key=selector, at_s=time.monotonic())
            )
            try:
                data = self._outbox.asked(self.keys, key, part, time.monotonic())
            except (UnknownIdError, WireError) as error:
                query.reply_err(str(error).encode())
            else:
                query.reply(key, self._signatures.sign(key, data) if part is None else data)
