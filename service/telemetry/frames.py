"""Telemetry frames as the estimators see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameBlock:
    """Frames of one session, contiguous in sequence and recorded under one reconstructor.

    Row k holds the slopes and the command that was on the mirror during the exposure that made
    them: there is no lag between the columns.
    """

    session: str
    """The RTC's session: its sequence numbers mean nothing outside it."""

    first_seq: int
    """Sequence number of row 0; row i is ``first_seq + i``."""

    t0_ns_utc: int
    """End of exposure of row 0, nanoseconds since the Unix epoch, UTC."""

    dt_ns: int
    """Frame period, nanoseconds."""

    slopes: NDArray[np.float32]
    """``(n_frames, n_slopes)``, in the order and sign of conventions (Sx then Sy)."""

    commands_m: NDArray[np.float32]
    """``(n_frames, n_modes)``: total modal command on the mirror, dither included, metres OPD."""

    dither_m: NDArray[np.float32] | None
    """``(n_frames, n_modes)``: the dither's share of the command, metres OPD; None: no dither."""

    cm_id: str | None
    """The reconstructor that multiplied these slopes; None when the RTC does not know."""

    @property
    def n_frames(self) -> int:
        """Number of rows."""
        return int(self.slopes.shape[0])
