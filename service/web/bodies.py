"""Bodies of requests: whole, in time, not too large, not too many at once."""

from __future__ import annotations

import asyncio
import random

from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import PyrcalError, TooLargeError, TooSlowError
from service.web.problems import known_problem

MAX_BODY_BYTES = 1_000_000
"""Of a request; uploads to be fitted have a limit of their own."""

BODY_S = 20.0
"""Longest time the body of a request may take to come, seconds."""

PATIENCE_S = 3.0
"""What a body may take whatever its rate: an order crosses a poor network in that, seconds. Up to a
third more, by chance: bodies that came together are not refused together, with others waiting."""

SLOWEST_BYTES_S = 1000
"""Bytes a second that must come from then on."""

MAX_BODIES = 500
"""Bodies that may be on their way at once; beyond it the one that has been so longest gives way: an
order finds a place whatever others hold."""

MAX_HELD_BYTES = 50_000_000
"""Of all of them together; beyond it the same one gives way."""

OnTheirWay = dict[object, tuple[asyncio.Timeout, bytearray]]
"""By request, oldest first: the time that its body has, and what has come of it."""

STREAMED = ("POST", "/v1/fits")
"""The route that reads its body itself: it goes to the disk, with its own limits."""


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
    body, began_s = bytearray(), asyncio.get_running_loop().time()
    patience_s = PATIENCE_S * random.uniform(1.0, 4.0 / 3.0)
    on_their_way: OnTheirWay = request.app.state.bodies
    try:
        async with asyncio.timeout_at(began_s + min(patience_s, BODY_S)) as limit:
            if told or "transfer-encoding" in request.headers:
                on_their_way[request] = limit, body
            while True:
                _make_room(on_their_way)
                message = await receive()
                if message["type"] == "http.disconnect":
                    return None
                body += message.get("body", b"")
                if len(body) > MAX_BODY_BYTES:
                    raise _too_large("more")
                if not message.get("more_body", False):
                    return bytes(body)
                limit_s = min(patience_s + len(body) / SLOWEST_BYTES_S, BODY_S)
                limit.reschedule(began_s + limit_s)
    except TimeoutError as error:
        took_s = asyncio.get_running_loop().time() - began_s
        found = f"found {len(body)} bytes in {took_s:.1f} s, not all"
        raise TooSlowError(
            f"body: {found}, expected at least {SLOWEST_BYTES_S} bytes a second"
        ) from error
    finally:
        on_their_way.pop(request, None)


def _make_room(on_their_way: OnTheirWay) -> None:
    """Let those that have been on their way longest have no time left, where there are too many."""
    held = sum(len(body) for _, body in on_their_way.values())
    while len(on_their_way) > MAX_BODIES or held > MAX_HELD_BYTES:
        limit, body = on_their_way.pop(next(iter(on_their_way)))
        held -= len(body)
        if not limit.expired():
            limit.reschedule(asyncio.get_running_loop().time())


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
