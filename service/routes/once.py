"""The same POST sent twice, by a double click or a lost answer, is carried out once."""

from __future__ import annotations

import asyncio
import hashlib
from collections import OrderedDict
from dataclasses import dataclass, field
from http import HTTPStatus

from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.routes.connections import STREAMED, again
from service.routes.problems import problem

KEY = "idempotency-key"

LONGEST_KEY = 200
MOST_KEPT = 1000
"""Answers that are remembered; the oldest go first."""

LARGEST_KEPT = 100_000
"""Bytes: an order's answer is a few hundred."""

_NOT_DONE = {HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.INSUFFICIENT_STORAGE}
"""Answers that say that nothing was done: the next time may do it."""


_Name = tuple[object, str]
"""Who may act, and the key of that one."""


@dataclass(eq=False, slots=True)
class _Given:
    """A request with a key, and its answer once there is one."""

    print: bytes
    """Of method, path and body."""

    answer: list[Message] = field(default_factory=list)
    done: asyncio.Event = field(default_factory=asyncio.Event)


class Once:
    """Answers a POST with an ``Idempotency-Key`` that has been answered as it was answered then.

    One that comes while the first is at work waits for its answer. What is remembered is lost
    with the service, and bounded.

    Parameters
    ----------
    app
        The application.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._given: OrderedDict[_Name, _Given] = OrderedDict()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or hand it on."""
        if scope["type"] != "http" or scope["method"] != "POST":
            return await self._app(scope, receive, send)
        request = Request(scope, receive)
        key = request.headers.get(KEY)
        if key is None:
            return await self._app(scope, receive, send)
        return await self._answer(request, key, send)

    async def _answer(self, request: Request, key: str, send: Send) -> None:
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
        return await self._carry_out(name, print_, receive, request.scope, send)

    async def _carry_out(
        self, name: _Name, print_: bytes, receive: Receive, scope: Scope, send: Send
    ) -> None:
        """Hand a request on, and remember what it is answered."""
        given = _Given(print_)
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
            while len(self._given) > MOST_KEPT:
                self._given.popitem(last=False)

    async def _refuse(self, request: Request, send: Send, found: str) -> None:
        detail = f"header.Idempotency-Key: {found}"
        answer = problem(request, HTTPStatus.UNPROCESSABLE_ENTITY, "idempotency-key", detail)
        await answer(request.scope, request.receive, send)


def _lasts(heard: list[Message]) -> bool:
    """Return whether an answer is to be given again: whole, small, and of something done."""
    if not heard or heard[-1].get("more_body", False):
        return False
    size = sum(len(message.get("body", b"")) for message in heard)
    return heard[0]["status"] not in _NOT_DONE and size <= LARGEST_KEPT
