"""Calibration gain, optical gain and passes, kept apart.

Three factors stand between the model's D and what a sensor shows, and none may hide in another:

- the **calibration gain** belongs to the measured matrix: how much larger the mirror's stroke is
  than the model's, mode by mode. It is constant, on either side of 1, and goes into D:
  ``D_tuned = D diag(g)``, the paper's last step.
- the **optical gain** belongs to the sky: a pyramid in residual turbulence answers less than in
  a flat wavefront. It is at most 1, changes with the seeing, and goes into the loop gains: the
  table of them stands beside a reconstructor and is never folded into it.
- **passes** belong to the scene: by day the light meets the mirror twice and every slope doubles.
  It is stated, never part of D.

The optical gain of every mode comes from that of a few. A pyramid in a residual of structure
function D responds as behind an incoherent source of mutual coherence ``exp(-D/2)``: the logarithm
of a mode's optical gain is the strength of the residual times a shape that the modulation and the
mode's spatial frequency fix. The shape is read off the diffractive telescope
(docs/results/optical_gain.md); its strength, a common factor and a smooth departure are found from
the modes that were dithered, as a Gaussian process whose uncertainty grows away from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError

Array = NDArray[np.float64]

_NEIGHBOURS = 25
"""Measured modes whose median stands for one that was not measured."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationGains:
    """Measured over modelled response, for every mode of the basis."""

    values: Array
    """``(n_basis,)`` measured over the model's, passes divided out; near 1."""

    measured: NDArray[np.bool_]
    """``(n_basis,)`` whether the mode was measured; the others take their neighbours' median."""

    @classmethod
    def of_modes(
        cls, gains: NDArray[Any], modes: NDArray[np.intp], n_basis: int
    ) -> CalibrationGains:
        """Extend the gains ``(n,)`` of the measured ``modes`` to a basis of ``n_basis``.

        Beyond the reference the mirror is taken to answer as at the nearest measured modes.

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
        """Return ``D diag(g)``: the model's columns with the stroke the mirror really has.

        ``interaction_matrix`` is ``(n_slopes, n_modes)``, the first modes of the basis, of a
        single pass; so is the result.
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
    nearest = np.argsort(np.abs(known - mode), kind="stable")[:_NEIGHBOURS]
    return float(np.median(gains[nearest]))


REFERENCE_MODES = (0, 12, 20, 36, 64, 112, 150, 195, 257, 340, 449, 501, 593)
REFERENCE_GAINS = (
    0.516, 0.511, 0.504, 0.502, 0.543, 0.578, 0.608, 0.628, 0.648, 0.681, 0.710, 0.722, 0.787,
)  # fmt: skip
"""Optical gains of FLAO's modes at 1" of seeing: the shape."""

STRENGTH_SIGMA = 0.5
"""1 σ of the residual's strength before anything is measured: 1 is the reference's."""

COMMON_SIGMA = 0.05
"""Of a factor common to all modes: the mirror's stroke, the model's absolute scale."""

SHAPE_SIGMA = 0.06
"""Of a smooth departure from the shape, far from any measured mode."""

SHAPE_SCALE = 0.7
"""Over which such a departure changes, in units of the logarithm of the mode's number."""

MIN_SIGMA = 0.02
"""Of one measured mode, relative: the response is not diagonal."""

TWO_PASSES_ABOVE = 1.1
"""A median above this is light that met the mirror twice: twice an optical gain."""

FACTOR_BOUNDS = (0.5, 2.0)
"""No mode's loop gain is changed by more than these against the mean of all."""

GATE_SIGMA = 2.0
GATE_SWING = 0.05
"""Relative swing of the gain with the seeing, from one window to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeGain:
    """The optical gain of one mode, followed over the windows that dithered it."""

    mode: int
    """0-based basis index."""

    gain: float
    """Modulus of the sensor's response over the model's."""

    sigma: float
    """1 σ of it at ``t_ns_utc``."""

    scatter: float
    """1 σ of a single window, as the windows themselves scattered."""

    t_ns_utc: int
    """End of the last window that held this mode."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GainTable:
    """The optical gain of the first modes of the basis, and what loop gains undo it."""

    optical_gain: Array
    """``(n_modes,)`` how much of the model's response the sensor shows; up to 2 by day."""

    relative_sigma: Array
    """``(n_modes,)`` 1 σ of it, as a share of it."""

    @property
    def factors(self) -> Array:
        """``(n_modes,)`` by which to multiply one loop gain for all: mean 1, bounded."""
        inverse = 1.0 / self.optical_gain
        return np.asarray(np.clip(inverse / inverse.mean(), *FACTOR_BOUNDS))

    @property
    def highest(self) -> Array:
        """``(n_modes,)`` optical gain that a loop must bear: two σ up, with the seeing's swing."""
        sigma = np.hypot(self.relative_sigma, GATE_SWING)
        return np.asarray(self.optical_gain * np.exp(GATE_SIGMA * sigma))

    def loop_gains(self, in_effect: float) -> Array:
        """Return ``(n_modes,)`` integrator gains that act as about ``in_effect`` on every mode."""
        mean = in_effect * float(np.mean(1.0 / self.optical_gain))
        return np.asarray(mean * self.factors)


def gain_table(measured: Sequence[ModeGain], n_modes: int) -> GainTable:
    """Return the table of the first ``n_modes`` modes; nothing measured: what is expected.

    Raises
    ------
    ModelError
        If a gain is not a positive number.
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
    passes = 2.0 if len(found) and np.median(found) > TWO_PASSES_ABOVE else 1.0
    expected, covariance = _expected(everywhere) + np.log(passes), _covariance(everywhere, modes)
    variance = np.diag(_covariance(everywhere, everywhere)).copy()
    if len(modes):
        noise = (spread / found) ** 2 + MIN_SIGMA**2
        weights = np.linalg.solve(_covariance(modes, modes) + np.diag(noise), covariance.T).T
        expected = expected + weights @ (np.log(found) - np.log(passes) - _expected(modes))
        variance -= np.einsum("ij,ij->i", weights, covariance)
    return GainTable(
        optical_gain=np.exp(expected),
        relative_sigma=np.sqrt(np.maximum(variance, 0.0)),
    )


def _expected(modes: NDArray[np.intp]) -> Array:
    """Return the logarithm of the reference's optical gain of these modes."""
    place = np.log1p(np.array(REFERENCE_MODES))
    return np.asarray(np.interp(np.log1p(modes), place, np.log(REFERENCE_GAINS)))


def _covariance(one: NDArray[np.intp], other: NDArray[np.intp]) -> Array:
    """Return the prior covariance of the logarithms, ``(len(one), len(other))``."""
    strength = STRENGTH_SIGMA**2 * np.outer(_expected(one), _expected(other))
    apart = (np.log1p(one)[:, None] - np.log1p(other)) / SHAPE_SCALE
    return np.asarray(strength + COMMON_SIGMA**2 + SHAPE_SIGMA**2 * np.exp(-0.5 * apart**2))
