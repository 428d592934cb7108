"""Routes of reconstructors: records, numbers, gains, comparisons; how any matrix leaves."""

from __future__ import annotations

import io
import pathlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Path, Query, Request, Response
from fastapi.responses import FileResponse, StreamingResponse
from numpy.typing import NDArray

from service.errors import CommandError
from service.records.products import MatrixState
from service.records.registration import MeasuredGains
from service.runtime.snapshot import ModeGainTable, present_gains
from service.runtime.supervisor import Supervisor
from service.tracking.reconstructors import require_record
from service.tracking.references import require_references
from service.web import views
from service.web.connections import tag_of, unless_kept
from service.web.problems import COMMAND, INVALID, UNKNOWN

router = APIRouter(prefix="/v1", tags=["state"], responses={**INVALID})

Numbers = NDArray[np.float32]

# --- which matrix is meant


_ALIASES = {
    "in-use": "no reconstructor is known to be in use",
    "previous": "no earlier reconstructor has been in use",
    "candidate": "no reconstructor is proposed",
}
"""Names for what changes, and the text where there is none."""


async def _resolve_id(
    service: views.ServiceDep,
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
    return views.found_or_refuse(found or None, f"{matrix_id}: {_ALIASES[matrix_id]}")


MatrixId = Annotated[str, Depends(_resolve_id)]
"""Reconstructor named in a path."""


async def _resolve_references(
    service: views.ServiceDep,
    reference_id: Annotated[
        str, Path(alias="id", description="Id of references, or in-use, candidate, newest")
    ],
) -> str:
    """Return the id that is meant."""
    kept = service.snapshot().tracker.references
    proposed = [r.id for r in kept.records if r.state is MatrixState.PROPOSED]
    newest = kept.records[-1].id if kept.records else None
    offered = proposed[-1] if proposed else None
    aliases = {"in-use": kept.used_id, "candidate": offered, "newest": newest}
    if reference_id not in aliases:
        return reference_id
    return views.found_or_refuse(aliases[reference_id], f"{reference_id}: there are no references")


ReferencesId = Annotated[str, Depends(_resolve_references)]
"""Reference slopes named in a path."""


async def _other(
    service: views.ServiceDep,
    other: Annotated[str, Path(description="Id of another, or in-use, previous, candidate")],
) -> str:
    return await _resolve_id(service, other)


OtherId = Annotated[str, Depends(_other)]
"""Second reconstructor named in the same path."""


_SLOPES_PER_PRODUCT = 1024
"""Slopes that are multiplied at once, in float64."""

RESPONSE_PART_BYTES = 4_000_000
"""Bytes sent at once, so that the 250 MB of a large telescope's matrix are never copied whole."""


# --- the formats in which its numbers leave


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


class MatrixParameters(views.Parameters):
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
    file_of: Callable[[str], pathlib.Path],
) -> Response:
    """Return a matrix in the requested format; its shape is in the headers, except with HDF5.

    An id is never reused, so a client that has its numbers in this format need not load them again.

    Raises
    ------
    CommandError
        If it is not available in that format.
    """

    def made() -> Response:
        extension = _EXTENSIONS.get(form, form.value)
        headers = {"Content-Disposition": f'attachment; filename="{matrix_id}.{extension}"'}
        if form is MatrixFormat.HDF5:
            return FileResponse(file_of(matrix_id), media_type=MEDIA_TYPES[form], headers=headers)
        numbers = np.ascontiguousarray(matrix_of(matrix_id), "<f4")
        headers |= {"X-Shape": ",".join(str(n) for n in numbers.shape), "X-Dtype": "<f4"}
        if form is MatrixFormat.FITS:
            content = _as_fits(numbers, matrix_id)
            return Response(content, media_type=MEDIA_TYPES[form], headers=headers)
        head = b"" if form is MatrixFormat.RAW else _npy_head(numbers)
        # Stated, so that a client notices a transfer that breaks off.
        headers["Content-Length"] = str(len(head) + numbers.nbytes)
        parts = _parts(head, numbers)
        return StreamingResponse(parts, media_type=MEDIA_TYPES[form], headers=headers)

    return await unless_kept(request, tag_of(matrix_id, form), made)


def _parts(head: bytes, numbers: Numbers) -> Iterator[bytes]:
    """Yield a file's header, and its numbers as raw memory."""
    yield head
    raw = numbers.reshape(-1).view(np.uint8)
    for first in range(0, len(raw), RESPONSE_PART_BYTES):
        yield raw[first : first + RESPONSE_PART_BYTES].tobytes()


def _npy_head(numbers: Numbers) -> bytes:
    buffer = io.BytesIO()
    about = np.lib.format.header_data_from_array_1_0(numbers)
    np.lib.format.write_array_header_1_0(buffer, about)
    return buffer.getvalue()


def _as_fits(numbers: Numbers, matrix_id: str) -> bytes:
    try:
        from astropy.io import fits
    except ImportError:
        text = "FITS: found no astropy, expected it to be installed: pip install astropy"
        raise CommandError(text) from None
    image, buffer = fits.PrimaryHDU(numbers), io.BytesIO()
    image.header["OBJECT"] = matrix_id
    image.writeto(buffer)
    return buffer.getvalue()


def describes_numbers(description: str, rows_and_columns: str, example: str) -> dict[str, Any]:
    """Return the OpenAPI description of such an answer."""
    return {
        **views.binary(description, *MEDIA_TYPES.values()),
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


# --- the reconstructors


@router.get("/reconstructors", responses={200: views.shows(views.RECONSTRUCTORS)})
async def reconstructors(service: views.ServiceDep) -> Response:
    """Return the reconstructors, oldest first."""
    return views.tagged(service.snapshot().tracker, views.RECONSTRUCTORS)


@router.get("/reconstructors/{id}", responses={200: views.shows(views.RECONSTRUCTOR), **UNKNOWN})
async def reconstructor(service: views.ServiceDep, matrix_id: MatrixId) -> Response:
    """Return the record of a reconstructor."""
    return views.tagged(require_record(service.snapshot().tracker, matrix_id))


@router.get(
    "/reconstructors/{id}/matrix",
    response_class=Response,
    responses={
        200: describes_numbers(
            "The reconstructor, metres OPD per slope",
            "Rows (modes) and columns (slopes)",
            "400,1384",
        ),
        **UNKNOWN,
    },
)
async def reconstructor_matrix(
    request: Request,
    service: views.ServiceDep,
    matrix_id: MatrixId,
    parameters: Annotated[MatrixParameters, Query()],
) -> Response:
    """Return a reconstructor ``(n_modes, n_slopes)``, metres OPD per slope.

    ``?format=npy`` (the default) is a NumPy file, ``raw`` the bytes as they travel to the RTC,
    whose SHA-256 is the reconstructor's ``sha256``, ``hdf5`` the archived product, ``fits`` an
    image.
    """
    return await numbers_of(
        request,
        matrix_id,
        parameters.format,
        service.matrix,
        lambda name: service.archive.reconstructors.file(name),
    )


@router.get("/references", tags=["references"], responses={200: views.shows(views.REFERENCES)})
async def references(service: views.ServiceDep) -> Response:
    """Return the shape, and the references, oldest first."""
    return views.answer(service.snapshot().tracker, views.REFERENCES)


@router.get(
    "/references/{id}",
    tags=["references"],
    responses={200: views.shows(views.REFERENCES_RECORD), **UNKNOWN},
)
async def reference_record(service: views.ServiceDep, reference_id: ReferencesId) -> Response:
    """Return the record of references."""
    return views.tagged(require_references(service.snapshot().tracker, reference_id))


@router.get(
    "/references/{id}/slopes",
    tags=["references"],
    response_class=Response,
    responses={
        200: describes_numbers(
            "The offset of the slopes, to be subtracted beyond the RTC's own references",
            "Number of slopes",
            "1384",
        ),
        **UNKNOWN,
    },
)
async def reference_slopes(
    request: Request,
    service: views.ServiceDep,
    reference_id: ReferencesId,
    parameters: Annotated[MatrixParameters, Query()],
) -> Response:
    """Return the offset of references ``(n_slopes,)``, for a program that applies it."""
    store = service.archive.references
    return await numbers_of(request, reference_id, parameters.format, store.matrix, store.file)


@router.get("/gains", responses={200: views.shows(views.GAINS), **COMMAND})
async def gains(service: views.ServiceDep) -> Response:
    """Return the optical gains of all modes now.

    ``POST /v1/loop`` with ``effective_gain`` sets the loop gains by it, if the gate agrees.
    """
    found = present_gains(service.snapshot().tracker)
    if found is None:
        raise CommandError("gains: no RTC is there: the number of modes is not known")
    return views.answer(ModeGainTable.of(found))


@router.get("/reconstructors/{id}/gains", responses={200: views.shows(views.GAINS), **UNKNOWN})
async def reconstructor_gains(service: views.ServiceDep, matrix_id: MatrixId) -> Response:
    """Return the optical gains when a reconstructor was made."""
    record = require_record(service.snapshot().tracker, matrix_id)
    gains = MeasuredGains(
        measured=record.optical_gains, n_modes=record.n_modes, reference_id=record.reference_id
    )
    return views.answer(ModeGainTable.of(gains, record.id))


# --- what the page draws of them


@dataclass(frozen=True, slots=True, kw_only=True)
class SingularValues:
    """Singular values of a reconstructor's modes: weak ones amplify noise."""

    id: str
    """Id of the reconstructor."""

    values: list[float]
    """One over each singular value of the reconstructor, largest first, slope per metre OPD: those
    of the interaction matrix it inverts, where none were left out."""

    nominal: list[float] | None
    """Singular values of the model's interaction matrix with as many modes, at nominal
    registration; null while the model is being prepared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixComparison:
    """Difference of two reconstructors, mode by mode: of as many modes as both have."""

    id: str
    other: str
    modes: list[int]
    """Basis indices."""

    gain: list[float]
    """Norm of the first matrix' row divided by that of the other's."""

    cosine: list[float]
    """Cosine of the angle between both rows: 1 if they measure the same slopes, -1 with opposite
    sign."""

    difference: float
    """Norm of what they differ by over that of the other, all of these modes together."""


SINGULAR = views.define_view("SingularValuesView", SingularValues)
COMPARISON = views.define_view("MatrixComparisonView", MatrixComparison)


@router.get(
    "/reconstructors/{id}/singular-values", responses={200: views.shows(SINGULAR), **UNKNOWN}
)
async def singular_values(
    request: Request, service: views.ServiceDep, matrix_id: MatrixId
) -> Response:
    """Return the singular values of a reconstructor."""
    known = service.description
    products = None if known is None else known.products

    def made() -> Response:
        found = views.answer(_singular_values(matrix_id, service.matrix(matrix_id), products))
        if products is not None:
            found.headers["Cache-Control"] = "private, max-age=86400"  # an id is never reused
        return found

    # The answer changes once the model is prepared.
    return await unless_kept(request, tag_of(matrix_id, products is None), made)


def _singular_values(
    matrix_id: str, matrix: NDArray[np.float32], products: NDArray[np.float32] | None
) -> SingularValues:
    """Return those that are not lost in rounding, of a reconstructor and of as many modes."""
    power = np.linalg.eigvalsh(_products(matrix))
    # Eigenvalues are squares of singular values: below 1e-13 of the largest they are rounding
    # errors of float64.
    inverted = power[power > power[-1] * 1e-13] ** -0.5
    nominal = None
    if products is not None:
        modelled = np.linalg.eigvalsh(products[: len(matrix), : len(matrix)].astype(np.float64))
        # Rounding makes the smallest eigenvalues of a singular matrix slightly negative.
        nominal = _round(np.sqrt(np.maximum(modelled[::-1], 0.0)))
    return SingularValues(id=matrix_id, values=_round(inverted), nominal=nominal)


def _products(matrix: Numbers) -> NDArray[np.float64]:
    """Return the matrix times its transpose, some slopes at once: in float64 it is large."""
    found = np.zeros((len(matrix), len(matrix)))
    for first in range(0, matrix.shape[1], _SLOPES_PER_PRODUCT):
        some = matrix[:, first : first + _SLOPES_PER_PRODUCT].astype(np.float64)
        found += some @ some.T
    return found


def _round(values: NDArray[np.float64]) -> list[float]:
    return [float(f"{value:.4g}") for value in values]


@router.get(
    "/reconstructors/{id}/compared-with/{other}",
    responses={200: views.shows(COMPARISON), **UNKNOWN, **COMMAND},
)
async def compare(
    request: Request, service: views.ServiceDep, matrix_id: MatrixId, other: OtherId
) -> Response:
    """Return the difference of two reconstructors, mode by mode."""
    return await unless_kept(
        request,
        tag_of(matrix_id, other),
        lambda: views.answer(_compare(service, matrix_id, other)),
    )


def _compare(service: Supervisor, matrix_id: str, other: str) -> MatrixComparison:
    """Compare two reconstructors; waits for the disk.

    Raises
    ------
    CommandError
        If they are of different slopes.
    """
    first, second = (service.matrix(name) for name in (matrix_id, other))
    if first.shape[1] != second.shape[1]:
        raise CommandError(
            f"found {first.shape[1]} slopes in {matrix_id} and {second.shape[1]} in {other}, "
            "expected as many in both"
        )
    n_modes = min(len(first), len(second))
    sums = np.array([_sums(first[mode], second[mode]) for mode in range(n_modes)])
    sizes, others, between = np.sqrt(sums[:, :3].T)
    # A row of zeros gives NaN, which is shown as null.
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = sizes / others
        cosine = sums[:, 3] / (sizes * others)
        difference = np.linalg.norm(between) / np.linalg.norm(others)
    return MatrixComparison(
        id=matrix_id,
        other=other,
        modes=list(range(n_modes)),
        gain=_round(gain),
        cosine=_round(cosine),
        difference=float(difference),
    )


def _sums(one: Numbers, other: Numbers) -> tuple[float, float, float, float]:
    """Return the squares of two rows and of their difference, and their product."""
    a, b = one.astype(np.float64), other.astype(np.float64)
    return float(a @ a), float(b @ b), float((a - b) @ (a - b)), float(a @ b)
