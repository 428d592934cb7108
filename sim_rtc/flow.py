"""Frozen flow over the pupil: what the pupil, and all that is linear in its phase, see of a layer.

A layer moves along its wind by whole rows of its screen. The pupil sees a square window of the
newest rows through one constant interpolation, so the slopes, or anything else that is linear in
the phase, are a convolution along the wind: as many filters as the window has columns, each as
long as the window. It is done by blocks of Fourier transforms, exact but for rounding, and costs a
fifteenth of the matrix times the phase of every step.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.sparse import csr_array

from service.errors import ModelError
from service.model.instrument import KarhunenLoeve
from sim_rtc.atmosphere import ExtrudedScreen, Layer

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Complex64 = NDArray[np.complex64]

_MARGIN_ROWS = 2
"""Rows beyond the pupil that the cubic interpolation reaches."""

_TAPS = np.arange(-1, 3)
"""Rows, and columns, that a cubic interpolation reads around a point."""

_ROWS_TOGETHER = 128
_LENGTH = 1.5
"""Of a transform, over that of the window: longer ones need more memory, shorter ones more of
them."""

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
        self._reading = _reading(along + centre, across + centre, self._n_rows)
        self._length = next_fast_len(int(_LENGTH * self._n_rows), real=True)
        self._block_steps = self._length - self._n_rows + 1
        self._screen = ExtrudedScreen(
            n_columns=self._n_rows,
            n_kept=self._n_rows + _ROWS_TOGETHER,
            pitch_m=pitch_m,
            turbulence=turbulence,
            rng=rng,
        )
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
        """Steps that are kept."""
        return len(self._rows) - self._n_rows + 1

    def reach(self, first_step: int, last_step: int) -> None:
        """Go on to the last step if it is not there yet, and forget those before the first."""
        n_missing = last_step + 1 - self._first_step - self._n_steps
        if n_missing <= 0:
            return
        passed = min(first_step - self._first_step, self._n_steps)
        self._first_step += passed
        self._answers = {one: self._answers[one][passed:] for one in self._asked}
        self._asked.clear()
        together = _BLOCKS_TOGETHER * self._block_steps
        n_new = -(-n_missing // together) * together
        self._rows = np.concatenate([self._rows[passed:], *self._extruded(n_new)])

    def phases(self, steps: NDArray[np.intp], weights: Array32, *, apart: bool = False) -> Array32:
        """Return sums of the OPD at steps, ``(n_frames, n_points)``, metres, without their piston.

        ``steps`` and ``weights`` are ``(n_frames, n_steps)``. Frames that lie ``apart`` are read
        themselves, of others the steps that they lie between: these are fewer.
        """
        known, place = np.unique(steps, return_inverse=True)
        near = np.zeros((len(steps), len(known)), dtype=np.float32)
        near[np.arange(len(steps))[:, None], place.reshape(steps.shape)] = weights
        windows = self._windows(known)
        return self._read(near @ windows) if apart else np.asarray(near @ self._read(windows))

    def responses(self, first_step: int, response: PhaseResponse) -> Array32:
        """Return what a response makes of the phase ``(n_steps, n_outputs)`` from a step on."""
        known = self._answers.get(response)
        n_known = 0 if known is None else len(known)
        if n_known < self._n_steps:
            new = self._filtered(self._rows[n_known:], response.spectra(self))
            self._answers[response] = new if known is None else np.concatenate([known, new])
        self._asked.add(response)
        return self._answers[response][first_step - self._first_step :]

    def filters(self, matrix: Array32) -> Complex64:
        """Return the spectra of the filters that make ``matrix @ phase`` of the rows."""
        cells = self._reading.T @ np.ascontiguousarray(matrix.T)
        cells -= matrix.sum(axis=1) / np.float32(len(cells))
        filters = cells.reshape(self._n_rows, self._n_rows, -1)
        return np.asarray(rfft(filters, self._length, axis=0))

    def _windows(self, step: NDArray[np.intp]) -> Array32:
        """Return what lies before the pupil at these steps, ``(n_steps, n_rows²)``, mean 0."""
        newest = step - self._first_step + self._n_rows - 1
        windows = self._rows[newest[:, None] - np.arange(self._n_rows)].reshape(len(step), -1)
        windows -= windows.mean(axis=1, keepdims=True)
        return np.asarray(windows)

    def _read(self, windows: Array32) -> Array32:
        """Return what the pupil's points see in windows, ``(n_windows, n_points)``."""
        return np.asarray((self._reading @ windows.T).T)

    def _filtered(self, rows: Array32, spectra: Complex64) -> Array32:
        """Return the outputs ``(n_steps, n_outputs)`` of all windows in these rows."""
        n_steps = len(rows) - self._n_rows + 1
        n_blocks = -(-n_steps // self._block_steps)
        n_padded = (n_blocks - 1) * self._block_steps + self._length
        padded = np.zeros((n_padded, self._n_rows), dtype=np.float32)
        padded[: len(rows)] = rows
        blocks = sliding_window_view(padded, self._length, axis=0)[:: self._block_steps]
        parts = np.ascontiguousarray(rfft(blocks, axis=2).transpose(2, 0, 1))
        answers = irfft(parts @ spectra, self._length, axis=0)[self._n_rows - 1 :]
        return np.asarray(answers.transpose(1, 0, 2).reshape(-1, spectra.shape[2])[:n_steps])

    def _extruded(self, n_rows: int) -> list[Array32]:
        """Return the next rows, oldest first, in pieces."""
        pieces = []
        for start in range(0, n_rows, _ROWS_TOGETHER):
            n = min(_ROWS_TOGETHER, n_rows - start)
            self._screen.extrude(n)
            piece = self._amplitude * self._screen.window(n)[::-1]
            pieces.append(piece.astype(np.float32))
        return pieces


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


def _reading(row: Array, column: Array, n_rows: int) -> csr_array:
    """Return the matrix ``(n_points, n_rows²)`` that reads points of a window, newest row first."""
    row0, column0 = np.floor(row), np.floor(column)
    rows = row0[:, None].astype(np.intp) + _TAPS
    columns = column0[:, None].astype(np.intp) + _TAPS
    cells = rows[:, :, None] * n_rows + columns[:, None, :]
    weights = cubic_weights(row - row0)[:, :, None] * cubic_weights(column - column0)[:, None, :]
    pointer = np.arange(0, cells.size + 1, _TAPS.size**2)
    return csr_array(
        (weights.astype(np.float32).reshape(-1), cells.reshape(-1), pointer),
        shape=(len(row), n_rows**2),
    )
