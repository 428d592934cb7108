"""The REST application: reads snapshots, hands commands on; no science."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator
from functools import cache
from typing import Any

import structlog
import uvicorn
from fastapi import APIRouter, FastAPI
from fastapi.routing import APIRoute, iter_route_contexts
from starlette.routing import BaseRoute
from typing_extensions import override

from service import __version__
from service.runtime.supervisor import Supervisor
from service.runtime.uploads import FitQueue
from service.web import (
    archive,
    commands,
    fits,
    health,
    matrices,
    notes,
    numbers,
    page,
    problems,
    reading,
    recordings,
    refits,
    schemas,
    session,
    stream,
    trends,
)
from service.web.authentication import OPEN, SCHEMES, Authentication, Hosts, needs, scope_of
from service.web.connections import Idempotency, RequestId, server_config
from service.web.keys import KeyFile
from service.web.unchanged import NOT_MODIFIED, Unchanged

REQUESTS_WITHIN_S = 2
"""Requests under way when the service is asked to stop may take this long: an upload would take
longer."""

TICK_S = 0.9
"""From one look of the server's whether it is over to the next, besides uvicorn's own 0.1 s."""

_DESCRIPTION = """
Calibration service of an adaptive telescope with a pyramid wavefront sensor.

Shifts are in subapertures, angles in degrees, magnification is a ratio; every number has its unit
in its name. Times are nanoseconds since the Unix epoch, UTC. A number that is not known or not
finite is `null`. Errors are `application/problem+json` (RFC 9457). `X-Request-ID` of an answer, the
one that was sent or a new one, is in every line of the log that the request has led to.
"""


async def answer(
    service: Supervisor,
    desk: FitQueue,
    listener: socket.socket,
    names: tuple[str, ...],
    keys: KeyFile,
    over: asyncio.Event,
) -> None:
    """Answer requests under these ``names`` until it is ``over``."""
    host, port = listener.getsockname()[:2]
    app = create_app(service, desk, hosts=Hosts(bound=host, allowed=names), keys=keys, over=over)
    server = _Server(server_config(app, timeout_graceful_shutdown=REQUESTS_WITHIN_S))
    server.over = over
    structlog.get_logger().info("api.listening", url=f"http://{host}:{port}")
    await server.serve(sockets=[listener])


class _Server(uvicorn.Server):
    """A uvicorn that leaves signals alone: it would raise them again before all is closed."""

    over: asyncio.Event

    @override
    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    @override
    async def on_tick(self, counter: int) -> bool:
        over = await super().on_tick(0)  # the date of answers is told anew
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(TICK_S):
                await self.over.wait()
        return over or self.over.is_set()


def create_app(
    service: Supervisor,
    desk: FitQueue | None = None,
    *,
    hosts: Hosts | None = None,
    keys: KeyFile | None = None,
    over: asyncio.Event | None = None,
) -> FastAPI:
    """Return the REST application of a service, and of a desk for fits where there is one.

    It answers to ``hosts``, loopback alone where they are not given, and to no other name; who asks
    needs one of the ``keys``, if there are any. Streams end when it is ``over``.

    FastAPI's own pages are left out: they load their scripts from the internet. ``/docs`` is there
    all the same, from the package.
    """
    app = _Application(
        title="pyrcal",
        version=__version__,
        description=_DESCRIPTION,
        docs_url=None,
        redoc_url=None,
        routes=_routes(with_fits=desk is not None),
    )
    app.add_middleware(Unchanged)
    app.add_middleware(Idempotency)
    app.add_middleware(
        Authentication, hosts=hosts or Hosts(), keys=keys, audit=lambda entry: service.audit(entry)
    )
    app.add_middleware(RequestId)
    app.state.service = service
    app.state.keys = keys
    app.state.slopes = numbers.SlopesCache()
    app.state.stream = stream.Stream(service, over or asyncio.Event())
    problems.install(app)
    page.install(app)
    if desk is not None:
        app.state.fits = desk
    return app


@cache
def _routes(*, with_fits: bool) -> list[BaseRoute]:
    """Return what is answered where; FastAPI takes a tenth of a second to work that out."""
    shared = APIRouter(generate_unique_id_function=_operation_id, responses=problems.EVERYWHERE)
    routers = [
        reading.router,
        numbers.router,
        archive.router,
        recordings.router,
        trends.router,
        notes.router,
        stream.router,
        page.router,
        refits.router,
        commands.router,
        commands.observatory,
        matrices.router,
        matrices.noisy,
        health.router,
        session.router,
    ]
    for router in [*routers, fits.router] if with_fits else routers:
        shared.include_router(router)
    return shared.routes


class _Application(FastAPI):
    """Describes what it answers when it is asked to, not when it is made."""

    @override
    def openapi(self) -> dict[str, Any]:
        if self.openapi_schema is None:
            document = super().openapi()
            described = {"Problem": problems.Problem.model_json_schema()} | schemas.schemas()
            document["components"]["schemas"] |= described | self._tell_bodies(document)
            document["components"]["securitySchemes"] = SCHEMES
            self._tell_scopes(document)
            for operations in document["paths"].values():
                for method, operation in operations.items():
                    _tell_operation(method, operation, document["components"]["schemas"])
        return super().openapi()

    def _tell_bodies(self, document: dict[str, Any]) -> dict[str, schemas.Schema]:
        """Say of each operation what it reads, and return the schemas of that."""
        read = {
            f"{method.lower()} {route.path_format}": found.call
            for route in iter_route_contexts(self.routes)
            if isinstance(route.original_route, APIRoute)
            for found in route.dependant.dependencies
            for method in route.methods or ()
            if isinstance(found.call, commands.Body)
        }
        bodies, found = commands.bodies(read)
        for operation, body in bodies.items():
            method, _, path = operation.partition(" ")
            document["paths"][path][method]["requestBody"] = body
        return found

    def _tell_scopes(self, document: dict[str, Any]) -> None:
        """Say of each operation which key it needs."""
        for route in iter_route_contexts(self.routes):
            for method in route.methods or () if route.path_format in document["paths"] else ():
                scope = scope_of(route, method)
                security = OPEN if scope is None else needs(scope)
                document["paths"][route.path_format][method.lower()] |= security


def _tell_operation(method: str, operation: dict[str, Any], known: dict[str, Any]) -> None:
    """Say in one line what an operation does, what its answers are, and which are not sent again.

    FastAPI's own summary is the name of a function.
    """
    first, _, rest = operation["description"].partition("\n\n")
    operation["summary"] = " ".join(first.split()).rstrip(".")
    operation["description"] = rest or first
    answers = operation["responses"]
    for found in answers.values():
        contents = found.get("content", {}).values()
        names = [one["schema"].get("$ref", "").rpartition("/")[2] for one in contents]
        if found["description"] == "Successful Response":
            told = known.get(names[0], {}) if names else {}
            found["description"] = told.get("description", "Done").partition("\n\n")[0]
        if any(name.endswith("AcceptedView") for name in names):
            found["headers"] = {"Location": _LOCATION}
    kept = answers.get("200", {}).get("content", {}).keys()
    if method == "get" and kept & _HAVE_TAGS:
        answers["304"] = NOT_MODIFIED


_HAVE_TAGS = {"application/json", *numbers.MEDIA_TYPES.values()}
"""Kinds of answers with an ETag."""

_LOCATION = {
    "description": "Where to look for what was begun",
    "schema": {"type": "string", "format": "uri-reference"},
}


def _operation_id(route: APIRoute) -> str:
    return route.name
