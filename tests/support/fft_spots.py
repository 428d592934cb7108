"""A Shack-Hartmann by brute force: fields of lenslets transformed, pixels summed, centroids.

Nothing of the service's: another grid, light counted where it falls, pushed and pulled.
"""

from functools import cache

import numpy as np
from scipy import ndimage

SAMPLES, PADDED = 32, 256
"""Points across a lenslet, and of its transform, of which only the middle is computed."""

FINE = PADDED // SAMPLES
"""Points of the transform across λ/d."""

PUSH_M = 2e-10


def fine_points(n, shift):
    """Return pupil points ``(n, n, SAMPLES, SAMPLES, 2)`` under each lenslet, subapertures."""
    line = (np.arange(n * SAMPLES) + 0.5) / SAMPLES - n / 2
    points = np.stack(np.meshgrid(line - shift[0], line - shift[1]), axis=-1)
    return points.reshape(n, SAMPLES, n, SAMPLES, 2).swapaxes(1, 2)


@cache
def _transform(n_points):
    """Return the matrix ``(n_points, SAMPLES)`` of the padded transform's middle points.

    Most of a padded transform is light that no pixel counts; this is the rest, to rounding.
    """
    # half a step aside: a pixel then holds whole numbers of them, and lies as the field does
    places = np.arange(n_points) - n_points / 2 + 0.5
    return np.exp(-2j * np.pi / PADDED * np.outer(places, np.arange(SAMPLES)))


def spots(field, n_pixels, width=1):
    """Return pixels ``(..., n_pixels, n_pixels)`` of ``width`` λ/d, for fields ``(..., y, x)``."""
    fine = width * FINE
    transform = _transform(n_pixels * fine)
    light = np.abs(transform @ (field @ transform.T)) ** 2
    return light.reshape(*light.shape[:-2], n_pixels, fine, n_pixels, fine).sum((-3, -1))


def centroids(light):
    """Return ``(2, ...)`` in pixels: pixels times their places over pixels; 0 where it is dark."""
    places = np.arange(light.shape[-1]) - (light.shape[-1] - 1) / 2
    total = np.maximum(light.sum((-2, -1)), 1e-12)
    return np.stack([light.sum(-2) @ places, light.sum(-1) @ places]) / total


def sampled(basis, reach):
    """Return ``basis.render`` within ``reach`` subapertures, by splines through a fine grid.

    Sixteen samples per subaperture: slopes differ by less than 1e-4 of their size, and rendering
    hundreds of thousands of points again and again is avoided.
    """
    line = np.arange(-16 * reach, 16 * reach + 1) / 16
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    maps = basis.render(grid).T.reshape(-1, len(line), len(line))
    splines = [ndimage.spline_filter(one) for one in maps]

    def render(points):
        places = 16 * (points.T[::-1] + reach)
        found = [ndimage.map_coordinates(one, places, prefilter=False) for one in splines]
        return np.column_stack(found)

    return render


def pushed(instrument, opd_at, shift, counted, n_pixels=6, width=1):
    """Return slopes ``(2, n, n, n_shapes)`` in λ/d per metre: half the push less half the pull.

    ``opd_at(points)`` are wavefronts ``(n_points, n_shapes)`` at places in the pupil; ``counted``
    makes of a spot of a full lenslet what its pixels count.
    """
    wave = 2j * np.pi / instrument.wfs.wavelength_m
    counts = counted(spots(np.ones((SAMPLES, SAMPLES)), n_pixels, width))
    rows = []
    for points in fine_points(instrument.wfs.n_subapertures, shift):
        radius = np.hypot(points[..., 0], points[..., 1]) / (instrument.wfs.pupil_diameter / 2)
        amplitude = (radius <= 1.0) & (radius >= instrument.obscuration_ratio)
        opd = np.moveaxis(opd_at(points.reshape(-1, 2)).reshape(*radius.shape, -1), -1, 0)
        push, pull = (
            width
            * centroids(counts * spots(amplitude * np.exp(step * wave * opd), n_pixels, width))
            for step in (PUSH_M, -PUSH_M)
        )
        rows.append((push - pull) / (2.0 * PUSH_M))
    return np.moveaxis(np.stack(rows), (0, 1, 2, 3), (1, 0, 3, 2))
