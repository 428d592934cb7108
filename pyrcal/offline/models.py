"""The models of one fit, from coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.estimation.orientation import LowOrder, coarse_sampling, low_order_of
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import Influence, Stop
from service.model.misregistration import Misregistration
from service.model.modes import Basis, ModalBasis
from service.model.pupil import Illumination
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import KEPT_BYTES, Mapper
from service.model.surface import Gaussian, ThinPlate, mirror_surface

Array = NDArray[np.float64]

CHEAP = 2
"""Pupil points per subaperture, and nodes, of the model for derivatives; for residuals, and for far
steps, the sensor's kind says how many are enough."""

BETTER = 0.95
"""Another instrument is preferred when it leaves less than this share of χ². On the diffractive
telescope the right stop has left 0.83 to 0.94 of what the wrong one does, noise included, from a
shift of 0.08 subaperture on; at no shift the two differ by less than 0.01."""

FAR_BETTER = 0.7
"""The same of influence functions and centroids, of which none is quite the bench's."""

MOST_ACROSS = 160
"""Points across the pupil of a simulator's black and white map that a fit takes as they are: of 16
subapertures with six points each, three points left 0.0014 subapertures of error, 3.7 σ, six 0.0001
(docs/results/peers.md). Beyond, a step is too small a part of the pupil to matter."""

SENSOR_STEP = 0.03
"""Of the difference that stands for a derivative by the sensor's number, its logarithm. It is taken
to one side: a fit ends where that number is within 0.01 of the model's, and the derivative is then
off by a share of that."""


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

    max_misfit_ratio: float
    """Largest χ² that it may leave, over what the file leaves, to be preferred."""


def deciding_sampling(instrument: Instrument) -> int:
    """Return how many pupil points a subaperture has in the model that decides a fit.

    As many as a map of the pupil that knows no partly lit point, as simulators have it, as long as
    that is no more than ``MOST_ACROSS`` in all: fewer points make its steps grey.
    """
    usual, pupil = kind_of(instrument).fine_sampling, instrument.pupil
    if pupil is None or np.any((pupil.lit > 0.0) & (pupil.lit < 1.0)):
        return usual
    points = round(instrument.subaperture_m / (instrument.binning * pupil.pitch_m))
    across = instrument.wfs.n_subapertures * instrument.binning * points
    return max(usual, points) if across <= MOST_ACROSS else usual


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
    made: dict[int, InteractionModel] = field(default_factory=dict)
    """By sampling, the models of one instrument: those of other modes share their optics."""

    def model(
        self, sampling: int, basis: Basis | None = None, *, once: bool = False
    ) -> InteractionModel:
        """Return a model of this sampling, of ``basis`` or else of the own modes.

        One that is used ``once`` keeps no response of the sensor to every point of the pupil.
        """
        known = self.made.get(sampling)
        if known is not None and known.instrument is self.instrument:
            return known.of_modes(basis or self.basis)
        model = InteractionModel(
            self.instrument,
            basis or self.basis,
            pupil_sampling=sampling,
            detector_nodes=sampling,
            illumination=self.illumination,
            mapper=self.mapper,
            kept_bytes=0.0 if once else KEPT_BYTES,
        )
        if not once:
            self.made[sampling] = model
        return model

    @cached_property
    def low_order(self) -> LowOrder:
        """The smoothest shapes of the modes."""
        return low_order_of(self._coarse)

    @cached_property
    def far(self) -> InteractionModel:
        """Leads from afar: the smoothest shapes on the coarse grid."""
        return self._coarse.of_modes(self.low_order.shapes)

    @cached_property
    def _coarse(self) -> InteractionModel:
        return self.model(coarse_sampling(self.instrument))

    @cached_property
    def cheap(self) -> InteractionModel:
        """For derivatives near the solution."""
        return self.model(CHEAP)

    @cached_property
    def fine(self) -> InteractionModel:
        """Decides."""
        return self.model(deciding_sampling(self.instrument))

    def matrix(self, model: InteractionModel, alpha: Misregistration) -> NDArray[np.float32]:
        """Return D of one of the models, ``(n_slopes, n_modes)``, and count it."""
        self.counter.n += 1
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

    def displaced(self, offsets: Array) -> FitModels:
        """Return the models of a sensor whose pupil images lie beside their places ``(8,)``.

        Subapertures, axes of conventions.md: along x of the images at -x -y, +x -y, -x +y, +x +y,
        then along y.
        """
        wfs = kind_of(self.instrument).displaced(self.instrument, offsets)
        return replace(self, instrument=replace(self.instrument, wfs=wfs))

    def optics_derivatives(
        self, alpha: Misregistration, optics: Sequence[Optic]
    ) -> list[NDArray[Any]]:
        """Return how D changes with each of them, ``(n_slopes, n_modes)``, on the cheap grid."""
        found = []
        for optic in optics:
            if optic is Optic.WIDTH:
                found.append(self.cheap.width_derivative(alpha))
                continue
            other = self.adjusted(optic, SENSOR_STEP).model(CHEAP, once=True)
            beside = other.interaction_matrix(alpha)
            found.append((beside - self.cheap.interaction_matrix(alpha)) / SENSOR_STEP)
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
            Other(words=words, max_misfit_ratio=BETTER): replace(self, instrument=other)
            for words, other in others.items()
        }
        for words, sensor in kind_of(about).other_sensors(about.wfs).items():
            other = Other(words=words, max_misfit_ratio=FAR_BETTER)
            found[other] = replace(self, instrument=replace(about, wfs=sensor))
        if isinstance(self.basis, ModalBasis):
            gaussian = isinstance(self.basis.surface, ThinPlate)
            mirror = about.analytic_mirror
            shape = Influence.GAUSSIAN if gaussian else Influence.THIN_PLATE
            surface = mirror_surface(
                replace(mirror, shape=replace(mirror.shape, influence=shape)), about.subaperture_m
            )
            other = Other(words=f'influence = "{shape}"', max_misfit_ratio=FAR_BETTER)
            found[other] = replace(self, basis=self.basis.of_surface(surface))
        return found
