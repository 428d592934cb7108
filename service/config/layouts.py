"""Where the actuators of an analytic mirror are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_CHUNK = 256
"""Points compared with all others at once."""


def rings(first_ring: int, last_ring: int, pitch_m: float) -> NDArray[np.float64]:
    """Return actuators on concentric rings, ``(n_actuators, 2)``, x and y in metres.

    Ring k has 6k + 3 actuators at radius (k - 1/2) pitch, the first of each on +x: the layout is
    its own mirror image under y -> -y, so that the modes come out even or odd.
    """
    found = []
    for ring in range(first_ring, last_ring + 1):
        n_actuators = 6 * ring + 3
        angle = 2.0 * np.pi * np.arange(n_actuators) / n_actuators
        found.append((ring - 0.5) * pitch_m * np.column_stack([np.cos(angle), np.sin(angle)]))
    return np.concatenate(found)


def grid(n_across: int, pitch_m: float, diameter_m: float) -> NDArray[np.float64]:
    """Return the points of a centred square grid inside a circle, ``(n_actuators, 2)``, metres.

    Rows run along +x, from the lowest y up, as ``[y, x]`` arrays do.
    """
    line = (np.arange(n_across) - (n_across - 1) / 2) * pitch_m
    y, x = np.meshgrid(line, line, indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel()])
    rounding = 1.0 + 1e-9
    inside = np.linalg.norm(points, axis=1) <= diameter_m / 2 * rounding
    return np.asarray(points[inside])


def typical_pitch(positions_m: NDArray[np.float64]) -> float:
    """Return the median distance to the nearest neighbour, metres."""
    return float(np.median(_nearest(positions_m)[0]))


def coincident(positions_m: NDArray[np.float64]) -> tuple[int, int] | None:
    """Return the indices of two actuators in the same place, or None."""
    distances, neighbours = _nearest(positions_m)
    same = np.flatnonzero(distances <= 1e-6 * np.ptp(positions_m))
    if same.size == 0:
        return None
    first, second = sorted((int(same[0]), int(neighbours[same[0]])))
    return first, second


def _nearest(positions_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return how far every point's nearest neighbour is, and which it is.

    By brute force: a tree would take longer to import than this takes for a few thousand points.
    """
    n = len(positions_m)
    distances, neighbours = np.full(n, np.inf), np.zeros(n, dtype=np.intp)
    if n < 2:
        return distances, neighbours
    for start in range(0, n, _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, n))
        apart = np.hypot(*(positions_m[rows, None] - positions_m).transpose(2, 0, 1))
        apart[np.arange(len(rows)), rows] = np.inf
        neighbours[rows] = apart.argmin(axis=1)
        distances[rows] = apart.min(axis=1)
    return distances, neighbours
