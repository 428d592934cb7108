"""Modes measured on a grid: a cubic spline, evaluated wherever the registration puts them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.filling import filled, padded
from service.model.instrument import Instrument, TabulatedModes
from service.model.turbulence import expected_variance

Array = NDArray[np.float64]

MARGIN_SUBAP = 3.0
"""Surface kept around the nominal pupil: what the largest shift and magnification can reach."""

LEAST_POINTS_PER_SUBAPERTURE = 2.0
"""Below, the table itself has lost the high modes."""

ENOUGH_POINTS_PER_SUBAPERTURE = 4.0
"""0.45 % of error at mode 400; 2 points give 3 %."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TabulatedBasis:
    """Measured modes, in the units of their owner, between the points of their table."""

    instrument: Instrument
    """Whose modes they are; its turbulence is what they are expected to meet."""

    coefficients: NDArray[np.floating]
    """``(ny * nx, n_modes)`` weights of the B-splines at every table point."""

    surface_known: NDArray[np.bool_]
    """``(ny, nx)``: where the table says something, the margin around it included."""

    step_subap: float
    """Step of the table along both axes, in subapertures."""

    y_sign: float = 1.0
    """-1: the mirror is seen from behind."""

    @property
    def n_modes(self) -> int:
        """Modes of the basis."""
        return int(self.coefficients.shape[1])

    @cached_property
    def variance_m2(self) -> Array:
        """``(n_modes,)`` expected variance of each mode under the turbulence, its unit squared."""
        return expected_variance(self.instrument, self.render)

    def render(self, points: Array) -> Array:
        """Return the modes ``(n_points, n_modes)`` at mirror ``points`` ``(n_points, 2)``."""
        (rows, y), (columns, x) = self._splines(points)
        return self._combined(rows, columns, _outer(y[0], x[0]))

    def render_slope(self, points: Array, direction: Array) -> Array:
        """Return the derivative of the modes along ``direction``, ``(n_points, n_modes)``."""
        (rows, y), (columns, x) = self._splines(points)
        along_x = direction[:, 0] / self.step_subap
        along_y = direction[:, 1] * self.y_sign / self.step_subap
        weights = along_x[:, None, None] * _outer(y[0], x[1])
        weights += along_y[:, None, None] * _outer(y[1], x[0])
        return self._combined(rows, columns, weights)

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
        """Return a basis of these modes only."""
        return replace(self, coefficients=np.ascontiguousarray(self.coefficients[:, indices]))

    def combined(self, weights: Array) -> TabulatedBasis:
        """Return a basis of combinations of the modes, ``weights`` ``(n_modes, n_combined)``."""
        return replace(self, coefficients=self.coefficients @ weights)

    def mirrored(self) -> TabulatedBasis:
        """Return the same modes of the mirror seen from its other side."""
        return replace(self, y_sign=-self.y_sign)

    def _place(self, points: Array) -> Array:
        """Return where points lie in the table, ``(n_points, 2)``: row and column."""
        centre = (np.array(self.surface_known.shape) - 1) / 2
        return np.asarray(points[:, ::-1] * [self.y_sign, 1.0] / self.step_subap + centre)

    def _splines(self, points: Array) -> tuple[tuple[NDArray[np.intp], tuple[Array, Array]], ...]:
        """Return for y and x the four table lines around every point, weights and their slopes."""
        found = []
        for n, place in zip(self.surface_known.shape, self._place(points).T, strict=True):
            cell = np.clip(np.floor(place).astype(np.intp), 0, n - 2)
            lines = cell[:, None] + np.arange(-1, 3)
            lines = np.where(lines < 0, -lines, np.where(lines > n - 1, 2 * (n - 1) - lines, lines))
            found.append((lines, _cubic(np.clip(place - cell, 0.0, 1.0))))
        return tuple(found)

    def _combined(self, rows: NDArray[np.intp], columns: NDArray[np.intp], weights: Array) -> Array:
        n_points = len(rows)
        index = rows[:, :, None] * self.surface_known.shape[1] + columns[:, None, :]
        matrix = scipy.sparse.csr_array(
            (
                weights.astype(self.coefficients.dtype).ravel(),
                index.astype(np.int32).ravel(),
                np.arange(0, 16 * n_points + 1, 16, dtype=np.int32),
            ),
            shape=(n_points, len(self.coefficients)),
        )
        return np.asarray(matrix @ self.coefficients)


def tabulated_basis(instrument: Instrument, table: TabulatedModes) -> TabulatedBasis:
    """Return the spline through a table of modes, continued smoothly where nothing is known.

    Raises
    ------
    ModelError
        If the table is too coarse for the sensor.
    """
    step = table.pitch_m / instrument.subaperture_m
    if step > 1.0 / LEAST_POINTS_PER_SUBAPERTURE:
        raise ModelError(
            f"modes: found a table of {1 / step:.2f} points per subaperture; expected at least "
            f"{LEAST_POINTS_PER_SUBAPERTURE:g}, {ENOUGH_POINTS_PER_SUBAPERTURE:g} for good"
        )
    reach = (instrument.wfs.pupil_diameter / 2 + MARGIN_SUBAP) / step
    ny, nx = table.known.shape
    margin = (int(np.ceil(reach - (ny - 1) / 2)), int(np.ceil(reach - (nx - 1) / 2)))
    known = padded(table.known, margin)
    if not known.any():
        raise ModelError("modes: found a table that knows nothing of the surface over the pupil")
    samples = filled(table.cube, table.known, margin)
    for mode in samples.T:
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


def _cubic(fraction: Array) -> tuple[Array, Array]:
    """Return the four cubic B-splines over a cell, and their derivatives, ``(n_points, 4)``."""
    t, s = fraction, 1.0 - fraction
    values = [s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3]
    slopes = [-(s**2), 3 * t**2 - 4 * t, 4 * s - 3 * s**2, t**2]
    return np.column_stack(values) / 6.0, np.column_stack(slopes) / 2.0


def _outer(y: Array, x: Array) -> Array:
    """Return the products of weights along y and x, ``(n_points, 4, 4)``."""
    return np.asarray(y[:, :, None] * x[:, None, :])
