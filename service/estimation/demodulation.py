"""Demodulation of telemetry at the lines of a dither and at frequencies next to them.

The direct way multiplies every frame by the sine and cosine of every bin. It is too slow for 37
bins per line in real time. Relative to its line a bin rotates slowly, so within a short segment of
frames the weights ``h_k``, ``h_k cos(v k)`` and ``h_k sin(v k)`` (Hann window h, any offset v) are
combinations of a few smooth shapes. Frames are therefore multiplied by each line times each of
these shapes only; the bins are combinations of the sums, a tenth of the work, exact up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

SIDE_OFFSETS_HZ = np.concatenate([np.arange(-20.0, -2.0), np.arange(3.0, 21.0)])
"""Frequencies at which the noise is measured, relative to each dither line. 36 bins; 6 were too
few."""

SEGMENT_S = 0.12
"""Duration of a segment. Longer segments need more shapes, shorter ones more sums."""

MIN_SEGMENT_FRAMES = 16

MIN_SHAPE_RATIO = 1e-7
"""Shapes weaker than this fraction of the strongest are below rounding in every bin."""

_COLUMNS_AT_ONCE = 256
"""Columns that are added at once: products of all would take twice the memory of their sums."""

_OFFSETS_HZ = np.unique(np.abs(SIDE_OFFSETS_HZ))
_N_SHAPES = 1 + 2 * len(_OFFSETS_HZ)


@dataclass(frozen=True, slots=True, kw_only=True)
class DemodulationBank:
    """The bins of a window: each line and ``SIDE_OFFSETS_HZ`` next to it, with a Hann weight."""

    lines_hz: tuple[float, ...]
    frame_rate_hz: float
    n_frames: int
    """Length of the window."""

    def empty(self, n_columns: int) -> Array:
        """Return sums over no frames yet, ``(n_lines, 2, n_shapes, n_columns)``.

        The second axis has the real and the imaginary parts.
        """
        return np.zeros((len(self.lines_hz), 2, _N_SHAPES, n_columns), np.float32)

    def add(self, sums: Array, columns: Array, place: int) -> None:
        """Add frames ``(n, n_columns)`` to the sums; the first is frame ``place`` of the window."""
        length = _smooth(self.frame_rate_hz, self.n_frames).shape[1]
        end = place + len(columns)
        cuts = [place, *range(place // length * length + length, end, length), end]
        segments = [first // length for first in cuts[:-1]]
        shaped = [_shaped_lines(self, index) for index in segments]
        bins = np.hstack([_segment(self, index)[1] for index in segments])
        n_columns, by_shape = columns.shape[1], sums.transpose(2, 1, 0, 3)
        for start in range(0, n_columns, _COLUMNS_AT_ONCE):
            some = slice(start, min(start + _COLUMNS_AT_ONCE, n_columns))
            width = some.stop - start
            found = np.empty((len(segments), len(shaped[0]), width), np.float32)
            for lines, (first, stop), part in zip(shaped, pairwise(cuts), found, strict=True):
                here = slice(first % length, first % length + stop - first)
                frames = columns[first - place : stop - place, some]
                np.matmul(lines[:, here], frames, out=part)
            product = bins @ found.reshape(bins.shape[1], -1)
            by_shape[..., some] += product.reshape(*by_shape.shape[:3], width)

    def at_bins(self, sums: Array) -> Array:
        """Return ``(n_lines, 1 + n_side, n_columns)`` sums of ``h_k x_k exp(-i w k)``.

        They replace the sums of the shapes in memory: with a hundred lines both have 60 MB.
        """
        which = np.searchsorted(_OFFSETS_HZ, np.abs(SIDE_OFFSETS_HZ))
        # Shapes are kept for positive offsets only. cos(-v k) = cos(v k) and sin(-v k) = -sin(v k)
        # give the negative ones.
        turning = (1j * np.sign(SIDE_OFFSETS_HZ)).astype(np.complex64)[:, None]
        found = sums.reshape(-1).view(np.complex64).reshape(len(sums), 1 + len(which), -1)
        for (real, imaginary), bins in zip(sums, found, strict=True):
            shapes = real + np.complex64(1j) * imaginary
            cosines, sines = np.split(shapes[1:], 2)
            bins[0] = shapes[0]
            bins[1:] = cosines[which] - turning * sines[which]
        return found

    def at_lines(self, columns: Array, place: int) -> Array:
        """Return ``(2 * n_lines, n_columns)`` sums at the lines: real parts, imaginary ones."""
        frames = place + np.arange(len(columns))
        return np.asarray((_lines(self, frames) * _hann(self.n_frames, frames)) @ columns)


@lru_cache(maxsize=48)
def _segment(bank: DemodulationBank, index: int) -> tuple[Array, Array]:
    """Return lines and bins of one segment, which are the same in every window.

    ``(2 * n_lines, length)`` both parts of each line, and ``(n_shapes, n_smooth)`` the matrix that
    leads from smooth shapes to bins: of 1, the cosines, then the sines.
    """
    smooth = _smooth(bank.frame_rate_hz, bank.n_frames)
    length = smooth.shape[1]
    frames = index * length + np.arange(length)
    turns = np.outer(_OFFSETS_HZ / bank.frame_rate_hz, frames)
    turning = np.vstack([np.ones(length), *cosines_and_sines(turns)])
    bins = np.asarray((turning * _hann(bank.n_frames, frames)) @ smooth.T, np.float32)
    return _lines(bank, frames), bins


@lru_cache(maxsize=4)
def _shaped_lines(bank: DemodulationBank, index: int) -> Array:
    """Return ``(n_smooth * 2 * n_lines, length)``: each smooth shape times both parts of each line.

    Only those in use are kept: with a hundred lines a segment has 1.4 MB, a window twenty segments.
    """
    smooth, (lines, _) = _smooth(bank.frame_rate_hz, bank.n_frames), _segment(bank, index)
    return np.asarray((smooth[:, None] * lines).reshape(-1, smooth.shape[1]))


@lru_cache(maxsize=4)
def _smooth(frame_rate_hz: float, n_frames: int) -> Array:
    """Return orthonormal shapes ``(n_smooth, length)`` that span all bins within a segment."""
    length = max(round(SEGMENT_S * frame_rate_hz), MIN_SEGMENT_FRAMES)
    # A Hann window is a constant plus one period: it shifts a frequency by one bin either way.
    weight_hz = np.array([-1.0, 0.0, 1.0]) * frame_rate_hz / n_frames
    slow_hz = np.add.outer([0.0, *_OFFSETS_HZ], weight_hz)
    turns = 2 * np.pi * np.outer(slow_hz / frame_rate_hz, np.arange(length))
    _, size, shapes = np.linalg.svd(np.vstack([np.cos(turns), np.sin(turns)]), full_matrices=False)
    return np.asarray(shapes[size > MIN_SHAPE_RATIO * size[0]], np.float32)


def _lines(bank: DemodulationBank, frames: Array) -> Array:
    """Return ``exp(-i w k)`` of every line, ``(2 * n_lines, n)``: real parts, imaginary ones."""
    cosines, sines = cosines_and_sines(np.outer(bank.lines_hz, frames / bank.frame_rate_hz))
    # Minus: the imaginary part of exp(-i w k).
    return np.concatenate([cosines, -sines])


def cosines_and_sines(turns: Array) -> tuple[Array, Array]:
    """Return cosine and sine of turns; whole turns are removed first, to keep single precision."""
    angles = (2 * np.pi * (turns - np.rint(turns))).astype(np.float32)
    return np.cos(angles), np.sin(angles)


def _hann(n_frames: int, frames: Array) -> Array:
    return np.asarray(0.5 - 0.5 * np.cos(2 * np.pi * (frames + 0.5) / n_frames), np.float32)
