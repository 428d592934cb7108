"""Compare telemetry before and after a swap.

Numbers are from docs/results/reliability.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.estimation.residual import Residual, ResidualLevel
from service.records.operations import ProbationFinding, Verdict

Array = NDArray[np.float64]

REFERENCE_PERIOD_S = 4.0
"""Telemetry before the swap that the loop is compared with."""

DECISION_PERIOD_S = 4.0
"""Telemetry with the new matrix after which a moderate change is decided. A gust of one second is a
quarter of it, so the median does not see it."""

LARGE_CHANGE_PERIOD_S = 2.0
"""Time for which a large change must last before an early decision: longer than a gust."""

LARGE_CHANGE_SHARE = 0.8
"""Share of the parts of that time that must show it; a gust of a second fills 0.6 of them."""

RESIDUAL_SIGMAS = 3.0
"""Noise of the median, in σ, that a change of the residual must exceed in addition to
``WORSE_POWER_RATIO``. With
``WORSE_POWER_RATIO`` itself, one to three σ, fewer than one healthy swap in 5,000 exceeds both."""

WORSE_POWER_RATIO = 1.21
"""Residual power that is worse, 1.1 in RMS, if nothing were known to vary."""

MAX_WORSE_POWER_RATIO = 1.96
"""Residual power, 1.4 in RMS, that is worse however noisy the loop was before the swap: a gust in
the few seconds before raises the measured noise. Of 200 healthy swaps, gusts and seeing that
doubles included, none had more than 1.4 (1.18 in RMS)."""

MODE_SIGMAS = 4.5
"""The same of single modes: the worst of hundreds is looked at."""

WORSE_MODE_POWER_RATIO = 1.7
"""Power of a mode's steps that is worse: of hundreds of modes the one that a good matrix makes
worst has 1.6."""

EARLY_POWER_RATIO = 6.25
"""Power ratio, 2.5 in RMS, that is acted on as soon as it has lasted. A gust that raises the
residual 1.6 times makes 2.6 in power, and seeing that doubles in 10 s another 1.3."""

DIVERGED_POWER_RATIO = 9.0
"""Power of all slopes over that before that is acted on in ``DIVERGED_PARTS`` parts. Single modes
have no such limit: a vibration of tip and tilt that raises the residual 1.6 times raises the steps
of these two modes up to 30 times."""

DIVERGED_PARTS = 3

WORSE_MEDIAN_POWER_RATIO = 4.0
"""Power of the steps of the median mode: seeing changes it by half in three seconds."""

WORSE_SLOPES_POWER_RATIO = 6.0
"""Power of all slopes: seeing that doubles within three seconds makes it 3.2."""

WORSE_RING_POWER_RATIO = 6.0
"""Power of the outer ring over that of the mirror inside of it."""

GROUP_S = 0.5
"""Parts of so much time are summed for the decision: a ringing mode and a slow loop vary much from
part to part, and the median of parts would be far below their mean."""

MEDIAN_NOISE_RATIO = 1.25
"""1 σ of a median of independent values over that of their mean."""

NOISE_LENGTHS = (1, 2)
"""Groups from whose scatter the noise of one is measured. Where turbulence or vibrations are
correlated for longer than a group, the sum of two scatters more than independent groups would, and
the larger estimate counts."""

PRIOR_SCATTER = 0.2
"""1 σ of the logarithm of power in a group that is assumed before any is measured; 0.1 to 0.25 were
measured (docs/results/reliability.md)."""

PRIOR_VALUES = 4
"""Measured values that this assumption counts for."""

MIN_SCATTER = 0.1
"""The same of the residual, at least: turbulence is never steadier."""

MIN_MODE_SCATTER = 0.05
"""The same of a mode's steps: white noise has 0.06 in a group of 500 frames."""

SLOPES, OUTER, INNER = -3, -2, -1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """Sums over some frames of one matrix."""

    n_frames: float
    power: Array
    """``(n_modes + 3,)`` of squares: steps of each mode, metres²; slopes, ring, mirror inside."""

    residual: Residual | None = None
    """Residual as the reference matrix measures it; None if the matrix is unknown or there were no
    frames."""

    peak: float = 0.0
    """Largest sum of squares of one frame's slopes."""

    def plus(self, other: Part) -> Part:
        """Return the sums over both."""
        residual = other.residual
        return Part(
            n_frames=self.n_frames + other.n_frames,
            power=self.power + other.power,
            residual=self.residual if residual is None else residual.plus(self.residual),
            peak=max(self.peak, other.peak),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Before:
    """Telemetry under the matrix before."""

    id: str
    modes: NDArray[np.intp]
    """Modes in the loop with it."""

    part_s: float
    """Length of a part, seconds."""

    power: Array
    """``(n_modes + 3,)`` median over the last groups of the power per frame, as in a part."""

    mode_sigma: float
    """1 σ of the logarithm of a mode's power in a group, what all modes have in common taken
    out."""

    residual_sigma: float
    """The same of the residual, seeing taken out."""

    n_groups: int
    """Groups that the median is of."""

    level: ResidualLevel | None = None
    """Level of the residual; None if unknown."""

    peak: float = 0.0
    """Largest sum of squares of one frame's slopes."""

    @classmethod
    def of(
        cls, cm_id: str, parts: tuple[Part, ...], modes: NDArray[np.intp], part_s: float
    ) -> Before:
        """Return the reference from these parts of a matrix that controls these modes."""
        groups = group_parts(parts, part_s)
        n_recent = min(max(round(REFERENCE_PERIOD_S / GROUP_S), 2), len(groups))
        powers = _powers(groups)
        power = np.asarray(np.median(powers[-n_recent:], axis=0))
        moving = modes[power[modes] > 0.0]
        # A mode may rest in a group and move in the median of all.
        logs = np.log(np.maximum(powers[:, moving] / power[moving], 1e-30))
        if logs.size:
            logs -= np.median(logs, axis=1, keepdims=True)
        level = ResidualLevel.of(_residuals(groups), n_recent)
        residual_logs = np.zeros((0, 1)) if level is None else level.log_ratios[:, None]
        return cls(
            id=cm_id,
            modes=moving,
            part_s=part_s,
            power=power,
            mode_sigma=measure_sigma(logs, MIN_MODE_SCATTER),
            residual_sigma=measure_sigma(residual_logs, MIN_SCATTER, lower_half=True),
            n_groups=n_recent,
            level=level,
            peak=max(part.peak for part in parts),
        )

    def noise(self, sigma: float, n_groups: int) -> float:
        """Return 1 σ of how the median of so many groups differs from that before."""
        return MEDIAN_NOISE_RATIO * sigma * float(np.sqrt(1.0 / n_groups + 1.0 / self.n_groups))


def measure_sigma(logs: Array, min_sigma: float, *, lower_half: bool = False) -> float:
    """Return 1 σ of ``logs`` ``(n_groups, n)`` in one group, correlation between groups included.

    The interquartile range is used, which a gust in a tenth of the time does not change; with
    ``lower_half`` only the half below the median, which a gust in a third of it does not.
    """
    found = PRIOR_SCATTER * PRIOR_SCATTER
    for length in NOISE_LENGTHS:
        n = len(logs) // length
        if n < 2 or not logs.shape[1]:
            continue
        means = logs[len(logs) - n * length :].reshape(n, length, -1).mean(axis=1)
        low, middle, high = np.quantile(means - np.median(means, axis=0), (0.25, 0.5, 0.75))
        spread = 2.0 * (middle - low) if lower_half else high - low
        # 1.349 σ is the interquartile range of a normal distribution. The variance of a mean of
        # independent groups, times their number, is that of one group.
        square = length * (float(spread) / 1.349) ** 2
        n_values = n * logs.shape[1]
        # The prior is for short histories, whose scatter is hardly known.
        mixed = (n_values * square + PRIOR_VALUES * PRIOR_SCATTER**2) / (n_values + PRIOR_VALUES)
        found = mixed if length == 1 else max(found, mixed)
    return max(float(np.sqrt(found)), min_sigma)


def group_parts(parts: tuple[Part, ...], part_s: float) -> tuple[Part, ...]:
    """Return the sums over groups of parts, the newest whole; an incomplete first one is left out.

    Fewer parts than one group are summed as they are.
    """
    size = max(round(GROUP_S / part_s), 1)
    first = len(parts) % size if len(parts) >= size else 0
    groups = [parts[k : k + size] for k in range(first, len(parts), size)]
    return tuple(reduce(Part.plus, group) for group in groups)


def compare_telemetry(
    before: Before,
    parts: tuple[Part, ...],
    modes: NDArray[np.intp],
    after_id: str,
    *,
    decides: bool,
) -> ProbationFinding:
    """Return the judgement on a matrix from its telemetry; ``modes`` are in the loop with both.

    Every quantity is a series of power ratios. ``decides`` compares the median of all groups of
    parts with a limit that includes the measured noise; otherwise only what has lasted in most
    parts and is several times larger counts, and what diverges. A mode's power is compared with its
    own; what all modes have in common is taken out, unless it has become less: then a mode that has
    not is no worse.
    """
    looked = _Look(n_last=max(round(LARGE_CHANGE_PERIOD_S / before.part_s), 2), decides=decides)
    series = group_parts(parts, before.part_s) if decides else parts
    after = _powers(series)
    moving = modes[np.median(after, axis=0)[modes] > 0.0]
    if len(moving) == 0:
        return not_compared(before.id, after_id, "no mode is in the loop with both, and moves")
    grown = np.log(np.maximum(after[:, moving], 1e-40) / before.power[moving])
    common = np.median(grown, axis=1)
    single = grown - np.maximum(common, 0.0)[:, None]
    worst = int(np.argmax(looked.value(single)))
    noise = before.noise(before.mode_sigma, len(series))
    limit = float(np.log(WORSE_MODE_POWER_RATIO)) + MODE_SIGMAS * noise
    grounds = [
        looked.ground(
            f"mode {moving[worst]} moves {{:.2f}} times as much, against all modes,",
            single[:, worst],
            limit,
        ),
        looked.ground(
            "the median mode moves {:.2f} times as much", common, np.log(WORSE_MEDIAN_POWER_RATIO)
        ),
        looked.ground(
            "all slopes are {:.2f} times as large",
            _log_growth(before.power, after, SLOPES),
            np.log(WORSE_SLOPES_POWER_RATIO),
            diverged=float(np.log(DIVERGED_POWER_RATIO)),
        ),
    ]
    residual = None
    if before.level is not None:
        logs = before.level.log_ratios_of(_residuals(series), moving)
        if len(logs):
            noise = before.noise(before.residual_sigma, len(logs))
            residual = looked.ground(
                "the residual, seeing taken out, is {:.2f} times as large",
                logs,
                min(
                    np.log(WORSE_POWER_RATIO) + RESIDUAL_SIGMAS * noise,
                    np.log(MAX_WORSE_POWER_RATIO),
                ),
            )
            grounds.append(residual)
    ring = None
    if min(before.power[OUTER], before.power[INNER]) > 0.0 and after[:, [OUTER, INNER]].all():
        logs = _log_growth(before.power, after, OUTER) - _log_growth(before.power, after, INNER)
        ring = looked.ground(
            "the outer ring moves {:.2f} times as much", logs, np.log(WORSE_RING_POWER_RATIO)
        )
        grounds.append(ring)
    lost = before.level is not None and before.level.lost(_residuals(parts))
    worse = lost or any(ground.worse for ground in grounds)
    return ProbationFinding(
        verdict=Verdict.WORSE if worse else Verdict.AS_GOOD,
        before=before.id,
        after=after_id,
        text=_in_words(grounds, before.id, lost=lost),
        mode=int(moving[worst]),
        mode_ratio=grounds[0].rms,
        limit=grounds[0].limit,
        common_ratio=grounds[1].rms,
        slopes_ratio=grounds[2].rms,
        lost=lost,
        residual_ratio=None if residual is None else residual.rms,
        residual_limit=None if residual is None else residual.limit,
        ring_ratio=None if ring is None else ring.rms,
    )


class _Ground(NamedTuple):
    """One number that a verdict rests on; all of them are kept in the finding."""

    worse: bool
    words: str
    rms: float
    """RMS over that before: the median of all parts, or what the last ones have in common."""

    limit: float
    """RMS."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Look:
    """Rule for evaluating a series of power ratios: for the decision, or for an early one."""

    n_last: int
    """Parts that a large change must have lasted."""

    decides: bool

    def value(self, logs: Array) -> Array:
        """Return the median; before the decision what most of the last parts exceed."""
        if self.decides:
            return np.asarray(np.median(logs, axis=0))
        if len(logs) < self.n_last:
            # Too few parts: a value below any limit, whose exponential is still finite.
            return np.full(logs.shape[1:], -40.0)
        return np.asarray(np.quantile(logs[-self.n_last :], 1.0 - LARGE_CHANGE_SHARE, axis=0))

    def ground(
        self, words: str, logs: Array, limit: float, *, diverged: float | None = None
    ) -> _Ground:
        """Return one quantity's verdict from ``logs`` ``(n,)`` of its power ratios."""
        value, newest = float(self.value(logs)), logs[-DIVERGED_PARTS:]
        if diverged is not None and len(newest) == DIVERGED_PARTS and newest.min() > diverged:
            value, limit = float(newest.min()), diverged
        else:
            # however noisy the loop was: no healthy one is worse by a factor of several for so long
            early = float(np.log(EARLY_POWER_RATIO))
            limit = min(limit, early) if self.decides else early
        # Half, because the logarithms are of powers and the finding states RMS.
        rms = float(np.exp(0.5 * max(value, -40.0)))
        return _Ground(value > limit, words.format(rms), rms, float(np.exp(0.5 * limit)))


def _in_words(grounds: list[_Ground], before: str, *, lost: bool) -> str:
    """Return the one number that an operator needs: the farthest beyond its limit, or nearest."""
    worse = [ground for ground in grounds if ground.worse]
    one = max(worse or grounds, key=lambda ground: ground.rms / ground.limit)
    text = f"{one.words} as with {before} ({one.limit:.2f} is too much)"
    if lost:
        return f"the loop is lost: {text}" if worse else "the loop is lost: it corrects nothing"
    return text if worse else f"as good: at most, {text}"


def _powers(parts: tuple[Part, ...]) -> Array:
    """Return ``(n_parts, n_modes + 3)`` power per frame."""
    return np.array([part.power / part.n_frames for part in parts])


def _log_growth(before: Array, after: Array, column: int) -> Array:
    """Return the logarithm of a power over that before, one per part."""
    if before[column] <= 0.0:
        return np.zeros(len(after))
    return np.asarray(np.log(np.maximum(after[:, column], 1e-40) / before[column]))


def _residuals(parts: tuple[Part, ...]) -> tuple[Residual, ...]:
    return tuple(part.residual for part in parts if part.residual is not None)


def not_compared(before: str, after: str, why: str) -> ProbationFinding:
    """Return that nothing is known of these two, and why."""
    return ProbationFinding(verdict=Verdict.UNKNOWN, before=before, after=after, text=why)
