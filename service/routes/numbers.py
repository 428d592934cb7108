"""Which matrix is meant, and its numbers as they leave: NumPy, raw, HDF5, FITS."""

from __future__ import annotations

import io
from collections.abc import Callable
from enum import StrEnum
from typing import Annotated, Any

import numpy as np
from fastapi import Depends, Path, Response
from fastapi.concurrency import run_in_threadpool
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from service.errors import CommandError, UnknownIdError
from service.routes.views import ServiceDep
from service.tracking.products import MatrixState

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


def _named(
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
    proposed = [r.id for r in state.reconstructors if r.state is MatrixState.PROPOSED]
    found = {
        "in-use": state.in_use,
        "previous": state.previous,
        "candidate": proposed[-1] if proposed else None,
    }[matrix_id]
    if not found:
        raise UnknownIdError(f"{matrix_id}: {_ALIASES[matrix_id]}")
    return found


MatrixId = Annotated[str, Depends(_named)]
"""Of a reconstructor that a path names."""


class MatrixFormat(StrEnum):
    """How a matrix leaves."""

    NPY = "npy"
    """NumPy's own file format."""

    RAW = "raw"
    """C-ordered little-endian float32, the bytes ``sha256`` is of."""

    HDF5 = "hdf5"
    """The archived product, with what it was made from, or how it was measured."""

    FITS = "fits"
    """An image of float32; the service then needs astropy, its extra ``fits``."""


class MatrixParameters(Parameters):
    """How to return a matrix."""

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
    matrix_id: str,
    form: MatrixFormat,
    matrix_of: Callable[[str], Numbers],
    file_of: Callable[[str], bytes],
) -> Response:
    """Return a matrix as it is asked for; the shape is in the headers, but with HDF5.

    Raises
    ------
    CommandError
        If it cannot leave like that from here.
    """
    extension = _EXTENSIONS.get(form, form.value)
    headers = {"Content-Disposition": f'attachment; filename="{matrix_id}.{extension}"'}
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
                text = "FITS: found no astropy, expected pyrcal installed with its extra 'fits'"
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
