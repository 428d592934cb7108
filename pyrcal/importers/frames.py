"""Recognise camera frames of a pyramid, and describe them for the instrument file.

A response may be recorded as the change of every camera pixel instead of as slopes. Such a cube is
imported unchanged: the pupil images are located in the light, and the fit computes slopes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.importers.imported import Array, Signals, in_arrays_file
from pyrcal.importers.layouts import is_listed_twice
from service.errors import MatrixError
from service.model.pupil_images import PupilImages, find_pupil_images

SUBAPERTURES_PER_ACTUATOR = 2.0
"""Smallest number of subapertures per actuator along a diameter. Pixels are binned to no fewer, so
that the finest influence functions stay sampled while the model stays small."""

MARGIN_SUBAP = 1.0
"""Width by which the grid of subapertures exceeds the pupil image."""

MEAN_FRAME = "the mean frame"

LIT_SHARE = 0.5
"""Smallest light in a valid subaperture, relative to the median lit one."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frames:
    """A response recorded as camera frames."""

    cube: Array
    """``(n_modes, ny, nx)`` change of each pixel per unit of command."""

    light: Array
    """``(ny, nx)`` mean frame, or the mask of lit pixels where no frame was recorded."""

    light_name: str
    """Source of ``light``, for messages."""

    @property
    def has_mean_frame(self) -> bool:
        """True if the light was recorded in the counts of the frames."""
        return self.light_name == MEAN_FRAME


def frames_of(matrix: Array, light: Array | None, valid: Array | None) -> Frames | None:
    """Return a response as frames, or None if its shape is that of slopes.

    Parameters
    ----------
    matrix
        ``(n_modes, ny, nx)``, ``(ny, nx, n_modes)``, ``(ny * nx, n_modes)``, or one row for each
        lit pixel of ``valid``; the last two also transposed. Without light and mask, rows for all
        pixels are recognised if the detector is square.
    light
        ``(ny, nx)`` mean frame of the camera; None if none was recorded.
    valid
        Mask of lit pixels ``(ny, nx)``, or of valid subapertures; None if there is none.
    """
    light_map = light if light is not None else valid
    name = MEAN_FRAME if light is not None else "the mask of lit pixels"
    if light_map is not None and light_map.ndim == 2:
        cube = _cube_of(matrix, light_map, valid)
        light_map = np.asarray(light_map, np.float64)
        return None if cube is None else Frames(cube=cube, light=light_map, light_name=name)
    if matrix.ndim == 2 and valid is None:
        matrix = _unfold_frames(matrix)
    if matrix.ndim != 3:
        return None
    # Only lit pixels respond, so the response itself shows where the pupil images are.
    cube = np.moveaxis(matrix, -1, 0) if matrix.shape[0] == matrix.shape[1] else matrix
    strength = np.sqrt(np.mean(np.square(np.nan_to_num(cube, copy=True)), axis=0, dtype=float))
    return Frames(cube=cube, light=strength, light_name="the strength of the response")


def _cube_of(matrix: Array, light_map: Array, valid: Array | None) -> Array | None:
    """Return a response as frames of the shape of the light; None if its shape is another."""
    if matrix.ndim == 3:
        if matrix.shape[1:] == light_map.shape:
            return matrix
        return np.moveaxis(matrix, -1, 0) if matrix.shape[:2] == light_map.shape else None
    if matrix.ndim != 2:
        return None
    if light_map.size in matrix.shape:
        flat = matrix if matrix.shape[0] == light_map.size else matrix.T
        return np.ascontiguousarray(flat.T).reshape(-1, *light_map.shape)
    if valid is None or not np.isin(valid, (0, 1)).all():
        return None
    lit = valid.astype(bool)
    # A mask that lists its subapertures twice is one for Sx and Sy: the rows are slopes. Twice as
    # many rows are slopes as well, although there may be as many modes as subapertures.
    if lit.sum() not in matrix.shape or is_listed_twice(lit) or 2 * lit.sum() in matrix.shape:
        return None
    flat = matrix if matrix.shape[0] == lit.sum() else matrix.T
    cube = np.zeros((flat.shape[1], *lit.shape), dtype=matrix.dtype)
    cube[:, lit] = flat.T
    return cube


def _unfold_frames(matrix: Array) -> Array:
    """Return rows for all pixels of a square detector as frames; others unchanged."""
    n_pixels = max(matrix.shape)
    side = math.isqrt(n_pixels)
    if side**2 != n_pixels or min(matrix.shape) == n_pixels:
        return matrix
    by_mode = matrix if matrix.shape[1] == n_pixels else matrix.T
    return np.ascontiguousarray(by_mode).reshape(-1, side, side)


def describe_frames(
    frames: Frames,
    n_actuators: int,
    pixels_per_subaperture: int | None,
    where: str,
    notes: list[str],
) -> Signals:
    """Return the sensor's part of an import, with what the images in the light show.

    Raises
    ------
    MatrixError
        If the light does not show four pupil images.
    """
    images = find_pupil_images(frames.light, f"{where}: {frames.light_name}")
    pixels = pixels_per_subaperture or _choose_binning(images, n_actuators)
    n = _grid(images, pixels, frames.light.shape)
    notes.append(describe_images(frames, images))
    notes.append(f"{pixels} x {pixels} pixels are one subaperture; --pixels-per-subap changes that")
    valid = _valid(frames.light, images, n, pixels)
    return Signals(
        table={
            "n_subapertures": n,
            **describe_windows(images, pixels),
            "valid_subapertures": in_arrays_file("valid_subapertures"),
        },
        arrays={
            "interaction_matrix": frames.cube,
            "flux_frame": frames.light,
            "valid_subapertures": valid.astype(np.uint8),
        },
        obscuration_ratio=images.obscuration_ratio,
        columns=0,
        has_mean_frame=frames.has_mean_frame,
    )


def describe_images(frames: Frames, images: PupilImages) -> str:
    """Return a sentence on the positions of the pupil images."""
    centres = ", ".join(f"[{row:.2f}, {column:.2f}]" for row, column in images.centres_px)
    return (
        f"matrix: camera frames of {frames.cube.shape[1]} x {frames.cube.shape[2]} pixels; pupil "
        f"images {images.diameter_px:.1f} pixels wide with a hole of {images.hole_px:.1f}, centred "
        f"at (row, column) {centres}, found in {frames.light_name}"
    )


def describe_windows(images: PupilImages, pixels: int) -> dict[str, Any]:
    """Return the keys of ``[wfs]`` that say where the subapertures are on the frames."""
    return {
        "pupil_diameter_subap": round(images.diameter_px / pixels, 3),
        "input": "frames",
        "pixels_per_subaperture": pixels,
        "pupil_centres_px": np.round(images.centres_px, 3).tolist(),
    }


def _choose_binning(images: PupilImages, n_actuators: int) -> int:
    # The actuators across a round mirror of so many.
    across = math.sqrt(4.0 * n_actuators / math.pi)
    return max(1, int(images.diameter_px / (SUBAPERTURES_PER_ACTUATOR * across)))


def _grid(images: PupilImages, pixels: int, shape: tuple[int, ...]) -> int:
    """Return the number of subapertures across: around an image, and within the frame."""
    to_edge = min(
        float(np.min(images.centres_px + 0.5)),
        float(np.min(np.array(shape) - 0.5 - images.centres_px)),
    )
    return min(math.ceil(images.diameter_px / pixels + MARGIN_SUBAP), int(2.0 * to_edge / pixels))


def _valid(light: Array, images: PupilImages, n: int, pixels: int) -> NDArray[np.bool_]:
    """Return the subapertures that are lit, by the mean of the four images, ``(n, n)``."""
    offsets = np.arange(n * pixels) - (n * pixels - 1) / 2.0
    total = np.zeros((n, n))
    for row, column in images.centres_px:
        # Windows that are rounded to pixels may reach beyond the frame by one.
        rows = np.clip(np.rint(row + offsets).astype(int), 0, light.shape[0] - 1)
        columns = np.clip(np.rint(column + offsets).astype(int), 0, light.shape[1] - 1)
        total += light[np.ix_(rows, columns)].reshape(n, pixels, n, pixels).mean(axis=(1, 3))
    # The background of the camera must not count as light.
    total -= np.percentile(total, 1)
    places = (np.arange(n) - (n - 1) / 2.0) * pixels
    radius = np.hypot(*np.meshgrid(places, places))
    # Away from both edges, where subapertures are lit in part.
    inside = (radius < 0.45 * images.diameter_px) & (radius > 0.55 * images.hole_px)
    valid = total > LIT_SHARE * float(np.median(total[inside]))
    if not valid.any():
        raise MatrixError("flux: found no lit subaperture, expected some")
    return np.asarray(valid & (radius < 0.5 * images.diameter_px + pixels))
