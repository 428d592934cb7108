"""The HTTP server, request ids, idempotent orders and ETags.

The same POST sent twice, by a double click or a lost answer, is carried out once. An answer that a
client has already is not sent again. The body of a request has a limit of size and time.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import math
import re
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any, cast
from uuid import uuid4

import uvicorn
from fastapi import Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from structlog.contextvars import bound_contextvars
from typing_extensions import override
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from service.errors import PyrcalError, TooLargeError, TooSlowError
from service.records import messages
from service.web.problems import known_problem, problem

MAX_BODY_BYTES = 1_000_000
"""Largest body of a request. Uploads to be fitted have a limit of their own."""

MAX_BODY_S = 20.0
"""Longest time that the body of a request may take to arrive, seconds."""

STREAMED = ("POST", "/v1/fits")
"""The route that reads its body itself and writes it to the disk, with its own limits."""


async def bounded(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Run a request with its whole body, if that arrives in time and is not too large."""
    request = Request(scope)
    if (request.method, request.url.path) != STREAMED:
        try:
            body = await _whole(request, receive)
        except PyrcalError as error:
            refusal = known_problem(request, error)
            # otherwise the server would read the rest of the body, which may have no end
            refusal.headers["Connection"] = "close"
            return await refusal(scope, receive, send)
        if body is None:
            return None
        receive = again(body, receive)
    return await app(scope, receive, send)


async def _whole(request: Request, receive: Receive) -> bytes | None:
    """Return the body of a request; None if the client disconnected before it was complete.

    Raises
    ------
    TooLargeError, TooSlowError
        If it exceeds the limit of size or time.
    """
    length = request.headers.get("content-length", "")
    # Refused before anything is read, if the client states the length.
    if length.isdecimal() and int(length) > MAX_BODY_BYTES:
        raise _too_large(f"{int(length) / 1e6:.1f} MB")
    body = bytearray()
    try:
        async with asyncio.timeout(MAX_BODY_S):
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return None
                body += message.get("body", b"")
                # The stated length may be missing or wrong.
                if len(body) > MAX_BODY_BYTES:
                    raise _too_large("more")
                if not message.get("more_body", False):
                    return bytes(body)
    except TimeoutError as error:
        raise TooSlowError(
            f"body: found {len(body)} bytes in {MAX_BODY_S:g} s, expected all of it"
        ) from error


def _too_large(found: str) -> TooLargeError:
    return TooLargeError(f"body: found {found}, expected at most {MAX_BODY_BYTES / 1e6:.1f} MB")


def again(body: bytes, receive: Receive) -> Receive:
    """Return a ``receive`` that begins with this body."""
    first = True

    async def replayed() -> Message:
        nonlocal first
        if not first:
            return await receive()
        first = False
        return {"type": "http.request", "body": body, "more_body": False}

    return replayed


MAX_CONNECTIONS = 500
"""Connections at once; older ones end for more. A page holds two of them."""

MAX_HEAD_S = 5
"""Time for the head of a request from the beginning of its connection, or the answer before it,
seconds."""

ARRIVAL_S = 0.05
"""Time for the request of a new connection to arrive before others are ended, seconds. A wave of
strangers may be accepted at once, with an operator among the first of them."""

CROWD_REPORT_S = 10.0
"""Time for which connections that had to end are reported."""

UNAVAILABLE_RETRY_S = 5
"""``Retry-After`` when the service ends or cannot read its keys, seconds."""


class Middleware:
    """Base of our middleware: it handles HTTP requests and passes everything else on.

    Parameters
    ----------
    app
        The application.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or hand it on."""
        over_http = scope["type"] == "http"
        await (self._answer if over_http else self._app)(scope, receive, send)

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        raise NotImplementedError


async def to_its_end(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Run a request; one still at work when the service ends gets an error, if possible."""
    begun = False

    async def noted(message: Message) -> None:
        nonlocal begun
        begun = True
        await send(message)

    try:
        await app(scope, receive, noted)
    except asyncio.CancelledError:
        if not begun:
            detail = "the service ends: ask the next one again"
            status = HTTPStatus.SERVICE_UNAVAILABLE
            headers = {"Retry-After": str(UNAVAILABLE_RETRY_S)}
            await problem(Request(scope), status, "ending", detail, headers)(scope, receive, send)


class Crowd(ServerState):
    """uvicorn's list of connections, in which there is always room for one more.

    In a crowd, the operator who sends a stop connects last. A new connection therefore ends the
    oldest one of the address that has the most, and those without a whole request first. The
    operator may have the same address if it is that of a proxy or of this machine.
    """

    def __init__(self) -> None:
        super().__init__()
        self._ended: Counter[str] = Counter()
        self._last_s = -math.inf
        self._makes_room = False

    def admit(self, loop: asyncio.AbstractEventLoop) -> None:
        """Make room after a new connection, when its request has had time to arrive."""
        if len(self.connections) > MAX_CONNECTIONS and not self._makes_room:
            self._makes_room = True
            loop.call_later(ARRIVAL_S, self._make_room)

    def _make_room(self) -> None:
        self._makes_room = False
        members = cast("set[Connection]", self.connections)
        while (excess := len(members) - MAX_CONNECTIONS) > 0:
            address, _ = Counter(each.address for each in members).most_common(1)[0]
            theirs = (each for each in members if each.address == address)
            for each in sorted(theirs, key=Connection.rank)[:excess]:
                # connection_lost() comes later.
                members.discard(each)
                each.transport.abort()  # close() would wait for one that does not read
                self._ended[address] += 1
            self._last_s = time.monotonic()

    def complaint(self) -> messages.Message | None:
        """Return whose connections had to end lately, or None if none had to."""
        if time.monotonic() - self._last_s > CROWD_REPORT_S:
            self._ended.clear()
            return None
        address, n = self._ended.most_common(1)[0]
        return messages.compose("rest.crowded", address, most=MAX_CONNECTIONS, n=n)


class Connection(H11Protocol):
    """A connection of uvicorn on which a request has to begin in time.

    uvicorn limits the time until the next request of a connection begins; here the limit is for
    the whole head of a request, the first one included. The body has a limit of its own.
    """

    @override
    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.address = self.client[0] if self.client else ""
        self._since_s = time.monotonic()
        self.timeout_keep_alive_task = self.loop.call_later(
            self.timeout_keep_alive, self.timeout_keep_alive_handler
        )
        cast(Crowd, self.server_state).admit(self.loop)

    @override
    def data_received(self, data: bytes) -> None:
        # uvicorn would cancel the timer with the first byte.
        timer, self.timeout_keep_alive_task = self.timeout_keep_alive_task, None
        super().data_received(data)
        if self._answers and timer is not None:
            self._since_s = time.monotonic()
            timer.cancel()
        else:
            self.timeout_keep_alive_task = timer

    def rank(self) -> tuple[bool, float]:
        """Return the sort key of a connection; the lowest one ends first.

        A client that has sent a whole request and waits for its answer comes last.
        """
        return self._answers and not self.cycle.more_body, self._since_s

    @property
    def _answers(self) -> bool:
        # None until the first request, which uvicorn's annotation leaves out.
        return self.cycle is not None and not self.cycle.response_complete  # type: ignore[redundant-expr]


class Server(uvicorn.Server):
    """uvicorn that leaves the signals to the service and ends with it.

    Parameters
    ----------
    app
        The application.
    over
        Event that is set when the service ends.
    within_s
        Time that requests under way are given then, seconds.
    proxies
        Addresses and networks of reverse proxies whose ``X-Forwarded-For`` and
        ``X-Forwarded-Proto`` are trusted.
    """

    def __init__(
        self, app: ASGIApp, over: asyncio.Event, *, within_s: int, proxies: tuple[str, ...] = ()
    ) -> None:
        config = uvicorn.Config(
            app,
            http=Connection,
            ws="none",
            log_config=None,
            access_log=False,
            timeout_keep_alive=MAX_HEAD_S,
            timeout_graceful_shutdown=within_s,
            proxy_headers=bool(proxies),
            forwarded_allow_ips=list(proxies),
        )
        super().__init__(config)
        self.server_state = self.crowd = Crowd()
        self._over = over

    @override
    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield  # uvicorn would raise them again before the service has closed everything

    @override
    async def on_tick(self, counter: int) -> bool:
        return await super().on_tick(counter) or self._over.is_set()


# --- the same POST is carried out once


ONCE = "idempotency-key"
"""Header of a request that may be sent again."""

MAX_KEY_LENGTH = 200
"""Longest idempotency key, characters."""

MAX_KEPT_ANSWERS = 1000
"""Answers that are remembered; the oldest are dropped first."""

MAX_KEPT_BYTES = 100_000
"""Largest answer that is remembered; the answer to an order has some hundred bytes."""

_NOT_DONE = {HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.INSUFFICIENT_STORAGE}
"""Answers that say that nothing was done: the next time may do it."""

_Name = tuple[object, str]
"""Sender of a request, and its key."""


@dataclass(eq=False, slots=True)
class _StoredAnswer:
    """A request with a key, and its answer once there is one."""

    print: bytes
    """Digest of method, path and body."""

    answer: list[Message] = field(default_factory=list)
    done: asyncio.Event = field(default_factory=asyncio.Event)


class Idempotency(Middleware):
    """Answers a POST with an ``Idempotency-Key`` that has been answered as it was answered then.

    One that comes while the first is at work waits for its answer. What is remembered is lost
    with the service, and bounded.
    """

    def __init__(self, app: ASGIApp) -> None:
        super().__init__(app)
        self._given: OrderedDict[_Name, _StoredAnswer] = OrderedDict()

    @override
    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope, receive)
        key = request.headers.get(ONCE)
        if request.method != "POST" or key is None:
            return await self._app(scope, receive, send)
        return await self._once(request, key, send)

    async def _once(self, request: Request, key: str, send: Send) -> None:
        if (request.method, request.url.path) == STREAMED:
            # it goes to the disk as it comes: nobody has its bytes to compare
            return await self._refuse(request, send, "found a key, expected none with an upload")
        if not (0 < len(key) <= MAX_KEY_LENGTH and key.isprintable()):
            found = f"found {len(key)} characters, expected 1 to {MAX_KEY_LENGTH} printable ones"
            return await self._refuse(request, send, found)
        # Per key holder: nobody gets an answer that was made for somebody else.
        name = (request.user and request.user.name, key)
        body = await request.body()
        print_ = hashlib.sha256(f"{request.method} {request.url}\n".encode() + body).digest()
        # Asked again after the wait: if nothing was done, one of those that waited does it.
        while (before := self._given.get(name)) is not None:
            if before.print != print_:
                found = "found a key that was used with another request, expected a new one"
                return await self._refuse(request, send, found)
            await before.done.wait()
            if before.answer:
                for message in before.answer:
                    await send(message)
                return None
        receive = again(body, request.receive)
        return await self._perform(name, print_, receive, request.scope, send)

    async def _perform(
        self, name: _Name, print_: bytes, receive: Receive, scope: Scope, send: Send
    ) -> None:
        """Hand a request on, and remember what it is answered."""
        given = _StoredAnswer(print_)
        self._given[name] = given
        messages: list[Message] = []

        async def noted(message: Message) -> None:
            messages.append(message)
            await send(message)

        try:
            await self._app(scope, receive, noted)
            if _lasts(messages):
                given.answer = messages
        finally:
            if not given.answer and self._given.get(name) is given:
                del self._given[name]
            # In any case, or those that wait would wait for ever.
            given.done.set()
            while len(self._given) > MAX_KEPT_ANSWERS:
                self._given.popitem(last=False)

    async def _refuse(self, request: Request, send: Send, found: str) -> None:
        detail = f"header.Idempotency-Key: {found}"
        answer = problem(request, HTTPStatus.UNPROCESSABLE_ENTITY, "idempotency-key", detail)
        await answer(request.scope, request.receive, send)


def _lasts(messages: list[Message]) -> bool:
    """Return whether an answer is to be given again: whole, small, and of something done."""
    if not messages or messages[-1].get("more_body", False):
        return False
    size = sum(len(message.get("body", b"")) for message in messages)
    return messages[0]["status"] not in _NOT_DONE and size <= MAX_KEPT_BYTES


# --- which request has led to what: an id in its answer and in every line of the log


REQUEST_ID = "x-request-id"

_USABLE = re.compile(r"[A-Za-z0-9._-]{1,64}")
"""An id of the client's own that is harmless in a log."""


def change_headers(send: Send, change: Callable[[MutableHeaders], object]) -> Send:
    """Return a ``send`` that changes the headers of an answer before they are sent."""

    async def changed(message: Message) -> None:
        if message["type"] == "http.response.start":
            change(MutableHeaders(scope=message))
        await send(message)

    return changed


class SecurityHeaders(Middleware):
    """Has no answer taken for another type than it says, nor kept where it does not say so."""

    @override
    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        def secure(headers: MutableHeaders) -> None:
            headers.setdefault("X-Content-Type-Options", "nosniff")
            headers.setdefault("Cache-Control", "no-store")

        await self._app(scope, receive, change_headers(send, secure))


class RequestId(Middleware):
    """Gives each request an id, the client's own where that can be used.

    What is logged while it is at work has the id as ``request_id``, in the tasks it starts, too.
    """

    @override
    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        requested_id = Headers(scope=scope).get(REQUEST_ID, "")
        name = requested_id if _USABLE.fullmatch(requested_id) else uuid4().hex

        named = change_headers(send, lambda headers: headers.update({REQUEST_ID: name}))
        with bound_contextvars(request_id=name):
            await self._app(scope, receive, named)


# --- what a client has already is not sent again: an ETag on each answer, 304 where it is the same


NOT_MODIFIED: dict[str, Any] = {
    "description": "It is what `If-None-Match` names: the client has it already",
    "headers": {"ETag": {"description": "Of the answer", "schema": {"type": "string"}}},
}
"""The OpenAPI description of an answer without a body."""

_KEPT = "private, no-cache"
"""A browser keeps a response and revalidates it each time; no proxy stores it."""


def tag_of(*parts: object) -> str:
    """Return a weak ETag that differs when one of the parts does."""
    return f'W/"{hashlib.blake2b(repr(parts).encode(), digest_size=12).hexdigest()}"'


def has_already(headers: Headers, tag: str) -> bool:
    """Return whether a request says that the client has what carries this ETag."""
    sent = {one.strip().removeprefix("W/") for one in headers.get("if-none-match", "").split(",")}
    # Weak comparison, as If-None-Match demands (RFC 9110, section 13.1.2).
    return "*" in sent or tag.removeprefix("W/") in sent


def not_modified(request: Request, tag: str) -> Response | None:
    """Return the answer that nothing has changed, None: what it asks for has to be made."""
    if not has_already(request.headers, tag):
        return None
    headers = {"ETag": tag, "Cache-Control": _KEPT}
    return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)


async def unless_kept(request: Request, tag: str, make: Callable[[], Response]) -> Response:
    """Return what a thread makes, with its ETag; nothing is made for a client that has it."""
    same = not_modified(request, tag)
    if same is not None:
        return same
    made = await run_in_threadpool(make)
    made.headers["ETag"] = tag
    return made


class Unchanged(Middleware):
    """Gives every JSON document an ETag, and sends it only to a client that has another one.

    What comes bit by bit passes as it is, and so does what has an ETag of its own and is no JSON.
    """

    @override
    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        asked, head = Headers(scope=scope), None

        async def sent(message: Message) -> None:
            nonlocal head
            # The start is held back until the body is known: its ETag and status depend on it.
            if message["type"] == "http.response.start" and _can_be_kept(scope, message):
                head = message
                return None
            if head is None:
                return await send(message)
            begun, head = head, None
            # A response in parts has no tag: it would have to be kept whole in memory.
            if message.get("more_body", False):
                await send(begun)
                return await send(message)
            headers = MutableHeaders(scope=begun)
            tag = headers.setdefault("ETag", tag_of(message["body"]))
            headers.setdefault("Cache-Control", _KEPT)
            if has_already(asked, tag):
                begun["status"], message["body"] = HTTPStatus.NOT_MODIFIED.value, b""
                # They describe the body, which a 304 does not have.
                del headers["content-length"], headers["content-type"]
            await send(begun)
            return await send(message)

        await self._app(scope, receive, sent)


def _can_be_kept(scope: Scope, start: Message) -> bool:
    is_json = Headers(raw=start["headers"]).get("content-type", "") == "application/json"
    return scope["method"] == "GET" and start["status"] == HTTPStatus.OK and is_json
