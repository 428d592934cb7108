"""Interaction matrices that are measured for the service: ask for one, see it, take it away.

The RTC measures one, or the service sums a noisy one on sky from a random dither. A noisy one can
never become a reconstructor: no route, and nothing behind one, publishes it.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from enum import StrEnum
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import Field, model_validator

from service.routes import views
from service.routes.commands import (
    MOST_MODES,
    AcceptedView,
    BasisMode,
    Modes,
    Positive,
    Request,
    accepted,
)
from service.routes.problems import COMMAND, INVALID, UNKNOWN
from service.routes.reading import Parameters, describes_numbers, numbers_of
from service.routes.views import ServiceDep, answer, known, shows
from service.snapshot import Snapshot
from service.tracking.dither_request import NOISY_DITHER
from service.tracking.events import GiveUp, GiveUpNoisy, Measure, MeasureNoisy
from service.tracking.products import ModeSet
from service.wire import Pattern

router = APIRouter(
    prefix="/v1", tags=["interaction matrices it has measured"], responses={**INVALID}
)
noisy = APIRouter(prefix="/v1", tags=["noisy interaction matrices"], responses={**INVALID})

LONGEST_S = 3600.0
_MEASURED = "/v1/measurements"
_NOISY = "/v1/noisy-matrix"

MeasurementId = Annotated[str, Path(alias="id", description="Id of a measured matrix")]
NoisyId = Annotated[str, Path(alias="id", description="Id of a noisy interaction matrix")]


class MeasureBody(Request):
    """Have the RTC measure an interaction matrix; what is left out, the service chooses.

    All patterns but "sine" open the loop meanwhile.
    """

    pattern: Pattern = Field(default=Pattern.PUSH_PULL_MODAL, strict=False)
    """"push-pull-modal", "push-pull-zonal", "hadamard" or "sine"."""

    modes: list[BasisMode] | None = Field(default=None, min_length=1, max_length=MOST_MODES)
    """0-based basis indices, none twice; null: the controlled ones."""

    amplitude_m: Positive | None = None
    """RMS of each mode's stroke, metres OPD."""

    n_average: int | None = Field(default=None, ge=1, le=10_000)
    """Pushes, and as many pulls, of each shape."""

    frequency_hz: list[Positive] | None = Field(default=None, min_length=1, max_length=MOST_MODES)
    """One for each of ``modes``; only of a sine."""

    duration_s: Positive | None = None
    """Only of a sine."""

    @model_validator(mode="after")
    def _consistent(self) -> MeasureBody:
        if self.modes is not None and len(set(self.modes)) < len(self.modes):
            raise ValueError("modes without any of them twice")
        if self.pattern is Pattern.SINE and self.n_average is not None:
            raise ValueError("no n_average with a sine: its duration_s does the averaging")
        given = self.frequency_hz is not None or self.duration_s is not None
        if self.pattern is not Pattern.SINE and given:
            raise ValueError(f"no frequency_hz and no duration_s with {self.pattern}")
        n_modes = len(self.modes or ())
        if self.frequency_hz is not None and len(self.frequency_hz) != n_modes:
            raise ValueError(
                f"one frequency_hz for each of modes: {len(self.frequency_hz)} given for {n_modes}"
            )
        return self


class MatrixAcceptedView(AcceptedView):
    """A matrix that is being measured."""

    id: str
    """Of the matrix to come."""


class MeasuredFormat(StrEnum):
    """How a measured matrix leaves."""

    NPY = "npy"
    """NumPy's own file format."""

    RAW = "raw"
    """C-ordered little-endian float32, the bytes ``sha256`` is of."""

    HDF5 = "hdf5"
    """The archived product, with how it was measured."""


class MeasuredParameters(Parameters):
    """How to return a measured matrix."""

    format: MeasuredFormat = MeasuredFormat.NPY
    """"npy", "raw" or "hdf5"."""


_MEASURED_NUMBERS = describes_numbers(
    "The measured interaction matrix, slope per metre OPD",
    "Rows (slopes) and columns (modes); not with hdf5",
    "1384,400",
)
_MEASURED_NUMBERS["content"]["application/x-hdf5"] = {
    "schema": {"type": "string", "format": "binary"}
}


def _new_id(prefix: str, snapshot: Snapshot) -> str:
    now = datetime.fromtimestamp(snapshot.now_ns / 1e9, UTC)
    return f"{prefix}{now:%Y%m%dT%H%M%S.%f}"


async def _file(file_of: Callable[[str], bytes], matrix_id: str) -> Response:
    """Return the archived product."""
    return Response(
        await run_in_threadpool(file_of, matrix_id),
        media_type="application/x-hdf5",
        headers={"Content-Disposition": f'attachment; filename="{matrix_id}.h5"'},
    )


@router.post("/measurements", status_code=202, responses={**COMMAND})
async def measure(service: ServiceDep, body: MeasureBody | None = None) -> MatrixAcceptedView:
    """Have the RTC measure an interaction matrix; 409 with its reason when it will not.

    The answer comes when the RTC has begun; the matrix follows seconds to minutes later.
    """
    command = Measure(id=_new_id("im-", service.snapshot()), **(body or MeasureBody()).fields())
    answered = await accepted(service, command, measurement=f"{_MEASURED}/{command.id}")
    return MatrixAcceptedView(id=command.id, **answered.model_dump())


@router.get("/measurements", responses={200: shows(views.MEASUREMENTS)})
async def measurements(service: ServiceDep) -> Response:
    """Return the interaction matrices that were measured or are being measured, oldest first."""
    return answer(service.snapshot().tracker, views.MEASUREMENTS)


@router.get("/measurements/{id}", responses={200: shows(views.MEASUREMENT), **UNKNOWN})
async def measurement(service: ServiceDep, measurement_id: MeasurementId) -> Response:
    """Return how a matrix was measured, or how far it is."""
    record = service.snapshot().tracker.measurement(measurement_id)
    return answer(known(record, f"measurement {measurement_id}"))


@router.delete("/measurements/{id}", status_code=202, responses={**COMMAND, **UNKNOWN})
async def give_up(service: ServiceDep, measurement_id: MeasurementId) -> AcceptedView:
    """Wait no longer for a matrix under way; one that is stored stays.

    Nothing on the wire ends the RTC's own work: it may go on to the end, and refuse other commands
    until then. The service ignores what comes of it and asks, as often as it takes, for the loop
    to be closed again if it was closed before.
    """
    return await accepted(
        service, GiveUp(id=measurement_id), measurement=f"{_MEASURED}/{measurement_id}"
    )


@router.get(
    "/measurements/{id}/matrix",
    response_class=Response,
    responses={200: _MEASURED_NUMBERS, **UNKNOWN},
)
async def measured_matrix(
    service: ServiceDep,
    measurement_id: MeasurementId,
    parameters: Annotated[MeasuredParameters, Query()],
) -> Response:
    """Return a measured interaction matrix ``(n_slopes, n_modes)``, slope per metre OPD.

    ``?format=npy`` (the default) is a NumPy file, ``raw`` the bytes whose SHA-256 is the
    measurement's ``sha256``, ``hdf5`` the archived product with how it was measured.
    """
    if parameters.format is MeasuredFormat.HDF5:
        return await _file(service.archive.measured.file, measurement_id)
    raw = parameters.format is MeasuredFormat.RAW
    return await numbers_of(service.archive.measured.matrix, measurement_id, raw=raw)


class NoisyBody(Request):
    """Measure a noisy interaction matrix; what is left out, the service chooses.

    The loop stays closed: random signs on all its modes at once, a few nanometres altogether.
    """

    modes: Modes = ModeSet.CONTROLLED
    """0-based basis indices, none twice, or "controlled" or "all"."""

    total_amplitude_m: Positive | None = None
    """RMS of all modes together, metres OPD."""

    duration_s: float | None = Field(default=None, gt=0.0, le=LONGEST_S)
    """Of telemetry; the RTC's time."""

    over_budget: bool = False
    """Whether it may be more than the dither's budget."""


@noisy.post("/noisy-matrix", status_code=202, responses={**COMMAND})
async def measure_noisy(service: ServiceDep, body: NoisyBody | None = None) -> MatrixAcceptedView:
    """Measure a noisy interaction matrix on sky, loop closed, by a random dither.

    The service's own dither makes way for it; every window of it is fitted like any other.
    """
    asked = (body or NoisyBody()).fields()
    name, total_m = _new_id(NOISY_DITHER, service.snapshot()), asked.pop("total_amplitude_m")
    command = MeasureNoisy(id=name, total_m=total_m, **asked)
    answered = await accepted(service, command, matrix=f"{_NOISY}/{command.id}")
    return MatrixAcceptedView(id=command.id, **answered.model_dump())


@noisy.get("/noisy-matrix", responses={200: shows(views.NOISY_MATRICES)})
async def noisy_matrices(service: ServiceDep) -> Response:
    """Return the noisy interaction matrices the service remembers, oldest first."""
    return answer(service.snapshot().tracker, views.NOISY_MATRICES)


@noisy.get("/noisy-matrix/{id}", responses={200: shows(views.NOISY), **UNKNOWN})
async def noisy_matrix(service: ServiceDep, noisy_id: NoisyId) -> Response:
    """Return what is known of one, or how far it is."""
    record = service.snapshot().tracker.noisy_matrix(noisy_id)
    return answer(known(record, f"noisy matrix {noisy_id}"))


@noisy.delete("/noisy-matrix/{id}", status_code=202, responses={**COMMAND, **UNKNOWN})
async def give_up_noisy(service: ServiceDep, noisy_id: NoisyId) -> AcceptedView:
    """End one under way, and its dither; one that is stored stays."""
    return await accepted(service, GiveUpNoisy(id=noisy_id), matrix=f"{_NOISY}/{noisy_id}")


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
async def noisy_file(service: ServiceDep, noisy_id: NoisyId) -> Response:
    """Return the archived HDF5 file of one; ``pyrcal fit`` reads it."""
    return await _file(service.archive.noisy.file, noisy_id)
