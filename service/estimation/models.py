"""The models of one fit, from coarse to fine.

The smoothest shapes that a set of modes can make lead from afar. The lowest Karhunen-Loeve modes
are such shapes already; a user's own modes, or single actuators, must be combined. The combination
is the same for the model and for the measured columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import Influence, Stop
from service.model.misregistration import Misregistration
from service.model.modes import Basis, Gaussian, ModalBasis, ThinPlate, mirror_surface
from service.model.pupil import Illumination
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Mapper

Array = NDArray[np.float64]

CHEAP, FINE = 2, 3
"""Pupil points per subaperture, and nodes, of the models for derivatives and for residuals; for
far steps the sensor's kind says how many are enough. Against 8 points the fine one is biased by
0.02 % of a subaperture and 0.004 % of magnification."""

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

BETTER = 0.95
"""Another instrument is believed when it leaves less than this share of χ². On the diffractive
telescope the right stop has left 0.83 to 0.94 of what the wrong one does, noise included, from a
shift of 0.08 subaperture on; at no shift the two differ by less than 0.01."""

FAR_BETTER = 0.7
"""The same of influence functions, of which none is quite the mirror's."""

SENSOR_STEP = 0.05
"""Of the difference that stands for a derivative by the sensor's number, its logarithm."""


class Optic(StrEnum):
    """A number of the instrument that a matrix can determine, by its logarithm."""

    WIDTH = "width"
    """Of the influence functions: their coupling, where they have one."""

    SENSOR = "sensor"
    """What the kind of sensor says can be told: a pyramid's modulation."""


@dataclass(slots=True)
class Counter:
    """Interaction matrices computed so far."""

    n: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Other:
    """A change of the instrument file."""

    words: str
    """Key and value, as the file would say them."""

    believed: float
    """Share of χ² below which it is believed rather than the file."""


def coarse_sampling(instrument: Instrument) -> int:
    """Return how many pupil points a subaperture needs for the smoothest shapes."""
    return kind_of(instrument).coarsest_sampling(instrument.wfs)


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
        return low_order_of(self.model(coarse_sampling(self.instrument)))

    @cached_property
    def far(self) -> InteractionModel:
        """Leads from afar: the smoothest shapes on the coarse grid."""
        return self.model(coarse_sampling(self.instrument), self.low_order.shapes)

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
    def optics(self) -> tuple[Optic, ...]:
        """Numbers of the instrument fitted beside the registration."""
        found = []
        if self.coupling is not None:
            found.append(Optic.WIDTH)
        if self.sensor_key is not None:
            found.append(Optic.SENSOR)
        return tuple(found)

    @property
    def unknown(self) -> frozenset[Optic]:
        """Numbers that the instrument file calls unknown."""
        keys = {Optic.WIDTH: "mirror.coupling", Optic.SENSOR: f"wfs.{self.sensor_key}"}
        return frozenset(one for one in self.optics if keys[one] in self.instrument.unknown)

    @property
    def sensor_key(self) -> str | None:
        """Key of the sensor's number that the matrix can tell; None: it has none."""
        return kind_of(self.instrument).fitted_key(self.instrument.wfs)

    @property
    def sensor_number(self) -> float:
        """That number, as the instrument has it; 0 where there is none."""
        key = self.sensor_key
        return 0.0 if key is None else float(getattr(self.instrument.wfs, key))

    @property
    def coupling(self) -> float | None:
        """Coupling of the influence functions; None: they have none."""
        surface = self.basis.surface if isinstance(self.basis, ModalBasis) else None
        return surface.coupling if isinstance(surface, Gaussian) else None

    def exact(self, optic: Optic) -> bool:
        """Return whether an instrument of another value can be made, or a derivative has to do."""
        return optic is Optic.SENSOR or self.coupling is not None

    def adjusted(self, optic: Optic, change: float) -> FitModels:
        """Return the models of an instrument that differs by this in a logarithm."""
        if optic is Optic.SENSOR and self.sensor_key is not None:
            number = self.sensor_number * float(np.exp(change))
            wfs = replace(self.instrument.wfs, **{self.sensor_key: number})
            return replace(self, instrument=replace(self.instrument, wfs=wfs))
        if not isinstance(self.basis, ModalBasis) or not isinstance(self.basis.surface, Gaussian):
            raise ModelError("fit: found influence functions without a coupling to be changed")
        surface = self.basis.surface
        coupling = float(surface.coupling ** np.exp(-2.0 * change))
        return replace(self, basis=self.basis.of_surface(replace(surface, coupling=coupling)))

    def optics_derivatives(
        self, alpha: Misregistration, optics: Sequence[Optic]
    ) -> list[NDArray[Any]]:
        """Return how D changes with each of them, ``(n_slopes, n_modes)``, on the cheap grid."""
        found = []
        for optic in optics:
            if optic is Optic.WIDTH:
                found.append(self.cheap.width_derivative(alpha))
                continue
            less, more = (
                self.adjusted(optic, side * SENSOR_STEP).cheap.interaction_matrix(alpha)
                for side in (-1.0, 1.0)
            )
            found.append((more - less) / (2.0 * SENSOR_STEP))
            self.counter.n += 1
        self.counter.n += len(found)
        return found

    @property
    def other_instruments(self) -> dict[Other, FitModels]:
        """Models of instruments that this one may be taken for."""
        about = self.instrument
        stop = Stop.TELESCOPE if about.stop is Stop.MIRROR else Stop.MIRROR
        others = {f'stop = "{stop}"': replace(about, stop=stop)}
        for words, recipe in kind_of(about).other_recipes(about.slopes).items():
            others[words] = replace(about, slopes=recipe)
        found = {
            Other(words=words, believed=BETTER): replace(self, instrument=other)
            for words, other in others.items()
        }
        if isinstance(self.basis, ModalBasis):
            gaussian = isinstance(self.basis.surface, ThinPlate)
            mirror = about.analytic_mirror
            shape = Influence.GAUSSIAN if gaussian else Influence.THIN_PLATE
            surface = mirror_surface(
                replace(mirror, shape=replace(mirror.shape, influence=shape)), about.subaperture_m
            )
            other = Other(words=f'influence = "{shape}"', believed=FAR_BETTER)
            found[other] = replace(self, basis=self.basis.of_surface(surface))
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
