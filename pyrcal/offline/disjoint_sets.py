"""Disjoint sets of modes, actuators and subapertures, each fitted alone: a block jackknife.

A set is fitted by one step from the common solution with its own part of the normal equations, so
that no model is computed again. Two kinds of sets are told apart. Sets that see the whole pupil
evenly (a checkerboard, alternate sectors, rings, all sets of modes) repeat the whole fit, and their
scatter is that of the registration. Halves and quadrants do not: a mirror that is drawn distorted
moves opposite halves in opposite directions, which cancels in the whole. They are compared and
reported, and do not enter σ. Nor would bow ties be of use: along one diagonal a rotation looks like
a stretch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.estimation.reference import Target
from service.estimation.solver import Projection

Array = NDArray[np.float64]
Labels = NDArray[np.intp]

N_COMBS = 8
"""Most sets of modes of a partition."""

MIN_MODES = 3
"""Modes that a set must have."""

SIGNIFICANT = 3.0
"""Sets that differ by more than this many of their combined σ enter σ with their own scatter, not
with the mean over all partitions."""

N_SECTORS = 12
"""Sectors of which every second one makes a set."""

HALVES = ("left and right half", "lower and upper half", "quadrants")
"""Partitions of the pupil whose sets see one side of it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DisjointSets:
    """One partition, and where each of its sets alone leads."""

    words: str
    """Name of the partition."""

    steps: Array
    """``(n_sets, 4)`` step of each set alone from the common solution, numeric units."""

    sigma: Array
    """``(n_sets, 4)`` 1 σ of each step, from the scatter within the set."""

    jackknife: Array
    """``(4,)`` 1 σ of the registration by leaving out one set at a time."""

    @property
    def tension(self) -> Array:
        """``(4,)`` largest difference of two sets over their combined σ."""
        found = np.zeros(4)
        for k in range(len(self.steps)):
            apart = np.abs(self.steps[k + 1 :] - self.steps[k])
            both = np.hypot(self.sigma[k + 1 :], self.sigma[k])
            ratios = np.divide(apart, both, out=np.zeros_like(apart), where=both > 0.0)
            found = np.maximum(found, ratios.max(axis=0, initial=0.0))
        return found

    @property
    def even(self) -> bool:
        """Whether each of its sets sees the whole pupil, so that its scatter is that of α."""
        return self.words not in HALVES


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Normals:
    """The normal equations of a projection in parts: of each mode, or of each slope."""

    normals: Array
    """``(n_parts, n_unknowns, n_unknowns)``."""

    scores: Array
    """``(n_unknowns, n_parts)``."""

    clusters: Labels
    """``(n_parts,)`` parts with the same number are taken as dependent."""

    @classmethod
    def of_modes(cls, seen: Projection) -> Normals:
        """Return the normal equations of each mode."""
        return cls(normals=seen.normals, scores=seen.scores, clusters=np.arange(len(seen.gains)))

    @classmethod
    def of_rows(cls, seen: Projection, regions: Labels) -> Normals:
        """Return the normal equations of each slope.

        ``regions`` ``(n_rows,)`` are the clusters.
        """
        root = np.sqrt(seen.weights)
        by_row = seen.jacobian.transpose(1, 0, 2) * root
        return cls(
            normals=by_row @ by_row.transpose(0, 2, 1),
            scores=np.einsum("skm,sm->ks", by_row, seen.residual * root),
            clusters=regions,
        )

    def compare(
        self, partitions: Mapping[str, Labels], held: Array, pull: Array, noise: float
    ) -> Iterator[DisjointSets]:
        """Yield each partition with the steps of its sets.

        Parameters
        ----------
        partitions
            Name, and the set of each part ``(n_parts,)``.
        held, pull
            Prior of the unknowns as normal equations: ``(n, n)`` and ``(n,)``.
        noise
            Variance of a weighted residual.
        """
        for words, labels in partitions.items():
            try:
                yield self._compared(words, labels, held, pull, noise)
            except np.linalg.LinAlgError:
                continue  # a set that determines nothing says nothing

    def _compared(
        self, words: str, labels: Labels, held: Array, pull: Array, noise: float
    ) -> DisjointSets:
        numbers = np.unique(labels)
        normals = np.array([self.normals[labels == k].sum(axis=0) for k in numbers])
        scores = np.array([self.scores[:, labels == k].sum(axis=1) for k in numbers])
        every, scored = normals.sum(axis=0), scores.sum(axis=0)
        steps, sigma, without = [], [], []
        for k, number in enumerate(numbers):
            spread = np.linalg.inv(normals[k] + held)
            step = spread @ (scores[k] - pull)
            inside = labels == number
            about = self.scores[:, inside] - (self.normals[inside] @ step).T
            _, cluster = np.unique(self.clusters[inside], return_inverse=True)
            summed = np.array([np.bincount(cluster, row) for row in about])
            n_clusters = summed.shape[1]
            pulled = (spread @ summed)[:4]
            scatter = np.sum(pulled**2, axis=1) * n_clusters / max(n_clusters - 1, 1)
            steps.append(step[:4])
            sigma.append(np.sqrt(np.maximum(scatter, np.diag(spread)[:4] * noise)))
            left = every - normals[k] + held
            without.append(np.linalg.solve(left, scored - scores[k] - pull)[:4])
        n_sets, apart = len(numbers), np.array(without) - np.mean(without, axis=0)
        return DisjointSets(
            words=words,
            steps=np.array(steps),
            sigma=np.array(sigma),
            jackknife=np.sqrt((n_sets - 1) / n_sets * np.sum(apart**2, axis=0)),
        )


def jackknife_sigma(partitions: Sequence[DisjointSets]) -> Array:
    """Return ``(4,)`` 1 σ of the registration by all partitions of one kind.

    Each alone has few degrees of freedom, so their mean variance counts; but sets that differ
    significantly show something that the others cannot see, and count by themselves.
    """
    found = [one for one in partitions if one.even]
    if not found:
        return np.zeros(4)
    squares = np.array([one.jackknife**2 for one in found])
    tensions = np.array([one.tension for one in found])
    alone = np.where(tensions > SIGNIFICANT, squares, 0.0).max(axis=0)
    return np.asarray(np.sqrt(np.maximum(squares.mean(axis=0), alone)))


def mode_partitions(target: Target, n_planes: int, *, by_actuator: bool) -> dict[str, Labels]:
    """Return partitions of the modes: name, and the set of each mode ``(n_modes,)``.

    Columns of single actuators have places instead of an order: the place of each is the centroid
    of its response.
    """
    n_modes = target.n_modes
    rank = np.argsort(np.argsort(target.modes, kind="stable"), kind="stable")
    n_combs = min(N_COMBS, n_modes // MIN_MODES)
    found = {"odd and even modes": rank % 2}
    if n_combs > 2:
        found[f"{n_combs} combs of modes"] = rank % n_combs
    if by_actuator:
        x, y = _centroids(target, n_planes)
        found["alternate sectors of actuators"] = _sector(x, y) % 2
        away = np.hypot(x, y)
        found["inner and outer actuators"] = (away > np.median(away)).astype(np.intp)
    else:
        found["low and high modes"] = (2 * rank // n_modes).astype(np.intp)
    return {
        words: labels
        for words, labels in found.items()
        if len(np.unique(labels)) > 1 and np.bincount(labels).min() >= MIN_MODES
    }


def _centroids(target: Target, n_planes: int) -> tuple[Array, Array]:
    """Return where each column answers, ``(n_modes,)`` along x and y, subapertures."""
    half = (len(target.valid) - 1) / 2
    y, x = np.stack(np.nonzero(target.valid)) - half
    power = (target.matrix**2).reshape(n_planes, len(x), -1).sum(axis=0)
    total = power.sum(axis=0)
    return (x @ power) / total, (y @ power) / total


def _sector(x: Array, y: Array) -> Labels:
    return np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * N_SECTORS).astype(np.intp)


def pupil_partitions(
    valid: NDArray[np.bool_], n_planes: int, rows: NDArray[np.bool_]
) -> dict[str, Labels]:
    """Return partitions of the subapertures: name, and the set of each slope that counts."""
    n = len(valid)
    row, column = np.nonzero(valid)
    x = np.asarray(column - (n - 1) / 2, dtype=np.float64)
    y = np.asarray(row - (n - 1) / 2, dtype=np.float64)
    away = np.hypot(x, y)
    found = {
        "checkerboard": (row + column) % 2,
        "alternate sectors": _sector(x, y) % 2,
        "inner and outer rings": away > np.median(away),
        HALVES[0]: x > 0.0,
        HALVES[1]: y > 0.0,
        HALVES[2]: (x > 0.0) * 2 + (y > 0.0),
    }
    tiled = {
        words: np.tile(labels.astype(np.intp), n_planes)[rows] for words, labels in found.items()
    }
    return {words: labels for words, labels in tiled.items() if len(np.unique(labels)) > 1}
