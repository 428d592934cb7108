"""The checker's end of the link."""

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
    Reply,
    Role,
    decode,
)
from service.wire.signing import Signatures

if TYPE_CHECKING:
    import zenoh

MOST_WAITING: Final = 20_000
"""Messages that wait to be looked at; beyond it the oldest are dropped."""

OFFERED_S: Final = 600.0
"""A matrix can be asked for this long."""

ANSWER_S: Final = 2.0
"""For the answer to a question of any other kind than a command."""


class Topic(StrEnum):
    """The kind of key a message came on."""

    FRAMES = "frames"
    STATUS = "status"
    ACK = "ack"
    MEASURED = "im"
    ALIVE = "alive"
    ASKED = "asked"
    """The RTC asked for a matrix: the key has which, and which part."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedMessage:
    """One message of an RTC."""

    topic: Topic
    key: str
    at_s: float
    """When it came, on a monotonic clock."""

    data: bytes = b""
    attachment: bytes | None = None
    recoverable: bool = False
    """Whether its publisher keeps what it has sent."""

    alive: bool = False
    """Of a token: whether it came; else it went."""

    refused: str = ""
    """Why its signature is not accepted; empty: it is, or none is asked for."""


def systems_with_rtc(endpoint: Endpoint, wait_s: float) -> list[str]:
    """Return the systems whose RTC is at a router, waiting at most ``wait_s``.

    Raises
    ------
    LinkError
        If no router answers.
    """
    session = link.open_session(endpoint)
    end_s = time.monotonic() + wait_s
    try:
        while not (found := link.tokens(session, Keys.all_alive(Role.RTC))):
            if time.monotonic() >= end_s:
                return []
            time.sleep(0.2)
    finally:
        session.close()  # type: ignore[no-untyped-call]
    return sorted({Keys.system_of(key) for key in found})


class RtcConnection:
    """The link, a context manager; messages wait until they are taken.

    Where no service is there it is one to the RTC: it holds the token, and answers for matrices.
    """

    def __init__(self, endpoint: Endpoint, *, as_service: bool = True) -> None:
        self._endpoint = endpoint
        self.keys = Keys(endpoint.system)
        self._signatures = Signatures(endpoint.security.secret, Role.SERVICE)
        self._as_service = as_service
        self._outbox = Outbox(OFFERED_S)
        self._messages: deque[ReceivedMessage] = deque(maxlen=MOST_WAITING)
        self._session: zenoh.Session | None = None
        self._held: list[object] = []
        self._ids = itertools.count()
        self.other_service = False
        """Whether a service drives this RTC: then nothing but listening is allowed."""

    def __enter__(self) -> Self:
        """Open the link."""
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    def open(self) -> None:
        """Subscribe, and declare the service's token.

        Raises
        ------
        LinkError
            If the port is busy or no router answers.
        """
        self._session = session = link.open_session(self._endpoint)
        keys = self.keys
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
        """Whether the RTC's router is this program."""
        return not self._endpoint.connect

    def new_id(self, what: str) -> str:
        """Return an id that was never used."""
        return f"check-{what}-{time.time_ns()}-{next(self._ids)}"

    def command(self, command: Command) -> Reply:
        """Return the RTC's reply.

        Raises
        ------
        LinkError
            If there is none, or one that cannot be read.
        """
        answer = link.send_command(self._opened, self._endpoint, command, self._signatures)
        try:
            return decode(Reply, answer)
        except WireError as error:
            raise LinkError(f"the reply is unusable: {error}") from error

    @property
    def signs(self) -> bool:
        """Whether RTC and checker share a secret."""
        return self._endpoint.security.secret is not None

    def signed(self, kind: CommandKind, payload: bytes) -> bytes:
        """Return a request with its signature."""
        return self._signatures.sign(self.keys.command(kind), payload)

    def ask(
        self, kind: CommandKind, payload: bytes, *, as_it_is: bool = False
    ) -> tuple[bytes | None, float]:
        """Return the reply to these bytes and its delay; None: there is none.

        They are signed where a secret is shared, unless they are to be sent ``as_it_is``.

        Raises
        ------
        LinkError
            If the reply is an error reply.
        """
        began_s = time.monotonic()
        selector = self.keys.command(kind)
        signed = payload if as_it_is else self.signed(kind, payload)
        answer = link.ask(self._opened, selector, ANSWER_S, signed, Encodings.COMMAND)
        return answer, time.monotonic() - began_s

    def applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return the matrix that the RTC says it uses.

        Raises
        ------
        WireError
            If what comes breaks the contract or the checksum differs.
        LinkError
            If there is no answer.
        """
        return link.fetch_applied(self._opened, self.keys, self._signatures)

    def offer(self, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        """Serve a matrix from now on.

        Raises
        ------
        WireError
            If its id names another one.
        """
        self._outbox.add(Offer.of(manifest, matrix))

    def put_chunk(self, matrix_id: str, index: int, data: bytes) -> None:
        """Send one part of a matrix."""
        key = self.keys.chunk(matrix_id, index)
        link.put(self._opened, key, data, Encodings.BYTES, urgent=False)

    def put_commit(self, matrix_id: str, data: bytes) -> None:
        """Send a manifest, or bytes that are none."""
        key = self.keys.commit(matrix_id)
        signed = self._signatures.sign(key, data)
        link.put(self._opened, key, signed, Encodings.COMMIT, urgent=True)

    @property
    def _opened(self) -> zenoh.Session:
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
                    refused=self._why_unsigned(topic, key, data, attachment),
                    recoverable=sample.source_info is not None,
                )
            )

        return on_sample

    def _why_unsigned(self, topic: Topic, key: str, data: bytes, attachment: bytes | None) -> str:
        try:
            if topic is Topic.FRAMES:
                self._signatures.check(key, attachment or b"", data)
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
            asked = key if part is None else f"{key}?chunk={part}"
            self._messages.append(
                ReceivedMessage(topic=Topic.ASKED, key=asked, at_s=time.monotonic())
            )
            try:
                data = self._outbox.asked(self.keys, key, part, time.monotonic())
            except (UnknownIdError, WireError) as error:
                query.reply_err(str(error).encode())
            else:
                query.reply(key, self._signatures.sign(key, data) if part is None else data)
