"""Spots of lenslets: how a centroid answers to the wavefront across one, to first order.

The field of a lenslet is transformed to the pixels and weighted there as the centroid weights them;
transformed back, it says how far each point of the lenslet pulls. Nothing is assumed of the spot:
a field of view that cuts its wings, large pixels and light that the pupil's edge cuts are all in.

Lengths on a lenslet are in its width d, angles in λ/d, so that a centroid is in waves across it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.model.pupil import gauss_legendre
from service.model.sensors.shack_hartmann.table import Centroid

Array = NDArray[Any]

_NODES_PER_PIXEL = 3
"""Along a side, and one for each λ/d that the pixel is wide: spots are that smooth."""

SPARE_NODES = 6
"""More than fringes of light at the border of what is seen need."""


_MOVED = 9
"""Places of a spot that is moved about."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Spots:
    """Pixels and centroid of every lenslet alike."""

    n_pixels: int
    """Along a side of the field."""

    pixel: float
    """Width of a pixel, λ/d."""

    centroid: Centroid
    threshold: float | None = None

    @cached_property
    def nodes(self) -> tuple[Array, Array]:
        """Quadrature ``(n_nodes,)`` across a lenslet, -1/2 to 1/2, and its weights; sum 1.

        As many as the finest fringe needs that the border of the field makes.
        """
        places, weights = gauss_legendre(int(np.ceil(self.n_pixels * self.pixel)) + SPARE_NODES)
        return places / 2, weights / 2

    @cached_property
    def _angles(self) -> tuple[Array, Array]:
        """Quadrature across the field, ``(n_pixels, n_inside)`` angles, and weights inside."""
        places, weights = gauss_legendre(_NODES_PER_PIXEL + int(np.ceil(self.pixel)))
        return self.pixel * (self._places[:, None] + places / 2), self.pixel * weights / 2

    @property
    def _places(self) -> Array:
        """Middle of each pixel, in pixels from the middle of the field."""
        return np.arange(self.n_pixels) - (self.n_pixels - 1) / 2

    @cached_property
    def _transform(self) -> Array:
        """``(n_angles, n_nodes)``: from the field on a lenslet to the field on its pixels."""
        places, weights = self.nodes
        return np.exp(-2j * np.pi * self._angles[0].reshape(-1, 1) * places) * weights

    @cached_property
    def _area(self) -> Array:
        """``(n_angles, n_angles)`` the quadrature's own weights."""
        of_angle = np.tile(self._angles[1], self.n_pixels)
        return np.outer(of_angle, of_angle)

    @cached_property
    def _counts(self) -> tuple[Array, Array, Array]:
        """Weight of the light at an angle, and that weight times its pixel's x, and y.

        ``(..., n_angles, n_angles)`` each, including the quadrature weight.
        """
        # What counts is decided by a fully lit lenslet: thresholds follow the brightest pixel.
        full = self.images(np.ones((1, *[len(self.nodes[0])] * 2)))
        counts = self._spread(self.weights_of(full))
        x = self.pixel * np.repeat(self._places, self._angles[0].shape[1])
        return counts, counts * x, counts * x[:, None]

    def weights_of(self, full: Array) -> Array:
        """Return how much each pixel counts, of spots ``(n, n_pixels, n_pixels)`` in full light."""
        # Relative to the brightest pixel, as the threshold is.
        light = full / full.max(axis=(1, 2), keepdims=True)
        match self.centroid:
            case Centroid.CENTRE_OF_GRAVITY | Centroid.GRADIENT:
                return np.ones_like(light)
            case Centroid.THRESHOLD:
                return np.asarray(light >= self.threshold, np.float64)
            case Centroid.WEIGHTED:
                return np.asarray(light)

    def _spread(self, on_pixels: Array) -> Array:
        """Return pixel values ``(n, n_pixels, n_pixels)`` at the angles within the pixels."""
        n_inside = self._angles[0].shape[1]
        return np.asarray(np.kron(on_pixels, np.ones((n_inside, n_inside))) * self._area)

    def _transform_amplitude(self, amplitude: Array) -> Array:
        return np.asarray(self._transform @ amplitude @ self._transform.T)

    def images(self, amplitude: Array) -> Array:
        """Return the light on the pixels ``(n_lenslets, n_pixels, n_pixels)`` [y, x]."""
        light = np.abs(self._transform_amplitude(amplitude)) ** 2 * self._area
        # Several angles belong to a pixel: their light is summed.
        n, inside = self.n_pixels, self._angles[0].shape[1]
        return np.asarray(light.reshape(-1, n, inside, n, inside).sum(axis=(2, 4)))

    @property
    def memory_bytes(self) -> float:
        """Memory of spots that differ from lenslet to lenslet, bytes."""
        return 0.0

    def light(self, first: Array, second: Array) -> Array:
        """Return the light that counts ``(n_lenslets,)``, bilinear in two amplitudes.

        Amplitudes are ``(n_lenslets, n_nodes, n_nodes)`` [y, x] at the nodes.
        """
        product = self._transform_amplitude(first).conj() * self._transform_amplitude(second)
        return np.asarray(np.sum(product.real * self._counts[0], axis=(1, 2)))

    def pull(self, outer: Array, inner: Array) -> tuple[Array, Array]:
        """Return how far phase pulls a spot along x, and along y; not over its light yet.

        ``(n_lenslets, n_nodes, n_nodes)`` each, per radian, bilinear in two amplitudes: where the
        phase is, and with which light it interferes. Quadrature weights are in it.
        """
        _, weights = self.nodes
        seen = self._transform_amplitude(inner).conj()
        # The transform contains the quadrature weights, and so does ``lit``: count them once.
        back = self._transform / weights
        lit = -2.0 * outer * np.outer(weights, weights)
        along_x, along_y = (
            lit * np.imag(back.T @ (seen * moment) @ back) for moment in self._counts[1:]
        )
        return along_x, along_y

    def straightness(self, moves: float) -> Array:
        """Return how far centroids go, ``(2 * n_lenslets,)`` along x, then y, over what is linear.

        Of full lenslets, as spots move to ``moves`` λ/d on either side and pixels pass the
        threshold; linear: what pixels that count at rest make of small moves.
        """
        nodes = self.nodes[0]
        full = np.ones((1, len(nodes), len(nodes)))
        aside = np.linspace(-moves, moves, _MOVED)
        found = []
        for axis, pull in enumerate(self.pull(full, full)):
            along = nodes[:, None] if axis else nodes
            # The answer to a tilt that the model has, per λ/d of motion.
            linear = 2 * np.pi * (pull * along).sum(axis=(1, 2)) / self.light(full, full)
            seen = [self._centroids(full * np.exp(2j * np.pi * far * along), axis) for far in aside]
            fitted = aside @ np.array(seen) / (aside @ aside)
            found.append(fitted / np.maximum(linear, 1e-3))
        return np.concatenate(found)

    def _centroids(self, amplitude: Array, axis: int) -> Array:
        """Return centroids ``(n_lenslets,)`` along x (0) or y (1), each by its own threshold."""
        spots = self.images(amplitude)
        brightest = spots.max(axis=(1, 2), keepdims=True)
        spots = np.where(spots >= (self.threshold or 0.0) * brightest, spots, 0.0)
        line = spots.sum(axis=1 + axis)
        return np.asarray(line @ self._places * self.pixel / line.sum(axis=1))


@dataclass(frozen=True, kw_only=True, eq=False)
class MeanGradients(Spots):
    """Lenslets whose signals are mean gradients, waves across one, as in geometric simulators.

    There is no spot: with an unlimited field of fine pixels the centroid is the mean gradient of
    the phase, weighted by the light at each point. A field of six λ/d weighs the rim of a lenslet
    differently, which rotates a fit of mean gradients by some thousandths of a degree
    (docs/results/accuracy.md). Pixels only see the light.
    """

    @cached_property
    def _slope(self) -> Array:
        """``(n_nodes, n_nodes)``: from heights at the nodes to slopes there, per width.

        Of the polynomial through the heights: by the barycentric weights (Berrut & Trefethen 2004,
        eq. 9.4).
        """
        places = self.nodes[0]
        apart = places[:, None] - places
        np.fill_diagonal(apart, 1.0)
        weights = 1.0 / apart.prod(axis=1)
        slope = weights / weights[:, None] / apart
        np.fill_diagonal(slope, 0.0)
        np.fill_diagonal(slope, -slope.sum(axis=1))
        return np.asarray(slope)

    @override
    def light(self, first: Array, second: Array) -> Array:
        _, weights = self.nodes
        return np.asarray(np.einsum("nyx,nyx,y,x->n", first, second, weights, weights))

    @override
    def pull(self, outer: Array, inner: Array) -> tuple[Array, Array]:
        _, weights = self.nodes
        lit = outer * inner * np.outer(weights, weights) / (2.0 * np.pi)
        return lit @ self._slope, self._slope.T @ lit
