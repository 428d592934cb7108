"""Recognise the FFT grid of a bench that is simulated, by the width of its maps.

A simulated pupil has a whole number of points in each subaperture, which is one pixel, and its
influence functions have the same points.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pyrcal.importers.imported import Array, Imported
from pyrcal.importers.oopao import PYRAMID, find_image_centres
from service.errors import MatrixError
from service.files.container import DATASET
from service.model.pupil_images import find_pupil_images

_POINTS = range(2, 9)
"""Points along a subaperture of a simulation; finer maps say nothing of the model's grid."""

_USUAL_SEPARATION = 1.2
"""Default distance of neighbouring pupil images over their diameter, as in the instrument file. The
grid of OOPAO is twice as wide."""

_MAX_WIDTH_RATIO = 0.12
"""Largest relative difference of the pupil's width from that of its images as they respond. Without
modulation light between the images responds, so that an image of 36 pixels seems 39 wide."""

_SEEMING_PX = 0.6
"""Error by which unmodulated images seem too close together, and half of it for others."""

_CENTRED_PX = 0.25
"""Largest distance of the images' common middle from that of a simulated frame, pixels."""


def find_fft_grid(
    imported: Imported, options: argparse.Namespace, *, certain: bool = False
) -> Imported | None:
    """Return the bench as one that was simulated with an FFT; None if its files exclude that.

    A fit can decide between both. Where there is none, ``certain`` excludes frames whose images are
    not around the very middle, as those of a camera hardly ever are: with the grid a pupil image
    has another width. Slopes of a real bench differ by a few per cent on the grid.
    """
    wfs, arrays = imported.tables["wfs"], imported.arrays
    names = ("influence_functions", "mode_shapes", "pupil")
    side = next((arrays[name].shape[-1] for name in names if name in arrays), 0)
    one_pixel = options.pixels_per_subap in {None, 1}
    if not side or wfs.get("kind") != PYRAMID or "fft_grid" in wfs or not one_pixel:
        return None
    notes = list(imported.notes)
    if arrays[DATASET].ndim == 3:
        keys = _describe_frames(arrays[DATASET], side, options.pupil_subap, certain, notes)
    else:
        keys = _describe_slopes(wfs, side)
    if not keys:
        return None
    n = keys["n_subapertures"]
    keys["fft_grid"]["points_per_subaperture"] = side // n
    notes.append(
        f"the bench may be simulated, because maps of {side} points have {side // n} in each of "
        f"{n} subapertures, and the pupil is taken as that wide; if it is not, remove fft_grid "
        "from [wfs] and check pupil_diameter_subap"
    )
    tables = {**imported.tables, "wfs": {**wfs, **keys}}
    # Windows between pixels would mix the points of a simulation.
    return replace(imported, tables=tables, notes=tuple(notes), centres_found=False)


def centre_images(simulated: Imported) -> Imported | None:
    """Return a simulation of frames with its pupil images in OOPAO's own quadrants.

    A rooftop or an aberration darkens images so that they seem elsewhere. None if there are no
    frames, or if the images are in these places already.
    """
    wfs = simulated.tables["wfs"]
    if "pupil_centres_px" not in wfs:
        return None
    found, width = np.reshape(wfs["pupil_centres_px"], (2, 2, 2)), wfs["fft_grid"]["width_subap"]
    # One image that seems elsewhere does not move the median of four distances, and light between
    # the images makes them seem closer.
    apart = np.median([*(found[1] - found[0])[:, 0], *(found[:, 1] - found[:, 0])[:, 1]])
    odd = (int(width) - wfs["n_subapertures"]) % 2
    separation = 2 * math.ceil((apart - odd) / 2.0) + odd
    ends = [(width - 1.0 + side * separation) / 2.0 for side in (-1, 1)]
    centres = [[row, column] for row in ends for column in ends]
    if centres == wfs["pupil_centres_px"]:
        return None
    places = {"pupil_centres_px": centres, "pupil_separation_subap": separation}
    return replace(simulated, tables={**simulated.tables, "wfs": {**wfs, **places}})


def _describe_slopes(wfs: Mapping[str, Any], side: int) -> dict[str, Any]:
    """Return the keys of ``[wfs]`` of a simulation that gave slopes; empty if it cannot be one."""
    n = wfs["n_subapertures"]
    if side % n or side // n not in _POINTS or wfs.get("pupil_diameter_subap", n) != n:
        return {}
    apart = wfs.get("pupil_separation_subap", _USUAL_SEPARATION * n)
    return {"n_subapertures": n, "fft_grid": {"width_subap": 2.0 * math.ceil(apart)}}


def _describe_frames(
    frames: Array, side: int, across: float | None, certain: bool, notes: list[str]
) -> dict[str, Any]:
    """Return the keys of ``[wfs]`` of a simulation of frames; empty if it cannot be one."""
    # Not in the light: without modulation it is between the images as well, and on their inner
    # edges, so that they seem 2.7 pixels closer to the middle; the response shows them to 0.6.
    strength = np.sqrt(np.mean(np.square(frames, dtype=float), axis=0))
    try:
        images = find_pupil_images(strength, DATASET)
    except MatrixError:
        return {}
    width, seen = frames.shape[-1], images.diameter_px
    tolerance = 0.0 if across else _MAX_WIDTH_RATIO
    counts = [
        n
        for n in range(2, side + 1)
        if side % n == 0 and abs(n / (across or seen) - 1.0) <= tolerance
    ]
    off = np.abs(images.centres_px.mean(axis=0) - (width - 1) / 2.0).max()
    if len(counts) != 1 or frames.shape[1] != width or (certain and off > _CENTRED_PX):
        return {}
    n = counts[0]
    # Windows of whole pixels: their distance is even if the width of the detector less that of the
    # pupil is.
    # The mean of both pairs: the outermost of displaced images are further apart than their square.
    ordered = np.sort(images.centres_px, axis=0)
    apart = float(np.mean(ordered[2:] - ordered[:2])) + _SEEMING_PX
    odd = (width - n) % 2
    sensor = {"pupil_separation_subap": 2 * round((apart - odd) / 2) + odd}
    return {
        "n_subapertures": n,
        "pixels_per_subaperture": 1,
        "pupil_diameter_subap": float(n),
        **sensor,
        "pupil_centres_px": find_image_centres(frames, sensor, notes),
        "valid_subapertures": "auto",
        "fft_grid": {"width_subap": float(width)},
    }
