"""Karhunen-Loeve modes of a mirror: its shapes in the order of their variance in turbulence."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument
from service.model.local import LocalShapes, shapes_on
from service.model.pupil import PupilGrid, instrument_pupil
from service.model.sensors.sensor import by_rows
from service.model.surface import Gaussian, Surface
from service.model.turbulence import (
    SAMPLING,
    local_statistics,
    piston_free,
    pupil_gram,
    pupil_statistics,
)

Array = NDArray[np.float64]

_PISTON_RATIO = 1e-9
_DEGENERACY_RATIO = 1e-3
"""Relative difference below which two variances count as equal. By symmetry of the mirror they are;
the square grid of points separates them slightly."""

_POINTS_PER_SUBAPERTURE = 4
"""Number of points per subaperture on which the modes are made orthonormal."""

WHOLE_BYTES = 2.5e8
"""Size in bytes above which influence functions of finite extent are stored tile by tile."""


def compute_modes(instrument: Instrument, surface: Surface) -> tuple[Array, Array]:
    """Return strokes ``(n_actuators, n_modes)`` and variances of the mirror's first KL modes.

    The modes are piston-free and of unit RMS; mode 0 is the tilt along +x, mode 1 the tilt along
    +y. If mirror and pupil are symmetric about the x axis, even and odd modes are computed
    separately, so that pairs of equal variance have a unique orientation and every machine computes
    the same basis.

    Raises
    ------
    ModelError
        If the mirror has fewer modes than requested.
    """
    n_modes, positions_m = instrument.modes.n_modes, instrument.analytic_mirror.positions_m
    if not 2 <= n_modes < len(positions_m):
        raise ModelError(
            f"modes: found n_modes = {n_modes}; expected at least tip and tilt, and "
            f"fewer than the {len(positions_m)} actuators (piston is left out)"
        )
    gram, covariance = surface_statistics(instrument, surface)
    fine = instrument_pupil(instrument, _POINTS_PER_SUBAPERTURE)
    sectors = [scipy.sparse.eye_array(len(positions_m), format="csc")]
    if np.allclose(fine.amplitude, fine.amplitude[::-1], rtol=0.0, atol=1e-9):
        sectors = _parity_sectors(positions_m)
    strokes, variance = _diagonalise(
        gram, covariance, sectors, n_modes, _left_out(instrument, surface)
    )
    # Once more on finer points: the statistics of turbulence are computed on coarser ones.
    strokes = _unit_rms(strokes, _gram(surface, strokes, fine))
    strokes = _tilts_along_axes(strokes, positions_m)
    return _fix_signs(strokes, positions_m), variance


def _left_out(instrument: Instrument, surface: Surface) -> Array:
    """Return combinations of strokes ``(n, n_actuators)`` that are 0 in every mode.

    They are the mean steps across the gaps between a mirror's segments. A pyramid hardly measures
    the height of segments relative to one another, least of all behind the arms of a spider, so
    these differential pistons are excluded from every fit and inversion.
    """
    # Only Gaussian functions can end at a gap.
    if not isinstance(surface, Gaussian) or not surface.segments_deg:
        return np.empty((0, len(surface.positions)))
    radius = instrument.wfs.pupil_diameter / 2
    return surface.steps(radius * instrument.obscuration_ratio, radius)


def surface_statistics(instrument: Instrument, surface: Surface) -> tuple[Array, Array]:
    """Return Gram matrix of the actuators' functions and covariance of turbulence on them."""
    functions = _local(surface, instrument_pupil(instrument, SAMPLING))
    if functions is not None:
        return local_statistics(instrument, functions)
    influence = _influence(surface)
    return pupil_statistics(instrument, lambda points: _heights(surface, influence, points))


def _gram(surface: Surface, strokes: Array, pupil: PupilGrid) -> Array:
    """Return the Gram matrix of modes on a pupil."""
    functions = _local(surface, pupil)
    if functions is not None:
        return np.asarray(strokes.T @ pupil_gram(functions.sparse(), pupil.weights) @ strokes)
    heights = _heights(surface, _influence(surface) @ strokes, pupil.points)
    shapes = piston_free(heights, pupil.weights)
    return np.asarray(shapes.T @ (shapes * pupil.weights[:, None]))


def _heights(surface: Surface, coefficients: Array, points: Array) -> Array:
    """Return shapes at points, computed in blocks of points to limit memory."""
    return by_rows(map, lambda some: surface.basis(some) @ coefficients, points)


def _influence(surface: Surface) -> Array:
    return surface.coefficients(np.eye(len(surface.positions)))


def _local(surface: Surface, pupil: PupilGrid) -> LocalShapes | None:
    """Return the influence functions tile by tile; None if that saves no memory."""
    n_points, n_functions = int(pupil.lit.sum()), len(surface.positions)
    if not isinstance(surface, Gaussian) or 8.0 * n_points * n_functions < WHOLE_BYTES:
        return None
    return shapes_on(pupil, n_functions, surface.patch)


def _parity_sectors(positions_m: Array) -> list[Any]:
    """Return sparse bases ``(n_actuators, n)`` of the strokes even and odd under y -> -y.

    Without this symmetry there is one basis of all strokes.
    """
    n = len(positions_m)
    distance, image = scipy.spatial.KDTree(positions_m).query(positions_m * [1.0, -1.0])
    if distance.max() > 1e-6 * np.ptp(positions_m) or len(set(image)) != n:
        return [scipy.sparse.eye_array(n, format="csc")]
    on_axis = np.flatnonzero(image == np.arange(n))
    # One actuator of each pair stands for both.
    first = np.flatnonzero(image > np.arange(n))
    # Actuators on the axis keep their place among the pairs. This order decides the basis, which
    # must not change.
    leading = np.sort(np.concatenate([on_axis, first]))
    mirror = scipy.sparse.csc_array((np.ones(n), (image, np.arange(n))), shape=(n, n))
    whole = scipy.sparse.eye_array(n, format="csc")
    scale = np.where(np.isin(leading, on_axis), 0.5, np.sqrt(0.5))
    even = (whole + mirror)[:, leading].multiply(scale).tocsc()
    return [even, (whole - mirror)[:, first] * np.sqrt(0.5)]


def _diagonalise(
    gram: Array, covariance: Array, sectors: list[Any], n_modes: int, left_out: Array
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
        against = scipy.linalg.orth((left_out @ whiten).T)
        variance, vectors = scipy.linalg.eigh(_without(whiten.T @ covariance @ whiten, against))
        n_out = against.shape[1]  # excluded directions have variance 0 and come first
        strokes = whiten @ vectors[:, n_out:]
        found += [
            (one, parity, mode) for one, mode in zip(variance[n_out:], strokes.T, strict=True)
        ]
    found.sort(key=lambda mode: -mode[0])
    ordered = _sort_even_first(found)[:n_modes]
    if len(ordered) < n_modes:
        raise ModelError(f"modes: the mirror has {len(ordered)} modes, {n_modes} were requested")
    return np.column_stack([mode[2] for mode in ordered]), np.array([mode[0] for mode in ordered])


def _without(covariance: Array, directions: Array) -> Array:
    """Return a covariance in which orthonormal ``directions`` ``(n, k)`` do not vary."""
    along = covariance @ directions
    both = directions @ (directions.T @ along) @ directions.T
    return np.asarray(covariance - along @ directions.T - directions @ along.T + both)


def _sort_even_first(found: list[tuple[float, int, Array]]) -> list[tuple[float, int, Array]]:
    """Sort pairs of equal variance, even modes first; otherwise rounding would decide."""
    ordered: list[tuple[float, int, Array]] = []
    start = 0
    for stop in range(1, len(found) + 1):
        if (
            stop == len(found)
            or found[stop - 1][0] - found[stop][0] > _DEGENERACY_RATIO * found[start][0]
        ):
            ordered += sorted(found[start:stop], key=lambda mode: mode[1])
            start = stop
    return ordered


def _unit_rms(strokes: Array, gram: Array) -> Array:
    """Orthonormalise the modes over the pupil, in order: their ``gram`` there becomes one."""
    # In order: the first modes keep their shape, the last ones take the corrections.
    upper = scipy.linalg.cholesky(gram)
    return np.asarray(scipy.linalg.solve_triangular(upper, strokes.T, trans="T").T)


def _tilts_along_axes(strokes: Array, positions_m: Array) -> Array:
    """Turn the first two modes in their plane until mode 1 holds no tilt along x.

    Both have the same variance, so without a symmetry their orientation is arbitrary. They stay
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
