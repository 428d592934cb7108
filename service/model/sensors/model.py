"""The model of a kind of sensor: its record, its optics, its light.

All code that needs something specific to a sensor asks here; only the folder of a kind knows which
kind it is. A kind omits what it does not have.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.aperture import find_offset
from service.model.instrument import Instrument, SensorDescription, SensorMode
from service.model.pupil import PupilGrid, valid_subapertures
from service.model.sensors.sensor import CannotTell, Fineness, Light, Sensor, WorkingPoint
from service.model.slopes import SlopeRecipe

Array = NDArray[np.float64]

Term = float | Array
"""Variance of slopes: one value for all, or ``(n_signals,)``."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Signals that exist but do not measure what the model computes."""

    subapertures: NDArray[np.bool_]
    """``(n, n)`` [y, x], in the axes of conventions.md."""

    reason: str
    """Description of the signals, with the key that excludes them."""


class SensorModel(ABC):
    """The model of one kind of wavefront sensor."""

    name: ClassVar[str]
    """``wfs.kind`` of an instrument file."""

    loses_gain: ClassVar[bool] = False
    """Whether it answers less the larger the residual wavefront is."""

    fine_sampling: ClassVar[int] = 3
    """Pupil points along a subaperture, and nodes, of the model that decides the fit of a matrix:
    against 8 a pyramid's is biased by 0.02 % of a subaperture and 0.004 % of magnification."""

    edge_slips: ClassVar[bool] = False
    """True if the sensor can lock on a mirror edge that is displaced by one wavelength."""

    @abstractmethod
    def read_sensor(
        self,
        table: Any,  # noqa: ANN401 - its own
        given: frozenset[str],
        subaperture_m: float,
    ) -> SensorDescription:
        """Return the sensor that a table describes, its mask apart; ``given``: keys written.

        Raises
        ------
        ModelError
            One line that begins with the key.
        """

    def left_out(self, instrument: Instrument) -> LeftOut | None:
        """Return valid subapertures whose signals a measured matrix is not compared in."""
        return None

    def in_modes(
        self,
        table: Any,  # noqa: ANN401 - its own
        sensor: Any,  # noqa: ANN401 - its own
    ) -> tuple[tuple[SensorMode, str], ...]:
        """Return the modes that a table makes of its sensor, each with where its own mask is.

        ``path:/dataset``, or "auto": by ``flux_threshold``. Empty: the sensor has no modes.

        Raises
        ------
        ModelError
            One line that begins with the key.
        """
        return ()

    def frames(self, table: Any, given: frozenset[str]) -> object | None:  # noqa: ANN401 - its own
        """Return how signals are made of the frames that the RTC sends; None: it sends signals."""
        return None

    def signals_of_frames(
        self, instrument: Instrument, frames: NDArray[Any], flux_frame: NDArray[Any] | None
    ) -> Array:
        """Return the signals ``(n_signals, n_modes)`` of frames ``(n_modes, ny, nx)``.

        They are changes per unit of each mode, relative to a mean frame ``(ny, nx)``; see
        ``frames``. Without a mean frame they are divided by their sum.

        Raises
        ------
        ModelError
            If the frames do not fit the sensor.
        """
        raise ModelError(f"{instrument.name}: found frames; expected signals of a {self.name}")

    def knows_mean_light(self, instrument: Instrument) -> bool:
        """Return whether signals can be made of frames without a mean frame."""
        return False

    def locate_images(
        self, instrument: Instrument, flux_frame: NDArray[Any]
    ) -> tuple[Instrument, tuple[str, ...], float]:
        """Return the instrument with its pupil images located in a mean frame, remarks, and σ.

        Only images that the instrument file leaves open are located. The last value is 1 σ of the
        middle of the images, subapertures.
        """
        return instrument, (), 0.0

    def measure_image_offsets(self, instrument: Instrument, light: Array) -> Array | CannotTell:
        """Return the displacement (x, y) of each pupil image in its light, ``(4, 2)`` subapertures.

        Raises
        ------
        ModelError
            If the light is not that of this sensor.
        """
        return CannotTell(reason=f"a {self.name} has no pupil images to be located")

    def is_weakly_modulated(self, sensor: Any) -> bool:  # noqa: ANN401 - its own
        """Return whether a modulation is so narrow that models of the focus differ."""
        return False

    def image_centres(self, instrument: Instrument, flux_frame: NDArray[Any]) -> Array | None:
        """Return where a mean frame shows the pupil images, ``(4, 2)`` row and column, pixels.

        Whatever the instrument file says of them. None if they cannot be found, or there is one.
        """
        return None

    def identity(self, sensor: Any) -> tuple[float, ...]:  # noqa: ANN401 - its own
        """Return the numbers that make another configuration of it when they change."""
        return (sensor.wavelength_m,)

    @abstractmethod
    def noise_terms(self, instrument: Instrument) -> tuple[Term, Term]:
        """Return the variance of a slope by each photon, and by noise 1 of its pixels.

        Both over the square of the photons yet; numbers, or ``(n_signals,)`` where the spots of
        subapertures are not alike.
        """

    def slope_noise(
        self, instrument: Instrument, electrons: float, read_noise: float, excess: float = 1.0
    ) -> float:
        """Return 1 σ of a slope of a subaperture with so many electrons, read with this noise.

        ``excess`` is the variance of the photon noise over Poisson's. RMS of all slopes.
        """
        of_photons, of_pixels = (_mean(term) for term in self.noise_terms(instrument))
        return math.sqrt(excess * of_photons * electrons + of_pixels * read_noise**2) / electrons

    def noise_shape(self, instrument: Instrument) -> Array | None:
        """Return 1 σ of each signal ``(n_signals,)`` over their RMS, by photons of the same light.

        None: all alike.
        """
        of_photons, _ = self.noise_terms(instrument)
        if isinstance(of_photons, float):
            return None
        shape: Array = (of_photons / of_photons.mean()) ** 0.5
        return shape

    @abstractmethod
    def pixels(self, instrument: Instrument, valid: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the indices of the pixels of valid subapertures in a response's flat light.

        ``(n_pixels, n_valid)``; the light has n_pixels for every subaperture of the grid.
        """

    @abstractmethod
    def sensor(
        self,
        instrument: Instrument,
        pupil: PupilGrid,
        fineness: Fineness,
        working_point: WorkingPoint | None = None,
    ) -> Sensor:
        """Return the sensor of an instrument on this pupil, by default for a flat wavefront.

        Raises
        ------
        ModelError
            If it cannot be computed so.
        """

    def working_point(
        self,
        instrument: Instrument,
        *,
        n_controlled: int,
        r0_m: float | None = None,
        sampling: int,
    ) -> WorkingPoint | None:
        """Return what a loop of so many modes makes of a star; None: nothing, to this sensor.

        ``sampling`` are the pupil's points along a subaperture.

        Raises
        ------
        ModelError
            If no mode is controlled or r0 is not positive.
        """
        return None

    def fine_sampling_of(self, sensor: Any) -> int | None:  # noqa: ANN401 - its own
        """Return how many pupil points along a subaperture made a matrix; None for a real sensor.

        The model that decides a fit then has the same, and the simulation's errors with it.
        """
        return None

    def coarsest_sampling(self, sensor: Any) -> int:  # noqa: ANN401 - its own
        """Return how many pupil points along a subaperture the smoothest shapes need."""
        return 1

    def derivative_sampling(self, sensor: Any) -> int:  # noqa: ANN401 - its own
        """Return how many pupil points along a subaperture derivatives need, and early steps."""
        return 2

    def find_fitted_key(self, sensor: Any) -> str | None:  # noqa: ANN401 - its own
        """Return the key of a sensor parameter that is fitted together with α, by its logarithm.

        Fitting it keeps a wrong value in the file from biasing α. None if there is no such
        parameter.
        """
        return None

    def stretch_modulation(
        self,
        sensor: Any,  # noqa: ANN401 - its own
        change: tuple[float, float],
    ) -> SensorDescription | None:
        """Return the sensor with its modulation stretched further; None if it has none.

        ``change`` are half the logarithms of the ratio of two axes: those along x and y, and those
        along 45 and 135 degrees.
        """
        return None

    def modulation_entry(self, sensor: Any) -> str:  # noqa: ANN401 - its own
        """Return the value of ``wfs.modulation_ellipse`` for a sensor with such a modulation."""
        raise ModelError(f"a {self.name}: found an elliptic modulation, expected a pyramid's")

    def aberrate(
        self,
        sensor: Any,  # noqa: ANN401 - its own
        number: int,
        change_rad: float,
    ) -> SensorDescription | None:
        """Return the sensor with more of a static Zernike polynomial; None if it has none.

        ``number`` is Noll's, ``change_rad`` the change of its coefficient in radians RMS.
        """
        return None

    def aberration_entry(self, sensor: Any) -> str:  # noqa: ANN401 - its own
        """Return the value of ``wfs.static_aberration_nm`` for a sensor with such an aberration."""
        raise ModelError(f"a {self.name}: found a static aberration, expected a pyramid's")

    def other_recipes(self, recipe: SlopeRecipe) -> dict[str, SlopeRecipe]:
        """Return recipes that this one may be taken for, by what a file would say of them."""
        return {}

    def other_sensors(self, sensor: Any) -> dict[str, SensorDescription]:  # noqa: ANN401 - its own
        """Return sensors that this one may be taken for, by what a file would say of them."""
        return {}

    @abstractmethod
    def aot(self, recipe: SlopeRecipe) -> tuple[str, dict[str, int]]:
        """Return its class in AOT files, and the fields that only this class is given."""

    def image_sigma_subap(self, instrument: Instrument) -> float | None:
        """Return the prior 1 σ of the position of each pupil image, in subapertures.

        None if the sensor has one pupil image, or if the file states the positions.
        """
        return None

    def image_floors(self, instrument: Instrument) -> tuple[Array, Array]:
        """Return 1 σ of α ``(4,)`` by places of pupil images that the file calls unknown.

        Then the same by places that the file neither states nor calls unknown. Numeric units
        (subapertures, radians, ratio); 0 where nothing is unknown. Rotation and magnification
        displace the pupil's edge.
        """
        return np.zeros(4), np.zeros(4)

    def displace_images(self, instrument: Instrument, offsets: Array) -> SensorDescription:
        """Return the sensor with its pupil images displaced by ``offsets`` ``(2 n_images,)``.

        Subapertures, axes of conventions.md: of each image along x, then of each along y.

        Raises
        ------
        ModelError
            If it has only one image.
        """
        return self.with_images_at(instrument, self.offsets_px(instrument, offsets))

    def image_offsets(self, instrument: Instrument) -> Array | None:
        """Return the displacements of the pupil images in the instrument file, ``(4, 2)``.

        They are relative to the pixel grid, less their mean, in subapertures and the axes of
        conventions.md: (x, y) of the images at -x -y, +x -y, -x +y, +x +y. None if the file does
        not state them.
        """
        return None

    def turned_edge_sigma(self, instrument: Instrument, displaced_subap: Array) -> Array:
        """Return 1 σ of α ``(4,)`` from the turned edges of what displaces the pupil images.

        ``displaced_subap`` ``(4, 2)`` is added to what the instrument file states. Numeric units; 0
        for a sensor with one image.
        """
        return np.zeros(4)

    def turn_edges(self, instrument: Instrument, sensor: Any, shapes: Array) -> Array:  # noqa: ANN401 - its own
        """Return what turned edges of displaced images add to the signals of wavefronts.

        ``(n_signals, n_shapes)``; ``shapes`` ``(n_points, n_shapes)`` as for ``Response.apply``.
        """
        return np.zeros((sensor.n_signals, shapes.shape[1]))

    def offsets_px(self, instrument: Instrument, offsets: Array) -> Array:
        """Return displacements ``(n_images, 2)`` in pixels, as an instrument file has them.

        Raises
        ------
        ModelError
            If it has only one image.
        """
        raise ModelError(f"a {self.name}: found several images to be moved, expected a pyramid's")

    def with_images_at(self, instrument: Instrument, offsets_px: Array) -> SensorDescription:
        """Return the sensor with its images displaced as an instrument file states it, ``(4, 2)``.

        The inverse of ``offsets_px``.

        Raises
        ------
        ModelError
            If it has only one image.
        """
        raise ModelError(f"a {self.name}: found several images to be moved, expected a pyramid's")

    def without_image_places(self, instrument: Instrument) -> Instrument | None:
        """Return the instrument without the places of its pupil images; None if it states none."""
        return None

    def pupil_offset(self, instrument: Instrument) -> tuple[float, float] | None:
        """Return where file or mask place the pupil's image on the grid, (x, y).

        Subapertures, axes of conventions.md; None if they do not say.
        """
        if instrument.wfs.valid_subapertures is None:
            return None
        return find_offset(valid_subapertures(instrument), instrument.wfs.pupil_diameter)

    def light(self, instrument: Instrument) -> Light | CannotTell:
        """Return what an instrument's light says of the pupil, or why it says nothing."""
        return CannotTell(
            reason=f"the position of the pupil cannot be estimated from the flux of a {self.name}"
        )


def _mean(term: Term) -> float:
    return term if isinstance(term, float) else float(term.mean())
