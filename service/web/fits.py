"""Routes of fits of uploaded matrices."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from starlette.requests import ClientDisconnect

from service import errors, files
from service.model.kinds import Method
from service.runtime.uploads import FitJob, FitQueue, FitState
from service.web import views
from service.web.problems import COMMAND, INVALID, UNKNOWN, problem_response

router = APIRouter(prefix="/v1", tags=["fits of uploaded matrices"], responses={**INVALID})


@dataclass(frozen=True, slots=True, kw_only=True)
class FitJobs:
    """The fits the service remembers until it ends."""

    fits: tuple[FitJob, ...]
    """Oldest first."""


FIT_JOB = views.define_view(
    "FitJobView", FitJob, "id state stage name asked_ns_utc n_bytes sha256 reason"
)
FIT_JOBS = views.define_view("FitJobsView", FitJobs)


async def _fits_of(request: Request) -> FitQueue:
    fits: FitQueue = request.app.state.fits
    return fits


FitsDep = Annotated[FitQueue, Depends(_fits_of)]
"""The desk a route works for."""

FitId = Annotated[str, Path(alias="id", description="Id of a fit")]

_TEXT = 200
"""Longest name of an array or a file."""


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


class FitParameters(BaseModel):
    """Parameters of a fit, in the words of ``pyrcal fit``."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    dataset: str | None = Field(default=None, min_length=1, max_length=_TEXT)
    """Name of the matrix in its file; default interaction_matrix."""

    method: Method = Method.JOINT
    """"joint", "paper" or "sensitivity"."""

    modes: Annotated[str, Field(max_length=10_000), _understood(files.parse_modes)] | None = None
    """Basis indices, like 0:400 or 3,5,9; default all."""

    start: Annotated[str, Field(max_length=_TEXT), _understood(files.parse_alpha)] | None = None
    """X,Y,ROT,MAG: subapertures, degrees, ratio."""

    gain_map: bool = False
    """Whether a gain over the pupil, common to all modes, is unknown too."""

    anamorphosis: bool = False
    """Whether the mirror's image may be stretched."""

    instrument: (
        Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,64}$"), _understood(_packaged)] | None
    ) = None
    """A packaged instrument; default: the service's own, or the one in the upload."""

    reference: str | None = Field(default=None, min_length=1, max_length=_TEXT)
    """Name of the measured file in an uploaded zip."""

    name: str = Field(default="", max_length=_TEXT)
    """What to call it in the list of fits, such as the file's name."""

    measurement: str | None = Field(default=None, min_length=1, max_length=_TEXT)
    """Id of a matrix the RTC has measured for this service; there is no body then."""

    def asked(self) -> dict[str, Any]:
        """Return the arguments for ``pyrcal fit``."""
        return self.model_dump(mode="json", exclude={"name", "measurement"})


class FitAcceptedView(BaseModel):
    """A fit in the queue."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    id: str
    """Of the fit."""

    links: dict[str, str]
    """Where to look for what becomes of it."""


_UPLOAD: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "An HDF5, FITS or NumPy file, or a zip of one, an instrument file and its "
        "data",
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}


@router.post(
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
    service: views.ServiceDep,
    fits: FitsDep,
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
            raise errors.MatrixError("found a body beside ?measurement=, expected one of the two")
        content = await run_in_threadpool(service.archive.measured.file, parameters.measurement)
        body, content_length = _kept(content), len(content)
    name = parameters.name or parameters.measurement or ""
    job = await fits.take(parameters.asked(), body, content_length, name)
    links = {"fit": f"/v1/fits/{job.id}", "fits": "/v1/fits"}
    response.headers["Location"] = links["fit"]
    return FitAcceptedView(id=job.id, links=links)


@router.get("/fits", responses={200: views.shows(FIT_JOBS)})
async def fits_known(fits: FitsDep) -> Response:
    """Return the last fits, oldest first."""
    return views.answer(FitJobs(fits=tuple(fits.jobs())))


_FOUND = {"anyOf": [{"$ref": f"{views.SCHEMAS}{one}"} for one in ("FitDocument", FIT_JOB.name)]}
_DRAWN = {"$ref": f"{views.SCHEMAS}FitFigures"}


@router.get(
    "/fits/{id}",
    responses={
        200: {
            "description": "What was found; of a fit that failed or was given up the job itself: "
            "its `state` and the `reason`",
            "content": {"application/json": {"schema": _FOUND}},
        },
        202: views.shows(FIT_JOB) | {"description": "Not finished yet"},
        **UNKNOWN,
    },
)
async def fit_found(fits: FitsDep, fit_id: FitId) -> Response:
    """Return the result of a fit; 202 while it runs.

    What was found has a ``verdict``; a fit that failed, or was given up, has ``state`` and
    ``reason`` instead.
    """
    job = fits.job(fit_id)
    if job.document is not None:
        return JSONResponse(dict(job.document))
    ended = job.state in {FitState.FAILED, FitState.GIVEN_UP}
    return JSONResponse(views.to_json(job), HTTPStatus.OK if ended else HTTPStatus.ACCEPTED)


@router.get(
    "/fits/{id}/figures",
    responses={
        200: {
            "description": "What the figures of a fit are drawn from.",
            "content": {"application/json": {"schema": _DRAWN}},
        },
        **UNKNOWN,
    },
)
async def fit_figures(fits: FitsDep, fit_id: FitId) -> Response:
    """Return the numbers behind a fit's figures; 404 while there are none."""
    job = fits.job(fit_id)
    return Response(
        views.found_or_refuse(job.figures, f"fit {fit_id} is {job.state} and has no figures"),
        media_type="application/json",
    )


@router.delete("/fits/{id}", responses={200: views.shows(FIT_JOB), **UNKNOWN, **COMMAND})
async def give_up_fit(fits: FitsDep, fit_id: FitId) -> Response:
    """End a fit; 409 if it is over."""
    return views.answer(await fits.give_up(fit_id))


async def _kept(content: bytes) -> AsyncIterator[bytes]:
    yield content


async def _body(request: Request) -> AsyncIterator[bytes]:
    try:
        async for chunk in request.stream():
            yield chunk
    except ClientDisconnect as error:
        raise errors.MatrixError("upload: the client went away half-way") from error
