"""Modes given on a grid, evaluated by a cubic spline.

Tables of shapes end somewhere. A cubic spline cannot stop at an edge: a table that falls to zero
outside its pupil is wrong by 20 % inside it. So a smooth surface is put where the table knows
nothing. It decides nothing that is used (slopes near unknown surface are left out), it only has to
join smoothly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument, TabulatedModes
from service.model.turbulence import predict_variance, pupil_statistics

Array = NDArray[np.float64]
Table = NDArray[np.floating]
Mask = NDArray[np.bool_]

MARGIN_SUBAP = 3.0
"""Surface kept around the nominal pupil: what the largest shift and magnification can reach."""

MIN_POINTS_PER_SUBAPERTURE = 2.0
"""Below, the table itself has lost the high modes."""

ENOUGH_POINTS_PER_SUBAPERTURE = 4.0
"""0.45 % of error at mode 400; 2 points give 3 %."""

_SMOOTHING_SUBAP = 0.5
"""Step of the finite differences that approximate a Laplacian, subapertures."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TabulatedBasis:
    """Measured modes, in the units of their owner, between the points of their table."""

    instrument: Instrument
    """Instrument whose modes they are; they are weighted by its turbulence."""

    coefficients: NDArray[np.floating]
    """``(ny * nx, n_modes)`` weights of the B-splines at every table point."""

    surface_known: NDArray[np.bool_]
    """``(ny, nx)``: where the table says something, the margin around it included."""

    step_subap: float
    """Step of the table along both axes, in subapertures."""

    y_sign: float = 1.0
    """-1: the mirror is seen from behind."""

    is_local: ClassVar[bool] = False
    """True if its functions end near their actuators."""

    @property
    def n_modes(self) -> int:
        """Modes of the basis."""
        return int(self.coefficients.shape[1])

    @cached_property
    def variance_m2(self) -> Array:
        """``(n_modes,)`` expected variance of each mode under the turbulence, its unit squared."""
        return predict_variance(*pupil_statistics(self.instrument, self.render))

    def render(self, points: Array) -> Array:
        """Return the modes ``(n_points, n_modes)`` at mirror ``points`` ``(n_points, 2)``."""
        return self._combine_splines(self._splines_at(points, None))

    def render_slope(self, points: Array, direction: Array) -> Array:
        """Return the derivative of the modes along ``direction``, ``(n_points, n_modes)``."""
        return self._combine_splines(self._splines_at(points, direction))

    def render_wider(self, points: Array) -> Array:
        """Return how the modes change when their influence functions become wider."""
        return smooth_shapes(self.render, points)

    def known(self, points: Array) -> NDArray[np.bool_]:
        """Return whether the table knows the surface at every point, ``(n_points,)``."""
        place = self._place(points)
        # on a sample, within rounding, that sample is all that counts
        low, high = np.floor(place + 1e-9).astype(int), np.ceil(place - 1e-9).astype(int)
        last = np.array(self.surface_known.shape) - 1
        inside = np.all((low >= 0) & (high <= last), axis=1)
        corners = [np.clip(corner, 0, last).T for corner in (low, high)]
        for row in (corners[0][0], corners[1][0]):
            for column in (corners[0][1], corners[1][1]):
                inside &= self.surface_known[row, column]
        return np.asarray(inside)

    def subset(self, indices: Sequence[int] | NDArray[np.integer]) -> TabulatedBasis:
        """Return a basis of these modes only; itself if they are all, in order."""
        if np.array_equal(indices, np.arange(self.n_modes)):
            return self
        return replace(self, coefficients=np.ascontiguousarray(self.coefficients[:, indices]))

    def combine_modes(self, weights: Array) -> TabulatedBasis:
        """Return a basis of combinations of the modes, ``weights`` ``(n_modes, n_combined)``."""
        weights = weights.astype(self.coefficients.dtype)
        return replace(self, coefficients=self.coefficients @ weights)

    def _place(self, points: Array) -> Array:
        """Return the positions of points in the table, ``(n_points, 2)``: row and column."""
        centre = (np.array(self.surface_known.shape) - 1) / 2
        return np.asarray(points[:, ::-1] * [self.y_sign, 1.0] / self.step_subap + centre)

    def _splines(self, points: Array) -> tuple[tuple[NDArray[np.intp], tuple[Array, Array]], ...]:
        """Return for y and x the four table lines around every point, weights and their slopes."""
        found = []
        for n, place in zip(self.surface_known.shape, self._place(points).T, strict=True):
            cell = np.clip(np.floor(place).astype(np.intp), 0, n - 2)
            lines = cell[:, None] + np.arange(-1, 3)
            # Mirrored at the ends, as the spline filter assumes.
            lines = np.where(lines < 0, -lines, np.where(lines > n - 1, 2 * (n - 1) - lines, lines))
            found.append((lines, _cubic(np.clip(place - cell, 0.0, 1.0))))
        return tuple(found)

    def _splines_at(self, points: Array, direction: Array | None) -> Any:  # noqa: ANN401 - sparse
        """Return what each table point weighs at points, or in the rate along a direction there."""
        (rows, y), (columns, x) = self._splines(points)
        if direction is None:
            weights = _outer(y[0], x[0])
        else:
            along_x = direction[:, 0] / self.step_subap
            along_y = direction[:, 1] * self.y_sign / self.step_subap
            weights = along_x[:, None, None] * _outer(y[0], x[1])
            weights += along_y[:, None, None] * _outer(y[1], x[0])
        n_points = len(rows)
        index = rows[:, :, None] * self.surface_known.shape[1] + columns[:, None, :]
        return scipy.sparse.csr_array(
            (
                weights.astype(self.coefficients.dtype).ravel(),
                index.astype(np.int32).ravel(),
                np.arange(0, 16 * n_points + 1, 16, dtype=np.int32),
            ),
            shape=(n_points, self.surface_known.size),
        )

    def _combine_splines(self, splines: Any) -> Array:  # noqa: ANN401 - scipy has no types
        """Return the modes where the table's points weigh so much."""
        return np.asarray(splines @ self.coefficients)


def build_table_basis(instrument: Instrument, table: TabulatedModes) -> TabulatedBasis:
    """Return the spline through a table of modes, continued smoothly where nothing is known.

    Raises
    ------
    ModelError
        If the table is too coarse for the sensor.
    """
    if table.cube is None:
        raise ModelError("modes: found functions that end; expected a table of modes")
    step, margin = margin_of(instrument, table)
    known = pad_mask(table.known, margin)
    samples = fill_table(table.cube, table.known, margin)
    for mode in samples.T:
        # Mode by mode: the filter returns a copy, which for all modes at once would double the
        # memory.
        mode[:] = scipy.ndimage.spline_filter(
            mode.reshape(known.shape), order=3, output=mode.dtype
        ).ravel()
    return TabulatedBasis(
        instrument=instrument,
        coefficients=samples,
        surface_known=known,
        step_subap=step,
        y_sign=table.y_sign,
    )


def margin_of(instrument: Instrument, table: TabulatedModes) -> tuple[float, tuple[int, int]]:
    """Return the table's step in subapertures, and how many more rows and columns are needed.

    Raises
    ------
    ModelError
        If the table is too coarse for the sensor, or knows nothing over the pupil.
    """
    step = table.pitch_m / instrument.subaperture_m
    if step > 1.0 / MIN_POINTS_PER_SUBAPERTURE:
        raise ModelError(
            f"modes: found a table of {1 / step:.2f} points per subaperture; expected at least "
            f"{MIN_POINTS_PER_SUBAPERTURE:g}, {ENOUGH_POINTS_PER_SUBAPERTURE:g} for good"
        )
    reach = (instrument.wfs.pupil_diameter / 2 + MARGIN_SUBAP) / step
    ny, nx = table.known.shape
    margin = (int(np.ceil(reach - (ny - 1) / 2)), int(np.ceil(reach - (nx - 1) / 2)))
    if not pad_mask(table.known, margin).any():
        raise ModelError("modes: found a table that knows nothing of the surface over the pupil")
    return step, margin


def smooth_shapes(render: Callable[[Array], Array], points: Array) -> Array:
    """Return how shapes ``(n_points, n_modes)`` change when they are smoothed a little.

    A Gaussian of width w that becomes wider changes by ``w²/2`` times its Laplacian, per logarithm
    of the width and but for its height; w is taken as one subaperture.
    """
    steps = _SMOOTHING_SUBAP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    around = sum(render(points + step) for step in steps) - 4.0 * render(points)
    return np.asarray(around / (2.0 * _SMOOTHING_SUBAP**2))


def _cubic(fraction: Array) -> tuple[Array, Array]:
    """Return the four cubic B-splines over a cell, and their derivatives, ``(n_points, 4)``."""
    t, s = fraction, 1.0 - fraction
    values = [s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3]
    slopes = [-(s**2), 3 * t**2 - 4 * t, 4 * s - 3 * s**2, t**2]
    return np.column_stack(values) / 6.0, np.column_stack(slopes) / 2.0


def _outer(y: Array, x: Array) -> Array:
    """Return the products of weights along y and x, ``(n_points, 4, 4)``."""
    return np.asarray(y[:, :, None] * x[:, None, :])


def known_samples(cube: Table) -> Mask:
    """Return ``(ny, nx)``: where a cube ``(n_modes, ny, nx)`` says something.

    Samples that are not finite in any mode say nothing, nor do regions where every mode is exactly
    zero. A line of zeros one sample wide does: odd modes vanish together on an axis.
    """
    # Padded, so that zeros at the rim of the table form a region with the outside.
    zero = np.pad(~np.any(cube, axis=0), 1, constant_values=True)
    region = scipy.ndimage.binary_opening(zero, np.ones((2, 2), bool))
    zeros = scipy.ndimage.binary_dilation(region, mask=zero)[1:-1, 1:-1]
    return np.asarray(np.isfinite(cube).all(axis=0) & ~zeros)


def pad_mask(mask: Mask, margin: tuple[int, int]) -> Mask:
    """Return the mask with ``margin`` unknown rows and columns around it; negative ones cut."""
    return np.asarray(_resize(mask[None], margin)[0])


def fill_table(cube: Table, known: Mask, margin: tuple[int, int]) -> Table:
    """Return shapes ``(ny * nx, n_modes)`` on a table with ``margin`` more rows and columns around.

    Unknown samples continue the surface oddly about the nearest known one, as a tangent would:
    ``f(p) = 2 f(b) - f(2 b - p)``. Every filled sample is two known ones, for all modes at once.
    """
    shapes = _resize(np.where(known, cube, cube.dtype.type(0)), margin)
    samples = np.ascontiguousarray(shapes.reshape(len(shapes), -1).T)
    # A spline across an edge to zero would be wrong inside of it.
    target, weights = continuation(pad_mask(known, margin))
    samples[target] = weights.astype(samples.dtype) @ samples
    return samples


def _resize(planes: NDArray[np.generic], margin: tuple[int, int]) -> NDArray[np.generic]:
    grown = [(max(m, 0), max(m, 0)) for m in margin]
    cut = [slice(max(-m, 0), n - max(-m, 0)) for m, n in zip(margin, planes.shape[1:], strict=True)]
    return np.pad(planes[:, cut[0], cut[1]], [(0, 0), *grown])


def continuation(known: Mask) -> tuple[NDArray[np.intp], scipy.sparse.csr_array]:
    """Return the unknown samples and the weights ``(n_unknown, n_samples)`` that make them."""
    nearest = scipy.ndimage.distance_transform_edt(
        ~known, return_distances=False, return_indices=True
    )
    # Each unknown sample is mirrored at the known one nearest to it.
    place = np.argwhere(~known)
    edge = nearest[:, ~known].T
    mirrored = 2 * edge - place
    inside = np.all((mirrored >= 0) & (mirrored < known.shape), axis=1)
    inside[inside] = known[tuple(mirrored[inside].T)]
    at_edge = np.ravel_multi_index(tuple(edge.T), known.shape)
    # Where the mirrored sample is unknown, too, the edge takes its place: 2 f(b) - f(b) is f(b).
    at_image = at_edge.copy()
    at_image[inside] = np.ravel_multi_index(tuple(mirrored[inside].T), known.shape)
    rows = np.arange(len(place))
    weights = scipy.sparse.csr_array(
        (
            np.concatenate([np.full(len(rows), 2.0), np.full(len(rows), -1.0)]),
            (np.concatenate([rows, rows]), np.concatenate([at_edge, at_image])),
        ),
        shape=(len(rows), known.size),
    )
    return np.asarray(np.ravel_multi_index(tuple(place.T), known.shape)), weights
