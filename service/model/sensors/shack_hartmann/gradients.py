"""Mean gradients of wavefronts over the light of each lenslet, as geometric simulators take them.

There is no spot: with an unlimited field of fine pixels the centroid is the mean gradient of the
phase, weighted by the light at each point. A field of six λ/d weighs the rim of a lenslet
differently, which rotates a fit of mean gradients by some thousandths of a degree
(docs/results/accuracy.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.model.sensors.shack_hartmann.spots import Spots

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class MeanGradients(Spots):
    """Lenslets whose signals are mean gradients, waves across one; pixels only see the light."""

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
