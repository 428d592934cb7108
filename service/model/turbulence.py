"""Von Karman turbulence on modes and on a pyramid.

A long exposure sees each star point spread over the residual's halo. To the pyramid that is an
incoherent extended source: a core, the modulation circle itself, weakened by the residual's
coherence at large distance, and a halo around it. The Jacobian averaged over that source is the
one a closed loop has on sky; the one of a flat wavefront overestimates it and biases the
registration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.described import KarhunenLoeve
from service.model.instrument import Instrument
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


SERVO_RESIDUAL = 0.12
"""Share of the turbulence left at the cut-off by noise and delay; it falls with (k / k_c)²."""

POINTS = tuple(range(12, 42, 2))
"""On each of 15 rings, inner ones first: 390 with an error of 0.01 % in magnification. As many on
every ring, all at the same angles, would need 600: the outer ones are the longer."""

_N_SAMPLES = 1000
"""Of frequencies and of tilts."""

_N_DISTANCES = 600
"""Nodes of a Gauss-Legendre rule over the pupil: enough for 100 subapertures. On FLAO the light of
a ring is right to 1e-5, for which equal steps would have to be 20,000."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Halo:
    """Source points beside the modulation circle, on rings about the axis."""

    core_weight: float
    """Share of the light that stays on the modulation circle, 0..1."""

    radii: Array
    """``(n_rings,)`` tilt of the rings, radians of phase per subaperture."""

    weights: Array
    """``(n_rings,)`` share of the light on each ring; what diffracts further out is lost."""

    n_points: tuple[int, ...]
    """Points on each ring, all even."""


def working_point(
    instrument: Instrument, *, n_controlled: int, r0_m: float | None = None, sampling: int
) -> Halo:
    """Return the source a loop with ``n_controlled`` modes makes of a star.

    The residual's spectrum is von Karman above the cut-off of the controlled modes and
    ``SERVO_RESIDUAL (k / k_c)²`` of it below. Its coherence is ``B(r) = exp(-D(r) / 2)``; the halo
    is the Hankel transform of ``(B - B_inf) J0(k_mod r)``, cut where a pupil grid of ``sampling``
    points per subaperture ends.

    Raises
    ------
    ModelError
        If no mode is controlled or r0 is not positive.
    """
    r0 = instrument.modes.r0_m if r0_m is None else r0_m
    if n_controlled < 1 or r0 <= 0.0:
        raise ModelError(
            f"working point: found {n_controlled} controlled modes, r0 {r0} m; expected >= 1, > 0"
        )
    frequency, power = _residual_spectrum(instrument, n_controlled, r0)
    nodes, node_weights = scipy.special.roots_legendre(_N_DISTANCES)
    radius = instrument.wfs.pupil_diameter / 2.0
    distance = radius * (1.0 + nodes)
    step = np.gradient(frequency)
    variance = float(power * frequency @ step) / (2 * np.pi)
    covariance = (
        scipy.special.j0(np.outer(distance, frequency)) @ (power * frequency * step) / (2 * np.pi)
    )
    coherence = np.exp(covariance - variance)
    far = float(np.exp(-variance))
    circle = 2 * np.pi * instrument.wfs.modulation_lambda_over_d / instrument.wfs.pupil_diameter
    shape = (coherence - far) * scipy.special.j0(circle * distance) * distance
    tilt = np.linspace(0.0, np.pi * sampling, _N_SAMPLES)
    halo = scipy.special.j0(np.outer(tilt, distance)) @ (shape * radius * node_weights)
    return _rings(tilt, np.maximum(halo * tilt, 0.0), far)


def _residual_spectrum(
    instrument: Instrument, n_controlled: int, r0_m: float
) -> tuple[Array, Array]:
    """Return spatial frequencies (rad per subaperture) and the residual's phase power there.

    Phase at the sensing wavelength, power per (rad per subaperture)². The cut-off is where the
    controlled modes fill a disc in frequency: ``k_c = 4 sqrt(n) / D``.
    """
    scale = instrument.subaperture_m
    cutoff = 4.0 * np.sqrt(n_controlled) / instrument.wfs.pupil_diameter
    frequency = np.geomspace(1e-2 * cutoff, 1e2 * cutoff, _N_SAMPLES)
    outer = 2 * np.pi * scale / instrument.modes.outer_scale_m
    colour = (REFERENCE_WAVELENGTH_M / instrument.wfs.wavelength_m) ** 2
    # 0.0229 r0^(-5/3) f^(-11/3) in cycles, converted to angular frequency
    power = 0.0229 * (2 * np.pi) ** (5 / 3) * (scale / r0_m) ** (5 / 3)
    spectrum = colour * power * (frequency**2 + outer**2) ** (-11 / 6)
    kept = np.where(frequency < cutoff, SERVO_RESIDUAL * (frequency / cutoff) ** 2, 1.0)
    # the transform to a covariance is over d²k / (2π)²
    return frequency, spectrum * kept * (2 * np.pi) ** 2


def _rings(tilt: Array, brightness: Array, core: float) -> Halo:
    """Return rings of equal light: each stands for a quantile of the halo."""
    light = np.concatenate([[0.0], np.cumsum((brightness[1:] + brightness[:-1]) / 2)])
    light *= tilt[1] - tilt[0]
    n_rings = len(POINTS)
    middle = (np.arange(n_rings) + 0.5) / n_rings * light[-1]
    return Halo(
        core_weight=core,
        radii=np.interp(middle, light, tilt),
        weights=np.full(n_rings, light[-1] / n_rings),
        n_points=POINTS,
    )
