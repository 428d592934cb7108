"""Turbulence in layers: screens of von Karman phase that never repeat, extruded row by row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky

from service.model.instrument import KarhunenLoeve
from service.model.turbulence import von_karman_covariance

Array = NDArray[np.float64]

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
