"""Unknowns beside the registration: small, linear, and held back by what is usual.

Each is one more derivative in the projection, with a prior of its own. A turn of the slope axes is
always among them: a pyramid whose edges are turned by a degree would otherwise turn the
registration by 0.007 deg with 400 modes, and by 0.06 deg with the lowest 40.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.fit.options import FitOptions
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration

Array = NDArray[np.float64]

SLOPE_TURN_SIGMA_RAD = np.deg2rad(1.5)
"""A pyramid is aligned to the pixels to a degree or two."""

GAIN_MAP_ORDER = 4
"""Of the polynomial in x and y that the gain over the pupil is."""

GAIN_MAP_SIGMA = 0.3
"""Of each coefficient of the gain map."""

ANAMORPHOSIS_SIGMA = 0.02
"""Half the stretch of the mirror's image along one axis over the other."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Nuisances:
    """The unknowns beside the registration, in their order."""

    maps: Array
    """``(n_maps, n_slopes)`` gain over the pupil of each coefficient of the gain map."""

    anamorphosis: bool
    """Whether the two stretches are unknown."""

    @property
    def sigma(self) -> Array:
        """``(n_nuisances,)`` how large each may be, 1 σ."""
        stretches = [ANAMORPHOSIS_SIGMA] * (2 if self.anamorphosis else 0)
        maps = [GAIN_MAP_SIGMA] * len(self.maps)
        return np.array([SLOPE_TURN_SIGMA_RAD, *stretches, *maps])

    def derivatives(
        self, model: InteractionModel, alpha: Misregistration, matrix: NDArray[Any]
    ) -> Array:
        """Return ``(n_nuisances, n_slopes, n_modes)``: change of the matrix with each of them."""
        along_x, along_y = np.split(matrix, 2)
        found = [np.concatenate([-along_y, along_x])]
        if self.anamorphosis:
            found += list(model.stretch_derivatives(alpha))
        found += [pattern[:, None] * matrix for pattern in self.maps]
        return np.array(found)

    def gain_map(self, values: Array, valid: NDArray[np.bool_]) -> Array | None:
        """Return the gain over the pupil ``(n, n)``, mean 1; None without a gain map."""
        if not len(self.maps):
            return None
        gain = np.full(valid.shape, np.nan)
        coefficients = values[len(values) - len(self.maps) :]
        gain[valid] = 1.0 + coefficients @ self.maps[:, : int(valid.sum())]
        return gain

    def stretches(self, values: Array) -> Array | None:
        """Return the two stretches; None when they are not unknown."""
        return values[1:3].copy() if self.anamorphosis else None


def nuisances_of(options: FitOptions, valid: NDArray[np.bool_]) -> Nuisances:
    """Return the unknowns that these options ask for."""
    maps = _polynomials(valid) if options.gain_map else np.empty((0, 2 * int(valid.sum())))
    return Nuisances(maps=maps, anamorphosis=options.anamorphosis)


def _polynomials(valid: NDArray[np.bool_]) -> Array:
    """Return orthonormal polynomials over the valid subapertures without their mean, twice over."""
    n = len(valid)
    y, x = (np.stack(np.nonzero(valid)) - (n - 1) / 2) / (n / 2)
    powers = [
        x**i * y**j
        for i in range(GAIN_MAP_ORDER + 1)
        for j in range(GAIN_MAP_ORDER + 1 - i)
        if i + j > 0
    ]
    centred = np.array(powers) - np.mean(powers, axis=1, keepdims=True)
    orthonormal, _ = np.linalg.qr(centred.T)
    return np.tile(orthonormal.T * np.sqrt(valid.sum()), 2)
