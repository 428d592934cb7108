"""Spots of a Shack-Hartmann for any wavefront, and their centroids.

It shares only the nominal geometry with the service's model. The wavefront is interpolated linearly
between the points of the pupil onto a regular grid under each lenslet, propagated as a whole, and
summed on pixels. Centroids are those of noisy pixels, with a threshold for each spot in each frame.

A laser guide star sends light from many heights. The service's model blurs spots by a Gaussian
along a straight line; here the layer is cut into sheets, each sends light from its own height, and
the pixels collect it sheet by sheet.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ConfigurationError
from service.model.pupil import PupilGrid
from service.model.sensors.shack_hartmann.description import ShackHartmann
from service.model.sensors.shack_hartmann.table import Centroid, LaserStar
from service.model.slopes import SlopeRecipe

Array = NDArray[Any]

ANGLE_STEP = 0.5
"""Sampling of a point's light, λ/d; it has no finer structure."""

_SHEETS = 9
"""The layer is cut into, over four times its standard deviation."""

_BEYOND_SIGMA = 1.5
"""σ of the widest star that light is sampled beyond the field: little of it comes back into it."""

_FWHM = math.sqrt(8.0 * math.log(2.0))


class SodiumStar:
    """Spreads the light of a point over the pixels as a layer of sodium would."""

    def __init__(self, wfs: ShackHartmann, laser: LaserStar, subaperture_m: float) -> None:
        """Prepare the sheets of the layer for these lenslets."""
        n, m = wfs.n_subapertures, wfs.pixels_per_subaperture
        lambda_over_d = wfs.wavelength_m / subaperture_m
        across = math.radians(laser.spot_arcsec / 3600.0) / _FWHM / lambda_over_d
        sheets = np.linspace(-2.0, 2.0, _SHEETS)
        light = np.exp(-(sheets**2) / 2.0)
        heights = laser.height_m + sheets * laser.thickness_m / _FWHM
        # Relative to the mean height, on which the sensor is focused.
        parallax = (1.0 / laser.height_m - 1.0 / heights) / lambda_over_d
        from_launcher = subaperture_m * (np.arange(n) - (n - 1) / 2)[:, None] - laser.launcher_m
        aside = from_launcher[:, :, None] * parallax  # (n, 2, n_sheets)
        pixel = wfs.pixel_lambda_over_d(subaperture_m)
        borders = pixel * (np.arange(m + 1) - m / 2)
        beyond = _BEYOND_SIGMA * math.hypot(across, float(np.abs(aside).max()) / 2.0) + 0.5
        n_angles = math.ceil((m * pixel / 2 + beyond) / ANGLE_STEP)
        self.angles = ANGLE_STEP * np.arange(-n_angles, n_angles + 1)
        """``(n_angles,)`` along an axis where the light of a point is wanted, λ/d."""

        past = borders[:, None] - self.angles - aside[..., None, None]
        shares = np.diff(scipy.special.ndtr(past / across), axis=-2)
        self._from_x = shares[:, 0].astype(np.float32)
        """``(n, n_sheets, m, n_angles)``: what pixels of a column of lenslets get of each sheet."""

        weighted = shares[:, 1] * (light / light.sum())[:, None, None]
        self._from_y = weighted.astype(np.float32).reshape(n, _SHEETS * m, -1)

    def on_pixels(self, light: Array) -> Array:
        """Return ``(n, m, n, m)`` of the light of a point ``(n, n_angles, n, n_angles)``."""
        n, n_sheets, m, _ = self._from_x.shape
        along = self._from_y @ light.reshape(n, light.shape[1], -1)
        along = along.reshape(n, n_sheets, m, n, -1).transpose(3, 1, 0, 2, 4)
        seen = along.reshape(n, n_sheets, n * m, -1) @ self._from_x.swapaxes(2, 3)
        return np.asarray(seen.sum(axis=1).reshape(n, n, m, m).transpose(1, 2, 0, 3))


LENSLET_SAMPLING = 4
"""Points of the pupil per subaperture."""

_INSIDE_PIXEL = 2
"""Samples of the light along a side of a pixel, more where it is wider than λ/d."""

_FAINTEST = 0.05
"""Light of a spot over that of a flat wavefront below which its centroid is that of no spot: the
noise of its pixels would be divided by nothing."""


class DiffractiveLenslets:
    """The light on the pixels behind the lenslets, at one shift of the pupil's image.

    Raises
    ------
    ConfigurationError
        If the sensor has mean gradients, and so no spots.
    """

    def __init__(
        self,
        wfs: ShackHartmann,
        pupil: PupilGrid,
        subaperture_m: float,
        shift_subap: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        if wfs.centroid is Centroid.GRADIENT:
            raise ConfigurationError(
                'wfs.centroid: found "gradient" with --plant diffractive, expected spots, "cog" or '
                "another centroid, or --plant linear: a mean gradient has no light"
            )
        self._wfs, self._pupil, self._subaperture_m = wfs, pupil, subaperture_m
        self.shift_subap = shift_subap
        """(x, y) by which the pupil's image is moved."""

        self._pixel = wfs.pixel_lambda_over_d(subaperture_m)
        self._star = None if wfs.laser is None else SodiumStar(wfs, wfs.laser, subaperture_m)
        self._angles, angle = self._sample_field()
        self._n_nodes = max(8, int(np.ceil(len(self._angles) * angle)) + 4)
        self._on_x, self._on_y = (self._interpolate_nodes(shift) for shift in shift_subap)
        self._amplitude: Array = self._under(pupil.amplitude)
        self._wavenumber = np.float32(2 * np.pi / wfs.wavelength_m)
        self._edge, self._inside = _extend_points(pupil.lit)
        self._transform = self._to_angles(angle)
        self._flat = self.images(np.zeros(int(pupil.lit.sum()), dtype=np.float32))

    def at(self, shift_subap: tuple[float, float]) -> DiffractiveLenslets:
        """Return the same sensor with the image of the pupil elsewhere."""
        return DiffractiveLenslets(self._wfs, self._pupil, self._subaperture_m, shift_subap)

    def images(self, opd_m: Array) -> Array:
        """Return the light ``(n, m, n, m)``: row of lenslets, row of their pixels, so along x.

        ``opd_m`` is ``(n_points,)``, at the lit points of the pupil. The unit is the light of a
        full lenslet, the wings beyond its pixels counted.
        """
        # Continued linearly beyond the rim of the pupil, where nodes of partly lit lenslets fall.
        phase = self._wavenumber * self._under(2.0 * opd_m[self._edge] - opd_m[self._inside])
        field = np.empty(phase.shape, np.complex64)
        np.multiply(self._amplitude, np.cos(phase), out=field.real)
        np.multiply(self._amplitude, np.sin(phase), out=field.imag)
        n, nodes, rows = self._wfs.n_subapertures, self._n_nodes, self._transform
        seen = rows @ field.reshape(n, nodes, n * nodes)
        seen = seen.reshape(-1, nodes) @ rows.T
        light = (seen.real**2 + seen.imag**2).reshape(n, len(rows), n, len(rows))
        if self._star is not None:
            return self._star.on_pixels(light)
        m = self._wfs.pixels_per_subaperture
        # rows: lenslet, pixel, inside; columns: lenslet, pixel, inside
        return np.asarray(light.reshape(n, m, -1, n, m, len(rows) // m).sum(axis=(2, 5)))

    def signals(self, light: Array, valid: NDArray[np.bool_], recipe: SlopeRecipe) -> Array:
        """Return centroids ``(n_slopes,)`` of valid lenslets, waves across one."""
        spots, flat = (each.swapaxes(1, 2)[valid] for each in (light, self._flat))
        if self._wfs.centroid is Centroid.WEIGHTED:
            spots = spots * flat
        elif self._wfs.centroid is Centroid.THRESHOLD:
            brightest = spots.max(axis=(1, 2), keepdims=True)
            spots = np.where(spots >= np.float32(self._wfs.threshold or 0.0) * brightest, spots, 0)
        m = self._wfs.pixels_per_subaperture
        places = (self._pixel * (np.arange(m) - (m - 1) / 2)).astype(spots.dtype)
        total = spots.sum(axis=(1, 2))
        total = np.maximum(total, _FAINTEST * np.median(total))
        along = np.stack([spots.sum(axis=1) @ places, spots.sum(axis=2) @ places])
        return np.asarray((along / total).reshape(-1))

    def _interpolate_nodes(self, shift: float) -> Array:
        """Return how nodes under lenslets read the pupil's grid, ``(n n_nodes, n_grid)``."""
        n, grid = self._wfs.n_subapertures, self._pupil.coordinates
        places = (np.arange(n * self._n_nodes) + 0.5) / self._n_nodes - n / 2 - shift
        distance = np.abs(places[:, None] - grid) * self._pupil.sampling
        return np.maximum(1.0 - distance, 0.0).astype(np.float32)

    def _under(self, on_grid: Array) -> Array:
        """Return a map of the pupil's grid at the nodes of all lenslets."""
        return np.asarray(self._on_y @ on_grid.astype(np.float32, copy=False) @ self._on_x.T)

    def _sample_field(self) -> tuple[Array, float]:
        """Return where light is sampled along an axis, λ/d, and the distance between samples."""
        if self._star is not None:
            return self._star.angles, ANGLE_STEP
        inside = _INSIDE_PIXEL * int(np.ceil(self._pixel))
        n = self._wfs.pixels_per_subaperture * inside
        return self._pixel * ((np.arange(n) + 0.5) / inside - n / inside / 2), self._pixel / inside

    def _to_angles(self, angle: float) -> Array:
        """Return the transform of a lenslet's line of nodes to samples of its light."""
        nodes = (np.arange(self._n_nodes) + 0.5) / self._n_nodes - 0.5
        step = np.sqrt(angle) / self._n_nodes
        transform = step * np.exp(-2j * np.pi * self._angles[:, None] * nodes)
        return np.asarray(transform.astype(np.complex64))


def _extend_points(lit: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return lit points whose wavefronts continue it straight, twice the first less the second.

    Both ``(n_grid, n_grid)``: the nearest lit point and its neighbour across; where it is lit both
    are the point itself.
    """
    number = np.full(lit.shape, -1)
    number[lit] = np.arange(lit.sum())
    nearest = scipy.ndimage.distance_transform_edt(
        ~lit, return_distances=False, return_indices=True
    )
    across = np.clip(2 * nearest - np.indices(lit.shape), 0, len(lit) - 1)
    across = np.where(lit[tuple(across)], across, nearest)
    return number[tuple(nearest)], number[tuple(across)]
