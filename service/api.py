"""The REST application: reads snapshots, hands commands on; no science."""

from __future__ import annotations

from fastapi import FastAPI
from fastapi.routing import APIRoute

from service import __version__
from service.routes import (
    acquisition,
    estimators,
    gains,
    health,
    loop,
    measurements,
    noisy,
    operating,
    pointing,
    problems,
    reading,
)
from service.routes import fits as fits_of_uploads
from service.routes.admission import Admission, Hosts
from service.routes.fits import Fits
from service.routes.service import Link, Service, Snapshot

__all__ = ["Link", "Service", "Snapshot", "create_app"]

_DESCRIPTION = """
Calibration service of an adaptive telescope with a pyramid wavefront sensor.

Shifts are in subapertures, angles in degrees, magnification is a ratio; every number has its unit
in its name. Times are nanoseconds since the Unix epoch, UTC. A number that is not known or not
finite is `null`. Errors are `application/problem+json` (RFC 9457).
"""


def create_app(
    service: Service, fits: Fits | None = None, *, hosts: Hosts | None = None
) -> FastAPI:
    """Return the REST application of a service, and of a desk for fits where there is one.

    It answers to ``hosts``, loopback alone where they are not given, and to no other name.

    Swagger and ReDoc pages are left out: they load their scripts from the internet, which an
    observatory's network need not reach. ``/openapi.json`` is there.
    """
    app = FastAPI(
        title="pyrcal",
        version=__version__,
        description=_DESCRIPTION,
        docs_url=None,
        redoc_url=None,
        generate_unique_id_function=_operation_id,
        responses=problems.EVERYWHERE,
    )
    app.add_middleware(Admission, hosts=hosts or Hosts())
    app.state.service = service
    problems.install(app)
    for routes in (
        reading,
        estimators,
        gains,
        operating,
        acquisition,
        pointing,
        loop,
        measurements,
        noisy,
        health,
    ):
        app.include_router(routes.router)
    if fits is not None:
        app.state.fits = fits
        app.include_router(fits_of_uploads.router)
    return app


def _operation_id(route: APIRoute) -> str:
    return route.name
