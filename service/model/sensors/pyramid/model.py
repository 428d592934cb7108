"""The pyramid as a model of a kind of sensor."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.model.instrument import Instrument, SensorMode
from service.model.kinds import Normalisation
from service.model.pupil import PupilGrid
from service.model.sensors.model import SensorModel, Term
from service.model.sensors.pyramid import description, detector_windows, signals, working_point
from service.model.sensors.pyramid.description import FrameWindows, Pyramid, pyramid_in
from service.model.sensors.pyramid.light import PyramidLight
from service.model.sensors.pyramid.table import IMAGE_KEY, PyramidTable
from service.model.sensors.pyramid.working_point import Halo
from service.model.sensors.sensor import Fineness, WorkingPoint
from service.model.slopes import SlopeRecipe

Array = NDArray[np.float64]

IMAGE_SIGMA_PX = 0.15
"""1 σ of the displacement of a pupil image from its place on the pixel grid, along an axis, in
detector pixels. Real pyramids have 0.05 to 0.3 px: faces differ by some 0.1 % of their angle, and
the windows that cut out the images begin at whole pixels."""

MEASURED_SIGMA_PX = 0.1
"""The same of centres that were measured on the detector's frames. Under even light they are found
to 0.01 pixel; on real benches, where light is uneven and spiders cross the edge, two ways to find
them differ by 0.1 to 0.4."""

EDGE_SHIFT = 1.3
"""1 σ of a shift over the mean square displacement of the pupil images and over the distance
between their centres, all in subapertures. Faces that displace two images by d against each other
meet at an edge that is turned by d over that distance S. The light that it exchanges is seen at two
places d apart, so that a shift is wrong by up to d**2 / (4 S); the model moves the images alone.
Matrices of OOPAO with images displaced by 0.2 and 0.3 of 18 subapertures were fitted with errors of
0.0023 and 0.0069 (RMS of a shift), which sets of modes and regions of the pupil share."""

EDGE_TURN = 0.3
"""The same of a rotation, at the pupil's edge, over that of a shift: errors were 0.008 and 0.018
deg with a radius of 6 subapertures."""

LOCATED_SIGMA_PX = 0.005
"""1 σ of a shift by the places of images that were located on frames, in detector pixels: each is
found to 0.0065 pixel, and errors of shifts are 0.0025 RMS with images 0.1 pixel off the grid (40
draws) and 0.0039 with 0.3 pixel (16 draws, 0.0095 at most)."""

SHIFT_ERROR_RATIO = 0.25
"""Error of a shift that takes no account of displaced images, over their RMS displacement along an
axis. Of 12 and 24 subapertures, modulated by 0 and 3 λ/D, low and high modes: 0.15 to 0.27."""

EDGE_ERROR_RATIO = 0.03
"""The same of rotation and magnification, at the pupil's edge: 0.001 to 0.032."""

_WEAK_LAMBDA_OVER_D = 1.5
"""Modulation up to which the star's own width counts as much."""


class PyramidModel(SensorModel):
    """The modulated pyramid."""

    name = "pyramid"
    loses_gain = True
    edge_slips = True

    @override
    def read_sensor(
        self, table: PyramidTable, given: frozenset[str], subaperture_m: float
    ) -> Pyramid:
        return description.pyramid_of(table, given)

    @override
    def in_modes(self, table: PyramidTable, sensor: Pyramid) -> tuple[tuple[SensorMode, str], ...]:
        return description.modes_of(table, sensor)

    @override
    def frames(self, table: PyramidTable, given: frozenset[str]) -> FrameWindows | None:
        return description.frames_of(table, given)

    @override
    def signals_of_frames(
        self, instrument: Instrument, frames: NDArray[Any], flux_frame: NDArray[Any]
    ) -> Array:
        return detector_windows.slopes_from_frames(instrument, frames, flux_frame)

    @override
    def locate_images(
        self, instrument: Instrument, flux_frame: NDArray[Any]
    ) -> tuple[Instrument, tuple[str, ...]]:
        return detector_windows.locate_images(instrument, flux_frame)

    @override
    def image_centres(self, instrument: Instrument, flux_frame: NDArray[Any]) -> Array | None:
        return detector_windows.image_centres(instrument, flux_frame)

    @override
    def identity(self, sensor: Pyramid) -> tuple[float, ...]:
        separation = sensor.image_separation_subap
        return (sensor.wavelength_m, sensor.modulation_lambda_over_d, separation)

    @override
    def bin_sensor(self, sensor: Pyramid, binning: int) -> Pyramid:
        return description.bin_pyramid(sensor, binning)

    @override
    def noise_terms(self, instrument: Instrument) -> tuple[Term, Term]:
        # a difference of four pixels over the mean flux: their variances add up, in x and y alike
        return 1.0, 4.0

    @override
    def pixels(self, instrument: Instrument, valid: NDArray[np.bool_]) -> NDArray[np.intp]:
        return signals.pixel_places(valid)

    @override
    def sensor(
        self,
        instrument: Instrument,
        pupil: PupilGrid,
        fineness: Fineness,
        working_point: WorkingPoint | None = None,
    ) -> signals.PyramidSensor:
        return signals.pyramid_sensor(instrument, pupil, fineness, working_point)

    @override
    def working_point(
        self,
        instrument: Instrument,
        *,
        n_controlled: int,
        r0_m: float | None = None,
        sampling: int,
    ) -> Halo:
        return working_point.working_point(
            instrument, n_controlled=n_controlled, r0_m=r0_m, sampling=sampling
        )

    @override
    def coarsest_sampling(self, sensor: Pyramid) -> int:
        # the phase of a modulation wide for its subapertures turns too fast for one point
        wide = 2.0 * sensor.modulation_lambda_over_d + 3.0 >= sensor.pupil_diameter
        return 2 if wide else 1

    @override
    def is_weakly_modulated(self, sensor: Pyramid) -> bool:
        return sensor.modulation_lambda_over_d <= _WEAK_LAMBDA_OVER_D

    @override
    def find_fitted_key(self, sensor: Pyramid) -> str | None:
        return "modulation_lambda_over_d" if sensor.modulation_lambda_over_d > 0.0 else None

    @override
    def other_recipes(self, recipe: SlopeRecipe) -> dict[str, SlopeRecipe]:
        local = recipe.normalisation is Normalisation.LOCAL
        divisor = Normalisation.GLOBAL if local else Normalisation.LOCAL
        return {f'normalisation = "{divisor}"': replace(recipe, normalisation=divisor)}

    @override
    def aot(self, recipe: SlopeRecipe) -> tuple[str, dict[str, int]]:
        return "Pyramid", {"n_sides": 4, "dimensions": recipe.kind.n_planes}

    @override
    def image_sigma_subap(self, instrument: Instrument) -> float | None:
        if pyramid_in(instrument).image_offsets_subap is not None:
            return None
        measured = isinstance(instrument.frames, FrameWindows)
        return (MEASURED_SIGMA_PX if measured else IMAGE_SIGMA_PX) / _pixels(instrument)

    @override
    def image_floors(self, instrument: Instrument) -> tuple[Array, Array]:
        sigma, radius = self.image_sigma_subap(instrument) or 0.0, instrument.wfs.pupil_diameter / 2
        shift, edge = SHIFT_ERROR_RATIO * sigma, EDGE_ERROR_RATIO * sigma / radius
        floor, none = np.array([shift, shift, edge, edge]), np.zeros(4)
        return (floor, none) if f"wfs.{IMAGE_KEY}" in instrument.unknown else (none, floor)

    @override
    def turned_edge_sigma(self, instrument: Instrument, displaced_subap: Array) -> Array:
        stated = self.image_offsets(instrument)
        offsets = displaced_subap + (0.0 if stated is None else stated)
        apart = offsets - offsets.mean(axis=0)
        wfs = pyramid_in(instrument)
        shift = EDGE_SHIFT * float(np.mean(apart**2)) / wfs.image_separation_subap
        turn = EDGE_TURN * shift / (wfs.pupil_diameter / 2.0)
        if isinstance(instrument.frames, FrameWindows):
            shift = float(np.hypot(shift, LOCATED_SIGMA_PX / _pixels(instrument)))
        return np.array([shift, shift, turn, 0.0])

    @override
    def image_offsets(self, instrument: Instrument) -> Array | None:
        offsets = description.image_offsets(instrument)
        return None if offsets is None else offsets.reshape(4, 2)

    @override
    def offsets_px(self, instrument: Instrument, offsets: Array) -> Array:
        turned = description.orient_offsets(
            offsets.reshape(2, 2, 2).transpose(1, 2, 0),
            instrument.slopes.assumed_orientation,
            back=True,
        )
        return turned.reshape(4, 2) * _pixels(instrument)

    @override
    def with_images_at(self, instrument: Instrument, offsets_px: Array) -> Pyramid:
        pixels = _pixels(instrument)
        places = tuple((float(x) / pixels, float(y) / pixels) for x, y in offsets_px)
        return replace(pyramid_in(instrument), image_offsets_subap=places)

    @override
    def pupil_offset(self, instrument: Instrument) -> tuple[float, float] | None:
        turned = description.stated_offsets(instrument)
        if turned is None:
            return None
        x, y = turned.mean(axis=(0, 1))
        return float(x), float(y)

    @override
    def light(self, instrument: Instrument) -> PyramidLight:
        return PyramidLight(instrument=instrument)


def _pixels(instrument: Instrument) -> int:
    """Return the detector pixels along a side of a subaperture."""
    frames = instrument.frames
    return frames.pixels_per_subaperture if isinstance(frames, FrameWindows) else 1
