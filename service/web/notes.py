"""Notes of operators about a moment of the night: written down, and read beside the charts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import Field

from service.archive.notes import Annotation
from service.runtime.telemetry_recorder import AnnotationChoice
from service.web.commands import AcceptedView, ClientDep, body
from service.web.problems import COMMAND, INVALID
from service.web.reading import TimeParameters
from service.web.views import ServiceDep, answer, define_view, shows

router = APIRouter(prefix="/v1", tags=["what it has kept"], responses={**INVALID})


@dataclass(frozen=True, slots=True, kw_only=True)
class AnnotationList:
    """Notes of operators."""

    annotations: tuple[Annotation, ...]
    """Oldest first."""


class AnnotationParameters(TimeParameters):
    """Which notes to return."""

    limit: int = Field(default=500, ge=1, le=2000)
    """At most so many, the newest ones."""


define_view("AnnotationView", Annotation)
ANNOTATIONS = define_view("AnnotationsView", AnnotationList)


class AnnotationAcceptedView(AcceptedView):
    """A note that is kept."""

    id: int
    """Of the note."""


@router.get("/annotations", responses={200: shows(ANNOTATIONS)})
async def list_annotations(
    service: ServiceDep, parameters: Annotated[AnnotationParameters, Query()]
) -> Response:
    """Return what operators have noted about a time, oldest first."""
    found = await run_in_threadpool(
        service.archive.annotations.between, *parameters.between, parameters.limit
    )
    return answer(AnnotationList(annotations=found))


@router.post("/annotations", status_code=201, responses={**COMMAND})
async def annotate(
    client: ClientDep, choice: Annotated[AnnotationChoice, body(AnnotationChoice)]
) -> AnnotationAcceptedView:
    """Note something about a moment: it is kept for ever, in the history and the audit trail."""
    entry = client.actor.entry("annotation", choice.note, by=choice.by, why=choice.reason)
    t_ns = entry.t_ns_utc if choice.t_ns_utc is None else choice.t_ns_utc
    note = Annotation(t_ns_utc=t_ns, written_ns_utc=entry.t_ns_utc, who=entry.who, note=choice.note)
    number = await run_in_threadpool(client.service.archive.annotations.add, note)
    client.service.audit(replace(entry, answer=f"note {number}"))
    where = f"/v1/annotations?since_ns={t_ns}&until_ns={t_ns}"
    accepted = client.accepted("it is kept, in the history of that time", annotation=where)
    return AnnotationAcceptedView(id=number, **accepted.model_dump())
