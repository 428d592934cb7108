"""Disjoint sets of modes, actuators and subapertures, each fitted separately: a block jackknife.

A set is fitted by one step from the common solution with its own part of the normal equations, so
that no model is computed again. The σ of its step has three parts:

- leaving out one of its modes at a time: noise, and errors of single modes;
- leaving out one region of the pupil at a time, if sets cover different parts of the pupil: errors
  of the model that all modes share;
- between two sets, the difference of their displacements by a smooth distortion of the mirror. The
  distortion (second and third order) is fitted to the whole matrix. A distorted relay or a
  distorted nominal geometry gives different registrations in different parts of the pupil.

Sets that cover the whole pupil evenly (a checkerboard, rings, all sets of modes) repeat the whole
fit, and their scatter enters the σ of the registration. Halves, quadrants and alternate sectors do
not: a distorted mirror moves opposite halves in opposite directions, and the two sides of an arm
that the file lacks pull the rotation in opposite directions, which cancels over the pupil. They are
compared and reported only. Bow ties are not used: along one diagonal a rotation looks like
a stretch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.estimation.reference import Target
from service.estimation.solver import Projection

Array = NDArray[np.float64]
Labels = NDArray[np.intp]

N_COMBS = 8
"""Largest number of sets of modes in a partition."""

MIN_MODES = 3
"""Smallest number of modes in a set."""

SIGNIFICANT = 3.0
"""Number of combined σ by which sets must differ for their own scatter to enter σ, instead of the
mean over all partitions."""

N_SECTORS = 12
"""Number of sectors; alternate sectors make a set."""

PARTS = ("left and right half", "lower and upper half", "quadrants", "alternate sectors")
"""Partitions of the pupil whose sets cover one side of it, or one side of an arm. With arms that
the file lacks, alternate sectors made σ of the rotation 50 times the error."""

ACTUATORS = ("alternate sectors of actuators", "inner and outer actuators")
"""Partitions of modes whose responses are in different parts of the pupil."""

DISTORTION_SIGMA_SUBAP = 0.1
"""Prior 1 σ of each term of a smooth distortion, RMS over the pupil, subapertures."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DisjointSets:
    """One partition, and the step of each of its sets."""

    words: str
    """Name of the partition."""

    steps: Array
    """``(n_sets, 4)`` step of each set alone from the common solution, numeric units."""

    sigma: Array
    """``(n_sets, 4)`` 1 σ of each step, by leaving out modes and regions of the pupil."""

    distorted: Array
    """``(n_sets, 4)`` change of each set by the mirror's distortion; 0 if all cover the same
    region."""

    jackknife: Array
    """``(4,)`` 1 σ of the registration by leaving out one set at a time."""

    @property
    def ratios(self) -> Array:
        """``(n_pairs, 4)`` difference of every two sets over their combined σ."""
        return self._ratios(self.distorted)

    @property
    def tension(self) -> Array:
        """``(4,)`` largest difference of two sets over their combined σ."""
        return np.asarray(self.ratios.max(axis=0, initial=0.0))

    @property
    def straight_tension(self) -> Array:
        """``(4,)`` largest difference over combined σ, if the mirror were not distorted."""
        return np.asarray(self._ratios(np.zeros_like(self.distorted)).max(axis=0, initial=0.0))

    def _ratios(self, distorted: Array) -> Array:
        first, second = np.triu_indices(len(self.steps), k=1)
        apart = np.abs(self.steps[first] - self.steps[second])
        variance = self.sigma[first] ** 2 + self.sigma[second] ** 2
        both = np.sqrt(variance + (distorted[first] - distorted[second]) ** 2)
        return np.divide(apart, both, out=np.zeros_like(apart), where=both > 0.0)

    @property
    def even(self) -> bool:
        """True if each set covers the whole pupil, so that their scatter is that of α."""
        return self.words not in PARTS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Distortion:
    """A smooth distortion of the mirror, fitted to the whole matrix."""

    rms_subap: float
    """RMS displacement over the pupil without shift, rotation and magnification, subapertures."""

    share: float
    """χ² with the distortion over that of the fit."""

    moved: Array
    """``(4,)`` change of the registration if the distortion is fitted, numeric units."""

    field: Array
    """``(n_rows, 2)`` displacement along x and y at the position of each slope, subapertures."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Normals:
    """Contributions of each mode, or of each slope, to the normal equations."""

    normals: Array
    """``(n_parts, n_unknowns, n_unknowns)``."""

    scores: Array
    """``(n_unknowns, n_parts)``."""

    clusters: Labels
    """``(n_parts,)`` cluster number of each part; parts of a cluster are treated as dependent."""

    @classmethod
    def of_modes(cls, seen: Projection) -> Normals:
        """Return the normal equations of each mode."""
        clusters = np.arange(len(seen.gains))
        return cls(normals=seen.normals, scores=seen.scores, clusters=clusters)

    @classmethod
    def of_modes_in_groups(cls, seen: Projection, groups: Labels) -> list[Normals]:
        """Return the normal equations of each mode, of every group of slopes ``(n_rows,)``."""
        order, found = np.argsort(groups, kind="stable"), []
        by_mode = np.ascontiguousarray(seen.jacobian[:, order].transpose(2, 0, 1))
        pulled = (seen.residual[order] * seen.weights).T.astype(by_mode.dtype)
        edges = np.cumsum(np.bincount(groups))
        for rows in map(slice, (0, *edges[:-1]), edges):
            part = by_mode[:, :, rows]
            normals = part @ part.transpose(0, 2, 1) * seen.weights[:, None, None]
            scores = (part @ pulled[:, rows, None])[:, :, 0].T
            found.append(cls(normals=normals, scores=scores, clusters=np.arange(len(by_mode))))
        return found

    @classmethod
    def add(cls, parts: Sequence[Normals]) -> Normals:
        """Return the sums of the same parts."""
        return replace(
            parts[0],
            normals=np.sum([one.normals for one in parts], axis=0),
            scores=np.sum([one.scores for one in parts], axis=0),
        )

    @classmethod
    def of_rows(
        cls, seen: Projection, regions: Labels, modes: NDArray[np.bool_] | None = None
    ) -> Normals:
        """Return the normal equations of each slope, of some modes ``(n_modes,)`` or of all.

        ``regions`` ``(n_rows,)`` are the clusters.
        """
        kept = slice(None) if modes is None else modes
        root = np.sqrt(seen.weights[kept]).astype(seen.jacobian.dtype)
        by_row = seen.jacobian[:, :, kept].transpose(1, 0, 2) * root
        pulled = (seen.residual[:, kept] * root).astype(by_row.dtype)
        return cls(
            normals=np.asarray(by_row @ by_row.transpose(0, 2, 1), np.float64),
            scores=np.einsum("skm,sm->ks", by_row, pulled),
            clusters=regions,
        )

    def leave_one_out(
        self, inside: NDArray[np.bool_], held: Array, pull: Array
    ) -> tuple[Array, Array]:
        """Return the step of selected parts ``(n_parts,)`` and its 1 σ by leaving out clusters."""
        parts = np.flatnonzero(inside)
        # ``reduceat`` adds neighbours, so the parts of each cluster are brought together first.
        order = parts[np.argsort(self.clusters[parts], kind="stable")]
        _, first = np.unique(self.clusters[order], return_index=True)
        n_clusters = len(first)
        normals = np.add.reduceat(self.normals[order], first, axis=0)
        scores = np.add.reduceat(self.scores[:, order], first, axis=1)
        every, scored = normals.sum(axis=0) + held, scores.sum(axis=1) - pull
        # All fits with one cluster left out are solved at once.
        left = np.linalg.solve(every - normals, (scored[:, None] - scores).T[:, :, None])[:, :4, 0]
        spread = np.sum((left - left.mean(axis=0)) ** 2, axis=0)
        # Fits with one cluster left out share all others and hardly differ. The factor of the
        # jackknife turns their scatter into the σ of the whole.
        sigma = np.sqrt((n_clusters - 1) / n_clusters * spread)
        return np.linalg.solve(every, scored)[:4], sigma

    def solve_displacement(self, inside: NDArray[np.bool_], held: Array, field: Array) -> Array:
        """Return the change of selected parts by a displacement of each slope ``(n_parts, 2)``."""
        normals = self.normals[inside]
        # The first two unknowns are the shifts: a displaced point has the derivatives of a shift.
        along = np.einsum("ski,si->k", normals[:, :, :2], field[inside])
        return np.asarray(np.linalg.solve(normals.sum(axis=0) + held, along)[:4])

    def fit_distortion(
        self, places: Array, held: Array, pull: Array, chi: float, noise: float
    ) -> Distortion:
        """Return the smooth distortion that explains the most, with all other unknowns free.

        To first order, a displacement u of a point changes its slopes by u times the derivatives by
        shift, so the normal equations of each slope contain all that is needed.

        Parameters
        ----------
        places
            ``(n_rows, 2)`` position of each slope, pupil radii.
        held, pull
            Prior of the unknowns as normal equations: ``(n, n)`` and ``(n,)``.
        chi
            χ² of the fit.
        noise
            Variance of a weighted residual.
        """
        shapes = _smooth_shapes(places)
        n, n_shapes = len(held), shapes.shape[1]
        across = np.einsum("sa,ski->kai", shapes, self.normals[:, :, :2]).reshape(n, -1)
        among = np.einsum("sa,sb,sij->aibj", shapes, shapes, self.normals[:, :2, :2], optimize=True)
        scored = np.einsum("sa,is->ai", shapes, self.scores[:2]).ravel()
        # The prior bounds terms that the measured modes hardly determine.
        own = np.full(2 * n_shapes, noise / DISTORTION_SIGMA_SUBAP**2)
        normal = np.block(
            [
                [self.normals.sum(axis=0) + held, across],
                [across.T, among.reshape(2 * n_shapes, -1) + np.diag(own)],
            ]
        )
        pulled = np.concatenate([self.scores.sum(axis=1) - pull, scored])
        step = np.linalg.solve(normal, pulled)
        field = shapes @ step[n:].reshape(n_shapes, 2)
        return Distortion(
            rms_subap=float(np.sqrt(np.mean(np.sum(field**2, axis=1)))),
            share=max(1.0 - float(step @ pulled) / chi, 0.0) if chi > 0.0 else 1.0,
            moved=step[:4],
            field=field,
        )


def _smooth_shapes(places: Array) -> Array:
    """Return terms of second and third order ``(n_rows, 7)``, RMS 1, free of lower orders."""
    x, y = places.T
    lower = [np.ones_like(x), x, y]
    found = []
    # Lower orders are removed, because α and the anamorphosis already describe them.
    for term in (x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3):
        base = np.column_stack(lower)
        own = term - base @ np.linalg.lstsq(base, term, rcond=None)[0]
        found.append(own / max(float(np.sqrt(np.mean(own**2))), 1e-12))
        lower.append(own)
    return np.column_stack(found)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SetComparison:
    """A projection at its solution, ready to be compared set by set."""

    seen: Projection

    regions: Labels
    """``(n_rows,)`` region of the pupil of each slope."""

    held: Array
    """``(n_unknowns, n_unknowns)`` prior of the unknowns as normal equations."""

    pull: Array
    """``(n_unknowns,)`` the prior's scores."""

    noise: float
    """Variance of a weighted residual."""

    distortion: Distortion

    def of_modes(self, partitions: Mapping[str, Labels], parts: Normals) -> Iterator[DisjointSets]:
        """Yield partitions of the modes; ``parts`` are the normal equations of each mode."""
        every = np.ones(len(self.regions), dtype=bool)

        def by_region(_set: int, inside: NDArray[np.bool_]) -> tuple[Array, Array]:
            by_row = Normals.of_rows(self.seen, self.regions, inside)
            _, sigma = by_row.leave_one_out(every, self.held, self.pull)
            return sigma, by_row.solve_displacement(every, self.held, self.distortion.field)

        for words, labels in partitions.items():
            with suppress(np.linalg.LinAlgError):  # skip sets that do not determine a registration
                # sets of actuators respond in different parts of the pupil, so errors of one
                # region and a distortion of the mirror move them apart
                apart = by_region if words in ACTUATORS else None
                yield self._make_sets(words, labels, parts, apart)

    def of_rows(self, partitions: Mapping[str, Labels], parts: Normals) -> Iterator[DisjointSets]:
        """Yield partitions of the slopes; ``parts`` are the normal equations of each slope."""
        if not partitions:
            return
        every = np.ones(len(self.seen.gains), dtype=bool)
        # slopes that are in the same set of every partition are added up once
        labels_of, groups = np.unique(
            np.column_stack(list(partitions.values())), axis=0, return_inverse=True
        )
        by_group = Normals.of_modes_in_groups(self.seen, groups.ravel())
        for column, (words, labels) in enumerate(partitions.items()):

            def by_mode(
                number: int, inside: NDArray[np.bool_], of_group: Labels = labels_of[:, column]
            ) -> tuple[Array, Array]:
                own = Normals.add([by_group[k] for k in np.flatnonzero(of_group == number)])
                # Leaving out regions does not show errors of single modes, which all slopes of a
                # set share.
                _, sigma = own.leave_one_out(every, self.held, self.pull)
                return sigma, parts.solve_displacement(inside, self.held, self.distortion.field)

            with suppress(np.linalg.LinAlgError):
                yield self._make_sets(words, labels, parts, by_mode)

    def _make_sets(
        self,
        words: str,
        labels: Labels,
        parts: Normals,
        others: Callable[[int, NDArray[np.bool_]], tuple[Array, Array]] | None,
    ) -> DisjointSets:
        """Return a partition of ``parts`` ``(n_parts,)``.

        ``others`` returns 1 σ of a set, and its change by the distortion, that its own parts do not
        show; None if there is neither.
        """
        steps, sigmas, distorted = [], [], []
        for number in np.unique(labels):
            inside = labels == number
            step, sigma = parts.leave_one_out(inside, self.held, self.pull)
            more, moved = (np.zeros(4), np.zeros(4)) if others is None else others(number, inside)
            # With few clusters the jackknife may be small by chance: it is at least the noise.
            spread = np.linalg.inv(parts.normals[inside].sum(axis=0) + self.held)
            noise = np.sqrt(np.diag(spread)[:4] * self.noise)
            steps.append(step)
            sigmas.append(np.maximum(np.hypot(sigma, more), noise))
            distorted.append(moved)
        every = np.ones(len(labels), dtype=bool)
        _, jackknife = replace(parts, clusters=labels).leave_one_out(every, self.held, self.pull)
        return DisjointSets(
            words=words,
            steps=np.array(steps),
            sigma=np.array(sigmas),
            distorted=np.array(distorted),
            jackknife=jackknife,
        )


def jackknife_sigma(partitions: Sequence[DisjointSets]) -> Array:
    """Return ``(4,)`` 1 σ of the registration from all partitions of one kind.

    Each partition has few degrees of freedom, so their mean variance is used. A partition whose
    sets differ significantly counts by itself, because it shows an error that the others cannot: a
    distortion that explains the difference leaves the registration uncertain by as much.
    """
    # A distorted mirror moves opposite halves in opposite directions, and so does an arm its sides.
    # That cancels over the pupil, so parts of it would overstate the error of α.
    found = [one for one in partitions if one.even]
    if not found:
        return np.zeros(4)
    squares = np.array([one.jackknife**2 for one in found])
    tensions = np.array([one.straight_tension for one in found])
    # a significant difference may not be averaged away by partitions that cannot show it
    alone = np.where(tensions > SIGNIFICANT, squares, 0.0).max(axis=0)
    return np.asarray(np.sqrt(np.maximum(squares.mean(axis=0), alone)))


def mode_partitions(target: Target, n_planes: int, *, by_actuator: bool) -> dict[str, Labels]:
    """Return partitions of the modes: name, and the set of each mode ``(n_modes,)``.

    Columns of single actuators are sorted by position instead of order: the centroid of the
    response.
    """
    n_modes = target.n_modes
    # Ranks, not indices: the measured modes may have gaps and any order.
    rank = np.argsort(np.argsort(target.modes, kind="stable"), kind="stable")
    n_combs = min(N_COMBS, n_modes // MIN_MODES)
    # Sets from every n-th mode contain low and high orders alike.
    found = {"odd and even modes": rank % 2}
    # Two combs would be the odd and even modes again.
    if n_combs > 2:
        found[f"{n_combs} combs of modes"] = rank % n_combs
    # A number of an actuator says nothing about its order, but its place does about the pupil.
    if by_actuator:
        x, y = _centroids(target, n_planes)
        found[ACTUATORS[0]] = _sector(x, y) % 2
        away = np.hypot(x, y)
        found[ACTUATORS[1]] = (away > np.median(away)).astype(np.intp)
    else:
        found["low and high modes"] = (2 * rank // n_modes).astype(np.intp)
    return {
        words: labels
        for words, labels in found.items()
        if len(np.unique(labels)) > 1 and np.bincount(labels).min() >= MIN_MODES
    }


def _centroids(target: Target, n_planes: int) -> tuple[Array, Array]:
    """Return the centroid of each column's response ``(n_modes,)`` along x and y, subapertures."""
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
    """Return partitions of the subapertures: name, and the set of each used slope."""
    n = len(valid)
    row, column = np.nonzero(valid)
    x = np.asarray(column - (n - 1) / 2, dtype=np.float64)
    y = np.asarray(row - (n - 1) / 2, dtype=np.float64)
    # The median of the distance gives two rings with equally many subapertures.
    away = np.hypot(x, y)
    found = {
        "checkerboard": (row + column) % 2,
        PARTS[3]: _sector(x, y) % 2,
        "inner and outer rings": away > np.median(away),
        PARTS[0]: x > 0.0,
        PARTS[1]: y > 0.0,
        PARTS[2]: (x > 0.0) * 2 + (y > 0.0),
    }
    tiled = {
        words: np.tile(labels.astype(np.intp), n_planes)[rows] for words, labels in found.items()
    }
    return {words: labels for words, labels in tiled.items() if len(np.unique(labels)) > 1}
