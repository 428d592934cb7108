"""Which request has led to what: an id that is in its answer and in every line of the log."""

from __future__ import annotations

import re
from uuid import uuid4

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from structlog.contextvars import bound_contextvars

HEADER = "x-request-id"

_USABLE = re.compile(r"[A-Za-z0-9._-]{1,64}")
"""An id of the client's own that is harmless in a log."""


class Traced:
    """Gives each request an id, the client's own where that can be used.

    What is logged while it is at work has the id as ``request_id``, in the tasks it starts, too.

    Parameters
    ----------
    app
        The application.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, with its id."""
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        told = Headers(scope=scope).get(HEADER, "")
        name = told if _USABLE.fullmatch(told) else uuid4().hex

        async def named(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[HEADER] = name
            await send(message)

        with bound_contextvars(request_id=name):
            return await self._app(scope, receive, named)
