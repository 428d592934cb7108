"""Manifests: what a matrix that travels in chunks must turn out to be."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from service.model.misregistration import PARAMETERS
from service.wire.chunks import CHUNK_LIMIT, DTYPE, MATRIX_LIMIT, MatrixLayout
from service.wire.commands import Pattern
from service.wire.fields import Fields, pack

AXIS_LIMIT: Final = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """A reconstructor on its way from the service to the RTC, or the one the RTC uses."""

    id: str
    """Never reused."""

    layout: MatrixLayout
    """Shape ``(n_controlled, n_slopes)``, chunks and checksum; row i commands basis mode i."""

    alpha: Mapping[str, float] | None
    """Registration it was computed for: shifts in subapertures, rotation in degrees, ratio."""

    sigma: Mapping[str, float] | None
    """1 σ of ``alpha``, same names and units."""

    im_id: str | None
    """Informative: the interaction matrix it inverts."""

    parent: str | None
    """Informative: the reconstructor it follows."""

    basis_id: str
    """Of the modal basis it commands."""

    config_id: str
    """Of the slopes it multiplies."""

    system: str
    """The ``{system}`` of the keys."""

    created_ns: int
    """When it was computed, nanoseconds since the Unix epoch, UTC."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredManifest:
    """An interaction matrix the RTC has measured: slope per metre OPD."""

    id: str
    """The command's."""

    layout: MatrixLayout
    """Shape ``(n_slopes, n_modes_measured)``; no chunks when the measurement failed."""

    reason: str | None
    """Why there is no matrix; None when there is one."""

    modes: tuple[int, ...]
    """0-based basis indices, one per column."""

    amplitude_m: tuple[float, ...]
    """RMS of each mode's stroke, metres OPD."""

    n_average: int
    """Repetitions averaged."""

    pattern: Pattern
    """How it was measured."""

    double_pass: bool
    """Whether the light saw the mirror twice."""

    session: str
    """The RTC's session."""

    basis_id: str
    config_id: str
    system: str
    created_ns: int
    """When it was measured, nanoseconds since the Unix epoch, UTC."""


def encode_manifest(manifest: Manifest) -> bytes:
    """Return the payload of a ``commit``.

    Raises
    ------
    WireError
        If the record breaks the contract.
    """
    data = _pack_with_layout(manifest)
    decode_manifest(data)
    return data


def decode_manifest(data: bytes) -> Manifest:
    """Return the manifest of a reconstructor.

    Raises
    ------
    WireError
        If a key is missing or out of range, or the message is too long.
    """
    message = Fields.unpack(data, "the manifest of a reconstructor").of_this_version()
    return Manifest(
        id=message.identifier("id"),
        layout=_layout(message, first_chunks=1),
        alpha=message.optional("alpha", lambda key: _alpha(message, key)),
        sigma=message.optional("sigma", lambda key: message.named_numbers(key, PARAMETERS)),
        im_id=message.optional("im_id", message.text),
        parent=message.optional("parent", message.text),
        basis_id=message.opaque("basis_id"),
        config_id=message.opaque("config_id"),
        system=message.identifier("system"),
        created_ns=message.integer("created_ns"),
    )


def _alpha(message: Fields, key: str) -> dict[str, float]:
    alpha = message.named_numbers(key, PARAMETERS)
    message.child(key).number("magnification", above=0.0)
    return alpha


def encode_measured_manifest(manifest: MeasuredManifest) -> bytes:
    """Return the payload of an ``im`` commit.

    Raises
    ------
    WireError
        If the record breaks the contract.
    """
    data = _pack_with_layout(manifest)
    decode_measured_manifest(data)
    return data


def decode_measured_manifest(data: bytes) -> MeasuredManifest:
    """Return the manifest of a measured interaction matrix.

    Raises
    ------
    WireError
        If a key is missing or out of range, or the message is too long.
    """
    message = Fields.unpack(data, "the manifest of a measured matrix").of_this_version()
    layout = _layout(message, first_chunks=0)
    modes = message.integers("modes", high=AXIS_LIMIT)
    amplitude = message.numbers("amplitude_m", above=0.0)
    if len(amplitude) != len(modes) or (layout.n_chunks and len(modes) != layout.shape[1]):
        raise message.refusal(
            "amplitude_m", list(amplitude), f"one for each of {layout.shape[1]} measured modes"
        )
    return MeasuredManifest(
        id=message.identifier("id"),
        layout=layout,
        reason=None if layout.n_chunks else message.text("reason"),
        modes=modes,
        amplitude_m=amplitude,
        n_average=message.integer("n_average", 1),
        pattern=message.choice("pattern", Pattern),
        double_pass=message.flag("double_pass"),
        session=message.opaque("session"),
        basis_id=message.opaque("basis_id"),
        config_id=message.opaque("config_id"),
        system=message.identifier("system"),
        created_ns=message.integer("created_ns"),
    )


def _pack_with_layout(manifest: Manifest | MeasuredManifest) -> bytes:
    layout = manifest.layout
    return pack(
        manifest,
        omit=("layout",),
        shape=layout.shape,
        dtype=DTYPE,
        n_chunks=layout.n_chunks,
        chunk_bytes=layout.chunk_bytes,
        sha256=layout.sha256,
    )


def _layout(message: Fields, first_chunks: int) -> MatrixLayout:
    shape = message.integers("shape", high=AXIS_LIMIT)
    if len(shape) != 2 or 4 * shape[0] * shape[1] > MATRIX_LIMIT:
        raise message.refusal("shape", str(shape), f"two axes, at most {MATRIX_LIMIT} bytes")
    if message.get("dtype") != DTYPE:
        raise message.refusal("dtype", message.get("dtype"), repr(DTYPE))
    chunk_bytes = message.integer("chunk_bytes", 1, CHUNK_LIMIT)
    n_chunks = message.integer("n_chunks", first_chunks)
    expected = math.ceil(4 * shape[0] * shape[1] / chunk_bytes)
    if n_chunks and n_chunks != expected:
        raise message.refusal("n_chunks", n_chunks, f"{expected} for shape {shape}")
    return MatrixLayout(
        shape=(shape[0], shape[1]),
        n_chunks=n_chunks,
        chunk_bytes=chunk_bytes,
        sha256=message.sha256("sha256") if n_chunks else "",
    )
