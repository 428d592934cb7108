"""Choose a dither: modes, amplitude, length of windows, lines.

**Which**: a mode whose waves are long answers a mirror that is far out of place almost as it
should, so that steps lead home from afar; one whose waves are short says precisely where the
mirror is once it is near. Near registration all modes see a shift equally well, but one of high
azimuthal order tells a rotation twice as well as its neighbours, and one of high radial order the
magnification. The loop is the other way round: far from registration it holds a few modes at most.

**How much and how often**: as little as keeps α as well known as it must be, by how precise a
window of dither is. A table says so to begin with, then what the windows show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement, pairwise

import numpy as np
from numpy.typing import NDArray

from service.model.interaction import Linearisation

Array = NDArray[np.float64]

STRENGTH = 2.0
"""Of a burst: its own σ is the one asked for over this, where the budget allows."""

NEARLY_BEST = 1.1
"""Where the walk is too fast for what is asked: σ may be this much above the best there is."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitherRequirement:
    """The σ asked of the dither, and its budget."""

    sigma: Array
    """``(4,)`` 1 σ of α to be kept at all times, numeric units, model error not included."""

    drift_rate: Array
    """``(4,)`` random walk σ after one second, numeric units: the flexure."""

    budget_m: float
    """Largest RMS of all lines together on the mirror, metres OPD; never exceeded."""

    window_s: float
    """Telemetry of one burst, in one window or several, seconds."""

    window_sigma: Array = field(default_factory=lambda: np.full(4, np.inf))
    """``(4,)`` 1 σ that one window may have where it follows on the last without pause."""

    longest_s: float = np.inf
    """From one burst to the next, whatever α does meanwhile, seconds."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Schedule:
    """A dither of one burst every ``interval_s``."""

    total_m: float
    """RMS of all lines together, metres OPD."""

    interval_s: float
    """From the start of a burst to the start of the next; ``window_s``: no pause."""

    sigma: Array
    """``(4,)`` 1 σ of α just before each burst, which is when it is worst, numeric units."""

    sufficient: bool
    """Whether that is what was asked for; otherwise the budget is spent and it is the best."""


def schedule(precision: Array, requirement: DitherRequirement) -> Schedule:
    """Return the schedule that keeps ``demand.sigma`` within the budget.

    ``precision`` ``(4,)`` is κ of ``σ = κ / (A sqrt(T))``, in numeric units times m sqrt(s), as
    measured on the last windows. A burst of σ² = R every Δ seconds holds a random walk of rate q
    at ``P² - q²Δ P - q²Δ R = 0`` before each update, so ``Δ = P² / (q² (P + R))``. Weak dither
    often costs less than strong dither seldom, but leaves no pauses and no estimate that stands
    alone: a burst is made ``STRENGTH`` times as precise as asked, which costs
    ``sqrt(1 + STRENGTH²)`` of the least possible. Where the walk leaves no pause, the dither is no
    stronger than brings σ within ``NEARLY_BEST`` of the best the budget could buy.
    """
    total_m = min(
        _amplitude(precision, requirement, requirement.sigma / STRENGTH), requirement.budget_m
    )
    interval_s = min(_longest_interval(precision, requirement, total_m), requirement.longest_s)
    if interval_s < requirement.window_s:
        interval_s = requirement.window_s
        total_m = _without_pause(precision, requirement)
    before = _variance_before(precision, requirement, total_m, interval_s)
    return Schedule(
        total_m=total_m,
        interval_s=interval_s,
        sigma=np.sqrt(before),
        sufficient=bool(np.all(before <= requirement.sigma**2 * (1.0 + 1e-9))),
    )


def burst_s(
    precision: Array, requirement: DitherRequirement, lengths_s: tuple[float, ...]
) -> float:
    """Return the shortest burst that alone is as precise as asked, on the whole budget.

    Of ``lengths_s``, shortest first. One in which α walks further than the noise of its estimate is
    no use: the filter follows α better than that.
    """
    for length_s, longer_s in pairwise(lengths_s):
        noise = precision**2 / (requirement.budget_m**2 * length_s)
        if np.all(noise <= requirement.sigma**2):
            return length_s
        lacking = noise > requirement.sigma**2
        walk = requirement.drift_rate**2 * longer_s
        if np.all(walk[lacking] > (noise * length_s / longer_s)[lacking]):
            return length_s
    return lengths_s[-1]


def window_s(
    precision: Array, requirement: DitherRequirement, usable: Array, lengths_s: tuple[float, ...]
) -> float:
    """Return the shortest window in which the dither, on the whole budget, stands out of the noise.

    Of ``lengths_s``, shortest first. Beyond a σ of ``usable`` ``(4,)`` in one window the noise in
    the regressors biases the fit; many short windows tell as much as a long one otherwise, sooner,
    and a lost frame or a changed matrix costs less of them.
    """
    noise = [precision**2 / (requirement.budget_m**2 * length) for length in lengths_s]
    return next(
        (s for s, n in zip(lengths_s, noise, strict=True) if np.all(n <= usable**2)), lengths_s[-1]
    )


def _amplitude(precision: Array, requirement: DitherRequirement, sigma: Array) -> float:
    """Return the dither of which one window has no more than this ``sigma`` in any parameter."""
    return float(np.max(precision / (sigma * np.sqrt(requirement.window_s))))


def _longest_interval(precision: Array, requirement: DitherRequirement, total_m: float) -> float:
    wanted = requirement.sigma**2
    noise = precision**2 / (total_m**2 * requirement.window_s)
    return float(np.min(wanted**2 / (requirement.drift_rate**2 * (wanted + noise))))


def _variance_before(
    precision: Array, requirement: DitherRequirement, total_m: float, interval_s: float
) -> Array:
    walk = requirement.drift_rate**2 * interval_s
    noise = precision**2 / (total_m**2 * requirement.window_s)
    return np.asarray(0.5 * (walk + np.sqrt(walk**2 + 4.0 * walk * noise)))


def _without_pause(precision: Array, requirement: DitherRequirement) -> float:
    """Return the weakest dither that, without pause, holds what is asked for or nearly the best.

    Each of its windows tells what one alone must.
    """
    best = _variance_before(precision, requirement, requirement.budget_m, requirement.window_s)
    allowed = np.maximum(requirement.sigma**2, NEARLY_BEST**2 * best)
    noise = allowed**2 / (requirement.drift_rate**2 * requirement.window_s) - allowed
    of_window = np.minimum(np.sqrt(noise), requirement.window_sigma)
    return min(_amplitude(precision, requirement, of_window), requirement.budget_m)


def clear_of(
    wanted_hz: tuple[float, ...],
    avoid_hz: tuple[float, ...],
    *,
    clearance_hz: float,
    step_hz: float,
    range_hz: tuple[float, float],
) -> tuple[float, ...] | None:
    """Return dither lines as near to the wanted ones as vibrations allow, or None.

    Every line keeps ``clearance_hz`` from all of ``avoid_hz`` and from its fellows, no line is the
    sum or difference of others (``f_i + f_j - f_k``, by ``step_hz`` times four), and each is a
    multiple of ``step_hz`` so that a window holds whole periods.
    """
    low, high = (np.ceil(range_hz[0] / step_hz), np.floor(range_hz[1] / step_hz))
    grid = step_hz * np.arange(low, high + 1)
    chosen: list[float] = []
    for wanted in wanted_hz:
        by_distance = grid[np.argsort(np.abs(grid - wanted), kind="stable")]
        taken = (*avoid_hz, *chosen)
        free = (
            float(f)
            for f in by_distance
            if all(abs(f - t) >= clearance_hz for t in taken)
            and not _coincides(float(f), chosen, 4.0 * step_hz)
        )
        found = next(free, None)
        if found is None:
            return None
        chosen.append(found)
    return tuple(chosen)


def _coincides(frequency: float, chosen: list[float], within_hz: float) -> bool:
    """Return whether a line falls on a third-order product of those chosen, or makes one of them.

    The pyramid is odd in the wavefront to lowest order, so products of three lines are what it
    adds. Those chosen are clear of one another's.
    """
    lines = (*chosen, frequency)
    for first, second in combinations_with_replacement(lines, 2):
        for third in lines:
            if third in (first, second):
                continue
            product, made_of = first + second - third, (first, second, third)
            if frequency not in made_of:
                if abs(product - frequency) < within_hz:
                    return True
                continue
            for line in chosen:
                if abs(product - line) < within_hz and line not in made_of:
                    return True
    return False


SPAN = 100
"""Modes above the controlled ones that are looked at: further up, models of mirrors differ more."""


def information(linearisation: Linearisation) -> Array:
    """Return the information of each mode on α, ``(n_modes, 4, 4)``, per metre² and unit noise.

    The Fisher information of white slope noise, a free gain of the mode taken out:
    ``J^T J`` with ``J_k = (I - P) dD/dα_k``, P the projection on the mode's own response.
    """
    response, derivatives = linearisation.matrix, linearisation.derivatives
    n_modes = response.shape[1]
    norm = _sums(response, response)
    along = np.array([_sums(response, derivative) for derivative in derivatives])
    full = np.empty((n_modes, len(derivatives), len(derivatives)))
    for k, one in enumerate(derivatives):
        for j, other in enumerate(derivatives[: k + 1]):
            full[:, k, j] = full[:, j, k] = _sums(one, other)
    return np.asarray(full - np.einsum("km,lm->mkl", along, along) / norm[:, None, None])


def _sums(one: NDArray[np.float32], other: NDArray[np.float32]) -> Array:
    """Return the products of every two columns, ``(n_modes,)``."""
    return np.asarray(np.einsum("sm,sm->m", one, other), dtype=np.float64)


def most_informative(
    information: Array, candidates: Sequence[int], n: int, wanted: Array
) -> tuple[int, ...]:
    """Return the ``n`` modes that together come closest to every wanted σ ``(4,)``.

    Of all sets the one whose worst ratio of σ to ``wanted`` is smallest, found by exchange: from
    evenly spread modes, each in turn gives way to the best other candidate until none does.
    """
    pool = [mode for mode in candidates if mode < len(information)]
    if len(pool) <= n:
        return tuple(pool)
    scaled = information * np.outer(wanted, wanted)
    chosen = [pool[k] for k in np.linspace(0, len(pool) - 1, n).round().astype(int)]
    cost, improving = float(_worst(scaled[chosen].sum(axis=0))), True
    while improving:
        improving = False
        for place in range(n):
            kept = chosen[:place] + chosen[place + 1 :]
            others = [mode for mode in pool if mode not in kept]
            costs = _worst(scaled[kept].sum(axis=0) + scaled[others])
            best = int(np.argmin(costs))
            if costs[best] < cost * (1.0 - 1e-6):
                chosen, cost, improving = [*kept, others[best]], float(costs[best]), True
    return tuple(sorted(chosen))


def _worst(scaled: Array) -> Array:
    """Return the largest variance of α over what is wanted, of sets ``(..., 4, 4)``.

    A set that is blind to a combination of parameters has an enormous one.
    """
    power = np.diagonal(scaled, axis1=-2, axis2=-1)
    unit = np.sqrt(power[..., :, None] * power[..., None, :])
    correlation = scaled / unit + 1e-12 * np.eye(scaled.shape[-1])
    variances = np.diagonal(np.linalg.inv(correlation), axis1=-2, axis2=-1) / power
    return np.asarray(variances.max(axis=-1))


MAX_LINES = 8
FEWEST_LINES = 3
"""Modes dithered at once: two fix neither four parameters nor whether they are right."""

LINE_BAND = (0.2, 0.4)
"""Of the frame rate: wind biases slower lines, and near half the rate there is no room beside."""

CLEARANCE_HZ = 21.0
"""Between two lines: the noise is measured within 20 Hz of each."""

FIRST_CLOSED = 150
"""Modes a loop is first closed on: those a registration known to some per cent will carry."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Band:
    """A band of modes that is dithered with the loop open."""

    first: int
    """Lowest mode, of a basis in which modes get finer."""

    last: int
    floor: NDArray[np.float64]
    """``(4,)`` 1 σ of the model's error with the loop open, numeric units: the response that an
    uncorrected wavefront leaves is not the model's."""


SMOOTH = Band(
    first=0,
    last=28,
    floor=np.array([0.06, 0.06, np.deg2rad(0.25), 0.025]),
)
"""Leads from anywhere in the range."""

FINER = Band(
    first=36,
    last=99,
    floor=np.array([0.02, 0.02, np.deg2rad(0.06), 0.008]),
)
"""Confirms with other modes, three times as precisely."""


def modes_of(band: Band, n_modes: int, n_lines: int) -> tuple[int, ...]:
    """Return the modes to dither, spread over a band; a short basis shares what it has.

    The bands of ``SMOOTH`` and ``FINER`` have no mode in common however short the basis is, as
    long as it has twice as many modes as lines.
    """
    scale = min(1.0, (n_modes - 1) / FINER.last)
    first, last = np.ceil(scale * band.first), np.floor(scale * band.last)
    spread = np.round(np.linspace(first, last, n_lines)).astype(int)
    return tuple(int(mode) for mode in np.unique(spread))


def lines_of(frame_rate_hz: float, window_s: float, n_max: int) -> tuple[float, ...]:
    """Return as many dither lines as the band has room for, at most ``most``; maybe too few.

    Each is a whole number of periods of a window, and none is what the pyramid makes of others.
    """
    low, high = (share * frame_rate_hz for share in LINE_BAND)
    for n_lines in range(min(n_max, MAX_LINES), FEWEST_LINES - 1, -1):
        found = clear_of(
            tuple(np.linspace(low, high, n_lines + 1)[:-1].tolist()),
            (),
            clearance_hz=CLEARANCE_HZ,
            step_hz=frame_rate_hz / round(window_s * frame_rate_hz),
            range_hz=(low, high),
        )
        if found is not None:
            return found
    return ()


TABLE_MAGNITUDES = np.array([7.0, 10.0, 12.5])

TABLE = (
    np.array(
        [
            [0.019, 0.019, np.deg2rad(0.084), 0.0042],
            [0.059, 0.059, np.deg2rad(0.37), 0.0074],
            [0.13, 0.13, np.deg2rad(0.53), 0.026],
        ]
    )
    * 1e-9
)
"""``(n_magnitudes, 4)`` κ of ``σ = κ / (A sqrt(T))``, numeric units times m sqrt(s), of four modes
on the diffractive telescope at 1 kHz: of what the design study and docs/results/night.md found,
the larger."""

MEMORY_WINDOWS = 8.0
"""Windows after which what was learnt is worth 1/e: fewer scatter, more are slow when the seeing
changes."""

RATIO_RANGE = (0.05, 20.0)
"""Of a single window over the table: beyond it is the window that is odd."""


def tabulated(magnitude: float | None) -> Array:
    """Return κ ``(4,)`` for a star before any window has been seen; None: the faintest row.

    The noise of a faint star goes on growing as it does between the last two rows.
    """
    m, logs = TABLE_MAGNITUDES, np.log(TABLE)
    star = m[-1] if magnitude is None else max(float(magnitude), m[0])
    row = min(int(np.searchsorted(m, star, side="right")) - 1, len(m) - 2)
    share = (star - m[row]) / (m[row + 1] - m[row])
    kappa: Array = np.exp(logs[row] + share * (logs[row + 1] - logs[row]))
    return kappa


def measured_ratio(
    covariance: Array, total_m: float, window_s: float, magnitude: float | None
) -> Array:
    """Return the κ ``(4,)`` that one window shows, over that of the table.

    Parameters
    ----------
    covariance
        ``(4, 4)`` of the window's estimate, from its own data, numeric units.
    total_m
        RMS of all lines together as they were on the mirror, metres OPD.
    window_s
        Length of the window, seconds.
    magnitude
        Of the star; None: not known.
    """
    kappa = np.sqrt(np.diag(covariance)) * total_m * np.sqrt(window_s)
    return np.asarray(np.clip(kappa / tabulated(magnitude), *RATIO_RANGE))


def forgetting_mean(mean: Array | None, n_windows: int, ratio: Array) -> Array:
    """Return the quadratic mean of the ratios after one more, ``n_windows`` having gone before."""
    if mean is None or n_windows == 0:
        return ratio
    share = max(1.0 / (n_windows + 1), 1.0 / MEMORY_WINDOWS)
    return np.asarray(np.sqrt((1.0 - share) * mean**2 + share * ratio**2))
