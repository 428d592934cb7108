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

from service.model.pupil import gauss_legendre
from service.model.sensors.shack_hartmann.table import Centroid

Array = NDArray[Any]

_NODES_PER_PIXEL = 3
"""Along a side, and one for each λ/d that the pixel is wide: spots are that smooth."""

_SPARE_NODES = 6


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
        places, weights = gauss_legendre(int(np.ceil(self.n_pixels * self.pixel)) + _SPARE_NODES)
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
    def _counts(self) -> Array:
        """``(n_angles, n_angles)`` how much the light at an angle counts, of its quadrature too."""
        _, weights = self._angles
        of_angle = np.tile(weights, self.n_pixels)
        area = np.outer(of_angle, of_angle)
        n_inside = weights.size
        light = self.images(np.ones((1, *[len(self.nodes[0])] * 2)))[0]
        light /= light.max()
        if self.centroid is Centroid.CENTRE_OF_GRAVITY:
            light = np.ones_like(light)
        elif self.centroid is Centroid.THRESHOLD:
            light = (light >= self.threshold).astype(np.float64)
        return area * np.kron(light, np.ones((n_inside, n_inside)))

    def _seen(self, amplitude: Array) -> Array:
        return np.asarray(self._transform @ amplitude @ self._transform.T)

    def images(self, amplitude: Array) -> Array:
        """Return the light on the pixels ``(n_lenslets, n_pixels, n_pixels)`` [y, x]."""
        _, weights = self._angles
        of_angle = np.tile(weights, self.n_pixels)
        light = np.abs(self._seen(amplitude)) ** 2 * np.outer(of_angle, of_angle)
        n, inside = self.n_pixels, weights.size
        return np.asarray(light.reshape(-1, n, inside, n, inside).sum(axis=(2, 4)))

    def light(self, first: Array, second: Array) -> Array:
        """Return the light that counts ``(n_lenslets,)``, bilinear in two amplitudes.

        Amplitudes are ``(n_lenslets, n_nodes, n_nodes)`` [y, x] at the nodes.
        """
        product = self._seen(first).conj() * self._seen(second)
        return np.asarray(np.einsum("nij,ij->n", product.real, self._counts))

    def pull(self, outer: Array, inner: Array) -> tuple[Array, Array]:
        """Return how far phase pulls a spot along x, and along y; not over its light yet.

        ``(n_lenslets, n_nodes, n_nodes)`` each, per radian, bilinear in two amplitudes: where the
        phase is, and with which light it interferes. Quadrature weights are in it.
        """
        _, weights = self.nodes
        seen = self._seen(inner).conj() * self._counts
        place = self.pixel * np.repeat(self._places, self._angles[0].shape[1])
        back = self._transform / weights
        lit = -2.0 * outer * np.outer(weights, weights)
        along_x, along_y = (
            lit * np.imag(back.T @ (seen * moment) @ back) for moment in (place, place[:, None])
        )
        return along_x, along_y
