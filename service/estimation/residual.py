"""Measure the turbulence that a closed loop leaves.

**Residual with seeing taken out.** A reference matrix measures the residual from the slopes,
whichever matrix closes the loop. After the command is subtracted, the result is the turbulence
itself; its motion in a few hundredths of a second measures how demanding it is at present. Both are
compared mode by mode.

A loop brings to zero what its own matrix measures, modes beyond the controlled ones included, so
each matrix finds its own loop better. Both matrices therefore measure both loops, and the agreement
of the two counts.

**Rejection.** The residual as the loop itself measures it, divided by its commands, shows if the
loop holds well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation.estimator import Change, FrameContext, Mark, Streaming
from service.estimation.frames import FrameBlock

Array = NDArray[np.float64]

SAMPLE_S = 0.008
"""Time between two frames that are sampled: turbulence moves little in it, at any frame rate."""

LAG_SAMPLES = 4
"""Samples between two positions of the turbulence whose difference counts."""

KEPT_STRIDE_SAMPLES = 4
"""One of so many samples is kept, for a matrix to come to read."""

CALM_SHARE = 0.7
"""Share of the groups before that make the reference. The others may be a gust, which would hide in
the reference how far the turbulence usually moves."""

N_LOST_PARTS = 3
"""Parts in which a loop is checked for being lost."""

LOST_POWER_RATIO = 9.0
"""Residual power over that before which a lost loop exceeds at least: a gust makes it 2.6. The
power of all commands alone says nothing: tip and tilt wander, and a healthy mirror may move ten
times as much as in the seconds before."""

RUNAWAY_POWER_RATIO = 6.25
"""Power of the commands of the upper half of the modes, over that before, which only a loop that
is lost exceeds in each of ``N_LOST_PARTS`` parts: seeing that doubles makes it 3.2, a gust 2.6."""


def runs_away(powers_m2: Sequence[float], usual_m2: float) -> bool:
    """Return True if the commands have become far larger than they were, and stay so.

    ``powers_m2`` are the powers of the upper half of the modes in consecutive parts, oldest first,
    and ``usual_m2`` is that before. A pyramid that saturates measures a small residual in a lost
    loop, so that its commands alone show the loss. Those of the lower half, tip and tilt above all,
    wander far in a healthy loop and do not count.
    """
    last = powers_m2[-N_LOST_PARTS:]
    limit = RUNAWAY_POWER_RATIO * usual_m2
    return len(last) == N_LOST_PARTS and all(power > limit for power in last)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Residual:
    """Sums over some frames, ``(n_modes,)`` of squares in metres²."""

    n_seen: int
    seen: Array
    """Power of the residual."""

    n_moved: int
    moved: Array
    """Power of the turbulence's motion between samples."""

    commanded: Array
    """Power of the command, over the samples of ``seen``."""

    own: Array | None = None
    """Power of the residual as the loop's own matrix measures it; None if that is the reference
    matrix, or its numbers are unknown."""

    kept: tuple[NDArray[np.float32], ...] = ()
    """``(n, n_slopes)`` each: some of the samples themselves."""

    def plus(self, other: Residual | None) -> Residual:
        """Return the sums over both."""
        if other is None or len(other.seen) != len(self.seen):
            return self
        own = None
        if self.own is not None and other.own is not None and len(self.own) == len(other.own):
            own = self.own + other.own
        names = ("n_seen", "seen", "n_moved", "moved", "commanded", "kept")
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return replace(self, **sums, own=own)

    def read_by(self, matrix: NDArray[np.float32] | None) -> Residual:
        """Return the sums with ``own`` as this matrix reads the samples that were kept."""
        n_kept = sum(map(len, self.kept))
        if matrix is None or not n_kept:
            return replace(self, own=None)
        squares = [_squares(some @ matrix.T) for some in self.kept]
        return replace(self, own=np.sum(squares, axis=0) * (self.n_seen / n_kept))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reader:
    """The matrix that reads the residual, and where it saw the turbulence last."""

    matrix: NDArray[np.float32]
    """``(n_modes, n_slopes)``."""

    seq: NDArray[np.int64]
    """``(n,)`` of the last samples, ``LAG_SAMPLES`` at most."""

    turbulence_m: NDArray[np.float32]
    """``(n, n_modes)`` where it was then."""

    @classmethod
    def of(cls, matrix: NDArray[np.float32]) -> Reader:
        """Return one that has seen nothing yet."""
        none = np.zeros((0, len(matrix)), np.float32)
        return cls(matrix=matrix, seq=np.zeros(0, np.int64), turbulence_m=none)

    def read(
        self, block: FrameBlock, own: NDArray[np.float32] | None = None
    ) -> tuple[Reader, Residual | None]:
        """Return the residual in a block; None: it uses none of its frames.

        ``own`` is the matrix ``(n_modes, n_slopes)`` that closes the loop, if it is another one.
        """
        stride = stride_frames(block.dt_ns)
        rows = np.arange(-block.first_seq % stride, block.n_frames, stride)
        if not len(rows):
            return self, None
        n_modes = len(self.matrix)
        residual = block.slopes[rows] @ self.matrix.T
        commands = block.commands_m[rows, :n_modes]
        seq = np.concatenate([self.seq, block.first_seq + rows])
        # The residual is the turbulence plus the command, which counteracts it.
        turbulence = np.concatenate([self.turbulence_m, residual - commands])
        moved = turbulence[LAG_SAMPLES:] - turbulence[:-LAG_SAMPLES]
        # Pairs across a gap of frames are further apart in time and would show too much motion.
        moved = moved[seq[LAG_SAMPLES:] - seq[:-LAG_SAMPLES] == LAG_SAMPLES * stride]
        kept = (block.first_seq + rows) % (KEPT_STRIDE_SAMPLES * stride) == 0
        sums = Residual(
            n_seen=len(rows),
            seen=_squares(residual),
            n_moved=len(moved),
            moved=_squares(moved),
            commanded=_squares(commands),
            own=None if own is None else _squares(block.slopes[rows] @ own.T),
            # Slopes are kept only before a swap, for the matrix to come; after it that matrix reads
            # them here.
            kept=(block.slopes[rows[kept]],) if own is None and kept.any() else (),
        )
        return replace(self, seq=seq[-LAG_SAMPLES:], turbulence_m=turbulence[-LAG_SAMPLES:]), sums


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualLevel:
    """The residual of a trusted loop, as the reference for another one."""

    total: Residual
    """Sums over the calmer of the last groups with that loop."""

    log_ratios: Array
    """``(n_groups,)`` logarithm of each group's residual power over ``total``, seeing taken out,
    oldest first; groups older than ``total`` are included, to measure the noise."""

    n_recent: int
    """Groups at the end of ``log_ratios`` that the loop is compared with: their median."""

    @classmethod
    def of(cls, groups: tuple[Residual, ...], n_recent: int) -> ResidualLevel | None:
        """Return the level of these, oldest first; None if there are none."""
        known = tuple(group for group in groups if group.n_moved)
        recent = known[-n_recent:]
        by_power = sorted(recent, key=lambda group: float(group.seen.sum()) / group.n_seen)
        if not by_power:
            return None
        calm = by_power[: max(round(CALM_SHARE * len(recent)), 1)]
        total = reduce(lambda sums, group: group.plus(sums), calm)
        modes, plain = np.arange(len(total.seen)), replace(total, own=None)
        # those with another number of modes were read by another matrix
        logs = [log_ratio(plain, one, modes) for one in known if len(one.seen) == len(total.seen)]
        return cls(total=total, log_ratios=np.array(logs), n_recent=len(recent))

    def read_by(self, matrix: NDArray[np.float32] | None) -> ResidualLevel:
        """Return the level with ``own`` as this matrix reads it."""
        return replace(self, total=self.total.read_by(matrix))

    def log_ratios_of(self, parts: tuple[Residual, ...], modes: NDArray[np.intp]) -> Array:
        """Return each part's residual power over the median of those before, as a logarithm."""
        usual = float(np.median(self.log_ratios[-self.n_recent :]))
        known = modes[modes < len(self.total.seen)]
        logs = [log_ratio(self.total, part, known) for part in parts if part.n_seen]
        return np.array(logs) - usual

    def _upper_powers(self, parts: tuple[Residual, ...]) -> tuple[list[float], float]:
        """Return the power of the commands of the upper half of the modes: parts, and before."""
        usual = self.total.commanded / self.total.n_seen
        upper = np.flatnonzero(usual > 0.0)
        upper = upper[len(upper) // 2 :]
        # Parts of another number of modes have another upper half, so that nothing can be compared.
        comparable = [p for p in parts if len(p.commanded) == len(usual) and p.n_seen]
        if len(comparable) < len(parts) or not len(upper):
            return [], 0.0
        return (
            [float(p.commanded[upper].sum()) / p.n_seen for p in parts],
            float(usual[upper].sum()),
        )

    def lost(self, parts: tuple[Residual, ...]) -> bool:
        """Return True if the loop no longer corrects.

        Its residual is far larger than before in each of the last parts, and either as large as
        the turbulence that the mirror followed then, or the mirror itself moves by far more. Where
        the sensor saturates, its commands run away (``runs_away``). The mean of the parts would not
        do: turbulence that changes within a frame fills one part with what the loop then corrects.
        """
        parts = parts[-N_LOST_PARTS:]
        if runs_away(*self._upper_powers(parts)):
            return True
        if len(parts) < N_LOST_PARTS or not all(part.n_seen for part in parts):
            return False
        followed = self.total.commanded.sum() / self.total.n_seen
        before = self.total.seen.sum() / self.total.n_seen
        left = min(part.seen.sum() / part.n_seen for part in parts)
        n_seen = sum(part.n_seen for part in parts)
        moves = sum(part.commanded.sum() for part in parts) / n_seen
        far_larger = left > LOST_POWER_RATIO * before
        return bool(far_larger and (left > followed or moves > 10.0 * followed))


def stride_frames(dt_ns: int) -> int:
    """Return the number of frames between two samples."""
    return max(round(SAMPLE_S * 1e9 / dt_ns), 1)


def log_ratio(before: Residual, after: Residual, modes: NDArray[np.intp]) -> float:
    """Return the logarithm of ``ratio``, finite."""
    return float(np.log(max(ratio(before, after, modes), 1e-30)))


def ratio(before: Residual, after: Residual, modes: NDArray[np.intp]) -> float:
    """Return the residual's power in these modes relative to that before, seeing taken out.

    If the matrix that closes the loop has measured both, the geometric mean of both measurements is
    returned. The motion of the turbulence is measured wrongly in a mode that diverges, so no mode
    is corrected by more than twice the median mode's factor.
    """
    if not len(modes) or not after.n_seen:
        return 1.0
    was, now = (r.seen[modes] / r.n_seen for r in (before, after))
    harder = np.ones(len(modes))
    if before.n_moved and after.n_moved:
        moved, moves = (r.moved[modes] / r.n_moved for r in (before, after))
        harder = np.where(moved > 0.0, moves / np.where(moved > 0.0, moved, 1.0), 1.0)
        common = float(np.median(harder))
        # half its own, for that scatters; noise does not become less with the seeing
        harder = np.clip(np.sqrt(harder * common), 1.0, max(2.0 * common, 1.0))
    believed = _over(now / harder, was)
    own = [r.own / r.n_seen for r in (before, after) if r.own is not None]
    if len(own) < 2 or len(own[0]) != len(own[1]) or modes.max() >= len(own[0]):
        return believed
    return float(np.sqrt(believed * _over(own[1][modes] / harder, own[0][modes])))


def _over(now: Array, was: Array) -> float:
    total = float(was.sum())
    return float(now.sum() / total) if total > 0.0 else 1.0


def _squares(rows: NDArray[np.float32]) -> Array:
    return np.asarray(np.einsum("km,km->m", rows, rows), np.float64)


RESIDUAL_MEMORY_S = 1.0

MAX_RESIDUAL_RATIO = 0.25
"""RMS of the residual, as the loop itself reads it, over that of its commands: less in a loop that
holds well. One of the small telescope has 0.04 to 0.08; 0.48 where it is 0.9 subapertures off."""

MAX_MEDIAN_RESIDUAL_RATIO = 0.35
"""The same of the median mode: 0.2 against 0.47 there."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rejection(Streaming):
    """Forgetting sums over frames of one loop."""

    resets = Change.OPEN
    unless = Mark.STANDS
    only_closed = True

    lasts_s: float = 0.0
    """Telemetry that has entered."""

    residual: Array | None = None
    """``(n_modes,)`` squares of the residual; None: nothing has come."""

    commanded: Array | None = None
    """``(n_modes,)`` of the commands."""

    @override
    def update(self, frames: FrameContext) -> Rejection:
        """Return it after one more block."""
        block, rtc, in_loop = frames.block, frames.rtc, frames.loop.in_loop
        own = block.without_dither().commands_m[:, in_loop].astype(float)
        if len(own) < 2:
            return self
        # The loop law solved for R s: the residual follows from the commands alone, whatever matrix
        # is in use. The delay only shifts it in time.
        gains = np.array(rtc.gains)[in_loop]
        residual = np.square((rtc.leak * own[:-1] - own[1:]) / gains).sum(axis=0)
        commanded, lasts_s = np.square(own[1:]).sum(axis=0), block.n_frames * block.dt_ns * 1e-9
        if self.residual is None or self.commanded is None or len(self.residual) != len(residual):
            return Rejection(lasts_s=lasts_s, residual=residual, commanded=commanded)
        fade = float(np.exp(-lasts_s / RESIDUAL_MEMORY_S))
        return Rejection(
            lasts_s=self.lasts_s + lasts_s,
            residual=fade * self.residual + residual,
            commanded=fade * self.commanded + commanded,
        )

    @property
    def holds(self) -> bool | None:
        """Return True if the loop holds well; None if there is too little telemetry."""
        if self.residual is None or self.commanded is None or self.lasts_s < RESIDUAL_MEMORY_S:
            return None
        # A mode that never moved would divide by zero.
        commanded = np.maximum(self.commanded, 1e-40)
        left = float(np.sqrt(self.residual.sum() / commanded.sum()))
        median = float(np.sqrt(np.median(self.residual / commanded)))
        return left < MAX_RESIDUAL_RATIO and median < MAX_MEDIAN_RESIDUAL_RATIO
