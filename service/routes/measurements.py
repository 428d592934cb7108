"""Interaction matrices the RTC measures: ask for one, see how far it is, take it away."""

from __future__ import annotations

import io
from datetime import UTC, datetime
from enum import StrEnum
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Path, Query, Response
from fastapi.concurrency import run_in_threadpool
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from service.errors import UnknownIdError
from service.events import GiveUp, Measure
from service.routes.operating import AcceptedView, Positive, Request, accepted
from service.routes.problems import COMMAND, INVALID, UNKNOWN
from service.routes.service import ServiceDep
from service.routes.views import View
from service.state import MeasurePattern, MeasureState

router = APIRouter(
    prefix="/v1", tags=["interaction matrices it has measured"], responses={**INVALID}
)

MOST_MODES = 100_000
_ALL = "/v1/measurements"

MeasurementId = Annotated[str, Path(alias="id", description="Id of a measured matrix")]


class MeasureBody(Request):
    """Have the RTC measure an interaction matrix; what is left out, the service chooses.

    All patterns but "sine" open the loop meanwhile.
    """

    pattern: MeasurePattern = Field(default=MeasurePattern.PUSH_PULL_MODAL, strict=False)
    """"push-pull-modal", "push-pull-zonal", "hadamard" or "sine"."""

    modes: list[Annotated[int, Field(ge=0)]] | None = Field(
        default=None, min_length=1, max_length=MOST_MODES
    )
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
        if self.pattern is MeasurePattern.SINE and self.n_average is not None:
            raise ValueError("no n_average with a sine: its duration_s does the averaging")
        given = self.frequency_hz is not None or self.duration_s is not None
        if self.pattern is not MeasurePattern.SINE and given:
            raise ValueError(f"no frequency_hz and no duration_s with {self.pattern}")
        n_modes = len(self.modes or ())
        if self.frequency_hz is not None and len(self.frequency_hz) != n_modes:
            raise ValueError(
                f"one frequency_hz for each of modes: {len(self.frequency_hz)} given for {n_modes}"
            )
        return self


class MeasurementView(View):
    """A measured interaction matrix, or one that is being measured."""

    id: str
    state: MeasureState
    """"asked", "running", "refused", "failed", "stored" or "given-up"."""

    reason: str
    """Why there is no matrix."""

    pattern: MeasurePattern
    modes: tuple[int, ...]
    """0-based basis indices, one for each column."""

    amplitude_m: tuple[float, ...]
    """RMS of each mode's stroke, metres OPD."""

    n_average: int | None
    frequency_hz: tuple[float, ...] | None
    duration_s: float | None
    asked_ns_utc: int | None
    """When the service asked for it; null: it did not."""

    start_seq: int | None
    """First frame that contained a stroke."""

    created_ns_utc: int | None
    """When it was measured, by the RTC's clock."""

    n_slopes: int | None
    """Rows of the matrix."""

    double_pass: bool | None
    """Whether the light saw the mirror twice: the matrix is then twice as large."""

    session: str | None
    basis_id: str | None
    config_id: str | None
    sha256: str
    """Of the matrix as it travels, 64 lower-case hex digits; empty: there is none."""


class MeasurementsView(View):
    """Measured interaction matrices, oldest first."""

    measurements: tuple[MeasurementView, ...]


class MeasureAcceptedView(AcceptedView):
    """A measurement the RTC has begun."""

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


class MeasuredParameters(BaseModel):
    """How to return a measured matrix."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    format: MeasuredFormat = MeasuredFormat.NPY
    """"npy", "raw" or "hdf5"."""


@router.post("/measurements", status_code=202, responses={**COMMAND})
async def measure(service: ServiceDep, body: MeasureBody | None = None) -> MeasureAcceptedView:
    """Have the RTC measure an interaction matrix; 409 with its reason when it will not.

    The answer comes when the RTC has begun; the matrix follows seconds to minutes later.
    """
    body = body or MeasureBody()
    now = datetime.fromtimestamp(service.snapshot().now_ns / 1e9, UTC)
    command = Measure(
        id=f"im-{now:%Y%m%dT%H%M%S.%f}",
        pattern=body.pattern,
        modes=None if body.modes is None else tuple(body.modes),
        amplitude_m=body.amplitude_m,
        n_average=body.n_average,
        frequency_hz=None if body.frequency_hz is None else tuple(body.frequency_hz),
        duration_s=body.duration_s,
    )
    text = await service.submit(command)
    links = {"measurement": f"{_ALL}/{command.id}", "state": "/v1/state", "events": "/v1/events"}
    return MeasureAcceptedView(id=command.id, text=text, links=links)


@router.get("/measurements")
async def measurements(service: ServiceDep) -> MeasurementsView:
    """Return the interaction matrices that were measured or are being measured, oldest first."""
    return MeasurementsView.model_validate(service.snapshot().tracker)


@router.get("/measurements/{id}", responses={**UNKNOWN})
async def measurement(service: ServiceDep, measurement_id: MeasurementId) -> MeasurementView:
    """Return how a matrix was measured, or how far it is."""
    record = service.snapshot().tracker.measurement(measurement_id)
    if record is None:
        raise UnknownIdError(f"measurement {measurement_id}: nobody has heard of it")
    return MeasurementView.model_validate(record)


@router.delete("/measurements/{id}", status_code=202, responses={**COMMAND, **UNKNOWN})
async def give_up(service: ServiceDep, measurement_id: MeasurementId) -> AcceptedView:
    """Wait no longer for a matrix under way; one that is stored stays.

    Nothing on the wire ends the RTC's own work: it may go on to the end, and refuse other commands
    until then. The service ignores what comes of it and asks, as often as it takes, for the loop
    to be closed again if it was closed before.
    """
    return await accepted(
        service, GiveUp(id=measurement_id), measurement=f"{_ALL}/{measurement_id}"
    )


@router.get(
    "/measurements/{id}/matrix",
    response_class=Response,
    responses={
        200: {
            "description": "The measured interaction matrix, slope per metre OPD",
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
                "application/x-hdf5": {"schema": {"type": "string", "format": "binary"}},
            },
            "headers": {
                "X-Shape": {
                    "description": "Rows (slopes) and columns (modes); not with hdf5",
                    "schema": {"type": "string", "example": "1384,400"},
                },
                "X-Dtype": {
                    "description": "C-ordered little-endian float32; not with hdf5",
                    "schema": {"type": "string", "example": "<f4"},
                },
            },
        },
        **UNKNOWN,
    },
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
        content = await run_in_threadpool(service.measured_file, measurement_id)
        return Response(
            content,
            media_type="application/x-hdf5",
            headers={"Content-Disposition": f'attachment; filename="{measurement_id}.h5"'},
        )
    matrix = await run_in_threadpool(service.measured_matrix, measurement_id)
    numbers = np.ascontiguousarray(matrix, "<f4")
    raw = parameters.format is MeasuredFormat.RAW
    extension = "f4" if raw else "npy"
    return Response(
        numbers.tobytes() if raw else _npy(numbers),
        media_type="application/octet-stream",
        headers={
            "X-Shape": ",".join(str(n) for n in numbers.shape),
            "X-Dtype": "<f4",
            "Content-Disposition": f'attachment; filename="{measurement_id}.{extension}"',
        },
    )


def _npy(numbers: NDArray[np.float32]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, numbers, allow_pickle=False)
    return buffer.getvalue()
