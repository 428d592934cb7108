"""Choice of a dither: modes, amplitude, length of windows, frequencies.

**Modes.** Far from registration the response to a mode of low spatial frequency still resembles
the model, so a fit converges from there. Near registration a mode of high spatial frequency is
more precise. All modes then determine a shift equally well, but one of high azimuthal order
determines a rotation twice as well as its neighbours, and one of high radial order the
magnification. Without a known registration the loop is stable with a few modes at most.

**Amplitude and interval.** The dither is as weak and as rare as the required σ of α allows. The
precision κ of a window, ``σ = κ / (A sqrt(T))`` for a dither of RMS A over T seconds, is taken
from a table at first and then from the windows themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement, pairwise

import numpy as np
from numpy.typing import NDArray

from service.model.interaction import Linearisation
from service.records.operations import Schedule

Array = NDArray[np.float64]

BURST_PRECISION_RATIO = 2.0
"""Required σ over the σ of one burst alone, if the budget allows it."""

MAX_SIGMA_RATIO = 1.1
"""Largest σ over the smallest that the budget allows, if α drifts too fast for the required σ."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitherRequirement:
    """Required σ of α, and the budget of the dither.

    Numeric units are subapertures for the shifts, radians, and a ratio.
    """

    sigma: Array
    """``(4,)`` largest 1 σ of α at any time, numeric units, model error not included."""

    drift_rate: Array
    """``(4,)`` 1 σ of the random walk of α after one second (flexure), numeric units."""

    budget_m: float
    """Largest RMS of all lines together on the mirror, metres OPD; never exceeded."""

    window_s: float
    """Telemetry of one burst, in one window or several, seconds."""

    window_sigma: Array = field(default_factory=lambda: np.full(4, np.inf))
    """``(4,)`` largest 1 σ of one window of a dither without pauses, numeric units."""

    longest_s: float = np.inf
    """Longest interval between the starts of two bursts, however stable α is, seconds."""


def compute_schedule(precision: Array, requirement: DitherRequirement) -> Schedule:
    """Return the weakest schedule that keeps ``requirement.sigma`` within the budget.

    ``precision`` ``(4,)`` is κ of ``σ = κ / (A sqrt(T))``, in numeric units times m sqrt(s), as
    measured on the last windows. Bursts with σ² = R every Δ seconds keep a random walk of rate q
    at a variance P before each update with ``P² - q²Δ P - q²Δ R = 0``, the steady state of a
    Kalman filter. So ``Δ = P² / (q² (P + R))``.

    Frequent weak bursts cost less than rare strong ones, but leave no pauses, and no burst is a
    useful estimate by itself. Each burst is therefore made ``BURST_PRECISION_RATIO`` times as
    precise as required, at ``sqrt(1 + BURST_PRECISION_RATIO²)`` times the least possible cost. If
    α drifts too fast for any pause, the dither is no stronger than needed for a σ within
    ``MAX_SIGMA_RATIO`` of the smallest that the budget allows.
    """
    burst_sigma = requirement.sigma / BURST_PRECISION_RATIO
    total_m = min(_amplitude(precision, requirement, burst_sigma), requirement.budget_m)
    interval_s = min(_longest_interval(precision, requirement, total_m), requirement.longest_s)
    if interval_s < requirement.window_s:
        interval_s = requirement.window_s
        total_m = _continuous_amplitude(precision, requirement)
    before = _variance_before_update(precision, requirement, total_m, interval_s)
    return Schedule(
        total_m=total_m,
        interval_s=interval_s,
        sigma=np.sqrt(before),
        sufficient=bool(np.all(before <= requirement.sigma**2 * (1.0 + 1e-9))),
    )


def choose_burst_s(
    precision: Array, requirement: DitherRequirement, lengths_s: tuple[float, ...]
) -> float:
    """Return the shortest burst that reaches the required σ alone, on the whole budget, seconds.

    The burst is one of ``lengths_s``, which are in rising order. If none reaches it, the longest
    useful one is returned.
    """
    for length_s, longer_s in pairwise(lengths_s):
        noise = precision**2 / (requirement.budget_m**2 * length_s)
        if np.all(noise <= requirement.sigma**2):
            return length_s
        # A burst in which α drifts further than the noise of the estimate gains nothing over two
        # shorter ones: the filter follows the drift, a fit over the burst averages it.
        lacking = noise > requirement.sigma**2
        walk = requirement.drift_rate**2 * longer_s
        if np.all(walk[lacking] > (noise * length_s / longer_s)[lacking]):
            return length_s
    return lengths_s[-1]


def choose_window_s(
    precision: Array, requirement: DitherRequirement, usable: Array, lengths_s: tuple[float, ...]
) -> float:
    """Return the shortest window whose estimate is not biased by noise, seconds.

    The window is one of ``lengths_s``, which are in rising order; the whole budget is assumed. If
    the σ of one window exceeds ``usable`` ``(4,)``, the noise in the regressors biases the fit.
    Otherwise short windows are as precise together as a long one, they give the first estimate
    sooner, and a lost frame or a swapped matrix costs less telemetry.
    """
    noise = [precision**2 / (requirement.budget_m**2 * length) for length in lengths_s]
    return next(
        (s for s, n in zip(lengths_s, noise, strict=True) if np.all(n <= usable**2)), lengths_s[-1]
    )


def _amplitude(precision: Array, requirement: DitherRequirement, sigma: Array) -> float:
    """Return the RMS of a dither of which one burst reaches ``sigma`` in all parameters, metres."""
    return float(np.max(precision / (sigma * np.sqrt(requirement.window_s))))


def _longest_interval(precision: Array, requirement: DitherRequirement, total_m: float) -> float:
    required = requirement.sigma**2
    noise = precision**2 / (total_m**2 * requirement.window_s)
    return float(np.min(required**2 / (requirement.drift_rate**2 * (required + noise))))


def _variance_before_update(
    precision: Array, requirement: DitherRequirement, total_m: float, interval_s: float
) -> Array:
    walk = requirement.drift_rate**2 * interval_s
    noise = precision**2 / (total_m**2 * requirement.window_s)
    return np.asarray(0.5 * (walk + np.sqrt(walk**2 + 4.0 * walk * noise)))


def _continuous_amplitude(precision: Array, requirement: DitherRequirement) -> float:
    """Return the RMS of the weakest dither without pauses that is precise enough, metres.

    The filtered σ is the required one, or within ``MAX_SIGMA_RATIO`` of the best possible. The σ
    of each window is at most ``requirement.window_sigma``.
    """
    budget_m, window_s = requirement.budget_m, requirement.window_s
    best = _variance_before_update(precision, requirement, budget_m, window_s)
    allowed = np.maximum(requirement.sigma**2, MAX_SIGMA_RATIO**2 * best)
    noise = allowed**2 / (requirement.drift_rate**2 * window_s) - allowed
    window_sigma = np.minimum(np.sqrt(noise), requirement.window_sigma)
    return min(_amplitude(precision, requirement, window_sigma), budget_m)


def place_lines(
    wanted_hz: tuple[float, ...],
    avoid_hz: tuple[float, ...],
    *,
    clearance_hz: float,
    step_hz: float,
    range_hz: tuple[float, float],
) -> tuple[float, ...] | None:
    """Return dither frequencies as close to ``wanted_hz`` as vibrations allow; None if impossible.

    Every line keeps ``clearance_hz`` from all of ``avoid_hz`` and from the other lines. No line is
    within four ``step_hz`` of an intermodulation product ``f_i + f_j - f_k`` of others. Each line
    is a multiple of ``step_hz``, so that a window holds whole periods and lines do not leak into
    each other.
    """
    low, high = (np.ceil(range_hz[0] / step_hz), np.floor(range_hz[1] / step_hz))
    grid = step_hz * np.arange(low, high + 1)
    # Lines are placed one after the other, each on the nearest free frequency: a vibration moves
    # the lines next to it and leaves the others where they are.
    chosen: list[float] = []
    for wanted in wanted_hz:
        by_distance = grid[np.argsort(np.abs(grid - wanted), kind="stable")]
        taken = (*avoid_hz, *chosen)
        free = (
            float(f)
            for f in by_distance
            if all(abs(f - t) >= clearance_hz for t in taken)
            and not _is_intermodulation(float(f), chosen, 4.0 * step_hz)
        )
        found = next(free, None)
        if found is None:
            return None
        chosen.append(found)
    return tuple(chosen)


def _is_intermodulation(frequency: float, chosen: list[float], within_hz: float) -> bool:
    """Return True if a line and those chosen have an intermodulation product on one of them.

    The response of a pyramid is odd in the wavefront. The lowest order of its nonlinearity is the
    third, which adds lines at ``f_i + f_j - f_k``. The chosen lines are clear of their own
    products already, so only products that involve the new line, or fall on it, are checked.
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


N_MODES_ABOVE_LOOP = 100
"""Number of modes above the controlled ones that may be dithered.

Further up in the basis the models of mirrors differ more from the mirrors themselves.
"""


def compute_information(linearisation: Linearisation) -> Array:
    """Return the Fisher information of each mode on α, ``(n_modes, 4, 4)``, per m² and unit noise.

    The slope noise is white with σ = 1. The gain of each mode (optical gain) is a free parameter
    of the fit, so only changes of shape count: ``J^T J`` with ``J_k = (I - P) dD/dα_k``, where P
    projects on the mode's own response.
    """
    response, derivatives = linearisation.matrix, linearisation.derivatives
    n_modes = response.shape[1]
    norm = _column_products(response, response)
    along = np.array([_column_products(response, derivative) for derivative in derivatives])
    full = np.empty((n_modes, len(derivatives), len(derivatives)))
    for k, one in enumerate(derivatives):
        for j, other in enumerate(derivatives[: k + 1]):
            full[:, k, j] = full[:, j, k] = _column_products(one, other)
    return np.asarray(full - np.einsum("km,lm->mkl", along, along) / norm[:, None, None])


def _column_products(one: NDArray[np.float32], other: NDArray[np.float32]) -> Array:
    """Return the scalar product of each pair of equal columns, ``(n_modes,)``."""
    return np.asarray(np.einsum("sm,sm->m", one, other), dtype=np.float64)


def select_informative_modes(
    information: Array, candidates: Sequence[int], n: int, wanted: Array
) -> tuple[int, ...]:
    """Return the ``n`` modes whose common information comes closest to every wanted σ ``(4,)``.

    The set minimises the largest ratio of σ to ``wanted``. It is found by exchange: starting from
    evenly spread candidates, each mode in turn is replaced by the best other one until no
    exchange is better. Trying all sets is out of the question: 100 candidates have 4e6 sets of 4.
    """
    pool = [mode for mode in candidates if mode < len(information)]
    if len(pool) <= n:
        return tuple(pool)
    scaled = information * np.outer(wanted, wanted)
    chosen = [pool[k] for k in np.linspace(0, len(pool) - 1, n).round().astype(int)]
    # Variances are compared in units of the wanted ones, so that all parameters count alike.
    cost, improving = float(_worst_variance_ratio(scaled[chosen].sum(axis=0))), True
    while improving:
        improving = False
        for place in range(n):
            kept = chosen[:place] + chosen[place + 1 :]
            others = [mode for mode in pool if mode not in kept]
            costs = _worst_variance_ratio(scaled[kept].sum(axis=0) + scaled[others])
            best = int(np.argmin(costs))
            # The small margin keeps two equal sets from being exchanged for ever.
            if costs[best] < cost * (1.0 - 1e-6):
                chosen, cost, improving = [*kept, others[best]], float(costs[best]), True
    return tuple(sorted(chosen))


def _worst_variance_ratio(scaled: Array) -> Array:
    """Return the largest ratio of variance to the wanted one, of sets ``(..., 4, 4)``."""
    power = np.diagonal(scaled, axis1=-2, axis2=-1)
    unit = np.sqrt(power[..., :, None] * power[..., None, :])
    # The small diagonal keeps a set that is blind to a combination of parameters invertible; its
    # variance is then enormous, and the exchange leaves it.
    correlation = scaled / unit + 1e-12 * np.eye(scaled.shape[-1])
    variances = np.diagonal(np.linalg.inv(correlation), axis1=-2, axis2=-1) / power
    return np.asarray(variances.max(axis=-1))


# --- dither of the open loop, for the acquisition of an unknown registration

MAX_LINES = 8
"""Largest number of modes dithered at once with the loop open."""

MIN_LINES = 3
"""Smallest number; two modes neither determine four parameters nor show whether they agree."""

LINE_BAND_RATIO = (0.2, 0.4)
"""Range of dither frequencies over the frame rate.

Below it turbulence carried by the wind biases the response; towards half the frame rate no room
is left for the noise to be measured on both sides of a line.
"""

CLEARANCE_HZ = 21.0
"""Smallest distance between two lines; the noise of each is measured within 20 Hz of it."""

FIRST_LOOP_MODES = 150
"""Number of modes with which the loop is first closed.

Such a loop is stable with a registration that is known to a few per cent.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Band:
    """Range of modes that is dithered with the loop open."""

    first: int
    """Lowest mode, of a basis in order of rising spatial frequency."""

    last: int
    """Highest mode, included."""

    floor: NDArray[np.float64]
    """``(4,)`` 1 σ of the model error with the loop open, numeric units. The uncorrected wavefront
    changes the response of the sensor, which the model does not contain."""


COARSE_BAND = Band(
    first=0,
    last=28,
    floor=np.array([0.06, 0.06, np.deg2rad(0.25), 0.025]),
)
"""Modes of low spatial frequency, with which a fit converges from the whole search range."""

FINE_BAND = Band(
    first=36,
    last=99,
    floor=np.array([0.02, 0.02, np.deg2rad(0.06), 0.008]),
)
"""Other modes of higher spatial frequency, which confirm the first fit three times as precisely."""


def spread_modes(band: Band, n_modes: int, n_lines: int) -> tuple[int, ...]:
    """Return modes to dither, spread evenly over a band.

    For a basis shorter than ``FINE_BAND`` both bands are scaled down together. They have no mode in
    common as long as the basis has twice as many modes as there are lines, so that the second fit
    remains independent of the first.
    """
    scale = min(1.0, (n_modes - 1) / FINE_BAND.last)
    first, last = np.ceil(scale * band.first), np.floor(scale * band.last)
    spread = np.round(np.linspace(first, last, n_lines)).astype(int)
    return tuple(int(mode) for mode in np.unique(spread))


def spread_lines(frame_rate_hz: float, window_s: float, n_max: int) -> tuple[float, ...]:
    """Return as many dither frequencies as fit into the band, at most ``n_max``.

    Empty if fewer than ``MIN_LINES`` fit. Each has a whole number of periods in a window, and none
    is an intermodulation product of others.
    """
    low, high = (share * frame_rate_hz for share in LINE_BAND_RATIO)
    for n_lines in range(min(n_max, MAX_LINES), MIN_LINES - 1, -1):
        found = place_lines(
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

PRECISION_TABLE = (
    np.array(
        [
            [0.019, 0.019, np.deg2rad(0.084), 0.0042],
            [0.059, 0.059, np.deg2rad(0.37), 0.0074],
            [0.13, 0.13, np.deg2rad(0.53), 0.026],
        ]
    )
    * 1e-9
)
"""``(n_magnitudes, 4)`` κ of ``σ = κ / (A sqrt(T))``, numeric units times m sqrt(s).

Measured with four modes on the simulated diffractive telescope at 1 kHz: the larger of the values
of the design study and of docs/results/tracking.md.
"""

MEMORY_WINDOWS = 8.0
"""Number of windows after which the weight of a measured precision is 1/e.

With fewer the estimate scatters; with more it follows a change of the seeing too slowly.
"""

PRECISION_RATIO_RANGE = (0.05, 20.0)
"""Range of the precision of one window over that of the table; a window beyond it is an outlier."""


def look_up_precision(magnitude: float | None) -> Array:
    """Return κ ``(4,)`` of a star from the table, for use before the first window.

    An unknown magnitude counts as the faintest row. Beyond it κ is extrapolated from the last two
    rows, because the noise of a faint star keeps growing.
    """
    # κ is interpolated in its logarithm: photon noise is a power of the flux.
    m, logs = TABLE_MAGNITUDES, np.log(PRECISION_TABLE)
    star = m[-1] if magnitude is None else max(float(magnitude), m[0])
    row = min(int(np.searchsorted(m, star, side="right")) - 1, len(m) - 2)
    share = (star - m[row]) / (m[row + 1] - m[row])
    kappa: Array = np.exp(logs[row] + share * (logs[row + 1] - logs[row]))
    return kappa


def compute_precision_ratio(
    covariance: Array, total_m: float, window_s: float, magnitude: float | None
) -> Array:
    """Return κ ``(4,)`` of one window over κ of the table.

    Parameters
    ----------
    covariance
        ``(4, 4)`` covariance of the window's estimate, from its own scatter, numeric units.
    total_m
        RMS of all lines together as measured on the mirror, metres OPD.
    window_s
        Length of the window, seconds.
    magnitude
        Magnitude of the star; None if unknown.
    """
    kappa = np.sqrt(np.diag(covariance)) * total_m * np.sqrt(window_s)
    return np.asarray(np.clip(kappa / look_up_precision(magnitude), *PRECISION_RATIO_RANGE))


def update_mean_ratio(mean: Array | None, n_windows: int, ratio: Array) -> Array:
    """Return the forgetting quadratic mean of ``n_windows`` ratios after one more, ``(4,)``."""
    if mean is None or n_windows == 0:
        return ratio
    # A plain mean at first: with a constant share the first window would weigh too much.
    share = max(1.0 / (n_windows + 1), 1.0 / MEMORY_WINDOWS)
    return np.asarray(np.sqrt((1.0 - share) * mean**2 + share * ratio**2))
