"""The pyramid as a model of a kind of sensor."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError
from service.model.instrument import Instrument, SensorDescription, SensorMode
from service.model.kinds import LoopFacts, Normalisation
from service.model.pupil import PupilGrid, valid_subapertures
from service.model.sensors.model import SensorModel, Term
from service.model.sensors.pyramid import description, detector_windows, signals, working_point
from service.model.sensors.pyramid.description import (
    FrameWindows,
    Pyramid,
    by_quadrant,
    orient_offsets,
    oriented_pyramid,
    pyramid_in,
    read_aberration,
    stretch_of,
)
from service.model.sensors.pyramid.light import PyramidLight
from service.model.sensors.pyramid.optics import PyramidOptics, enough_modulation_points
from service.model.sensors.pyramid.table import IMAGE_KEY, PyramidMode, PyramidNumbers, PyramidTable
from service.model.sensors.pyramid.turned_edges import turn_edges
from service.model.sensors.pyramid.working_point import Halo
from service.model.sensors.sensor import CannotTell, Fineness, WorkingPoint
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

WHOLE_PIXEL_SIGMA_PX = 0.3
"""The same of images that a simulation has anywhere between windows of whole pixels."""

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

_SEPARATION_TOLERANCE = 0.1

_FRAME_KEYS = ("pupil_centres_px", "pixels_per_subaperture")

USUAL_MODULATION = 3.0
"""Modulation, λ/D, that is tried where the instrument file states none."""

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
        diameter, separation = table.pupil_diameter, _separation(table, given)
        # Images that overlap on the detector add their light: no normalised difference of them is a
        # slope.
        if separation < diameter:
            raise ModelError(
                f"pupil_separation_subap: found {separation:g}, expected at least the pupil's "
                f"diameter, {diameter:g} subapertures: the images would overlap"
            )
        optics = {field.name: getattr(table, field.name) for field in fields(PyramidNumbers)}
        pixels = table.pixels_per_subaperture
        # The file has detector pixels, because windows are cut there; the optics need subapertures.
        offsets: tuple[tuple[float, float], ...] | None = None
        if table.image_offsets_px is not None:
            offsets = tuple((x / pixels, y / pixels) for x, y in table.image_offsets_px)
        ellipse, stretch = table.modulation_ellipse, None
        if ellipse is not None:
            stretch = stretch_of(ellipse.axes_lambda_over_d, math.radians(ellipse.angle_deg))
        return Pyramid(
            **optics | {"pupil_separation_subap": separation},
            aberration_rad=read_aberration(table.static_aberration_nm or (), table.wavelength_m),
            image_offsets_subap=offsets,
            modulation_stretch=stretch,
            fft_grid=table.fft_grid,
        )

    @override
    def in_modes(self, table: PyramidTable, sensor: Pyramid) -> tuple[tuple[SensorMode, str], ...]:
        if table.mode and table.input != "slopes":
            raise ModelError(f'mode: belongs to input = "slopes", found input = "{table.input}"')
        names = [mode.config_id for mode in table.mode]
        for k, mode in enumerate(table.mode):
            if mode.config_id in names[:k]:
                raise ModelError(
                    f"mode[{k}].config_id: found {mode.config_id!r} again, expected a name of "
                    "its own"
                )
        return tuple(
            (self._in_mode(sensor, mode, f"mode[{k}]"), mode.valid_subapertures)
            for k, mode in enumerate(table.mode)
        )

    def _in_mode(self, sensor: Pyramid, mode: PyramidMode, where: str) -> SensorMode:
        n, binning = sensor.n_subapertures, mode.binning
        # A binned grid that does not fill the finest one may have a column more or less: only the
        # RTC knows.
        if mode.n_subapertures is None and n % binning:
            raise ModelError(
                f"{where}.binning: found {binning} of {n} subapertures, which it does not divide; "
                f"expected n_subapertures as well, that of the binned grid: about {n / binning:.1f}"
            )
        across = mode.n_subapertures or n // binning
        diameter = sensor.pupil_diameter / binning
        # A grid a little narrower than the image cuts its rim only; one of twice its width is a
        # slip.
        if not diameter - 1.0 < across < 2.0 * diameter:
            raise ModelError(
                f"{where}.n_subapertures: found {across} across a pupil image of {diameter:.1f}, "
                "expected as many as the image is wide, or a few more"
            )
        modulation = mode.modulation_lambda_over_d
        wfs = replace(
            self.bin_sensor(sensor, binning),
            n_subapertures=across,
            modulation_lambda_over_d=(
                sensor.modulation_lambda_over_d if modulation is None else modulation
            ),
            fft_grid=None,
        )
        loop = LoopFacts(frame_rate_hz=mode.frame_rate_hz, n_controlled=mode.n_controlled)
        return SensorMode(config_id=mode.config_id, binning=binning, wfs=wfs, loop=loop)

    @override
    def frames(self, table: PyramidTable, given: frozenset[str]) -> FrameWindows | None:
        if table.input == "slopes":
            for key in _FRAME_KEYS:
                if key in given and getattr(table, key) != 1:
                    raise ModelError(f'{key}: belongs to input = "frames", found input = "slopes"')
            return None
        centres = None if table.pupil_centres_px is None else _centres(table).reshape(4, 2)
        return FrameWindows(
            centres_px=centres,
            pixels_per_subaperture=table.pixels_per_subaperture,
            normalised=table.input == "normalised-frames",
        )

    @override
    def signals_of_frames(
        self, instrument: Instrument, frames: NDArray[Any], flux_frame: NDArray[Any] | None
    ) -> Array:
        return detector_windows.slopes_from_frames(instrument, frames, flux_frame)

    @override
    def knows_mean_light(self, instrument: Instrument) -> bool:
        return isinstance(instrument.frames, FrameWindows) and instrument.frames.normalised

    @override
    def locate_images(
        self, instrument: Instrument, flux_frame: NDArray[Any]
    ) -> tuple[Instrument, tuple[str, ...], float]:
        located, remarks, sigma = detector_windows.locate_images(instrument, flux_frame)
        if located is not instrument:  # places of the file have their part in ``turned_edge_sigma``
            sigma = float(np.hypot(sigma, _turned_edge_shift(located, np.zeros((4, 2)))))
        return located, remarks, sigma

    @override
    def measure_image_offsets(self, instrument: Instrument, light: Array) -> Array | CannotTell:
        return detector_windows.measure_image_offsets(instrument, light)

    @override
    def image_centres(self, instrument: Instrument, flux_frame: NDArray[Any]) -> Array | None:
        return detector_windows.image_centres(instrument, flux_frame)

    @override
    def identity(self, sensor: Pyramid) -> tuple[float, ...]:
        separation = sensor.image_separation_subap
        stretch, rooftop = sensor.modulation_stretch or (), sensor.rooftop_lambda_over_d
        more = (*stretch, *sensor.aberration_rad, *((rooftop,) if rooftop else ()))
        return (sensor.wavelength_m, sensor.modulation_lambda_over_d, separation, *more)

    def bin_sensor(self, sensor: Pyramid, binning: int) -> Pyramid:
        """Return the sensor with so many subapertures made one along each axis."""
        return replace(
            sensor,
            n_subapertures=sensor.n_subapertures // binning,
            pupil_separation_subap=sensor.image_separation_subap / binning,
            pupil_diameter_subap=sensor.pupil_diameter / binning,
            image_offsets_subap=None
            if sensor.image_offsets_subap is None
            else tuple((x / binning, y / binning) for x, y in sensor.image_offsets_subap),
        )

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
        wfs = oriented_pyramid(instrument)
        if not isinstance(working_point, Halo | None):
            raise ModelError(f"pyramid: found {working_point!r}, expected a halo")
        optics = PyramidOptics(
            wfs=wfs,
            pupil=pupil,
            n_nodes=fineness.n_nodes,
            n_modulation=max(fineness.n_source_points, enough_modulation_points(wfs)),
            dtype=fineness.dtype,
            halo=working_point,
            recipe=instrument.slopes,
            arrays=fineness.arrays,
            offsets=description.image_offsets(instrument),
            aberration_rad=description.draw_aberration(instrument, pupil),
        )
        return signals.PyramidSensor(
            optics=optics,
            valid=valid_subapertures(instrument),
            mapper=fineness.mapper,
            kept_bytes=fineness.kept_bytes,
        )

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
    def fine_sampling_of(self, sensor: Pyramid) -> int | None:
        return None if sensor.fft_grid is None else sensor.fft_grid.points_per_subaperture

    @override
    def coarsest_sampling(self, sensor: Pyramid) -> int:
        # The phase of a modulation that is wide for its subapertures turns too fast for one point.
        wide = 2.0 * sensor.largest_modulation + 3.0 >= sensor.pupil_diameter
        return 2 if wide else 1

    @override
    def derivative_sampling(self, sensor: Pyramid) -> int:
        # With two points 7 λ/D on 10 subapertures give a matrix that is wrong by 40 %, and the fit
        # of the modulation ended at 5.7 λ/D.
        return 1 + self.coarsest_sampling(sensor)

    @override
    def is_weakly_modulated(self, sensor: Pyramid) -> bool:
        return sensor.modulation_lambda_over_d <= _WEAK_LAMBDA_OVER_D

    @override
    def find_fitted_key(self, sensor: Pyramid) -> str | None:
        return "modulation_lambda_over_d"

    @override
    def stretch_modulation(self, sensor: Pyramid, change: tuple[float, float]) -> Pyramid:
        e, f = sensor.modulation_stretch or (0.0, 0.0)
        return replace(sensor, modulation_stretch=(e + change[0], f + change[1]))

    @override
    def modulation_entry(self, sensor: Pyramid) -> str:
        longer, shorter, angle_rad = sensor.modulation_axes
        return (
            f"{{ axes_lambda_over_d = [{longer:#.4g}, {shorter:#.4g}], "
            f"angle_deg = {math.degrees(angle_rad) % 180.0:.2f} }}"
        )

    @override
    def aberrate(self, sensor: Pyramid, number: int, change_rad: float) -> Pyramid:
        coefficients = np.zeros(max(number - 1, len(sensor.aberration_rad)))
        coefficients[: len(sensor.aberration_rad)] = sensor.aberration_rad
        coefficients[number - 2] += change_rad
        return replace(sensor, aberration_rad=tuple(coefficients.tolist()))

    @override
    def aberration_entry(self, sensor: Pyramid) -> str:
        unit_nm = sensor.wavelength_m / (2.0 * math.pi * 1e-9)
        return f"[{', '.join(f'{one * unit_nm:.1f}' for one in sensor.aberration_rad)}]"

    @override
    def other_recipes(self, recipe: SlopeRecipe) -> dict[str, SlopeRecipe]:
        local = recipe.normalisation is Normalisation.LOCAL
        divisor = Normalisation.GLOBAL if local else Normalisation.LOCAL
        return {f'normalisation = "{divisor}"': replace(recipe, normalisation=divisor)}

    @override
    def other_sensors(self, sensor: Pyramid) -> dict[str, SensorDescription]:
        # No modulation is reached by no logarithm of another one, and the reverse.
        if sensor.modulation_lambda_over_d > 0.0:
            return {"modulation_lambda_over_d = 0": replace(sensor, modulation_lambda_over_d=0.0)}
        modulated = replace(sensor, modulation_lambda_over_d=USUAL_MODULATION)
        return {'modulation_lambda_over_d = "unknown"': modulated}

    @override
    def aot(self, recipe: SlopeRecipe) -> tuple[str, dict[str, int]]:
        return "Pyramid", {"n_sides": 4, "dimensions": recipe.kind.n_planes}

    @override
    def image_sigma_subap(self, instrument: Instrument) -> float | None:
        if pyramid_in(instrument).image_offsets_subap is not None:
            return None
        measured = isinstance(instrument.frames, FrameWindows)
        if measured and pyramid_in(instrument).fft_grid is not None:
            return WHOLE_PIXEL_SIGMA_PX / _pixels(instrument)
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
        shift = _turned_edge_shift(instrument, offsets)
        turn = EDGE_TURN * shift / (instrument.wfs.pupil_diameter / 2.0)
        # A simulation puts its images exactly where its file says.
        simulated = pyramid_in(instrument).fft_grid is not None
        if isinstance(instrument.frames, FrameWindows) and not simulated:
            shift = float(np.hypot(shift, LOCATED_SIGMA_PX / _pixels(instrument)))
        return np.array([shift, shift, turn, 0.0])

    @override
    def turn_edges(self, instrument: Instrument, sensor: Any, shapes: Array) -> Array:
        frames, own = instrument.frames, instrument.slopes.assumed_orientation
        windows = frames.off_grid_subap if isinstance(frames, FrameWindows) else np.zeros((4, 2))
        stated = pyramid_in(instrument).image_offsets_subap
        # A sign exchanges images in the model, but not their edges.
        seen, off = (
            orient_offsets(np.reshape(one, (2, 2, 2)), replace(own, sign_x=1, sign_y=1))
            for one in (windows, np.zeros(8) if stated is None else stated)
        )
        exchanged = own.sign_x < 0 and own.sign_y < 0
        return turn_edges(sensor, shapes, seen, off, exchanged=exchanged)

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
    def without_image_places(self, instrument: Instrument) -> Instrument | None:
        wfs = pyramid_in(instrument)
        if wfs.image_offsets_subap is None:
            return None
        return replace(instrument, wfs=replace(wfs, image_offsets_subap=None))

    @override
    def pupil_offset(self, instrument: Instrument) -> tuple[float, float] | None:
        turned = description.stated_offsets(instrument)
        if turned is None:
            return super().pupil_offset(instrument)
        x, y = turned.mean(axis=(0, 1))
        return float(x), float(y)

    @override
    def light(self, instrument: Instrument) -> PyramidLight:
        return PyramidLight(instrument=instrument)


def _turned_edge_shift(instrument: Instrument, offsets: Array) -> float:
    """Return 1 σ of a shift by images displaced by ``offsets`` ``(4, 2)`` from their windows."""
    if isinstance(instrument.frames, FrameWindows):
        offsets = offsets + instrument.frames.off_grid_subap
    apart, wfs = offsets - offsets.mean(axis=0), pyramid_in(instrument)
    return EDGE_SHIFT * float(np.mean(apart**2)) / wfs.image_separation_subap


def _pixels(instrument: Instrument) -> int:
    """Return the detector pixels along a side of a subaperture."""
    frames = instrument.frames
    return frames.pixels_per_subaperture if isinstance(frames, FrameWindows) else 1


def _separation(table: PyramidTable, given: frozenset[str]) -> float:
    """Return the distance of the images: as given, or from their positions on the frames."""
    stated = table.image_separation_subap
    if table.pupil_centres_px is None or table.input == "slopes":
        return stated
    centres = _centres(table)
    # Both rows and both columns: faces of a real pyramid differ by some 0.1 %.
    sides = (centres[1, :, 0] - centres[0, :, 0], centres[:, 1, 1] - centres[:, 0, 1])
    measured = float(np.mean(sides)) / table.pixels_per_subaperture
    if "pupil_separation_subap" not in given:
        return measured
    if abs(measured / stated - 1.0) > _SEPARATION_TOLERANCE:
        raise ModelError(
            f"pupil_separation_subap: found {stated:g}, expected about {measured:.1f}, the "
            "distance of wfs.pupil_centres_px"
        )
    return stated


def _centres(table: PyramidTable) -> NDArray[np.float64]:
    try:
        return by_quadrant(np.array(table.pupil_centres_px))
    except ModelError as error:
        raise ModelError(f"pupil_centres_px: {error}") from error
