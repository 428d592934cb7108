"""The operator's page and the manual."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Final

import numpy as np
from fastapi import APIRouter, FastAPI, Response
from fastapi.responses import FileResponse
from numpy.typing import NDArray
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from typing_extensions import override

from service.control.gate import LIMIT_M
from service.model.instrument import Instrument, Mirror
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.web.authentication import OPEN
from service.web.connections import Middleware
from service.web.views import ServiceDep, answer, define_view, shows

router = APIRouter(prefix="/v1", tags=["state"])

FILES: Final = Path(__file__).parent / "dashboard"

MANUAL: Final = Path(__file__).parent / "manual"
"""Where ``make docs`` has put the manual."""

SWAGGER: Final = Path(__file__).parent / "swagger"
"""Swagger UI, which shows what REST answers and tries it out: no observatory needs the internet."""

OPENAPI: Final = Path(__file__).parent / "openapi.json"
"""What REST answers: ``python -m studies.pages`` writes it."""

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
    # it can be searched
    "Content-Security-Policy": HEADERS["Content-Security-Policy"].replace(
        "form-action 'none'", "form-action 'self'"
    ),
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
    r"/|/dashboard/.*|/v1/(alpha/history|trends|marks|annotations|gains|mirror|events|reconstructors)"
    r"|/v1/fits/[^/]*/figures"
)


def _with_headers(app: ASGIApp, headers: Mapping[str, str]) -> ASGIApp:
    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(headers)
            await send(message)

        await app(scope, receive, sent)

    return guarded


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MirrorDrawing:
    """The mirror on the sensor, as far as it can be drawn: lengths in subapertures, centred."""

    n_subapertures: int
    """Across the sensor's grid."""

    pupil_diameter_subap: float
    """Of the pupil's image."""

    obscuration_ratio: float
    """Of it, linear."""

    stop: Stop
    """"mirror": the pupil's rim moves with the shift, and keeps its size; "telescope": it stays."""

    nominal: Misregistration
    """Where the mirror should be: what the instrument file says."""

    tolerance: NDArray[np.float64]
    """``(4,)`` further than this from what the reconstructor in use was made for, and another one
    is made whatever it wins, numeric units."""

    edge_limit_m: float
    """Largest RMS motion of an outer actuator for slope noise of 1 that the gate accepts."""

    actuators: tuple[tuple[float, float], ...]
    """x and y of each on the sensor where α is nothing; empty: modes were measured, and nobody has
    told where the actuators are."""


MIRROR: Final = define_view("MirrorView", MirrorDrawing)


@router.get("/mirror", responses={200: shows(MIRROR)})
async def mirror(service: ServiceDep) -> Response:
    """Return the mirror's drawing on the sensor; ``GET /v1/alpha`` says where it lies."""
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
            edge_limit_m=LIMIT_M,
            actuators=_actuators(instrument),
        )
    )


def _actuators(instrument: Instrument) -> tuple[tuple[float, float], ...]:
    mirror = instrument.mirror
    if not isinstance(mirror, Mirror):
        return ()
    places = mirror.positions_m / instrument.subaperture_m * [1.0, mirror.y_sign]
    return tuple((round(x, 4), round(y, 4)) for x, y in places.tolist())
