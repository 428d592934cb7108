"""Finding the registration from nothing: begin, abort, and how far it has come."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter
from pydantic import Field

from service.events import AbortAcquisition, Acquire
from service.routes.operating import AcceptedView, Request, accepted
from service.routes.problems import COMMAND, INVALID
from service.routes.service import ServiceDep

router = APIRouter(
    prefix="/v1/acquisition",
    tags=["what an operator asks of it"],
    responses={**COMMAND, **INVALID},
)


class AcquisitionBody(Request):
    """Begin an acquisition, or end one."""

    action: Literal["start", "abort"] = Field()
    """"start" opens the loop; "abort" leaves it as it was found if that held, else open or closed
    on a matrix that has passed the gate."""


@router.post("", status_code=202)
async def acquisition(service: ServiceDep, body: AcquisitionBody) -> AcceptedView:
    """Find the registration from nothing, in any mode: its matrices need no further approval.

    The loop is opened, smooth modes are dithered to find the mirror and others to confirm it, and
    the loop closes on as many modes as the gate allows, then on more.
    """
    command = Acquire() if body.action == "start" else AbortAcquisition()
    return await accepted(service, command)
