"""Cut pupil images out of detector frames at sub-pixel places.

The four pupil images of a real pyramid are whole pixels wide by accident and seldom sit on a
rectangle. A window that starts between two pixels is cut from the running sum of the light, with a
spline through it: what falls on neighbouring subapertures is then neither lost nor counted twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument
from service.model.kinds import Stop
from service.model.pupil import rtc_valid_subapertures
from service.model.sensors.pyramid.description import FrameWindows, by_quadrant
from service.model.sensors.pyramid.signals import signals_of
from service.model.sensors.sensor import CannotTell
from service.model.slopes import SlopeRecipe

Array = NDArray[np.float64]

_REACH_PX = 16
"""Pixels around a window that its spline is made of: further ones weigh less than 1e-5."""

_AT_ONCE = 32
"""Frames that are cut together: more only need memory."""

_FARTHEST_SUBAP = 0.5
"""Distance from the middle of what is lit at which a place is not believed."""

_BESIDE_SUBAP = 0.25
"""Distance of the centres of the file from the light that is mentioned."""

_DARK, _LIT = 0.25, 0.75
"""Shares of the typical light between which a pixel counts in part when images are looked for."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Window:
    """One pupil image: which pixels it is made of, and how."""

    rows: slice
    columns: slice
    along_y: Array
    """``(n, n_rows)`` share of every pixel row in every subaperture row."""

    along_x: Array
    """``(n, n_columns)``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Windows:
    """Cuts frames of one shape into the four pupil images."""

    centres_px: Array
    """``(2, 2, 2)``: of the image at this side along y and x its row and column."""

    shape: tuple[int, int]
    """Of a frame: rows, columns."""

    windows: tuple[_Window, ...]
    """At -y -x, -y +x, +y -x, +y +x."""

    def cut(self, frames: NDArray[np.floating]) -> Array:
        """Return the images ``(..., 2, n, 2, n)`` of ``frames`` ``(..., rows, columns)``.

        Side along y, row of subapertures, side along x, column of subapertures.

        Raises
        ------
        ModelError
            If the frames have another shape.
        """
        if frames.shape[-2:] != self.shape:
            raise ModelError(f"frames: found {frames.shape[-2:]} pixels, expected {self.shape}")
        images = [
            window.along_y @ frames[..., window.rows, window.columns] @ window.along_x.T
            for window in self.windows
        ]
        upper, lower = (np.stack(pair, axis=-2) for pair in (images[:2], images[2:]))
        return np.stack([upper, lower], axis=-4)


def frame_windows(instrument: Instrument, flux_frame: Array) -> Windows:
    """Return the windows of an instrument that delivers frames.

    ``flux_frame`` is ``(rows, columns)``, a mean frame; where the instrument does not tell where
    the pupil images lie, they are found in it.

    Raises
    ------
    ModelError
        If the images cannot be found, or a window leaves the frame.
    """
    told = instrument.frames
    if not isinstance(told, FrameWindows):
        raise ModelError(f"{instrument.name}: found wfs.input = slopes, expected frames")
    pixels = told.pixels_per_subaperture
    if told.centres_px is None:
        centres = _refined(instrument, flux_frame, pixels)
    else:
        centres = by_quadrant(told.centres_px)
    return _windows_at(instrument, centres, flux_frame, pixels)


def _refined(instrument: Instrument, flux_frame: Array, pixels: int) -> Array:
    """Return the centres of the pupil images ``(2, 2, 2)`` in a mean frame, to 0.01 pixel.

    The middle of what is lit is good to 0.1 pixel: light is diffracted between the images, and a
    rim of grey pixels is lopsided. So the images are cut out there along whole pixels, and each is
    compared with what the model shows. Where the light is another pupil's, or the frame ends too
    near, the middle of what is lit stays.
    """
    from service.model.sensors.pyramid.light import image_places

    centres = found_centres(flux_frame, instrument.wfs.pupil_diameter * pixels)
    n = instrument.wfs.n_subapertures
    between = (n * pixels / 2 - 0.5) % 1.0
    whole = np.round(centres - between) + between
    try:
        images = _windows_at(instrument, whole, flux_frame, pixels).cut(flux_frame)
    except ModelError:
        return centres
    places = image_places(images.transpose(0, 2, 1, 3).reshape(4, n, n), instrument)
    if isinstance(places, CannotTell):
        return centres
    found = whole + pixels * places[:, ::-1].reshape(2, 2, 2)  # (x, y) to (row, column)
    return found if np.abs(found - centres).max() < _FARTHEST_SUBAP * pixels else centres


def _windows_at(instrument: Instrument, centres: Array, flux_frame: Array, pixels: int) -> Windows:
    n = instrument.wfs.n_subapertures
    shape = (flux_frame.shape[0], flux_frame.shape[1])
    windows = []
    for row, column in centres.reshape(4, 2):
        rows, along_y = _axis(row, n, pixels, shape[0], "rows")
        columns, along_x = _axis(column, n, pixels, shape[1], "columns")
        windows.append(_Window(rows=rows, columns=columns, along_y=along_y, along_x=along_x))
    return Windows(centres_px=centres, shape=shape, windows=tuple(windows))


def remarks_on_windows(instrument: Instrument, flux_frame: NDArray[np.floating]) -> Iterator[str]:
    """Yield where the pupil images were found, or how far they are from where they should be."""
    windows = instrument.frames
    if not isinstance(windows, FrameWindows):
        return
    light = flux_frame.astype(np.float64)
    if windows.centres_px is None:
        centres = frame_windows(instrument, light).centres_px.reshape(4, 2)
        found = f"pupil_centres_px = [{_listed(centres)}]"
        yield f"shifts count from the pupil images as found: {found}"
    elif instrument.stop is not Stop.MIRROR:  # with it the images move
        yield from _beside_the_light(instrument, windows, light)


def _beside_the_light(instrument: Instrument, windows: FrameWindows, light: Array) -> Iterator[str]:
    """Yield that the centres of the file lie beside the pupil images of the flux frame."""
    if windows.centres_px is None:
        return
    pixels = windows.pixels_per_subaperture
    try:
        found = found_centres(light, instrument.wfs.pupil_diameter * pixels).reshape(4, 2)
    except ModelError:
        return
    expected = by_quadrant(windows.centres_px).reshape(4, 2)
    away = float(np.hypot(*(found - expected).T).max()) / pixels
    if away > _BESIDE_SUBAP:
        yield (
            f"wfs.pupil_centres_px lie up to {away:.2f} subapertures beside the pupil images of "
            f"the flux frame, which are centred at [{_listed(found)}]: correct the key"
        )


def _listed(centres: Array) -> str:
    return ", ".join(f"[{row:.2f}, {column:.2f}]" for row, column in centres)


def slopes_from_frames(
    instrument: Instrument, frames: NDArray[np.floating], flux_frame: NDArray[np.floating]
) -> Array:
    """Return the slopes ``(n_slopes, n_modes)`` that differential frames stand for.

    Parameters
    ----------
    instrument
        One that delivers frames.
    frames
        ``(n_modes, rows, columns)`` change of every pixel per unit of each mode.
    flux_frame
        ``(rows, columns)`` mean frame in the same counts.

    Returns
    -------
    slopes
        All Sx, then all Sy, or the four images, on the detector's own axes, by
        ``rtc_valid_subapertures``.

    Raises
    ------
    ModelError
        If the frames do not fit one another, the pupil images are not found in them, or a valid
        subaperture is dark.
    """
    if flux_frame.ndim != 2 or frames.ndim != 3 or frames.shape[1:] != flux_frame.shape:
        raise ModelError(
            f"frames: found shape {frames.shape} and a flux frame of {flux_frame.shape}; "
            "expected (n_modes, rows, columns) and (rows, columns)"
        )
    windows = frame_windows(instrument, flux_frame.astype(np.float64))
    valid = rtc_valid_subapertures(instrument)
    rest = windows.cut(flux_frame)
    slopes = [
        slopes_per_unit(
            rest, windows.cut(frames[start : start + _AT_ONCE]), valid, instrument.slopes
        )
        for start in range(0, len(frames), _AT_ONCE)
    ]
    return np.concatenate(slopes, axis=1)


def slopes_per_unit(
    rest: Array, images: Array, valid: NDArray[np.bool_], recipe: SlopeRecipe
) -> Array:
    """Return what the signals do ``(n_slopes, n_modes)`` when the light changes.

    ``rest`` is ``(2, n, 2, n)`` the mean light, ``images`` ``(n_modes, 2, n, 2, n)`` its change
    per unit of every mode. All Sx, then all Sy, of the subapertures ``valid`` ``(n, n)`` [y, x],
    on the detector's own axes: a wavefront that moves light to lower columns has a positive Sx.
    The normalisation's own change is part of it.

    Raises
    ------
    ModelError
        If a valid subaperture, or all of them together, sees no light.
    """
    signals, flux = signals_of(rest, valid, recipe)
    changes, flux_changes = signals_of(images, valid, recipe)
    if flux.min() <= 0.0:
        raise ModelError(
            f"flux frame: found {flux.min():g} counts in a valid subaperture, expected light in all"
        )
    slopes = signals / flux
    return np.asarray(((changes - slopes * flux_changes) / flux).T)


def found_centres(flux_frame: Array, diameter_px: float) -> Array:
    """Return the centres of the four pupil images in a mean frame, ``(2, 2, 2)``.

    The middle of what is lit at all, however unevenly: only the outline counts.

    Raises
    ------
    ModelError
        If the lit areas are not four discs of this diameter.
    """
    light = np.nan_to_num(flux_frame)
    row, column = _darkest(light.sum(axis=1)), _darkest(light.sum(axis=0))
    centres = np.empty((2, 2, 2))
    for y, rows in enumerate((slice(None, row), slice(row, None))):
        for x, columns in enumerate((slice(None, column), slice(column, None))):
            disc = _disc(light[rows, columns])
            middle = [axis @ np.arange(len(axis)) for axis in _profiles(disc)]
            centres[y, x] = np.add(middle, [y * row, x * column])
            found_px = float(np.sqrt(4 / np.pi * disc.sum()))
            if abs(found_px / diameter_px - 1.0) > 0.05:
                raise ModelError(
                    f"flux frame: found a lit area as large as a disc of {found_px:.1f} pixels "
                    f"near row {centres[y, x, 0]:.0f}, column {centres[y, x, 1]:.0f}; expected "
                    f"four pupil images of {diameter_px:g}"
                )
    return centres


def _darkest(profile: Array) -> int:
    """Return the darkest line in the middle half of a profile: it parts the images."""
    quarter = len(profile) // 4
    return quarter + int(np.argmin(profile[quarter : len(profile) - quarter]))


def _disc(light: Array) -> Array:
    """Return the lit disc of one quadrant: 1 inside, holes filled, the lit share on the edge."""
    bright = light[light > np.percentile(light, 98) / 3]
    typical = np.median(bright) if bright.size else 1.0
    lit = np.clip((light / typical - _DARK) / (_LIT - _DARK), 0.0, 1.0)
    solid = scipy.ndimage.binary_fill_holes(lit > 0.5)
    return np.where(
        scipy.ndimage.binary_erosion(solid), 1.0, lit * scipy.ndimage.binary_dilation(solid)
    )


def _profiles(disc: Array) -> tuple[Array, Array]:
    """Return how a disc is spread over rows and columns; each sums to 1."""
    total = max(float(disc.sum()), 1e-300)
    return disc.sum(axis=1) / total, disc.sum(axis=0) / total


def _axis(centre_px: float, n: int, pixels: int, length: int, name: str) -> tuple[slice, Array]:
    """Return which pixels of an axis a window needs, and their shares ``(n, n_pixels)``."""
    edges = centre_px + 0.5 + (np.arange(n + 1) - n / 2) * pixels
    if edges[0] < -1e-9 or edges[-1] > length + 1e-9:
        raise ModelError(
            f"frames: found a window of {n * pixels} {name} around {centre_px:g}, which leaves "
            f"the frame of {length}"
        )
    first = max(int(np.floor(edges[0])) - _REACH_PX, 0)
    last = min(int(np.ceil(edges[-1])) + _REACH_PX, length)
    running = np.tri(last - first + 1, last - first, -1)
    spline = scipy.interpolate.make_interp_spline(np.arange(first, last + 1), running, k=5)
    return slice(first, last), np.diff(spline(np.clip(edges, first, last)), axis=0)
