"""Is the loop holding? Watched on the commands of the highest controlled modes.

A mis-registered loop goes unstable in its highest modes first, while slopes and wavefront error
look healthy almost to the end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.telemetry.frames import FrameBlock

DIVERGING_RATIO = 10.0
"""Times the expected turbulence that the upper half of the controlled modes may reach."""

CALM_RATIO = 5.0
"""Below this a loop that was diverging counts as holding again."""

ABSURD_RATIO = 1e4
"""Times the expected turbulence that no mirror reaches: commands are in another unit."""

_DECADES = {9: "nanometres", 6: "micrometres"}

_MEMORY_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopHealth:
    """Forgetting mean of how far the high modes are beyond what turbulence asks of them."""

    ratio: float = 0.0
    """RMS of the command in the upper half of the controlled modes over its expectation."""

    diverging: bool = False
    absurd: bool = False
    """Whether commands are beyond any mirror and came there at once, as no loop does."""

    @property
    def unit(self) -> str:
        """What the unit of absurd commands looks like."""
        decades = np.log10(max(self.ratio, 1.0))
        nearest = min(_DECADES, key=lambda decade: abs(decade - decades))
        if abs(nearest - decades) > 2.0:
            return "they are in another unit than metres of OPD, or decoded wrongly"
        return f"they look like {_DECADES[nearest]}, metres of OPD are expected"


def observe(
    health: LoopHealth,
    block: FrameBlock,
    mode_variance_m2: NDArray[np.float64],
    in_loop: NDArray[np.intp],
) -> LoopHealth:
    """Return the health of a loop of these modes after one more block; open, it is well."""
    if not len(in_loop):
        return LoopHealth()
    upper = in_loop[len(in_loop) // 2 :]
    commands = block.commands_m[:, upper]
    expected = float(mode_variance_m2[upper].sum())
    if expected <= 0.0:
        return health
    levels = np.sqrt(np.sum(commands.astype(np.float64) ** 2, axis=1) / expected)
    absurd = _absurd(health, levels)
    if absurd != health.absurd:
        health = LoopHealth(ratio=float(np.sqrt(np.mean(levels**2))))
    fade = float(np.exp(-block.n_frames * block.dt_ns * 1e-9 / _MEMORY_S))
    ratio = float(np.sqrt(fade * health.ratio**2 + (1.0 - fade) * np.mean(levels**2)))
    limit = CALM_RATIO if health.diverging else DIVERGING_RATIO
    return LoopHealth(ratio=ratio, diverging=not absurd and ratio > limit, absurd=absurd)


def _absurd(health: LoopHealth, levels: NDArray[np.float64]) -> bool:
    """Return whether the frames are in another unit: one that runs away passes what is possible."""
    beyond = levels > ABSURD_RATIO
    if health.absurd or not beyond.any():
        return health.absurd and bool(beyond[-1])
    before = levels[: int(np.argmax(beyond))]
    return not health.diverging and not bool((before > DIVERGING_RATIO).any())
