"""The mirror's modes and its surface between actuators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument, Mirror, TabulatedModes
from service.model.kinds import BasisKind, Influence
from service.model.pupil import PupilGrid, instrument_pupil
from service.model.tabulated import TabulatedBasis, smoothed, tabulated_basis
from service.model.turbulence import (
    expected_variance,
    piston_free,
    pupil_statistics,
)

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

    def near(self, points: Array) -> NDArray[np.intp]:
        """Return which functions are higher than ``NOTHING`` at any of some points close together.

        ``points`` is ``(n_points, 2)``.
        """
        reach = self.pitch * np.sqrt(np.log(NOTHING) / np.log(self.coupling))
        middle = points.mean(axis=0)
        around = np.linalg.norm(points - middle, axis=1).max()
        apart = np.linalg.norm(self.positions - middle, axis=1)
        candidates = np.flatnonzero(apart <= around + reach)
        dx, dy = _offsets(points, self.positions[candidates])
        reached = (dx**2 + dy**2).min(axis=0, initial=np.inf) <= reach**2
        return np.asarray(candidates[reached])

    def only(self, functions: NDArray[np.intp]) -> Gaussian:
        """Return the surface that these functions alone make."""
        return replace(self, positions=self.positions[functions])

    def coefficients(self, strokes: Array) -> Array:
        """Each actuator is its own basis function."""
        return np.asarray(strokes, dtype=np.float64)

    def basis(self, points: Array) -> Array:
        """Evaluate the Gaussians."""
        dx, dy = _offsets(points, self.positions)
        return np.asarray(np.exp(np.log(self.coupling) / self.pitch**2 * (dx**2 + dy**2)))

    def wider(self, points: Array) -> Array:
        """Differentiate the Gaussians by the logarithm of their width."""
        dx, dy = _offsets(points, self.positions)
        exponent = np.log(self.coupling) / self.pitch**2 * (dx**2 + dy**2)
        return np.asarray(-2.0 * exponent * np.exp(exponent))

    def slope(self, points: Array, direction: Array) -> Array:
        """Differentiate the Gaussians along ``direction``."""
        dx, dy = _offsets(points, self.positions)
        rate = 2.0 * np.log(self.coupling) / self.pitch**2
        along = dx * direction[:, :1] + dy * direction[:, 1:]
        return np.asarray(rate * along * self.basis(points))


NOTHING = 1e-6
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
            return Gaussian(positions, mirror.pitch_m / subaperture_m, mirror.shape.coupling)


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


Indices = Sequence[int] | NDArray[np.integer]

_PISTON_RATIO = 1e-9
_DEGENERATE = 1e-3
"""The square grid splits pairs that the mirror's symmetry makes equal by less than this."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalBasis:
    """Modes of an analytic mirror.

    A unit command is 1 m RMS of OPD over the pupil for Karhunen-Loeve modes, and what its owner
    says for others.
    """

    surface: Surface
    """The mirror between its actuators, coordinates in subapertures."""

    mode_to_actuator: Array
    """``(n_actuators, n_modes)`` actuator strokes of each mode, metres OPD per unit command."""

    coefficients: Array
    """``(n_basis, n_modes)`` weights of the surface's basis functions for each mode."""

    variance_m2: Array
    """``(n_modes,)`` expected variance of each mode under the turbulence, metres² OPD."""

    y_sign: float = 1.0
    """-1: the mirror is seen from behind."""

    @property
    def n_modes(self) -> int:
        """Modes of the basis."""
        return int(self.coefficients.shape[1])

    def render(self, points: Array) -> Array:
        """Return the modes ``(n_points, n_modes)`` at mirror ``points`` ``(n_points, 2)``."""
        return self.surface.basis(points * [1.0, self.y_sign]) @ self.coefficients

    def render_slope(self, points: Array, direction: Array) -> Array:
        """Return the derivative of the modes along ``direction``, ``(n_points, n_modes)``."""
        side = np.array([1.0, self.y_sign])
        return self.surface.slope(points * side, direction * side) @ self.coefficients

    def render_wider(self, points: Array) -> Array:
        """Return how the modes change with the logarithm of the influence functions' width.

        ``(n_points, n_modes)``; the strokes of the actuators stay.
        """
        if isinstance(self.surface, Gaussian):
            return self.surface.wider(points * [1.0, self.y_sign]) @ self.coefficients
        return smoothed(self.render, points)

    @property
    def is_local(self) -> bool:
        """Whether its functions end near their actuators, so that ``patch`` knows them."""
        return isinstance(self.surface, Gaussian)

    def patch(
        self, points: Array, direction: Array | None = None
    ) -> tuple[NDArray[np.intp], Array]:
        """Return which functions reach some points close together, and their heights there.

        ``(n_near,)`` and ``(n_points, n_near)``; with a ``direction`` ``(n_points, 2)`` their rates
        along it. What they weigh in each mode are the ``coefficients``.

        Raises
        ------
        ModelError
            If they do not end.
        """
        if not isinstance(self.surface, Gaussian):
            raise ModelError("modes: found functions that reach everywhere; expected local ones")
        side = np.array([1.0, self.y_sign])
        near = self.surface.near(points * side)
        some = self.surface.only(near)
        if direction is None:
            return near, some.basis(points * side)
        return near, some.slope(points * side, direction * side)

    def of_surface(self, surface: Surface) -> ModalBasis:
        """Return the same strokes of other influence functions."""
        coefficients = surface.coefficients(self.mode_to_actuator)
        return replace(self, surface=surface, coefficients=coefficients)

    def known(self, points: Array) -> NDArray[np.bool_]:
        """Return that an analytic surface is known at every point, ``(n_points,)``."""
        return np.ones(len(points), dtype=np.bool_)

    def subset(self, indices: Indices) -> ModalBasis:
        """Return a basis of these modes only, in this order."""
        return replace(
            self,
            mode_to_actuator=np.ascontiguousarray(self.mode_to_actuator[:, indices]),
            coefficients=np.ascontiguousarray(self.coefficients[:, indices]),
            variance_m2=self.variance_m2[indices],
        )

    def combined(self, weights: Array) -> ModalBasis:
        """Return a basis of combinations of the modes, ``weights`` ``(n_modes, n_combined)``.

        Modes are taken to vary apart from one another.
        """
        return replace(
            self,
            mode_to_actuator=self.mode_to_actuator @ weights,
            coefficients=self.coefficients @ weights,
            variance_m2=self.variance_m2 @ weights**2,
        )


Basis = ModalBasis | TabulatedBasis
"""Shapes of the mirror that can be evaluated wherever a registration puts them."""


def modal_basis(instrument: Instrument) -> Basis:
    """Return the modes of this instrument, whatever kind they are.

    Raises
    ------
    ModelError
        If the mirror has fewer modes than were asked for, or its table is too coarse.
    """
    if isinstance(instrument.mirror, TabulatedModes):
        return tabulated_basis(instrument, instrument.mirror)
    return analytic_basis(instrument)


def analytic_basis(instrument: Instrument) -> ModalBasis:
    """Return the modes of an analytic mirror: the user's own, its actuators, or KL modes.

    Raises
    ------
    ModelError
        If the mirror has fewer modes than were asked for, or is a table of shapes.
    """
    mirror = instrument.analytic_mirror
    if mirror.mode_to_actuator is not None:
        return _given_basis(instrument, mirror, mirror.mode_to_actuator)
    match mirror.basis:
        case BasisKind.ZONAL:
            return _given_basis(instrument, mirror, np.eye(len(mirror.positions_m)))
        case BasisKind.KARHUNEN_LOEVE:
            return karhunen_loeve_basis(instrument)


def _given_basis(instrument: Instrument, mirror: Mirror, strokes: Array) -> ModalBasis:
    """Return the modes with these actuator strokes ``(n_actuators, n_modes)``, as they are."""
    surface = mirror_surface(mirror, instrument.subaperture_m)
    coefficients = surface.coefficients(strokes)
    return ModalBasis(
        surface=surface,
        mode_to_actuator=strokes,
        coefficients=coefficients,
        variance_m2=expected_variance(
            instrument, lambda points: surface.basis(points) @ coefficients
        ),
        y_sign=mirror.y_sign,
    )


def karhunen_loeve_basis(instrument: Instrument) -> ModalBasis:
    """Return the first ``n_modes`` KL modes of the instrument's mirror, piston-free, unit RMS.

    Mode 0 is the tilt along +x, mode 1 the tilt along +y. Where mirror and pupil are symmetric
    about the x axis the even and odd modes are found apart, so that pairs of equal variance have
    one well-defined orientation and every machine finds the same basis.

    Raises
    ------
    ModelError
        If the mirror has fewer modes than were asked for.
    """
    turbulence = instrument.modes
    mirror = instrument.analytic_mirror
    surface = mirror_surface(mirror, instrument.subaperture_m)
    n_actuators = len(mirror.positions_m)
    if not 2 <= turbulence.n_modes < n_actuators:
        raise ModelError(
            f"modes: found n_modes = {turbulence.n_modes}; expected at least tip and tilt, and "
            f"fewer than the {n_actuators} actuators (piston is left out)"
        )
    influence = surface.coefficients(np.eye(n_actuators))
    gram, covariance = pupil_statistics(
        instrument, lambda points: surface.basis(points) @ influence
    )
    pupil = instrument_pupil(instrument, 4)
    sectors = [np.eye(n_actuators)]
    if np.allclose(pupil.amplitude, pupil.amplitude[::-1], rtol=0.0, atol=1e-9):
        sectors = _parity_sectors(mirror.positions_m)
    strokes, variance = _diagonalise(gram, covariance, sectors, turbulence.n_modes)
    strokes = _unit_rms(strokes, surface, influence, pupil)
    strokes = _tilts_along_axes(strokes, mirror.positions_m)
    strokes = _fix_signs(strokes, mirror.positions_m)
    return ModalBasis(
        surface=surface,
        mode_to_actuator=strokes,
        coefficients=influence @ strokes,
        variance_m2=variance,
        y_sign=mirror.y_sign,
    )


def _parity_sectors(positions_m: Array) -> list[Array]:
    """Return bases ``(n_actuators, n)`` of the strokes even and odd under y -> -y.

    One sector with everything when the layout has no such symmetry.
    """
    n = len(positions_m)
    distance, image = scipy.spatial.KDTree(positions_m).query(positions_m * [1.0, -1.0])
    if distance.max() > 1e-6 * np.ptp(positions_m) or len(set(image)) != n:
        return [np.eye(n)]
    even, odd = [], []
    for j, partner in enumerate(image):
        unit = np.zeros(n)
        if j == partner:
            unit[j] = 1.0
            even.append(unit)
        elif j < partner:
            unit[[j, partner]] = np.sqrt(0.5)
            even.append(unit)
            odd.append(unit * np.where(np.arange(n) == partner, -1.0, 1.0))
    return [np.array(even).T, np.array(odd).T]


def _diagonalise(
    gram: Array, covariance: Array, sectors: list[Array], n_modes: int
) -> tuple[Array, Array]:
    """Return strokes and variances of the KL modes, by falling variance.

    Solves the eigenproblem of the turbulence projected on each sector, in coordinates where the
    Gram matrix is the identity; the null vector of the Gram matrix is piston and is dropped.
    """
    found = []
    for parity, sector in enumerate(sectors):
        power, axes = scipy.linalg.eigh(sector.T @ gram @ sector)
        kept = power > _PISTON_RATIO * power[-1]
        whiten = sector @ (axes[:, kept] / np.sqrt(power[kept]))
        variance, vectors = scipy.linalg.eigh(whiten.T @ covariance @ whiten)
        strokes = whiten @ vectors
        found += [(variance[j], parity, strokes[:, j]) for j in range(len(variance))]
    found.sort(key=lambda mode: -mode[0])
    ordered = _even_before_odd(found)[:n_modes]
    if len(ordered) < n_modes:
        raise ModelError(f"modes: the mirror has {len(ordered)} modes, {n_modes} were asked for")
    return np.column_stack([mode[2] for mode in ordered]), np.array([mode[0] for mode in ordered])


def _even_before_odd(found: list[tuple[float, int, Array]]) -> list[tuple[float, int, Array]]:
    """Settle the order inside pairs of equal variance, which rounding would otherwise decide."""
    ordered: list[tuple[float, int, Array]] = []
    start = 0
    for stop in range(1, len(found) + 1):
        if (
            stop == len(found)
            or found[stop - 1][0] - found[stop][0] > _DEGENERATE * found[start][0]
        ):
            ordered += sorted(found[start:stop], key=lambda mode: mode[1])
            start = stop
    return ordered


def _unit_rms(strokes: Array, surface: Surface, influence: Array, pupil: PupilGrid) -> Array:
    """Orthonormalise the modes over the pupil, in order, on a finer grid than they came from."""
    shapes = piston_free(surface.basis(pupil.points) @ (influence @ strokes), pupil.weights)
    gram = shapes.T @ (shapes * pupil.weights[:, None])
    upper = scipy.linalg.cholesky(gram)
    return np.asarray(scipy.linalg.solve_triangular(upper, strokes.T, trans="T").T)


def _tilts_along_axes(strokes: Array, positions_m: Array) -> Array:
    """Turn the first two modes in their plane until mode 1 holds no tilt along x.

    They are equally strong, so without a symmetry their orientation is any. The turn leaves both
    orthonormal.
    """
    along = positions_m[:, 0] @ strokes[:, :2]
    cosine, sine = along / np.hypot(*along)
    turned = strokes.copy()
    turned[:, :2] = strokes[:, :2] @ np.array([[cosine, -sine], [sine, cosine]])
    return turned


def _fix_signs(strokes: Array, positions_m: Array) -> Array:
    """Give every mode one sign: tilts rise along +x and +y, the rest by a fixed projection.

    The projection is on an arbitrary irregular vector, so that no symmetry can make it vanish.
    """
    index = np.arange(1, len(positions_m) + 1)
    projection = np.modf(index * np.sqrt(2.0))[0] - 0.5
    sign = np.sign(projection @ strokes)
    sign[:2] = np.sign([positions_m[:, 0] @ strokes[:, 0], positions_m[:, 1] @ strokes[:, 1]])
    return np.asarray(strokes * sign)
