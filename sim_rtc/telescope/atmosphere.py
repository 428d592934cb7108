"""Turbulence in frozen layers on endless screens.

Screens of von Karman phase are extruded row by row and never repeat. A layer moves along its wind
by whole rows. The pupil sees a square window of the newest rows through one constant
interpolation, so the slopes, or anything else that is linear in the phase, are a convolution along
the wind: as many filters as the window has columns, each as long as the window. It is done by
blocks of Fourier transforms, exact but for rounding, and costs a fifteenth of the matrix times the
phase of every step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.kinds import KarhunenLoeve
from service.model.turbulence import von_karman_covariance

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_DENSE_ROWS = 2
"""Newest rows that enter the extrusion in full."""

_FAR_ROWS = (4, 8, 16, 32, 64, 128)
"""Older rows that enter it thinned out: they hold the low frequencies (Fried & Clark 2008)."""

_FAR_STRIDE = 4
_BURN_IN_OUTER_SCALES = 6.0
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


def compute_fried_parameter_m(seeing_arcsec: float) -> float:
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
        self._weights, self._noise = _conditional(n_columns, pitch_m, turbulence)
        capacity = 8 * self._n_kept
        self._rows = np.zeros((capacity, n_columns))
        self._newest = capacity - self._n_kept
        # The rows begin at zero: after some outer scales nothing is left of that.
        self.extrude(int(_BURN_IN_OUTER_SCALES * turbulence.outer_scale_m / pitch_m))

    def extrude(self, n_rows: int = 1) -> None:
        """Add rows upwind, one after the other; the oldest are forgotten."""
        fresh = self._rng.standard_normal((n_rows, self._n_columns)) @ self._noise.T
        for row in fresh:
            # The strip is filled from its end to its beginning. At the beginning the newest rows
            # are copied back.
            if self._newest == 0:
                keep = self._rows[: self._n_kept].copy()
                self._newest = len(self._rows) - self._n_kept
                self._rows[self._newest :] = keep
            # A view: the stencil is one gather from flat memory.
            flat = self._rows.reshape(-1)[self._newest * self._n_columns :]
            row += self._weights @ flat[self._offset]
            self._newest -= 1
            self._rows[self._newest] = row

    def window(self, n_rows: int) -> Array:
        """Return a view of the newest ``n_rows`` rows, ``(n_rows, n_columns)``, newest first."""
        return self._rows[self._newest : self._newest + n_rows]


def _stencil(n_columns: int) -> NDArray[np.intp]:
    """Return ``(n, 2)`` age in rows (1: the newest) and column of the points a new row sees."""
    dense = [(age, column) for age in range(1, _DENSE_ROWS + 1) for column in range(n_columns)]
    far = [(age, column) for age in _FAR_ROWS for column in range(0, n_columns, _FAR_STRIDE)]
    return np.array(dense + far)


@lru_cache(maxsize=8)
def _conditional(n_columns: int, pitch_m: float, turbulence: KarhunenLoeve) -> tuple[Array, Array]:
    """Return A and B: the mean of a new row given the stencil, and its square-root covariance.

    Layers as wide as each other, and nights of one telescope, share them.
    """
    stencil = _stencil(n_columns)
    row = np.column_stack([np.zeros(n_columns, dtype=np.intp), np.arange(n_columns)])
    seen = _covariance(stencil, stencil, pitch_m, turbulence)
    cross = _covariance(row, stencil, pitch_m, turbulence)
    own = _covariance(row, row, pitch_m, turbulence)
    weights = scipy.linalg.cho_solve(scipy.linalg.cho_factor(seen), cross.T).T
    return weights, scipy.linalg.cholesky(own - weights @ cross.T, lower=True)


def _covariance(
    a: NDArray[np.intp], b: NDArray[np.intp], pitch_m: float, turbulence: KarhunenLoeve
) -> Array:
    """Return the covariance between lattice points; equal distances are evaluated once."""
    difference = a[:, None, :] - b[None, :, :]
    squared, where = np.unique((difference**2).sum(axis=-1), return_inverse=True)
    values = von_karman_covariance(np.sqrt(squared) * pitch_m, turbulence)
    return np.asarray(values[where].reshape(len(a), len(b)))


def _layers(*rows: tuple[float, float, float]) -> tuple[Layer, ...]:
    return tuple(
        Layer(fraction=share, speed_m_s=speed, direction_deg=direction)
        for share, speed, direction in rows
    )


PROFILES = {
    "single": _layers((1.0, 12.0, 35.0)),
    "three-layer": _layers((0.6, 7.0, 20.0), (0.25, 12.0, 75.0), (0.15, 22.0, 140.0)),
    "paranal-like": _layers(
        (0.66, 6.0, 10.0),
        (0.12, 5.0, 50.0),
        (0.09, 10.0, 95.0),
        (0.08, 28.0, 120.0),
        (0.05, 18.0, 130.0),
    ),
}
"""Share of the strength, wind speed in m/s and direction in degrees, from the ground upwards.

``paranal-like`` has what a median night at Paranal has: two thirds of the turbulence slow and near
the ground, a tenth in a fast jet stream. The work of a linear plant grows with the sum of the
speeds (12, 41 and 67 m/s): every row of a screen that passes is seen through the sensor once.
"""


Complex64 = NDArray[np.complex64]

_MARGIN_ROWS = 2
"""Rows beyond the pupil that the cubic interpolation reaches."""

_TAPS = np.arange(-1, 3)
"""Rows, and columns, that a cubic interpolation reads around a point."""

_ROWS_TOGETHER = 128
_LENGTH = 1.5
"""Length of a transform relative to the window. Longer transforms need more memory, shorter ones
are more numerous."""

_OUTPUTS_TOGETHER = 1024
"""Outputs of a matrix transformed together. All of an ELT's would take 16 GB for 5 that are kept.
"""

_BLOCKS_TOGETHER = 10
"""Blocks answered at a time: the spectra are read from memory once for all of them."""


class PhaseResponse:
    """A matrix that acts on the phase over the pupil, and its spectra along the winds."""

    def __init__(self, matrix: Array32) -> None:
        self.matrix = matrix
        """``(n_outputs, n_points)`` per metre of OPD."""
        self._spectra: dict[FrozenLayer, Complex64] = {}

    def spectra(self, layer: FrozenLayer) -> Complex64:
        """Return the filters of a layer ``(n_frequencies, n_columns, n_outputs)``.

        They take a second to compute and are kept.
        """
        if layer not in self._spectra:
            self._spectra[layer] = layer.filters(self.matrix)
        return self._spectra[layer]


class FrozenLayer:
    """One layer as the pupil's points see it, step by step of a row of its screen.

    Steps are numbered from 0. Those that were reached last are kept.
    """

    def __init__(
        self,
        layer: Layer,
        *,
        points_m: Array,
        pitch_m: float,
        turbulence: KarhunenLoeve,
        rng: np.random.Generator,
    ) -> None:
        """Take the strength of all layers together, and the pupil's points ``(n_points, 2)``."""
        angle = np.deg2rad(layer.direction_deg)
        along = points_m @ [np.cos(angle), np.sin(angle)] / pitch_m
        across = points_m @ [-np.sin(angle), np.cos(angle)] / pitch_m
        radius = np.hypot(along, across).max()
        self._n_rows = int(np.ceil(2 * radius)) + 2 * _MARGIN_ROWS + 1
        centre = (self._n_rows - 1) / 2
        self._reading = _build_reader(along + centre, across + centre, self._n_rows)
        self._length = scipy.fft.next_fast_len(int(_LENGTH * self._n_rows), real=True)
        self._block_steps = self._length - self._n_rows + 1
        self._screen = ExtrudedScreen(
            n_columns=self._n_rows,
            n_kept=self._n_rows + _ROWS_TOGETHER,
            pitch_m=pitch_m,
            turbulence=turbulence,
            rng=rng,
        )
        # The fraction is of Cn², and so of the variance.
        self._amplitude = np.sqrt(layer.fraction)
        # Oldest first: the row at n_rows - 1 + k is the newest one that step first_step + k sees.
        newest_first = self._screen.window(self._n_rows - 1)
        self._rows: Array32 = (self._amplitude * newest_first[::-1]).astype(np.float32)
        self._first_step = 0
        self._answers: dict[PhaseResponse, Array32] = {}
        self._asked: set[PhaseResponse] = set()
        self.steps_per_second = layer.speed_m_s / pitch_m
        """Rows the wind moves by in a second."""

    @property
    def _n_steps(self) -> int:
        """Number of stored steps."""
        return len(self._rows) - self._n_rows + 1

    def reach(self, first_step: int, last_step: int) -> None:
        """Go on to the last step if it is not there yet, and forget those before the first."""
        n_missing = last_step + 1 - self._first_step - self._n_steps
        if n_missing <= 0:
            return
        passed = min(first_step - self._first_step, self._n_steps)
        self._first_step += passed
        # Responses that were not requested since the last time belong to optics that are no longer
        # used.
        self._answers = {one: self._answers[one][passed:] for one in self._asked}
        self._asked.clear()
        together = _BLOCKS_TOGETHER * self._block_steps
        # Rounded up to whole blocks, for which the Fourier transforms are made.
        n_new = -(-n_missing // together) * together
        self._rows = np.concatenate([self._rows[passed:], *self._extrude_rows(n_new)])

    def phases(self, steps: NDArray[np.intp], weights: Array32, *, apart: bool = False) -> Array32:
        """Return sums of the OPD at steps, ``(n_frames, n_points)``, metres, without their piston.

        ``steps`` and ``weights`` are ``(n_frames, n_steps)``. Frames that are far ``apart`` are
        read themselves. For others only the steps around them are read, which are fewer.
        """
        known, place = np.unique(steps, return_inverse=True)
        near = np.zeros((len(steps), len(known)), dtype=np.float32)
        near[np.arange(len(steps))[:, None], place.reshape(steps.shape)] = weights
        windows = self._windows(known)
        return self._read(near @ windows) if apart else np.asarray(near @ self._read(windows))

    def responses(self, first_step: int, response: PhaseResponse) -> Array32:
        """Return a response to the phase ``(n_steps, n_outputs)`` from a step on."""
        known = self._answers.get(response)
        n_known = 0 if known is None else len(known)
        if n_known < self._n_steps:
            new = self._filter_rows(self._rows[n_known:], response.spectra(self))
            self._answers[response] = new if known is None else np.concatenate([known, new])
        self._asked.add(response)
        return self._answers[response][first_step - self._first_step :]

    def filters(self, matrix: Array32) -> Complex64:
        """Return the spectra of the filters that make ``matrix @ phase`` of the rows."""
        shape = (self._length // 2 + 1, self._n_rows, len(matrix))
        spectra = np.empty(shape, np.complex64)
        for start in range(0, len(matrix), _OUTPUTS_TOGETHER):
            outputs = slice(start, start + _OUTPUTS_TOGETHER)
            part = matrix[outputs]
            cells = self._reading.T @ np.ascontiguousarray(part.T)
            # The mean of the window is taken out of the phase; here it is taken out of the filter
            # instead.
            cells -= part.sum(axis=1) / np.float32(len(cells))
            filters = cells.reshape(self._n_rows, self._n_rows, -1)
            spectra[:, :, outputs] = scipy.fft.rfft(filters, self._length, axis=0)
        return spectra

    def _windows(self, step: NDArray[np.intp]) -> Array32:
        """Return the windows over the pupil at these steps, ``(n_steps, n_rows²)``, mean 0."""
        newest = step - self._first_step + self._n_rows - 1
        windows = self._rows[newest[:, None] - np.arange(self._n_rows)].reshape(len(step), -1)
        # No sensor sees piston, which is larger than the rest: without it float32 keeps more
        # digits.
        windows -= windows.mean(axis=1, keepdims=True)
        return np.asarray(windows)

    def _read(self, windows: Array32) -> Array32:
        """Return the phase at the pupil's points, of windows, ``(n_windows, n_points)``."""
        return np.asarray((self._reading @ windows.T).T)

    def _filter_rows(self, rows: Array32, spectra: Complex64) -> Array32:
        """Return the outputs ``(n_steps, n_outputs)`` of all windows in these rows."""
        n_steps = len(rows) - self._n_rows + 1
        n_blocks = -(-n_steps // self._block_steps)
        n_padded = (n_blocks - 1) * self._block_steps + self._length
        padded = np.zeros((n_padded, self._n_rows), dtype=np.float32)
        padded[: len(rows)] = rows
        blocks = sliding_window_view(padded, self._length, axis=0)[:: self._block_steps]
        parts = np.ascontiguousarray(scipy.fft.rfft(blocks, axis=2).transpose(2, 0, 1))
        # The first n_rows - 1 outputs of a circular convolution wrap around (overlap-save).
        answers = scipy.fft.irfft(parts @ spectra, self._length, axis=0)[self._n_rows - 1 :]
        return np.asarray(answers.transpose(1, 0, 2).reshape(-1, spectra.shape[2])[:n_steps])

    def _extrude_rows(self, n_rows: int) -> list[Array32]:
        """Return the next rows, oldest first, in pieces."""
        pieces = []
        for start in range(0, n_rows, _ROWS_TOGETHER):
            n = min(_ROWS_TOGETHER, n_rows - start)
            self._screen.extrude(n)
            piece = self._amplitude * self._screen.window(n)[::-1]
            pieces.append(piece.astype(np.float32))
        return pieces


def build_layers(
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
            replace(layer, fraction=layer.fraction / total),
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


def _build_reader(row: Array, column: Array, n_rows: int) -> scipy.sparse.csr_array:
    """Return the matrix ``(n_points, n_rows²)`` that reads points of a window, newest row first."""
    row0, column0 = np.floor(row), np.floor(column)
    rows = row0[:, None].astype(np.intp) + _TAPS
    columns = column0[:, None].astype(np.intp) + _TAPS
    cells = rows[:, :, None] * n_rows + columns[:, None, :]
    weights = cubic_weights(row - row0)[:, :, None] * cubic_weights(column - column0)[:, None, :]
    pointer = np.arange(0, cells.size + 1, _TAPS.size**2)
    return scipy.sparse.csr_array(
        (weights.astype(np.float32).reshape(-1), cells.reshape(-1), pointer),
        shape=(len(row), n_rows**2),
    )
