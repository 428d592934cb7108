"""Karhunen-Loeve modes of von Karman turbulence, in the space the mirror can reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.linalg import cholesky, eigh, solve_triangular
from scipy.spatial import KDTree
from scipy.special import gamma, kv

from service.errors import ModelError
from service.model.instrument import Instrument, KarhunenLoeve
from service.model.mirror import Surface, mirror_surface
from service.model.pupil import PupilGrid, annular_pupil

Array = NDArray[np.float64]

REFERENCE_WAVELENGTH_M = 500e-9
"""Wavelength at which r0 is quoted, metres."""

_COVARIANCE_SAMPLING = 3
_NORM_SAMPLING = 4
_PISTON_RATIO = 1e-9
_DEGENERATE = 1e-3
"""The square grid splits pairs that the mirror's symmetry makes equal by less than this."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalBasis:
    """The modes the RTC commands. A unit command is 1 m RMS of OPD over the pupil."""

    surface: Surface
    """The mirror between its actuators, coordinates in subapertures."""

    mode_to_actuator: Array
    """``(n_actuators, n_modes)`` actuator strokes of each mode, metres OPD per metre RMS."""

    coefficients: Array
    """``(n_basis, n_modes)`` weights of the surface's basis functions for each mode."""

    variance_m2: Array
    """``(n_modes,)`` expected variance of each mode under the turbulence, metres² OPD."""

    def render(self, points: Array) -> Array:
        """Return the modes ``(n_points, n_modes)`` at mirror ``points`` ``(n_points, 2)``."""
        return self.surface.basis(points) @ self.coefficients

    def render_slope(self, points: Array, direction: Array) -> Array:
        """Return the derivative of the modes along ``direction``, ``(n_points, n_modes)``."""
        return self.surface.slope(points, direction) @ self.coefficients


def von_karman_covariance(separation_m: Array, turbulence: KarhunenLoeve) -> Array:
    """Return the phase covariance of von Karman turbulence, in metres² of OPD.

    References
    ----------
    Conan 2000, PhD thesis; Heritier et al. 2018 use the same spectrum.
    """
    scale = (turbulence.outer_scale_m / turbulence.r0_m) ** (5 / 3)
    shape = (24 / 5 * gamma(6 / 5)) ** (5 / 6) / np.pi ** (8 / 3) * gamma(11 / 6)
    x = 2 * np.pi * np.asarray(separation_m, dtype=np.float64) / turbulence.outer_scale_m
    at_zero = scale * shape * gamma(5 / 6) / 2
    safe = np.maximum(x, 1e-12)
    phase = np.where(
        x > 1e-9, scale * shape / 2 ** (5 / 6) * safe ** (5 / 6) * kv(5 / 6, safe), at_zero
    )
    return np.asarray(phase * (REFERENCE_WAVELENGTH_M / (2 * np.pi)) ** 2)


def karhunen_loeve_basis(instrument: Instrument) -> ModalBasis:
    """Return the first ``n_modes`` KL modes of the instrument's mirror, piston-free, unit RMS.

    Mode 0 is the tilt along +x, mode 1 the tilt along +y. Where the mirror is symmetric about the
    x axis the even and odd modes are found apart, so that pairs of equal variance have one
    well-defined orientation and every machine finds the same basis.

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
    gram, covariance = _pupil_statistics(instrument, surface, influence)
    strokes, variance = _diagonalise(
        gram, covariance, _parity_sectors(mirror.positions_m), turbulence.n_modes
    )
    strokes = _unit_rms(strokes, surface, influence, _pupil(instrument, _NORM_SAMPLING))
    strokes = _tilts_along_axes(strokes, mirror.positions_m)
    strokes = _fix_signs(strokes, mirror.positions_m)
    return ModalBasis(
        surface=surface,
        mode_to_actuator=strokes,
        coefficients=influence @ strokes,
        variance_m2=variance,
    )


def _pupil(instrument: Instrument, sampling: int) -> PupilGrid:
    return annular_pupil(
        n_subapertures=instrument.wfs.n_subapertures,
        diameter_subap=instrument.wfs.pupil_diameter,
        obscuration_ratio=instrument.obscuration_ratio,
        sampling=sampling,
    )


def _piston_free(shapes: Array, weights: Array) -> Array:
    return shapes - weights @ shapes


def _pupil_statistics(
    instrument: Instrument, surface: Surface, influence: Array
) -> tuple[Array, Array]:
    """Return Gram matrix of the influence functions and covariance of their projections.

    The covariance is a convolution of every weighted shape with B(r), done exactly on a padded
    grid: the dense n_points² matrix is never formed.
    """
    pupil = _pupil(instrument, _COVARIANCE_SAMPLING)
    weights = pupil.weights
    shapes = _piston_free(surface.basis(pupil.points) @ influence, weights)
    weighted = shapes * weights[:, None]
    n = len(pupil.coordinates)
    size = next_fast_len(2 * n, real=True)
    lag = np.minimum(np.arange(size), size - np.arange(size))
    separation = np.hypot(lag[:, None], lag) / pupil.sampling * instrument.subaperture_m
    kernel = rfft2(von_karman_covariance(separation, instrument.modes))
    convolved = np.empty_like(weighted)
    plane = np.zeros((n, n))
    for j in range(weighted.shape[1]):
        plane[pupil.lit] = weighted[:, j]
        spread = irfft2(rfft2(plane, (size, size)) * kernel, (size, size))
        convolved[:, j] = spread[:n, :n][pupil.lit]
    return shapes.T @ weighted, weighted.T @ convolved


def _parity_sectors(positions_m: Array) -> list[Array]:
    """Return bases ``(n_actuators, n)`` of the strokes even and odd under y -> -y.

    One sector with everything when the layout has no such symmetry.
    """
    n = len(positions_m)
    distance, image = KDTree(positions_m).query(positions_m * [1.0, -1.0])
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
        power, axes = eigh(sector.T @ gram @ sector)
        kept = power > _PISTON_RATIO * power[-1]
        whiten = sector @ (axes[:, kept] / np.sqrt(power[kept]))
        variance, vectors = eigh(whiten.T @ covariance @ whiten)
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
    shapes = _piston_free(surface.basis(pupil.points) @ (influence @ strokes), pupil.weights)
    gram = shapes.T @ (shapes * pupil.weights[:, None])
    upper = cholesky(gram)
    return np.asarray(solve_triangular(upper, strokes.T, trans="T").T)


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
