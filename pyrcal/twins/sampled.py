"""A fitted bench on the square grid of a simulation that uses an FFT."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.instrument_checks import COUPLING_KEY
from pyrcal.fitting.models import ABERRATION_KEY, ELLIPSE_KEY, ROOFTOP_KEY, set_coupling
from service.files.container import MAX_BYTES
from service.files.disk_cache import cached_basis
from service.model.instrument import Instrument, Mirror
from service.model.interaction import InteractionModel
from service.model.kinds import SignalKind, Stop
from service.model.misregistration import Misregistration
from service.model.modes import Basis, ModalBasis
from service.model.pupil import Illumination, PupilGrid, instrument_pupil, valid_subapertures
from service.model.sensors.pyramid.description import (
    FrameWindows,
    by_quadrant,
    draw_aberration,
    orient_offsets,
    oriented_pyramid,
    pyramid_in,
    read_aberration,
    stretch_of,
)
from service.model.sensors.pyramid.table import FftGrid
from service.model.sensors.registry import kind_of
from service.model.slopes import Orientation, rtc_mask, to_rtc
from service.model.surface import Gaussian

Array = NDArray[Any]

USUAL_POINTS = (2, 4)
"""Points of the pupil along a subaperture, where the files do not give the grid."""

MAX_POINTS = 8
"""Largest number of points along a subaperture that is taken from the map of the pupil."""

USUAL_WIDTH = 3.0
"""Width of the detector over that of the pupil, where neither frames nor the files give it."""

MAX_JUDGED_MODES = 40
"""Number of modes with which the places of the pupil images are judged."""

NOTABLE_SHARE = 0.001
"""Difference of what two models leave, from which on a remark names it."""

MIN_LIGHT = 0.02
"""Least light over the mean: a smooth gain may fall below 0 at the pupil's edge."""

Actuators = tuple[Basis, Array]
"""Influence functions of actuators, and strokes ``(n_actuators, n_modes)`` of the bench's modes."""

_Grid = tuple[int, int]
"""Points per detector pixel, and detector pixels across."""

_SIDES = np.array([[[-1, -1], [1, -1]], [[-1, 1], [1, 1]]]) / 2.0
"""Position (x, y) of each image over the separation, ``(2, 2, 2)`` [side y, side x]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """A sampled bench as a model of another program."""

    path: Path
    """File that the other program runs."""

    remarks: tuple[str, ...]
    """Assumptions of the model and what it does not contain, one sentence each."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampledBench:
    """A fitted bench in the axes of conventions.md, on a grid of points and of detector pixels."""

    instrument: Instrument
    """Instrument with the fitted values."""

    basis: Basis
    """Modes of the mirror, with the fitted coupling."""

    actuators: Actuators | None = None
    """Actuators of the mirror; None if only shapes of modes are given."""

    alpha: Misregistration
    """Fitted registration."""

    n_pixels: int
    """Detector pixels along the pupil's array."""

    points_per_pixel: int
    """Points of the pupil along a detector pixel."""

    width_px: int
    """Width of the detector, and of the grid of the FFT, pixels."""

    separation_px: float
    """Distance between the centres of neighbouring pupil images, pixels."""

    illumination: Illumination | None
    """Light over the pupil, which the fit has found as a gain; None for even light."""

    amplitude: Array
    """``(n_points, n_points)`` field amplitude of the pupil on the whole array, in this light."""

    aberration_m: Array | None
    """``(n_points, n_points)`` OPD of the static aberration, metres; None for a flat wavefront."""

    pupil_shift_subap: Array
    """``(2,)`` position (x, y) of the pupil on the sensor's grid, subapertures."""

    image_places_px: Array
    """``(2, 2, 2)`` [side y, side x, (x, y)] displacement of the images from a centred square."""

    valid: NDArray[np.bool_]
    """``(n_pixels, n_pixels)`` valid subapertures."""

    unit_m: float
    """OPD of a unit command, metres, light passes included."""

    frame_shape: tuple[int, int] | None = None
    """Rows and columns of the bench's frames; None if it has slopes."""

    reverse: bool
    """True if the bench's signals have the other sign than those of conventions.md."""

    remarks: tuple[str, ...] = ()
    """Assumptions, one sentence each."""

    @property
    def n_points(self) -> int:
        """Points across the pupil's array."""
        return self.n_pixels * self.points_per_pixel

    @property
    def pixels(self) -> int:
        """Detector pixels along a subaperture."""
        return _pixels(self.instrument)

    @property
    def n_subapertures(self) -> int:
        """Subapertures along the pupil's array."""
        return self.n_pixels // self.pixels

    @property
    def width_m(self) -> float:
        """Width of the pupil's array, metres in the pupil plane."""
        return self.n_subapertures * self.instrument.subaperture_m

    @property
    def modulation(self) -> tuple[float, float, float]:
        """Semi-axes, λ over the array's width, and the angle of the first one, radians."""
        wider = self.n_subapertures / self.instrument.wfs.pupil_diameter
        first, second, angle = oriented_pyramid(self.instrument).modulation_axes
        return first * wider, second * wider, angle

    @property
    def rooftop_lambda_over_d(self) -> float:
        """Rooftop of the pyramid, in the axes of conventions.md."""
        return oriented_pyramid(self.instrument).rooftop_lambda_over_d

    @property
    def mirror_alpha(self) -> Misregistration:
        """Registration of the mirror on the pupil."""
        return self.alpha.add_step(np.array([*-self.pupil_shift_subap, 0.0, 0.0]))

    def points_on_mirror(self) -> Array:
        """Return where on the mirror the points of the pupil are ``(n_points ** 2, 2)``."""
        sampling, alpha = self.points_per_pixel * self.pixels, self.mirror_alpha
        along = (np.arange(self.n_points) - (self.n_points - 1) / 2) / sampling
        x, y = np.meshgrid(along, along)
        return alpha.on_mirror(np.column_stack([x.ravel(), y.ravel()]) - alpha.vector[:2])

    @property
    def gaussian(self) -> tuple[ModalBasis, Gaussian] | None:
        """Modes and functions of a mirror whose functions are Gaussians; None of any other.

        Functions that end at the edges of segments are no Gaussians.
        """
        basis = self.basis
        if not isinstance(basis, ModalBasis) or not isinstance(basis.surface, Gaussian):
            return None
        return None if basis.surface.segments_deg else (basis, basis.surface)

    def render_functions(self, drawn: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return functions ``(n_drawn, n)`` where α puts them, and the modes made of them.

        ``drawn`` ``(n_points, n_points)`` marks the points. The modes are ``(n, n_modes)``: strokes
        of actuators, or the identity if the functions are the modes themselves.
        """
        functions, modes = self.actuators or (self.basis, np.eye(self.basis.n_modes))
        return functions.render(self.points_on_mirror()[drawn.ravel()]), modes

    @property
    def orientation(self) -> Orientation:
        """Orientation of the bench's signals, without the sign that the mirror has instead."""
        found = self.instrument.slopes.assumed_orientation
        return replace(found, sign_x=1, sign_y=1) if self.reverse else found

    def list_signals(self) -> tuple[Array, Array]:
        """Return for each of the bench's signals its index in the model's, and its sign.

        The model's signals are all Sx and all Sy of ``valid``, or its detector of
        ``width_px ** 2`` pixels.
        """
        if self.instrument.frames is not None:
            return self._list_pixels()
        recipe = replace(self.instrument.slopes, orientation=self.orientation)
        if recipe.kind is SignalKind.INTENSITY:
            numbers = 1 + self._list_image_pixels()
        else:
            numbers = 1 + np.arange(2 * int(self.valid.sum()))
        mask = rtc_mask(valid_subapertures(self.instrument), self.orientation)
        listed = to_rtc(numbers, recipe, mask)
        return np.abs(listed) - 1, np.sign(listed)

    def _list_image_pixels(self) -> Array:
        """Return the pixel of each image of each valid subaperture, image after image."""
        rows, columns = np.nonzero(self.valid)
        corner = (self.width_px - self.n_pixels) / 2
        found = []
        for x, y in _SIDES.reshape(4, 2) * self.separation_px:
            row, column = rows + round(corner + y), columns + round(corner + x)
            found.append(row * self.width_px + column)
        return np.concatenate(found)

    def _list_pixels(self) -> tuple[Array, Array]:
        """Return the model's pixel of each of the bench's, row by row, and signs of 1."""
        n, apart, orientation = self.width_px, round(self.separation_px), self.orientation
        places = np.arange(n)
        other = np.where(places < n / 2, places + apart, places - apart) % n
        # a sign of -1 exchanges the images at -x and +x, which stay as they are
        along_y = other if orientation.sign_y < 0 else places
        along_x = other if orientation.sign_x < 0 else places
        flipped = rtc_mask(np.arange(n * n).reshape(n, n), orientation)[np.ix_(along_y, along_x)]
        rows, columns = self.frame_shape or (n, n)
        return flipped[:rows, :columns].ravel(), np.ones(rows * columns, dtype=int)


def sample_bench(
    instrument: Instrument,
    fit: Fit,
    frame_shape: tuple[int, int] | None = None,
    actuators: Actuators | None = None,
) -> SampledBench:
    """Return a fitted bench on the grid of the simulation that made its matrix, or a usual one.

    ``frame_shape`` is that of the bench's frames; None if it has slopes, or a square detector that
    the files describe. ``actuators`` are those of a mirror whose functions are given.

    Raises
    ------
    ModelError
        If the sensor is no pyramid.
    """
    found = apply_fit(instrument, fit)
    basis = set_coupling(cached_basis(instrument), list_adopted(fit).get(COUPLING_KEY))
    tried = [
        _place_images(replace(_draw_bench(found, basis, fit, *grid), frame_shape=frame_shape), fit)
        for grid in _list_grids(found, frame_shape)
    ]
    bench, left = min(tried, key=lambda one: one[1])
    bench = _with_actuators(bench, actuators)
    if "wfs.wavelength_m" in found.unknown:
        wavelength_nm = found.wfs.wavelength_m * 1e9
        remark = f"The wavelength is unknown: {wavelength_nm:.0f} nm is assumed."
        bench = replace(bench, remarks=(*bench.remarks, remark))
    if pyramid_in(found).fft_grid is not None:
        return bench
    remark = (
        f"The grid of {bench.points_per_pixel} points per detector pixel and {bench.width_px} "
        f"pixels leaves least of those that were tried, {left:.1%}: the instrument file gives no "
        "fft_grid."
    )
    return replace(bench, remarks=(*bench.remarks, remark))


def _with_actuators(bench: SampledBench, actuators: Actuators | None) -> SampledBench:
    """Return the bench with its actuators, or with a remark that its models have none."""
    basis = bench.basis
    if isinstance(basis, ModalBasis):
        actuators = basis.of_actuators, basis.mode_to_actuator
    reason = "no influence functions of actuators are given"
    if actuators is not None:
        n_bytes = 8 * bench.n_points**2 * actuators[0].n_modes
        # OOPAO's model of a Gaussian mirror has positions, and SPECULA needs its functions
        if n_bytes <= MAX_BYTES or bench.gaussian is not None:
            return replace(bench, actuators=actuators)
        reason = f"the functions of all actuators would take {n_bytes / 1e9:.0f} GB"
    remark = f"The mirror of the models has the bench's modes instead of its actuators: {reason}."
    return replace(bench, remarks=(*bench.remarks, remark))


def _list_grids(instrument: Instrument, frame_shape: tuple[int, int] | None) -> list[_Grid]:
    """Return the grid that the instrument file gives, or those on which a matrix may be simulated.

    OOPAO's usual grid is twice the separation wide, SPECULA's three pupils.
    """
    wfs, pixels = pyramid_in(instrument), _pixels(instrument)
    n, separation = wfs.n_subapertures * pixels, wfs.image_separation_subap * pixels
    grid, pupil = wfs.fft_grid, instrument.pupil
    widths = {2 * separation, max(USUAL_WIDTH * n, n + separation)}
    points = {float(one) for one in USUAL_POINTS}
    if grid is not None:
        widths, points = {grid.width_subap * pixels}, {float(grid.points_per_subaperture)}
    elif pupil is not None:
        # the map of a simulated pupil has its points
        own = round(instrument.subaperture_m / pupil.pitch_m, 3)
        points = {own} if own.is_integer() and own <= MAX_POINTS else points
    if frame_shape is not None:
        widths = {max(frame_shape)}
    even = {2 * math.ceil(width / 2 - 1e-6) for width in widths}
    per_pixel = {max(1, math.ceil(one / pixels)) for one in points}
    # OOPAO has one point for each pixel, or an even number
    return [(one + (one % 2 if one > 1 else 0), width) for one in per_pixel for width in even]


def _draw_bench(found: Instrument, basis: Basis, fit: Fit, points: int, width: int) -> SampledBench:
    """Return a bench with its images on a centred square, for so many points and pixels."""
    pixels = _pixels(found)
    light = _read_light(fit)
    pupil, n_pixels = _draw_pupil(found, pixels, points, light)
    n_points = n_pixels * points
    phase_rad = draw_aberration(found, pupil)
    metres = found.wfs.wavelength_m / (2.0 * math.pi)
    separation = pyramid_in(found).image_separation_subap * pixels
    if found.frames is None:
        # slopes are cut at whole pixels on both sides of the middle
        separation = n_pixels + 2.0 * round((separation - n_pixels) / 2)
    orientation = found.slopes.assumed_orientation
    return SampledBench(
        instrument=found,
        basis=basis,
        alpha=fit.alpha,
        n_pixels=n_pixels,
        points_per_pixel=points,
        width_px=width,
        separation_px=separation,
        illumination=light,
        amplitude=_pad(pupil.amplitude, n_points),
        aberration_m=None if phase_rad is None else _pad(phase_rad * metres, n_points),
        pupil_shift_subap=_pupil_shift(found, fit.alpha),
        image_places_px=np.zeros((2, 2, 2)),
        valid=_pad(valid_subapertures(found), n_pixels // pixels),
        unit_m=1.0 if found.mirror.stroke_known else float(np.median(fit.gains)),
        reverse=orientation.sign_x == orientation.sign_y == -1,
    )


def apply_fit(instrument: Instrument, fit: Fit) -> Instrument:
    """Return the instrument with the values that the fit determined."""
    slopes = replace(instrument.slopes, orientation=fit.orientation, order=fit.order)
    wfs, mirror = pyramid_in(instrument), instrument.mirror
    values = list_adopted(fit)
    if isinstance(mirror, Mirror) and COUPLING_KEY in values:
        mirror = replace(mirror, shape=replace(mirror.shape, coupling=values[COUPLING_KEY]))
    wfs = replace(
        wfs,
        modulation_lambda_over_d=values.get(
            "modulation_lambda_over_d", wfs.modulation_lambda_over_d
        ),
        rooftop_lambda_over_d=values.get(ROOFTOP_KEY, wfs.rooftop_lambda_over_d),
    )
    for origin in fit.origins:
        if origin.key == ELLIPSE_KEY:
            ellipse = tomllib.loads(origin.entry)[ELLIPSE_KEY]
            first, second = ellipse["axes_lambda_over_d"]
            stretch = stretch_of((first, second), math.radians(ellipse["angle_deg"]))
            radius = math.sqrt(first * second)
            wfs = replace(wfs, modulation_lambda_over_d=radius, modulation_stretch=stretch)
        elif origin.key == ABERRATION_KEY:
            found = tomllib.loads(origin.entry)[ABERRATION_KEY]
            wfs = replace(wfs, aberration_rad=read_aberration(found, wfs.wavelength_m))
    return replace(instrument, slopes=slopes, wfs=wfs, mirror=mirror)


def list_adopted(fit: Fit) -> dict[str, float]:
    """Return the fitted optical numbers that take the place of the instrument file's, by key."""
    return {one.key: one.found for one in fit.optics if one.found is not None and one.is_adopted}


def _pixels(instrument: Instrument) -> int:
    frames = instrument.frames
    return frames.pixels_per_subaperture if isinstance(frames, FrameWindows) else 1


def _pad(square: Array, n: int) -> Array:
    return np.pad(square, (n - len(square)) // 2)


def _read_light(fit: Fit) -> Illumination | None:
    """Return the light that makes slopes as much larger as the fitted gain over the pupil."""
    if fit.gain_map is None:
        return None
    unknown = np.isnan(fit.gain_map)
    nearest = scipy.ndimage.distance_transform_edt(
        unknown, return_distances=False, return_indices=True
    )
    along = np.arange(len(unknown), dtype=np.float64) - (len(unknown) - 1) / 2
    light = np.maximum(fit.gain_map[tuple(nearest)], MIN_LIGHT)
    return Illumination(coordinates=along, intensity=light)


def _draw_pupil(
    instrument: Instrument, pixels: int, points: int, light: Illumination | None
) -> tuple[PupilGrid, int]:
    """Return the pupil, and the pixels of an array around it that has the sensor's grid inside."""
    n, sampling = instrument.wfs.n_subapertures, pixels * points
    pupil = instrument_pupil(instrument, sampling)
    margin = max(0, math.ceil((len(pupil.coordinates) / sampling - n) / 2))
    return pupil if light is None else pupil.lit_by(light), (n + 2 * margin) * pixels


def _pupil_shift(instrument: Instrument, alpha: Misregistration) -> Array:
    """Return where the pupil is on the sensor's grid ``(2,)``, subapertures."""
    if instrument.stop is Stop.MIRROR:
        return alpha.vector[:2]
    return np.array(kind_of(instrument).pupil_offset(instrument) or (0.0, 0.0))


def _place_images(bench: SampledBench, fit: Fit) -> tuple[SampledBench, float]:
    """Return the bench with the places of its images, and what its model leaves of the matrix.

    A fit with a continuous model absorbs the sampling of a simulated bench in fitted places:
    written into a model of the same sampling they would leave ten times as much.
    """
    kind, about, remarks = kind_of(bench.instrument), bench.instrument, bench.remarks
    left = _residual(bench, about, fit)
    if fit.image_offsets_px is not None:
        there = replace(about, wfs=kind.with_images_at(about, fit.image_offsets_px))
        with_places = _residual(bench, there, fit)
        if with_places < left:
            about, left = there, with_places
        elif with_places > left + NOTABLE_SHARE:
            remarks = (
                *remarks,
                f"The fitted places of the pupil images are left out: with them {with_places:.2%} "
                f"is left over, without them {left:.2%}.",
            )
    off = kind.image_offsets(about)
    places = _window_places(bench) + bench.pupil_shift_subap * bench.pixels
    if off is not None:
        places += off.reshape(2, 2, 2) * bench.pixels
    return replace(bench, image_places_px=places, remarks=remarks), left


def _window_places(bench: SampledBench) -> Array:
    """Return the displacement of the windows ``(2, 2, 2)`` from a centred square, our axes."""
    frames = bench.instrument.frames
    if not isinstance(frames, FrameWindows) or frames.centres_px is None:
        return np.zeros((2, 2, 2))
    off = by_quadrant(frames.centres_px)[..., ::-1] - (bench.width_px - 1) / 2
    return orient_offsets(off - _SIDES * bench.separation_px, bench.orientation)


def _residual(bench: SampledBench, instrument: Instrument, fit: Fit) -> float:
    """Return what a model on the bench's grid leaves of the measured matrix."""
    sampling = bench.points_per_pixel * bench.pixels
    grid = FftGrid(points_per_subaperture=sampling, width_subap=bench.width_px / bench.pixels)
    some = np.unique(np.linspace(0, len(fit.modes) - 1, MAX_JUDGED_MODES).astype(int))
    model = InteractionModel(
        replace(instrument, wfs=replace(pyramid_in(instrument), fft_grid=grid)),
        bench.basis.subset(fit.modes[some]),
        pupil_sampling=sampling,
        detector_nodes=sampling,
        illumination=bench.illumination,
    )
    found = model.interaction_matrix(bench.alpha)
    return residual_fraction(fit.measured[:, some], found)


def residual_fraction(measured: Array, found: Array) -> float:
    """Return the RMS of ``measured`` that ``found`` leaves, with a free gain for each mode."""
    return float(np.sqrt(np.mean(1.0 - correlations(measured, found) ** 2)))


def correlations(measured: Array, found: Array) -> Array:
    """Return the correlation ``(n_modes,)`` of two matrices in each column.

    Rows that are 0 or not finite in all of ``measured`` do not count.
    """
    rows = np.isfinite(measured).all(axis=1) & np.any(measured != 0.0, axis=1)
    one, other = measured[rows].astype(float), found[rows].astype(float)
    scale = np.linalg.norm(one, axis=0) * np.linalg.norm(other, axis=0)
    return np.asarray(np.sum(one * other, axis=0) / scale)
