"""Zernike polynomials."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]


def compute_zernikes(coefficients: NDArray[Any], points: Array) -> Array:
    """Return a sum of Zernike polynomials at ``points`` ``(n_points, 2)`` of the unit disc.

    ``coefficients`` ``(n,)`` are those of Noll's numbers 1 to n: piston, tip along x, tilt along
    y, focus, astigmatism. A unit coefficient has an RMS of 1 over the full disc.

    References
    ----------
    Noll 1976, JOSA 66, 207.
    """
    radius, angle = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    total = np.zeros(len(points))
    for number, value in enumerate(coefficients, 1):
        order = int(np.ceil((np.sqrt(8.0 * number + 1.0) - 3.0) / 2.0))
        place = number - order * (order + 1) // 2 - 1
        azimuthal = order % 2 + 2 * ((place + 1 - order % 2) // 2)
        # The radial polynomial is Jacobi's of the squared radius.
        half = (order - azimuthal) // 2
        jacobi = scipy.special.eval_jacobi(half, azimuthal, 0.0, 1.0 - 2.0 * radius**2)
        shape = np.sqrt(order + 1.0) * (-1.0) ** half * radius**azimuthal * jacobi
        if azimuthal:
            turned = np.cos if number % 2 == 0 else np.sin
            shape = shape * np.sqrt(2.0) * turned(azimuthal * angle)
        total += value * shape
    return total
