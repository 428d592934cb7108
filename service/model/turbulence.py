"""Von Karman turbulence on modes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

from service.model.instrument import Instrument
from service.model.kinds import KarhunenLoeve
from service.model.pupil import instrument_pupil

Array = NDArray[np.float64]

REFERENCE_WAVELENGTH_M = 500e-9
"""Wavelength at which r0 is quoted, metres."""


def von_karman_covariance(separation_m: Array, turbulence: KarhunenLoeve) -> Array:
    """Return the phase covariance of von Karman turbulence, in metres² of OPD.

    References
    ----------
    Conan 2000, PhD thesis; Heritier et al. 2018 use the same spectrum.
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
    pupil = instrument_pupil(instrument, 3)
    weights = pupil.weights
    shapes = piston_free(render(pupil.points), weights)
    weighted = shapes * weights[:, None]
    n = len(pupil.coordinates)
    size = scipy.fft.next_fast_len(2 * n, real=True)
    lag = np.minimum(np.arange(size), size - np.arange(size))
    separation = np.hypot(lag[:, None], lag) / pupil.sampling * instrument.subaperture_m
    kernel = scipy.fft.rfft2(von_karman_covariance(separation, instrument.modes))
    convolved = np.empty_like(weighted)
    plane = np.zeros((n, n))
    for j in range(weighted.shape[1]):
        plane[pupil.lit] = weighted[:, j]
        spread = scipy.fft.irfft2(scipy.fft.rfft2(plane, (size, size)) * kernel, (size, size))
        convolved[:, j] = spread[:n, :n][pupil.lit]
    return shapes.T @ weighted, weighted.T @ convolved


def expected_variance(instrument: Instrument, render: Callable[[Array], Array]) -> Array:
    """Return the variance ``(n_shapes,)`` of each coefficient when turbulence is fitted, metres².

    The shapes need be neither orthogonal nor independent: the fit is the shortest.
    """
    gram, covariance = pupil_statistics(instrument, render)
    inverse = scipy.linalg.pinvh(gram)
    return np.asarray(np.einsum("ij,jk,ki->i", inverse, covariance, inverse, optimize=True))
