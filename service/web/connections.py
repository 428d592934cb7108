"""Requests over HTTP, whatever they ask: how much time and memory one may take, its id, done once.

The same POST sent twice, by a double click or a lost answer, is carried out once.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
from collections import OrderedDict
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any
from uuid import uuid4

import uvicorn
from fastapi import Request
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from structlog.contextvars import bound_contextvars
from typing_extensions import override
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.errors import PyrcalError, TooLargeError, TooSlowError
from service.web.problems import Problem, known_problem, problem
from service.web.stream import ABORT

MAX_BODY_BYTES = 1_000_000
"""Of a request; uploads to be fitted have a limit of their own."""

BODY_S = 20.0
"""Longest time the body of a request may take to come, seconds."""

HALF_OPEN_S = 10.0
"""Longest time a request's head may take, seconds; also for what still comes after the answer."""

MAX_CONNECTIONS = 100
"""Beyond it the one that has waited longest, with no request at work, gives way."""

RETRY_S = 5
"""When a client that finds no place should come again, seconds."""

STREAMED = ("POST", "/v1/fits")
"""The route that reads its body itself: it goes to the disk, with its own limits."""


class Middleware:
    """Stands before the application; what is no request over HTTP passes by it.

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


async def bounded(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Run a request with its whole body, if that comes in time and is not too large."""
    request = Request(scope)
    if (request.method, request.url.path) != STREAMED:
        try:
            body = await _whole(request, receive)
        except PyrcalError as error:
            return await known_problem(request, error)(scope, receive, send)
        if body is None:
            return None
        receive = again(body, receive)
    return await app(scope, receive, send)


async def to_its_end(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Run a request; one that is still at work when the service ends is told so, if it can be."""
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
            headers = {"Retry-After": str(RETRY_S)}
            await problem(Request(scope), status, "ending", detail, headers)(scope, receive, send)


async def _whole(request: Request, receive: Receive) -> bytes | None:
    """Return the body of a request; None: the client went away before it was whole.

    Raises
    ------
    TooLargeError, TooSlowError
        If it is beyond the limit, or has not come in time.
    """
    told = request.headers.get("content-length", "")
    if told.isdecimal() and int(told) > MAX_BODY_BYTES:
        raise _too_large(f"{int(told) / 1e6:.1f} MB")
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return None
                body += message.get("body", b"")
                if len(body) > MAX_BODY_BYTES:
                    raise _too_large("more")
                if not message.get("more_body", False):
                    return bytes(body)
    except TimeoutError as error:
        raise TooSlowError(f"body: {len(body)} bytes came within {BODY_S:g} s, not all") from error


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


def server_config(app: ASGIApp, **options: Any) -> uvicorn.Config:  # noqa: ANN401 - uvicorn's own
    """Return how the application is served: with limits, and nothing logged for each request."""
    return uvicorn.Config(
        app, http=_Connection, ws="none", log_config=None, access_log=False, **options
    )


async def _busy(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer instead of the application."""
    detail = f"{MAX_CONNECTIONS} requests are at work, the most there may be: try later"
    headers = {"Retry-After": str(RETRY_S), "Connection": "close"}
    status = HTTPStatus.SERVICE_UNAVAILABLE
    answer = problem(Request(scope), status, "busy", detail, headers)
    await answer(scope, receive, send)


def _abortable(app: Any, transport: asyncio.Transport) -> Any:  # noqa: ANN401 - uvicorn's own
    """Let the application end the connection itself, where nobody takes what it sends."""

    async def abortable(scope: Scope, receive: Receive, send: Send) -> None:
        scope["extensions"] = {ABORT: transport.abort}
        await app(scope, receive, send)

    return abortable


class _Connection(H11Protocol):
    """A connection that does not wait for ever, and gives way to others while it does.

    uvicorn limits the time between two requests, not that of a request's head.
    """

    _since_s = 0.0
    _ending: asyncio.TimerHandle | None = None

    @override
    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._since_s = self.loop.time()
        others = [c for c in self.connections if isinstance(c, _Connection) and c.stands]
        if len(others) > MAX_CONNECTIONS:
            resting = [c for c in others if c.rests and c is not self]
            if resting:
                min(resting, key=lambda c: c._since_s).transport.abort()  # noqa: SLF001 - its own
            else:
                self.app = _busy
        self.app = _abortable(self.app, transport)
        self._watch()

    @override
    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch()

    @override
    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._since_s = self.loop.time()
        self._watch()

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._unwatch()

    @override
    def send_400_response(self, msg: str) -> None:
        self._answer(HTTPStatus.BAD_REQUEST, "http", msg)

    @property
    def stands(self) -> bool:
        """Whether it has not been ended yet; one that has is gone a moment later."""
        return not self.transport.is_closing()

    @property
    def rests(self) -> bool:
        """Whether no request is at work."""
        begun = self.cycle is not None  # though its type says that it always is
        return not begun or self.cycle.response_complete

    def _watch(self) -> None:
        """Start the clock when something is awaited that no request needs, else stop it."""
        if not self.rests or self.transport.is_closing():
            self._unwatch()
        elif self._ending is None:
            self._ending = self.loop.call_later(HALF_OPEN_S, self._end)

    def _unwatch(self) -> None:
        if self._ending is not None:
            self._ending.cancel()
            self._ending = None

    def _end(self) -> None:
        head_came_half = self.conn.trailing_data[0] and self.cycle is None
        if head_came_half:
            detail = f"the head of the request did not come within {HALF_OPEN_S:g} s"
            self._answer(HTTPStatus.REQUEST_TIMEOUT, "too-slow", detail)
        else:
            self.transport.abort()

    def _answer(self, status: HTTPStatus, kind: str, detail: str) -> None:
        """Answer without the application, which has not heard of a request, and close."""
        if self.rests:
            told = Problem.of(status, kind, detail, instance="")
            body = json.dumps(told.model_dump()).encode()
            head = (
                f"HTTP/1.1 {status} {status.phrase}\r\nContent-Type: application/problem+json\r\n"
                f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
            )
            self.transport.write(head.encode() + body)
        self.transport.close()


# --- the same POST is carried out once


ONCE = "idempotency-key"
"""Header of whoever may send a request again."""

LONGEST_KEY = 200
MAX_KEPT = 1000
"""Answers that are remembered; the oldest go first."""

LARGEST_KEPT = 100_000
"""Bytes: an order's answer is a few hundred."""

_NOT_DONE = {HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.INSUFFICIENT_STORAGE}
"""Answers that say that nothing was done: the next time may do it."""

_Name = tuple[object, str]
"""Who may act, and the key of that one."""


@dataclass(eq=False, slots=True)
class _StoredAnswer:
    """A request with a key, and its answer once there is one."""

    print: bytes
    """Of method, path and body."""

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
        if not (0 < len(key) <= LONGEST_KEY and key.isprintable()):
            found = f"found {len(key)} characters, expected 1 to {LONGEST_KEY} printable ones"
            return await self._refuse(request, send, found)
        name = (request.user and request.user.name, key)
        body = await request.body()
        print_ = hashlib.sha256(f"{request.method} {request.url}\n".encode() + body).digest()
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
        heard: list[Message] = []

        async def noted(message: Message) -> None:
            heard.append(message)
            await send(message)

        try:
            await self._app(scope, receive, noted)
            if _lasts(heard):
                given.answer = heard
        finally:
            if not given.answer and self._given.get(name) is given:
                del self._given[name]
            given.done.set()
            while len(self._given) > MAX_KEPT:
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
    return messages[0]["status"] not in _NOT_DONE and size <= LARGEST_KEPT


# --- which request has led to what: an id in its answer and in every line of the log


REQUEST_ID = "x-request-id"

_USABLE = re.compile(r"[A-Za-z0-9._-]{1,64}")
"""An id of the client's own that is harmless in a log."""


class RequestId(Middleware):
    """Gives each request an id, the client's own where that can be used.

    What is logged while it is at work has the id as ``request_id``, in the tasks it starts, too.
    """

    @override
    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        told = Headers(scope=scope).get(REQUEST_ID, "")
        name = told if _USABLE.fullmatch(told) else uuid4().hex

        async def named(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[REQUEST_ID] = name
            await send(message)

        with bound_contextvars(request_id=name):
            await self._app(scope, receive, named)
