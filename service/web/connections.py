"""Idle connections, request ids, idempotency, what a client has already.

The same POST sent twice, by a double click or a lost answer, is carried out once; what a client has
already is not sent again.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import re
import resource
import socket
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any
from uuid import uuid4

import uvicorn
from fastapi import Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from structlog.contextvars import bound_contextvars
from typing_extensions import override

from service.web.bodies import STREAMED, again
from service.web.problems import problem

IDLE_S = 10.0
"""Longest time a request's head may take, seconds, or nothing be taken of an answer."""

MAX_IDLE = 2000
"""Connections that may wait so, half of the descriptors at most; beyond it those that have waited
longest give way. One that waits costs nothing, one that comes back again and again does."""

MAX_DESCRIPTORS = 8192
"""That the service asks of the system, where its limit is less."""

AT_ONCE = 20
"""Connections that are taken, or ended, before others have their turn."""

BREATH_S = 0.1
"""Between two lots that have stood still for too long: those that came together would come back
together, and have others wait."""

MAX_PENDING = 2048
"""Connections that the system holds until they are taken."""

TICK_S = 0.9
"""From one look of the server's at what is idle to the next, besides uvicorn's own 0.1 s."""

RETRY_S = 5
"""When a client that finds no place should come again, seconds."""


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
            headers = {"Retry-After": str(RETRY_S)}
            await problem(Request(scope), status, "ending", detail, headers)(scope, receive, send)


class Server(uvicorn.Server):
    """uvicorn that ends with the service and closes idle connections.

    uvicorn limits the time between two requests, not that of a request's head, and not how long
    it waits for somebody who takes nothing of an answer.

    Parameters
    ----------
    app
        The application.
    over
        Set when the service ends.
    within_s
        For requests that are under way then.
    proxies
        Addresses and networks whose word is taken for who asks, and how: ``X-Forwarded-For``,
        ``X-Forwarded-Proto``.
    """

    def __init__(
        self, app: ASGIApp, over: asyncio.Event, *, within_s: int, proxies: tuple[str, ...] = ()
    ) -> None:
        config = uvicorn.Config(
            app,
            http="h11",
            ws="none",
            log_config=None,
            access_log=False,
            backlog=AT_ONCE,
            timeout_graceful_shutdown=within_s,
            proxy_headers=bool(proxies),
            forwarded_allow_ips=list(proxies),
        )
        super().__init__(config)
        self._over = over
        self._since_s: dict[object, float] = {}
        self._max_idle = min(MAX_IDLE, _descriptors() // 2)

    @override
    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for listener in sockets or ():
            listener.listen(
                MAX_PENDING
            )  # asyncio takes ``backlog`` for what it accepts at once, too

    @override
    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield  # uvicorn would raise them again before all is closed

    @override
    async def on_tick(self, counter: int) -> bool:
        over = await super().on_tick(0)  # the date of answers is told anew
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(TICK_S):
                await self._end_idle()
                await self._over.wait()
        return over or self._over.is_set()

    async def _end_idle(self) -> None:
        """End what has stood still for too long; of too much, what has done so the longest."""
        now_s = time.monotonic()
        idle = {still: one for one in self.server_state.connections if (still := _stands(one))}
        self._since_s = {still: self._since_s.get(still, now_s) for still in idle}
        by_age = sorted(idle, key=self._since_s.__getitem__)
        n_too_many = max(len(by_age) - self._max_idle, 0)
        for n_seen, still in enumerate(by_age):
            at_leisure = n_seen >= n_too_many
            if self._over.is_set() or (at_leisure and now_s - self._since_s[still] <= IDLE_S):
                return
            if n_seen % AT_ONCE == 0:
                await asyncio.sleep(BREATH_S if at_leisure else 0)
            if _stands(idle[still]) == still:
                idle[still].transport.abort()


def _descriptors() -> int:
    """Return how many files and connections the service may hold, once it has asked for more."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(MAX_DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    return wanted if soft == resource.RLIM_INFINITY else max(soft, wanted)


def _stands(connection: Any) -> tuple[object, ...]:  # noqa: ANN401 - uvicorn's own
    """Return where a connection stands still, until it does something; empty: it is at work."""
    n_unsent, cycle = connection.transport.get_write_buffer_size(), connection.cycle
    at_work = cycle is not None and not cycle.response_complete
    return () if at_work and not n_unsent else (connection, cycle, n_unsent)


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


class SecurityHeaders(Middleware):
    """Has no answer taken for another type than it says, nor kept where it does not say so."""

    @override
    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def headed(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.setdefault("X-Content-Type-Options", "nosniff")
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        await self._app(scope, receive, headed)


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


# --- what a client has already is not sent again: an ETag on each answer, 304 where it is the same


NOT_MODIFIED: dict[str, Any] = {
    "description": "It is what `If-None-Match` names: the client has it already",
    "headers": {"ETag": {"description": "Of the answer", "schema": {"type": "string"}}},
}
"""The OpenAPI description of an answer without a body."""

_KEPT = "private, no-cache"
"""A browser keeps an answer and asks each time whether it still holds; nobody between does."""


def tag_of(*parts: object) -> str:
    """Return a weak ETag that differs when one of the parts does."""
    return f'W/"{hashlib.blake2b(repr(parts).encode(), digest_size=12).hexdigest()}"'


def has_already(headers: Headers, tag: str) -> bool:
    """Return whether a request says that the client has what carries this ETag."""
    sent = {one.strip().removeprefix("W/") for one in headers.get("if-none-match", "").split(",")}
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
            if message["type"] == "http.response.start" and _can_be_kept(scope, message):
                head = message
                return None
            if head is None:
                return await send(message)
            begun, head = head, None
            if message.get("more_body", False):
                await send(begun)
                return await send(message)
            headers = MutableHeaders(scope=begun)
            tag = headers.setdefault("ETag", tag_of(message["body"]))
            headers.setdefault("Cache-Control", _KEPT)
            if has_already(asked, tag):
                begun["status"], message["body"] = HTTPStatus.NOT_MODIFIED.value, b""
                del headers["content-length"], headers["content-type"]
            await send(begun)
            return await send(message)

        await self._app(scope, receive, sent)


def _can_be_kept(scope: Scope, start: Message) -> bool:
    is_json = Headers(raw=start["headers"]).get("content-type", "") == "application/json"
    return scope["method"] == "GET" and start["status"] == HTTPStatus.OK and is_json
