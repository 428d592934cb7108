"""Where the telescope looks, told by an observatory whose RTC does not know it."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import Field

from service.events import SetPointing
from service.routes.operating import AcceptedView, Request, accepted
from service.routes.problems import COMMAND, INVALID
from service.routes.service import ServiceDep
from service.state import Pointing

router = APIRouter(
    prefix="/v1", tags=["what the observatory tells it"], responses={**COMMAND, **INVALID}
)


class PointingRequest(Request):
    """Where the telescope looks now."""

    elevation_deg: float = Field(ge=-90.0, le=90.0)
    """Above the horizon, degrees."""

    azimuth_deg: float = Field(ge=-720.0, le=720.0)
    """From north over east, degrees; only differences count."""


@router.put("/pointing", status_code=202)
async def pointing(service: ServiceDep, body: PointingRequest) -> AcceptedView:
    """Say where the telescope looks, at least whenever it has moved by a degree.

    The registration moves with it. An RTC that says so in its status overrules this.
    """
    told = Pointing(elevation_deg=body.elevation_deg, azimuth_deg=body.azimuth_deg)
    return await accepted(service, SetPointing(pointing=told))
