"""The mirror's surface between its actuators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model.instrument import Influence, Mirror

Array = NDArray[np.float64]


class Surface(Protocol):
    """Influence functions as a linear combination of a basis that can be evaluated anywhere."""

    def coefficients(self, strokes: Array) -> Array:
        """Return ``(n_basis, n_shapes)`` weights of the shapes with these actuator strokes.

        ``strokes`` is ``(n_actuators, n_shapes)``.
        """

    def basis(self, points: Array) -> Array:
        """Return ``(n_points, n_basis)`` at ``points`` ``(n_points, 2)``, x and y."""

    def slope(self, points: Array, direction: Array) -> Array:
        """Return ``(n_points, n_basis)``: derivative of ``basis`` along ``direction``.

        ``direction`` is ``(n_points, 2)`` and need not have unit length.
        """


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
    """In the units of ``positions``."""

    coupling: float
    """Height at one pitch, 0..1."""

    def coefficients(self, strokes: Array) -> Array:
        """Each actuator is its own basis function."""
        return np.asarray(strokes, dtype=np.float64)

    def basis(self, points: Array) -> Array:
        """Evaluate the Gaussians."""
        dx, dy = _offsets(points, self.positions)
        return np.asarray(np.exp(np.log(self.coupling) / self.pitch**2 * (dx**2 + dy**2)))

    def slope(self, points: Array, direction: Array) -> Array:
        """Differentiate the Gaussians along ``direction``."""
        dx, dy = _offsets(points, self.positions)
        rate = 2.0 * np.log(self.coupling) / self.pitch**2
        along = dx * direction[:, :1] + dy * direction[:, 1:]
        return np.asarray(rate * along * self.basis(points))


def mirror_surface(mirror: Mirror, subaperture_m: float) -> Surface:
    """Return the surface of this mirror in coordinates of subapertures."""
    positions = mirror.positions_m / subaperture_m
    match mirror.influence:
        case Influence.THIN_PLATE:
            return ThinPlate(positions)
        case Influence.GAUSSIAN:
            return Gaussian(positions, mirror.pitch_m / subaperture_m, mirror.coupling)


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
