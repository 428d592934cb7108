"""Routes that read the service's state."""

from __future__ import annotations

from dataclasses import replace
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field

from service.control.gains import ModeGain, gain_table
from service.errors import CommandError
from service.runtime.snapshot import ModeGainTable
from service.web import numbers, views
from service.web.problems import COMMAND, INVALID, UNKNOWN, problem, problem_response
from service.web.views import ServiceDep, answer, found_or_refuse, shows, tagged

router = APIRouter(prefix="/v1", tags=["state"], responses={**INVALID})


class LimitParameters(numbers.Parameters):
    """Length of the returned list."""

    limit: int = Field(default=200, ge=1, le=100_000)
    """At most so many entries, the newest ones."""


@router.get("/state", responses={200: shows(views.STATE)})
async def state(service: ServiceDep) -> Response:
    """Return the whole state."""
    return answer(service.snapshot())


@router.get(
    "/alpha",
    responses={
        200: shows(views.ALPHA),
        404: problem_response("No window of telemetry has been accepted yet"),
    },
)
async def alpha(request: Request, service: ServiceDep) -> Response:
    """Return the registration now: estimate, 1 σ, covariance and age."""
    snapshot = service.snapshot()
    tracker = snapshot.tracker
    current = snapshot.alpha
    if current is None:
        detail = (
            f"no estimate yet: {tracker.windows.accepted} windows accepted, "
            f"{tracker.windows.refused} refused; {snapshot.ready_reason}"
        )
        return problem(request, HTTPStatus.NOT_FOUND, "no-estimate", detail)
    return answer(current)


@router.get("/reconstructors", responses={200: shows(views.RECONSTRUCTORS)})
async def reconstructors(service: ServiceDep) -> Response:
    """Return the reconstructors, oldest first."""
    return tagged(service.snapshot().tracker, views.RECONSTRUCTORS)


@router.get("/reconstructors/{id}", responses={200: shows(views.RECONSTRUCTOR), **UNKNOWN})
async def reconstructor(service: ServiceDep, matrix_id: numbers.MatrixId) -> Response:
    """Return the record of a reconstructor."""
    record = service.snapshot().tracker.reconstructor(matrix_id)
    return tagged(found_or_refuse(record, f"unknown reconstructor {matrix_id}"))


@router.get(
    "/reconstructors/{id}/matrix",
    response_class=Response,
    responses={
        200: numbers.describes_numbers(
            "The reconstructor, metres OPD per slope",
            "Rows (modes) and columns (slopes)",
            "400,1384",
        ),
        **UNKNOWN,
    },
)
async def reconstructor_matrix(
    request: Request,
    service: ServiceDep,
    matrix_id: numbers.MatrixId,
    parameters: Annotated[numbers.MatrixParameters, Query()],
) -> Response:
    """Return a reconstructor ``(n_modes, n_slopes)``, metres OPD per slope.

    ``?format=npy`` (the default) is a NumPy file, ``raw`` the bytes as they travel to the RTC,
    whose SHA-256 is the reconstructor's ``sha256``, ``hdf5`` the archived product, ``fits`` an
    image.
    """
    return await numbers.numbers_of(
        request,
        matrix_id,
        parameters.format,
        service.matrix,
        lambda name: service.archive.reconstructors.file(name),
    )


@router.get("/alarms", responses={200: shows(views.ALARMS)})
async def alarms(service: ServiceDep) -> Response:
    """Return the alarms: lasting, ended unseen, muted."""
    return answer(service.snapshot(), views.ALARMS)


@router.get("/events", responses={200: shows(views.EVENTS)})
async def events(service: ServiceDep, parameters: Annotated[LimitParameters, Query()]) -> Response:
    """Return the log, oldest first, and the alarms."""
    tracker = service.snapshot().tracker
    return answer(replace(tracker, log=tracker.log[-parameters.limit :]), views.EVENTS)


@router.get("/gains", responses={200: shows(views.GAINS), **COMMAND})
async def gains(service: ServiceDep) -> Response:
    """Return the optical gains of all modes now.

    ``POST /v1/loop`` with ``effective_gain`` sets the loop gains by it, if the gate agrees.
    """
    tracker = service.snapshot().tracker
    if tracker.loop.rtc is None:
        raise CommandError("gains: no RTC is there: the number of modes is not known")
    current = tracker.alpha.registration
    measured = () if current is None else current.optical_gains
    return _gain_table(None, measured, tracker.loop.rtc.n_modes)


@router.get("/reconstructors/{id}/gains", responses={200: shows(views.GAINS), **UNKNOWN})
async def reconstructor_gains(service: ServiceDep, matrix_id: numbers.MatrixId) -> Response:
    """Return the optical gains when a reconstructor was made."""
    found = service.snapshot().tracker.reconstructor(matrix_id)
    record = found_or_refuse(found, f"unknown reconstructor {matrix_id}")
    return _gain_table(record.id, record.optical_gains, record.n_modes)


def _gain_table(matrix_id: str | None, measured: tuple[ModeGain, ...], n_modes: int) -> Response:
    table = gain_table(measured, n_modes)
    return answer(
        ModeGainTable(
            reconstructor=matrix_id,
            measured=measured,
            optical_gain=table.optical_gain.tolist(),
            relative_sigma=table.relative_sigma.tolist(),
            factor=table.factors.tolist(),
        )
    )
