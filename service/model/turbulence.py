"""Von Karman turbulence on modes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model.instrument import Instrument
from service.model.kinds import KarhunenLoeve
from service.model.local import LocalShapes
from service.model.pupil import PupilGrid, instrument_pupil

Array = NDArray[np.float64]

SAMPLING = 3
"""Points a subaperture at which turbulence meets shapes."""

_BLOCK = 64
"""Functions at a time."""

REFERENCE_WAVELENGTH_M = 500e-9
"""Wavelength at which r0 is quoted, metres."""


def von_karman_covariance(separation_m: Array, turbulence: KarhunenLoeve) -> Array:
    """Return the phase covariance of von Karman turbulence, in metres² of OPD.

    References
    ----------
    Conan 2000, PhD thesis.
    """
    scale = (turbulence.outer_scale_m / turbulence.r0_m) ** (5 / 3)
    shape = (
        (24 / 5 * scipy.special.gamma(6 / 5)) ** (5 / 6)
        / np.pi ** (8 / 3)
        * scipy.special.gamma(11 / 6)
    )
    x = 2 * np.pi * np.asarray(separation_m, dtype=np.float64) / turbulence.outer_scale_m
    at_zero = scale * shape * scipy.special.gamma(5 / 6) / 2
    safe = np.maximum(x, 1e-12)
    # K_5/6 is infinite at 0, though the product has a limit there.
    phase = np.where(
        x > 1e-9,
        scale * shape / 2 ** (5 / 6) * safe ** (5 / 6) * scipy.special.kv(5 / 6, safe),
        at_zero,
    )
    return np.asarray(phase * (REFERENCE_WAVELENGTH_M / (2 * np.pi)) ** 2)


def piston_free(shapes: Array, weights: Array) -> Array:
    """Return shapes ``(n_points, n_shapes)`` without their mean under these weights."""
    return np.asarray(shapes - weights @ shapes)


def pupil_statistics(
    instrument: Instrument, render: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """Return Gram matrix of the shapes and covariance of the turbulence's projections on them.

    ``render`` gives the shapes ``(n_points, n_shapes)`` at points of the pupil. The covariance is
    a convolution of every weighted shape with B(r), done exactly on a padded grid: the dense
    n_points² matrix is never formed.
    """
    pupil = instrument_pupil(instrument, SAMPLING)
    weights = pupil.weights
    shapes = piston_free(render(pupil.points), weights)
    weighted = shapes * weights[:, None]
    spread = Spread(instrument, pupil)
    convolved = np.empty_like(weighted)
    every = np.flatnonzero(pupil.lit)
    for j in range(weighted.shape[1]):
        convolved[:, j] = spread(every, weighted[:, j])
    return shapes.T @ weighted, weighted.T @ convolved


def local_statistics(instrument: Instrument, functions: LocalShapes) -> tuple[Array, Array]:
    """Return the same of functions that end, on the pupil of ``SAMPLING``, none of them whole.

    In float64: the last of thousands of modes have a millionth of the first one's variance, and a
    transform in single precision would put a tenth of noise on them.
    """
    pupil = instrument_pupil(instrument, SAMPLING)
    weights = pupil.weights
    spread, places = Spread(instrument, pupil), np.flatnonzero(pupil.lit)
    heights = functions.sparse().tocsc()
    covariance = np.empty((functions.n_functions, functions.n_functions))
    # A block at a time: whole functions of an ELT take tens of gigabytes.
    for start in range(0, functions.n_functions, _BLOCK):
        columns = range(start, min(start + _BLOCK, functions.n_functions))
        block = np.zeros((len(columns), functions.n_points))
        for k, j in enumerate(columns):
            at = slice(heights.indptr[j], heights.indptr[j + 1])
            points = heights.indices[at]
            if len(points):  # an actuator may stand in the dark
                block[k] = spread(places[points], heights.data[at] * weights[points])
        covariance[start : columns.stop] = (block * weights) @ functions
    piston = spread(places, weights) * weights
    # without their means: (f - m)' W B W (f - m), m the mean of each function
    mean, on_piston = weights @ heights, piston @ heights
    covariance -= np.outer(mean, on_piston)
    covariance -= np.outer(on_piston, mean)
    covariance += piston.sum() * np.outer(mean, mean)
    # Rounding leaves it slightly unsymmetric.
    return pupil_gram(heights, weights), (covariance + covariance.T) / 2


def pupil_gram(heights: Any, weights: Array) -> Array:  # noqa: ANN401 - scipy has no types
    """Return the Gram matrix of functions that end, without their means, ``(n, n)``.

    ``heights`` is ``(n_points, n)``, sparse.
    """
    mean = weights @ heights
    weighted = scipy.sparse.diags_array(weights) @ heights
    return np.asarray((heights.T @ weighted).toarray() - np.outer(mean, mean))


class Spread:
    """The turbulence's covariance B(r), spread about weights on a pupil: their convolution."""

    def __init__(self, instrument: Instrument, pupil: PupilGrid) -> None:
        n = len(pupil.coordinates)
        self._lit = pupil.lit
        # Twice the pupil, so that what a circular convolution wraps around stays off the pupil.
        self._size = scipy.fft.next_fast_len(2 * n, real=True)
        lag = np.minimum(np.arange(self._size), self._size - np.arange(self._size))
        separation = np.hypot(lag[:, None], lag) / pupil.sampling * instrument.subaperture_m
        self._kernel = scipy.fft.rfft2(von_karman_covariance(separation, instrument.modes))

    def __call__(self, places: NDArray[np.intp], weights: Array) -> Array:
        """Return the convolution at all lit points, of weights at places of the flat grid.

        Only the lines that hold any are transformed along x, and only those of the pupil back.
        """
        n, size = len(self._lit), self._size
        y, x = np.divmod(places, n)
        first, last = y.min(), y.max() + 1
        lines = np.zeros((last - first, n))
        lines[y - first, x] = weights
        along_x = np.zeros((size, size // 2 + 1), complex)
        along_x[first:last] = scipy.fft.rfft(lines, size, axis=1)
        both = scipy.fft.fft(along_x, axis=0, overwrite_x=True)
        both *= self._kernel
        back = scipy.fft.ifft(both, axis=0, overwrite_x=True)[:n]
        return np.asarray(scipy.fft.irfft(back, size, axis=1)[:, :n][self._lit])


def predict_variance(gram: Array, covariance: Array) -> Array:
    """Return the variance ``(n_shapes,)`` of each coefficient when turbulence is fitted, metres².

    Of statistics of the pupil. The shapes need be neither orthogonal nor independent: the fit is
    the shortest.
    """
    # Modes may depend on one another: their Gram matrix is then singular.
    inverse = scipy.linalg.pinvh(gram)
    return np.asarray(np.einsum("ij,jk,ki->i", inverse, covariance, inverse, optimize=True))
