"""Tables of shapes end somewhere: where they know nothing, and a smooth surface to put there.

A cubic spline cannot stop at an edge: a table that falls to zero outside its pupil is wrong by
20 % inside it. What is put there instead decides nothing that is used (slopes near unknown surface
are left out), it only has to join smoothly.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

Table = NDArray[np.floating]
Mask = NDArray[np.bool_]


def known_samples(cube: Table) -> Mask:
    """Return ``(ny, nx)``: where a cube ``(n_modes, ny, nx)`` says something.

    Samples that are not finite in any mode say nothing, nor do regions where every mode is exactly
    zero. A line of zeros one sample wide does: odd modes vanish together on an axis.
    """
    zero = np.pad(~np.any(cube, axis=0), 1, constant_values=True)
    region = scipy.ndimage.binary_opening(zero, np.ones((2, 2), bool))
    zeros = scipy.ndimage.binary_dilation(region, mask=zero)[1:-1, 1:-1]
    return np.asarray(np.isfinite(cube).all(axis=0) & ~zeros)


def padded(mask: Mask, margin: tuple[int, int]) -> Mask:
    """Return the mask with ``margin`` unknown rows and columns around it; negative ones cut."""
    return np.asarray(_resized(mask[None], margin)[0])


def filled(cube: Table, known: Mask, margin: tuple[int, int]) -> Table:
    """Return shapes ``(ny * nx, n_modes)`` on a table with ``margin`` more rows and columns around.

    Unknown samples continue the surface oddly about the nearest known one, as a tangent would:
    ``f(p) = 2 f(b) - f(2 b - p)``. Every filled sample is two known ones, for all modes at once.
    """
    shapes = _resized(np.where(known, cube, cube.dtype.type(0)), margin)
    samples = np.ascontiguousarray(shapes.reshape(len(shapes), -1).T)
    target, weights = _continuation(padded(known, margin))
    samples[target] = weights.astype(samples.dtype) @ samples
    return samples


def _resized(planes: NDArray[np.generic], margin: tuple[int, int]) -> NDArray[np.generic]:
    grown = [(max(m, 0), max(m, 0)) for m in margin]
    cut = [slice(max(-m, 0), n - max(-m, 0)) for m, n in zip(margin, planes.shape[1:], strict=True)]
    return np.pad(planes[:, cut[0], cut[1]], [(0, 0), *grown])


def _continuation(known: Mask) -> tuple[NDArray[np.intp], scipy.sparse.csr_array]:
    """Return the unknown samples and the weights ``(n_unknown, n_samples)`` that make them."""
    nearest = scipy.ndimage.distance_transform_edt(
        ~known, return_distances=False, return_indices=True
    )
    place = np.argwhere(~known)
    edge = nearest[:, ~known].T
    mirrored = 2 * edge - place
    inside = np.all((mirrored >= 0) & (mirrored < known.shape), axis=1)
    inside[inside] = known[tuple(mirrored[inside].T)]
    at_edge = np.ravel_multi_index(tuple(edge.T), known.shape)
    at_image = at_edge.copy()
    at_image[inside] = np.ravel_multi_index(tuple(mirrored[inside].T), known.shape)
    rows = np.arange(len(place))
    weights = scipy.sparse.csr_array(
        (
            np.concatenate([np.full(len(rows), 2.0), np.full(len(rows), -1.0)]),
            (np.concatenate([rows, rows]), np.concatenate([at_edge, at_image])),
        ),
        shape=(len(rows), known.size),
    )
    return np.asarray(np.ravel_multi_index(tuple(place.T), known.shape)), weights
