"""Has the outer ring of the mirror slipped? Watched on the commands.

A segment at the edge of the pupil can slip by wavelengths and stay there: the sensor sees little
light across it, its slopes look healthy, and only the command shows the step. On the diffractive
telescope the slowly averaged position of the outermost actuators stays below 2.2 times what
turbulence asks of them in every loop that held. A slip takes it to 7 to 18, or leaves it at 3 for
seconds while the wavefront is lost already (docs/results/edge_slip.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.telemetry.frames import FrameBlock

Array = NDArray[Any]

SLIPPED_RATIO = 4.5
"""Averaged position of an outer actuator, in σ of turbulence, that no healthy loop shows."""

SUSPECT_RATIO = 2.5
"""What no healthy loop shows for longer than ``SUSPECT_FOR_S``; below it, a ring that had slipped
is back."""

SUSPECT_FOR_S = 0.5

LOW_MODES = 30
"""Left out: tip, tilt and their like move the whole mirror by more than any slip."""

LOOK_FRAMES = 50
"""One of so many frames is looked at, however long a block is."""

_MEMORY_S = 0.25
"""Turbulence of higher modes has forgotten itself after this; a slip has not."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Actuators:
    """Where the actuators are, and how far each mode moves them."""

    positions: NDArray[np.float64]
    """``(n_actuators, 2)`` in any unit."""

    strokes: NDArray[np.float64]
    """``(n_actuators, n_modes)`` position for a unit command of each mode."""

    @property
    def outer(self) -> NDArray[np.bool_]:
        """``(n_actuators,)`` within 4 % of the largest radius: one ring of FLAO's fourteen."""
        radius = np.hypot(*self.positions.T)
        return np.asarray(radius > 0.96 * radius.max())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeWatch:
    """Where the actuators of one mirror stand for a modal command, in σ of turbulence."""

    outer: NDArray[np.float32]
    """``(n_outer, n_modes)`` of the outermost ring; zero for modes left out."""

    inner: NDArray[np.float32]
    """``(n_inner, n_modes)`` of all others: they tell how strong the turbulence is tonight."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeHealth:
    """Forgetting means of what the two parts of the mirror do."""

    position: NDArray[np.float32] | None = None
    """``(n_outer,)`` averaged position, in σ of the turbulence the basis was made for."""

    turbulence: float = 1.0
    """RMS of the inner actuators in the same unit."""

    ratio: float = 0.0
    """Largest averaged position of an outer actuator over ``turbulence``."""

    suspect_s: float = 0.0
    """For how long the ratio has been above ``SUSPECT_RATIO``."""

    slipped: bool = False


def edge_watch(
    actuators: Actuators, mode_variance_m2: NDArray[np.float64], in_loop: NDArray[np.intp]
) -> EdgeWatch | None:
    """Return what to watch in a loop of these modes; None when they are too few to say.

    The same when nothing is known of the turbulence in the modes.
    """
    used, high = np.zeros(len(mode_variance_m2)), in_loop[in_loop >= LOW_MODES]
    used[high] = 1.0
    expected = np.sqrt(actuators.strokes**2 @ (used * mode_variance_m2))
    if len(high) <= LOW_MODES or expected.min() <= 0.0:
        return None
    shapes = (actuators.strokes * used / expected[:, None]).astype(np.float32)
    outer = actuators.outer
    return EdgeWatch(outer=shapes[outer], inner=shapes[~outer])


def observe_edge(health: EdgeHealth, block: FrameBlock, watch: EdgeWatch) -> EdgeHealth:
    """Return the health after one more block, of which a frame now and then is looked at."""
    start = 0
    while start < block.n_frames:
        stop = min(start + LOOK_FRAMES, block.n_frames)
        lasted_s = (stop - start) * block.dt_ns * 1e-9
        health = _seen(health, block.commands_m[stop - 1], lasted_s, watch)
        start = stop
    return health


def _seen(
    health: EdgeHealth, command: NDArray[np.float32], lasted_s: float, watch: EdgeWatch
) -> EdgeHealth:
    """Return the health after a command that stands for so much time."""
    outer, inner = watch.outer @ command, watch.inner @ command
    fade = float(np.exp(-lasted_s / _MEMORY_S))
    position = (1.0 - fade) * outer
    if health.position is not None:
        position += fade * health.position
    power = fade * health.turbulence**2 + (1.0 - fade) * float(np.mean(inner**2))
    turbulence = float(np.sqrt(power))
    ratio = float(np.abs(position).max()) / max(turbulence, 1e-3)
    suspect_s = health.suspect_s + lasted_s if ratio > SUSPECT_RATIO else 0.0
    slipped = ratio > SLIPPED_RATIO or suspect_s > SUSPECT_FOR_S
    return EdgeHealth(
        position=position,
        turbulence=turbulence,
        ratio=ratio,
        suspect_s=suspect_s,
        slipped=slipped or (health.slipped and suspect_s > 0.0),
    )
