"""The operator's page: its files, the manual, and its data.

The data are the stream of state and log, the last slopes, and the nominal geometry of the mirror.
"""

from __future__ import annotations

import asyncio
import json
import re
import time
import zlib
from collections.abc import AsyncIterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from fastapi import APIRouter, FastAPI, Header, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, StreamingResponse
from numpy.typing import NDArray
from pydantic_core import from_json
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send
from typing_extensions import override

from service.control.gate import MAX_EDGE_MOTION_M
from service.errors import BusyError, UnknownIdError
from service.estimation.frames import FrameBlock
from service.model.instrument import Instrument, Mirror
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.model.pupil import rtc_valid_subapertures
from service.model.slopes import as_maps, orient_mask, slopes_of, to_conventions
from service.records.state import LogEntry
from service.runtime.supervisor import Supervisor
from service.tracking.step_context import LOG_LENGTH
from service.web.authentication import OPEN
from service.web.connections import Middleware, change_headers
from service.web.problems import INVALID, problem_response
from service.web.views import ServiceDep, answer, as_json, define_view, held, shows

router = APIRouter(prefix="/v1", tags=["state"])

FILES: Final = Path(__file__).parent / "dashboard"

MANUAL: Final = Path(__file__).parent / "manual"
"""Folder of the manual that ``make docs`` writes."""

SWAGGER: Final = Path(__file__).parent / "swagger"
"""Swagger UI, which shows what REST answers and tries it out: no observatory needs the internet."""

OPENAPI: Final = Path(__file__).parent / "openapi.json"
"""The OpenAPI document, written by ``python -m pyrcal_studies.pages``."""

HEADERS: Final = {
    # its own files and its own service: nothing inline, no other host
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    # asked for again each time, 304 while it is the same: never the page of another version
    "Cache-Control": "no-cache",
}


MANUAL_HEADERS: Final = {
    **HEADERS,
    # its search is a form, its theme has icons as fonts and in its style sheet
    "Content-Security-Policy": HEADERS["Content-Security-Policy"]
    .replace("form-action 'none'", "form-action 'self'; font-src 'self'")
    .replace("img-src 'self'", "img-src 'self' data:"),
}

SWAGGER_HEADERS: Final = {
    **HEADERS,
    # Swagger UI sets styles of elements, and has its icons in its style sheet
    "Content-Security-Policy": HEADERS["Content-Security-Policy"]
    .replace("style-src 'self'", "style-src 'self' 'unsafe-inline'")
    .replace("img-src 'self'", "img-src 'self' data:"),
}


def install(app: FastAPI) -> None:
    """Serve the page at ``/``, what REST answers at ``/docs``, the manual, and their files."""

    @app.get("/", include_in_schema=False, openapi_extra=OPEN)
    async def page() -> Response:
        return FileResponse(FILES / "index.html", headers=HEADERS)

    @app.get("/openapi.json", include_in_schema=False, openapi_extra=OPEN)
    async def openapi() -> Response:
        return Response(OPENAPI.read_bytes(), media_type="application/json")

    @app.get("/docs", include_in_schema=False, openapi_extra=OPEN)
    async def swagger() -> Response:
        return FileResponse(SWAGGER / "index.html", headers=SWAGGER_HEADERS)

    app.add_middleware(Packed)
    app.mount("/dashboard", _with_headers(StaticFiles(directory=FILES), HEADERS))
    app.mount("/docs/files", _with_headers(StaticFiles(directory=SWAGGER), SWAGGER_HEADERS))
    manual = _Manual(directory=MANUAL, html=True, check_dir=False)
    app.mount("/manual", _with_headers(manual, MANUAL_HEADERS))


class _Manual(StaticFiles):
    """The manual, from the moment it has been built."""

    @override
    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if not (MANUAL / "index.html").is_file():
            detail = (
                "the manual has not been built: run make docs in the checkout; an image has it. "
                "Its pages are the files of docs/"
            )
            raise HTTPException(HTTPStatus.SERVICE_UNAVAILABLE, detail)
        await super().__call__(scope, receive, send)


class Packed(Middleware):
    """Compresses what the page is made of, and the long lists it reads.

    Not what is compressed already or cannot be, as noise in a matrix, nor a stream, nor what every
    page asks for every second: that would cost more than it saves.
    """

    def __init__(self, app: ASGIApp) -> None:
        super().__init__(app)
        self._packing = GZipMiddleware(app, minimum_size=1000, compresslevel=4)

    @override
    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        packs = _PACKED.fullmatch(scope["path"])
        await (self._packing if packs else self._app)(scope, receive, send)


_PACKED: Final = re.compile(
    r"/|/dashboard/.*|/v1/(alpha/history|trends|marks|annotations|gains(/history)?|mirror|events|reconstructors)"
    r"|/v1/fits/[^/]*/figures"
)


def _with_headers(app: ASGIApp, headers: Mapping[str, str]) -> ASGIApp:
    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        await app(scope, receive, change_headers(send, lambda sent: sent.update(headers)))

    return guarded


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MirrorDrawing:
    """The mirror on the sensor, as far as it can be drawn: lengths in subapertures, centred."""

    n_subapertures: int
    """Subapertures across the sensor's grid."""

    pupil_diameter_subap: float
    """Diameter of the pupil image, subapertures."""

    obscuration_ratio: float
    """Obscuration ratio of the pupil, linear."""

    stop: Stop
    """Stop of the pupil: with "mirror" its rim moves with the shift and keeps its size, with
    "telescope" it stays."""

    nominal: Misregistration
    """Nominal registration by the instrument file."""

    tolerance: NDArray[np.float64]
    """``(4,)`` distance from the registration of the reconstructor in use from which a new one is
    made whatever it gains, numeric units."""

    edge_limit_m: float
    """Largest RMS motion of an outer actuator for slope noise of 1 that the gate accepts."""

    actuators: tuple[tuple[float, float], ...]
    """x and y of each actuator on the sensor at nominal registration; empty if the modes were
    measured and the actuators are unknown."""


MIRROR: Final = define_view("MirrorView", MirrorDrawing)


@router.get("/mirror", responses={200: shows(MIRROR)})
async def mirror(service: ServiceDep) -> Response:
    """Return the nominal geometry of the mirror on the sensor.

    ``GET /v1/alpha`` has its registration.
    """
    instrument = service.instrument
    wfs = instrument.wfs
    return answer(
        MirrorDrawing(
            n_subapertures=wfs.n_subapertures,
            pupil_diameter_subap=wfs.pupil_diameter,
            obscuration_ratio=instrument.obscuration_ratio,
            stop=instrument.stop,
            nominal=instrument.start,
            tolerance=service.policy.update_threshold,
            edge_limit_m=MAX_EDGE_MOTION_M,
            actuators=_actuators(instrument),
        )
    )


def _actuators(instrument: Instrument) -> tuple[tuple[float, float], ...]:
    mirror = instrument.mirror
    if not isinstance(mirror, Mirror):
        return ()
    places = mirror.positions_m / instrument.subaperture_m * [1.0, mirror.y_sign]
    return tuple((round(x, 4), round(y, 4)) for x, y in places.tolist())


# --- the last slopes


@dataclass(frozen=True, slots=True, kw_only=True)
class SlopeMaps:
    """The last slopes, over the subapertures.

    Rows from the lowest y upwards, Sx and Sy side by side, in the axes of the conventions; null
    where none is valid.
    """

    t_ns_utc: int
    """Time of the first of these frames, by the RTC's clock."""

    n_frames: int
    """About a tenth of a second of them."""

    cm_id: str | None
    """Reconstructor that multiplied them; null if unknown."""

    rms: list[list[float]]
    """Over these frames, about zero, in the slopes' own unit."""


SHOWN_S = 0.5
"""Time for which a picture of the slopes is reused."""

SLOPES = define_view("SlopeMapsView", SlopeMaps)


class SlopesCache:
    """The last slopes as they leave, worked out once for all pages: each asks every second."""

    def __init__(self) -> None:
        self._body = b""
        self._until_s = 0.0

    def body(self, service: Supervisor) -> bytes:
        """Return them as JSON, at most ``SHOWN_S`` old; telemetry must have come."""
        block, now_s = service.newest_frames, time.monotonic()
        if block is not None and now_s >= self._until_s:
            self._body = bytes(answer(_maps(block, service.instrument)).body)
            self._until_s = now_s + SHOWN_S
        return self._body


@router.get(
    "/slopes",
    responses={200: shows(SLOPES), 404: problem_response("No telemetry has come yet"), **INVALID},
)
async def slopes(service: ServiceDep, shown: Annotated[SlopesCache, held("slopes")]) -> Response:
    """Return the RMS of the last residual slopes as maps."""
    if service.newest_frames is None:
        raise UnknownIdError("slopes: no telemetry has come yet")
    return Response(await run_in_threadpool(shown.body, service), media_type="application/json")


def _maps(block: FrameBlock, instrument: Instrument) -> SlopeMaps:
    valid = rtc_valid_subapertures(instrument)
    recipe, orientation = instrument.slopes, instrument.slopes.assumed_orientation
    ours = slopes_of(to_conventions(block.slopes.T, recipe, valid), recipe.kind)
    rms = np.sqrt(np.mean(np.square(ours, dtype=np.float64), axis=-1)).reshape(-1)
    maps = np.round(as_maps(rms, orient_mask(valid, orientation)), 4)
    return SlopeMaps(
        t_ns_utc=block.t0_ns_utc,
        n_frames=block.n_frames,
        cm_id=block.cm_id,
        rms=maps.tolist(),
    )


# --- server-sent events, rendered once for all listeners


STREAM_PERIOD_S = 0.5
"""Period at which the stream looks for changes, seconds. All listeners share one snapshot."""

MAX_STREAM_SILENCE_S = 10.0
"""Longest silence of the stream, seconds; then a comment and the state are sent."""

MAX_LISTENERS = 60
"""Listeners to the stream. Fewer than connections, so that other requests find a place."""

RETRY_MS = 1000
"""Time after which a disconnected listener reconnects, milliseconds."""

_CLOCKS = ("now_ns", "now_utc", "uptime_s", "age_s")
"""Ends of the names of the state's fields that change while nothing happens."""

Log = tuple[LogEntry, ...]


class Stream:
    """Server-sent events of the service for every listener.

    There is no queue: the service's log is one, and a listener has a position in it. One that falls
    further behind than the log reaches is instructed to read the whole log again. Of the state only
    the newest is sent.

    Parameters
    ----------
    service
        Service whose state and log are sent.
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

    async def listen(self, received_id: str) -> AsyncIterator[bytes]:
        """Yield server-sent events that follow the log line with this id, the last one received."""
        ids: list[str] | None = None
        version, quiet_since = 0, 0
        yield f"retry: {RETRY_MS}\n\n".encode()
        while not self._over.is_set():
            now, news = self._look(), b""
            if version != self._version:
                version, news = self._version, self._state
            elif now - quiet_since >= MAX_STREAM_SILENCE_S / STREAM_PERIOD_S:
                news = b": nothing new\n\n" + self._state
            # The list is made anew only when the log has changed.
            if self._ids is not ids:
                ids = self._ids
                news += self._since(received_id)
                received_id = ids[-1]
            if news:
                quiet_since = now
                yield news
            await self._next_look()

    def _look(self) -> int:
        """Render what is known, unless it was in this moment; return the number of the moment."""
        now = int(asyncio.get_running_loop().time() / STREAM_PERIOD_S)
        if now != self._looked:
            self._looked = now
            snapshot = self._service.snapshot()
            if self._log is not snapshot.tracker.log:
                self._log = snapshot.tracker.log
                self._ids = _ids(self._log, snapshot.started_ns)
            shown = as_json(snapshot)
            # Ages change with every look: with them the state would be sent twice a second for
            # ever.
            lasting = _without_clocks(from_json(shown))
            self._version += lasting != self._lasting
            self._lasting = lasting
            self._state = _event("state", shown.encode())
        return now

    async def _next_look(self) -> None:
        """Wait for the next moment, or the end."""
        time_s = asyncio.get_running_loop().time()
        rest_s = STREAM_PERIOD_S - time_s % STREAM_PERIOD_S
        with suppress(TimeoutError):
            # A little later than the moment, so that the clock has surely reached it.
            async with asyncio.timeout(rest_s + 1e-3):
                await self._over.wait()

    def _since(self, received_id: str) -> bytes:
        """Return the events after a log line."""
        if received_id not in self._ids:
            return _event("reset", b'{"log":"/v1/events"}', self._ids[-1])
        first = self._ids.index(received_id)
        lines = zip(self._ids[first + 1 :], (self._log or ())[first:], strict=True)
        return b"".join(_event("log", as_json(e).encode(), k) for k, e in lines)


def _ids(log: Log, started_ns: int) -> list[str]:
    """Return ids of the log's beginning and of its lines, constant while one service runs.

    If the log has dropped lines, no listener can have received its beginning.
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
        if not key.endswith(_CLOCKS)
    }


def _event(name: str, data: bytes, identity: str = "") -> bytes:
    head = f"event: {name}\n" + (f"id: {identity}\n" if identity else "")
    return head.encode() + b"data: " + data + b"\n\n"


class _EventStream(StreamingResponse):
    """One listener's stream."""

    media_type = "text/event-stream"

    def __init__(self, stream: Stream, received_id: str) -> None:
        # The second header keeps nginx from holding the events back.
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        super().__init__(stream.listen(received_id), headers=headers)
        self._stream = stream

    @override
    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        # Counted here and not in listen(), which begins only with the first byte.
        self._stream.n_listeners += 1
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._stream.n_listeners -= 1


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
        **INVALID,
    },
)
async def stream(
    stream: Annotated[Stream, held("stream")],
    last_event_id: Annotated[str, Header(max_length=200)] = "",
) -> StreamingResponse:
    """Send the state, at most twice a second, and the log as it grows.

    A client that sends its last id in ``Last-Event-ID`` gets the lines it has missed.
    """
    if stream.n_listeners >= MAX_LISTENERS:
        raise BusyError(f"stream: found {MAX_LISTENERS} listeners, the most there may be")
    return _EventStream(stream, last_event_id)
