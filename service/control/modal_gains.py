"""Gains of the modes, each kind kept apart from the others.

Three factors stand between the model's D and what a sensor shows, and none may hide in another:

- the **calibration gain** belongs to the measured matrix: how much larger the mirror's stroke is
  than the model's, mode by mode. It is constant, on either side of 1, and goes into D:
  ``D_tuned = D diag(g)``, the paper's last step.
- the **optical gain** belongs to the sky: a pyramid in residual turbulence answers less than in
  a flat wavefront. It is at most 1, changes with the seeing, and goes into the loop gains.
- **passes** belong to the scene: by day the light meets the mirror twice and every slope doubles.
  It is stated, never part of D.
"""

from __future__ import annotations

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
    """How much of the model's response a measured matrix shows, for every mode of the basis."""

    values: Array
    """``(n_basis,)`` measured over ``passes`` times the model's; near 1."""

    measured: NDArray[np.bool_]
    """``(n_basis,)`` whether the mode was measured; the others take their neighbours' median."""

    passes: int
    """How often the light met the mirror in that measurement; not part of ``values``."""

    @classmethod
    def of_modes(
        cls, gains: NDArray[Any], modes: NDArray[np.intp], n_basis: int, *, passes: int
    ) -> CalibrationGains:
        """Extend the gains ``(n,)`` of the measured ``modes`` to a basis of ``n_basis``.

        Beyond the reference the mirror is taken to answer as at the nearest measured modes.

        Raises
        ------
        ModelError
            If modes and gains do not match, a gain is not positive, or ``passes`` is not 1 or 2.
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
        if passes not in {1, 2}:
            raise ModelError(f"calibration gains: found {passes} passes; expected 1 or 2")
        values = np.array([_nearby_median(mode, known, given) for mode in range(n_basis)])
        values[known] = given
        measured = np.zeros(n_basis, dtype=np.bool_)
        measured[known] = True
        return cls(values=values, measured=measured, passes=passes)

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


def single_pass(measured_matrix: NDArray[Any], passes: int) -> NDArray[Any]:
    """Return the matrix that light meeting the mirror once would have measured."""
    if passes not in {1, 2}:
        raise ModelError(f"interaction matrix: found {passes} passes; expected 1 or 2")
    return np.asarray(measured_matrix / measured_matrix.dtype.type(passes))


def optical_gains(modes: NDArray[np.intp], values: NDArray[Any], n_modes: int) -> Array:
    """Return the optical gain of every mode ``(n_modes,)`` from those of a few.

    It varies smoothly with the logarithm of the mode's number; outside the modes it stays.

    Raises
    ------
    ModelError
        If a value is not in (0, 1]: more than the flat response is no optical gain.
    """
    found = np.asarray(values, dtype=np.float64)
    if len(found) == 0 or not np.all((found > 0.0) & (found <= 1.0)):
        raise ModelError(
            f"optical gain: found {found.tolist()}; expected values in (0, 1]: a factor above 1 is "
            "a calibration gain or a second pass"
        )
    order = np.argsort(modes)
    place = np.log1p(np.asarray(modes, dtype=np.float64)[order])
    return np.asarray(np.interp(np.log1p(np.arange(n_modes)), place, found[order]))


def loop_gains(in_effect: Array, optical_gain: Array, passes: int) -> Array:
    """Return the integrator gains ``(n_modes,)`` that act as ``in_effect`` behind this sensor.

    For a reconstructor of the flat, single-pass response: the loop sees ``passes`` times the
    optical gain of it.
    """
    if passes not in {1, 2}:
        raise ModelError(f"loop gains: found {passes} passes; expected 1 or 2")
    return np.asarray(in_effect / (optical_gain * passes))


def _nearby_median(mode: int, known: NDArray[np.intp], gains: Array) -> float:
    """Return the median gain of the measured modes nearest in number."""
    nearest = np.argsort(np.abs(known - mode), kind="stable")[:_NEIGHBOURS]
    return float(np.median(gains[nearest]))
