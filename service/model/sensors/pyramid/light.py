"""Find the pupil images in their mean light, and measure the illumination inside them.

With the mirror as stop the outline and the obscuration move with the shift, so their edges give a
start for a fit before any matrix is measured. The light inside the outline may be uneven: it is
modelled as a smooth surface times the image of an even beam, diffraction included, and only the
edges determine the position.

Slopes weigh by the light of their subaperture (global normalisation), so an unevenness of 20 % is
20 % of a slope: larger than the effect of any misregistration on the matrix. Heritier et al. 2018
(section 4.4) suggest putting the measured illumination into the model. The pattern belongs to the
beam, that is to the pupil's images: with the mirror as stop it moves with them, and the map is kept
relative to their position when the light was measured. With a fixed telescope stop it stays on the
sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument
from service.model.pupil import Illumination, instrument_pupil
from service.model.sensors.pyramid.description import (
    draw_aberration,
    image_offsets,
    oriented_pyramid,
    pyramid_in,
)
from service.model.sensors.pyramid.optics import PyramidOptics, enough_modulation_points
from service.model.sensors.sensor import CannotTell, ImageOffsets, PupilPosition
from service.model.slopes import orient_mask

Array = NDArray[np.float64]

_ORDER = 3
"""Order of the polynomial that models uneven light."""

_FIRST_STEPS = np.arange(-3.0, 3.1, 1.0)
"""Positions tried first on either axis, subapertures."""

_PROBE_SUBAP = 0.05
_LARGEST_STEP_SUBAP = 0.7
_HUBER_SIGMA = 2.0
"""Residuals beyond so many robust σ count less."""

_BAD_SIGMA = 6.0
_BAD_SHARE = 0.25
"""A pixel is bad when it departs from its three companions by so many robust σ and, besides, by
this share of a lit pixel: diffraction and static aberrations make good ones differ."""

_MAX_BAD_SHARE = 0.03
"""Share of an image's pixels: beyond it they are not bad, the image is another one."""

_MAX_RESIDUAL = 0.25
"""RMS residual over mean light from which the map is no image of this pupil."""

_PLACES_RESIDUAL = 0.12
"""The same where each image's own place is read. On AO188, whose light the model does not explain,
a quarter is left and the places are a pixel off; under even light, and under a gradient of 30 %, a
hundredth."""

_LARGEST_SIGMA_SUBAP = 1.0

_PLACES_SAMPLING = 3
"""Pupil points along a subaperture, and nodes, of the model that places are read with."""

_FLUX_SAMPLING = 2
"""The same for the mean flux of a running loop. Two are enough there: on the diffractive simulator
with usual imperfections, 0.05 to 0.3 px, two leave 0.004 to 0.009 px and three up to 0.011."""

_PLACES_STEPS = 6
_PLACES_SETTLED_SUBAP = 1e-3

_FLOOR_SUBAP = 0.02
"""1 σ of what smooth light of any shape moves an edge."""


_OFFSET_FLOOR_SUBAP = 0.005
"""1 σ of a displacement by static aberrations and dead pixels, which differ from image to image,
subapertures; uneven light, common to all images, does not displace them relative to one another."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PyramidLight:
    """The light of four pupil images as a ``Light``."""

    instrument: Instrument

    @property
    def shape(self) -> tuple[int, ...]:
        """Four images."""
        n = self.instrument.wfs.n_subapertures
        return (4, n, n)

    def counts_of(self, flux: bytes) -> Array:
        """Return the counts that a status carries, ``<f4``."""
        side = math.isqrt(len(flux) // 16)
        try:
            return np.frombuffer(flux, "<f4").reshape(4, side, side)
        except ValueError as error:
            raise ModelError(f"flux: {error}") from error

    def counts(self, light: NDArray[Any]) -> NDArray[Any]:
        """Return images ``(2, n, 2, n)`` in row-major order of their place on the detector."""
        return light.transpose(0, 2, 1, 3).reshape(self.shape)

    def orient_counts(self, counts: NDArray[Any]) -> NDArray[Any]:
        """Return counts in the RTC's axes, in those of conventions.md.

        A flip or a swap moves the images among one another, too.
        """
        n = counts.shape[-1]
        detector = counts.reshape(2, 2, n, n).transpose(0, 2, 1, 3).reshape(2 * n, 2 * n)
        turned = orient_mask(detector, self.instrument.slopes.assumed_orientation)
        sides = turned.reshape(2, n, 2, n).transpose(0, 2, 1, 3)
        return np.ascontiguousarray(sides).reshape(4, n, n)

    def find_pupil(self, counts: NDArray[Any]) -> PupilPosition | CannotTell:
        """Return the position of the pupil images in the mean counts ``(4, n, n)``.

        The axes are those of conventions.md, the images in row-major order of their place on the
        detector.

        Raises
        ------
        ModelError
            If the counts are not four images of the instrument's size.
        """
        images, _ = repair_pixels(counts, self.instrument)
        light = float(images.mean())
        if not light > 0.0:
            return CannotTell(reason=f"no light: the mean count is {light:g}; open the shutter")
        images = images / light
        # One point per subaperture is enough for the coarse grid of first positions.
        optics = build_even_optics(self.instrument)
        try:
            start = _first_guess(images, build_even_optics(self.instrument, 1))
            position, steps, formal, residual = _settle_position(images, optics, start)
        except np.linalg.LinAlgError:
            return CannotTell(reason="the light has no edge the position could be read from")
        if residual > _MAX_RESIDUAL:
            return CannotTell(
                reason=f"the light is not that of the instrument's pupil: {residual:.0%} of it "
                f"remain unexplained, expected at most {_MAX_RESIDUAL:.0%}; check the mask, the "
                "pupil diameter and the obscuration"
            )
        # The four images are four independent measurements of one position.
        scatter = steps.std(axis=0, ddof=1) / np.sqrt(len(steps))
        sigma = np.sqrt(scatter**2 + (formal**2).mean(axis=0) / len(steps) + _FLOOR_SUBAP**2)
        if not np.all(sigma < _LARGEST_SIGMA_SUBAP):
            return CannotTell(
                reason=f"the four images disagree by {scatter.max() * 2:.1f} subapertures; "
                "check that each is cut out of the frame at its own place"
            )
        return PupilPosition(at=_pair(position), sigma=_pair(sigma))

    def find_image_offsets(self, counts: NDArray[Any]) -> ImageOffsets | CannotTell:
        """Return the displacement of each pupil image in the mean counts ``(4, n, n)``.

        Displacements stated in the instrument file are not used. Axes and order are those of
        ``find_pupil``. A displacement common to all four images is a shift and is not included.

        Raises
        ------
        ModelError
            If the counts are not four images of the instrument's size.
        """
        wfs = replace(pyramid_in(self.instrument), image_offsets_subap=None)
        on_grid = replace(self.instrument, wfs=wfs)
        pupil = PyramidLight(instrument=on_grid).find_pupil(counts)
        if isinstance(pupil, CannotTell):
            return pupil
        found = _locate_images(counts, on_grid, np.tile(pupil.at, (4, 1)), _FLUX_SAMPLING)
        if isinstance(found, CannotTell):
            return found
        places, formal, _ = found
        sigma = np.hypot(formal, _OFFSET_FLOOR_SUBAP)
        return ImageOffsets(subap=places - places.mean(axis=0), sigma_subap=sigma)

    def illumination(self, counts: NDArray[Any], position: PupilPosition) -> Illumination:
        """Return how evenly the beam is lit, from the mean counts ``(4, n, n)``.

        Each image is divided by that of an even beam at the same place, diffraction included; the
        median of the four is robust to bad pixels and, to first order, to static aberrations, which
        move light from one image to another. Its mean over the pupil is 1. Diffraction scatters
        light from the bright part of the beam into the dark one, so the map is corrected once by
        the images that its own light would make. More corrections would amplify what the
        aberrations left.

        Raises
        ------
        ModelError
            If the counts are not four images of the instrument's size, or dark.
        """
        images, _ = repair_pixels(counts, self.instrument)
        if not images.mean() > 0.0:
            raise ModelError("illumination: found no light; expected the mean counts of the images")
        optics = build_even_optics(self.instrument)
        even = compute_even_images(optics, position.at)
        lit = _lit_part(even)
        share = _excess(images, even, lit)
        beam = _beam(_fill_outside(share, lit), position)
        if not beam.intensity.any():
            return beam
        shown = compute_even_images(replace(optics, pupil=optics.pupil.lit_by(beam)), position.at)
        return _beam(_fill_outside(share * _excess(images, shown, lit), lit), position)

    def relative(
        self, counts: NDArray[Any], position: PupilPosition
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return the light relative to an even beam, ``(n, n)`` on the sensor, and the known part.

        The map is not smoothed: sharp structure in it, such as a spider's shadow, determines the
        rotation.

        Raises
        ------
        ModelError
            If the counts are not four images of the instrument's size.
        """
        images, _ = repair_pixels(counts, self.instrument)
        even = compute_even_images(build_even_optics(self.instrument), position.at)
        lit = _lit_part(even)
        share = images.sum(axis=0) / np.where(lit, even.sum(axis=0), 1.0)
        return np.where(lit, share / share[lit].mean(), 1.0), lit


def image_places(counts: NDArray[Any], instrument: Instrument) -> Array | CannotTell:
    """Return each image's displacement from its place on the grid ``(4, 2)``: x, y, subapertures.

    ``counts`` ``(4, n, n)`` are the mean light, cut out so that the images are within half a
    subaperture of their places.

    Raises
    ------
    ModelError
        If the counts are not four images of the instrument's size.
    """
    found = _locate_images(counts, instrument, np.zeros((4, 2)), _PLACES_SAMPLING)
    if isinstance(found, CannotTell):
        return found
    places, _, residual = found
    return places if residual < _PLACES_RESIDUAL else _other_light(residual)


def _locate_images(
    counts: NDArray[Any], instrument: Instrument, start: Array, sampling: int
) -> tuple[Array, Array, float] | CannotTell:
    """Return places ``(4, 2)`` of the images, their formal 1 σ, subapertures, and what is left.

    Every image is compared with that of an even beam, diffraction between the images included,
    under smooth light of its own.
    """
    images, _ = repair_pixels(counts, instrument)
    light = float(images.mean())
    if not light > 0.0:
        return CannotTell(reason=f"no light: the mean count is {light:g}; open the shutter")
    optics, places = build_even_optics(instrument, sampling), start
    try:
        for _ in range(_PLACES_STEPS):
            there = replace(optics, offsets=places.reshape(2, 2, 2))
            steps, formal, residual = _departures(images / light, there, np.zeros(2))
            places = places + np.clip(steps, -_LARGEST_STEP_SUBAP, _LARGEST_STEP_SUBAP)
            if np.abs(steps).max() < _PLACES_SETTLED_SUBAP:
                break
    except np.linalg.LinAlgError:
        return CannotTell(reason="the light has no edge the places could be read from")
    if residual > _MAX_RESIDUAL:
        return _other_light(residual)
    return places, formal, residual


def _other_light(residual: float) -> CannotTell:
    return CannotTell(reason=f"the light is not that of the pupil: {residual:.0%} remain")


def build_even_optics(instrument: Instrument, sampling: int = 2) -> PyramidOptics:
    """Return the sensor with an evenly lit pupil, as finely as light needs it."""
    wfs, pupil = oriented_pyramid(instrument), instrument_pupil(instrument, sampling)
    return PyramidOptics(
        wfs=wfs,
        pupil=pupil,
        n_nodes=sampling,
        n_modulation=enough_modulation_points(wfs),
        offsets=image_offsets(instrument),
        aberration_rad=draw_aberration(instrument, pupil),
    )


def compute_even_images(optics: PyramidOptics, shift: tuple[float, float]) -> Array:
    """Return what an even beam shows ``(4, n, n)``, in the order of the counts."""
    n = optics.wfs.n_subapertures
    return optics.images(shift).transpose(0, 2, 1, 3).reshape(4, n, n)


def repair_pixels(counts: NDArray[Any], instrument: Instrument) -> tuple[Array, NDArray[np.bool_]]:
    """Return the counts ``(4, n, n)`` with bad pixels replaced, and which were bad.

    A pixel is bad when it is no number or far from the median of the same place in all images,
    each scaled to the same light: four images of one pupil see the same unevenness.

    Raises
    ------
    ModelError
        If the counts are not four images of the instrument's size.
    """
    n = instrument.wfs.n_subapertures
    if counts.shape != (4, n, n):
        raise ModelError(f"flux map: found counts {counts.shape}; expected {(4, n, n)}")
    images = np.where(np.isfinite(counts), counts, np.nan).astype(np.float64)
    if np.isnan(images).all():
        return np.zeros_like(images), np.ones(images.shape, dtype=np.bool_)
    # Clipped, so that a hot pixel does not set the scale of its image.
    level = np.nanmean(np.clip(images, 0.0, np.nanpercentile(images, 95.0)), axis=(1, 2))
    level = np.where(level > 0.0, level, 1.0)
    scaled = images / level[:, None, None]
    middle = np.nanmedian(scaled, axis=0)
    difference = scaled - middle
    # 1.4826 makes a median absolute deviation the σ of a normal distribution.
    spread = 1.4826 * np.nanmedian(np.abs(difference))
    lit = np.nanpercentile(middle, 75.0)
    bad = ~(np.abs(difference) <= _BAD_SIGMA * spread + _BAD_SHARE * np.maximum(middle, lit))
    bad &= np.isnan(images) | (bad.mean(axis=(1, 2), keepdims=True) <= _MAX_BAD_SHARE)
    return np.where(bad, np.nan_to_num(middle) * level[:, None, None], images), bad


def _settle_position(
    images: Array, optics: PyramidOptics, position: Array
) -> tuple[Array, Array, Array, float]:
    """Return position, the four images' own departures and their formal σ, and the residual."""
    for _ in range(10):
        steps, formal, residual = _departures(images, optics, position)
        # Limited: the edge is linear over less than a subaperture.
        step = np.clip(steps.mean(axis=0), -_LARGEST_STEP_SUBAP, _LARGEST_STEP_SUBAP)
        position = position + step
        if np.abs(step).max() < 1e-3:
            break
    return position, steps, formal, residual


def _first_guess(images: Array, optics: PyramidOptics) -> Array:
    """Return the best of a coarse grid of positions."""
    # The four images together, because static aberrations move light from one to another.
    total = images.sum(axis=0).ravel()
    surface = _polynomials(images.shape[1], 1)

    def left(x: float, y: float) -> float:
        even = compute_even_images(optics, (x, y)).sum(axis=0).reshape(-1, 1)
        # Ones for the background, which is no light of the pupil.
        columns = np.hstack([surface * even, np.ones_like(even)])
        return float(np.linalg.norm(total - columns @ np.linalg.lstsq(columns, total)[0]))

    tried = [(left(x, y), x, y) for x in _FIRST_STEPS for y in _FIRST_STEPS]
    return np.array(min(tried)[1:])


def _departures(
    images: Array, optics: PyramidOptics, position: Array
) -> tuple[Array, Array, float]:
    """Return displacements of the images from ``position``, their σ and the RMS residual.

    Displacements and σ are ``(4, 2)`` each.
    """

    def shown_at(place: Array) -> Array:
        return compute_even_images(optics, _pair(place))

    even, probes = shown_at(position), _PROBE_SUBAP * np.eye(2)
    rates = [
        (shown_at(position + probe) - shown_at(position - probe)) / (2 * _PROBE_SUBAP)
        for probe in probes
    ]
    surface = _polynomials(images.shape[1], _ORDER)
    found = [
        _departure(image.ravel(), shown.ravel(), [rate[k].ravel() for rate in rates], surface)
        for k, (image, shown) in enumerate(zip(images, even, strict=True))
    ]
    steps, formal, residuals = (np.array(part) for part in zip(*found, strict=True))
    return steps, formal, float(np.sqrt(np.mean(residuals**2)))


def _departure(
    image: Array, even: Array, rates: list[Array], surface: Array
) -> tuple[Array, Array, float]:
    """Fit smooth light, a background and a small movement to one image, robustly.

    The movement's columns need the light itself: it is fitted first without them.
    """
    lit = np.column_stack([surface * even[:, None], np.ones_like(even)])
    weights = np.ones_like(image)
    light = surface @ _weigh(lit, image, weights)[0][:-1]
    for _ in range(5):
        columns = np.column_stack([lit, rates[0] * light, rates[1] * light])
        solution, covariance = _weigh(columns, image, weights)
        left = image - columns @ solution
        # From the median, so that a spider or a dead pixel does not widen its own tolerance.
        scale = max(1.4826 * float(np.median(np.abs(left))), 1e-9)
        weights = np.minimum(1.0, _HUBER_SIGMA * scale / np.maximum(np.abs(left), 1e-12))
        light = surface @ solution[: surface.shape[1]]
    return solution[-2:], scale * np.sqrt(np.diag(covariance)[-2:]), float(left.std())


def _weigh(columns: Array, values: Array, weights: Array) -> tuple[Array, Array]:
    normal = columns.T @ (columns * weights[:, None])
    covariance = np.asarray(np.linalg.inv(normal))
    return covariance @ (columns.T @ (weights * values)), covariance


def _polynomials(n: int, order: int) -> Array:
    """Return monomials up to ``order`` over the grid, ``(n², n_terms)``."""
    u = np.linspace(-1.0, 1.0, n)
    x, y = np.tile(u, n), np.repeat(u, n)
    return np.column_stack([x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)])


def _pair(position: Array) -> tuple[float, float]:
    return float(position[0]), float(position[1])


_LIT_SHARE = 0.5
"""Smallest share of a full subaperture's light at which the illumination of the beam is measured.
"""

_SMOOTHING_SUBAP = 1.0
"""Smoothing of the map, subapertures: finer structure is not resolved, and diffraction ripples."""

_PLANE = ((0, 0), (1, 0), (0, 1))
"""Powers of x and y of a plane."""

_RIDGE = 1e-3
"""Regularisation of the slopes of a plane, for places whose surroundings are hardly known."""

_SPREAD_SUBAP = 1.0
_MARGIN = 4
"""Subapertures around the sensor's grid: the pupil may have moved when the map is used."""


def _lit_part(even: Array) -> NDArray[np.bool_]:
    """Return the pixels ``(n, n)`` that an even beam lights, from its images ``(4, n, n)``."""
    # The 75th percentile is that of full subapertures: those of the rim have less.
    light = even.sum(axis=0)
    return np.asarray(light > _LIT_SHARE * np.percentile(light, 75.0))


def _excess(images: Array, shown: Array, lit: NDArray[np.bool_]) -> Array:
    """Return how much more light there is than shown ``(n, n)``, mean 1 where lit."""
    ratio = images / images.mean(axis=(1, 2), keepdims=True) / np.where(lit, shown, 1.0)
    excess = np.where(lit, np.median(ratio, axis=0), 0.0)
    return np.asarray(excess / excess[lit].mean())


def _fill_outside(share: Array, lit: NDArray[np.bool_]) -> Array:
    """Return the smoothed map, extrapolated from inside the pupil to its outside.

    A plane is fitted to the surroundings of each subaperture inside: a weighted mean would flatten
    the rim of a beam that fades outwards, because only its inner side is known. Planes reach one
    subaperture beyond the rim, which the edge of the pupil may cross. Further outside, the map is a
    weighted mean of these, whose weights widen until everything is reached.
    """
    # With a margin, so that a beam that has moved is known there, too.
    measured = np.pad(lit, _MARGIN)
    known = scipy.ndimage.binary_dilation(measured)
    smooth = _smooth_by_planes(np.pad(np.where(lit, share, 0.0), _MARGIN), measured, known)
    filled, reached, width = smooth, known, _SPREAD_SUBAP
    while not reached.all():
        weight = scipy.ndimage.gaussian_filter(known.astype(np.float64), width, mode="constant")
        light = scipy.ndimage.gaussian_filter(smooth, width, mode="constant")
        new = ~reached & (weight > 1e-3)
        filled = np.where(new, light / np.maximum(weight, 1e-12), filled)
        reached = reached | new
        width *= 2.0
    return np.asarray(filled)


def _smooth_by_planes(
    values: Array, measured: NDArray[np.bool_], known: NDArray[np.bool_]
) -> Array:
    """Return the level, at the known places, of planes fitted to the measured ones; 0 elsewhere."""
    weights = measured.astype(np.float64)
    normal = np.array([[_moment(weights, a, b) for b in _PLANE] for a in _PLANE])
    right = np.array([_moment(values, a, (0, 0)) for a in _PLANE])
    # Relative to the weight around the place; the level itself is not held.
    ridge = normal[0, 0][known][:, None, None] * np.diag([0.0, _RIDGE, _RIDGE])
    planes = normal[:, :, known].transpose(2, 0, 1) + ridge
    level = np.linalg.solve(planes, right[:, known].T[:, :, None])[:, 0, 0]
    smooth = np.zeros_like(values)
    smooth[known] = np.maximum(level, 0.0)
    return smooth


def _moment(values: Array, one: tuple[int, int], other: tuple[int, int]) -> Array:
    """Return the weighted sum of values times powers of x and y around each subaperture."""
    half = int(4.0 * _SMOOTHING_SUBAP + 0.5)
    u = np.arange(-half, half + 1) / _SMOOTHING_SUBAP
    weight = np.exp(-0.5 * u**2) / np.exp(-0.5 * u**2).sum()
    rows = weight * u ** (one[1] + other[1])
    columns = weight * u ** (one[0] + other[0])
    along_y = scipy.ndimage.correlate1d(values, rows, axis=0, mode="constant")
    return np.asarray(scipy.ndimage.correlate1d(along_y, columns, axis=1, mode="constant"))


def _beam(smooth: Array, position: PupilPosition) -> Illumination:
    """Return the map with the beam's centre in its middle."""
    rows, columns = np.indices(smooth.shape, dtype=np.float64)
    places = [rows + position.at[1], columns + position.at[0]]
    centred = scipy.ndimage.map_coordinates(smooth, places, order=3, mode="nearest")
    coordinates = np.arange(len(centred), dtype=np.float64) - (len(centred) - 1) / 2
    return Illumination(coordinates=coordinates, intensity=np.maximum(centred, 0.0))
