"""Matrices on the wire: manifests, chunks and acknowledgements.

A matrix is sent in chunks, followed or preceded by a commit that carries its manifest: shape,
checksum, and what it is for. The receiver collects both in a :class:`ChunkAssembler`. The RTC
answers a reconstructor with an :class:`Acknowledgement`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Annotated, Final

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from service.errors import WireError
from service.wire import codec, commands

CHUNK_LIMIT: Final = 4_000_000
"""Largest chunk of a matrix, in bytes."""

MATRIX_LIMIT: Final = 2**31
"""Largest matrix, in bytes."""

DTYPE: Final = "<f4"
"""Type of every matrix on the wire: little-endian float32, in C order."""

AXIS_LIMIT: Final = 1_000_000
"""Largest number of rows or columns of a matrix."""

_Axis = Annotated[int, codec.integer(0, AXIS_LIMIT)]
_AXES: Final = f"two axes, at most {MATRIX_LIMIT} bytes"


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixLayout:
    """Shape, chunks and checksum of a float32 matrix on the wire."""

    shape: Annotated[tuple[_Axis, _Axis], Meta(description=_AXES)]
    """Rows and columns, C order."""

    n_chunks: codec.Count
    """Number of chunks; 0 after a failed measurement."""

    chunk_bytes: Annotated[int, codec.integer(1, CHUNK_LIMIT)]
    """Bytes of each chunk; the last one may be shorter."""

    sha256: Annotated[str, Meta(pattern=r"\A([0-9a-f]{64})?\Z", description=codec.SHA256_EXPECTED)]
    """SHA-256 of all bytes; empty after a failed measurement."""

    @property
    def n_bytes(self) -> int:
        """Number of bytes of the whole matrix."""
        return 4 * self.shape[0] * self.shape[1]

    def size_of(self, index: int) -> int:
        """Return the number of bytes that chunk ``index`` must have."""
        return min(self.chunk_bytes, self.n_bytes - index * self.chunk_bytes)


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """Manifest of a reconstructor that the service sends, or that the RTC uses."""

    id: codec.Id
    """Id of the reconstructor, never reused."""

    layout: MatrixLayout
    """Shape ``(n_controlled, n_slopes)``, chunks and checksum; row i commands basis mode i."""

    alpha: Mapping[str, float] | None
    """Registration for which it was computed."""

    sigma: Mapping[str, float] | None
    """1 σ of ``alpha``."""

    im_id: codec.Text | None
    """Id of the inverted interaction matrix; informative."""

    parent: codec.Text | None
    """Id of the reconstructor that it replaces; informative."""

    basis_id: codec.Opaque
    """Modal basis that it commands."""

    config_id: codec.Opaque
    """Sensor configuration whose slopes it multiplies."""

    system: codec.Id
    """The ``{system}`` of the keys."""

    created_ns: codec.Count
    """Time of its computation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredManifest:
    """Manifest of an interaction matrix measured by the RTC, in slope per metre OPD."""

    id: codec.Id
    """Id of the measure command."""

    layout: MatrixLayout
    """Shape ``(n_slopes, n_modes_measured)``; no chunks if the measurement failed."""

    reason: codec.Text | None
    """Reason of a failure."""

    modes: tuple[_Axis, ...]
    """0-based basis index of each column."""

    amplitude_m: tuple[codec.Positive, ...]
    """RMS stroke of each mode."""

    n_average: Annotated[int, codec.integer(1)]
    """Number of repetitions averaged."""

    pattern: commands.Pattern
    """Pattern of mirror commands."""

    double_pass: bool
    """True if the light meets the mirror twice, which doubles the slopes."""

    session: codec.Opaque
    """Session of the RTC."""

    basis_id: codec.Opaque
    """Modal basis."""

    config_id: codec.Opaque
    """Sensor configuration."""

    system: codec.Id
    """The ``{system}`` of the keys."""

    created_ns: codec.Count
    """Time of the measurement."""


class AckState(StrEnum):
    """Progress of a reconstructor in the RTC."""

    STAGED = "staged"
    APPLIED = "applied"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledgement:
    """Acknowledgement of one reconstructor by the RTC."""

    session: codec.Opaque
    """Session of the RTC; others are ignored."""

    id: codec.Id | None
    """Id of the reconstructor; None if the commit was unreadable."""

    sha256: codec.Sha256 | None
    """SHA-256 of the matrix; None if ``id`` is None."""

    state: AckState
    """Progress of the reconstructor."""

    reason: codec.Text
    """Reason of a rejection; else empty."""

    frame_seq: codec.Count | None
    """First frame whose slopes the new matrix multiplies; None unless applied."""


def _flatten_layout(keys: codec.Map) -> codec.Map:
    layout = asdict(keys.pop("layout"))
    return {**keys, "dtype": DTYPE, **layout}


# On the wire the keys of a layout are on the top level of the manifest, in one flat map. The record
# has them in a nested ``layout``; _flatten_layout and _nest_layout convert between the two.


def _manifest_fields(values: codec.Map, where: str) -> codec.Map:
    values = _nest_layout(values, where)
    alpha, sigma = (codec.read_registration(values, key, where) for key in ("alpha", "sigma"))
    if alpha is not None and alpha["magnification"] <= 0.0:
        inside = f"'alpha' of {where}"
        raise codec.refusal("magnification", alpha["magnification"], "a finite number > 0", inside)
    return {**values, "alpha": alpha, "sigma": sigma}


def _measured_manifest_fields(values: codec.Map, where: str) -> codec.Map:
    values = _nest_layout(values, where, may_fail=True)
    # A reason sent with a matrix is ignored, not refused.
    return values | {"reason": None} if values["layout"]["n_chunks"] else values


def _check_measured(manifest: MeasuredManifest, where: str) -> None:
    layout, n_modes = manifest.layout, len(manifest.modes)
    codec.check_applicability(manifest, where, reason=not layout.n_chunks)
    if len(manifest.amplitude_m) != n_modes or (layout.n_chunks and n_modes != layout.shape[1]):
        expected = f"one for each of {layout.shape[1]} measured modes"
        raise codec.refusal("amplitude_m", manifest.amplitude_m, expected, where)


def _check_acknowledgement(ack: Acknowledgement, where: str) -> None:
    if (ack.frame_seq is not None) != (ack.state is AckState.APPLIED):
        raise codec.refusal("frame_seq", ack.frame_seq, "a number if and only if applied", where)
    if ack.state is not AckState.REJECTED and (ack.id is None or ack.sha256 is None):
        raise codec.refusal("id, sha256", (ack.id, ack.sha256), "both, unless rejected", where)


def _nest_layout(values: codec.Map, where: str, *, may_fail: bool = False) -> codec.Map:
    """Return the map of a manifest with the keys of its layout moved below ``layout``."""
    if codec.require(values, "dtype", where) != DTYPE:
        raise codec.refusal("dtype", values["dtype"], repr(DTYPE), where)
    failed = may_fail and values.get("n_chunks") == 0
    if failed:
        # The contract allows nil or an empty text here.
        values["sha256"] = ""
    layout = codec.read(values, MatrixLayout, where)
    if layout.n_bytes > MATRIX_LIMIT:
        raise codec.refusal("shape", str(layout.shape), _AXES, where)
    expected = math.ceil(layout.n_bytes / layout.chunk_bytes)
    if layout.n_chunks != expected and not failed:
        raise codec.refusal(
            "n_chunks", layout.n_chunks, f"{expected} for shape {layout.shape}", where
        )
    if not layout.sha256 and not failed:
        raise codec.refusal("sha256", layout.sha256, codec.SHA256_EXPECTED, where)
    return {**values, "layout": asdict(layout)}


codec.register(
    Manifest, "the manifest of a reconstructor", keys=_flatten_layout, fields=_manifest_fields
)
codec.register(
    MeasuredManifest,
    "the manifest of a measured matrix",
    keys=_flatten_layout,
    optional_keys=("reason",),
    fields=_measured_manifest_fields,
    check=_check_measured,
)
codec.register(
    Acknowledgement,
    "an acknowledgement",
    fields=codec.nil_reason_to_text,
    check=_check_acknowledgement,
)


def layout_of(matrix: NDArray[np.float32], chunk_bytes: int) -> MatrixLayout:
    """Return the layout of a matrix that will be sent in chunks of ``chunk_bytes``.

    Raises
    ------
    WireError
        If the matrix is not two-dimensional and finite, or the chunk size is out of range.
    """
    if matrix.ndim != 2 or not np.all(np.isfinite(matrix)):
        raise WireError(
            f"range: a matrix of shape {matrix.shape} with {np.sum(~np.isfinite(matrix))} "
            "non-finite numbers cannot travel, expected a finite two-dimensional one"
        )
    rows, columns = matrix.shape
    if not 1 <= chunk_bytes <= CHUNK_LIMIT:
        raise WireError(f"range: chunk_bytes is {chunk_bytes}, expected 1 to {CHUNK_LIMIT}")
    return MatrixLayout(
        shape=(rows, columns),
        n_chunks=math.ceil(4 * rows * columns / chunk_bytes),
        chunk_bytes=chunk_bytes,
        sha256=checksum(matrix),
    )


def checksum(matrix: NDArray[np.float32]) -> str:
    """Return the SHA-256 of a matrix's bytes on the wire, 64 lower-case hex digits."""
    # Of the bytes on the wire, whatever order and byte order the array has in memory.
    return hashlib.sha256(np.ascontiguousarray(matrix, dtype=DTYPE).data).hexdigest()


def split(matrix: NDArray[np.float32], chunk_bytes: int) -> list[bytes]:
    """Return the bytes of a matrix in chunks of ``chunk_bytes``; the last may be shorter."""
    data = np.ascontiguousarray(matrix, dtype=DTYPE).data.cast("B")
    return [bytes(data[start : start + chunk_bytes]) for start in range(0, len(data), chunk_bytes)]


class ChunkAssembler:
    """Collector of the chunks of one matrix, in any order, before or after its manifest.

    zenoh sends a commit at a higher priority than chunks, so a manifest may overtake them. Until
    it has come only the limit on memory is checked. Chunks that do not fit the manifest are
    dropped, so that they count as missing and can be requested again.
    """

    __slots__ = ("_layout", "_limit_bytes", "_parts")

    def __init__(self, limit_bytes: int = MATRIX_LIMIT) -> None:
        self._limit_bytes = limit_bytes
        self._parts: dict[int, bytes] = {}
        self._layout: MatrixLayout | None = None

    def add(self, index: int, data: bytes) -> None:
        """Add one chunk; a repeated one is ignored.

        Raises
        ------
        WireError
            If it is too long, does not fit the manifest, or would exceed the limit on memory.
        """
        # zenoh may deliver a chunk twice: once published, once as the answer to a query.
        if index in self._parts:
            return
        if not 0 < len(data) <= CHUNK_LIMIT:
            raise WireError(
                f"range: chunk {index} has {len(data)} bytes, expected 1 to {CHUNK_LIMIT}"
            )
        if self.n_bytes + len(data) > self._limit_bytes:
            raise WireError(
                f"range: chunk {index} brings the matrix to {self.n_bytes + len(data)} bytes, "
                f"expected at most {self._limit_bytes}"
            )
        if self._layout is not None:
            _check_part(self._layout, index, len(data))
        self._parts[index] = data

    def announce(self, layout: MatrixLayout) -> None:
        """Set the layout from the manifest.

        Raises
        ------
        WireError
            If it exceeds the limit on memory, or chunks that have come do not fit it; those are
            dropped.
        """
        if layout.n_bytes > self._limit_bytes:
            raise WireError(
                f"range: shape {layout.shape} is {layout.n_bytes} bytes, "
                f"expected at most {self._limit_bytes}"
            )
        self._layout = layout
        # All chunks are checked before the first error is raised, so that one round of queries
        # brings all that are missing.
        refusals = []
        for index in list(self._parts):
            try:
                _check_part(layout, index, len(self._parts[index]))
            except WireError as error:
                del self._parts[index]
                refusals.append(error)
        if refusals:
            raise refusals[0]

    @property
    def n_bytes(self) -> int:
        """Number of bytes collected."""
        return sum(map(len, self._parts.values()))

    @property
    def complete(self) -> bool:
        """True if the manifest and all chunks have come."""
        return self._layout is not None and len(self._parts) == self._layout.n_chunks

    def missing(self) -> tuple[int, ...]:
        """Return the indices of chunks that have not come; empty before the manifest has."""
        if self._layout is None:
            return ()
        return tuple(k for k in range(self._layout.n_chunks) if k not in self._parts)

    def matrix(self) -> NDArray[np.float32]:
        """Return the complete matrix as a read-only array.

        Raises
        ------
        WireError
            If chunks are missing, the checksum differs, or a number is not finite.
        """
        layout = self._layout
        if layout is None or not self.complete:
            expected = "a manifest" if layout is None else f"chunks {self.missing()[:8]} as well"
            raise WireError(f"missing: {len(self._parts)} chunks are here, expected {expected}")
        data = b"".join(self._parts[k] for k in range(layout.n_chunks))
        found = hashlib.sha256(data).hexdigest()
        if found != layout.sha256:
            raise WireError(f"range: the matrix has sha256 {found}, expected {layout.sha256}")
        matrix = np.frombuffer(data, dtype=DTYPE).reshape(layout.shape)
        # A checksum does not exclude NaN, which would reach all actuators within one frame.
        if not np.all(np.isfinite(matrix)):
            n_bad = int(np.sum(~np.isfinite(matrix)))
            raise WireError(f"range: {n_bad} numbers of the matrix are not finite, expected none")
        return matrix


def _check_part(layout: MatrixLayout, index: int, n_bytes: int) -> None:
    if not 0 <= index < layout.n_chunks:
        raise WireError(f"range: chunk {index}, expected 0 to {layout.n_chunks - 1}")
    if n_bytes != layout.size_of(index):
        raise WireError(
            f"range: chunk {index} has {n_bytes} bytes, expected {layout.size_of(index)}"
        )
