"""Is the loop holding? Watched on the commands of the highest controlled modes.

A mis-registered loop goes unstable in its highest modes first, while slopes and wavefront error
look healthy almost to the end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.estimation.frames import FrameBlock

DIVERGING_RATIO = 10.0
"""Times the expected turbulence that the upper half of the controlled modes may reach."""

CALM_RATIO = 5.0
"""Below this a loop that was diverging counts as holding again."""

_MEMORY_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopHealth:
    """Forgetting mean of how far the high modes are beyond what turbulence asks of them."""

    ratio: float = 0.0
    """RMS of the command in the upper half of the controlled modes over its expectation."""

    diverging: bool = False


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
    power = float(np.mean(np.sum(commands.astype(np.float64) ** 2, axis=1)))
    expected = float(mode_variance_m2[upper].sum())
    if expected <= 0.0:
        return health
    fade = float(np.exp(-block.n_frames * block.dt_ns * 1e-9 / _MEMORY_S))
    ratio = float(np.sqrt(fade * health.ratio**2 + (1.0 - fade) * power / expected))
    limit = CALM_RATIO if health.diverging else DIVERGING_RATIO
    return replace(health, ratio=ratio, diverging=ratio > limit)
