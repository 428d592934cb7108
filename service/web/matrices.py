"""Routes of refits, measured and noisy matrices.

A reconstructor for the registration of now is a job that can be followed to its end. The RTC
measures an interaction matrix, or the service sums a noisy one on sky from a random dither. A noisy
one can never become a reconstructor: no route, and nothing behind one, publishes it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.runtime.command_results import RefitJob
from service.tracking.operation_records import MeasurementRecord, NoisyFinding
from service.tracking.state import TrackerState
from service.web import views
from service.web.commands import MeasurementId, NoisyId, RefitId
from service.web.connections import not_modified, tag_of
from service.web.numbers import MatrixParameters, describes_numbers, numbers_of
from service.web.problems import INVALID, UNKNOWN
from service.web.views import ServiceDep, answer, define_view, found_or_refuse, shows

router = APIRouter(prefix="/v1", tags=["measured matrices"], responses={**INVALID})
refits = APIRouter(prefix="/v1", tags=["orders"], responses={**INVALID})
noisy = APIRouter(prefix="/v1", tags=["noisy interaction matrices"], responses={**INVALID})

REFIT = define_view("RefitView", RefitJob)
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


_MEASURED_NUMBERS = describes_numbers(
    "The measured interaction matrix, slope per metre OPD",
    "Rows (slopes) and columns (modes)",
    "1384,400",
)


async def _file(request: Request, file_of: Callable[[str], bytes], matrix_id: str) -> Response:
    """Return the archived product, unless the client has it."""
    tag = tag_of(matrix_id)
    return not_modified(request, tag) or Response(
        await run_in_threadpool(file_of, matrix_id),
        media_type="application/x-hdf5",
        headers={"Content-Disposition": f'attachment; filename="{matrix_id}.h5"', "ETag": tag},
    )


@refits.get("/refits/{id}", responses={200: shows(REFIT), **UNKNOWN})
async def refit_job(service: ServiceDep, refit_id: RefitId) -> Response:
    """Return the progress of a refit, and the reconstructor it has made."""
    return answer(service.refits.job(refit_id))


@router.get("/measurements", responses={200: shows(views.MEASUREMENTS)})
async def measurements(service: ServiceDep) -> Response:
    """Return the measured interaction matrices, oldest first."""
    return answer(service.snapshot().tracker, views.MEASUREMENTS)


@router.get("/measurements/{id}", responses={200: shows(views.MEASUREMENT), **UNKNOWN})
async def measurement(service: ServiceDep, measurement_id: MeasurementId) -> Response:
    """Return how a matrix was measured, or its progress."""
    record = service.snapshot().tracker.measurement(measurement_id)
    return answer(found_or_refuse(record, f"unknown measurement {measurement_id}"))


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
    """Return a measured matrix ``(n_slopes, n_modes)``, slope per metre OPD.

    ``?format=npy`` (the default) is a NumPy file, ``raw`` the bytes whose SHA-256 is the
    measurement's ``sha256``, ``hdf5`` the archived product with how it was measured, ``fits`` an
    image.
    """
    kept = service.archive.measured
    return await numbers_of(request, measurement_id, parameters.format, kept.matrix, kept.file)


@noisy.get("/noisy-matrix", responses={200: shows(NOISY_MATRICES)})
async def noisy_matrices(service: ServiceDep) -> Response:
    """Return the noisy interaction matrices, oldest first."""
    return answer(service.snapshot().tracker, NOISY_MATRICES)


@noisy.get("/noisy-matrix/{id}", responses={200: shows(NOISY), **UNKNOWN})
async def noisy_matrix(service: ServiceDep, noisy_id: NoisyId) -> Response:
    """Return the record of a noisy matrix, or its progress."""
    record = service.snapshot().tracker.measurement(noisy_id)
    return answer(found_or_refuse(record, f"unknown noisy matrix {noisy_id}"), NOISY)


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
    """Return the HDF5 file of a noisy matrix."""
    return await _file(request, service.archive.noisy.file, noisy_id)
