"""What the service knows, for whoever reads: no route here changes anything."""

from __future__ import annotations

import io
from enum import StrEnum
from http import HTTPStatus
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from service.errors import UnknownIdError
from service.routes.problems import INVALID, UNKNOWN, problem, problem_response
from service.routes.registration_views import AlphaView, HistoryView
from service.routes.schemas import (
    EventsView,
    ReconstructorsView,
    ReconstructorView,
    StateView,
)
from service.routes.service import ServiceDep

router = APIRouter(prefix="/v1", tags=["what the service knows"], responses={**INVALID})

MatrixId = Annotated[str, Path(alias="id", description="Id of a reconstructor")]


class MatrixFormat(StrEnum):
    """How a reconstructor's numbers leave."""

    NPY = "npy"
    """NumPy's own file format."""

    RAW = "raw"
    """The bytes as they travel to the RTC: C-ordered little-endian float32."""


class Parameters(BaseModel):
    """Query parameters; an unknown one is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class LimitParameters(Parameters):
    """How much of a list to return."""

    limit: int = Field(default=200, ge=1, le=100_000)
    """At most so many entries, the newest ones."""


class MatrixParameters(Parameters):
    """How to return a reconstructor."""

    format: MatrixFormat = MatrixFormat.NPY
    """"npy" or "raw"."""


@router.get("/state")
async def state(service: ServiceDep) -> StateView:
    """Everything at one glance."""
    return StateView.of(service.snapshot())


@router.get(
    "/alpha",
    response_model=AlphaView,
    responses={404: problem_response("No window of telemetry has been accepted yet")},
)
async def alpha(request: Request, service: ServiceDep) -> AlphaView | Response:
    """Return the registration now: estimate, 1 σ, covariance and age."""
    snapshot = service.snapshot()
    tracker = snapshot.tracker
    if tracker.registration is None:
        detail = (
            f"no estimate yet: {tracker.windows_accepted} windows accepted, "
            f"{tracker.windows_refused} refused; {snapshot.ready_reason}"
        )
        return problem(request, HTTPStatus.NOT_FOUND, "no-estimate", detail)
    return AlphaView.of(tracker.registration, snapshot)


@router.get("/alpha/history")
async def alpha_history(
    service: ServiceDep, parameters: Annotated[LimitParameters, Query()]
) -> HistoryView:
    """Return the estimates of the last windows, oldest first."""
    history = service.snapshot().tracker.history
    return HistoryView.model_validate({"entries": history[-parameters.limit :]})


@router.get("/reconstructors")
async def reconstructors(service: ServiceDep) -> ReconstructorsView:
    """Return the reconstructors the service remembers, oldest first."""
    return ReconstructorsView.model_validate(service.snapshot().tracker)


@router.get("/reconstructors/{id}", responses={**UNKNOWN})
async def reconstructor(service: ServiceDep, matrix_id: MatrixId) -> ReconstructorView:
    """Return what is known of one reconstructor."""
    record = service.snapshot().tracker.reconstructor(matrix_id)
    if record is None:
        raise UnknownIdError(f"reconstructor {matrix_id}: nobody has heard of it")
    return ReconstructorView.model_validate(record)


@router.get(
    "/reconstructors/{id}/matrix",
    response_class=Response,
    responses={
        200: {
            "description": "The reconstructor, metres OPD per slope",
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}}
            },
            "headers": {
                "X-Shape": {
                    "description": "Rows (modes) and columns (slopes)",
                    "schema": {"type": "string", "example": "400,1384"},
                },
                "X-Dtype": {
                    "description": "C-ordered little-endian float32",
                    "schema": {"type": "string", "example": "<f4"},
                },
            },
        },
        **UNKNOWN,
    },
)
async def reconstructor_matrix(
    service: ServiceDep, matrix_id: MatrixId, parameters: Annotated[MatrixParameters, Query()]
) -> Response:
    """Return a reconstructor's numbers, ``(n_modes, n_slopes)``, metres OPD per slope.

    ``?format=npy`` (the default) is a NumPy file, ``?format=raw`` the bytes as they travel to
    the RTC, whose SHA-256 is the reconstructor's ``sha256``.
    """
    matrix = await run_in_threadpool(service.matrix, matrix_id)
    numbers = np.ascontiguousarray(matrix, "<f4")
    content = numbers.tobytes() if parameters.format is MatrixFormat.RAW else _npy(numbers)
    extension = "npy" if parameters.format is MatrixFormat.NPY else "f4"
    return Response(
        content,
        media_type="application/octet-stream",
        headers={
            "X-Shape": ",".join(str(n) for n in numbers.shape),
            "X-Dtype": "<f4",
            "Content-Disposition": f'attachment; filename="{matrix_id}.{extension}"',
        },
    )


def _npy(numbers: NDArray[np.float32]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, numbers, allow_pickle=False)
    return buffer.getvalue()


@router.get("/events")
async def events(
    service: ServiceDep, parameters: Annotated[LimitParameters, Query()]
) -> EventsView:
    """Return what happened, oldest first, and the alarms that last."""
    tracker = service.snapshot().tracker
    return EventsView.model_validate(
        {"alarms": tracker.alarms, "log": tracker.log[-parameters.limit :]}
    )
