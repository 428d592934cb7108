"""A pyramid as an instrument has it: its record, its frames, the places of its images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument, sensor_of_kind
from service.model.pupil import PupilGrid
from service.model.sensors.pyramid.table import FftGrid, PyramidNumbers
from service.model.slopes import Orientation
from service.model.zernikes import compute_zernikes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pyramid(PyramidNumbers):
    """The modulated pyramid wavefront sensor, and which of its subapertures are valid."""

    kind: ClassVar[str] = "pyramid"

    valid_subapertures: NDArray[np.bool_] | None = None
    """Mask ``(n_subapertures, n_subapertures)``, [y, x] in the RTC's own axes, as its slopes are
    listed; None: by ``flux_threshold`` at α = 0."""

    modulation_stretch: tuple[float, float] | None = None
    """Stretch ``(e, f)`` of the circle to an ellipse, in the RTC's own axes. The path is that of
    the circle times the exponential of ``[[e, f], [f, -e]]``. None for a circle."""

    fft_grid: FftGrid | None = None
    """Grid of the simulation that made a matrix; None for a real sensor."""

    aberration_rad: tuple[float, ...] = ()
    """Coefficients of the static aberration's Zernike polynomials from Noll's number 2 on, radians
    RMS, in the RTC's own axes; empty for a flat wavefront."""

    image_offsets_subap: tuple[tuple[float, float], ...] | None = None
    """Displacement (x, y) of the images at -x -y, +x -y, -x +y and +x +y from their places on the
    pixel grid, subapertures, in the RTC's own axes; None if unknown."""

    @property
    def largest_modulation(self) -> float:
        """Radius of the modulation, or the longer semi-axis, λ/D."""
        return self.modulation_lambda_over_d * math.exp(
            math.hypot(*self.modulation_stretch or (0,))
        )

    @property
    def modulation_path(self) -> tuple[float, float, float]:
        """``(a, b, c)`` of the path ``x = b cos t + c sin t``, ``y = a cos t``, λ/D.

        Every ellipse has this form, whose points t and -t have the same y.
        """
        radius, (e, f) = self.modulation_lambda_over_d, self.modulation_stretch or (0.0, 0.0)
        size = 2.0 * math.hypot(e, f)
        # the square of the exponential of a traceless symmetric matrix
        slant = math.sinh(size) / size * 2.0 if size else 2.0
        along_y = math.sqrt(math.cosh(size) - slant * e)
        return radius * along_y, radius * slant * f / along_y, radius / along_y

    @property
    def modulation_axes(self) -> tuple[float, float, float]:
        """Semi-axes of the modulation, λ/D, and the angle of the first, radians, the RTC's axes."""
        e, f = self.modulation_stretch or (0.0, 0.0)
        radius, ratio = self.modulation_lambda_over_d, math.exp(math.hypot(e, f))
        return radius * ratio, radius / ratio, math.atan2(f, e) / 2.0


def read_aberration(coefficients_nm: Sequence[float], wavelength_m: float) -> tuple[float, ...]:
    """Return ``Pyramid.aberration_rad`` of coefficients in nm RMS."""
    return tuple(2e-9 * math.pi / wavelength_m * one for one in coefficients_nm)


def stretch_of(axes: tuple[float, float], angle_rad: float) -> tuple[float, float]:
    """Return ``Pyramid.modulation_stretch`` of an ellipse; the first axis is at the angle."""
    size = math.log(axes[0] / axes[1]) / 2.0
    return size * math.cos(2.0 * angle_rad), size * math.sin(2.0 * angle_rad)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameWindows:
    """Positions of the four pupil images on full detector frames."""

    centres_px: NDArray[np.float64] | None = None
    """``(4, 2)`` row and column of the images' centres, one in each quadrant of the four, in any
    order; pixel centres are whole numbers. None: to be found in a flux frame."""

    pixels_per_subaperture: int = 1
    """Detector pixels along a side of a subaperture."""

    normalised: bool = False
    """True if the frames are divided by their sum over the detector."""

    @property
    def off_grid_subap(self) -> NDArray[np.float64]:
        """Displacement (x, y) of each window from a square around their middle, ``(4, 2)``.

        Subapertures, in the detector's own axes; 0 where the images are still to be found.
        """
        if self.centres_px is None:
            return np.zeros((4, 2))
        sides = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) / 2.0
        off = by_quadrant(self.centres_px).reshape(4, 2) - self.centres_px.mean(axis=0)
        square = sides * 2.0 * float(np.mean(off * sides * 2.0))
        return np.asarray((off - square)[:, ::-1] / self.pixels_per_subaperture)


def image_offsets(instrument: Instrument) -> NDArray[np.float64] | None:
    """Return displacements of the images from their places ``(2, 2, 2)``: side y, side x, (x, y).

    As ``stated_offsets``, their mean subtracted: with the mirror as stop it is the shift of α, with
    the telescope as stop the place of the pupil.
    """
    stated = stated_offsets(instrument)
    return None if stated is None else np.asarray(stated - stated.mean(axis=(0, 1)))


def stated_offsets(instrument: Instrument) -> NDArray[np.float64] | None:
    """Return what the file says of the images' places ``(2, 2, 2)``: side y, side x, (x, y).

    In subapertures and in the axes of conventions.md; None if they are unknown.
    """
    offsets = pyramid_in(instrument).image_offsets_subap
    if offsets is None:
        return None
    return orient_offsets(np.array(offsets).reshape(2, 2, 2), instrument.slopes.assumed_orientation)


def orient_offsets(
    offsets: NDArray[np.float64], orientation: Orientation, *, back: bool = False
) -> NDArray[np.float64]:
    """Return displacements ``(2, 2, 2)`` of the RTC's axes in those of conventions.md.

    Side along y, side along x, (x, y). A sign of -1 exchanges the images' roles and leaves each at
    its place, as with pixels. ``back``: from conventions.md to the RTC's axes.
    """
    # A flip reverses the places of the images and the direction of their displacements.
    flips = np.array([orientation.flip_x, orientation.flip_y])
    signs = np.array([orientation.sign_x, orientation.sign_y]) * (-1) ** flips

    def flip(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values[:: signs[1], :: signs[0]] * (-1.0) ** flips

    def swap(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values.swapaxes(0, 1)[..., ::-1] if orientation.swap_xy else values

    return flip(swap(offsets)) if back else swap(flip(offsets))


def pyramid_in(instrument: Instrument) -> Pyramid:
    """Return the pyramid of an instrument that has one.

    Raises
    ------
    ModelError
        If its sensor is another.
    """
    return sensor_of_kind(instrument, Pyramid)


def oriented_pyramid(instrument: Instrument) -> Pyramid:
    """Return the pyramid with its modulation and its rooftop in the axes of conventions.md.

    Raises
    ------
    ModelError
        If the sensor is another.
    """
    wfs, orientation = pyramid_in(instrument), instrument.slopes.assumed_orientation
    mirrored = -1.0 if orientation.flip_x != orientation.flip_y else 1.0
    wfs = replace(wfs, rooftop_lambda_over_d=mirrored * wfs.rooftop_lambda_over_d)
    if wfs.modulation_stretch is None:
        return wfs
    e, f = wfs.modulation_stretch
    return replace(wfs, modulation_stretch=(-e if orientation.swap_xy else e, mirrored * f))


def draw_aberration(instrument: Instrument, pupil: PupilGrid) -> NDArray[np.float64] | None:
    """Return the static aberration over a pupil ``(n, n)`` [y, x] in radians; None without one."""
    wfs = pyramid_in(instrument)
    if not any(wfs.aberration_rad):
        return None
    phase = np.zeros(pupil.lit.shape)
    # Zernike polynomials grow without bound beyond the pupil.
    points = pupil.points / max(wfs.pupil_diameter / 2.0, np.hypot(*pupil.points.T).max())
    orientation = instrument.slopes.assumed_orientation
    points = points[:, ::-1] if orientation.swap_xy else points
    flips = [-1.0 if one else 1.0 for one in (orientation.flip_x, orientation.flip_y)]
    phase[pupil.lit] = compute_zernikes(np.array([0.0, *wfs.aberration_rad]), points * flips)
    # Signs of the slopes are those of commands, which the aberration shares.
    return -phase if orientation.sign_x == orientation.sign_y == -1 else phase


def by_quadrant(centres_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return four centres ``(4, 2)`` as ``(2, 2, 2)``: side along y, side along x, (row, column).

    Raises
    ------
    ModelError
        If the four quadrants around their mean do not contain one each.
    """
    # By quadrant, so that a file may list the centres in any order.
    side = (centres_px > centres_px.mean(axis=0)).astype(int)
    place = 2 * side[:, 0] + side[:, 1]
    if sorted(place) != [0, 1, 2, 3]:
        raise ModelError(
            f"found pupil images at {centres_px.tolist()}, expected one in each quadrant"
        )
    return np.asarray(centres_px[np.argsort(place)].reshape(2, 2, 2))
