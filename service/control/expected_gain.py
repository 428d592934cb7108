"""Prediction of the wavefront error that a new reconstructor would save.

The model of the loop is linear. Turbulence ``φ`` on every mode of the basis gives slopes
``s = D(α) G (φ + c) + n``, and the integrator is ``c = -H g R s`` with
``H = z^-d / (1 - leak z^-1)``. With the coupling ``B = g R D G = V Λ V^-1`` of the controlled modes
and ``B_h`` of the others, the residual of the controlled modes is

    ``e = V [1/(1 + HΛ)] V^-1 φ - V [H/(1 + HΛ)] V^-1 (B_h φ_h + g R n)``.

Its variance is summed over all temporal frequencies, for the reconstructor in use and for the
inverse of the present D. Modes are assumed to be independent. Under frozen flow a reconstructor
shifted along the wind predicts the turbulence and gains what it loses when shifted against the
wind; the model gives the mean of both (docs/results/tracking.md). Swings of the optical gain
and edge slip are not in the model: stability is judged by the gate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.control.loop import ControlLoop, find_eigenmodes
from service.model.instrument import Instrument
from service.model.sensors.registry import kind_of
from service.records.products import ExpectedGain

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

N_FREQUENCIES = 96
"""Number of frequencies between 0.001 and 0.5 of the frame rate; more change less than 1e-3."""

_N_SPECTRUM_GROUPS = 10
"""Number of groups of modes that share one temporal spectrum."""

_CORNER_RATIO = 0.3
"""Corner frequency over ``(n + 1) v / D`` of a mode of radial order n (Conan et al. 1995)."""

_VARIANCE_EXPONENT = -11.0 / 6.0
"""Exponent of the variance as a function of the mode number (Kolmogorov, two dimensions)."""

_SPECTRUM_EXPONENT = 17.0 / 3.0
"""Exponent with which the temporal spectrum falls above its corner (Conan et al. 1995)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sky:
    """Turbulence and noise in the loop."""

    variance_m2: Array
    """``(n_basis,)`` variance of the turbulence on each mode, metres² OPD."""

    beyond_m2: float
    """Variance of the turbulence outside of the basis, metres² OPD."""

    crossing_hz: float
    """Wind speed over telescope diameter."""

    slope_noise: float
    """1 σ of one slope in one frame."""


def extrapolate_variance_m2(variance_m2: Array) -> float:
    """Return the variance of the turbulence outside of a basis, metres² OPD.

    The variance of mode m falls as ``m^(-11/6)``. The law is scaled to the last third of the basis
    and integrated beyond it.
    """
    n = len(variance_m2)
    last = np.arange(2 * n // 3, n)
    scale = variance_m2[last].sum() / np.sum((last + 1.0) ** _VARIANCE_EXPONENT)
    return float(scale * (n + 0.5) ** (1.0 + _VARIANCE_EXPONENT) / -(1.0 + _VARIANCE_EXPONENT))


def predict_gain(
    in_use: NDArray[np.float32],
    fresh: NDArray[np.float32],
    interaction_matrix: NDArray[np.float32],
    loop: ControlLoop,
    sky: Sky,
) -> ExpectedGain:
    """Return the predicted gain of the reconstructor ``fresh`` over ``in_use``.

    Both are ``(n_controlled, n_slopes)``; ``interaction_matrix`` ``(n_slopes, n_basis)`` is that of
    the present registration. A mode without loop gain counts as uncontrolled.
    """
    # A loop without any gain is about to be closed: it is judged with all of its modes.
    moving = np.flatnonzero(loop.gains if loop.gains.any() else loop.gains == 0.0)
    order = np.concatenate([moving, np.setdiff1d(np.arange(len(sky.variance_m2)), moving)])
    seen = (interaction_matrix * np.asarray(loop.optical_gain, np.float32))[:, order]
    model = _LoopModel(replace(loop, gains=loop.gains[moving]), sky, order)
    now_m2, radius = _residual_variance(in_use[moving], seen, model)
    then_m2, fresh_radius = _residual_variance(fresh[moving], seen, model)
    rest_m2 = float(np.sum(model.variance_m2[len(moving) :])) + sky.beyond_m2
    wavefront = float(np.sqrt(then_m2 + rest_m2))
    loss = float(np.sqrt(now_m2 + rest_m2)) - wavefront
    if max(radius, fresh_radius) >= 1.0:
        # If not even a perfect reconstructor is stable, another matrix is not the remedy.
        loss = float("inf") if fresh_radius < 1.0 else 0.0
    return ExpectedGain(
        loss_m=loss, wavefront_m=wavefront, pole_radius=radius, fresh_pole_radius=fresh_radius
    )


def estimate_noise_loss_m(loss_m: float, step: Array, covariance: Array) -> float:
    """Return the part of a predicted loss that noise of the two registrations explains, metres.

    ``step`` ``(4,)`` is their difference, ``covariance`` ``(4, 4)`` that of the step. A loss grows
    with the square of the step. For noise alone the mean squared Mahalanobis distance is 4, one
    for each parameter, so the loss is scaled to a squared distance of 4.
    """
    distance2 = float(step @ np.linalg.solve(covariance, step))
    if distance2 <= len(step):
        return loss_m
    return loss_m * len(step) / distance2


class _LoopModel:
    """Frequency response of the integrator, and temporal spectra of groups of modes.

    Modes are in the order ``order``, the controlled ones first. Each shape in ``shapes`` sums to 1
    over the frequencies.
    """

    def __init__(self, loop: ControlLoop, sky: Sky, order: NDArray[np.intp]) -> None:
        self.loop, self.slope_noise = loop, sky.slope_noise
        self.variance_m2 = sky.variance_m2[order]
        # Logarithmic, because turbulence has most of its power at low frequencies.
        edges = np.geomspace(1e-3, 0.5, N_FREQUENCIES + 1)
        per_frame = np.sqrt(edges[1:] * edges[:-1])
        z: Complex = np.exp(-2j * np.pi * per_frame)
        self.integrator: Complex = z**loop.delay_frames / (1.0 - loop.leak * z)
        self.widths: Array = np.diff(edges)
        corners = (
            _CORNER_RATIO * (compute_radial_orders(len(sky.variance_m2)) + 1.0) * sky.crossing_hz
        )
        # Modes with nearly the same corner share a spectrum, so that variances need a few products
        # of matrices instead of one for each mode. The margins keep both ends inside.
        bounds = np.geomspace(corners[0] * 0.999, corners[-1] * 1.001, _N_SPECTRUM_GROUPS + 1)
        corners = corners[order]
        self.group: NDArray[np.intp] = np.searchsorted(bounds, corners) - 1
        self.shapes: Array = np.zeros((_N_SPECTRUM_GROUPS, N_FREQUENCIES))
        for k in range(_N_SPECTRUM_GROUPS):
            if np.any(self.group == k):
                corner = float(corners[self.group == k].mean()) / loop.frame_rate_hz
                shape = 1.0 / (1.0 + (per_frame / corner) ** _SPECTRUM_EXPONENT)
                self.shapes[k] = shape * self.widths / (shape @ self.widths)


def compute_radial_orders(n_modes: int) -> Array:
    """Return the radial order ``(n_modes,)`` of modes numbered like Zernike's, without piston."""
    modes = np.arange(2, n_modes + 2)
    return np.asarray(np.ceil((np.sqrt(8.0 * modes + 1.0) - 3.0) / 2.0))


def _residual_variance(
    reconstructor: NDArray[np.float32], response: NDArray[np.float32], model: _LoopModel
) -> tuple[float, float]:
    """Return the residual variance of the controlled modes, m², and the largest pole radius.

    ``response`` ``(n_slopes, n_basis)`` is the sensor's, with the modes in the model's order.
    """
    n = len(reconstructor)
    gains = model.loop.gains[:, None]
    coupling = gains * (reconstructor @ response).astype(float)
    eigenvalues, vectors = find_eigenmodes(coupling[:, :n])
    radius = model.loop.pole_radius(eigenvalues).max()
    rejected = 1.0 / (1.0 + model.integrator[:, None] * eigenvalues)
    passed = model.integrator[:, None] * rejected
    basis = _Eigenmodes(vectors)
    scale, total = np.sqrt(model.variance_m2), 0.0
    for k, shape in enumerate(model.shapes):
        own, other = model.group[:n] == k, n + np.flatnonzero(model.group[n:] == k)
        # Controlled modes are rejected by the loop; the others alias into it through the coupling.
        if own.any():
            total += basis.variance(np.diag(scale[:n])[:, own], rejected, shape)
        if len(other):
            total += basis.variance(coupling[:, other] * scale[other], passed, shape)
    noise = gains * reconstructor.astype(float) * model.slope_noise
    # There are many more slopes than modes, so noise enters by its (n, n) square root. White noise
    # has a power of 1 over frequencies from -0.5 to 0.5 per frame; only half of them are summed.
    total += basis.variance(_square_root(noise @ noise.T), passed, 2.0 * model.widths)
    return total, float(radius)


def _square_root(covariance: Array) -> Array:
    """Return a square root ``(n, n)`` of a covariance, singular or not."""
    power, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(power, 0.0)))


class _Eigenmodes:
    """Eigenvectors V ``(n, n)`` of a loop, which are mixtures of its modes; None for the modes."""

    def __init__(self, vectors: NDArray[Any] | None) -> None:
        self._coupled = vectors is not None
        if vectors is not None:
            self._inverse = np.linalg.inv(vectors)
            self._metric = vectors.conj().T @ vectors

    def variance(self, driving: Array, response: NDArray[Any], weights: Array) -> float:
        """Return the variance of ``V [response] V^-1 driving x`` for x of unit variance.

        ``driving`` is ``(n, n_inputs)``, ``response`` ``(n_frequencies, n)``; ``weights`` is the
        power of x at each frequency.
        """
        if not self._coupled:
            return float(np.sum(driving**2, axis=1) @ (weights @ np.abs(response) ** 2))
        driven = self._inverse @ driving
        mean = (response.T * weights) @ response.conj()
        return float(np.vdot(self._metric, (driven @ driven.conj().T) * mean).real)


ZERO_POINT_PHOTONS = 2.1e10
"""Photons per second and square metre from a star of magnitude 0 in the sensor's band."""

THROUGHPUT = 0.25
"""Detected photons over photons above the atmosphere, light diffracted out of the images lost."""

READ_NOISE_ELECTRONS = 4.0
"""Read noise per pixel, electrons RMS."""


def estimate_slope_noise(
    instrument: Instrument, *, magnitude: float, frame_rate_hz: float, n_valid: int
) -> float:
    """Return 1 σ of a slope in one frame, for light spread evenly over the valid subapertures."""
    area_m2 = instrument.collecting_area_m2
    flux = ZERO_POINT_PHOTONS * 10 ** (-0.4 * magnitude) * area_m2
    own = flux * THROUGHPUT / frame_rate_hz / n_valid
    return kind_of(instrument).slope_noise(instrument, own, READ_NOISE_ELECTRONS)
