"""The mirror's surface between its actuators."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model.instrument import Mirror
from service.model.kinds import Influence

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ThinPlate:
    """Thin-plate-spline interpolant through the actuators: 1 at its own, 0 at all others.

    It is the shape of least bending energy, which a position-controlled thin shell takes. The
    weights must stay in float64: rounded to float32 they alone change D by 1e-3.
    """

    positions: Array
    """``(n_actuators, 2)`` x and y, in the units of the points to be evaluated."""

    def coefficients(self, strokes: Array) -> Array:
        """Solve the spline system for these strokes."""
        n = len(self.positions)
        affine = np.column_stack([np.ones(n), self.positions])
        system = np.zeros((n + 3, n + 3))
        system[:n, :n] = _bending_kernel(*_offsets(self.positions, self.positions))
        system[:n, n:] = affine
        system[n:, :n] = affine.T
        # Three equations more: the weights have no sum and no moment, which keeps the plate finite
        # far away.
        padded = np.vstack([strokes, np.zeros((3, strokes.shape[1]))])
        return np.asarray(scipy.linalg.lu_solve(scipy.linalg.lu_factor(system), padded))

    def basis(self, points: Array) -> Array:
        """Evaluate r² log r about each actuator, then 1, x, y."""
        n = len(self.positions)
        out = np.empty((len(points), n + 3))
        out[:, :n] = _bending_kernel(*_offsets(points, self.positions))
        out[:, n] = 1.0
        out[:, n + 1 :] = points
        return out

    def slope(self, points: Array, direction: Array) -> Array:
        """Differentiate the basis along ``direction``."""
        n = len(self.positions)
        dx, dy = _offsets(points, self.positions)
        along = dx * direction[:, :1] + dy * direction[:, 1:]
        out = np.empty((len(points), n + 3))
        # Derivative of r² log r along a direction: (2 log r + 1) times the offset along it.
        out[:, :n] = (_log_squared(dx, dy) + 1.0) * along
        out[:, n] = 0.0
        out[:, n + 1 :] = direction
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Gaussian:
    """Gaussian influence functions, ``coupling ** (r / pitch)²``."""

    positions: Array
    """``(n_actuators, 2)`` x and y."""

    pitch: float
    """Distance of neighbouring actuators, in the units of ``positions``."""

    coupling: float
    """Height at one pitch, 0..1."""

    segments_deg: tuple[float, ...] = ()
    """Gaps that no function crosses, as a ``Mirror`` has them."""

    @property
    def reach(self) -> float:
        """Distance at which a function has ``NEGLIGIBLE_HEIGHT``, in the units of ``positions``."""
        return float(self.pitch * np.sqrt(np.log(NEGLIGIBLE_HEIGHT) / np.log(self.coupling)))

    def near(self, points: Array) -> NDArray[np.intp]:
        """Return which functions exceed ``NEGLIGIBLE_HEIGHT`` at any of some points close together.

        ``points`` is ``(n_points, 2)``.
        """
        reach = self.reach
        middle = points.mean(axis=0)
        around = np.linalg.norm(points - middle, axis=1).max()
        apart = np.linalg.norm(self.positions - middle, axis=1)
        # A circle around all points first: distances to every point are computed for few functions
        # only.
        candidates = np.flatnonzero(apart <= around + reach)
        dx, dy = _offsets(points, self.positions[candidates])
        reached = (dx**2 + dy**2).min(axis=0, initial=np.inf) <= reach**2
        return np.asarray(candidates[reached])

    def patch(
        self, points: Array, direction: Array | None = None
    ) -> tuple[NDArray[np.intp], Array]:
        """Return which functions reach some points close together, and their heights there.

        ``(n_near,)`` and ``(n_points, n_near)``; with a ``direction`` their rates along it.
        """
        near = self.near(points)
        some = replace(self, positions=self.positions[near])
        return near, some.basis(points) if direction is None else some.slope(points, direction)

    def coefficients(self, strokes: Array) -> Array:
        """Each actuator is its own basis function."""
        return np.asarray(strokes, dtype=np.float64)

    def basis(self, points: Array) -> Array:
        """Evaluate the Gaussians."""
        dx, dy = _offsets(points, self.positions)
        exponent = np.log(self.coupling) / self.pitch**2 * (dx**2 + dy**2)
        return np.asarray(self._within_segments(_exp(exponent), points))

    def wider(self, points: Array) -> Array:
        """Differentiate the Gaussians by the logarithm of their width."""
        dx, dy = _offsets(points, self.positions)
        exponent = np.log(self.coupling) / self.pitch**2 * (dx**2 + dy**2)
        return np.asarray(self._within_segments(-2.0 * exponent * _exp(exponent), points))

    def slope(self, points: Array, direction: Array) -> Array:
        """Differentiate the Gaussians along ``direction``."""
        dx, dy = _offsets(points, self.positions)
        rate = 2.0 * np.log(self.coupling) / self.pitch**2
        along = dx * direction[:, :1] + dy * direction[:, 1:]
        return np.asarray(rate * along * self.basis(points))

    def steps(self, inner: float, outer: float) -> Array:
        """Return the mean step of every function across each gap ``(n_gaps, n_functions)``.

        ``inner`` and ``outer`` are the distances from the centre between which it is taken.
        """
        radius = np.arange(inner, outer, self.pitch / _PER_PITCH)
        found = []
        for gap in self.segments_deg:
            before, after = (
                radius[:, None] * [np.cos(angle), np.sin(angle)]
                for angle in np.deg2rad([gap - _GAP_OFFSET_DEG, gap + _GAP_OFFSET_DEG])
            )
            found.append((self.basis(after) - self.basis(before)).mean(axis=0))
        return np.array(found)

    def _within_segments(self, values: Array, points: Array) -> Array:
        """Return values ``(n_points, n_functions)``, 0 across a gap."""
        if not self.segments_deg:
            return values
        there = segment_of(points, self.segments_deg)
        own = segment_of(self.positions, self.segments_deg)
        return np.asarray(values * (there[:, None] == own))


_PER_PITCH = 4
"""Places along a pitch of a gap at which its step is looked at."""

_GAP_OFFSET_DEG = 1e-6
"""Angle on either side of a gap at which its step is evaluated, degrees."""

NEGLIGIBLE_HEIGHT = 1e-6
"""Height below which a local function is left out: of slopes as much, and D keeps five digits."""

Surface = ThinPlate | Gaussian
"""Influence functions as combinations of functions that can be evaluated anywhere."""


def mirror_surface(mirror: Mirror, subaperture_m: float) -> Surface:
    """Return the surface of this mirror in coordinates of subapertures."""
    positions = mirror.positions_m / subaperture_m
    match mirror.shape.influence:
        case Influence.THIN_PLATE:
            return ThinPlate(positions)
        case Influence.GAUSSIAN:
            pitch = mirror.pitch_m / subaperture_m
            return Gaussian(positions, pitch, mirror.shape.coupling, mirror.segments_deg)


def segment_of(points: Array, gaps_deg: tuple[float, ...]) -> NDArray[np.intp]:
    """Return the segment ``(n_points,)`` that contains each point, counted from the first gap."""
    angle_deg = np.rad2deg(np.arctan2(points[:, 1], points[:, 0])) % 360.0
    return np.asarray(np.searchsorted(gaps_deg, angle_deg, side="right") % len(gaps_deg))


def _exp(exponent: Array) -> Array:
    """Return the exponential, 0 where it is below 1e-18.

    Denormal numbers of single precision make products forty times as slow.
    """
    return np.exp(exponent, out=np.zeros_like(exponent), where=exponent > _LEAST_EXPONENT)


_LEAST_EXPONENT = -41.0


def _offsets(points: Array, centres: Array) -> tuple[Array, Array]:
    """Return x and y of every point relative to every centre, ``(n_points, n_centres)``."""
    return points[:, :1] - centres[:, 0], points[:, 1:] - centres[:, 1]


def _log_squared(dx: Array, dy: Array) -> Array:
    """Return 2 log r, with 0 at r = 0 where it is always multiplied by a zero."""
    squared = dx**2 + dy**2
    return np.asarray(np.log(squared, out=np.zeros_like(squared), where=squared > 0.0))


def _bending_kernel(dx: Array, dy: Array) -> Array:
    """Return r² log r."""
    return np.asarray(0.5 * (dx**2 + dy**2) * _log_squared(dx, dy))
