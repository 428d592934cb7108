"""Fit the positions of sensors, mirrors and stars to α of every pair.

The fit is a weighted least-squares solution with the covariance of each pair. Some directions
change no pair's α measurably, less than a subaperture with all measurements together: along those,
the parameters stay closest to the file's values, and the directions are reported.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal.fitting.system import HEIGHT, MAGNIFICATION, ROTATION, SHIFTS, STAR, System
from service.model.misregistration import wrap_angle

Array = NDArray[np.float64]

UNSEEN_SUBAP = 1.0
"""Smallest 1 σ along a direction, at the pupil's edge, at which it counts as unobservable."""

MAX_STEPS = 20
SETTLED_SUBAP = 1e-7

_MIN_SHARE = 0.9
"""Share of a known direction within the unobservable ones above which it is reported."""

_MIN_NEW_SHARE = 0.1
"""Share of it outside the directions reported before, above which it is reported too."""

_MAX_LISTED, _MIN_LISTED = 4, 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SystemFit:
    """Fitted positions of sensors, mirrors and stars."""

    values: Array
    """``(n_parameters,)`` values, numeric units."""

    covariance: Array
    """``(n_parameters, n_parameters)`` covariance; zero along unobservable directions."""

    unseen_share: Array
    """``(n_parameters,)`` share of each parameter in unobservable directions, 0..1; such a
    parameter is known only relative to the others in that direction."""

    unseen: tuple[str, ...]
    """Unobservable directions as text."""

    misfit: Array
    """``(n_pairs, 4)`` measured α of each pair less the fitted one; NaN if not used."""

    pulls: Array
    """``(n_pairs, 4)`` misfit over 1 σ of α."""

    chi2: float
    n_free: int
    """Degrees of freedom: measured numbers less fitted ones; the expected χ²."""

    @property
    def sigma(self) -> Array:
        """``(n_parameters,)`` 1 σ of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def probability(self) -> float:
        """Probability of a larger χ² if the covariances are correct; 1 without redundancy."""
        return float(scipy.stats.chi2.sf(self.chi2, self.n_free)) if self.n_free else 1.0


def fit_system(system: System, alphas: Array, covariances: Array) -> SystemFit:
    """Return the positions of sensors, mirrors and stars from α of every pair.

    Parameters
    ----------
    system
        System with its nominal positions.
    alphas
        ``(n_pairs, 4)`` in the order of ``system.pairs``, numeric units; NaN if not measured.
    covariances
        ``(n_pairs, 4, 4)`` covariances of ``alphas``.
    """
    used = np.isfinite(alphas).all(axis=1)
    # Whitened with the whole covariance, because errors of one pair's parameters are correlated.
    roots = np.array([np.linalg.inv(np.linalg.cholesky(one)) for one in covariances[used]])
    free = np.array([parameter.free for parameter in system.parameters])
    unit = np.array([parameter.subap for parameter in system.parameters])
    values = system.nominal.copy()
    for _ in range(MAX_STEPS):
        left = _compute_misfit(system, alphas, values)
        rates = np.einsum("pij,pjk->pik", roots, system.rates(values)[used])
        seen = _Directions.of(rates.reshape(-1, len(values))[:, free] * unit[free])
        # the step is solved for the total offset from nominal, so that the unobservable part of
        # that offset stays zero
        moved = (values[free] - system.nominal[free]) / unit[free]
        whitened = np.einsum("pij,pj->pi", roots, left[used]).ravel()
        step = seen.best(whitened + seen.rates @ moved) - moved
        values[free] += step * unit[free]
        if np.max(np.abs(step), initial=0.0) < SETTLED_SUBAP:
            break
    left = _compute_misfit(system, alphas, values)
    whitened = np.einsum("pij,pj->pi", roots, left[used])
    covariance = np.zeros((len(values), len(values)))
    covariance[np.ix_(free, free)] = seen.covariance * np.outer(unit[free], unit[free])
    share = np.zeros(len(values))
    share[free] = np.linalg.norm(seen.unseen, axis=0)
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return SystemFit(
        values=values,
        covariance=covariance,
        unseen_share=share,
        unseen=tuple(_name_directions(system, values, seen.unseen, free, unit)),
        misfit=left,
        pulls=left / sigma,
        chi2=float(np.sum(whitened**2)),
        n_free=whitened.size - seen.n_seen,
    )


def _compute_misfit(system: System, alphas: Array, values: Array) -> Array:
    """Return measured less expected α, with rotation differences wrapped to half a turn."""
    left = alphas - system.alphas(values)
    left[:, 2] = [wrap_angle(angle) for angle in left[:, 2]]
    return left


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Directions:
    """Singular directions of the fitted parameters, in subapertures at the edge."""

    rates: Array
    """``(n_measured, n_found)`` derivatives, in σ per subaperture."""

    left: Array
    size: Array
    seen: Array
    """``(n_seen, n_found)`` observable directions, orthonormal."""

    unseen: Array
    """``(n_unseen, n_found)`` unobservable directions, orthonormal."""

    @classmethod
    def of(cls, rates: Array) -> _Directions:
        # Full, because with fewer measurements than parameters the remaining directions are
        # unobservable and have to be named too.
        left, size, along = np.linalg.svd(rates, full_matrices=True)
        # singular values are in σ per subaperture: their reciprocal is 1 σ along the direction
        n_seen = int(np.sum(size > 1.0 / UNSEEN_SUBAP))
        return cls(
            rates=rates,
            left=left[:, :n_seen],
            size=size[:n_seen],
            seen=along[:n_seen],
            unseen=along[n_seen:],
        )

    @property
    def n_seen(self) -> int:
        return len(self.size)

    def best(self, measured: Array) -> Array:
        """Return the shortest least-squares solution."""
        return np.asarray((measured @ self.left / self.size) @ self.seen)

    @property
    def covariance(self) -> Array:
        scaled = self.seen / self.size[:, None]
        return np.asarray(scaled.T @ scaled)


def _name_directions(
    system: System, values: Array, unseen: Array, free: NDArray[np.bool_], unit: Array
) -> Iterator[str]:
    """Yield in words the directions that ``unseen`` spans."""
    left = unseen
    for words, directions in _known_directions(system, values):
        found = False
        for direction in directions:
            moved = (direction / unit)[free]
            size = float(np.linalg.norm(moved))
            # Fixed parameters are left out, so a direction of such parameters only has no length.
            if size == 0.0 or np.linalg.norm(unseen @ moved) < _MIN_SHARE * size:
                continue
            # Only the part outside the directions named before, so that none is named twice.
            moved = moved @ left.T @ left / size
            if np.linalg.norm(moved) < _MIN_NEW_SHARE:
                continue
            found = True
            moved /= np.linalg.norm(moved)
            # rotate the remaining basis so that this direction comes first, then remove it
            turned, _ = np.linalg.qr(np.column_stack([left @ moved, np.eye(len(left))]))
            left = turned[:, 1:].T @ left
        if found:
            yield words
    parameters = [parameter for parameter in system.parameters if parameter.free]
    # What remains has no simple cause, so its largest parameters are listed.
    for direction in left:
        largest = np.argsort(-np.abs(direction))[:_MAX_LISTED]
        parts = [
            f"{parameters[k].owner} {parameters[k].name} ({direction[k]:+.2f})"
            for k in largest
            if abs(direction[k]) > _MIN_LISTED
        ]
        yield f"together, in subapertures: {', '.join(parts)}"


def _known_directions(system: System, values: Array) -> Iterator[tuple[str, list[Array]]]:
    """Yield directions that some systems cannot observe: text, and changes of all values."""
    yield from _of_each_star(system, values)
    both = (1.0 + 0j, 1j)
    everything = "sensors, mirrors and stars" if system.stars_move else "sensors and mirrors"
    yield (
        "the common shift of all sensors and mirrors: only their relative shift is observable",
        [_common_shift(system, values, along) for along in both],
    )
    yield (
        "the common direction of all stars: mirrors that are shifted in proportion to their "
        "altitudes look alike",
        [_common_direction(system, along) for along in both],
    )
    yield (
        f"the common rotation of all {everything}",
        [_common_turn(system, values, 1j)],
    )
    yield (
        f"the common magnification of all {everything}",
        [_common_turn(system, values, 1.0 + 0j)],
    )


def _of_each_star(system: System, values: Array) -> Iterator[tuple[str, list[Array]]]:
    """Yield changes of one star that its own sensor can compensate.

    They are unobservable if all mirrors are at one altitude.
    """
    altitude_m = float(np.mean([mirror.altitude_m for mirror in system.mirrors]))
    for number, sensor in enumerate(system.sensors):
        of_sensor = system.of_sensor(number)
        own = values[of_sensor]
        width_m = sensor.instrument.subaperture_m
        turn = own[MAGNIFICATION] * np.exp(1j * own[ROTATION])
        narrowed = 1.0 / (1.0 - altitude_m / own[HEIGHT])
        aside = []
        for along in (1.0 + 0j, 1j):
            direction = np.zeros(len(values))
            direction[of_sensor][STAR] = _xy(along)
            direction[of_sensor][SHIFTS] = _xy(turn * narrowed * altitude_m / width_m * along)
            aside.append(direction)
        nothing = "all mirrors are in the pupil"
        one = "they separate only with mirrors at several altitudes"
        yield (
            f"the star of {sensor.name}: {nothing}"
            if altitude_m == 0.0
            else f"the star's direction and the shift of {sensor.name}: {one}",
            aside,
        )
        # The light of a star at infinity has no cone, and so no height to be confused.
        if own[HEIGHT] < inf:
            higher = np.zeros(len(values))
            higher[of_sensor][HEIGHT] = 1.0
            higher[of_sensor][MAGNIFICATION] = (
                own[MAGNIFICATION] * narrowed * altitude_m / own[HEIGHT] ** 2
            )
            yield (
                f"the height of the star of {sensor.name}: {nothing}"
                if altitude_m == 0.0
                else f"the star's height and the magnification of {sensor.name}: {one}",
                [higher],
            )


def _common_shift(system: System, values: Array, along: complex) -> Array:
    """Return a common shift over the pupil; the cone effect reduces it at altitude."""
    direction = np.zeros(len(values))
    heights = values[: len(system.sensors) * 7].reshape(-1, 7)[:, HEIGHT]
    for number, sensor in enumerate(system.sensors):
        own = values[system.of_sensor(number)]
        turn = own[MAGNIFICATION] * np.exp(1j * own[ROTATION])
        shift = _xy(-turn * along / sensor.instrument.subaperture_m)
        direction[system.of_sensor(number)][SHIFTS] = shift
    for number, mirror in enumerate(system.mirrors):
        # A mirror has one shift for all sensors, so stars at several heights share the mean cone.
        narrowed = 1.0 - mirror.altitude_m * float(np.mean(1.0 / heights))
        direction[system.of_mirror(number)][SHIFTS] = _xy(narrowed * along)
    return direction


def _common_direction(system: System, along: complex) -> Array:
    direction = np.zeros(len(system.parameters))
    for number in range(len(system.sensors)):
        direction[system.of_sensor(number)][STAR] = _xy(along)
    for number, mirror in enumerate(system.mirrors):
        direction[system.of_mirror(number)][SHIFTS] = _xy(mirror.altitude_m * along)
    return direction


def _common_turn(system: System, values: Array, turn: complex) -> Array:
    """Return a common rotation (imaginary) or magnification (real) about the pupil's centre."""
    direction = np.zeros(len(values))
    for number in range(len(system.sensors)):
        own, change = values[system.of_sensor(number)], direction[system.of_sensor(number)]
        # The sensor's map follows the mirror's, so it has to turn back for an unchanged image.
        change[ROTATION], change[MAGNIFICATION] = -turn.imag, -turn.real * own[MAGNIFICATION]
        change[STAR] = _xy(turn * complex(*own[STAR]))
    for number in range(len(system.mirrors)):
        own, change = values[system.of_mirror(number)], direction[system.of_mirror(number)]
        change[ROTATION], change[MAGNIFICATION] = turn.imag, turn.real * own[MAGNIFICATION]
        change[SHIFTS] = _xy(turn * complex(*own[SHIFTS]))
    return direction


def _xy(point: complex) -> tuple[float, float]:
    return point.real, point.imag
