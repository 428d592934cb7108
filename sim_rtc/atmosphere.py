"""Frozen-flow turbulence: screens that never repeat, translated in whole rows.

Each layer is extruded row by row along its own wind, so the pupil sees it through one constant
interpolation matrix. Whatever is linear in the phase (the slopes above all) can then be computed
once per row and interpolated in time: the weights are the same all over the pupil.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky
from scipy.sparse import csr_array

from service.errors import ModelError
from service.model.instrument import KarhunenLoeve
from service.model.turbulence import von_karman_covariance

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_DENSE_ROWS = 2
"""Newest rows that enter the extrusion in full."""

_FAR_ROWS = (4, 8, 16, 32, 64, 128)
"""Older rows that enter it thinned out: they hold the low frequencies (Fried & Clark 2008)."""

_FAR_STRIDE = 4
_BURN_IN_OUTER_SCALES = 6.0
_MARGIN_ROWS = 2
"""Rows beyond the pupil that the cubic interpolation reaches."""

_TOGETHER = 128
"""Steps read at a time."""

_POINTS_TOGETHER = 512
"""Points read at a time: with these steps they stay in a processor's cache."""

_TAPS = 4
"""Rows, or columns, that a cubic interpolation reads."""

_SEEING_COEFFICIENT = 0.98
_ARCSEC_RAD = np.pi / 180.0 / 3600.0
_SEEING_WAVELENGTH_M = 500e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """One turbulent layer carried by the wind."""

    fraction: float
    """Share of the turbulence strength (Cn² dh); the layers' shares are normalised to 1."""

    speed_m_s: float
    """Wind speed in the pupil plane, metres per second."""

    direction_deg: float
    """Direction the layer moves towards, degrees from sensor +x towards +y."""


def fried_parameter_m(seeing_arcsec: float) -> float:
    """Return r0 at 500 nm, metres, of this seeing (FWHM at 500 nm, infinite outer scale)."""
    return _SEEING_COEFFICIENT * _SEEING_WAVELENGTH_M / (seeing_arcsec * _ARCSEC_RAD)


class ExtrudedScreen:
    """An endless strip of von Karman phase: every call adds one row that fits those before it.

    A new row is ``A z + B w``: z the newest rows (two in full, older ones thinned out), w white
    noise, A and B such that the covariance of all of them is exactly von Karman's.

    References
    ----------
    Assemat, Wilson & Gendron 2006, Opt. Express 14, 988; Fried & Clark 2008, JOSA A 25, 463.
    """

    def __init__(
        self,
        *,
        n_columns: int,
        n_kept: int,
        pitch_m: float,
        turbulence: KarhunenLoeve,
        rng: np.random.Generator,
    ) -> None:
        self._rng = rng
        self._n_columns = n_columns
        self._n_kept = max(n_kept, _FAR_ROWS[-1])
        stencil = _stencil(n_columns)
        self._offset = (stencil[:, 0] - 1) * n_columns + stencil[:, 1]
        self._weights, self._noise = _conditional(stencil, n_columns, pitch_m, turbulence)
        capacity = 8 * self._n_kept
        self._rows = np.zeros((capacity, n_columns))
        self._newest = capacity - self._n_kept
        self.extrude(int(_BURN_IN_OUTER_SCALES * turbulence.outer_scale_m / pitch_m))

    def extrude(self, n_rows: int = 1) -> None:
        """Add rows upwind, one after the other; the oldest are forgotten."""
        fresh = self._rng.standard_normal((n_rows, self._n_columns)) @ self._noise.T
        for row in fresh:
            if self._newest == 0:
                keep = self._rows[: self._n_kept].copy()
                self._newest = len(self._rows) - self._n_kept
                self._rows[self._newest :] = keep
            flat = self._rows.reshape(-1)[self._newest * self._n_columns :]
            row += self._weights @ flat[self._offset]
            self._newest -= 1
            self._rows[self._newest] = row

    def window(self, n_rows: int) -> Array:
        """Return a view of the newest ``n_rows`` rows, ``(n_rows, n_columns)``, newest first."""
        return self._rows[self._newest : self._newest + n_rows]


class FrozenLayer:
    """One layer seen by the plant's pupil points, advanced in steps of one screen row."""

    def __init__(
        self,
        layer: Layer,
        *,
        points_m: Array,
        pitch_m: float,
        turbulence: KarhunenLoeve,
        rng: np.random.Generator,
    ) -> None:
        angle = np.deg2rad(layer.direction_deg)
        along = points_m @ [np.cos(angle), np.sin(angle)] / pitch_m
        across = points_m @ [-np.sin(angle), np.cos(angle)] / pitch_m
        radius = np.hypot(along, across).max()
        self._n_rows = int(np.ceil(2 * radius)) + 2 * _MARGIN_ROWS + 1
        centre = (self._n_rows - 1) / 2
        self._sample = _CubicSampling(along + centre, across + centre, self._n_rows)
        self._screen = ExtrudedScreen(
            n_columns=self._n_rows,
            n_kept=self._n_rows + _TOGETHER,
            pitch_m=pitch_m,
            turbulence=turbulence,
            rng=rng,
        )
        self._amplitude = np.sqrt(layer.fraction)
        self.steps_per_second = layer.speed_m_s / pitch_m
        """Rows the wind moves by in a second."""

    def advance(self, n_steps: int) -> Array32:
        """Return the pupil phase after each of the next steps, ``(n_steps, n_points)``, metres."""
        out = np.empty((n_steps, self._sample.n_points), dtype=np.float32)
        for start in range(0, n_steps, _TOGETHER):
            rows = out[start : start + _TOGETHER]
            self._screen.extrude(len(rows))
            strip = self._screen.window(self._n_rows + len(rows) - 1)
            self._sample.read(strip, rows[::-1])
        out *= self._amplitude
        return out


def frozen_layers(
    layers: tuple[Layer, ...],
    *,
    points_m: Array,
    pitch_m: float,
    turbulence: KarhunenLoeve,
    rng: np.random.Generator,
) -> tuple[FrozenLayer, ...]:
    """Return the layers as the pupil points ``(n_points, 2)`` see them, shares normalised.

    Raises
    ------
    ModelError
        If there is no layer, or a share or a speed is not positive.
    """
    if not layers or any(layer.fraction <= 0 or layer.speed_m_s <= 0 for layer in layers):
        raise ModelError(f"atmosphere: found {layers}; expected shares > 0 and speeds > 0")
    total = sum(layer.fraction for layer in layers)
    return tuple(
        FrozenLayer(
            Layer(
                fraction=layer.fraction / total,
                speed_m_s=layer.speed_m_s,
                direction_deg=layer.direction_deg,
            ),
            points_m=points_m,
            pitch_m=pitch_m,
            turbulence=turbulence,
            rng=child,
        )
        for layer, child in zip(layers, rng.spawn(len(layers)), strict=True)
    )


def cubic_weights(fraction: Array) -> Array:
    """Return the Catmull-Rom weights ``(..., 4)`` of the taps at -1, 0, 1, 2 for positions 0..1."""
    t = np.asarray(fraction, dtype=np.float64)
    return np.stack(
        [
            ((-0.5 * t + 1.0) * t - 0.5) * t,
            (1.5 * t - 2.5) * t * t + 1.0,
            ((-1.5 * t + 2.0) * t + 0.5) * t,
            (0.5 * t - 0.5) * t * t,
        ],
        axis=-1,
    )


def _stencil(n_columns: int) -> NDArray[np.intp]:
    """Return ``(n, 2)`` age in rows (1: the newest) and column of the points a new row sees."""
    dense = [(age, column) for age in range(1, _DENSE_ROWS + 1) for column in range(n_columns)]
    far = [(age, column) for age in _FAR_ROWS for column in range(0, n_columns, _FAR_STRIDE)]
    return np.array(dense + far)


def _conditional(
    stencil: NDArray[np.intp], n_columns: int, pitch_m: float, turbulence: KarhunenLoeve
) -> tuple[Array, Array]:
    """Return A and B: the mean of a new row given the stencil, and its square-root covariance."""
    row = np.column_stack([np.zeros(n_columns, dtype=np.intp), np.arange(n_columns)])
    seen = _covariance(stencil, stencil, pitch_m, turbulence)
    cross = _covariance(row, stencil, pitch_m, turbulence)
    own = _covariance(row, row, pitch_m, turbulence)
    weights = cho_solve(cho_factor(seen), cross.T).T
    return weights, cholesky(own - weights @ cross.T, lower=True)


def _covariance(
    a: NDArray[np.intp], b: NDArray[np.intp], pitch_m: float, turbulence: KarhunenLoeve
) -> Array:
    """Return the covariance between lattice points; equal distances are evaluated once."""
    difference = a[:, None, :] - b[None, :, :]
    squared, where = np.unique((difference**2).sum(axis=-1), return_inverse=True)
    values = von_karman_covariance(np.sqrt(squared) * pitch_m, turbulence)
    return np.asarray(values[where].reshape(len(a), len(b)))


class _CubicSampling:
    """Reads square windows of a strip at the same fractional rows and columns in each.

    The next window is the same strip a row on. So columns are interpolated once per row of the
    strip and point, and rows after that: 8 products a point and window, where 16 taps would be.
    """

    def __init__(self, row: Array, column: Array, n_rows: int) -> None:
        """Take positions ``(n_points,)`` in windows of ``n_rows`` rows and columns."""
        row0, column0 = np.floor(row), np.floor(column)
        self.n_points = len(row)
        self._n_rows = n_rows
        self._row_weights = cubic_weights(row - row0).astype(np.float32)
        columns = column0[:, None].astype(np.intp) + np.arange(-1, 3)
        index = columns * n_rows + row0[:, None].astype(np.intp) - 1
        weights = cubic_weights(column - column0).astype(np.float32)
        self._pieces = [
            (piece, _reading(index[piece], weights[piece], n_rows**2))
            for piece in (
                slice(first, first + _POINTS_TOGETHER)
                for first in range(0, len(row), _POINTS_TOGETHER)
            )
        ]

    def read(self, strip: Array, out: Array32) -> None:
        """Put what the points see into ``out`` ``(n_windows, n_points)``, window means taken off.

        ``strip`` is ``(n_rows + n_windows - 1, n_columns)``; window k begins at its row k.
        """
        n_windows, reach = len(out), len(out) + _TAPS - 1
        # Three rows more for the taps: those of the last windows reach no further than its end.
        padded = np.zeros((strip.shape[1], len(strip) + _TAPS - 1), dtype=np.float32)
        padded[:, : len(strip)] = (strip - strip.mean()).T
        runs = sliding_window_view(padded, reach, axis=1).reshape(-1, reach)
        means = sliding_window_view(padded.mean(axis=0), self._n_rows)[:n_windows].mean(axis=1)
        for piece, reading in self._pieces:
            across, weights = reading @ runs, self._row_weights[piece]
            seen = across[:, :n_windows] * weights[:, :1]
            for tap in range(1, _TAPS):
                seen += across[:, tap : tap + n_windows] * weights[:, tap : tap + 1]
            seen -= means
            out[:, piece] = seen.T


def _reading(index: NDArray[np.intp], weights: Array32, n_cells: int) -> csr_array:
    """Return the matrix that adds up these cells, ``(n_points, n_taps)``, with their weights."""
    n_points, n_taps = index.shape
    pointer = np.arange(0, n_taps * n_points + 1, n_taps)
    return csr_array((weights.reshape(-1), index.reshape(-1), pointer), shape=(n_points, n_cells))
