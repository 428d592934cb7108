"""The pupil: where the phase lives, and how much light passes at each point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError

_EDGE_NODES = 32
"""Gauss-Legendre nodes across a cell: area fractions good to about 1e-4."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PupilGrid:
    """Square grid over the pupil image, ``sampling`` points per subaperture, and its light.

    Lengths are in subapertures; the origin is the centre of the pupil.
    """

    sampling: int
    """Points per subaperture."""

    coordinates: NDArray[np.float64]
    """``(n,)`` positions along either axis: ``(i - (n - 1) / 2) / sampling``."""

    amplitude: NDArray[np.float64]
    """``(n, n)``, [y, x]: field amplitude; on the edge the lit fraction of the cell."""

    @property
    def lit(self) -> NDArray[np.bool_]:
        """``(n, n)`` mask of the points that see any light."""
        return self.amplitude > 0.0

    @property
    def points(self) -> NDArray[np.float64]:
        """``(n_points, 2)`` x and y of the lit points, row-major."""
        y, x = np.nonzero(self.lit)
        return np.column_stack([self.coordinates[x], self.coordinates[y]])

    @property
    def weights(self) -> NDArray[np.float64]:
        """``(n_points,)`` share of the pupil's area at each lit point; sums to 1."""
        lit = self.amplitude[self.lit]
        return np.asarray(lit / lit.sum())


def annular_pupil(
    *, n_subapertures: int, diameter_subap: float, obscuration_ratio: float, sampling: int
) -> PupilGrid:
    """Return the grey pupil of an annular aperture.

    The amplitude of a cell is the fraction of its area inside the annulus: a binary edge would
    make the matrix jump as the sampling changes.

    Raises
    ------
    ModelError
        If the sampling is below 1, the obscuration not in [0, 1) or the diameter not positive.
    """
    if sampling < 1 or not 0.0 <= obscuration_ratio < 1.0 or diameter_subap <= 0.0:
        raise ModelError(
            f"pupil: found sampling {sampling}, obscuration {obscuration_ratio}, diameter "
            f"{diameter_subap} subap; expected >= 1, in [0, 1), > 0"
        )
    n = sampling * int(np.ceil(max(n_subapertures, diameter_subap)))
    coordinates = (np.arange(n) - (n - 1) / 2) / sampling
    radius = diameter_subap / 2
    amplitude = _disc_fraction(coordinates, radius, sampling)
    amplitude -= _disc_fraction(coordinates, radius * obscuration_ratio, sampling)
    return PupilGrid(
        sampling=sampling, coordinates=coordinates, amplitude=np.clip(amplitude, 0.0, 1.0)
    )


def _disc_fraction(
    coordinates: NDArray[np.float64], radius: float, sampling: int
) -> NDArray[np.float64]:
    """Fraction of each cell's area inside a centred disc: the integral of the chord over x."""
    half = 0.5 / sampling
    nodes, weights = np.polynomial.legendre.leggauss(_EDGE_NODES)
    x = coordinates[:, None] + half * nodes
    chord = np.sqrt(np.maximum(radius**2 - x**2, 0.0))
    top = np.minimum(coordinates[:, None, None] + half, chord)
    bottom = np.maximum(coordinates[:, None, None] - half, -chord)
    covered = np.maximum(top - bottom, 0.0) / (2 * half)
    return np.asarray(covered @ (weights / 2))
