"""A rooftop: an edge in place of the tip of a pyramid.

Two opposite faces are higher than the two others, and meet in the edge. Their light has a constant
phase against that of the others, and next to the tip each has taken a strip from both neighbours.
The transmission is then no longer one product of a function along y and one along x, but the sum of
a few: the functions are the two faces on either side of an edge, and the strips next to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.pupil import gauss_legendre
from service.model.sensors.pyramid.description import Pyramid

Array = NDArray[Any]

_STRIP_NODES = 6
"""Nodes across a strip: of a real sensor, with 2 λ/D and no modulation, 0.2 % of D are wrong."""

_MIN_PRODUCT = 2e-4
"""Smallest product over the largest one; times the modulation, λ/D, if that is above 1, because
it averages what is left out: 0.1 % of D at most up to 1 λ/D, with 2 to 10 of 14 products."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rooftop:
    """The transmission as a sum of products of functions along y and along x."""

    strip: Array
    """``(n_nodes,)`` spatial frequencies in the strip at positive ones, cycles per subaperture;
    empty if a simulation's grid has no sample there."""

    along_y: Array
    """``(n_products, n_functions)`` coefficients of the functions in each factor along y. The
    functions are the face at positive frequencies, that at negative ones, and in pairs the nodes
    of their strips."""

    along_x: Array
    """The same along x."""

    def list_waves(self, distance: NDArray[np.float64]) -> list[Array]:
        """Return the kernels of the nodes of both strips at these distances."""
        waves = [np.exp(2j * np.pi * one * distance) for one in self.strip]
        return [one for wave in waves for one in (wave, wave.conj())]


def make_rooftop(wfs: Pyramid, sampling: int, width_subap: float) -> Rooftop:
    """Return the rooftop of a sensor; without one, one product of the two faces together.

    ``sampling`` is that of the pupil, points along a subaperture; ``width_subap`` is that of the
    grid of an FFT, infinite for a real sensor.
    """
    if not wfs.rooftop_lambda_over_d:
        return Rooftop(strip=np.zeros(0), along_y=np.ones((1, 2)), along_x=np.ones((1, 2)))
    # The edge is the diagonal of a square of two strips.
    reach = abs(wfs.rooftop_lambda_over_d) / math.sqrt(8.0) / wfs.pupil_diameter
    if math.isinf(width_subap):
        nodes, weights = gauss_legendre(_STRIP_NODES)
        strip, weights = reach * (nodes + 1.0) / 2.0, reach * weights / 2.0 / sampling
    else:
        strip = np.arange(0.5, width_subap * reach) / width_subap
        weights = np.full(len(strip), 1.0 / (width_subap * sampling))
    higher = np.exp(2j * np.pi * wfs.image_separation_subap * reach)
    face = weights * np.exp(1j * np.pi * wfs.image_separation_subap * strip)
    taken = weights**2 * higher / face - face
    # Where strips along y and x cross, only the nearer one of the two higher faces counts.
    nearer = np.triu(np.multiply.outer(face, taken))
    crossed = -(nearer + np.triu(nearer, 1).T)
    table = np.block([[np.ones(1), taken], [taken[:, None], crossed]])
    # Functions of one side with those of the other, apart from the two higher faces.
    products = np.kron(table, [[0, 1], [1, 0]])
    products[:2, :2] += higher * np.eye(2)
    if wfs.rooftop_lambda_over_d < 0.0:  # mirrored along x
        products = products[:, np.arange(len(products)) ^ 1]
    # A plane wave adds up over the pupil, the kernel of a face is narrow.
    size = np.ones(len(products))
    size[2:] = sampling * wfs.pupil_diameter
    left, values, right = np.linalg.svd(products * size[:, None] * size)
    kept = values > _MIN_PRODUCT * max(1.0, wfs.largest_modulation) * values[0]
    along_y = (left[:, kept] * values[kept]).T / size
    return Rooftop(strip=strip, along_y=along_y, along_x=right[kept] / size)
