"""Noisy interaction matrices: measure one on sky, see how far it is, look at it, take it away.

None of them can become a reconstructor: no route, and nothing behind one, publishes them.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Path, Response
from fastapi.concurrency import run_in_threadpool
from numpy.typing import NDArray
from pydantic import Field

from service.errors import UnknownIdError
from service.events import GiveUpNoisy, MeasureNoisy
from service.reactions.dither_choice import NOISY_DITHER
from service.routes.modes import Modes
from service.routes.operating import AcceptedView, Positive, Request, accepted
from service.routes.problems import COMMAND, INVALID, UNKNOWN
from service.routes.service import ServiceDep
from service.routes.views import FourView, Number, View
from service.state import ModeSet, NoisyFinding, NoisyRecord, NoisyState

router = APIRouter(prefix="/v1", tags=["noisy interaction matrices"], responses={**INVALID})

LONGEST_S = 3600.0
_ALL = "/v1/noisy-matrix"

NoisyId = Annotated[str, Path(alias="id", description="Id of a noisy interaction matrix")]


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


class NoisyFindingView(View):
    """What came of a noisy interaction matrix."""

    n_slopes: int
    """Rows of the matrix."""

    n_frames: int
    """Frames that entered it."""

    n_missing: int
    """Frames of its windows that never came."""

    snr: Number
    """RMS signal of an element over its noise."""

    alpha: FourView | None
    """The registration fitted to it; null: none could be."""

    sigma: FourView | None
    """1 σ of it, from the data alone."""

    optical_gain: Number
    """Mean gain of the modes against the model."""

    misfit: Number
    """Residual power over what noise explains; 1: the model explains the data."""

    cm_id: str | None
    """The reconstructor in use at its end."""

    session: str
    created_ns_utc: int
    """End of its last frame, the RTC's clock."""

    sha256: str
    """Of the matrix, C-ordered little-endian float32."""


class NoisyView(View):
    """A noisy interaction matrix, or one under way."""

    id: str
    state: NoisyState
    """"waiting", "asked", "running", "finishing", "stored", "failed" or "given-up"."""

    reason: str
    """Why there is none, or what is missing."""

    n_modes: int
    """Columns."""

    modes: tuple[int, ...]
    """0-based basis indices, one for each column."""

    total_m: float
    """RMS of all modes together, metres OPD."""

    amplitude_m: float
    """RMS of each mode."""

    duration_s: float
    window_s: float
    """Of the windows it is summed from."""

    seed: int
    """Of the dither's signs."""

    asked_ns_utc: int
    basis_id: str
    config_id: str
    finding: NoisyFindingView | None
    """Null: not finished."""


class NoisyListView(View):
    """Noisy interaction matrices."""

    noisy_matrices: tuple[NoisyView, ...]
    """Oldest first."""


class NoisyAcceptedView(AcceptedView):
    """A noisy interaction matrix that has been asked for."""

    id: str
    """Of the matrix to come."""


@router.post("/noisy-matrix", status_code=202, responses={**COMMAND})
async def measure_noisy(service: ServiceDep, body: NoisyBody | None = None) -> NoisyAcceptedView:
    """Measure a noisy interaction matrix on sky, loop closed, by a random dither.

    The service's own dither makes way for it; every window of it is fitted like any other.
    """
    body = body or NoisyBody()
    now = datetime.fromtimestamp(service.snapshot().now_ns / 1e9, UTC)
    command = MeasureNoisy(
        id=f"{NOISY_DITHER}{now:%Y%m%dT%H%M%S.%f}",
        modes=body.modes if isinstance(body.modes, ModeSet) else tuple(body.modes),
        total_m=body.total_amplitude_m,
        duration_s=body.duration_s,
        over_budget=body.over_budget,
    )
    text = await service.submit(command)
    links = {"matrix": f"{_ALL}/{command.id}", "state": "/v1/state", "events": "/v1/events"}
    return NoisyAcceptedView(id=command.id, text=text, links=links)


@router.get("/noisy-matrix")
async def noisy_matrices(service: ServiceDep) -> NoisyListView:
    """Return the noisy interaction matrices the service remembers, oldest first."""
    records = service.snapshot().tracker.noisy
    return NoisyListView(noisy_matrices=tuple(_view(record) for record in records))


@router.get("/noisy-matrix/{id}", responses={**UNKNOWN})
async def noisy_matrix(service: ServiceDep, noisy_id: NoisyId) -> NoisyView:
    """Return what is known of one, or how far it is."""
    record = service.snapshot().tracker.noisy_matrix(noisy_id)
    if record is None:
        raise UnknownIdError(f"noisy matrix {noisy_id}: nobody has heard of it")
    return _view(record)


@router.delete("/noisy-matrix/{id}", status_code=202, responses={**COMMAND, **UNKNOWN})
async def give_up_noisy(service: ServiceDep, noisy_id: NoisyId) -> AcceptedView:
    """End one under way, and its dither; one that is stored stays."""
    return await accepted(service, GiveUpNoisy(id=noisy_id), matrix=f"{_ALL}/{noisy_id}")


@router.get(
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
    content = await run_in_threadpool(service.noisy_file, noisy_id)
    return Response(
        content,
        media_type="application/x-hdf5",
        headers={"Content-Disposition": f'attachment; filename="{noisy_id}.h5"'},
    )


def _view(record: NoisyRecord) -> NoisyView:
    values = {name: getattr(record, name) for name in NoisyView.model_fields if name != "n_modes"}
    finding = record.finding
    return NoisyView.model_validate(
        values | {"n_modes": len(record.modes), "finding": finding and _finding(finding)}
    )


def _finding(finding: NoisyFinding) -> dict[str, object]:
    names = (name for name in NoisyFindingView.model_fields if name != "sigma")
    values = {name: getattr(finding, name) for name in names}
    return values | {"sigma": _sigma(finding.covariance)}


def _sigma(covariance: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    return None if covariance is None else np.sqrt(np.diag(covariance))
