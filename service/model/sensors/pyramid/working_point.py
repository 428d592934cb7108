"""The response of a pyramid at its working point, in residual turbulence.

A long exposure sees each star point spread over the residual's halo. To the pyramid that is an
incoherent extended source: a core, the modulation circle itself, weakened by the residual's
coherence at large distance, and a halo around it. The Jacobian averaged over that source is the
one a closed loop has on sky; the one of a flat wavefront overestimates it and biases the
registration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError
from service.model.instrument import Instrument
from service.model.sensors.pyramid.description import pyramid_in
from service.model.sensors.sensor import WorkingPoint
from service.model.turbulence import REFERENCE_WAVELENGTH_M

Array = NDArray[np.float64]

SERVO_RESIDUAL = 0.12
"""Share of the turbulence left at the cut-off by noise and delay; it falls with (k / k_c)²."""

POINTS = tuple(range(12, 42, 2))
"""On each of 15 rings, inner ones first: 390 with an error of 0.01 % in magnification. As many on
every ring, all at the same angles, would need 600: the outer ones are the longer."""

_N_SAMPLES = 1000
"""Number of frequencies and of tilts."""

_N_DISTANCES = 600
"""Nodes of a Gauss-Legendre rule over the pupil: enough for 100 subapertures. On FLAO the light of
a ring is right to 1e-5, for which equal steps would have to be 20,000."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Halo(WorkingPoint):
    """Source points around the modulation circle, on rings about the axis."""

    core_weight: float
    """Share of the light that stays on the modulation circle, 0..1."""

    radii: Array
    """``(n_rings,)`` tilt of the rings, radians of phase per subaperture."""

    weights: Array
    """``(n_rings,)`` share of the light on each ring; what diffracts further out is lost."""

    n_points: tuple[int, ...]
    """Points on each ring, all even."""

    @property
    @override
    def coherence(self) -> float:
        return self.core_weight


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
    # exp(-D/2) with D = 2 (variance - covariance).
    coherence = np.exp(covariance - variance)
    far = float(np.exp(-variance))
    wfs = pyramid_in(instrument)
    circle = 2 * np.pi * wfs.modulation_lambda_over_d / wfs.pupil_diameter
    shape = (coherence - far) * scipy.special.j0(circle * distance) * distance
    tilt = np.linspace(0.0, np.pi * sampling, _N_SAMPLES)
    halo = scipy.special.j0(np.outer(tilt, distance)) @ (shape * radius * node_weights)
    # Times the tilt, because a ring's circumference grows with it; not below 0, where the truncated
    # integral oscillates.
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
    """Return rings of equal light: each represents a quantile of the halo."""
    light = np.concatenate([[0.0], np.cumsum((brightness[1:] + brightness[:-1]) / 2)])
    light *= tilt[1] - tilt[0]
    n_rings = len(POINTS)
    # Rings of equal light need the fewest points where the halo is faint.
    middle = (np.arange(n_rings) + 0.5) / n_rings * light[-1]
    return Halo(
        core_weight=core,
        radii=np.interp(middle, light, tilt),
        weights=np.full(n_rings, light[-1] / n_rings),
        n_points=POINTS,
    )
