"""The models of one fit: from coarse and cheap to as fine as the answer needs.

The smoothest shapes that a set of modes can make lead from afar. The lowest Karhunen-Loeve modes
are such shapes already; a user's own modes, or single actuators, must be combined. The combination
is the same for the model and for the measured columns.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.model.modes import Basis
from service.model.pupil import Illumination
from service.model.pyramid import Mapper

Array = NDArray[np.float64]

COARSE, CHEAP, FINE = 1, 2, 3
"""Pupil points per subaperture, and nodes, of the models for far steps, derivatives, residuals.
Against 8 points the fine one is biased by 0.02 % of a subaperture and 0.004 % of magnification."""

DEGREE = 5
"""Of the polynomials that stand for the lowest orders: 20 without piston."""

REPRESENTED = 0.5
"""Least share of a smooth shape's amplitude that the modes must be able to make."""

FEWEST = 3
"""Combinations below which single modes lead, smooth or not."""

MOST_SINGLE = 20


@dataclass(slots=True)
class Counter:
    """Interaction matrices computed so far."""

    n: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Other:
    """A change of the instrument file."""

    words: str
    """Key and value, as the file would say them."""

    says_what_moves: bool = False
    """Whether a registration means something else with it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FitModels:
    """One instrument and the modes to be fitted, at several samplings; each made when needed."""

    instrument: Instrument
    """Its orientation settled."""

    basis: Basis
    """Only the modes that are fitted."""

    illumination: Illumination | None = None
    mapper: Mapper = map
    counter: Counter = field(default_factory=Counter)

    def model(
        self, sampling: int, basis: Basis | None = None, instrument: Instrument | None = None
    ) -> InteractionModel:
        """Return a model of this sampling; ``basis`` and ``instrument`` stand in for the own."""
        return InteractionModel(
            instrument or self.instrument,
            basis or self.basis,
            pupil_sampling=sampling,
            detector_nodes=sampling,
            illumination=self.illumination,
            mapper=self.mapper,
        )

    @cached_property
    def low_order(self) -> LowOrder:
        """The smoothest shapes of the modes."""
        return low_order_of(self.model(COARSE))

    @cached_property
    def far(self) -> InteractionModel:
        """Leads from afar: the smoothest shapes on the coarse grid."""
        return self.model(COARSE, self.low_order.shapes)

    @cached_property
    def cheap(self) -> InteractionModel:
        """For derivatives near the solution."""
        return self.model(CHEAP)

    @cached_property
    def fine(self) -> InteractionModel:
        """Decides."""
        return self.model(FINE)

    def matrix(self, model: InteractionModel, vector: Array) -> NDArray[np.float32]:
        """Return D of one of the models, ``(n_slopes, n_modes)``, and count it."""
        self.counter.n += 1
        alpha = Misregistration.from_vector(vector)
        return np.asarray(model.interaction_matrix(alpha), dtype=np.float32)

    @property
    def others(self) -> dict[Other, Instrument]:
        """Instruments that this one may be taken for, by what to change in the file."""
        wfs = self.instrument.wfs
        radius = wfs.modulation_lambda_over_d
        stop = Stop.TELESCOPE if self.instrument.stop is Stop.MIRROR else Stop.MIRROR
        moves = Other(words=f'stop = "{stop}"', says_what_moves=True)
        found = {moves: replace(self.instrument, stop=stop)}
        for factor in (0.5, 2.0) if radius > 0.0 else ():
            changed = replace(wfs, modulation_lambda_over_d=factor * radius)
            turned = Other(words=f"modulation_lambda_over_d = {factor * radius:g}")
            found[turned] = replace(self.instrument, wfs=changed)
        return found


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
    """
    points = model.pupil.points
    root = np.sqrt(model.pupil.weights)[:, None]
    matrix = np.asarray(model.interaction_matrix(Misregistration()), dtype=np.float64)
    response = np.linalg.norm(matrix, axis=0)
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
        combined = np.eye(len(response))[:, :MOST_SINGLE]
    shapes = model.basis.combined(combined / response[:, None])
    return LowOrder(shapes=shapes, combinations=combined)


def _smooth(points: Array, root: Array) -> Array:
    """Return orthonormal polynomials without piston, times the root of the pupil's weights."""
    x, y = (points / np.abs(points).max()).T
    powers = [x**i * y ** (n - i) for n in range(DEGREE + 1) for i in range(n + 1)]
    orthonormal, _ = np.linalg.qr(np.column_stack(powers) * root)
    return np.asarray(orthonormal[:, 1:])
