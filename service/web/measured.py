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
from service.records.operations import MeasurementRecord, NoisyFinding
from service.records.state import TrackerState
from service.runtime.uploads import FitJob, FitQueue, FitState
from service.web import matrices, views
from service.web.problems import COMMAND, INVALID, UNKNOWN, problem_response

router = APIRouter(prefix="/v1", tags=["measured matrices"], responses={**INVALID})
noisy = APIRouter(prefix="/v1", tags=["noisy interaction matrices"], responses={**INVALID})
fits = APIRouter(prefix="/v1", tags=["fits of uploaded matrices"], responses={**INVALID})

MeasurementId = Annotated[str, Path(alias="id", description="Id of a measured matrix")]
NoisyId = Annotated[str, Path(alias="id", description="Id of a noisy interaction matrix")]

views.define_view(
    "NoisyFindingView",
    NoisyFinding,
    "n_slopes n_frames n_missing snr alpha sigma optical_gain misfit cm_id session created_ns_utc "
    "sha256",
)
NOISY = views.define_view(
    "NoisyView",
    MeasurementRecord,
    "id state reason n_modes modes total_m amplitude_m=each_m duration_s window_s seed "
    "asked_ns_utc basis_id config_id finding",
)
NOISY_MATRICES = views.define_view(
    "NoisyListView",
    TrackerState,
    "noisy_matrices=noisy",
    "Noisy interaction matrices.",
    noisy_matrices=NOISY,
)


_MEASURED_NUMBERS = matrices.describes_numbers(
    "The measured interaction matrix, slope per metre OPD",
    "Rows (slopes) and columns (modes)",
    "1384,400",
)


@router.get("/measurements", responses={200: views.shows(views.MEASUREMENTS)})
async def measurements(service: views.ServiceDep) -> Response:
    """Return the measured interaction matrices, oldest first."""
    return views.answer(service.snapshot().tracker, views.MEASUREMENTS)


@router.get("/measurements/{id}", responses={200: views.shows(views.MEASUREMENT), **UNKNOWN})
async def measurement(service: views.ServiceDep, measurement_id: MeasurementId) -> Response:
    """Return how a matrix was measured, or its progress."""
    record = service.snapshot().tracker.measurement(measurement_id)
    return views.answer(views.found_or_refuse(record, f"unknown measurement {measurement_id}"))


@router.get(
    "/measurements/{id}/matrix",
    response_class=Response,
    responses={200: _MEASURED_NUMBERS, **UNKNOWN},
)
async def measured_matrix(
    request: Request,
    service: views.ServiceDep,
    measurement_id: MeasurementId,
    parameters: Annotated[matrices.MatrixParameters, Query()],
) -> Response:
    """Return a measured matrix ``(n_slopes, n_modes)``, slope per metre OPD.

    ``?format=npy`` (the default) is a NumPy file, ``raw`` the bytes whose SHA-256 is the
    measurement's ``sha256``, ``hdf5`` the archived product with how it was measured, ``fits`` an
    image.
    """
    kept = service.archive.measured
    return await matrices.numbers_of(
        request, measurement_id, parameters.format, kept.matrix, kept.file
    )


@noisy.get("/noisy-matrix", responses={200: views.shows(NOISY_MATRICES)})
async def noisy_matrices(service: views.ServiceDep) -> Response:
    """Return the noisy interaction matrices, oldest first."""
    return views.answer(service.snapshot().tracker, NOISY_MATRICES)


@noisy.get("/noisy-matrix/{id}", responses={200: views.shows(NOISY), **UNKNOWN})
async def noisy_matrix(service: views.ServiceDep, noisy_id: NoisyId) -> Response:
    """Return the record of a noisy matrix, or its progress."""
    record = service.snapshot().tracker.measurement(noisy_id)
    return views.answer(views.found_or_refuse(record, f"unknown noisy matrix {noisy_id}"), NOISY)


_NOISY_FILE = views.binary(
    "HDF5: the matrix, the noise of each element, the synthetic matrix", "application/x-hdf5"
)


@noisy.get(
    "/noisy-matrix/{id}/file", response_class=Response, responses={200: _NOISY_FILE, **UNKNOWN}
)
async def noisy_file(request: Request, service: views.ServiceDep, noisy_id: NoisyId) -> Response:
    """Return the HDF5 file of a noisy matrix."""
    kept = service.archive.noisy
    return await matrices.numbers_of(
        request, noisy_id, matrices.MatrixFormat.HDF5, kept.matrix, kept.file
    )


# --- fits of uploads


@dataclass(frozen=True, slots=True, kw_only=True)
class FitJobs:
    """The fits the service remembers until it ends."""

    fits: tuple[FitJob, ...]
    """Oldest first."""


FIT_JOB = views.define_view(
    "FitJobView", FitJob, "id state stage name asked_ns_utc n_bytes sha256 reason"
)
FIT_JOBS = views.define_view("FitJobsView", FitJobs)


FitsDep = Annotated[FitQueue, views.held("fits")]
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


def _check_packaged(name: str) -> None:
    if name.endswith(".toml"):
        raise ValueError(
            f"found {name!r}, expected a packaged name; a file of your own goes into the upload"
        )


class FitParameters(views.Parameters):
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
        Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,64}$"), _understood(_check_packaged)]
        | None
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


class FitDocument(BaseModel):
    """Result of a fit: the object that ``pyrcal fit --json`` prints."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    shift_x_subap: float | None
    """Along sensor +x, subapertures."""

    shift_y_subap: float | None
    """Along sensor +y, subapertures."""

    rotation_deg: float | None
    """From sensor +x towards +y, degrees."""

    magnification: float | None
    """Ratio; 1 is nominal."""

    sigma: dict[str, float | None]
    """1 σ of the four, by name; noise, disagreement of subsets and model error together."""

    covariance: list[list[float | None]]
    """4 x 4, in the units of the names."""

    gains: list[float | None]
    """Measured column over the model's, one for each mode used, passes divided out."""

    residual_fraction: float | None
    """RMS of what is left over RMS of the measurement."""

    condition_number: float | None
    """Condition number of the synthetic matrix over the modes used."""

    n_modes_used: int
    orientation: dict[str, Any]
    """Orientation of the slopes, in the words of the instrument file."""

    subset_scatter: dict[str, float | None]
    """1 σ scatter of disjoint sets of modes, by name."""

    converged: bool
    verdict: str
    """Begins with "accepted" or "refused"; names what was left out."""

    registration: dict[str, Any] | None = None
    """Verdict on the registration: determined, reason, sigma_statistical, sigma_systematic (by
    name), disjoint_sets."""

    reconstructor: dict[str, Any] | None = None
    """Verdict on the model's reconstructor in the loop of the measured matrix: stable_modes of
    n_modes, gain, pole_radius, pole_radius_all, wavefront_ratio, noise_limited, reason."""

    anamorphosis: list[float] | None = None
    """Stretch of the mirror's image along x over the mean of both axes, less 1, and along 45 deg;
    null: the modes do not determine it, or it was not fitted."""

    anamorphosis_sigma: list[float] | None = None
    """1 σ of both; null: it was not fitted."""

    image_offsets_px: list[list[float]] | None = None
    """Displacements [x, y] of a pyramid's four pupil images that were fitted, detector pixels, as
    `wfs.image_offsets_px` states them; null if the instrument file states them."""

    instrument_found: dict[str, dict[str, float | None]] = {}
    """Values of the instrument that were fitted too, by key: found, sigma, and the file's value."""

    recommendation: str = ""
    """Advice in one sentence, which begins with "use it", "measure more" or "do not use"."""

    corrections: dict[str, Any] = {}
    """Values that the recommendation asks to write into the instrument file, by table and key; null
    removes a key. That of `instrument.pupil` describes how to turn or mirror the map."""

    found_not_told: list[dict[str, Any]] = []
    """Values that the matrix determines: key, found, told (the file's), how, and whether to correct
    the file."""

    unknown_not_found: list[str] = []
    """Values that the file calls "unknown" and the matrix does not determine, with the reason."""

    alternatives: list[dict[str, Any]] = []
    """Other explanations of the matrix: words, misfit (χ² over the fit's; null: not comparable),
    moved (by name), moved_sigma, preferred, undecided."""

    left_over: dict[str, Any] | None = None
    """Location of the residual: border (over inside), outlying subapertures and modes."""

    stroke: dict[str, Any] | None = None
    """OPD of one unit of a command: metres_per_unit (null: not determined), sigma, and condition:
    what the value requires, or why there is none."""

    causes: list[dict[str, Any]] = []
    """Causes of the power left over: words, share, sigma, and remedy (what to measure to reduce
    it); the largest first, the unexplained last."""

    notes: list[str]
    """Decisions of the fit that the user should know."""

    seconds: float | None


class FitMap(BaseModel):
    """Signals of one mode.

    Rows from the lowest y on, Sx and Sy side by side; null if not valid. For pixels, the four
    images in their arrangement on the detector.
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    mode: int
    measured: list[list[int | None]]
    """Percent of three times the RMS of what was measured, cut there."""

    synthetic: list[list[int | None]]
    """The model's, gain applied, in the same unit."""


class FitFigures(BaseModel):
    """Data of the figures of a fit."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    own_instrument: bool
    """True for a fit of the service's own instrument: its α can be compared with the service's."""

    modes: list[int]
    """Basis indices of the modes used; ``gains`` of the fit are of these."""

    residual_by_mode: list[float | None]
    """RMS of what is left over RMS of the measurement, of each."""

    singular_values: dict[str, list[float | None]]
    """"measured" and "synthetic", each over its largest."""

    residual_map: list[list[int | None]]
    """Residual in each subaperture, percent of the measured RMS: rows from the lowest y on, Sx
    and Sy side by side; null if not valid."""

    maps: list[FitMap]
    """Signals of a few modes: those of the paper where they were used."""


_UPLOAD: dict[str, Any] = {
    "requestBody": {
        "required": True,
        **views.binary(
            "An HDF5, FITS or NumPy file, or a zip of one, an instrument file and its data",
            "application/octet-stream",
        ),
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
    service: views.ServiceDep,
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


@fits.get("/fits", responses={200: views.shows(FIT_JOBS)})
async def fits_known(desk: FitsDep) -> Response:
    """Return the last fits, oldest first."""
    return views.answer(FitJobs(fits=tuple(desk.jobs())))


@fits.get(
    "/fits/{id}",
    responses={
        200: {
            "description": "What was found; of a fit that failed or was given up the job itself: "
            "its `state` and the `reason`",
            "model": FitDocument | FIT_JOB,
        },
        202: views.shows(FIT_JOB) | {"description": "Not finished yet"},
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
            "model": FitFigures,
        },
        **UNKNOWN,
    },
)
async def fit_figures(desk: FitsDep, fit_id: FitId) -> Response:
    """Return the numbers behind a fit's figures; 404 while there are none."""
    job = desk.job(fit_id)
    return Response(
        views.found_or_refuse(job.figures, f"fit {fit_id} is {job.state} and has no figures"),
        media_type="application/json",
    )


@fits.delete("/fits/{id}", responses={200: views.shows(FIT_JOB), **UNKNOWN, **COMMAND})
async def give_up_fit(desk: FitsDep, fit_id: FitId) -> Response:
    """End a fit; 409 if it is over."""
    return views.answer(await desk.give_up(fit_id))


async def _kept(path: pathlib.Path) -> AsyncIterator[bytes]:
    with path.open("rb") as file:
        while part := await run_in_threadpool(file.read, matrices.RESPONSE_PART_BYTES):
            yield part


async def _body(request: Request) -> AsyncIterator[bytes]:
    try:
        async for chunk in request.stream():
            yield chunk
    except ClientDisconnect as error:
        raise errors.MatrixError("upload: the client went away half-way") from error
