"""The base of every simulated telescope: pupil, mirror, sensor, errors.

It differs from the service's model of it by its grid and by everything in ``Imperfections``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Required, Self, TypedDict

import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError, ModelError
from service.model.instrument import Instrument, Mirror, SensorDescription
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis
from service.model.pupil import PupilGrid, valid_subapertures
from service.model.sensors.registry import kind_of
from sim_rtc.telescope.atmosphere import PhaseResponse
from sim_rtc.telescope.imperfections import (
    Imperfections,
    ShapeErrors,
    SlopeErrors,
    distort_points,
    image_offsets,
    non_common_path,
    true_sensor,
)
from sim_rtc.telescope.influence import InfluenceCube
from sim_rtc.telescope.mirror import MirrorFaults, PlantSurface, disobedient, misplace_actuators
from sim_rtc.telescope.scene import Scene

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_RENDER_ROWS = 512


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Optics(ABC):
    """The telescope's effect on a wavefront at one registration."""

    alpha: Misregistration
    """True registration of the mirror on the sensor."""

    opd_per_command: Array32
    """``(n_points, n_modes)`` OPD at the plant's pupil points per metre of command, as seen."""

    stuck_opd_m: Array32
    """``(n_points,)`` what stuck actuators add."""

    images: Array
    """Share of the light that every pixel detects, 0 where it is dead, in the sensor's own shape:
    ``(2, n, 2, n)`` of a pyramid, side, row along y, side, column along x; ``(n, m, n, m)`` of
    lenslets, row of them, row of their pixels, and so along x."""

    responses: tuple[tuple[float, PhaseResponse], ...] = ()
    """Slopes per metre of turbulence OPD: shares of exact responses, their sum 1; none where the
    slopes are not linear in the phase."""

    @property
    @abstractmethod
    def n_slopes(self) -> int:
        """Slopes of a frame."""

    @abstractmethod
    def towards(self, other: Self, share: float) -> Self:
        """Return the optics part of the way to ``other``, for small steps of a drift."""


class Departures(TypedDict, total=False):
    """Imperfections of a telescope; only the random numbers are required."""

    rng: Required[np.random.Generator]
    imperfections: Imperfections
    scene: Scene
    faults: MirrorFaults
    influence: InfluenceCube | None
    """Influence functions to use instead of the plant's own."""


class Plant(ABC):
    """A telescope, at any registration."""

    _instrument: Instrument
    _points: Array

    points_m: Array
    """``(n_points, 2)`` where the phase is sampled in the pupil, metres."""

    pitch_m: float
    """Distance between neighbouring points, metres."""

    weights: Array
    """``(n_points,)`` share of the pupil's area at each point; sums to 1."""

    valid: NDArray[np.bool_]
    """``(n_subapertures, n_subapertures)`` mask of the subapertures that give slopes."""

    pixels: NDArray[np.intp]
    """``(n_pixels, n_valid)`` indices of their pixels in the light."""

    slope_errors: SlopeErrors
    """Errors of light and slopes."""

    sensor_opd_m: Array32
    """``(n_points,)`` static OPD that the sensor sees and the science does not."""

    image_offsets_px: Array | None = None
    """``(4, 2)`` displacement (x, y) of each pupil image; None if they are on the pixel grid."""

    @abstractmethod
    def optics(self, alpha: Misregistration) -> Optics:
        """Return the optics at ``alpha``; takes seconds."""

    def sort_rows(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Return rows ``(n_slopes, ...)`` of conventions.md as this telescope lists its slopes."""
        return rows

    def _image_shift(self, alpha: Misregistration) -> tuple[float, float]:
        """Return by how much the pupil images move on the sensor, subapertures.

        With the telescope as stop they stay where the instrument file has them.
        """
        if self._instrument.stop is Stop.TELESCOPE:
            stated = kind_of(self._instrument).pupil_offset(self._instrument)
            return self._instrument.pupil_shift_subap or stated or (0.0, 0.0)
        return (alpha.shift_x_subap, alpha.shift_y_subap)

    def _on_mirror(self, alpha: Misregistration) -> Array:
        """Return the position of each point of the pupil on the mirror, ``(n_points, 2)``."""
        beside = np.array(self._image_shift(alpha)) - alpha.vector[:2]
        return self._instrument.with_anamorphosis(alpha).on_mirror(self._points + beside)


class SimulatedPlant(Plant):
    """A telescope simulated from its instrument file, with imperfections the file omits."""

    def __init__(
        self,
        instrument: Instrument,
        basis: ModalBasis,
        pupil: PupilGrid,
        made: Departures,
        binning: int = 1,
    ) -> None:
        """Take the pupil of the instrument file, and detector pixels along a subaperture's side."""
        imperfections = made.get("imperfections") or Imperfections()
        scene = made.get("scene") or Scene()
        # A stream for each imperfection, so that changing one leaves the others of a seed as they
        # are.
        uneven_rng, position_rng, pixel_rng, path_rng, *later_rngs = made["rng"].spawn(6)
        self._passes = np.float32(scene.passes)
        width_m = instrument.subaperture_m
        pupil = scene.light(pupil, width_m)
        self.image_offsets_px = image_offsets(imperfections, later_rngs[1])
        self._wfs = true_sensor(instrument, imperfections)
        self._instrument = replace(instrument, wfs=self._wfs)
        if self.image_offsets_px is not None:
            offsets_subap = (self.image_offsets_px / binning).T.ravel()
            self._wfs = _displace_images(self._instrument, offsets_subap)
            self._instrument = replace(instrument, wfs=self._wfs)
        self._pupil = light_unevenly(pupil, imperfections.unevenness, uneven_rng)
        drawn, influence = instrument.analytic_mirror, made.get("influence")
        mirror = misplace_actuators(drawn, imperfections.position_error, position_rng)
        strokes = basis.mode_to_actuator
        if influence is None:
            self._surface, strokes = self._own_surface(mirror, strokes)
        else:
            self._surface = influence.surface(drawn.positions_m, mirror.positions_m, width_m)
        faults = made.get("faults") or MirrorFaults()
        self._weights = np.column_stack(disobedient(self._surface, strokes, faults))
        self._shape_errors = ShapeErrors(
            pupil.lit, strokes.shape[1], imperfections.model_error, later_rngs[0]
        )
        self._points = distort_points(pupil.points, pupil.weights, imperfections)
        self.points_m = self._points * width_m
        self.pitch_m = width_m / pupil.sampling
        self.weights = pupil.weights
        self.valid = valid_subapertures(instrument)
        self.pixels = kind_of(instrument).pixels(instrument, self.valid)
        self.slope_errors = SlopeErrors(self.pixels, imperfections, pixel_rng, instrument.slopes)
        self.sensor_opd_m = non_common_path(self._points, self.weights, imperfections, path_rng)

    @abstractmethod
    def _own_surface(self, mirror: Mirror, strokes: Array) -> tuple[PlantSurface, Array]:
        """Return the surface of a mirror without measured influence functions, and its strokes."""

    def _render(self, alpha: Misregistration) -> tuple[Array32, Array32]:
        """Return modes ``(n_points, n_modes)`` and stuck actuators ``(n_points,)``, seen once."""
        on_mirror = self._on_mirror(alpha)
        blocks = [
            self._surface.basis(on_mirror[start : start + _RENDER_ROWS]) @ self._weights
            # In rows, because the basis of all points at once would be larger than the modes.
            for start in range(0, len(on_mirror), _RENDER_ROWS)
        ]
        shapes = np.concatenate([block.astype(np.float32) for block in blocks])
        modes = self._shape_errors.add_errors(shapes[:, :-1], on_mirror)
        return modes, np.ascontiguousarray(shapes[:, -1])


def _displace_images(instrument: Instrument, offsets_subap: Array) -> SensorDescription:
    """Return the sensor with its pupil images displaced ``(8,)``: along x, then along y.

    Raises
    ------
    ConfigurationError
        If it has one image only.
    """
    try:
        return kind_of(instrument).displace_images(instrument, offsets_subap)
    except ModelError as error:
        raise ConfigurationError(f"--image-offsets: {error}") from error


def interpolate(first: Array32, last: Array32, share: float) -> Array32:
    """Return the array part of the way from ``first`` to ``last``."""
    mixed = last - first
    mixed *= np.float32(share)
    mixed += first
    return mixed


def registration_between(first: Optics, last: Optics, share: float) -> Misregistration:
    """Return the registration part of the way from one to the other."""
    return Misregistration.from_vector(
        (1.0 - share) * first.alpha.vector + share * last.alpha.vector
    )


def light_unevenly(pupil: PupilGrid, unevenness: float, rng: np.random.Generator) -> PupilGrid:
    """Return the pupil lit by a random smooth map: polynomials up to third order, mean kept."""
    u = pupil.coordinates / np.abs(pupil.coordinates).max()
    x, y = u[None, :], u[:, None]
    powers = [(i, j) for i in range(4) for j in range(4) if 0 < i + j <= 3]
    departure = np.zeros_like(pupil.amplitude)
    for (i, j), weight in zip(powers, rng.standard_normal(len(powers)), strict=True):
        departure += weight * x**i * y**j
    departure -= departure[pupil.lit] @ pupil.weights
    departure *= unevenness / np.abs(departure[pupil.lit]).max()
    flux = np.maximum(1.0 + np.where(pupil.lit, departure, 0.0), 0.0)
    # The map is of the flux; the field goes with its square root.
    return replace(pupil, amplitude=pupil.amplitude * np.sqrt(flux))
