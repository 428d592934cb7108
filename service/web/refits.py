"""Reconstructors that an operator has computed: each is a job that can be followed to its end."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Response

from service.runtime.refits import RefitJob
from service.tracking.commands import Refit
from service.web.commands import AcceptedView, ClientDep, body
from service.web.problems import COMMAND, INVALID, UNKNOWN
from service.web.views import ServiceDep, answer, define_view, shows

router = APIRouter(prefix="/v1", tags=["what an operator asks of it"], responses={**INVALID})

RefitId = Annotated[str, Path(alias="id", max_length=128, description="Id of a refit")]

REFIT = define_view("RefitView", RefitJob)


class RefitAcceptedView(AcceptedView):
    """A reconstructor that is being computed."""

    id: str
    """Of the job: ``GET /v1/refits/{id}`` says what came of it."""


@router.post("/refit", status_code=202, responses={**COMMAND})
async def refit(client: ClientDep, command: Annotated[Refit, body(Refit)]) -> RefitAcceptedView:
    """Compute a reconstructor for the current registration; gate and mode apply as always.

    The answer has the id of a job, which tells which reconstructor came of it.
    """
    answered = await client.orders(command, reconstructors="/v1/reconstructors")
    job = client.service.refits.newest.id  # nothing has run since: no other can have begun
    links = client.accepted(answered.text, refit=f"/v1/refits/{job}").links | answered.links
    return RefitAcceptedView(id=job, text=answered.text, links=links)


@router.get("/refits/{id}", responses={200: shows(REFIT), **UNKNOWN})
async def refit_job(service: ServiceDep, refit_id: RefitId) -> Response:
    """Return how far a refit is: which reconstructor it has made, or why none."""
    return answer(service.refits.job(refit_id))
