"""A Shack-Hartmann by brute force: fields of lenslets transformed, pixels summed, centroids.

Nothing of the service's: another grid, light counted where it falls, pushed and pulled.
"""

import numpy as np

SAMPLES, PADDED = 32, 256
"""Points across a lenslet, and of its transform."""

FINE = PADDED // SAMPLES
"""Points of the transform across λ/d."""

PUSH_M = 2e-10


def fine_points(n, shift):
    """Return pupil points ``(n, n, SAMPLES, SAMPLES, 2)`` under each lenslet, subapertures."""
    line = (np.arange(n * SAMPLES) + 0.5) / SAMPLES - n / 2
    points = np.stack(np.meshgrid(line - shift[0], line - shift[1]), axis=-1)
    return points.reshape(n, SAMPLES, n, SAMPLES, 2).swapaxes(1, 2)


def spots(field, n_pixels):
    """Return pixels ``(..., n_pixels, n_pixels)``, λ/d wide, of fields ``(..., y, x)``."""
    # half a step aside: a pixel then holds whole numbers of them, and lies as the field does
    aside = np.exp(-1j * np.pi / PADDED * np.arange(SAMPLES))
    seen = np.fft.fft2(field * np.outer(aside, aside), s=(PADDED, PADDED))
    light = np.fft.fftshift(np.abs(seen) ** 2, axes=(-2, -1))
    middle = slice(*(PADDED // 2 + side * n_pixels * FINE // 2 for side in (-1, 1)))
    light = light[..., middle, middle]
    return light.reshape(*light.shape[:-2], n_pixels, FINE, n_pixels, FINE).sum((-3, -1))


def centroids(light):
    """Return ``(2, ...)`` in λ/d: pixels times their places over pixels; 0 where it is dark."""
    places = np.arange(light.shape[-1]) - (light.shape[-1] - 1) / 2
    total = np.maximum(light.sum((-2, -1)), 1e-12)
    return np.stack([light.sum(-2) @ places, light.sum(-1) @ places]) / total


def pushed(instrument, opd_at, shift, counted, n_pixels=6):
    """Return slopes ``(2, n, n, n_shapes)`` per metre: half the push less half the pull.

    ``opd_at(points)`` are wavefronts ``(n_points, n_shapes)`` at places in the pupil; ``counted``
    makes of a spot of a full lenslet what its pixels count.
    """
    wave = 2j * np.pi / instrument.wfs.wavelength_m
    counts = counted(spots(np.ones((SAMPLES, SAMPLES)), n_pixels))
    rows = []
    for points in fine_points(instrument.wfs.n_subapertures, shift):
        radius = np.hypot(points[..., 0], points[..., 1]) / (instrument.wfs.pupil_diameter / 2)
        amplitude = (radius <= 1.0) & (radius >= instrument.obscuration_ratio)
        opd = np.moveaxis(opd_at(points.reshape(-1, 2)).reshape(*radius.shape, -1), -1, 0)
        push, pull = (
            centroids(counts * spots(amplitude * np.exp(step * wave * opd), n_pixels))
            for step in (PUSH_M, -PUSH_M)
        )
        rows.append((push - pull) / (2.0 * PUSH_M))
    return np.moveaxis(np.stack(rows), (0, 1, 2, 3), (1, 0, 3, 2))
