"""Find the four pupil images of a pyramid in a picture of its camera.

The picture is a mean frame, or a mask of illuminated pixels. Each image is taken as a disc: its
edge is where the light falls to half of that just inside, its central hole is where the light rises
to half. Shadows of a spider and uneven light change neither.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import MatrixError

Array = NDArray[np.float64]

_DARK_SHARE = 0.05
"""Light between two images, relative to the brightest line of the picture."""

_HALF = 0.5
"""Relative light at the edge of a pupil image."""

_N_RAYS = 180
"""Rays along which the edge of an image is looked for."""

_RAY_STEP_PX = 0.25

_OUTLIER_PX = 1.5
"""Distance of a ray's edge from the fitted circle beyond which the ray is left out, pixels: a vane
or a bright spot is there."""

_SMALLEST_PX = 4.0
"""Smallest accepted diameter of an image and of its hole, pixels."""

_SAME_SIZE = 0.1
"""Largest relative difference between the diameters of the four images."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PupilImages:
    """Position and size of the four pupil images on the detector."""

    centres_px: Array
    """``(4, 2)`` row and column: upper left, upper right, lower left, lower right as stored."""

    diameter_px: float
    """Mean diameter of the four."""

    hole_px: float
    """Mean diameter of the central hole; 0 where there is none."""

    @property
    def obscuration_ratio(self) -> float:
        """Diameter of the hole over that of the image."""
        return self.hole_px / self.diameter_px


def find_pupil_images(light_map: NDArray[Any], where: str) -> PupilImages:
    """Return the four pupil images of a picture ``(ny, nx)``.

    Raises
    ------
    MatrixError
        If the picture does not show four discs of one size, one in each quadrant.
    """
    light = np.nan_to_num(np.asarray(light_map, dtype=np.float64))
    if light.ndim != 2 or min(light.shape) < 4 * _SMALLEST_PX:
        raise MatrixError(f"{where}: found shape {light.shape}, expected a frame of a camera")
    # The darkest pixels show the background: bias and stray light.
    light = light - np.percentile(light, 2)
    row, column = _dark_line(light.sum(axis=1)), _dark_line(light.sum(axis=0))
    centres, diameters, holes = [], [], []
    for rows in (slice(0, row), slice(row, None)):
        for columns in (slice(0, column), slice(column, None)):
            found = _disc(light[rows, columns])
            if found is None:
                raise MatrixError(
                    f"{where}: found no disc of light in rows {rows.start} to "
                    f"{rows.stop or len(light)}, columns {columns.start} to "
                    f"{columns.stop or light.shape[1]}; expected the four pupil images of a "
                    "pyramid"
                )
            y, x, diameter, hole = found
            centres.append((y + rows.start, x + columns.start))
            diameters.append(diameter)
            holes.append(hole)
    if np.ptp(diameters) > _SAME_SIZE * np.mean(diameters):
        sizes = ", ".join(f"{size:.1f}" for size in diameters)
        raise MatrixError(
            f"{where}: found discs of {sizes} pixels, expected four pupil images of one size"
        )
    return PupilImages(
        centres_px=np.array(centres),
        diameter_px=float(np.mean(diameters)),
        # a hole must show in most of the images: one alone is a dead spot
        hole_px=float(np.median(holes)),
    )


def _dark_line(profile: Array) -> int:
    """Return the line that parts the images: the middle of the dark ones, or the darkest."""
    n = len(profile)
    quarter = n // 4
    middle = profile[quarter : n - quarter]
    dark = middle - middle.min() <= _DARK_SHARE * max(np.ptp(profile), 1e-300)
    labels, _ = scipy.ndimage.label(dark)
    run = np.flatnonzero(labels == labels[int(np.argmin(middle))])
    return quarter + round(float(run.mean()))


def _disc(light: Array) -> tuple[float, float, float, float] | None:
    """Return row, column, diameter of the disc and of its hole; None if there is no disc."""
    # The 98th percentile and not the maximum, which may be a hot pixel.
    bright = light[light > np.percentile(light, 98) / 3]
    if not bright.size or bright.max() <= 0.0:
        return None
    typical = float(np.median(bright))
    places = np.argwhere(light > _HALF * typical)
    if len(places) < _SMALLEST_PX**2 / 2:
        return None
    # the middle of the extent: the mean would follow uneven light
    low, high = np.percentile(places, 1, axis=0), np.percentile(places, 99, axis=0)
    centre = (low + high) / 2.0
    radius = float(np.mean(high - low)) / 2.0
    for _ in range(3):
        edges = _edges(light, centre, radius, typical)
        circle = _circle(edges)
        if circle is None:
            return None
        centre, radius = circle
    if 2.0 * radius < _SMALLEST_PX:
        return None
    hole = _hole_radius(light, centre, radius)
    return float(centre[0]), float(centre[1]), 2.0 * radius, 2.0 * hole


def _edges(light: Array, centre: Array, radius: float, typical: float) -> Array:
    """Return the outermost points ``(n, 2)`` of each ray at which the light falls to half."""
    distances = np.arange(0.0, 1.5 * radius + 2.0, _RAY_STEP_PX)
    directions, rays = _rays(light, centre, distances)
    inside = (distances > 0.6 * radius) & (distances < 0.95 * radius)
    plateaus, edges = np.median(rays[:, inside], axis=1), []
    for direction, ray, plateau in zip(directions, rays, plateaus, strict=True):
        if plateau < _HALF * typical:
            continue  # this ray lies in the shadow of a vane
        lit = np.flatnonzero(ray > _HALF * plateau)
        k = int(lit[-1])
        if k + 1 >= len(ray):
            continue
        share = (ray[k] - _HALF * plateau) / (ray[k] - ray[k + 1])
        edges.append(centre + direction * (distances[k] + share * _RAY_STEP_PX))
    return np.array(edges).reshape(-1, 2)


def _rays(light: Array, centre: Array, distances: Array) -> tuple[Array, Array]:
    """Return directions ``(n_rays, 2)`` around a centre, and the light along each of them."""
    angles = 2.0 * np.pi * np.arange(_N_RAYS) / _N_RAYS
    directions = np.column_stack([np.sin(angles), np.cos(angles)])
    points = centre[:, None, None] + directions.T[:, :, None] * distances
    return directions, scipy.ndimage.map_coordinates(light, points, order=1, cval=0.0)


def _circle(edges: Array) -> tuple[Array, float] | None:
    """Return centre and radius of the circle through most of the points."""
    kept = edges
    for _ in range(4):
        if len(kept) < 8:
            return None
        terms = np.column_stack([2.0 * kept, np.ones(len(kept))])
        (y, x, rest), *_ = np.linalg.lstsq(terms, np.square(kept).sum(axis=1), rcond=None)
        centre, squared = np.array([y, x]), rest + y * y + x * x
        if squared <= 0.0:
            return None
        radius = float(np.sqrt(squared))
        away = np.abs(np.hypot(*(edges - centre).T) - radius)
        # At least half of the points stay, however bad the first circle is.
        kept = edges[away < max(_OUTLIER_PX, float(np.median(away)))]
    return centre, radius


def _hole_radius(light: Array, centre: Array, radius: float) -> float:
    """Return the radius at which the light around the centre rises to half; 0 without a hole."""
    distances = np.arange(0.0, 0.8 * radius, _RAY_STEP_PX)
    # The median over all rays ignores the arms of a spider.
    profile = np.median(_rays(light, centre, distances)[1], axis=0)
    plateau = float(np.median(profile[distances > 0.5 * radius]))
    dark = profile < _HALF * plateau
    if not dark[: max(int(_SMALLEST_PX / 2.0 / _RAY_STEP_PX), 1)].all():
        return 0.0
    return float(distances[int(np.argmin(dark))]) if not dark.all() else 0.0
