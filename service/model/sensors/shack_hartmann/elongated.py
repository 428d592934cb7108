"""Spots of a laser star: each lenslet sees the layer of sodium aslant, elongated in its own way.

The star is no point: its image is that of a point, blurred. What counts of the pixels, blurred in
the same way, counts of a point's image as much: so centroids answer to a wavefront as those of a
point do, with other weights for every lenslet. What a field, a threshold or weights cut away of an
elongated spot, along its axis and across it, is all in them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.model.pupil import gauss_legendre
from service.model.sensors.shack_hartmann.spots import SPARE_NODES, Spots
from service.model.sensors.shack_hartmann.table import LaserStar

Array = NDArray[Any]

FWHM = math.sqrt(8.0 * math.log(2.0))
"""Full width at half maximum of a Gaussian, in σ."""

_STEP = 0.5
"""Step between angles, λ/d: the light of a lenslet has no finer structure."""

_BEYOND_SIGMA = 3.0
"""σ of the star that the angles go on beyond the field, and λ/d more."""

_BEYOND = 1.0


def elongation_rad(laser: LaserStar, places_m: Array) -> Array:
    """Return full widths at half maximum ``(..., 2)``, x and y, at places ``(..., 2)``, metres.

    Light from z above the middle of the layer, at height H, is displaced by ``z / H**2`` times the
    distance to the launcher: along the launcher's own beam the star does not move.
    """
    aslant = laser.thickness_m / laser.height_m**2
    return np.asarray((places_m - np.asarray(laser.launcher_m)) * aslant)


def blur_of(laser: LaserStar, places_m: Array, lambda_over_d: float) -> Array:
    """Return the star's covariance ``(..., 2, 2)`` [x, y], in (λ/d)², as lenslets there see it."""
    along = elongation_rad(laser, places_m) / (FWHM * lambda_over_d)
    across = math.radians(laser.spot_arcsec / 3600.0) / (FWHM * lambda_over_d)
    # A line blurred by a round spot: covariances of a convolution add.
    return along[..., :, None] * along[..., None, :] + across**2 * np.eye(2)


@dataclass(frozen=True, kw_only=True, eq=False)
class ElongatedSpots(Spots):
    """Pixels and centroids of lenslets that each see the star blurred in their own way."""

    blur: Array
    """``(n_lenslets, 2, 2)`` covariance of the star [x, y], (λ/d)²."""

    widest: float
    """σ along the axis of the most elongated spot of all, also of lenslets that are not here."""

    @property
    def _beyond(self) -> float:
        """Width beyond the field, on either side, from which light comes into it."""
        return _BEYOND_SIGMA * self.widest + _BEYOND

    @override
    @cached_property
    def nodes(self) -> tuple[Array, Array]:
        # Light from beyond the field is blurred into it: nodes must resolve its fringes, too.
        width = self.n_pixels * self.pixel + 2.0 * self._beyond
        places, weights = gauss_legendre(int(np.ceil(width)) + SPARE_NODES)
        return places / 2, weights / 2

    @cached_property
    def _line(self) -> Array:
        """``(n_angles,)`` along an axis, λ/d."""
        n = int(np.ceil((self.n_pixels * self.pixel / 2 + self._beyond) / _STEP))
        return _STEP * np.arange(-n, n + 1)

    @override
    @cached_property
    def _transform(self) -> Array:
        places, weights = self.nodes
        return np.exp(-2j * np.pi * self._line[:, None] * places) * weights

    @cached_property
    def _frequencies(self) -> Array:
        """``(n_angles,)`` of light along an axis, d/λ, and so of what is made of it."""
        return np.fft.fftfreq(len(self._line), _STEP)

    @cached_property
    def _spectrum(self) -> Array:
        """``(n_angles, n_angles)``: from light at angles to its frequencies, along an axis."""
        return np.exp(-2j * np.pi * self._frequencies[:, None] * self._line)

    @cached_property
    def _star(self) -> Array:
        """``(n_lenslets, n_angles, n_angles)`` [y, x] the star's spectrum."""
        f = self._frequencies
        y, x = f[:, None], f
        xx, xy, yy = (self.blur[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
        square = xx * x**2 + 2.0 * xy * x * y + yy * y**2
        # Fourier transform of a Gaussian of this covariance.
        return np.asarray(np.exp(-2.0 * np.pi**2 * square))

    @cached_property
    def _to_pixels(self) -> Array:
        """``(n_pixels, n_angles)``: from frequencies to light on pixels, along an axis."""
        f, wide = self._frequencies, self.pixel
        there = np.exp(2j * np.pi * wide * self._places[:, None] * f)
        return np.asarray(wide * np.sinc(wide * f) * there / len(f))

    @override
    @cached_property
    def _counts(self) -> tuple[Array, Array, Array]:
        counts = self.weights_of(self.images(np.ones((1, *[len(self.nodes[0])] * 2))))
        x = self.pixel * self._places
        return (
            self._integrate_pixels(counts),
            self._integrate_pixels(counts * x),
            self._integrate_pixels(counts * x[:, None]),
        )

    def _integrate_pixels(self, on_pixels: Array) -> Array:
        """Return what pixels ``(n, n_pixels, n_pixels)`` make count of a point's light at angles.

        The transpose of ``images``, light to pixels.
        """
        seen = self._star * (self._to_pixels.T @ on_pixels @ self._to_pixels)
        return np.asarray((self._spectrum.T @ seen @ self._spectrum).real)

    @override
    @property
    def memory_bytes(self) -> float:
        # the star's spectrum, what counts, and two complex arrays while they are multiplied
        return (4 * 8.0 + 2 * 16.0) * len(self.blur) * len(self._line) ** 2

    @override
    def images(self, amplitude: Array) -> Array:
        light = np.abs(self._transform_amplitude(amplitude)) ** 2
        # A blur is a product of spectra.
        spectrum = self._star * (self._spectrum @ light @ self._spectrum.T)
        return np.asarray((self._to_pixels @ spectrum @ self._to_pixels.T).real)

    @cached_property
    def variances(self) -> tuple[Array, Array]:
        """Return the variance of centroids by a photon's place, and by noise 1 of every pixel.

        ``(2, n_lenslets)`` each, along x and y, in (λ/d)², over the square of the photons yet.
        """
        full = self.images(np.ones((1, *[len(self.nodes[0])] * 2)))
        # Where a photon falls: its place times what the pixel counts is the centroid it makes.
        share = full / full.sum(axis=(1, 2), keepdims=True)
        counts = self.weights_of(full)
        x = self.pixel * self._places
        square = np.stack([(counts * x) ** 2, (counts * x[:, None]) ** 2])
        light = (counts * share).sum(axis=(1, 2)) ** 2
        return (square * share).sum(axis=(2, 3)) / light, square.sum(axis=(2, 3)) / light
