"""Numbers behind the small figures of the page: singular values, and slopes as maps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from fastapi import APIRouter, Response
from fastapi.concurrency import run_in_threadpool
from numpy.typing import NDArray

from service.errors import UnknownIdError
from service.files.drawn import as_maps
from service.model.instrument import Instrument
from service.model.interaction import rtc_valid_subapertures
from service.model.slopes import slopes_of, to_conventions, turned_mask
from service.routes.numbers import MatrixId
from service.routes.problems import INVALID, UNKNOWN, problem_response
from service.routes.views import ServiceDep, answer, shows, view
from service.telemetry.frames import FrameBlock

router = APIRouter(prefix="/v1", tags=["what the service knows"], responses={**INVALID})


@dataclass(frozen=True, slots=True, kw_only=True)
class SingularValues:
    """How strongly a reconstructor's modes are seen: the weak ones amplify noise."""

    id: str
    """Of the reconstructor."""

    values: list[float]
    """One over each singular value of the reconstructor, largest first, slope per metre OPD: those
    of the interaction matrix it inverts, where none were left out."""

    nominal: list[float] | None
    """Of the model's interaction matrix of as many modes, the mirror where the instrument file has
    it; null: the model is being prepared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SlopeMaps:
    """The last slopes that came, over the subapertures.

    Rows from the lowest y on, Sx beside Sy, in conventions' axes; null where none is valid.
    """

    t_ns_utc: int
    """Of the first of these frames, the RTC's clock."""

    n_frames: int
    """About a tenth of a second of them."""

    cm_id: str | None
    """The reconstructor that multiplied them; null: nobody has told."""

    rms: list[list[float]]
    """Over these frames, about zero, in the slopes' own unit."""


SINGULAR = view("SingularValuesView", SingularValues)
SLOPES = view("SlopeMapsView", SlopeMaps)


@router.get("/reconstructors/{id}/singular-values", responses={200: shows(SINGULAR), **UNKNOWN})
async def singular_values(service: ServiceDep, matrix_id: MatrixId) -> Response:
    """Return the singular values that a reconstructor stands for."""
    matrix = await run_in_threadpool(service.matrix, matrix_id)
    known = service.description
    products = None if known is None else known.products
    found = answer(await run_in_threadpool(_singular_values, matrix_id, matrix, products))
    if products is not None:
        found.headers["Cache-Control"] = "private, max-age=86400"  # an id is never reused
    return found


def _singular_values(
    matrix_id: str, matrix: NDArray[np.float32], products: NDArray[np.float32] | None
) -> SingularValues:
    """Return those that are not lost in rounding, of a reconstructor and of as many modes."""
    numbers = matrix.astype(np.float64)
    power = np.linalg.eigvalsh(numbers @ numbers.T)
    inverted = power[power > power[-1] * 1e-13] ** -0.5
    nominal = None
    if products is not None:
        modelled = np.linalg.eigvalsh(products[: len(matrix), : len(matrix)].astype(np.float64))
        nominal = _rounded(np.sqrt(np.maximum(modelled[::-1], 0.0)))
    return SingularValues(id=matrix_id, values=_rounded(inverted), nominal=nominal)


def _rounded(values: NDArray[np.float64]) -> list[float]:
    return [float(f"{value:.4g}") for value in values]


@router.get(
    "/slopes",
    responses={200: shows(SLOPES), 404: problem_response("No telemetry has come yet")},
)
async def slopes(service: ServiceDep) -> Response:
    """Return the RMS of the last residual slopes as maps."""
    block = service.newest_frames
    if block is None:
        raise UnknownIdError("slopes: no telemetry has come yet")
    return answer(await run_in_threadpool(_maps, block, service.instrument))


def _maps(block: FrameBlock, instrument: Instrument) -> SlopeMaps:
    valid = rtc_valid_subapertures(instrument)
    recipe, orientation = instrument.slopes, instrument.slopes.assumed_orientation
    ours = slopes_of(to_conventions(block.slopes.T, recipe.order, orientation, valid), recipe.kind)
    rms = np.sqrt(np.mean(np.square(ours, dtype=np.float64), axis=-1)).reshape(-1)
    maps = np.round(as_maps(rms, turned_mask(valid, orientation)), 4)
    return SlopeMaps(
        t_ns_utc=block.t0_ns_utc,
        n_frames=block.n_frames,
        cm_id=block.cm_id,
        rms=maps.tolist(),
    )
