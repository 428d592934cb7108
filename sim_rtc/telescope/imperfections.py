"""Imperfections of the telescope relative to its nominal geometry.

There is one record for all plants. A calibration must tolerate all of them, so each is an option
with a default. ``realistic`` is a mix of all except two: errors of the modes' shapes, which
simulate a bench with a poor model, and displaced pupil images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.instrument import Instrument, SensorDescription
from service.model.kinds import SignalKind
from service.model.sensors.registry import kind_of
from service.model.slopes import PLAIN, SlopeRecipe, signals_of_slopes, slopes_of

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_NCPA_ORDER = 4
_NCPA_FIRST_SHAPE = 3
"""First shape of the non-common path aberration. Piston and tilts are excluded: an offset of the
image is no aberration."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Imperfections:
    """Imperfections of the plant relative to the nominal geometry."""

    unevenness: float = 0.10
    """Largest departure of the illumination from its mean, ratio of the flux."""

    position_error: float = 0.02
    """RMS error of an actuator's position per axis, in actuator pitches."""

    lowest_optical_gain: float = 0.6
    """Optical gain of the first mode, 0..1; the linear plant's only: physics gives the other's."""

    highest_optical_gain: float = 0.9
    """Optical gain of the last mode, 0..1."""

    bad_pixels: int = 0
    """Dead detector pixels: no light is read there, and the RTC, which knows them, reads slopes of
    0 in their subapertures."""

    distortion_subap: float = 0.0
    """Third-order radial distortion of the pupil image at its edge, in subapertures."""

    anamorphosis: float = 0.0
    """Stretch of the pupil image along x over the mean of both axes, ratio less 1."""

    modulation_error: float = 0.0
    """True modulation radius over the nominal one, less 1."""

    slope_rotation_deg: float = 0.0
    """Turn of the slope axes (the pyramid's edges) from +x towards +y."""

    ncpa_nm: float = 0.0
    """Static wavefront that only the sensor sees, nm RMS."""

    ncpa_zernike: int = 0
    """Noll's number of the polynomial that it consists of; 0 if it is random."""

    model_error: float = 0.0
    """Error of every mode's shape, a smooth pattern of its own: RMS gradient over the mode's."""

    image_offsets_px: tuple[float, ...] = ()
    """Displacement x, y of each pupil image of a pyramid from its place on the pixel grid, detector
    pixels, of the images at -x -y, +x -y, -x +y, +x +y. Their mean would be a shift of the
    registration and is taken out. Empty if the images are on the grid."""

    image_offset_rms_px: float = 0.0
    """RMS of the eight displacements, detector pixels, if they are drawn at random."""


SETS = {
    "ideal": Imperfections(
        unevenness=0.0, position_error=0.0, lowest_optical_gain=1.0, highest_optical_gain=1.0
    ),
    "usual": Imperfections(),
    "realistic": Imperfections(
        unevenness=0.20,
        position_error=0.02,
        lowest_optical_gain=0.45,
        highest_optical_gain=0.75,
        bad_pixels=6,
        distortion_subap=0.10,
        anamorphosis=0.002,
        modulation_error=0.10,
        slope_rotation_deg=1.0,
        ncpa_nm=30.0,
    ),
}
"""Mixes that have a name."""


_WHOLE_BYTES = 1e9
"""Size above which an array is processed in parts, because it would be in memory five times."""

_COLUMNS = 1024


class SlopeErrors:
    """Errors of light and slopes: dark pixels, silent subapertures, turned axes.

    The flux that dead pixels lack is missing in the mean that normalises every other slope, too.
    """

    def __init__(
        self,
        pixels: NDArray[np.intp],
        imperfections: Imperfections,
        rng: np.random.Generator,
        recipe: SlopeRecipe = PLAIN,
    ) -> None:
        """Set the indices of the pixels of valid subapertures in the flux, of a ``SensorKind``.

        ``pixels`` is ``(n_pixels, n_valid)``.
        """
        self.recipe = recipe
        """Computes signals from the light."""
        n_valid = pixels.shape[1]
        angle = np.deg2rad(imperfections.slope_rotation_deg)
        self._cosine, self._sine = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        n_bad = min(imperfections.bad_pixels, pixels.size)
        bad = rng.choice(pixels.size, size=n_bad, replace=False)
        self.silent: NDArray[np.bool_] = np.zeros(n_valid, dtype=np.bool_)
        """``(n_valid,)`` subapertures whose slopes read 0."""
        # pixels is (n_pixels, n_valid), so the remainder is the subaperture.
        self.silent[bad % n_valid] = True
        self._dark = pixels.reshape(-1)[bad]

    @property
    def absent(self) -> bool:
        """Whether the slopes are left as they are."""
        return bool(self._sine == 0.0 and not self.silent.any())

    def read(self, light: NDArray[Any]) -> NDArray[Any]:
        """Return what reaches the detector's electronics of light in the sensor's own shape."""
        if not len(self._dark):
            return light
        read = light.copy()
        read.reshape(-1)[self._dark] = 0
        return read

    def add_errors(self, slopes: Array32) -> Array32:
        """Return the slopes with these errors; the first axis of ``slopes`` is ``n_slopes``."""
        if self.absent:
            return slopes
        if slopes.nbytes <= _WHOLE_BYTES:
            return self._wrong(slopes)
        read = np.empty_like(slopes)
        for start in range(0, slopes.shape[1], _COLUMNS):
            part = slice(start, start + _COLUMNS)
            read[:, part] = self._wrong(slopes[:, part])
        return read

    def _wrong(self, slopes: Array32) -> Array32:
        along_x, along_y = before = slopes_of(slopes, self.recipe.kind)
        turned = np.stack(
            [
                self._cosine * along_x - self._sine * along_y,
                self._sine * along_x + self._cosine * along_y,
            ]
        )
        if self.recipe.kind is SignalKind.XY:
            read = turned.reshape(slopes.shape)
        else:
            read = slopes + signals_of_slopes(turned - before, self.recipe.kind)
        read[np.tile(self.silent, self.recipe.kind.n_planes)] = 0.0
        return np.asarray(read)


def image_offsets(imperfections: Imperfections, rng: np.random.Generator) -> Array | None:
    """Return the displacements (x, y) of the four pupil images ``(4, 2)``, detector pixels.

    Of the images at -x -y, +x -y, -x +y, +x +y; their mean is 0. None if they are on the pixel
    grid.
    """
    given, rms_px = imperfections.image_offsets_px, imperfections.image_offset_rms_px
    drawn = rng.standard_normal((4, 2))
    if given:
        offsets = np.array(given).reshape(4, 2)
        return np.asarray(offsets - offsets.mean(axis=0))
    if rms_px == 0.0:
        return None
    drawn -= drawn.mean(axis=0)
    return np.asarray(drawn * (rms_px / np.sqrt(np.mean(drawn**2))))


_PATTERN_ORDER = 3
"""Highest degree of the polynomials by which a mode's shape is wrong."""


class ShapeErrors:
    """Errors of the modes' shapes that no registration explains, each mode's own.

    A mode is multiplied by one plus a random polynomial over the mirror. The polynomial is scaled
    so that the gradient of the error has the given RMS over that of the mode: that is about the
    share of a column of the interaction matrix that the model of the mode does not explain. The
    errors stay on the mirror when its image moves.
    """

    def __init__(
        self, lit: NDArray[np.bool_], n_modes: int, model_error: float, rng: np.random.Generator
    ) -> None:
        """Take which points of the pupil's grid ``(n, n)`` are lit: shapes are known there."""
        self._model_error = model_error
        powers = [(i, k - i) for k in range(1, _PATTERN_ORDER + 1) for i in range(k + 1)]
        self._powers = np.array(powers)
        self._weights = rng.standard_normal((len(powers), n_modes))
        place = np.full(lit.shape, -1)
        place[lit] = np.arange(lit.sum())
        self._steps = np.concatenate(
            [
                np.column_stack([first.ravel(), second.ravel()])
                for first, second in ((place[:, :-1], place[:, 1:]), (place[:-1], place[1:]))
            ]
        )
        self._steps = self._steps[(self._steps >= 0).all(axis=1)]

    def add_errors(self, shapes: Array32, on_mirror: Array) -> Array32:
        """Return shapes ``(n_points, n_modes)`` with these errors.

        ``on_mirror`` ``(n_points, 2)`` are the points where the shapes are seen, on the mirror.
        """
        if self._model_error == 0.0:
            return shapes
        at = on_mirror / np.abs(on_mirror).max()
        terms = np.prod(at[:, None, :] ** self._powers, axis=2)
        # A constant would be a gain of the mode, which is no error of its shape.
        terms -= terms.mean(axis=0)
        errors = shapes * (terms @ self._weights).astype(np.float32)
        scale = self._model_error * self._roughness(shapes) / self._roughness(errors)
        return np.asarray(shapes + errors * scale.astype(np.float32))

    def _roughness(self, shapes: Array32) -> Array:
        """Return the RMS step of each shape between neighbouring points, ``(n_modes,)``."""
        first, second = self._steps.T
        steps = (shapes[first] - shapes[second]).astype(np.float64)
        return np.asarray(np.sqrt(np.mean(steps**2, axis=0)))


def distort_points(points: Array, weights: Array, imperfections: Imperfections) -> Array:
    """Return where in the pupil the light at these points of its image comes from.

    ``points`` is ``(n_points, 2)``. What a shift, a turn or a change of size could describe is
    taken out, weighted by area: that part would be a registration, and the true α another one.
    The outline keeps its place.
    """
    if imperfections.distortion_subap == 0.0 and imperfections.anamorphosis == 0.0:
        return points
    radius = np.hypot(*points.T)
    cubic = imperfections.distortion_subap * (radius / radius.max()) ** 2 / radius.max()
    moved = points * cubic[:, None] + points * [
        imperfections.anamorphosis,
        -imperfections.anamorphosis,
    ]
    place, error = points @ [1.0, 1.0j], moved @ [1.0, 1.0j]
    root = np.sqrt(weights)
    similarity = np.column_stack([np.ones_like(place), place])
    fit, *_ = np.linalg.lstsq(similarity * root[:, None], error * root, rcond=None)
    error -= similarity @ fit
    return np.asarray(points + np.column_stack([error.real, error.imag]))


def true_sensor(instrument: Instrument, imperfections: Imperfections) -> SensorDescription:
    """Return the sensor as it really is: with another modulation, where it has one."""
    wfs = instrument.wfs
    key = kind_of(instrument).find_fitted_key(wfs)
    if key is None:
        return wfs
    return replace(wfs, **{key: getattr(wfs, key) * (1.0 + imperfections.modulation_error)})


def non_common_path(
    points: Array, weights: Array, imperfections: Imperfections, rng: np.random.Generator
) -> Array32:
    """Return the static wavefront of the sensor's own optics, ``(n_points,)`` metres.

    One Zernike polynomial, or focus to fourth order, random, weaker as the order rises.
    """
    if imperfections.ncpa_zernike:
        shape = zernike(points / np.abs(points).max(), imperfections.ncpa_zernike)
        shape -= weights @ shape
        rms = np.sqrt(weights @ shape**2)
        return np.asarray(shape * imperfections.ncpa_nm * 1e-9 / rms, dtype=np.float32)
    shapes = low_orders(points, weights, _NCPA_ORDER)
    strength = rng.standard_normal(shapes.shape[1]) / np.arange(1, shapes.shape[1] + 1)
    strength[:_NCPA_FIRST_SHAPE] = 0.0
    strength *= imperfections.ncpa_nm * 1e-9 / np.linalg.norm(strength)
    return np.asarray(shapes @ strength, dtype=np.float32)


def zernike(points: Array, number: int) -> Array:
    """Return the polynomial of Noll's ``number`` at ``points`` ``(n_points, 2)`` of the unit disc.

    Noll 1976 (JOSA 66, 207), equations 1 and 2; RMS 1 over the full disc.
    """
    order = (math.isqrt(8 * number - 7) - 1) // 2
    place = number - order * (order + 1) // 2 - 1
    azimuthal = order % 2 + 2 * ((place + (order + 1) % 2) // 2)
    radius, angle = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    above, below = (order + azimuthal) // 2, (order - azimuthal) // 2
    factorial = math.factorial
    shape = sum(
        (-1.0) ** k
        * (factorial(order - k) // (factorial(k) * factorial(above - k) * factorial(below - k)))
        * radius ** (order - 2 * k)
        for k in range(below + 1)
    ) * np.sqrt(order + 1.0)
    if azimuthal:
        turned = np.sin if number % 2 else np.cos
        shape = shape * np.sqrt(2.0) * turned(azimuthal * angle)
    return np.asarray(shape)


TIP, TILT, FOCUS = 1, 2, 3
"""Columns of ``low_orders``: rising along +x, rising along +y, concave."""


def low_orders(points: Array, weights: Array, order: int) -> Array:
    """Return polynomials up to ``order`` at the points, ``(n_points, n_shapes)``.

    Piston first, then the tilt along x, the tilt along y, focus and the rest, made orthonormal
    over the area ``weights`` in that order: what Zernike's are on a full disc, on any outline.
    """
    x, y = points.T / np.abs(points).max()
    columns = [np.ones_like(x), x, y]
    for degree in range(2, order + 1):
        monomials = [x ** (degree - k) * y**k for k in range(degree + 1)]
        columns += [x**2 + y**2, *monomials[:2]] if degree == 2 else monomials
    root = np.sqrt(weights)[:, None]
    factor, triangle = np.linalg.qr(np.column_stack(columns) * root)
    # QR leaves the signs open: with these each shape rises as its polynomial does.
    return np.asarray(factor * np.sign(np.diag(triangle)) / root)
