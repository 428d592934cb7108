"""Server-sent events, rendered once for all listeners."""

from __future__ import annotations

import asyncio
import json
import zlib
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Request
from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send
from typing_extensions import override

from service.errors import BusyError
from service.runtime.supervisor import Supervisor
from service.tracking.state import LogEntry
from service.tracking.step_context import LOG_LENGTH
from service.web.problems import INVALID, problem_response
from service.web.views import as_json, to_json

router = APIRouter(prefix="/v1", tags=["state"], responses={**INVALID})

LOOK_S = 0.5
"""Between two looks at what is new, seconds: all listeners wake together and share one."""

HEARTBEAT_S = 10.0
"""Longest silence, seconds: then comes a comment, and the state as it is."""

MAX_LISTENERS = 60
"""Fewer than there may be connections: others want to ask something, too."""

RETRY_MS = 1000
"""When a listener that was cut off should come back, milliseconds."""

_CLOCKS = {"now_ns", "now_utc", "uptime_s", "age_s", "window_age_s", "frame_age_s"}
"""What changes in the state while nothing happens."""

Log = tuple[LogEntry, ...]


class Stream:
    """The service's news for every listener.

    There is no queue: the service's log is one, and a listener is a place in it. One that falls
    further behind than the log reaches is told to read the whole of it again. Of the state only the
    newest is sent.

    Parameters
    ----------
    service
        Whose state and log it is.
    over
        Set when the service ends: so does every stream.
    """

    def __init__(self, service: Supervisor, over: asyncio.Event) -> None:
        self._service = service
        self._over = over
        self._looked = -1
        self._log: Log | None = None
        self._ids: list[str] = []
        self._lasting: dict[str, Any] = {}
        self._state = b""
        self._version = 0
        self.n_listeners = 0
        """Streams that are open."""

    async def listen(self, heard: str) -> AsyncIterator[bytes]:
        """Yield server-sent events after the log line with the id ``heard``."""
        ids: list[str] | None = None
        version, quiet_since = 0, 0
        yield f"retry: {RETRY_MS}\n\n".encode()
        while not self._over.is_set():
            now, news = self._look(), b""
            if version != self._version:
                version, news = self._version, self._state
            elif now - quiet_since >= HEARTBEAT_S / LOOK_S:
                news = b": nothing new\n\n" + self._state
            if self._ids is not ids:
                ids = self._ids
                news += self._since(heard)
                heard = ids[-1]
            if news:
                quiet_since = now
                yield news
            await self._next_look()

    def _look(self) -> int:
        """Render what is known, unless it was in this moment; return the number of the moment."""
        now = int(asyncio.get_running_loop().time() / LOOK_S)
        if now != self._looked:
            self._looked = now
            snapshot = self._service.snapshot()
            if self._log is not snapshot.tracker.log:
                self._log = snapshot.tracker.log
                self._ids = _ids(self._log, snapshot.started_ns)
            shown = to_json(snapshot)
            lasting = _without_clocks(shown)
            self._version += lasting != self._lasting
            self._lasting = lasting
            self._state = _event("state", as_json(shown))
        return now

    async def _next_look(self) -> None:
        """Wait for the next moment, or the end."""
        time_s = asyncio.get_running_loop().time()
        with suppress(TimeoutError):
            async with asyncio.timeout(LOOK_S * (1.0 - time_s / LOOK_S % 1.0) + 1e-3):
                await self._over.wait()

    def _since(self, heard: str) -> bytes:
        """Return the events after a log line."""
        if heard not in self._ids:
            return _event("reset", b'{"log":"/v1/events"}', self._ids[-1])
        first = self._ids.index(heard)
        lines = zip(self._ids[first + 1 :], (self._log or ())[first:], strict=True)
        return b"".join(_event("log", as_json(to_json(e)), k) for k, e in lines)


def _ids(log: Log, started_ns: int) -> list[str]:
    """Return ids of the log's beginning and of its lines: the same for as long as one service runs.

    Where the log has left out lines its beginning is nothing that anybody can have heard.
    """
    run = f"{started_ns:x}"
    beginning = run if len(log) < LOG_LENGTH else f"{run}-"
    words = (json.dumps([entry.name, entry.text]).encode() for entry in log)
    lines = zip(log, words, strict=True)
    return [beginning, *(f"{run}-{entry.t_ns_utc:x}-{zlib.crc32(text):x}" for entry, text in lines)]


def _without_clocks(shown: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _without_clocks(value) if isinstance(value, dict) else value
        for key, value in shown.items()
        if key not in _CLOCKS
    }


def _event(name: str, data: bytes, identity: str = "") -> bytes:
    head = f"event: {name}\n" + (f"id: {identity}\n" if identity else "")
    return head.encode() + b"data: " + data + b"\n\n"


class _EventStream(StreamingResponse):
    """One listener's stream."""

    media_type = "text/event-stream"

    def __init__(self, stream: Stream, heard: str) -> None:
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        super().__init__(stream.listen(heard), headers=headers)
        self._stream = stream

    @override
    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._stream.n_listeners += 1
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._stream.n_listeners -= 1


async def _stream_of(request: Request) -> Stream:
    stream: Stream = request.app.state.stream
    return stream


@router.get(
    "/stream",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "`event: state` as `GET /v1/state` shows it, `event: log` a line of "
            "`GET /v1/events`, `event: reset` where lines are missing: read them all again",
            "content": {"text/event-stream": {"schema": {"type": "string"}}},
        },
        503: problem_response("Too many listen already"),
    },
)
async def stream(
    stream: Annotated[Stream, Depends(_stream_of)],
    last_event_id: Annotated[str, Header(max_length=200)] = "",
) -> StreamingResponse:
    """Send the state, at most twice a second, and the log as it grows.

    Who comes back with the ``Last-Event-ID`` it has heard gets the lines it has missed.
    """
    if stream.n_listeners >= MAX_LISTENERS:
        raise BusyError(f"stream: found {MAX_LISTENERS} listeners, the most there may be")
    return _EventStream(stream, last_event_id)
