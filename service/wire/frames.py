"""Batches of frames: a msgpack attachment and raw float32 rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from service.errors import WireError
from service.wire.codec import Id, Opaque, decode, encode, integer, travels, unpack

BATCH_LIMIT: Final = 4_000_000
"""Bytes: a longer payload is refused unread."""

ATTACHMENT_LIMIT: Final = 4096
"""Bytes: a longer attachment is refused unread."""

FRAMES_PER_BATCH: Final = 50
"""Most frames in one batch."""

COLUMN_LIMIT: Final = BATCH_LIMIT // 4


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameHeader:
    """Description of a batch's rows."""

    session: Opaque
    """New when the RTC starts, or its sequence or integrator starts over."""

    seq0: Annotated[int, integer(high=2**62)]
    """Sequence number of row 0; row i is ``seq0 + i``."""

    n: Annotated[int, integer(1, FRAMES_PER_BATCH)]
    """Rows, 1..50."""

    t0_ns: Annotated[int, integer(high=2**62)]
    """End of exposure of row 0, nanoseconds since the Unix epoch, UTC."""

    dt_ns: Annotated[int, integer(1, 10**12)]
    """Nominal frame period, nanoseconds."""

    n_slopes: Annotated[int, integer(1, COLUMN_LIMIT)]
    """Slopes of a row."""

    n_modes: Annotated[int, integer(1, COLUMN_LIMIT)]
    """Commands of a row: the whole basis, controlled or not."""

    dither: bool
    """Whether each row ends with the dither's share of its commands."""

    cm_id: Id | None
    """The reconstructor that multiplies these slopes; None when the RTC does not know."""

    basis_id: Opaque
    """Of the modal basis; changes with modes, order and scale."""

    config_id: Opaque
    """Of the sensor; changes with mask, slope recipe, reference slopes, binning, modulation."""

    @property
    def n_columns(self) -> int:
        """Floats of a row: slopes, commands and, if there, the dither."""
        return self.n_slopes + self.n_modes * (2 if self.dither else 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameBatch:
    """Consecutive frames as they travel.

    Row k holds the slopes and the command that was on the mirror during the exposure that made
    them; the arrays are read-only views of the received bytes.
    """

    header: FrameHeader
    """What the rows mean."""

    rows: NDArray[np.float32]
    """``(n, n_columns)``: slopes | commands | dither, if there."""

    @property
    def slopes(self) -> NDArray[np.float32]:
        """``(n, n_slopes)``, in the RTC's own order and sign."""
        return self.rows[:, : self.header.n_slopes]

    @property
    def commands_m(self) -> NDArray[np.float32]:
        """``(n, n_modes)``: total modal command, dither included, metres OPD."""
        return self.rows[:, self.header.n_slopes : self.header.n_slopes + self.header.n_modes]

    @property
    def dither_m(self) -> NDArray[np.float32] | None:
        """``(n, n_modes)``: the dither's share, metres OPD; None without dither."""
        if not self.header.dither:
            return None
        return self.rows[:, self.header.n_slopes + self.header.n_modes :]


def encode_frames(header: FrameHeader, rows: NDArray[np.float32]) -> tuple[bytes, bytes]:
    """Return payload and attachment of one batch.

    Parameters
    ----------
    header
        What the rows mean.
    rows
        ``(n, n_columns)``: slopes | commands in metres | the dither's share if ``header.dither``.

    Raises
    ------
    WireError
        If the rows are not what the header says, or the batch is longer than the limit.
    """
    if rows.shape != (header.n, header.n_columns):
        raise WireError(
            f"range: frame rows have shape {rows.shape}, expected {(header.n, header.n_columns)}"
        )
    payload = np.ascontiguousarray(rows, dtype="<f4").tobytes()
    attachment = encode(header)
    _check_sizes(payload, header)
    return payload, attachment


def decode_frames(payload: bytes, attachment: bytes | None) -> FrameBatch:
    """Return the batch; its rows are a view of ``payload``, nothing is copied.

    The values are not looked at: a frame with a NaN costs one frame, not its batch.

    Raises
    ------
    WireError
        If attachment or payload break the contract or do not fit together.
    """
    if attachment is None:
        raise WireError("missing: attachment of a frame batch")
    if len(payload) > BATCH_LIMIT:
        raise WireError(
            f"range: a frame batch has {len(payload)} bytes, expected at most {BATCH_LIMIT}"
        )
    header = decode(FrameHeader, attachment)
    _check_sizes(payload, header)
    rows = np.frombuffer(payload, dtype="<f4").reshape(header.n, header.n_columns)
    return FrameBatch(header=header, rows=rows)


travels(
    FrameHeader,
    "the attachment of a frame batch",
    opened=lambda data, where: unpack(data, where, ATTACHMENT_LIMIT),
)


def _check_sizes(payload: bytes, header: FrameHeader) -> None:
    expected = 4 * header.n * header.n_columns
    if len(payload) != expected or expected > BATCH_LIMIT:
        raise WireError(
            f"range: a frame batch has {len(payload)} bytes, expected {expected} for {header.n} "
            f"rows of {header.n_columns} float32, at most {BATCH_LIMIT}"
        )
