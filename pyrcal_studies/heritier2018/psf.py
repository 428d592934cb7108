"""Long exposures in the H band from snapshots of the residual wavefront."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2, fftshift, next_fast_len

from sim_rtc.telescope.diffractive import DiffractivePlant

Array = NDArray[np.float64]

H_BAND_M = 1.65e-6
OVERSAMPLING = 4
"""Samples per λ/D."""

FIELD = 128
"""Samples across the part that is kept: 32 λ/D."""


class Camera:
    """A perfect camera behind the telescope's pupil."""

    def __init__(self, plant: DiffractivePlant) -> None:
        place = np.round((plant.points_m - plant.points_m.min(axis=0)) / plant.pitch_m)
        self._column, self._row = place.astype(np.intp).T
        # a grey cell of the pupil has the amplitude of its area
        self._amplitude = plant.weights / plant.weights.sum()
        across = int(max(self._row.max(), self._column.max())) + 1
        self._size = next_fast_len(OVERSAMPLING * across)
        self._peak = float(self._exposure(np.zeros(len(self._row))).max())

    def image(self, residuals_m: NDArray[Any]) -> Array:
        """Return the long exposure ``(FIELD, FIELD)`` over these wavefronts, perfect peak 1.

        ``residuals_m`` is ``(n_snapshots, n_points)``; tilt is left in.
        """
        total = np.zeros((FIELD, FIELD))
        for residual in residuals_m:
            total += self._exposure(residual)
        return total / (len(residuals_m) * self._peak)

    def _exposure(self, opd_m: NDArray[Any]) -> Array:
        field = np.zeros((self._size, self._size), dtype=np.complex128)
        phase = 2 * np.pi / H_BAND_M * opd_m
        field[self._row, self._column] = self._amplitude * np.exp(1j * phase)
        power = np.abs(fftshift(fft2(field))) ** 2
        first = self._size // 2 - FIELD // 2
        return np.asarray(power[first : first + FIELD, first : first + FIELD])


def strehl(image: NDArray[Any]) -> float:
    """Return the peak of a long exposure whose perfect peak is 1."""
    return float(image.max())


def marechal(wavefront_error_nm: float) -> float:
    """Return the Strehl ratio that goes with a wavefront error, by Maréchal's approximation."""
    return float(np.exp(-((2e-9 * np.pi / H_BAND_M * wavefront_error_nm) ** 2)))
