"""Predict what a new reconstructor would win.

The linear model of the loop: turbulence ``φ`` on every mode of the basis, slopes
``s = D(α) G (φ + c) + n``, integrator ``c = -H g R s`` with ``H = z^-d / (1 - leak z^-1)``. With
the coupling ``B = g R D G = V Λ V^-1`` of the controlled modes and ``B_h`` of those beyond, what is
left of the controlled modes is

    ``e = V [1/(1 + HΛ)] V^-1 φ - V [H/(1 + HΛ)] V^-1 (B_h φ_h + g R n)``.

Its variance is summed over a frame's frequencies for the reconstructor in use and for the inverse
of the present D. Modes are taken to be independent: under frozen flow a reconstructor shifted along
the wind foresees the turbulence and wins what it loses when shifted against it, and the model
gives the mean of both (docs/results/update_policy.md). Neither swings of the optical gain nor
slipping segments are in it: the gate keeps a loop safe, this only says whether a new matrix is
worth the swap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.control.loop import ControlLoop, loop_modes
from service.model.instrument import Instrument
from service.model.sensors.registry import kind_of

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

N_FREQUENCIES = 96
"""Between a thousandth and half of the frame rate: twice as many change nothing in 1e-3."""

_N_GROUPS = 10
"""Of modes that share one temporal spectrum."""

_CORNER = 0.3
"""Corner frequency over ``(n + 1) v / D`` of a mode of radial order n (Conan et al. 1995)."""

_FALL = -11.0 / 6.0
"""Power of a mode's number that its variance follows."""

_STEEPNESS = 17.0 / 3.0
"""Power of the temporal spectrum above its corner (the same)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sky:
    """Turbulence and noise that the loop works against."""

    variance_m2: Array
    """``(n_basis,)`` variance of the turbulence on each mode, metres² OPD."""

    beyond_m2: float
    """Variance of the turbulence that no mode of the basis holds, metres²."""

    crossing_hz: float
    """Wind speed over telescope diameter."""

    slope_noise: float
    """1 σ of one slope in one frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedGain:
    """Loss with the reconstructor in use, by the linear model of the loop."""

    loss_m: float
    """Wavefront error above that with a new reconstructor, metres RMS; infinite: unstable."""

    wavefront_m: float
    """Wavefront error with a new reconstructor, metres RMS."""

    pole_radius: float
    """Largest closed-loop pole radius at the present registration, no uncertainty added."""

    fresh_pole_radius: float
    """The same with a new reconstructor."""


def beyond_m2(variance_m2: Array) -> float:
    """Return the variance of the turbulence beyond a basis, metres².

    That of mode m falls as ``m^(-11/6)`` (Kolmogorov's in two dimensions): the last third of the
    basis says how much is left.
    """
    n = len(variance_m2)
    last = np.arange(2 * n // 3, n)
    scale = variance_m2[last].sum() / np.sum((last + 1.0) ** _FALL)
    return float(scale * (n + 0.5) ** (1.0 + _FALL) / -(1.0 + _FALL))


def expected_gain(
    in_use: NDArray[np.float32],
    fresh: NDArray[np.float32],
    interaction_matrix: NDArray[np.float32],
    loop: ControlLoop,
    sky: Sky,
) -> ExpectedGain:
    """Return what ``fresh`` would win over ``in_use``, both ``(n_controlled, n_slopes)``.

    ``interaction_matrix`` ``(n_slopes, n_basis)`` is the sensor's at the present registration.
    A mode without gain is one beyond the loop, whichever its number.
    """
    moving = np.flatnonzero(loop.gains if loop.gains.any() else loop.gains == 0.0)
    order = np.concatenate([moving, np.setdiff1d(np.arange(len(sky.variance_m2)), moving)])
    seen = (interaction_matrix * np.asarray(loop.optical_gain, np.float32))[:, order]
    work = _Work(replace(loop, gains=loop.gains[moving]), sky, order)
    now_m2, radius = _left(in_use[moving], seen, work)
    then_m2, fresh_radius = _left(fresh[moving], seen, work)
    rest_m2 = float(np.sum(work.variance_m2[len(moving) :])) + sky.beyond_m2
    wavefront = float(np.sqrt(then_m2 + rest_m2))
    loss = float(np.sqrt(now_m2 + rest_m2)) - wavefront
    if max(radius, fresh_radius) >= 1.0:
        # what no reconstructor holds is no reason for another one
        loss = float("inf") if fresh_radius < 1.0 else 0.0
    return ExpectedGain(
        loss_m=loss, wavefront_m=wavefront, pole_radius=radius, fresh_pole_radius=fresh_radius
    )


def explained_by_noise(loss_m: float, step: Array, covariance: Array) -> float:
    """Return how much of a loss pure noise of the two registrations would show, metres.

    ``step`` ``(4,)`` is what separates them, ``covariance`` ``(4, 4)`` that of the step. A loss
    grows as the square of the step: of noise alone its mean is that at a squared distance of 4,
    one for each parameter, where all four weigh alike.
    """
    distance2 = float(step @ np.linalg.solve(covariance, step))
    if distance2 <= len(step):
        return loss_m
    return loss_m * len(step) / distance2


class _Work:
    """A loop, and what it works against: frequencies, and the spectra of groups of modes."""

    def __init__(self, loop: ControlLoop, sky: Sky, order: NDArray[np.intp]) -> None:
        self.loop, self.slope_noise = loop, sky.slope_noise
        self.variance_m2 = sky.variance_m2[order]
        edges = np.geomspace(1e-3, 0.5, N_FREQUENCIES + 1)
        per_frame = np.sqrt(edges[1:] * edges[:-1])
        z: Complex = np.exp(-2j * np.pi * per_frame)
        self.integrator: Complex = z**loop.delay_frames / (1.0 - loop.leak * z)
        self.widths: Array = np.diff(edges)
        corners = _CORNER * (radial_order(len(sky.variance_m2)) + 1.0) * sky.crossing_hz
        bounds = np.geomspace(corners[0] * 0.999, corners[-1] * 1.001, _N_GROUPS + 1)
        corners = corners[order]
        self.group: NDArray[np.intp] = np.searchsorted(bounds, corners) - 1
        self.shapes: Array = np.zeros((_N_GROUPS, N_FREQUENCIES))
        for k in range(_N_GROUPS):
            if np.any(self.group == k):
                corner = float(corners[self.group == k].mean()) / loop.frame_rate_hz
                shape = 1.0 / (1.0 + (per_frame / corner) ** _STEEPNESS)
                self.shapes[k] = shape * self.widths / (shape @ self.widths)


def radial_order(n_modes: int) -> Array:
    """Return the radial order ``(n_modes,)`` of modes numbered like Zernike's, without piston."""
    modes = np.arange(2, n_modes + 2)
    return np.asarray(np.ceil((np.sqrt(8.0 * modes + 1.0) - 3.0) / 2.0))


def _left(
    reconstructor: NDArray[np.float32], seen: NDArray[np.float32], work: _Work
) -> tuple[float, float]:
    """Return the variance left on the controlled modes, metres², and the largest pole radius."""
    n = len(reconstructor)
    gains = work.loop.gains[:, None]
    coupling = gains * (reconstructor @ seen).astype(float)
    eigenvalues, vectors = loop_modes(coupling[:, :n])
    radius = work.loop.pole_radius(eigenvalues).max()
    rejected = 1.0 / (1.0 + work.integrator[:, None] * eigenvalues)
    passed = work.integrator[:, None] * rejected
    basis = _Separate() if vectors is None else _Mixed(vectors)
    scale, total = np.sqrt(work.variance_m2), 0.0
    for k, shape in enumerate(work.shapes):
        own, other = work.group[:n] == k, n + np.flatnonzero(work.group[n:] == k)
        if own.any():
            total += basis.left(np.diag(scale[:n])[:, own], rejected, shape)
        if len(other):
            total += basis.left(coupling[:, other] * scale[other], passed, shape)
    noise = gains * reconstructor.astype(float) * work.slope_noise
    # slopes are many more than modes; white noise has a power of 1 within a frame's frequencies,
    # half of it on each side of zero
    total += basis.left(_factor(noise @ noise.T), passed, 2.0 * work.widths)
    return total, float(radius)


def _factor(covariance: Array) -> Array:
    """Return a square root ``(n, n)`` of a covariance, singular or not."""
    power, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(power, 0.0)))


class _Separate:
    """A loop whose modes are its eigenvectors."""

    def left(self, driving: Array, response: NDArray[Any], weights: Array) -> float:
        """Return the variance of ``[response] driving x``, x of unit variance and this spectrum."""
        return float(np.sum(driving**2, axis=1) @ (weights @ np.abs(response) ** 2))


class _Mixed:
    """A loop whose eigenvectors V ``(n, n)`` are mixtures of its modes."""

    def __init__(self, vectors: NDArray[Any]) -> None:
        self._inverse = np.linalg.inv(vectors)
        self._metric = vectors.conj().T @ vectors

    def left(self, driving: Array, response: NDArray[Any], weights: Array) -> float:
        """Return the variance of ``V [response] V^-1 driving x``, as above."""
        driven = self._inverse @ driving
        mean = (response.T * weights) @ response.conj()
        return float(np.vdot(self._metric, (driven @ driven.conj().T) * mean).real)


ZERO_POINT_PHOTONS = 2.1e10
"""Photons per second and square metre from a star of magnitude 0 in the sensor's band."""

THROUGHPUT = 0.25
"""Atmosphere, telescope, sensor and quantum efficiency together; light diffracted out of the images
counts as lost with it."""

READ_NOISE_ELECTRONS = 4.0
"""RMS per pixel and read."""


def noise_of_star(
    instrument: Instrument, *, magnitude: float, frame_rate_hz: float, n_valid: int
) -> float:
    """Return 1 σ of a slope of a star whose light falls evenly on the valid subapertures."""
    area_m2 = instrument.collecting_area_m2
    flux = ZERO_POINT_PHOTONS * 10 ** (-0.4 * magnitude) * area_m2
    own = flux * THROUGHPUT / frame_rate_hz / n_valid
    return kind_of(instrument).slope_noise(instrument, own, READ_NOISE_ELECTRONS)
