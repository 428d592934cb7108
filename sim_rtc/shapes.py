"""Low-order shapes over the pupil: tilts, focus and what follows, unit RMS on any outline."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TIP, TILT, FOCUS = 1, 2, 3
"""Columns of ``low_orders``: rising along +x, rising along +y, concave."""


def low_orders(points: Array, weights: Array, order: int) -> Array:
    """Return polynomials up to ``order`` at the points, ``(n_points, n_shapes)``.

    Piston first, then the tilt along x, the tilt along y, focus and the rest, made orthonormal
    over the area ``weights`` in that order: what Zernike's are on a full disc, on any outline.
    """
    x, y = points.T / np.abs(points).max()
    columns = [np.ones_like(x), x, y]
    for degree in range(2, order + 1):
        monomials = [x ** (degree - k) * y**k for k in range(degree + 1)]
        columns += [x**2 + y**2, *monomials[:2]] if degree == 2 else monomials
    root = np.sqrt(weights)[:, None]
    factor, triangle = np.linalg.qr(np.column_stack(columns) * root)
    return np.asarray(factor * np.sign(np.diag(triangle)) / root)
