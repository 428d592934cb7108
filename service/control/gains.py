"""Calibration gains and optical gains of the modes.

Three factors relate the response of the sensor to the model's D. They are kept apart, because each
has another cause and goes somewhere else:

- the **calibration gain** is the stroke of the mirror over that of the model, mode by mode. It is
  constant, above or below 1, and goes into D: ``D_tuned = D diag(g)``, the last step of Heritier
  et al. 2018, section 4.3.
- the **optical gain** is the response of a pyramid in residual turbulence over that in a flat
  wavefront. It is at most 1, changes with the seeing, and goes into the loop gains. Its table is
  published with a reconstructor and never multiplied into it.
- the **number of passes** is 2 if the light is reflected by the mirror twice, as with a daytime
  source, so that every slope doubles. It is a setting and never part of D.

The optical gain of all modes is inferred from that of the few that were dithered. A pyramid in a
residual with structure function D responds as to an incoherent source of mutual coherence
``exp(-D/2)``. The logarithm of a mode's optical gain is therefore the strength of the residual
times a shape that depends on the modulation and the mode's spatial frequency; it is largest near
the modulation radius. What noise and wind leave in the controlled modes has a steeper shape than
what lies beyond them, so a second shape is added. Both are the first two principal components of
true gains on the simulated diffractive telescope (docs/results/tracking.md); they leave 0.5 %
there. Their coefficients, a common factor and a smooth departure are fitted as a Gaussian process,
whose uncertainty grows with the distance from the dithered modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.errors import ModelError
from service.records.registration import ModeGain

Array = NDArray[np.float64]

_N_NEIGHBOURS = 25
"""Number of nearest measured modes whose median gain is given to a mode without measurement."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationGains:
    """Measured over modelled response of every mode of the basis."""

    values: Array
    """``(n_basis,)`` measured over modelled response in single pass; near 1."""

    measured: NDArray[np.bool_]
    """``(n_basis,)`` True for modes that were measured; others have the median of neighbours."""

    @classmethod
    def of_modes(
        cls, gains: NDArray[Any], modes: NDArray[np.intp], n_basis: int
    ) -> CalibrationGains:
        """Extend the gains ``(n,)`` of the measured ``modes`` to a basis of ``n_basis`` modes.

        A mode that was not measured has the median gain of the nearest measured ones.

        Raises
        ------
        ModelError
            If modes and gains do not match, or a gain is not positive.
        """
        if len(gains) == 0 or len(modes) != len(gains) or len(np.unique(modes)) != len(modes):
            raise ModelError(
                f"calibration gains: found {len(gains)} gains for {len(modes)} modes; "
                "expected one for each, every mode once"
            )
        order = np.argsort(modes)
        known, given = np.asarray(modes)[order], np.asarray(gains, dtype=np.float64)[order]
        if known[0] < 0 or known[-1] >= n_basis:
            raise ModelError(
                f"calibration gains: found modes {known[0]} to {known[-1]}; expected modes of "
                f"the basis, 0 to {n_basis - 1}"
            )
        if not np.all(np.isfinite(given) & (given > 0.0)):
            raise ModelError(
                "calibration gains: found a gain that is not a positive number; expected the "
                "orientation settled and dead modes left out"
            )
        values = np.array([_nearby_median(mode, known, given) for mode in range(n_basis)])
        values[known] = given
        measured = np.zeros(n_basis, dtype=np.bool_)
        measured[known] = True
        return cls(values=values, measured=measured)

    def tuned(self, interaction_matrix: NDArray[Any]) -> NDArray[Any]:
        """Return ``D diag(g)``, the model's matrix scaled to the measured stroke of each mode.

        ``interaction_matrix`` ``(n_slopes, n_modes)`` has the first modes of the basis in single
        pass; so has the result.

        Raises
        ------
        ModelError
            If the matrix has more modes than the gains.
        """
        n_modes = interaction_matrix.shape[1]
        if n_modes > len(self.values):
            raise ModelError(
                f"calibration gains: found {n_modes} modes to tune; the gains know "
                f"{len(self.values)}"
            )
        gains = self.values[:n_modes].astype(interaction_matrix.dtype)
        return np.asarray(interaction_matrix * gains)


def _nearby_median(mode: int, known: NDArray[np.intp], gains: Array) -> float:
    """Return the median gain of the measured modes nearest in number."""
    nearest = np.argsort(np.abs(known - mode), kind="stable")[:_N_NEIGHBOURS]
    return float(np.median(gains[nearest]))


REFERENCE_MODES = (0, 7, 16, 26, 42, 64, 110, 200, 330, 450, 593)
REFERENCE_GAINS = (
    0.517, 0.502, 0.480, 0.463, 0.494, 0.518, 0.573, 0.629, 0.664, 0.692, 0.730,
)  # fmt: skip
"""Optical gains of FLAO's ``REFERENCE_MODES`` at 1" of seeing, which define the shape.

First principal component of the logarithms of true gains on the simulated diffractive telescope at
magnitudes 8 and 11, 0.6 to 1.2" (docs/results/tracking.md).
"""

CONTRAST = (0.34, 0.46, 0.72, 1.00, 0.49, 0.25, -0.29, -0.75, -0.94, -0.93, -0.96)
"""Second component at ``REFERENCE_MODES``: log gain of low against high modes, 1 at its largest."""

CONTRAST_SIGMA = 0.05
"""Prior 1 σ of its coefficient; 0.015 to 0.034 were found."""

STRENGTH_SIGMA = 0.5
"""Prior 1 σ of the strength of the residual; the reference has strength 1."""

COMMON_SIGMA = 0.05
"""Prior 1 σ of a factor common to all modes: mirror stroke, absolute scale of the model."""

SHAPE_SIGMA = 0.02
"""Prior 1 σ of a smooth departure from both shapes, far from any measured mode."""

SHAPE_SCALE = 0.7
"""Correlation length of that departure, in the natural logarithm of the mode number."""

MIN_RELATIVE_SIGMA = 0.015
"""1 σ by which the gain of a single mode departs from the smooth curve, relative."""

MAX_SINGLE_PASS_GAIN = 1.1
"""Largest median optical gain in single pass; above it the light has met the mirror twice."""

GAIN_FACTOR_RANGE = (0.5, 2.0)
"""Range of a mode's loop gain over the mean of all modes."""

GATE_GAIN_SIGMAS = 2.0
"""Number of σ above the estimated optical gain at which the gate requires stability."""

GAIN_RATE = 0.05 / np.sqrt(60.0)
"""Random walk of a gain, relative, 1 σ after one second: seeing changes it by 5 % in a minute."""

GAIN_SWING = 0.05
"""Relative 1 σ of the change of the optical gain with the seeing between two windows."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GainTable:
    """Optical gains of the first modes of the basis, and the loop gains that compensate them."""

    optical_gain: Array
    """``(n_modes,)`` measured over modelled response; up to 2 in double pass."""

    relative_sigma: Array
    """``(n_modes,)`` 1 σ of ``optical_gain``, relative."""

    @property
    def factors(self) -> Array:
        """Factors ``(n_modes,)`` on a common loop gain, of mean 1 before they are clipped."""
        inverse = 1.0 / self.optical_gain
        return np.asarray(np.clip(inverse / inverse.mean(), *GAIN_FACTOR_RANGE))

    @property
    def highest(self) -> Array:
        """Optical gain ``(n_modes,)`` with which a loop must be stable: 2 σ and the swing above."""
        sigma = np.hypot(self.relative_sigma, GAIN_SWING)
        return np.asarray(self.optical_gain * np.exp(GATE_GAIN_SIGMAS * sigma))

    def loop_gains(self, in_effect: float) -> Array:
        """Return integrator gains ``(n_modes,)`` whose product with the optical gain is uniform.

        The product is about ``in_effect`` for every mode.
        """
        mean = in_effect * float(np.mean(1.0 / self.optical_gain))
        return np.asarray(mean * self.factors)


def gain_table(measured: Sequence[ModeGain], n_modes: int) -> GainTable:
    """Return the optical gains of the first ``n_modes`` modes, inferred from the measured ones.

    The posterior of the Gaussian process of the module's docstring. Without measurements it is the
    prior, the reference at 1" of seeing.

    Raises
    ------
    ModelError
        If a gain is not positive, or a σ is negative.
    """
    modes = np.array([gain.mode for gain in measured], dtype=np.intp)
    found = np.array([gain.gain for gain in measured])
    spread = np.array([gain.sigma for gain in measured])
    if not (np.all(np.isfinite(found) & (found > 0.0)) and np.all(spread >= 0.0)):
        raise ModelError(
            f"gain table: found gains {found.tolist()} and sigmas {spread.tolist()}; expected "
            "positive numbers"
        )
    everywhere = np.arange(n_modes)
    # An optical gain is at most 1, so a clearly larger median can only be double pass.
    passes = 2.0 if len(found) and np.median(found) > MAX_SINGLE_PASS_GAIN else 1.0
    expected = _reference_log_gain(everywhere) + np.log(passes)
    covariance = _prior_covariance(everywhere, modes)
    variance = (
        (STRENGTH_SIGMA * _reference_log_gain(everywhere)) ** 2
        + (CONTRAST_SIGMA * _interpolate(CONTRAST, everywhere)) ** 2
        + COMMON_SIGMA**2
        + SHAPE_SIGMA**2
    )
    # Conditioning of the Gaussian process on the measured modes, in the logarithm of the gain,
    # where a stronger residual is a multiple of the same shape.
    if len(modes):
        times_ns = np.array([gain.t_ns_utc for gain in measured])
        age_s = (times_ns.max() - times_ns) / 1e9
        noise = np.diag((spread / found) ** 2 + MIN_RELATIVE_SIGMA**2)
        # Gains measured before the seeing changed are wrong together, however many they are.
        shape = _reference_log_gain(modes) / _reference_log_gain(modes).mean()
        noise += GAIN_RATE**2 * np.minimum.outer(age_s, age_s) * np.outer(shape, shape)
        weights = np.linalg.solve(_prior_covariance(modes, modes) + noise, covariance.T).T
        expected = expected + weights @ (
            np.log(found) - np.log(passes) - _reference_log_gain(modes)
        )
        variance -= np.einsum("ij,ij->i", weights, covariance)
    # Single modes depart from any smooth curve.
    variance = np.maximum(variance, 0.0) + MIN_RELATIVE_SIGMA**2
    return GainTable(
        optical_gain=np.exp(expected),
        relative_sigma=np.sqrt(variance),
    )


def _reference_log_gain(modes: NDArray[np.intp]) -> Array:
    """Return the logarithm of the reference's optical gain of these modes, interpolated."""
    return _interpolate(np.log(REFERENCE_GAINS), modes)


def _interpolate(values: ArrayLike, modes: NDArray[np.intp]) -> Array:
    place = np.log1p(np.array(REFERENCE_MODES))
    return np.asarray(np.interp(np.log1p(modes), place, np.asarray(values)))


def _prior_covariance(one: NDArray[np.intp], other: NDArray[np.intp]) -> Array:
    """Return the prior covariance of log optical gains, ``(len(one), len(other))``."""
    strength = STRENGTH_SIGMA**2 * np.outer(_reference_log_gain(one), _reference_log_gain(other))
    contrast = CONTRAST_SIGMA**2 * np.outer(
        _interpolate(CONTRAST, one), _interpolate(CONTRAST, other)
    )
    apart = (np.log1p(one)[:, None] - np.log1p(other)) / SHAPE_SCALE
    smooth = COMMON_SIGMA**2 + SHAPE_SIGMA**2 * np.exp(-0.5 * apart**2)
    return np.asarray(strength + contrast + smooth)
