"""The REST application: read snapshots, hand commands on."""

from __future__ import annotations

import asyncio
import socket
from functools import cache

import structlog
from fastapi import APIRouter, FastAPI
from fastapi.routing import APIRoute
from starlette.routing import BaseRoute

from service import __version__
from service.config.settings import ApiTable
from service.runtime.supervisor import Supervisor
from service.runtime.uploads import FitQueue
from service.web import (
    archive,
    authentication,
    commands,
    history,
    matrices,
    measured,
    page,
    problems,
    state,
)
from service.web.authentication import Authentication, Hosts
from service.web.connections import Idempotency, RequestId, SecurityHeaders, Server, Unchanged
from service.web.keys import KeyFile

REQUESTS_WITHIN_S = 2
"""Requests under way when the service is asked to stop may take this long: an upload would take
longer."""

_DESCRIPTION = """
Calibration service of an adaptive telescope.

Shifts are in subapertures, angles in degrees, magnification is a ratio; every number has its unit
in its name. Times are nanoseconds since the Unix epoch, UTC. A number that is not known or not
finite is `null`. Errors are `application/problem+json` (RFC 9457). `X-Request-ID` of an answer, the
one that was sent or a new one, is in every line of the log that the request has led to.
"""


async def answer(
    service: Supervisor,
    desk: FitQueue,
    listener: socket.socket,
    settings: ApiTable,
    keys: KeyFile,
    over: asyncio.Event,
) -> None:
    """Answer requests as the ``settings`` say, until it is ``over``."""
    host, port = listener.getsockname()[:2]
    hosts = Hosts(bound=host, allowed=(settings.host, *settings.allowed_hosts))
    app = create_app(service, desk, hosts=hosts, keys=keys, over=over)
    server = Server(app, over, within_s=REQUESTS_WITHIN_S, proxies=settings.trusted_proxies)
    structlog.get_logger().info("api.listening", url=f"http://{host}:{port}")
    await server.serve(sockets=[listener])


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

    FastAPI's own pages are left out: they load their scripts from the internet, and its own
    document tells less than the records do. ``/docs`` and ``/openapi.json`` are files of the
    package.
    """
    app = FastAPI(
        title="pyrcal",
        version=__version__,
        description=_DESCRIPTION,
        openapi_url=None,
        routes=_routes(with_fits=desk is not None),
    )
    app.add_middleware(Unchanged)
    app.add_middleware(Idempotency)
    app.add_middleware(
        Authentication, hosts=hosts or Hosts(), keys=keys, audit=lambda entry: service.audit(entry)
    )
    app.add_middleware(RequestId)
    app.add_middleware(SecurityHeaders)
    app.state.service = service
    app.state.keys = keys
    app.state.slopes = page.SlopesCache()
    app.state.stream = page.Stream(service, over or asyncio.Event())
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
        state.router,
        matrices.router,
        archive.router,
        history.router,
        history.notes,
        page.router,
        commands.router,
        measured.router,
        measured.noisy,
        state.health,
        authentication.router,
    ]
    for router in [*routers, measured.fits] if with_fits else routers:
        shared.include_router(router)
    return shared.routes


def _operation_id(route: APIRoute) -> str:
    return route.name
