"""The pupil: points, their light, and lit subapertures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument, PupilMap
from service.model.slopes import orient_mask, rtc_mask

_EDGE_NODES = 32
"""Gauss-Legendre nodes across a cell: area fractions good to about 1e-4."""

_PARTS = 8
"""Parts of a cell along either axis that an arm's shadow is looked at in."""

_FULL_SHARE = 0.999
"""Light of a full subaperture, to what those are good for."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Illumination:
    """Evenness of the beam, seen from its own centre; it moves with the pupil images."""

    coordinates: NDArray[np.float64]
    """``(n,)`` rising positions along either axis, in subapertures from the beam's centre."""

    intensity: NDArray[np.float64]
    """``(n, n)``, [y, x]: light over that of an even beam; smooth beyond the outline."""

    def __post_init__(self) -> None:
        """Refuse light that cannot be.

        Raises
        ------
        ModelError
            If the map is not square over its coordinates, not finite, negative or dark.
        """
        n = len(self.coordinates)
        if self.intensity.shape != (n, n):
            raise ModelError(f"illumination: found {self.intensity.shape}; expected {(n, n)}")
        if not np.all(np.isfinite(self.intensity)) or self.intensity.min() < 0.0:
            raise ModelError("illumination: found a negative or not finite intensity")
        if not self.intensity.any():
            raise ModelError("illumination: found no light at all")

    def at(self, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the intensity ``(m, m)`` on a grid; beyond the map that of its edge."""
        low, high = self.coordinates[0], self.coordinates[-1]
        clipped = np.clip(coordinates, low, high)
        axes = (self.coordinates, self.coordinates)
        points = np.stack(np.meshgrid(clipped, clipped, indexing="ij"), axis=-1)
        return np.asarray(scipy.interpolate.RegularGridInterpolator(axes, self.intensity)(points))


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

    def lit_by(self, illumination: Illumination) -> PupilGrid:
        """Return the same pupil under this light: its amplitude times the root of the intensity."""
        root = np.sqrt(illumination.at(self.coordinates))
        return replace(self, amplitude=self.amplitude * root)


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


def instrument_pupil(instrument: Instrument, sampling: int) -> PupilGrid:
    """Return the instrument's evenly lit pupil, ``sampling`` points per subaperture."""
    pupil, grid = _drawn(_outline(instrument), sampling), getattr(instrument.wfs, "fft_grid", None)
    if grid is None or grid.points_per_subaperture != sampling or instrument.pupil is not None:
        return pupil
    # Points of a simulation are lit or not; with grey ones 2.4 % of a matrix were left over.
    return replace(pupil, amplitude=np.round(pupil.amplitude))


class _Outline(NamedTuple):
    """All that a pupil is drawn of; lengths in subapertures."""

    n_subapertures: int
    diameter: float
    obscuration_ratio: float
    spiders: float
    spiders_deg: tuple[float, ...]
    own: PupilMap | None
    subaperture_m: float


def _outline(instrument: Instrument) -> _Outline:
    return _Outline(
        n_subapertures=instrument.wfs.n_subapertures,
        diameter=instrument.wfs.pupil_diameter,
        obscuration_ratio=instrument.obscuration_ratio,
        spiders=(instrument.spiders_m or 0.0) / instrument.subaperture_m,
        spiders_deg=instrument.spiders_deg,
        own=instrument.pupil,
        subaperture_m=instrument.subaperture_m,
    )


@lru_cache(maxsize=16)
def _drawn(outline: _Outline, sampling: int) -> PupilGrid:
    if outline.own is not None:
        return _pupil_from_map(outline, outline.own, sampling)
    ring = annular_pupil(
        n_subapertures=outline.n_subapertures,
        diameter_subap=outline.diameter,
        obscuration_ratio=outline.obscuration_ratio,
        sampling=sampling,
    )
    if not outline.spiders_deg:
        return ring
    return replace(ring, amplitude=ring.amplitude * (1.0 - _shadows(ring, outline)))


def _pupil_from_map(outline: _Outline, own: PupilMap, sampling: int) -> PupilGrid:
    """Return a pupil from its map: of every cell the share of its area that is lit."""
    step = own.pitch_m / outline.subaperture_m
    width = max(outline.n_subapertures, outline.diameter, max(own.lit.shape) * step)
    # Rounding of the pitch must not add a ring of dark points.
    n = sampling * int(np.ceil(width - 1e-6))
    coordinates = (np.arange(n) - (n - 1) / 2) / sampling
    along_y, along_x = (_shares(coordinates, sampling, m, step) for m in own.lit.shape)
    amplitude = np.clip(along_y @ own.lit @ along_x.T, 0.0, 1.0)
    return PupilGrid(sampling=sampling, coordinates=coordinates, amplitude=amplitude)


def _shares(
    coordinates: NDArray[np.float64], sampling: int, m: int, step: float
) -> NDArray[np.float64]:
    """Return which share of each cell ``(n, m)`` each of ``m`` points of a map covers, one axis."""
    points = (np.arange(m) - (m - 1) / 2) * step
    # Overlap of two intervals: a cell of the grid and a point of the map.
    half, wide = 0.5 / sampling, step / 2
    high = np.minimum(coordinates[:, None] + half, points + wide)
    low = np.maximum(coordinates[:, None] - half, points - wide)
    return np.asarray(np.maximum(high - low, 0.0) * sampling)


def _shadows(pupil: PupilGrid, outline: _Outline) -> NDArray[np.float64]:
    """Return the share of every cell ``(n, n)`` that an arm of the spider hides.

    Cells near an arm are divided; of each part the share is that of an edge across it.
    """
    cell, centres = 1.0 / pupil.sampling, pupil.coordinates
    directions = [
        (float(np.cos(angle)), float(np.sin(angle))) for angle in np.deg2rad(outline.spiders_deg)
    ]
    near = np.zeros((len(centres), len(centres)), np.bool_)
    for cosine, sine in directions:
        reach = outline.spiders / 2 + cell * (abs(cosine) + abs(sine))
        near |= np.abs(cosine * centres[:, None] - sine * centres) < reach
    inside = ((np.arange(_PARTS) + 0.5) / _PARTS - 0.5) * cell
    row, column = np.nonzero(near)
    y = centres[row][:, None, None] + inside[:, None]
    x = centres[column][:, None, None] + inside
    part, hidden = cell / _PARTS, np.zeros((len(row), _PARTS, _PARTS))
    for cosine, sine in directions:
        width = part * (abs(cosine) + abs(sine))  # of a square part, seen along the edge
        across = np.abs(cosine * y - sine * x)
        covered = np.clip((outline.spiders / 2 - across) / width + 0.5, 0.0, 1.0)
        # An arm is a ray from the centre: nothing is hidden on the other side.
        covered *= np.clip((cosine * x + sine * y) / width + 0.5, 0.0, 1.0)
        # The larger share and not the sum: where arms meet they hide the same light.
        np.maximum(hidden, covered, out=hidden)
    shares = np.zeros(near.shape)
    shares[near] = hidden.mean(axis=(1, 2))
    return shares


def valid_subapertures(instrument: Instrument) -> NDArray[np.bool_]:
    """Return the mask ``(n, n)`` [y, x] in our axes: the instrument's own, or by flux at α = 0."""
    own = instrument.wfs.valid_subapertures
    if own is None:
        return lit_subapertures(instrument)
    return orient_mask(own, instrument.slopes.assumed_orientation)


def rtc_valid_subapertures(instrument: Instrument) -> NDArray[np.bool_]:
    """Return the mask ``(n, n)`` [y, x] in the RTC's own axes, in which its slopes are listed."""
    if instrument.wfs.valid_subapertures is not None:
        return instrument.wfs.valid_subapertures
    return rtc_mask(lit_subapertures(instrument), instrument.slopes.assumed_orientation)


def lit_subapertures(instrument: Instrument) -> NDArray[np.bool_]:
    """Return which subapertures ``(n, n)`` have enough of the pupil's area at α = 0.

    The flux is the pupil's light on each subaperture, so that the mask depends neither on the
    sampling nor on the light diffracted out of the images.
    """
    return np.asarray(light_per_subaperture(instrument) >= instrument.wfs.flux_threshold)


def fully_lit_subapertures(instrument: Instrument) -> NDArray[np.bool_]:
    """Return which subapertures ``(n, n)`` the edge of the pupil does not cut at α = 0."""
    return np.asarray(light_per_subaperture(instrument) > _FULL_SHARE)


def light_per_subaperture(instrument: Instrument) -> NDArray[np.float64]:
    """Return the share of each subaperture ``(n, n)`` that the pupil lights at α = 0."""
    return _light_per_subaperture(_outline(instrument))


@lru_cache(maxsize=8)
def _light_per_subaperture(outline: _Outline) -> NDArray[np.float64]:
    """Return the share of each subaperture ``(n, n)`` that the pupil lights."""
    # Of eight by eight cells each, whose lit shares are known to 1e-4.
    n, fine = outline.n_subapertures, _drawn(outline, 8).amplitude
    # The grid of the pupil may be larger than that of the sensor; both have the same centre.
    margin = (len(fine) - 8 * n) // 2
    inner = fine[margin : margin + 8 * n, margin : margin + 8 * n]
    return np.asarray(inner.reshape(n, 8, n, 8).mean(axis=(1, 3)))


@cache
def gauss_legendre(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ``n`` nodes and weights of Gauss and Legendre on -1 to 1; every model asks."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return nodes, weights


def _disc_fraction(
    coordinates: NDArray[np.float64], radius: float, sampling: int
) -> NDArray[np.float64]:
    """Fraction of each cell's area inside a centred disc: the integral of the chord over x."""
    half = 0.5 / sampling
    nodes, weights = gauss_legendre(_EDGE_NODES)
    x = coordinates[:, None] + half * nodes
    chord = np.sqrt(np.maximum(radius**2 - x**2, 0.0))
    top = np.minimum(coordinates[:, None, None] + half, chord)
    bottom = np.maximum(coordinates[:, None, None] - half, -chord)
    covered = np.maximum(top - bottom, 0.0) / (2 * half)
    return np.asarray(covered @ (weights / 2))
