"""How much dither, how often and where: as little as keeps α as well known as it must be."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STRENGTH = 2.0
"""Of a sitting: its own σ is the one asked for over this, where the budget allows."""

NEARLY_BEST = 1.1
"""Where the walk is too fast for what is asked: σ may be this much above the best there is."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Demand:
    """What is asked of the dither, and what it may cost."""

    sigma: Array
    """``(4,)`` 1 σ of α to be kept at all times, numeric units, model error not included."""

    drift_rate: Array
    """``(4,)`` random walk σ after one second, numeric units: the flexure."""

    budget_m: float
    """Largest RMS of all lines together on the mirror, metres OPD; never exceeded."""

    window_s: float
    """Telemetry of one sitting, in one window or several, seconds."""

    settling_s: float = 0.0
    """Dither before a sitting that comes after a pause, seconds."""

    window_sigma: Array = field(default_factory=lambda: np.full(4, np.inf))
    """``(4,)`` 1 σ that one window may have where it follows on the last without pause."""

    longest_s: float = np.inf
    """From one sitting to the next, whatever α does meanwhile, seconds."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Schedule:
    """A dither of one sitting every ``interval_s``."""

    total_m: float
    """RMS of all lines together, metres OPD."""

    interval_s: float
    """From the start of a sitting to the start of the next; ``window_s``: no pause."""

    sigma: Array
    """``(4,)`` 1 σ of α just before each sitting, which is when it is worst."""

    sufficient: bool
    """Whether that is what was asked for; otherwise the budget is spent and it is the best."""

    mean_cost_m: float
    """Quadratic mean of the dither over time, pauses included, metres OPD."""


def schedule(precision: Array, demand: Demand) -> Schedule:
    """Return the schedule that keeps ``demand.sigma`` within the budget.

    ``precision`` ``(4,)`` is κ of ``σ = κ / (A sqrt(T))``, in numeric units times m sqrt(s), as
    measured on the last windows. A sitting of σ² = R every Δ seconds holds a random walk of rate q
    at ``P² - q²Δ P - q²Δ R = 0`` before each update, so ``Δ = P² / (q² (P + R))``. Weak dither
    often costs less than strong dither seldom, but leaves no pauses and no estimate that stands
    alone: a sitting is made ``STRENGTH`` times as precise as asked, which costs
    ``sqrt(1 + STRENGTH²)`` of the least possible. Where the walk leaves no pause, the dither is no
    stronger than brings σ within ``NEARLY_BEST`` of the best the budget could buy.
    """
    total_m = min(_amplitude(precision, demand, demand.sigma / STRENGTH), demand.budget_m)
    interval_s = min(_longest_interval(precision, demand, total_m), demand.longest_s)
    if interval_s < demand.window_s:
        interval_s = demand.window_s
        total_m = _without_pause(precision, demand)
    before = _variance_before(precision, demand, total_m, interval_s)
    on_s = min(demand.window_s + demand.settling_s, interval_s)
    return Schedule(
        total_m=total_m,
        interval_s=interval_s,
        sigma=np.sqrt(before),
        sufficient=bool(np.all(before <= demand.sigma**2 * (1.0 + 1e-9))),
        mean_cost_m=total_m * float(np.sqrt(on_s / interval_s)),
    )


def sitting_s(precision: Array, demand: Demand, lengths_s: tuple[float, ...]) -> float:
    """Return the shortest sitting that alone is as precise as asked, on the whole budget.

    Of ``lengths_s``, shortest first. One in which α walks further than the noise of its estimate is
    no use: the filter follows α better than that.
    """
    for length_s, longer_s in pairwise(lengths_s):
        noise = precision**2 / (demand.budget_m**2 * length_s)
        if np.all(noise <= demand.sigma**2):
            return length_s
        lacking = noise > demand.sigma**2
        walk = demand.drift_rate**2 * longer_s
        if np.all(walk[lacking] > (noise * length_s / longer_s)[lacking]):
            return length_s
    return lengths_s[-1]


def window_s(
    precision: Array, demand: Demand, usable: Array, lengths_s: tuple[float, ...]
) -> float:
    """Return the shortest window in which the dither, on the whole budget, stands out of the noise.

    Of ``lengths_s``, shortest first. Beyond a σ of ``usable`` ``(4,)`` in one window the noise in
    the regressors biases the fit; many short windows tell as much as a long one otherwise, sooner,
    and a lost frame or a changed matrix costs less of them.
    """
    noise = [precision**2 / (demand.budget_m**2 * length) for length in lengths_s]
    return next(
        (s for s, n in zip(lengths_s, noise, strict=True) if np.all(n <= usable**2)), lengths_s[-1]
    )


def _amplitude(precision: Array, demand: Demand, sigma: Array) -> float:
    """Return the dither of which one window has no more than this ``sigma`` in any parameter."""
    return float(np.max(precision / (sigma * np.sqrt(demand.window_s))))


def _longest_interval(precision: Array, demand: Demand, total_m: float) -> float:
    wanted = demand.sigma**2
    noise = precision**2 / (total_m**2 * demand.window_s)
    return float(np.min(wanted**2 / (demand.drift_rate**2 * (wanted + noise))))


def _variance_before(precision: Array, demand: Demand, total_m: float, interval_s: float) -> Array:
    walk = demand.drift_rate**2 * interval_s
    noise = precision**2 / (total_m**2 * demand.window_s)
    return np.asarray(0.5 * (walk + np.sqrt(walk**2 + 4.0 * walk * noise)))


def _without_pause(precision: Array, demand: Demand) -> float:
    """Return the weakest dither that, without pause, holds what is asked for or nearly the best.

    Each of its windows tells what one alone must.
    """
    best = _variance_before(precision, demand, demand.budget_m, demand.window_s)
    allowed = np.maximum(demand.sigma**2, NEARLY_BEST**2 * best)
    noise = allowed**2 / (demand.drift_rate**2 * demand.window_s) - allowed
    of_window = np.minimum(np.sqrt(noise), demand.window_sigma)
    return min(_amplitude(precision, demand, of_window), demand.budget_m)


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
    adds.
    """
    lines = [*chosen, frequency]
    for i, first in enumerate(lines):
        for second in lines[i:]:
            for third in lines:
                if third in (first, second):
                    continue
                product = first + second - third
                others = [line for line in lines if line not in (first, second, third)]
                if any(abs(product - line) < within_hz for line in others):
                    return True
    return False
