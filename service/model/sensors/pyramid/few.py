"""A pyramid image's response to a few shapes, without the gradient at every point of the pupil.

``response_k(x) = sum_m Im{ conj(psi_m(x)) Wy (X_k exp(i k_m u)) Wx }``, psi_m the field at rest of
source point m and ``X_k`` the shape times the amplitude. It is computed source by source for all
subapertures together: the sum over y with the shapes, the sum over the nodes along x with the field
at rest, then the product of both. Each is a product of matrices that stay in the cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.sensors.sensor import Mapper

Array = NDArray[Any]

_SOURCES_TOGETHER = 10
"""Pairs of source points that one thread computes."""


def respond_to_few(
    amplitude: Array,
    shapes: Array,
    modulated: tuple[Array, Array],
    weights: tuple[Array, Array],
    mapper: Mapper,
    n_products: int = 1,
) -> tuple[Array, Array]:
    """Return the light of all sources ``(n, n)`` and its change ``(n, n, n_shapes)``, of one image.

    Parameters
    ----------
    amplitude
        ``(N, N)`` of the pupil; complex if it has a static aberration.
    shapes
        ``(N, N n_shapes)`` factor of each shape in the gradient, 0 at points that are not lit;
        complex as the amplitude.
    modulated
        Roof operators times the sources' phasors: along y ``(n_sources, n, n_nodes_y, N)``, along x
        ``(n, n_sources, n_nodes_x, N)``; the two sources of a pair count as nodes along x. Each
        source is repeated for every product that the operator is the sum of.
    weights
        ``(n_nodes_y,)`` and ``(n_nodes_x,)`` of the quadrature.
    mapper
        Spreads the sources over threads.
    n_products
        Number of products.
    """
    (modulated_y, modulated_x), (weights_y, weights_x) = modulated, weights
    n_terms, n, n_y, n_u = modulated_y.shape
    n_sources = n_terms // n_products
    n_x, dtype, n_shapes = modulated_x.shape[2], amplitude.real.dtype, shapes.shape[1] // n_u

    def respond_from(first: int) -> tuple[Array, Array]:
        """Return light and change of the sources that are computed together with the first."""
        light = np.zeros((n * n_x, n * n_y))
        change = np.zeros((n, n, n_shapes), dtype)
        field = np.empty((n * n_y, n_u), modulated_y.dtype)
        at_rest = np.empty((n, n_x, 2, 2, n * n_y), dtype)
        along_x = np.empty((n, 2 * n * n_y, n_u), dtype)
        counts_y = np.tile(weights_y, n)[:, None].astype(dtype)
        counts_x = weights_x[:, None].astype(dtype)
        for source in range(first, min(first + _SOURCES_TOGETHER, n_sources)):
            places = range(source * n_products, (source + 1) * n_products)
            seen = np.zeros((n * n_x, n * n_y), modulated_y.dtype)
            for place in places:
                y = modulated_y[place].reshape(-1, n_u)
                field.real, field.imag = _multiply(y, amplitude)
                seen += modulated_x[:, place].reshape(-1, n_u) @ field.T
            light += seen.real**2 + seen.imag**2
            # Im{conj(seen) x y} = Im{conj(seen) x} Re y + Re{conj(seen) x} Im y
            seen = seen.reshape(n, n_x, -1)
            np.negative(seen.imag, out=at_rest[:, :, 0, 0])
            at_rest[:, :, 0, 1] = at_rest[:, :, 1, 0] = seen.real
            at_rest[:, :, 1, 1] = seen.imag
            pairs = at_rest.reshape(n, 2 * n_x, -1).swapaxes(1, 2)
            for place in places:
                y, x = modulated_y[place].reshape(-1, n_u), modulated_x[:, place]
                parts_x = np.stack([x.real * counts_x, x.imag * counts_x], axis=2)
                np.matmul(pairs, parts_x.reshape(n, 2 * n_x, n_u), out=along_x)
                products = _multiply(y * counts_y, shapes)
                for over_y, by_line in zip(products, np.split(along_x, 2, axis=1), strict=True):
                    change += np.matmul(
                        by_line.reshape(n, n, -1).swapaxes(0, 1),
                        over_y.reshape(n, -1, n_shapes),
                    )
        light = light.reshape(n, n_x, n, n_y)
        return np.einsum("jbia,a,b->ij", light, weights_y, weights_x), change

    parts = mapper(respond_from, range(0, n_sources, _SOURCES_TOGETHER))
    light, change = (np.sum(each, axis=0) for each in zip(*parts, strict=True))
    return light, change


def _multiply(left: Array, right: Array) -> tuple[Array, Array]:
    """Return real and imaginary part of a product, whose right factor may be real."""
    if np.isrealobj(right):
        return left.real @ right, left.imag @ right
    product = left @ right
    return product.real, product.imag
