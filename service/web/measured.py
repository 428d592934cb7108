"""Routes of measured matrices: the RTC's own, noisy ones on sky, and fits of uploaded ones.

The RTC measures an interaction matrix, or the service sums a noisy one on sky from a random dither.
A noisy one can never become a reconstructor: no route, and nothing behind one, publishes it.
"""

from __future__ import annotations

import pathlib
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from starlette.requests import ClientDisconnect

from service import errors, files
from service.model.kinds import Method
from service.runtime.uploads import FitJob, FitQueue, FitState
from service.tracking.operation_records import MeasurementRecord, NoisyFinding
from service.tracking.state import TrackerState
from service.web import views
from service.web.matrices import (
    RESPONSE_PART_BYTES,
    MatrixFormat,
    MatrixParameters,
    describes_numbers,
    numbers_of,
)
from service.web.problems import COMMAND, INVALID, UNKNOWN, problem_response
from service.web.views import (
    Parameters,
    ServiceDep,
    answer,
    define_view,
    found_or_refuse,
    held,
    shows,
)

router = APIRouter(prefix="/v1", tags=["measured matrices"], responses={**INVALID})
noisy = APIRouter(prefix="/v1", tags=["noisy interaction matrices"], responses={**INVALID})
fits = APIRouter(prefix="/v1", tags=["fits of uploaded matrices"], responses={**INVALID})

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


_MEASURED_NUMBERS = describes_numbers(
    "The measured interaction matrix, slope per metre OPD",
    "Rows (slopes) and columns (modes)",
    "1384,400",
)


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
            "content": views.binary("application/x-hdf5"),
        },
        **UNKNOWN,
    },
)
async def noisy_file(request: Request, service: ServiceDep, noisy_id: NoisyId) -> Response:
    """Return the HDF5 file of a noisy matrix."""
    kept = service.archive.noisy
    return await numbers_of(request, noisy_id, MatrixFormat.HDF5, kept.matrix, kept.file)


# --- fits of uploads


@dataclass(frozen=True, slots=True, kw_only=True)
class FitJobs:
    """The fits the service remembers until it ends."""

    fits: tuple[FitJob, ...]
    """Oldest first."""


FIT_JOB = define_view(
    "FitJobView", FitJob, "id state stage name asked_ns_utc n_bytes sha256 reason"
)
FIT_JOBS = define_view("FitJobsView", FitJobs)


FitsDep = Annotated[FitQueue, held("fits")]
"""The desk a route works for."""

FitId = Annotated[str, Path(alias="id", description="Id of a fit")]

_MAX_NAME = 200
"""Longest name of an array or a file, characters."""


def _understood(parse: Callable[[str], object]) -> AfterValidator:
    """Return what refuses a text that ``parse`` does not understand."""

    def check(text: str) -> str:
        parse(text)
        return text

    return AfterValidator(check)


def _packaged(name: str) -> None:
    if name.endswith(".toml"):
        raise ValueError(
            f"found {name!r}, expected a packaged name; a file of your own goes into the upload"
        )


class FitParameters(Parameters):
    """Parameters of a fit, in the words of ``pyrcal fit``."""

    dataset: str | None = Field(default=None, min_length=1, max_length=_MAX_NAME)
    """Name of the matrix in its file; default interaction_matrix."""

    method: Method = Method.JOINT
    """"joint", "paper" or "sensitivity"."""

    modes: Annotated[str, Field(max_length=10_000), _understood(files.parse_modes)] | None = None
    """Basis indices, like 0:400 or 3,5,9; default all."""

    start: Annotated[str, Field(max_length=_MAX_NAME), _understood(files.parse_alpha)] | None = None
    """X,Y,ROT,MAG: subapertures, degrees, ratio."""

    gain_map: bool = False
    """True to fit a gain over the pupil, common to all modes."""

    anamorphosis: bool = True
    """True to fit the anamorphosis of the mirror's image."""

    instrument: (
        Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,64}$"), _understood(_packaged)] | None
    ) = None
    """A packaged instrument; default: the service's own, or the one in the upload."""

    reference: str | None = Field(default=None, min_length=1, max_length=_MAX_NAME)
    """Name of the measured file in an uploaded zip."""

    name: str = Field(default="", max_length=_MAX_NAME)
    """Name in the list of fits, such as the file's name."""

    measurement: str | None = Field(default=None, min_length=1, max_length=_MAX_NAME)
    """Id of a matrix the RTC has measured for this service; there is no body then."""

    def asked(self) -> dict[str, Any]:
        """Return the arguments for ``pyrcal fit``."""
        return self.model_dump(mode="json", exclude={"name", "measurement"})


class FitAcceptedView(BaseModel):
    """A fit in the queue."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    id: str
    """Id of the fit."""

    links: dict[str, str]
    """Paths where its result appears."""


_UPLOAD: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "An HDF5, FITS or NumPy file, or a zip of one, an instrument file and its "
        "data",
        "content": views.binary("application/octet-stream"),
    }
}


@fits.post(
    "/fits",
    status_code=202,
    openapi_extra=_UPLOAD,
    responses={
        **UNKNOWN,
        503: problem_response("Too many fits wait already"),
        507: problem_response("The disk refuses"),
    },
)
async def fit(
    request: Request,
    service: ServiceDep,
    desk: FitsDep,
    response: Response,
    parameters: Annotated[FitParameters, Query()],
    content_length: Annotated[int | None, Header(ge=0)] = None,
) -> FitAcceptedView:
    """Fit the registration to the matrix in the body.

    `curl -X POST -T im.h5 ...`. The answer comes as soon as the file is here; the fit runs in
    a process of its own, one after the other. `?measurement=ID` fits a matrix the RTC has measured
    for this service, without a body.
    """
    body = _body(request)
    if parameters.measurement is not None:
        if content_length:
            raise errors.MatrixError("found a body and ?measurement=, expected one of the two")
        path = await run_in_threadpool(service.archive.measured.file, parameters.measurement)
        body, content_length = _kept(path), path.stat().st_size
    name = parameters.name or parameters.measurement or ""
    job = await desk.take(parameters.asked(), body, content_length, name)
    links = {"fit": f"/v1/fits/{job.id}", "fits": "/v1/fits"}
    response.headers["Location"] = links["fit"]
    return FitAcceptedView(id=job.id, links=links)


@fits.get("/fits", responses={200: shows(FIT_JOBS)})
async def fits_known(desk: FitsDep) -> Response:
    """Return the last fits, oldest first."""
    return answer(FitJobs(fits=tuple(desk.jobs())))


_FOUND = {"anyOf": [{"$ref": f"{views.SCHEMAS}{one}"} for one in ("FitDocument", FIT_JOB.name)]}
_DRAWN = {"$ref": f"{views.SCHEMAS}FitFigures"}


@fits.get(
    "/fits/{id}",
    responses={
        200: {
            "description": "What was found; of a fit that failed or was given up the job itself: "
            "its `state` and the `reason`",
            "content": {"application/json": {"schema": _FOUND}},
        },
        202: shows(FIT_JOB) | {"description": "Not finished yet"},
        **UNKNOWN,
    },
)
async def fit_found(desk: FitsDep, fit_id: FitId) -> Response:
    """Return the result of a fit; 202 while it runs.

    What was found has a ``verdict``; a fit that failed, or was given up, has ``state`` and
    ``reason`` instead.
    """
    job = desk.job(fit_id)
    if job.document is not None:
        return JSONResponse(dict(job.document))
    ended = job.state in {FitState.FAILED, FitState.GIVEN_UP}
    return JSONResponse(views.to_json(job), HTTPStatus.OK if ended else HTTPStatus.ACCEPTED)


@fits.get(
    "/fits/{id}/figures",
    responses={
        200: {
            "description": "What the figures of a fit are drawn from.",
            "content": {"application/json": {"schema": _DRAWN}},
        },
        **UNKNOWN,
    },
)
async def fit_figures(desk: FitsDep, fit_id: FitId) -> Response:
    """Return the numbers behind a fit's figures; 404 while there are none."""
    job = desk.job(fit_id)
    return Response(
        found_or_refuse(job.figures, f"fit {fit_id} is {job.state} and has no figures"),
        media_type="application/json",
    )


@fits.delete("/fits/{id}", responses={200: shows(FIT_JOB), **UNKNOWN, **COMMAND})
async def give_up_fit(desk: FitsDep, fit_id: FitId) -> Response:
    """End a fit; 409 if it is over."""
    return answer(await desk.give_up(fit_id))


async def _kept(path: pathlib.Path) -> AsyncIterator[bytes]:
    with path.open("rb") as file:
        while part := await run_in_threadpool(file.read, RESPONSE_PART_BYTES):
            yield part


async def _body(request: Request) -> AsyncIterator[bytes]:
    try:
        async for chunk in request.stream():
            yield chunk
    except ClientDisconnect as error:
        raise errors.MatrixError("upload: the client went away half-way") from error
