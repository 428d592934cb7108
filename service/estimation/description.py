"""The model's view of the telescope: modes, actuators, ring."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.model.kinds import SignalKind
from service.model.misregistration import Misregistration

LOW_MODES = 30
"""Left out: tip, tilt and their like move the whole mirror by more than any slip."""


EDGE_MEMORY_S, EDGE_MEMORY_OF_M = 0.25, 8.22
"""Averaging time in seconds on a pupil of this diameter in metres, longer than the correlation time
of turbulence in the higher modes and shorter than a slip. It grows with the diameter, as the time
in which the wind crosses a mode."""

MIN_LEFT_OUT_MODES = 5
LEFT_OUT_SHARE = 0.1
"""Number and share of the lowest modes of the loop that are left out where every actuator is
watched (tip, tilt and others that wander far); the larger of both applies."""

MIN_ACTUATOR_MODES = 20
"""Smallest number of modes that remain; fewer do not separate an actuator from its neighbours."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Actuators:
    """Positions of the actuators, and the amplitude of each in each mode."""

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
class Description:
    """Parameters of the model that telemetry is checked against."""

    n_slopes: int
    n_modes: int
    mode_variance_m2: NDArray[np.float64]
    """``(n_modes,)`` expected variance of each mode under the instrument's turbulence."""

    actuators: Actuators | None = None
    """None if the modes are measured surfaces whose actuators are unknown."""

    mode_information: NDArray[np.float64] | None = None
    """``(n_modes, 4, 4)`` information on α in a dither of each mode; None if not computed."""

    products: NDArray[np.float32] | None = None
    """``(n_modes, n_modes)`` DᵀD at ``start``, slope² per metre²; None: not worked out."""

    kind: SignalKind = SignalKind.XY
    """What the signals are."""

    diameter_m: float = EDGE_MEMORY_OF_M
    """Diameter of the pupil, metres."""

    start: Misregistration = field(default_factory=Misregistration)
    """Start of a fit while α is unknown: the mirror's nominal rotation."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeWatch:
    """Positions of one mirror's actuators for a modal command, in σ of turbulence."""

    modes: NDArray[np.intp]
    """``(n_watched,)`` those of the loop that are not left out."""

    outer: NDArray[np.float32]
    """``(n_outer, n_watched)`` of the outermost ring."""

    inner: NDArray[np.float32]
    """``(n_watched, n_watched)`` mean products of all other actuators: a quadratic form of the
    command that gives their mean square, a measure of the present turbulence."""

    memory_s: float = EDGE_MEMORY_S
    """Over which positions are averaged."""


def edge_watch(
    actuators: Actuators,
    mode_variance_m2: NDArray[np.float64],
    in_loop: NDArray[np.intp],
    diameter_m: float = EDGE_MEMORY_OF_M,
) -> EdgeWatch | None:
    """Return what to watch in a loop of these modes; None if they are too few.

    The same when nothing is known of the turbulence in the modes.
    """
    high, outer = in_loop[in_loop >= LOW_MODES], actuators.outer
    shapes = _shapes_in_sigma(actuators, mode_variance_m2, high)
    if shapes is None or len(high) <= LOW_MODES:
        return None
    inner = shapes[~outer].T @ shapes[~outer] / np.count_nonzero(~outer)
    return EdgeWatch(
        modes=high,
        outer=shapes[outer].astype(np.float32),
        inner=inner.astype(np.float32),
        memory_s=EDGE_MEMORY_S * max(diameter_m / EDGE_MEMORY_OF_M, 1.0),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActuatorWatch:
    """Positions of all actuators for a modal command, in σ of turbulence."""

    modes: NDArray[np.intp]
    """``(n_watched,)`` those of the loop that are not left out."""

    shapes: NDArray[np.float32]
    """``(n_actuators, n_watched)``."""


def actuator_watch(
    actuators: Actuators, mode_variance_m2: NDArray[np.float64], in_loop: NDArray[np.intp]
) -> ActuatorWatch | None:
    """Return the watch of the actuators in a loop of these modes; None if they are too few.

    The lowest modes are left out: offsets and vibrations move them by more than turbulence does,
    and all actuators with them.
    """
    high = in_loop[max(MIN_LEFT_OUT_MODES, round(LEFT_OUT_SHARE * len(in_loop))) :]
    shapes = _shapes_in_sigma(actuators, mode_variance_m2, high)
    if shapes is None or len(high) < MIN_ACTUATOR_MODES:
        return None
    return ActuatorWatch(modes=high, shapes=shapes.astype(np.float32))


def _shapes_in_sigma(
    actuators: Actuators, mode_variance_m2: NDArray[np.float64], modes: NDArray[np.intp]
) -> NDArray[np.float64] | None:
    """Return ``(n_actuators, n_modes)`` in σ of turbulence; None if it moves one not at all."""
    strokes = actuators.strokes[:, modes]
    expected = np.sqrt(strokes**2 @ mode_variance_m2[modes])
    # The division below needs an expected position for every actuator.
    if not len(modes) or expected.min() <= 0.0:
        return None
    return np.asarray(strokes / expected[:, None])
