"""A pyramid as an instrument has it, made of its file's table or refused."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument, SensorMode, sensor_of_kind
from service.model.kinds import LoopFacts
from service.model.sensors.pyramid.table import PyramidMode, PyramidNumbers, PyramidTable
from service.model.slopes import Orientation

_SEPARATION_TOLERANCE = 0.1

_FRAME_KEYS = ("pupil_centres_px", "pixels_per_subaperture")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pyramid(PyramidNumbers):
    """The modulated pyramid wavefront sensor, and which of its subapertures are valid."""

    kind: ClassVar[str] = "pyramid"

    valid_subapertures: NDArray[np.bool_] | None = None
    """Mask ``(n_subapertures, n_subapertures)``, [y, x] in the RTC's own axes, as its slopes are
    listed; None: by ``flux_threshold`` at α = 0."""

    image_offsets_subap: tuple[tuple[float, float], ...] | None = None
    """Displacement (x, y) of the images at -x -y, +x -y, -x +y and +x +y from their places on the
    pixel grid, subapertures, in the RTC's own axes; None if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameWindows:
    """Positions of the four pupil images on full detector frames."""

    centres_px: NDArray[np.float64] | None = None
    """``(4, 2)`` row and column of the images' centres, one in each quadrant of the four, in any
    order; pixel centres are whole numbers. None: to be found in a flux frame."""

    pixels_per_subaperture: int = 1
    """Detector pixels along a side of a subaperture."""


def pyramid_of(table: PyramidTable, given: frozenset[str]) -> Pyramid:
    """Return the pyramid of a table without its mask; ``given`` are the keys that are written.

    Raises
    ------
    ModelError
        One line that begins with the key: the images overlap, or are not where the keys place them.
    """
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
    return Pyramid(
        **optics | {"pupil_separation_subap": separation},
        image_offsets_subap=offsets,
    )


def modes_of(table: PyramidTable, sensor: Pyramid) -> tuple[tuple[SensorMode, str], ...]:
    """Return the modes that a table makes of its sensor, each with where its mask is.

    Raises
    ------
    ModelError
        One line that begins with the key: two of one name, a binning that does not divide, frames.
    """
    if table.mode and table.input == "frames":
        raise ModelError('mode: belongs to input = "slopes", found input = "frames"')
    names = [mode.config_id for mode in table.mode]
    for k, mode in enumerate(table.mode):
        if mode.config_id in names[:k]:
            raise ModelError(
                f"mode[{k}].config_id: found {mode.config_id!r} again, expected a name of its own"
            )
    return tuple(
        (_in_mode(sensor, mode, f"mode[{k}]"), mode.valid_subapertures)
        for k, mode in enumerate(table.mode)
    )


def bin_pyramid(sensor: Pyramid, binning: int) -> Pyramid:
    """Return the pyramid whose subapertures are ``binning`` of the finest along each axis."""
    return replace(
        sensor,
        n_subapertures=sensor.n_subapertures // binning,
        pupil_separation_subap=sensor.image_separation_subap / binning,
        pupil_diameter_subap=sensor.pupil_diameter / binning,
        image_offsets_subap=None
        if sensor.image_offsets_subap is None
        else tuple((x / binning, y / binning) for x, y in sensor.image_offsets_subap),
    )


def _in_mode(sensor: Pyramid, mode: PyramidMode, where: str) -> SensorMode:
    n, binning = sensor.n_subapertures, mode.binning
    # A binned grid that does not fill the finest one may have a column more or less: only the RTC
    # knows.
    if mode.n_subapertures is None and n % binning:
        raise ModelError(
            f"{where}.binning: found {binning} of {n} subapertures, which it does not divide; "
            f"expected n_subapertures as well, that of the binned grid: about {n / binning:.1f}"
        )
    across = mode.n_subapertures or n // binning
    diameter = sensor.pupil_diameter / binning
    # A grid a little narrower than the image cuts its rim only; one of twice its width is a slip.
    if not diameter - 1.0 < across < 2.0 * diameter:
        raise ModelError(
            f"{where}.n_subapertures: found {across} across a pupil image of {diameter:.1f}, "
            "expected as many as the image is wide, or a few more"
        )
    modulation = mode.modulation_lambda_over_d
    wfs = replace(
        bin_pyramid(sensor, binning),
        n_subapertures=across,
        modulation_lambda_over_d=(
            sensor.modulation_lambda_over_d if modulation is None else modulation
        ),
    )
    loop = LoopFacts(frame_rate_hz=mode.frame_rate_hz, n_controlled=mode.n_controlled)
    return SensorMode(config_id=mode.config_id, binning=binning, wfs=wfs, loop=loop)


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
    told = pyramid_in(instrument).image_offsets_subap
    if told is None:
        return None
    return orient_offsets(np.array(told).reshape(2, 2, 2), instrument.slopes.assumed_orientation)


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


def frames_of(table: PyramidTable, given: frozenset[str]) -> FrameWindows | None:
    """Return the positions of the images on the RTC's frames; None if the RTC sends slopes.

    Raises
    ------
    ModelError
        One line that begins with the key: it belongs to frames, or the images are no quadrants.
    """
    if table.input == "slopes":
        for key in _FRAME_KEYS:
            if key in given and getattr(table, key) != 1:
                raise ModelError(f'{key}: belongs to input = "frames", found input = "slopes"')
        return None
    centres = None if table.pupil_centres_px is None else _centres(table).reshape(4, 2)
    return FrameWindows(centres_px=centres, pixels_per_subaperture=table.pixels_per_subaperture)


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
