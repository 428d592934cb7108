"""Cut pupil images out of detector frames at sub-pixel places.

The four pupil images of a real pyramid are whole pixels wide by accident and seldom sit on a
rectangle. A window that starts between two pixels is cut from the running sum of the light, with a
spline through it: what falls on neighbouring subapertures is then neither lost nor counted twice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import MatrixError, ModelError
from service.model.instrument import Instrument
from service.model.kinds import Stop
from service.model.pupil import rtc_valid_subapertures
from service.model.pupil_images import find_pupil_images
from service.model.sensors.pyramid.description import FrameWindows, by_quadrant, pyramid_in
from service.model.sensors.pyramid.signals import signals_of
from service.model.sensors.sensor import CannotTell
from service.model.slopes import SlopeRecipe

Array = NDArray[np.float64]

_SPLINE_MARGIN_PX = 16
"""Pixels around a window that its spline is made of: further ones weigh less than 1e-5."""

_FRAMES_AT_ONCE = 32
"""Frames that are cut together: more only need memory."""

_MAX_EDGE_DISTANCE_SUBAP = 0.5
"""Distance from the circle fitted to the edge beyond which a position computed with the model is
rejected, subapertures."""

_DIAMETER_TOLERANCE = 0.05
"""Relative difference of the images' diameter from the file's that is refused."""

_EDGE_POWERS = (0.5, 2.0)
"""Powers of the light whose halves are at 0.25 and 0.71 of the light."""

_EVEN_SIGMA_PX = 0.03
"""σ of the middle below which light counts as even: there it is up to 0.023 pixel with images of 12
pixels, 0.01 with 40."""

_SAMPLING_WITHOUT_LIGHT = 3
"""Pupil points along a subaperture of the light that replaces a missing mean frame."""

_REMARK_DISTANCE_SUBAP = 0.25
"""Distance of the centres of the file from the light that is mentioned."""


_Axis = tuple[slice, Array]
"""Pixels of a window along an axis; their shares in every subaperture ``(n, n_pixels)``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Windows:
    """Cuts frames of one shape into the four pupil images."""

    centres_px: Array
    """``(2, 2, 2)``: of the image at this side along y and x its row and column."""

    shape: tuple[int, int]
    """Shape of a frame: rows, columns."""

    windows: tuple[tuple[_Axis, _Axis], ...]
    """Along y and x, at -y -x, -y +x, +y -x, +y +x."""

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
            along_y @ frames[..., rows, columns] @ along_x.T
            for (rows, along_y), (columns, along_x) in self.windows
        ]
        upper, lower = (np.stack(pair, axis=-2) for pair in (images[:2], images[2:]))
        return np.stack([upper, lower], axis=-4)


def frame_windows(instrument: Instrument, flux_frame: Array) -> Windows:
    """Return the windows of an instrument that delivers frames.

    ``flux_frame`` is ``(rows, columns)``, a mean frame; pupil images without positions in the
    instrument file are located in it.

    Raises
    ------
    ModelError
        If the images cannot be found, or a window leaves the frame.
    """
    windows = instrument.frames
    if not isinstance(windows, FrameWindows):
        raise ModelError(f"{instrument.name}: found wfs.input = slopes, expected frames")
    pixels = windows.pixels_per_subaperture
    if windows.centres_px is None:
        centres = _refine_centres(instrument, flux_frame, pixels)
    else:
        centres = by_quadrant(windows.centres_px)
    return _windows_at(instrument, centres, flux_frame, pixels)


def _refine_centres(instrument: Instrument, flux_frame: Array, pixels: int) -> Array:
    """Return the centres of the pupil images ``(2, 2, 2)`` in a mean frame, to 0.01 pixel.

    Circles through the images' edges are good to 0.1 pixel: light is diffracted between the images,
    and a rim of grey pixels is lopsided. So the images are cut out there along whole pixels, and
    each is compared with what the model shows. Where the model does not explain the light, or the
    frame ends too near, the circles stay.
    """
    from service.model.sensors.pyramid.light import image_places

    centres = found_centres(flux_frame, instrument.wfs.pupil_diameter * pixels)
    try:
        whole, images = _cut_whole_pixels(instrument, centres, flux_frame, pixels)
    except ModelError:
        return centres
    places = image_places(images, instrument)
    if isinstance(places, CannotTell):
        return centres
    # Far from the circles the model has taken uneven light for a displacement.
    found = whole + pixels * places[:, ::-1].reshape(2, 2, 2)  # (x, y) to (row, column)
    return found if np.abs(found - centres).max() < _MAX_EDGE_DISTANCE_SUBAP * pixels else centres


def measure_image_offsets(instrument: Instrument, light: Array) -> Array | CannotTell:
    """Return the displacement (x, y) of each image from whole pixels ``(4, 2)``, less their mean.

    ``light`` is a mean frame of one pixel for each subaperture, or images ``(4, n, n)`` cut from
    one.

    Raises
    ------
    ModelError
        If a frame shows no images, a window leaves it, or there are not four images of this size.
    """
    from service.model.sensors.pyramid.light import image_places

    if light.ndim == 2:
        centres = found_centres(light, instrument.wfs.pupil_diameter)
        _, light = _cut_whole_pixels(instrument, centres, light, 1)
    places = image_places(light, instrument)
    return places if isinstance(places, CannotTell) else places - places.mean(axis=0)


def _cut_whole_pixels(
    instrument: Instrument, centres: Array, flux_frame: Array, pixels: int
) -> tuple[Array, Array]:
    """Return the nearest centres of windows of whole pixels, and the images ``(4, n, n)`` there."""
    n = instrument.wfs.n_subapertures
    # The centre of an even number of pixels is between two of them.
    between = (n * pixels / 2 - 0.5) % 1.0
    whole = np.round(centres - between) + between
    images = _windows_at(instrument, whole, flux_frame, pixels).cut(flux_frame)
    return whole, images.transpose(0, 2, 1, 3).reshape(4, n, n)


def image_centres(instrument: Instrument, flux_frame: NDArray[np.floating]) -> Array | None:
    """Return where a mean frame shows the pupil images, ``(4, 2)`` row and column.

    None if it does not show them, or the instrument does not deliver frames.
    """
    windows = instrument.frames
    if not isinstance(windows, FrameWindows):
        return None
    try:
        found = _refine_centres(
            instrument, flux_frame.astype(np.float64), windows.pixels_per_subaperture
        )
    except ModelError:
        return None
    return found.reshape(4, 2)


def _windows_at(instrument: Instrument, centres: Array, flux_frame: Array, pixels: int) -> Windows:
    n = instrument.wfs.n_subapertures
    shape = (flux_frame.shape[0], flux_frame.shape[1])
    # Each image has its own window: faces displace them independently.
    windows = tuple(
        (_axis(row, n, pixels, shape[0], "rows"), _axis(column, n, pixels, shape[1], "columns"))
        for row, column in centres.reshape(4, 2)
    )
    return Windows(centres_px=centres, shape=shape, windows=windows)


def locate_images(
    instrument: Instrument, flux_frame: NDArray[np.floating]
) -> tuple[Instrument, tuple[str, ...], float]:
    """Return the instrument with its pupil images located in a mean frame, remarks, and σ.

    Positions in the instrument file are kept, and a remark states how far the light is from them.
    The last value is 1 σ of the middle of the images, subapertures; the distance of the light from
    positions in the file is part of it.

    Raises
    ------
    ModelError
        If the images cannot be found, or a window leaves the frame.
    """
    windows = instrument.frames
    if not isinstance(windows, FrameWindows) or pyramid_in(instrument).fft_grid is not None:
        return instrument, (), 0.0  # a simulation has windows of whole pixels
    light, pixels = flux_frame.astype(np.float64), windows.pixels_per_subaperture
    sigma = _place_sigma(instrument, light, pixels)
    if windows.centres_px is not None:
        seen = image_centres(instrument, light)
        # the images move with the mirror if that is the stop
        if seen is None or instrument.stop is Stop.MIRROR:
            return instrument, (), sigma
        away = (seen - by_quadrant(windows.centres_px).reshape(4, 2)) / pixels
        middle = float(np.abs(away.mean(axis=0)).max())
        if middle * pixels > _EVEN_SIGMA_PX:
            sigma = float(np.hypot(sigma, middle))
        return instrument, _remark_on_centres(seen, float(np.hypot(*away.T).max())), sigma
    centres = frame_windows(instrument, light).centres_px.reshape(4, 2)
    found = _format_centres(centres)
    remark = f"shifts count from the pupil images as found: pupil_centres_px = [{found}]"
    return replace(instrument, frames=replace(windows, centres_px=centres)), (remark,), sigma


def _place_sigma(instrument: Instrument, light: Array, pixels: int) -> float:
    """Return 1 σ of the middle of the images, subapertures, by which light is taken as their edge.

    Uneven light displaces circles: on AO188 the middle by up to 0.07 pixel, single images by 0.2.
    """
    bright = np.maximum(light - np.percentile(light, 2), 0.0)
    try:
        half = found_centres(light, instrument.wfs.pupil_diameter * pixels).reshape(4, 2)
        others = [find_pupil_images(bright**power, "flux frame") for power in _EDGE_POWERS]
    except (MatrixError, ModelError):
        return 0.0
    apart = [np.mean(one.centres_px - half, axis=0) for one in others]
    sigma = float(np.sqrt(np.mean(np.max(np.square(apart), axis=0))))
    return sigma / pixels if sigma > _EVEN_SIGMA_PX else 0.0


def _remark_on_centres(found: Array, away_subap: float) -> tuple[str, ...]:
    """Return a remark if the centres of the file differ from the pupil images of the flux frame."""
    if away_subap <= _REMARK_DISTANCE_SUBAP:
        return ()
    return (
        f"wfs.pupil_centres_px are up to {away_subap:.2f} subapertures from the pupil images of "
        f"the flux frame, which are centred at [{_format_centres(found)}]: correct the key",
    )


def _format_centres(centres: Array) -> str:
    return ", ".join(f"[{row:.2f}, {column:.2f}]" for row, column in centres)


def slopes_from_frames(
    instrument: Instrument, frames: NDArray[np.floating], flux_frame: NDArray[np.floating] | None
) -> Array:
    """Return the slopes ``(n_slopes, n_modes)`` of differential frames.

    Parameters
    ----------
    instrument
        One that delivers frames.
    frames
        ``(n_modes, rows, columns)`` change of every pixel per unit of each mode.
    flux_frame
        ``(rows, columns)`` mean frame in the same counts. None: frames are divided by their sum,
        and the mean light is the model's for an evenly lit pupil.

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
    valid = rtc_valid_subapertures(instrument)
    if flux_frame is None:
        windows, rest = _windows_without_light(instrument, frames)
    elif flux_frame.ndim != 2 or frames.ndim != 3 or frames.shape[1:] != flux_frame.shape:
        raise ModelError(
            f"frames: found shape {frames.shape} and a flux frame of {flux_frame.shape}; "
            "expected (n_modes, rows, columns) and (rows, columns)"
        )
    else:
        windows = frame_windows(instrument, flux_frame.astype(np.float64))
        rest = windows.cut(flux_frame)
    slopes = [
        slopes_per_unit(
            rest, windows.cut(frames[start : start + _FRAMES_AT_ONCE]), valid, instrument.slopes
        )
        for start in range(0, len(frames), _FRAMES_AT_ONCE)
    ]
    return np.concatenate(slopes, axis=1)


def _windows_without_light(
    instrument: Instrument, frames: NDArray[np.floating]
) -> tuple[Windows, Array]:
    """Return the windows of frames that are divided by their sum, and the model's images in them.

    The images ``(2, n, 2, n)`` are shares of the light on the whole detector.
    """
    from service.model.sensors.pyramid.light import build_even_optics

    places = instrument.frames
    if not isinstance(places, FrameWindows) or places.centres_px is None:
        raise ModelError(
            f"{instrument.name}: found neither a mean frame nor wfs.pupil_centres_px; expected one "
            "of them, to know where the pupil images are"
        )
    centres = by_quadrant(places.centres_px)
    grid = pyramid_in(instrument).fft_grid
    sampling = _SAMPLING_WITHOUT_LIGHT if grid is None else grid.points_per_subaperture
    optics = build_even_optics(instrument, sampling)
    # The pyramid absorbs nothing: its images and what it scatters beside them share this light.
    whole = float(np.sum(optics.pupil.amplitude**2)) / sampling**2
    windows = _windows_at(instrument, centres, frames[0], places.pixels_per_subaperture)
    return windows, optics.images() / whole


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
    # A dark subaperture would divide by zero.
    if flux.min() <= 0.0:
        raise ModelError(
            f"flux frame: found {flux.min():g} counts in a valid subaperture, expected light in all"
        )
    slopes = signals / flux
    return np.asarray(((changes - slopes * flux_changes) / flux).T)


def found_centres(flux_frame: Array, diameter_px: float) -> Array:
    """Return the centres of the four pupil images in a mean frame, ``(2, 2, 2)``.

    By circles through their edges.

    Raises
    ------
    ModelError
        If the lit areas are not four discs of this diameter.
    """
    try:
        images = find_pupil_images(flux_frame, "flux frame")
    except MatrixError as error:
        raise ModelError(str(error)) from error
    if abs(images.diameter_px / diameter_px - 1.0) > _DIAMETER_TOLERANCE:
        raise ModelError(
            f"flux frame: found lit areas as large as a disc of {images.diameter_px:.1f} pixels; "
            f"expected four pupil images of {diameter_px:g}"
        )
    return images.centres_px.reshape(2, 2, 2)


def _axis(centre_px: float, n: int, pixels: int, length: int, name: str) -> _Axis:
    """Return which pixels of an axis a window needs, and their shares ``(n, n_pixels)``."""
    edges = centre_px + 0.5 + (np.arange(n + 1) - n / 2) * pixels
    if edges[0] < -1e-9 or edges[-1] > length + 1e-9:
        raise ModelError(
            f"frames: found a window of {n * pixels} {name} around {centre_px:g}, which leaves "
            f"the frame of {length}"
        )
    first = max(int(np.floor(edges[0])) - _SPLINE_MARGIN_PX, 0)
    last = min(int(np.ceil(edges[-1])) + _SPLINE_MARGIN_PX, length)
    # The running sum of each pixel: its spline between two edges is the light in between.
    running = np.tri(last - first + 1, last - first, -1)
    spline = scipy.interpolate.make_interp_spline(np.arange(first, last + 1), running, k=5)
    return slice(first, last), np.diff(spline(np.clip(edges, first, last)), axis=0)
