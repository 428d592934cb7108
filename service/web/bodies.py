"""Read the body of a request as a whole, within a limit of size and time."""

from __future__ import annotations

import asyncio

from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import PyrcalError, TooLargeError, TooSlowError
from service.web.problems import known_problem

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
