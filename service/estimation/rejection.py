"""How well a closed loop rejects turbulence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation.estimator import Change, Detector, FrameContext, Mark
from service.estimation.frames import FrameBlock

Array = NDArray[np.float64]

MEMORY_S = 1.0

LEFT = 0.25
"""RMS of the residual, as the loop itself reads it, over that of its commands: less in a loop that
holds well. One of the small telescope has 0.04 to 0.08; 0.48 where it is 0.9 subapertures off."""

LEFT_IN_MEDIAN = 0.35
"""The same of the median mode: 0.2 against 0.47 there."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rejection(Detector):
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
        rtc, in_loop = frames.rtc, frames.loop.in_loop
        return self.follow(frames.block, in_loop, np.array(rtc.gains)[in_loop], rtc.leak)

    def follow(
        self, block: FrameBlock, in_loop: NDArray[np.intp], gains: Array, leak: float
    ) -> Rejection:
        """Return it after one more block of a loop of these modes with these gains."""
        own = block.without_dither().commands_m[:, in_loop].astype(float)
        if len(own) < 2:
            return self
        residual = np.square((leak * own[:-1] - own[1:]) / gains).sum(axis=0)
        commanded, lasts_s = np.square(own[1:]).sum(axis=0), block.n_frames * block.dt_ns * 1e-9
        if self.residual is None or self.commanded is None or len(self.residual) != len(residual):
            return Rejection(lasts_s=lasts_s, residual=residual, commanded=commanded)
        fade = float(np.exp(-lasts_s / MEMORY_S))
        return Rejection(
            lasts_s=self.lasts_s + lasts_s,
            residual=fade * self.residual + residual,
            commanded=fade * self.commanded + commanded,
        )

    @property
    def holds(self) -> bool | None:
        """Whether the loop holds well; None: too little telemetry."""
        if self.residual is None or self.commanded is None or self.lasts_s < MEMORY_S:
            return None
        commanded = np.maximum(self.commanded, 1e-40)
        left = float(np.sqrt(self.residual.sum() / commanded.sum()))
        median = float(np.sqrt(np.median(self.residual / commanded)))
        return left < LEFT and median < LEFT_IN_MEDIAN
