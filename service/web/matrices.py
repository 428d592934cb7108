"""Matrices that are made or measured on request: ask for one, see how far it is, take it away.

A reconstructor for the registration of now is a job that can be followed to its end. The RTC
measures an interaction matrix, or the service sums a noisy one on sky from a random dither. A noisy
one can never become a reconstructor: no route, and nothing behind one, publishes it.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.runtime.refits import RefitJob
from service.runtime.snapshot import Snapshot
from service.tracking.commands import (
    GiveUp,
    Measure,
    MeasureChoice,
    MeasureNoisy,
    NoisyChoice,
    Refit,
)
from service.tracking.dither_request import NOISY_DITHER
from service.tracking.products import MeasurementRecord, NoisyFinding
from service.tracking.state import TrackerState
from service.web import views
from service.web.commands import AcceptedView, ClientDep, Said, about, body
from service.web.connections import not_modified, tag_of
from service.web.numbers import MatrixParameters, describes_numbers, numbers_of
from service.web.problems import COMMAND, INVALID, UNKNOWN
from service.web.views import ServiceDep, answer, define_view, found_or_refuse, shows

router = APIRouter(
    prefix="/v1", tags=["interaction matrices it has measured"], responses={**INVALID}
)
noisy = APIRouter(prefix="/v1", tags=["noisy interaction matrices"], responses={**INVALID})

_MEASURED = "/v1/measurements"
_NOISY = "/v1/noisy-matrix"

MeasurementId = Annotated[str, Path(alias="id", description="Id of a measured matrix")]
NoisyId = Annotated[str, Path(alias="id", description="Id of a noisy interaction matrix")]

define_view(
    "NoisyFindingView",
    NoisyFinding,
    "n_slopes n_frames n_missing snr alpha sigma optical_gain misfit cm_id session created_ns_utc "
    "sha256",
)
NOISY = define_view(
    "NoisyView",
    MeasurementRecord,
    "id state reason n_modes modes total_m amplitude_m=each_m duration_s window_s seed "
    "asked_ns_utc basis_id config_id finding",
)
NOISY_MATRICES = define_view(
    "NoisyListView",
    TrackerState,
    "noisy_matrices=noisy",
    "Noisy interaction matrices.",
    noisy_matrices=NOISY,
)


class MatrixAcceptedView(AcceptedView):
    """A matrix that is being measured."""

    id: str
    """Of the matrix to come."""


_MEASURED_NUMBERS = describes_numbers(
    "The measured interaction matrix, slope per metre OPD",
    "Rows (slopes) and columns (modes)",
    "1384,400",
)


def _new_id(prefix: str, snapshot: Snapshot) -> str:
    now = datetime.fromtimestamp(snapshot.now_ns / 1e9, UTC)
    return f"{prefix}{now:%Y%m%dT%H%M%S.%f}"


async def _file(request: Request, file_of: Callable[[str], bytes], matrix_id: str) -> Response:
    """Return the archived product, unless the client has it."""
    tag = tag_of(matrix_id)
    return not_modified(request, tag) or Response(
        await run_in_threadpool(file_of, matrix_id),
        media_type="application/x-hdf5",
        headers={"Content-Disposition": f'attachment; filename="{matrix_id}.h5"', "ETag": tag},
    )


@router.post("/measurements", status_code=202, responses={**COMMAND})
async def measure(
    client: ClientDep, choice: Annotated[MeasureChoice, body(MeasureChoice)]
) -> MatrixAcceptedView:
    """Have the RTC measure an interaction matrix; 409 with its reason when it will not.

    The answer comes when the RTC has begun; the matrix follows seconds to minutes later.
    """
    command = about(Measure, choice, id=_new_id("im-", client.service.snapshot()))
    answered = await client.orders(command, measurement=f"{_MEASURED}/{command.id}")
    return MatrixAcceptedView(id=command.id, **answered.model_dump())


@router.get("/measurements", responses={200: shows(views.MEASUREMENTS)})
async def measurements(service: ServiceDep) -> Response:
    """Return the interaction matrices that were measured or are being measured, oldest first."""
    return answer(service.snapshot().tracker, views.MEASUREMENTS)


@router.get("/measurements/{id}", responses={200: shows(views.MEASUREMENT), **UNKNOWN})
async def measurement(service: ServiceDep, measurement_id: MeasurementId) -> Response:
    """Return how a matrix was measured, or how far it is."""
    record = service.snapshot().tracker.measurement(measurement_id)
    return answer(found_or_refuse(record, f"unknown measurement {measurement_id}"))


@router.delete("/measurements/{id}", status_code=202, responses={**COMMAND, **UNKNOWN})
async def give_up(
    client: ClientDep, measurement_id: MeasurementId, instruction: Said
) -> AcceptedView:
    """Wait no longer for a matrix under way; one that is stored stays.

    Nothing on the wire ends the RTC's own work: it may go on to the end, and refuse other commands
    until then. The service ignores what comes of it and asks, as often as it takes, for the loop
    to be closed again if it was closed before.
    """
    command = about(GiveUp, instruction, id=measurement_id)
    return await client.orders(command, measurement=f"{_MEASURED}/{measurement_id}")


@router.get(
    "/measurements/{id}/matrix",
    response_class=Response,
    responses={200: _MEASURED_NUMBERS, **UNKNOWN},
)
async def measured_matrix(
    request: Request,
    service: ServiceDep,
    measurement_id: MeasurementId,
    parameters: Annotated[MatrixParameters, Query()],
) -> Response:
    """Return a measured interaction matrix ``(n_slopes, n_modes)``, slope per metre OPD.

    ``?format=npy`` (the default) is a NumPy file, ``raw`` the bytes whose SHA-256 is the
    measurement's ``sha256``, ``hdf5`` the archived product with how it was measured, ``fits`` an
    image.
    """
    kept = service.archive.measured
    return await numbers_of(request, measurement_id, parameters.format, kept.matrix, kept.file)


@noisy.post("/noisy-matrix", status_code=202, responses={**COMMAND})
async def measure_noisy(
    client: ClientDep, choice: Annotated[NoisyChoice, body(NoisyChoice)]
) -> MatrixAcceptedView:
    """Measure a noisy interaction matrix on sky, loop closed, by a random dither.

    The service's own dither makes way for it; every window of it is fitted like any other.
    """
    command = about(MeasureNoisy, choice, id=_new_id(NOISY_DITHER, client.service.snapshot()))
    answered = await client.orders(command, matrix=f"{_NOISY}/{command.id}")
    return MatrixAcceptedView(id=command.id, **answered.model_dump())


@noisy.get("/noisy-matrix", responses={200: shows(NOISY_MATRICES)})
async def noisy_matrices(service: ServiceDep) -> Response:
    """Return the noisy interaction matrices the service remembers, oldest first."""
    return answer(service.snapshot().tracker, NOISY_MATRICES)


@noisy.get("/noisy-matrix/{id}", responses={200: shows(NOISY), **UNKNOWN})
async def noisy_matrix(service: ServiceDep, noisy_id: NoisyId) -> Response:
    """Return what is known of a noisy matrix, or how far it is."""
    record = service.snapshot().tracker.measurement(noisy_id)
    return answer(found_or_refuse(record, f"unknown noisy matrix {noisy_id}"), NOISY)


@noisy.delete("/noisy-matrix/{id}", status_code=202, responses={**COMMAND, **UNKNOWN})
async def give_up_noisy(client: ClientDep, noisy_id: NoisyId, instruction: Said) -> AcceptedView:
    """End a noisy matrix under way, and its dither; one that is stored stays."""
    command = about(GiveUp, instruction, id=noisy_id)
    return await client.orders(command, matrix=f"{_NOISY}/{noisy_id}")


@noisy.get(
    "/noisy-matrix/{id}/file",
    response_class=Response,
    responses={
        200: {
            "description": "HDF5: the matrix, the noise of each element, the synthetic matrix",
            "content": {"application/x-hdf5": {"schema": {"type": "string", "format": "binary"}}},
        },
        **UNKNOWN,
    },
)
async def noisy_file(request: Request, service: ServiceDep, noisy_id: NoisyId) -> Response:
    """Return the archived HDF5 file of a noisy matrix; ``pyrcal fit`` reads it."""
    return await _file(request, service.archive.noisy.file, noisy_id)


# --- reconstructors that an operator has computed


refits = APIRouter(prefix="/v1", tags=["what an operator asks of it"], responses={**INVALID})

RefitId = Annotated[str, Path(alias="id", max_length=128, description="Id of a refit")]

REFIT = define_view("RefitView", RefitJob)


class RefitAcceptedView(AcceptedView):
    """A reconstructor that is being computed."""

    id: str
    """Of the job: ``GET /v1/refits/{id}`` says what came of it."""


@refits.post("/refit", status_code=202, responses={**COMMAND})
async def refit(client: ClientDep, command: Annotated[Refit, body(Refit)]) -> RefitAcceptedView:
    """Compute a reconstructor for the current registration; gate and mode apply as always.

    The answer has the id of a job, which tells which reconstructor came of it.
    """
    answered = await client.orders(command, reconstructors="/v1/reconstructors")
    job = client.service.refits.newest.id  # nothing has run since: no other can have begun
    links = client.accepted(answered.text, refit=f"/v1/refits/{job}").links | answered.links
    return RefitAcceptedView(id=job, text=answered.text, links=links)


@refits.get("/refits/{id}", responses={200: shows(REFIT), **UNKNOWN})
async def refit_job(service: ServiceDep, refit_id: RefitId) -> Response:
    """Return how far a refit is: which reconstructor it has made, or why none."""
    return answer(service.refits.job(refit_id))
