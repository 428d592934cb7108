"""The smoothest shapes of a set of modes.

The smoothest shapes that a set of modes can make lead from afar. The lowest Karhunen-Loeve modes
are such shapes already; a user's own modes, or single actuators, must be combined. The combination
is the same for the model and for the measured columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import Basis
from service.model.sensors.registry import kind_of

Array = NDArray[np.float64]


DEGREE = 5
"""Of the polynomials that stand for the lowest orders: 20 without piston."""

REPRESENTED = 0.5
"""Least share of a smooth shape's amplitude that the modes must be able to make."""

FEWEST = 3
"""Combinations below which single modes lead, smooth or not."""

MAX_SINGLE = 20

UNSEEN = 1e-9
"""Response of a mode over the largest, below which it is none."""

_NAMED = 5


def coarse_sampling(instrument: Instrument) -> int:
    """Return how many pupil points a subaperture needs for the smoothest shapes."""
    return kind_of(instrument).coarsest_sampling(instrument.wfs)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LowOrder:
    """Smooth combinations of the modes of a basis."""

    shapes: Basis
    """The combinations, as modes of their own."""

    combinations: Array
    """``(n_modes, n_low)`` of measured columns of unit size."""

    def measured(self, matrix: Array) -> Array:
        """Return the combinations ``(n_slopes, n_low)`` of measured columns, in any order of rows.

        Only the columns' shapes count: their unit and gains are taken from the model.
        """
        return np.asarray((matrix / np.linalg.norm(matrix, axis=0)) @ self.combinations)


def low_order_of(model: InteractionModel) -> LowOrder:
    """Return the smooth combinations of a model's modes; the first modes if there are hardly any.

    The model may be coarse. Shapes are compared over that part of the pupil where the surface is
    known, without their mean.

    Raises
    ------
    ModelError
        If the sensor does not see a mode.
    """
    points = model.pupil.points
    root = np.sqrt(model.pupil.weights)[:, None]
    matrix = np.asarray(model.interaction_matrix(Misregistration()), dtype=np.float64)
    response = np.linalg.norm(matrix, axis=0)
    unseen = np.flatnonzero(response <= UNSEEN * response.max())
    if len(unseen):
        named = ", ".join(str(mode) for mode in unseen[:_NAMED])
        raise ModelError(
            f"{model.instrument.name}: found {len(unseen)} of {len(response)} modes that move "
            f"nothing the sensor sees (columns {named}{', ...' if len(unseen) > _NAMED else ''}); "
            "expected actuators or tables in metres over the pupil (--modes leaves some out)"
        )
    root = np.where(model.basis.known(points)[:, None], root, 0.0)
    modes = model.basis.render(points) / response * root
    modes -= root * (root.T @ modes) / np.sum(root**2)
    smooth = _smooth(points, root)
    gram = modes.T @ modes
    held = gram + 1e-3 * np.trace(gram) / len(gram) * np.eye(len(gram))
    combined = np.linalg.solve(held, modes.T @ smooth)
    _, size, axes = np.linalg.svd(modes @ combined, full_matrices=False)
    kept = size > REPRESENTED
    combined = combined @ (axes[kept].T / size[kept])
    if combined.shape[1] < FEWEST:
        combined = np.eye(len(response))[:, :MAX_SINGLE]
    shapes = model.basis.combined(combined / response[:, None])
    return LowOrder(shapes=shapes, combinations=combined)


def _smooth(points: Array, root: Array) -> Array:
    """Return orthonormal polynomials without piston, times the root of the pupil's weights."""
    x, y = (points / np.abs(points).max()).T
    powers = [x**i * y ** (n - i) for n in range(DEGREE + 1) for i in range(n + 1)]
    orthonormal, _ = np.linalg.qr(np.column_stack(powers) * root)
    return np.asarray(orthonormal[:, 1:])
