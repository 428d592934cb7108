"""Telemetry as estimators take it: contiguous frames of one session, matrix and references."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameBlock:
    """Frames of one session, contiguous, of one reconstructor and one set of reference slopes.

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

    reference_name: str | None = None
    """Name of the reference slopes subtracted from these slopes; None if unknown."""

    @property
    def n_frames(self) -> int:
        """Number of rows."""
        return len(self.slopes)

    @property
    def next_seq(self) -> int:
        """Sequence number of the frame after the last row."""
        return self.first_seq + self.n_frames

    @property
    def next_t_ns(self) -> int:
        """End of exposure of the frame after the last row."""
        return self.t0_ns_utc + self.n_frames * self.dt_ns

    @property
    def is_dithered(self) -> bool:
        """Return True if a dither moves any mode; an RTC may send the columns without one."""
        dither = self.dither_m
        # The last row first: it answers at once in most dithered blocks, without a search through
        # all.
        return dither is not None and bool(dither[-1:].any() or dither.any())

    def rows(self, start: int, stop: int) -> FrameBlock:
        """Return these rows as a block: a view."""
        some = slice(start, stop)
        return FrameBlock(  # many a time for every block: replace() takes twice as long
            session=self.session,
            first_seq=self.first_seq + start,
            t0_ns_utc=self.t0_ns_utc + start * self.dt_ns,
            dt_ns=self.dt_ns,
            slopes=self.slopes[some],
            commands_m=self.commands_m[some],
            dither_m=None if self.dither_m is None else self.dither_m[some],
            cm_id=self.cm_id,
            reference_name=self.reference_name,
        )

    def last(self, n: int) -> FrameBlock:
        """Return the last ``n`` rows, copied: a view would keep the whole block."""
        view = self.rows(max(self.n_frames - n, 0), self.n_frames)
        return replace(
            view,
            slopes=view.slopes.copy(),
            commands_m=view.commands_m.copy(),
            dither_m=None if view.dither_m is None else view.dither_m.copy(),
        )

    def without_dither(self) -> FrameBlock:
        """Return the same frames with the integrator's own commands."""
        if self.dither_m is None:
            return self
        return replace(self, commands_m=self.commands_m - self.dither_m, dither_m=None)

    def follows(self, before: FrameBlock) -> bool:
        """Return whether this block goes on where another ends, with the same reference slopes."""
        # Sequence numbers mean nothing outside of their session, nor do differences of slopes whose
        # zero points differ.
        return (self.session, self.dt_ns, self.first_seq, self.reference_name) == (
            before.session,
            before.dt_ns,
            before.next_seq,
            before.reference_name,
        )


def join_frames(blocks: tuple[FrameBlock, ...]) -> FrameBlock:
    """Return blocks of which each follows the one before as one.

    Without dither columns where one of them has none.
    """
    if len(blocks) == 1:
        return blocks[0]
    dither = [block.dither_m for block in blocks if block.dither_m is not None]
    return replace(
        blocks[0],
        slopes=np.concatenate([block.slopes for block in blocks]),
        commands_m=np.concatenate([block.commands_m for block in blocks]),
        dither_m=np.concatenate(dither) if len(dither) == len(blocks) else None,
    )
