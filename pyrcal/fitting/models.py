"""Optical models of one fit at several samplings."""

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

PREFERRED_SHARE = 0.95
"""Share of χ² that another instrument must leave at most to be preferred. On the diffractive
telescope the correct stop left 0.83 to 0.94 of the wrong one's χ², noise included, from a shift of
0.08 subapertures; without shift the two differ by less than 0.01."""

FAR_PREFERRED_SHARE = 0.7
"""The same share for influence functions and centroids, because no model of them matches a bench
exactly."""

MAX_POINTS_ACROSS = 160
"""Largest number of points across a binary pupil map that the fit uses at full resolution. With 16
subapertures of six points each, three points left an error of 0.0014 subapertures, 3.7 σ, six
points 0.0001 (docs/results/accuracy.md). On larger maps a step is negligible."""

SENSOR_STEP = 0.03
"""Step of the sensor number's logarithm for a one-sided finite difference. A fit ends within 0.01
of the model's number, so the error of the derivative is negligible."""


LOGARITHM_ABOVE = 1.0
"""Modulation, λ/D, above which its logarithm is fitted, and below which its square is. The star is
as wide, so that narrower modulations change a matrix by their square, and 0 is within reach."""


def sensor_coordinate(number: float) -> float:
    """Return the fitted coordinate of a sensor number: logarithm, or square of a small one.

    Both have one value and one slope at ``LOGARITHM_ABOVE``.
    """
    ratio = number / LOGARITHM_ABOVE
    return float(np.log(ratio)) if ratio > 1.0 else (ratio**2 - 1.0) / 2.0


def set_coupling(basis: Basis, coupling: float | None) -> Basis:
    """Return the same strokes of Gaussian functions with a coupling; others, or None: unchanged."""
    if coupling is None or not isinstance(basis, ModalBasis):
        return basis
    if not isinstance(basis.surface, Gaussian):
        return basis
    return basis.of_surface(replace(basis.surface, coupling=coupling))


def moved_sensor_number(number: float, change: float) -> float:
    """Return a sensor number whose coordinate is changed; 0 if the change leads beyond it."""
    coordinate = sensor_coordinate(number) + change
    ratio = np.exp(coordinate) if coordinate > 0.0 else np.sqrt(max(2.0 * coordinate + 1.0, 0.0))
    return LOGARITHM_ABOVE * float(ratio)


ELLIPSE_KEY = "modulation_ellipse"
ROOFTOP_KEY = "rooftop_lambda_over_d"
ABERRATION_KEY = "static_aberration_nm"


class Optic(StrEnum):
    """An optical quantity that a matrix can determine, fitted as its logarithm.

    That of the sensor is fitted as its ``sensor_coordinate``, a rooftop and an aberration as
    themselves.
    """

    WIDTH = "width"
    """Width of the influence functions: their coupling, if they have one."""

    SENSOR = "sensor"
    """Fitted number of the sensor's kind: a pyramid's modulation."""

    STRETCH = "stretch"
    """Stretch of an elliptic modulation along x and y, see ``SensorModel.stretch_modulation``."""

    SLANT = "slant"
    """The same along 45 and 135 degrees."""

    ROOFTOP = "rooftop"
    """Length of the edge in place of a pyramid's tip, λ/D."""

    TILT_X = "tilt along x"
    """Static aberration of the beam, as all that follow: coefficients of Zernike polynomials,
    radians RMS, see ``SensorModel.aberrate``."""

    TILT_Y = "tilt along y"
    FOCUS = "focus"
    ASTIGMATISM_45 = "astigmatism at 45 deg"
    ASTIGMATISM_0 = "astigmatism at 0 deg"
    COMA_Y = "coma along y"
    COMA_X = "coma along x"
    TREFOIL_Y = "trefoil along y"
    TREFOIL_X = "trefoil along x"
    SPHERICAL = "spherical aberration"
    ASTIGMATISM_0_4 = "astigmatism at 0 deg of the fourth order"
    ASTIGMATISM_45_4 = "astigmatism at 45 deg of the fourth order"
    TETRAFOIL_0 = "tetrafoil at 0 deg"
    TETRAFOIL_22 = "tetrafoil at 22.5 deg"


ELLIPSE = (Optic.STRETCH, Optic.SLANT)
"""Parameters of an elliptic modulation, fitted together if ``wfs.modulation_ellipse`` is unknown.
"""


ABERRATION = tuple(Optic)[tuple(Optic).index(Optic.TILT_X) :]
"""Zernike polynomials from Noll's number 2 on, fitted together if ``wfs.static_aberration_nm`` is
unknown."""

ROOFTOP = (Optic.ROOFTOP,)
"""The one parameter of a rooftop, fitted if ``wfs.rooftop_lambda_over_d`` is unknown."""

FAMILIES = {ELLIPSE_KEY: ELLIPSE, ROOFTOP_KEY: ROOFTOP, ABERRATION_KEY: ABERRATION}
"""Quantities that are fitted if the instrument file marks their key of ``[wfs]`` as unknown."""


@dataclass(slots=True)
class Counter:
    """Number of interaction matrices computed so far."""

    n: int = 0


def choose_sampling(instrument: Instrument) -> int:
    """Return the pupil points per subaperture of the model that determines a fit.

    It is that of a binary pupil map, as simulators use, if that is at most ``MAX_POINTS_ACROSS``
    points in all: with fewer points its edges become grey.
    """
    simulated = kind_of(instrument).fine_sampling_of(instrument.wfs)
    if simulated is not None:
        return simulated
    usual, pupil = kind_of(instrument).fine_sampling, instrument.pupil
    # A grey map has no sharp edge that another sampling would blur.
    if pupil is None or np.any((pupil.lit > 0.0) & (pupil.lit < 1.0)):
        return usual
    points = round(instrument.subaperture_m / (instrument.binning * pupil.pitch_m))
    across = instrument.wfs.n_subapertures * instrument.binning * points
    return max(usual, points) if across <= MAX_POINTS_ACROSS else usual


@dataclass(frozen=True, kw_only=True, eq=False)
class FitModels:
    """Models of one instrument and the fitted modes at several samplings, computed on demand."""

    instrument: Instrument
    """Instrument with a known orientation."""

    basis: Basis
    """Fitted modes only."""

    illumination: Illumination | None = None
    mapper: Mapper = map
    counter: Counter = field(default_factory=Counter)
    made: dict[int, InteractionModel] = field(default_factory=dict)
    """Models of one instrument by sampling; models of other modes share their optics."""

    lowest: LowOrder | None = None
    """Smooth combinations of the modes if they are known; None to compute them."""

    def model(
        self, sampling: int, basis: Basis | None = None, *, once: bool = False
    ) -> InteractionModel:
        """Return a model of this sampling, for ``basis`` or the models' own modes.

        With few modes, a model that is used ``once`` or the fine one does not compute the sensor's
        response to every point of the pupil.
        """
        known = self.made.get(sampling)
        # ``replace`` passes the same dictionary on to models of other instruments.
        if known is not None and known.instrument is self.instrument:
            return known.of_modes(basis or self.basis)
        # With more modes the response to every point costs less, even if it is used once. The fine
        # model has no derivatives to share it.
        few = (basis or self.basis).n_modes < self.instrument.wfs.n_subapertures
        once_each = once or sampling > self.cheap_sampling
        model = InteractionModel(
            self.instrument,
            basis or self.basis,
            pupil_sampling=sampling,
            detector_nodes=sampling,
            illumination=self.illumination,
            mapper=self.mapper,
            kept_bytes=0.0 if few and once_each else KEPT_BYTES,
        )
        if known is not None:
            model.share_modes(known)
        # A trial that is used once must not replace the fit's own model in the shared dictionary.
        if not once:
            self.made[sampling] = model
        return model

    @cached_property
    def low_order(self) -> LowOrder:
        """Smoothest combinations of the modes."""
        return self.lowest or low_order_of(self._coarse)

    @cached_property
    def far(self) -> InteractionModel:
        """Model for far steps: the smoothest shapes on the coarse grid."""
        return self._coarse.of_modes(self.low_order.shapes)

    @cached_property
    def _coarse(self) -> InteractionModel:
        return self.model(coarse_sampling(self.instrument))

    @cached_property
    def cheap(self) -> InteractionModel:
        """Model for derivatives near the solution."""
        return self.model(self.cheap_sampling)

    @property
    def cheap_sampling(self) -> int:
        """Pupil points per subaperture, and nodes, of the model for derivatives."""
        return kind_of(self.instrument).derivative_sampling(self.instrument.wfs)

    @cached_property
    def fine(self) -> InteractionModel:
        """Model whose residual determines the fit."""
        return self.model(choose_sampling(self.instrument))

    def matrix(self, model: InteractionModel, alpha: Misregistration) -> NDArray[np.float32]:
        """Return D of one of the models, ``(n_slopes, n_modes)``, and count it."""
        self.counter.n += 1
        return np.asarray(model.interaction_matrix(alpha), dtype=np.float32)

    @property
    def optics(self) -> tuple[Optic, ...]:
        """Optical quantities that are fitted together with the registration."""
        found = []
        if self.coupling is not None:
            found.append(Optic.WIDTH)
        if self.sensor_key is not None:
            found.append(Optic.SENSOR)
        for key, family in FAMILIES.items():
            found += family if f"wfs.{key}" in self.instrument.unknown else ()
        return tuple(found)

    @property
    def unknown(self) -> frozenset[Optic]:
        """Optical quantities that the instrument file marks as unknown."""
        keys = {
            Optic.WIDTH: "mirror.coupling",
            Optic.SENSOR: f"wfs.{self.sensor_key}",
            **{optic: f"wfs.{key}" for key, family in FAMILIES.items() for optic in family},
        }
        return frozenset(one for one in self.optics if keys[one] in self.instrument.unknown)

    @property
    def sensor_key(self) -> str | None:
        """Key of the sensor number that the matrix can determine; None if it has none."""
        return kind_of(self.instrument).find_fitted_key(self.instrument.wfs)

    @property
    def sensor_number(self) -> float:
        """Value of the sensor number in the instrument; 0 if there is none."""
        key = self.sensor_key
        return 0.0 if key is None else float(getattr(self.instrument.wfs, key))

    @property
    def coupling(self) -> float | None:
        """Coupling of the influence functions; None if they have none."""
        surface = self.basis.surface if isinstance(self.basis, ModalBasis) else None
        return surface.coupling if isinstance(surface, Gaussian) else None

    def exact(self, optic: Optic) -> bool:
        """Return True if a model with another value can be built, not only a derivative."""
        return optic is not Optic.WIDTH or self.coupling is not None

    def with_optic(self, optic: Optic, change: float) -> FitModels:
        """Return the models of an instrument with a quantity changed, see ``Optic``."""
        kind, wfs = kind_of(self.instrument), self.instrument.wfs
        if optic in ABERRATION:
            sensor = kind.aberrate(wfs, 2 + ABERRATION.index(optic), change)
        elif optic in ELLIPSE:
            along = (change, 0.0) if optic is Optic.STRETCH else (0.0, change)
            sensor = kind.stretch_modulation(wfs, along)
        elif optic is Optic.ROOFTOP:
            sensor = replace(wfs, **{ROOFTOP_KEY: getattr(wfs, ROOFTOP_KEY) + change})
        elif optic is Optic.SENSOR and self.sensor_key is not None:
            number = moved_sensor_number(self.sensor_number, change)
            sensor = replace(wfs, **{self.sensor_key: number})
        elif self.coupling is None:
            raise ModelError("fit: found influence functions without a coupling to be changed")
        else:
            # A Gaussian is coupling ** (r / pitch)²: with a width e times larger its exponent is e²
            # times smaller.
            coupling = float(self.coupling ** np.exp(-2.0 * change))
            return replace(self, basis=set_coupling(self.basis, coupling))
        if sensor is None:
            raise ModelError(f"fit: found a {kind.name}, expected a pyramid, for its {optic}")
        return replace(self, instrument=replace(self.instrument, wfs=sensor))

    def with_displaced_images(self, offsets: Array) -> FitModels:
        """Return the models of a sensor with displaced pupil images ``(8,)``.

        In subapertures, axes of conventions.md: along x of the images at -x -y, +x -y, -x +y, +x
        +y, then along y.
        """
        wfs = kind_of(self.instrument).displace_images(self.instrument, offsets)
        return replace(self, instrument=replace(self.instrument, wfs=wfs))

    def optics_derivatives(
        self, alpha: Misregistration, optics: Sequence[Optic], cheap_matrix: NDArray[Any] | None
    ) -> list[NDArray[Any]]:
        """Return the derivatives of D by optical quantities, ``(n_slopes, n_modes)`` each.

        They are computed on the coarse grid. ``cheap_matrix`` is D on it; None if it is not known.
        """
        found = []
        for optic in optics:
            if optic is Optic.WIDTH:
                found.append(self.cheap.width_derivative(alpha))
                continue
            own = self.cheap.interaction_matrix(alpha) if cheap_matrix is None else cheap_matrix
            other = self.with_optic(optic, SENSOR_STEP).model(self.cheap_sampling, once=True)
            found.append((other.interaction_matrix(alpha) - own) / SENSOR_STEP)
            self.counter.n += 1
        self.counter.n += len(found)
        return found

    @property
    def other_instruments(self) -> dict[str, tuple[float, FitModels]]:
        """Models of instruments with which this one may be confused, by their entry of the file.

        Each with the share of χ² below which it is preferred.
        """
        about = self.instrument
        stop = Stop.TELESCOPE if about.stop is Stop.MIRROR else Stop.MIRROR
        others = {f'stop = "{stop}"': (PREFERRED_SHARE, replace(about, stop=stop))}
        for words, recipe in kind_of(about).other_recipes(about.slopes).items():
            others[words] = PREFERRED_SHARE, replace(about, slopes=recipe)
        for words, sensor in kind_of(about).other_sensors(about.wfs).items():
            others[words] = FAR_PREFERRED_SHARE, replace(about, wfs=sensor)
        found = {
            words: (share, replace(self, instrument=other))
            for words, (share, other) in others.items()
        }
        if isinstance(self.basis, ModalBasis):
            gaussian = isinstance(self.basis.surface, ThinPlate)
            mirror = about.analytic_mirror
            shape = Influence.GAUSSIAN if gaussian else Influence.THIN_PLATE
            surface = mirror_surface(
                replace(mirror, shape=replace(mirror.shape, influence=shape)), about.subaperture_m
            )
            models = replace(self, basis=self.basis.of_surface(surface))
            found[f'influence = "{shape}"'] = FAR_PREFERRED_SHARE, models
        return found
