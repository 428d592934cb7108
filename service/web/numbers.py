"""Routes of matrices and of the numbers behind the page's figures."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Path, Request, Response
from fastapi.concurrency import run_in_threadpool
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from service.errors import CommandError, UnknownIdError
from service.estimation.frames import FrameBlock
from service.model.instrument import Instrument
from service.model.pupil import rtc_valid_subapertures
from service.model.slopes import as_maps, slopes_of, to_conventions, turned_mask
from service.runtime.supervisor import Supervisor
from service.tracking.products import MatrixState
from service.web.connections import not_modified, tag_of
from service.web.problems import COMMAND, INVALID, UNKNOWN, problem_response
from service.web.views import ServiceDep, answer, define_view, shows

Numbers = NDArray[np.float32]


class Parameters(BaseModel):
    """Query parameters; an unknown one is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


_ALIASES = {
    "in-use": "no reconstructor is known to be in use",
    "previous": "no earlier reconstructor has been in use",
    "candidate": "no reconstructor is proposed",
}
"""Names for what changes, and what is said where there is none."""


async def _named(
    service: ServiceDep,
    matrix_id: Annotated[
        str,
        Path(alias="id", description="Id of a reconstructor, or in-use, previous, candidate"),
    ],
) -> str:
    """Return the id that is meant."""
    if matrix_id not in _ALIASES:
        return matrix_id
    state = service.snapshot().tracker
    proposed = [r.id for r in state.matrices.reconstructors if r.state is MatrixState.PROPOSED]
    found = {
        "in-use": state.matrices.in_use,
        "previous": state.previous,
        "candidate": proposed[-1] if proposed else None,
    }[matrix_id]
    if not found:
        raise UnknownIdError(f"{matrix_id}: {_ALIASES[matrix_id]}")
    return found


MatrixId = Annotated[str, Depends(_named)]
"""Of a reconstructor that a path names."""


async def _other(
    service: ServiceDep,
    other: Annotated[str, Path(description="Id of another, or in-use, previous, candidate")],
) -> str:
    return await _named(service, other)


OtherId = Annotated[str, Depends(_other)]
"""Of another one in the same path."""


class MatrixFormat(StrEnum):
    """Formats of an exported matrix."""

    NPY = "npy"
    """NumPy's own file format."""

    RAW = "raw"
    """C-ordered little-endian float32, the bytes ``sha256`` is of."""

    HDF5 = "hdf5"
    """The archived product, with what it was made from, or how it was measured."""

    FITS = "fits"
    """An image of float32."""


class MatrixParameters(Parameters):
    """Format of the returned matrix."""

    format: MatrixFormat = MatrixFormat.NPY
    """"npy", "raw", "hdf5" or "fits"."""


MEDIA_TYPES = {
    MatrixFormat.NPY: "application/octet-stream",
    MatrixFormat.RAW: "application/octet-stream",
    MatrixFormat.HDF5: "application/x-hdf5",
    MatrixFormat.FITS: "application/fits",
}
_EXTENSIONS = {MatrixFormat.RAW: "f4", MatrixFormat.HDF5: "h5"}


async def numbers_of(
    request: Request,
    matrix_id: str,
    form: MatrixFormat,
    matrix_of: Callable[[str], Numbers],
    file_of: Callable[[str], bytes],
) -> Response:
    """Return a matrix as it is asked for; the shape is in the headers, but with HDF5.

    An id is never reused: whoever has its numbers in this format need not have them again.

    Raises
    ------
    CommandError
        If it cannot leave like that from here.
    """
    extension = _EXTENSIONS.get(form, form.value)
    tag = tag_of(matrix_id, form)
    if (same := not_modified(request, tag)) is not None:
        return same
    headers = {"Content-Disposition": f'attachment; filename="{matrix_id}.{extension}"'}
    headers["ETag"] = tag
    if form is MatrixFormat.HDF5:
        content = await run_in_threadpool(file_of, matrix_id)
    else:
        numbers = np.ascontiguousarray(await run_in_threadpool(matrix_of, matrix_id), "<f4")
        headers |= {"X-Shape": ",".join(str(n) for n in numbers.shape), "X-Dtype": "<f4"}
        content = _written(numbers, form, matrix_id)
    return Response(content, media_type=MEDIA_TYPES[form], headers=headers)


def _written(numbers: Numbers, form: MatrixFormat, matrix_id: str) -> bytes:
    buffer = io.BytesIO()
    match form:
        case MatrixFormat.RAW:
            return numbers.tobytes()
        case MatrixFormat.FITS:
            try:
                from astropy.io import fits
            except ImportError:
                text = "FITS: found no astropy, expected it beside pyrcal: pip install astropy"
                raise CommandError(text) from None
            image = fits.PrimaryHDU(numbers)
            image.header["OBJECT"] = matrix_id
            image.writeto(buffer)
        case _:
            np.save(buffer, numbers, allow_pickle=False)
    return buffer.getvalue()


def describes_numbers(description: str, rows_and_columns: str, example: str) -> dict[str, Any]:
    """Return the OpenAPI description of such an answer."""
    binary = {"schema": {"type": "string", "format": "binary"}}
    return {
        "description": description,
        "content": dict.fromkeys(MEDIA_TYPES.values(), binary),
        "headers": {
            "X-Shape": {
                "description": f"{rows_and_columns}; not with hdf5",
                "schema": {"type": "string", "example": example},
            },
            "X-Dtype": {
                "description": "float32; little-endian but in FITS, C-ordered",
                "schema": {"type": "string", "example": "<f4"},
            },
        },
    }


# --- what the small figures of the page are drawn from


router = APIRouter(prefix="/v1", tags=["state"], responses={**INVALID})


@dataclass(frozen=True, slots=True, kw_only=True)
class SingularValues:
    """Singular values of a reconstructor's modes: weak ones amplify noise."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixComparison:
    """Difference of two reconstructors, mode by mode: of as many modes as both have."""

    id: str
    other: str
    modes: list[int]
    """Basis indices."""

    gain: list[float]
    """By how much stronger the first one answers: norm of its row over that of the other's."""

    cosine: list[float]
    """Of the angle between both rows: 1: they answer to the same slopes, -1: of opposite sign."""

    difference: float
    """Norm of what they differ by over that of the other, all of these modes together."""


SHOWN_S = 0.5
"""So long a picture of the slopes serves whoever asks."""

SINGULAR = define_view("SingularValuesView", SingularValues)
SLOPES = define_view("SlopeMapsView", SlopeMaps)
COMPARISON = define_view("MatrixComparisonView", MatrixComparison)


@router.get("/reconstructors/{id}/singular-values", responses={200: shows(SINGULAR), **UNKNOWN})
async def singular_values(request: Request, service: ServiceDep, matrix_id: MatrixId) -> Response:
    """Return the singular values of a reconstructor."""
    known = service.description
    products = None if known is None else known.products
    tag = tag_of(matrix_id, products is None)
    if (same := not_modified(request, tag)) is not None:
        return same
    matrix = await run_in_threadpool(service.matrix, matrix_id)
    found = answer(await run_in_threadpool(_singular_values, matrix_id, matrix, products))
    found.headers["ETag"] = tag
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
    "/reconstructors/{id}/compared-with/{other}",
    responses={200: shows(COMPARISON), **UNKNOWN, **COMMAND},
)
async def compare(
    request: Request, service: ServiceDep, matrix_id: MatrixId, other: OtherId
) -> Response:
    """Return the difference of two reconstructors, mode by mode."""
    tag = tag_of(matrix_id, other)
    if (same := not_modified(request, tag)) is not None:
        return same
    found = answer(await run_in_threadpool(_compared, service, matrix_id, other))
    found.headers["ETag"] = tag
    return found


def _compared(service: Supervisor, matrix_id: str, other: str) -> MatrixComparison:
    """Compare two reconstructors; waits for the disk.

    Raises
    ------
    CommandError
        If they are of different slopes.
    """
    first, second = (service.matrix(name).astype(np.float64) for name in (matrix_id, other))
    if first.shape[1] != second.shape[1]:
        raise CommandError(
            f"found {first.shape[1]} slopes in {matrix_id} and {second.shape[1]} in {other}, "
            "expected as many in both"
        )
    n_modes = min(len(first), len(second))
    first, second = first[:n_modes], second[:n_modes]
    sizes, others = (np.linalg.norm(rows, axis=1) for rows in (first, second))
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = sizes / others
        cosine = np.sum(first * second, axis=1) / (sizes * others)
        difference = np.linalg.norm(first - second) / np.linalg.norm(second)
    return MatrixComparison(
        id=matrix_id,
        other=other,
        modes=list(range(n_modes)),
        gain=_rounded(gain),
        cosine=_rounded(cosine),
        difference=float(difference),
    )


@router.get(
    "/slopes",
    responses={200: shows(SLOPES), 404: problem_response("No telemetry has come yet")},
)
async def slopes(request: Request, service: ServiceDep) -> Response:
    """Return the RMS of the last residual slopes as maps."""
    if service.newest_frames is None:
        raise UnknownIdError("slopes: no telemetry has come yet")
    shown: SlopesCache = request.app.state.slopes
    return Response(await run_in_threadpool(shown.body, service), media_type="application/json")


class SlopesCache:
    """The last slopes as they leave, worked out once for all pages: each asks every second."""

    def __init__(self) -> None:
        self._body = b""
        self._until_s = 0.0

    def body(self, service: Supervisor) -> bytes:
        """Return them as JSON, at most ``SHOWN_S`` old; telemetry must have come."""
        block, now_s = service.newest_frames, time.monotonic()
        if block is not None and now_s >= self._until_s:
            self._body = bytes(answer(_maps(block, service.instrument)).body)
            self._until_s = now_s + SHOWN_S
        return self._body


def _maps(block: FrameBlock, instrument: Instrument) -> SlopeMaps:
    valid = rtc_valid_subapertures(instrument)
    recipe, orientation = instrument.slopes, instrument.slopes.assumed_orientation
    ours = slopes_of(to_conventions(block.slopes.T, recipe, valid), recipe.kind)
    rms = np.sqrt(np.mean(np.square(ours, dtype=np.float64), axis=-1)).reshape(-1)
    maps = np.round(as_maps(rms, turned_mask(valid, orientation)), 4)
    return SlopeMaps(
        t_ns_utc=block.t0_ns_utc,
        n_frames=block.n_frames,
        cm_id=block.cm_id,
        rms=maps.tolist(),
    )
