"""REST application of the service: its routers, middleware and server."""

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
from service.records.alarms import REST_CROWDED
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

SHUTDOWN_TIMEOUT_S = 2
"""Time that running requests have to finish when the service stops; uploads take longer."""

_DESCRIPTION = """
Calibration service of an adaptive telescope.

Shifts are in subapertures, angles in degrees, magnification is a ratio; every number has its unit
in its name. Times are nanoseconds since the Unix epoch, UTC. A number that is not known or not
finite is `null`. Errors are `application/problem+json` (RFC 9457). Each response has an
`X-Request-ID`, that of the request or a new one, which is in every log line of the request.
"""


async def answer(
    service: Supervisor,
    desk: FitQueue,
    listener: socket.socket,
    settings: ApiTable,
    keys: KeyFile,
    over: asyncio.Event,
) -> None:
    """Serve HTTP requests on ``listener`` until the event ``over`` is set."""
    host, port = listener.getsockname()[:2]
    hosts = Hosts(bound=host, allowed=(settings.host, *settings.allowed_hosts))
    app = create_app(service, desk, hosts=hosts, keys=keys, over=over)
    server = Server(app, over, within_s=SHUTDOWN_TIMEOUT_S, proxies=settings.trusted_proxies)
    service.complaints[REST_CROWDED] = server.crowd.complaint
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
    """Return the REST application of a service.

    Parameters
    ----------
    service
        Supervisor that has the state and takes commands.
    desk
        Queue for fits of uploaded matrices; None leaves out their routes.
    hosts
        Host names that requests may name; None for loopback only.
    keys
        API keys, one of which a request must have; None to require none.
    over
        Event at which streams end; None if they never do.

    Notes
    -----
    FastAPI's own documentation pages are not served: they load scripts from the internet, which an
    observatory's network may not reach. ``/docs`` and ``/openapi.json`` are files of the package,
    and the latter describes more than FastAPI could derive.
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
    """Return all routes; cached, because FastAPI takes a tenth of a second to build them."""
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
