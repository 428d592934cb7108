"""The light of the beam as the four images show it, made the model's pupil amplitude.

Slopes weigh by the light of their subaperture (global normalisation), so an unevenness of 20 % is
20 % of a slope: larger than everything a registration does to the matrix. The paper names the
measured illumination as its next step.

The pattern belongs to the beam, that is to the pupil's images: with the mirror as stop it moves
with them, and the map is kept relative to where they lay when the light was counted. With a fixed
telescope stop it stays on the sensor.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.fit.flux import PupilPosition, even_images, even_optics, mended
from service.model.instrument import Instrument
from service.model.pupil import Illumination

Array = NDArray[np.float64]

_LIT = 0.5
"""Share of a full subaperture's light from which one tells how evenly the beam is lit."""

_SMOOTHING_SUBAP = 1.0
"""Of the map: a subaperture cannot tell what is finer than itself, and diffraction ripples."""

_SPREAD_SUBAP = 1.0
_MARGIN = 4
"""Subapertures around the sensor's grid: the pupil may have moved when the map is used."""


def measured_illumination(
    counts: NDArray[Any], instrument: Instrument, position: PupilPosition
) -> Illumination:
    """Return how evenly the beam is lit, from the mean counts ``(4, n, n)``.

    Each image is divided by that of an even beam at the same place, diffraction included; the
    median of the four is robust to bad pixels and, to first order, to static aberrations, which
    move light from one image to another. Its mean over the pupil is 1. Nothing is deconvolved:
    scattered light hides a tenth of the unevenness, but undoing that also amplifies what the
    aberrations left.

    Raises
    ------
    ModelError
        If the counts are not four images of the instrument's size, or dark.
    """
    images, _ = mended(counts, instrument)
    if not images.mean() > 0.0:
        raise ModelError("illumination: found no light; expected the mean counts of the images")
    shown = even_images(even_optics(instrument), (position.x_subap, position.y_subap))
    lit = shown.sum(axis=0) > _LIT * np.percentile(shown.sum(axis=0), 75.0)
    return _beam(_filled(_excess(images, shown, lit), lit), position)


def relative_light(
    counts: NDArray[Any], instrument: Instrument, position: PupilPosition
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the light over that of an even beam, ``(n, n)`` on the sensor, and where it is known.

    Not smoothed: what is sharp in it, a spider's shadow, tells the rotation.

    Raises
    ------
    ModelError
        If the counts are not four images of the instrument's size.
    """
    images, _ = mended(counts, instrument)
    even = even_images(even_optics(instrument), (position.x_subap, position.y_subap)).sum(axis=0)
    lit = even > _LIT * np.percentile(even, 75.0)
    share = images.sum(axis=0) / np.where(lit, even, 1.0)
    return np.where(lit, share / share[lit].mean(), 1.0), lit


def _excess(images: Array, shown: Array, lit: NDArray[np.bool_]) -> Array:
    """Return how much more light there is than shown ``(n, n)``, mean 1 where lit."""
    ratio = images / images.mean(axis=(1, 2), keepdims=True) / np.where(lit, shown, 1.0)
    excess = np.where(lit, np.median(ratio, axis=0), 0.0)
    return np.asarray(excess / excess[lit].mean())


def _filled(share: Array, lit: NDArray[np.bool_]) -> Array:
    """Return the map, smoothed, with what lies outside the pupil continued from inside.

    Normalised convolution, ever wider until everything is reached.
    """
    padded = np.pad(np.where(lit, share, 0.0), _MARGIN)
    known = np.pad(lit.astype(np.float64), _MARGIN)
    width = _SMOOTHING_SUBAP
    weight = scipy.ndimage.gaussian_filter(known, width, mode="constant")
    filled = scipy.ndimage.gaussian_filter(padded, width, mode="constant") / np.maximum(
        weight, 1e-12
    )
    reached = known > 0.0
    width = _SPREAD_SUBAP
    while not reached.all():
        weight = scipy.ndimage.gaussian_filter(known, width, mode="constant")
        wider = scipy.ndimage.gaussian_filter(padded, width, mode="constant") / np.maximum(
            weight, 1e-12
        )
        new = ~reached & (weight > 1e-3)
        filled = np.where(new, wider, filled)
        reached = reached | new
        width *= 2.0
    return np.asarray(filled)


def _beam(smooth: Array, position: PupilPosition) -> Illumination:
    """Return the map with the beam's centre in its middle."""
    rows, columns = np.indices(smooth.shape, dtype=np.float64)
    places = [rows + position.y_subap, columns + position.x_subap]
    centred = scipy.ndimage.map_coordinates(smooth, places, order=3, mode="nearest")
    coordinates = np.arange(len(centred), dtype=np.float64) - (len(centred) - 1) / 2
    return Illumination(coordinates=coordinates, intensity=np.maximum(centred, 0.0))
