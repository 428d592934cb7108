"""Compare the mean of the commands before and after a change of reference slopes.

A wrong offset looks perfect in the slopes, from which the RTC has subtracted it: only the commands
show it. Their mean over the turbulence changes by what the mirror holds in addition to the shape
before. What it holds, over the shape that was sent, is 1 where sign, scale and numbers are as sent.
Turbulence moves the mean as well: σ is taken from the scatter of blocks on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation.estimator import Change, FrameContext, Mark, Streaming

Array = NDArray[np.float64]

BLOCK_S = 0.5
"""Duration of a block, longer than the turbulence of all but the lowest modes remembers."""

BLOCKS_BEFORE = 40
"""Blocks with the references before; more would meet other drifts."""

BLOCKS_AFTER = 50
"""Blocks with the references after a change: a finding comes within 25 s or not at all."""

REPORT_BLOCKS = 5
"""Number of blocks between two findings."""

MAX_MODES = 300
"""Modes that are compared; shapes are smooth."""

SETTLING_S = 0.3
"""Time after the ramp within which the loop reaches the shape."""


class HeldRatio(NamedTuple):
    """Share of a shape that the mirror holds."""

    ratio: float
    """1 if it was applied as it was sent."""

    sigma: float
    """1 σ of it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeanCommands(Streaming):
    """Means of the commands with the references in use and with those before."""

    resets = Change.GONE | Change.SESSION | Change.RATE | Change.OPEN
    unless = Mark.STANDS | Mark.ABSURD
    only_closed = True

    name: str = ""
    """References of the last block; those of a ramp do not count."""

    before: tuple[str, tuple[Array, ...]] = ("", ())
    """References before, and means ``(n_modes,)`` of their blocks, metres, oldest first."""

    blocks: tuple[Array, ...] = ()
    """The same with the references in use."""

    total: Array | None = None
    """Sum of the block under way."""

    n_frames: int = 0
    """Frames in that sum; negative while the loop settles."""

    @override
    def update(self, frames: FrameContext) -> MeanCommands:
        block, rate_hz = frames.block, frames.rtc.frame_rate_hz
        name, now = block.reference_name or "", self
        if name.endswith("~"):
            return self
        if name != self.name:
            wait = -round(SETTLING_S * rate_hz)
            now = replace(self, name=name, before=(self.name, self.blocks), blocks=(), total=None)
            now = replace(now, n_frames=wait if self.name else 0)
        n_frames = now.n_frames + len(block.commands_m)
        if now.n_frames < 0:
            return replace(now, n_frames=min(n_frames, 0))
        total = block.commands_m[:, :MAX_MODES].sum(axis=0, dtype=np.float64)
        total = total if now.total is None else now.total + total
        if n_frames < BLOCK_S * rate_hz:
            return replace(now, total=total, n_frames=n_frames)
        kept = now.blocks[-max(BLOCKS_BEFORE, BLOCKS_AFTER) + 1 :]
        return replace(now, blocks=(*kept, total / n_frames), total=None, n_frames=0)

    @property
    def duration_s(self) -> float:
        """Duration of the telemetry that is compared, without the ramp."""
        return BLOCK_S * (len(self.before[1][-BLOCKS_BEFORE:]) + len(self.blocks))

    def is_due(self, earlier: MeanCommands) -> bool:
        """Return True if there is a new finding since an earlier state."""
        n_blocks = len(self.blocks)
        new = n_blocks != len(earlier.blocks) or self.name != earlier.name
        return new and bool(n_blocks) and not n_blocks % REPORT_BLOCKS and bool(self.before[1])

    def measure(self, shape_m: Array, shape_before_m: Array) -> HeldRatio | None:
        """Return how much of a shape ``(n_modes,)`` the mirror holds; None if unknown.

        It is taken to have held all of the shape before. So the change of the mean would be minus
        the sum of both shapes if the sign of the new one alone were turned.
        """
        after, before = np.array(self.blocks[:BLOCKS_AFTER]), np.array(self.before[1])
        if min(len(before), len(after)) < REPORT_BLOCKS or not shape_m[:MAX_MODES].any():
            return None
        n_modes = min(len(shape_m), after.shape[1])
        shape_m, shape_before_m = shape_m[:n_modes], shape_before_m[:n_modes]
        after, before = after[:, :n_modes], before[-BLOCKS_BEFORE:, :n_modes]
        apart = np.concatenate([part - part.mean(axis=0) for part in (before, after)])
        weights = shape_m / np.maximum(apart.var(axis=0), np.finfo(float).tiny)
        weights /= weights @ shape_m
        spread = apart @ weights
        # Blocks of the lowest modes are not independent: neighbours tell how much.
        memory = float(np.clip((spread[1:] @ spread[:-1]) / (spread @ spread), 0.0, 0.9))
        n_free = len(spread) - 2
        variance = spread @ spread / n_free * (1.0 + memory) / (1.0 - memory)
        sigma = np.sqrt(variance * (1.0 / len(before) + 1.0 / len(after)))
        held_m = after.mean(axis=0) - before.mean(axis=0) + shape_before_m
        ratio = float(held_m @ weights)
        return HeldRatio(ratio=ratio, sigma=float(sigma))
