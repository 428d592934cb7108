"""Detect slopes that stand still."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation.estimator import UNMARKED, Change, Detector, FrameContext, Mark
from service.estimation.frames import FrameBlock

STRIDE = 8
"""One of so many frames is compared with the last one compared."""

STANDS_S = 0.05
"""Telemetry that has not changed for so long is no measurement: photons and electrons always move
the last digits of hundreds of slopes."""

ALARM_S = 0.5
"""A camera that stands for less may only have skipped some frames."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Standstill(Detector):
    """The last slopes, and for how long they have been the same."""

    resets = Change.OPEN
    only_closed = True

    session: str = ""
    slopes: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    """``(n_slopes,)`` of the last frame looked at."""

    first_seq: int = 0
    """First frame looked at that has these."""

    since_ns_utc: int = 0
    """End of its exposure, the RTC's clock."""

    lasts_s: float = 0.0
    """Until the last frame looked at."""

    @override
    def update(self, frames: FrameContext) -> Standstill:
        """Return it after one more block."""
        return self.follow(frames.block)

    @property
    @override
    def marks(self) -> Mark:
        """Whether nothing can be measured with these slopes."""
        return Mark.STANDS if self.lasts_s >= STANDS_S else UNMARKED

    @property
    @override
    def conditions(self) -> tuple[str | None, ...]:
        """Text of the alarm: what stands still, since when, what to do; None: nothing."""
        if self.lasts_s < ALARM_S:
            return (None,)
        what = "are the same in every frame" if self.slopes.any() else "are all zero"
        since = datetime.fromtimestamp(self.since_ns_utc * 1e-9, UTC)
        text = (
            f"the slopes {what} since frame {self.first_seq}, {since:%H:%M:%S} UTC: the camera "
            "stands, or its images do not reach the RTC; open the loop, then see to the camera: "
            "the mirror is moved by what is no measurement"
        )
        return (text,)

    def follow(self, block: FrameBlock) -> Standstill:
        """Return it after one more block."""
        state = self
        for row in range(-block.first_seq % STRIDE, block.n_frames, STRIDE):
            slopes, t_ns = block.slopes[row], block.t0_ns_utc + row * block.dt_ns
            if state.session == block.session and np.array_equal(slopes, state.slopes):
                state = replace(state, lasts_s=(t_ns - state.since_ns_utc) * 1e-9)
                continue
            state = Standstill(
                session=block.session,
                slopes=slopes.copy(),
                first_seq=block.first_seq + row,
                since_ns_utc=t_ns,
            )
        return state
