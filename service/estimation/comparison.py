"""Compare telemetry before and after a swap.

Numbers are from docs/results/probation.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.estimation.residual import GROUP, MIN_PARTS, Residual, ResidualLevel, ratio, total_of

Array = NDArray[np.float64]

WORSE = 1.7
"""Power of a mode over its own before: less is not worth a swap, whatever is known of it. Of
hundreds of modes the one that a good matrix makes worst has 1.6 after three seconds."""

LASTING = 3
"""Parts in a row, two at least, in each of which a mode moves so much more: turbulence does that
for one. A loop that is being lost has no time for more: soon everything moves."""

SIGMAS = 4.5
"""Of a part's scatter beyond that: hundreds of modes are looked at thirty times."""

MIN_SCATTER = 0.1
"""Of the logarithm of a mode's power in one part."""

COMMON_WORSE = 4.0
"""Power of the steps of all modes, their median: seeing changes it by half in three seconds."""

SLOPES_WORSE = 6.0
"""Power of all slopes: seeing that doubles within three seconds makes it 3.2."""

RING_WORSE = 6.0
"""Power of the outer ring over that of the mirror inside of it."""

SLOW_PARTS = 10
"""Parts before slopes and ring are looked at: turbulence and vibrations are slow in them."""

SLOPES, OUTER, INNER = -3, -2, -1


class Verdict(StrEnum):
    """Outcome of a comparison."""

    AS_GOOD = "as-good"
    WORSE = "worse"
    UNKNOWN = "unknown"
    """It could not be made; the text says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbationFinding:
    """Telemetry with one matrix against telemetry with the one before."""

    verdict: Verdict
    before: str
    """Id of the matrix before."""

    after: str
    """Id of the one that is judged."""

    text: str
    """The numbers in words, or why there are none."""

    after_s: float = 0.0
    """Telemetry with it, seconds."""

    mode: int = -1
    """The one that has grown most against all others; -1: none was compared."""

    mode_ratio: float = 0.0
    """RMS of its steps over that before, less what all modes have in common."""

    limit: float = 0.0
    """Of that ratio: more is worse."""

    common_ratio: float = 0.0
    """RMS of the steps over those before: the median of all modes."""

    slopes_ratio: float = 0.0
    """RMS of all slopes over that before."""

    lost: bool = False
    """Whether the loop does no longer what a loop is for: without it the wavefront would be no
    worse."""

    residual_ratio: float | None = None
    """RMS of the residual, as both matrices read it, over that before, seeing taken out; as the one
    before reads it alone where nobody knows the numbers of the other; None: of neither."""

    residual_limit: float | None = None
    """Of that ratio: more is worse; None as above."""

    ring_ratio: float | None = None
    """RMS of the outer ring against the mirror inside, over that before; None: too few modes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """Sums over some frames of one matrix."""

    n_frames: float
    power: Array
    """``(n_modes + 3,)`` of squares: steps of each mode, metres²; slopes, ring, mirror inside."""

    residual: Residual | None = None
    """As the matrix reads it that is believed; None: it is not known, or no frame was looked at."""

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
    """In the loop with it."""

    n_parts: int
    power: Array
    """As in a part, per frame."""

    scatter: float
    """1 σ of the logarithm of a mode's power in one part, what all have in common taken out."""

    level: ResidualLevel | None = None
    """Of the residual; None: it is not known."""

    peak: float = 0.0
    """Largest sum of squares of one frame's slopes."""

    @classmethod
    def of(cls, cm_id: str, parts: tuple[Part, ...], modes: NDArray[np.intp]) -> Before:
        """Return what these parts of a matrix that controls these modes come to."""
        power = _mean(parts)
        moving = modes[power[modes] > 0.0]
        powers = np.array([part.power[moving] / part.n_frames for part in parts])
        logs = np.log(np.maximum(powers / power[moving], 1e-30))
        scatter = 0.0
        if logs.size:
            logs -= np.median(logs, axis=1, keepdims=True)
            scatter = 1.4826 * float(np.median(np.abs(logs)))
        return cls(
            id=cm_id,
            modes=moving,
            n_parts=len(parts),
            power=power,
            scatter=max(scatter, MIN_SCATTER),
            level=ResidualLevel.of(_residuals(parts)),
            peak=max(part.peak for part in parts),
        )


def compared(
    before: Before, parts: tuple[Part, ...], modes: NDArray[np.intp], after_id: str
) -> ProbationFinding:
    """Return what telemetry of a matrix says of it; ``modes`` are in the loop with both.

    A mode's power is compared with its own; what all have in common is taken out, unless it has
    become less: then a mode that has not is no worse. A mode is worse beyond ``WORSE`` times by
    ``SIGMAS`` of what the logarithm of its power scatters from part to part before, and in each of
    the last ``LASTING`` parts beyond ``WORSE``.
    """
    after = _mean(parts)
    moving = modes[after[modes] > 0.0]
    if len(moving) == 0:
        return not_compared(before.id, after_id, "no mode is in the loop with both, and moves")
    grown = np.log(after[moving] / before.power[moving])
    common = float(np.median(grown))
    single = grown - max(common, 0.0)
    worst = int(np.argmax(single))
    scatter = before.scatter * np.sqrt(1.0 / before.n_parts + 1.0 / len(parts))
    limit = float(np.log(WORSE) + SIGMAS * scatter)
    rings = single[worst] > limit and _lasts(before, parts, int(moving[worst]), max(common, 0.0))
    slopes = _log_ratio(before.power[SLOPES], after[SLOPES])
    ring = None
    edges = [power[k] for power in (before.power, after) for k in (OUTER, INNER)]
    if min(edges) > 0.0:
        ring = _log_ratio(edges[0] / edges[1], edges[2] / edges[3])
    slow = len(parts) >= SLOW_PARTS
    whole = _residual(before, parts, modes)
    lost = before.level is not None and before.level.lost(_residuals(parts))
    rms = [float(np.exp(0.5 * x)) for x in (single[worst], limit, common, slopes)]
    ring_rms = None if ring is None else float(np.exp(0.5 * ring))
    whole_rms = (None, None) if whole is None else tuple(float(np.sqrt(x)) for x in whole)
    grounds = [
        _Ground(
            bool(rings),
            f"mode {moving[worst]} moves {rms[0]:.2f} times as much, against all modes,",
            rms[0] / rms[1],
            rms[1],
        ),
        _ground("the median mode moves {:.2f} times as much", rms[2], COMMON_WORSE),
        _ground("all slopes are {:.2f} times as large", rms[3], SLOPES_WORSE, tells=slow),
    ]
    if whole is not None:
        words = "the residual, seeing taken out, is {:.2f} times as large"
        tells = len(parts) >= MIN_PARTS
        grounds.append(_ground(words, float(np.sqrt(whole[0])), whole[1], tells=tells))
    if ring_rms is not None:
        words = "the outer ring moves {:.2f} times as much"
        grounds.append(_ground(words, ring_rms, RING_WORSE, tells=slow))
    worse = lost or any(ground.worse for ground in grounds)
    text = _in_words(grounds, before.id, lost=lost)
    return ProbationFinding(
        verdict=Verdict.WORSE if worse else Verdict.AS_GOOD,
        before=before.id,
        after=after_id,
        text=text,
        mode=int(moving[worst]),
        mode_ratio=rms[0],
        limit=rms[1],
        common_ratio=rms[2],
        slopes_ratio=rms[3],
        lost=lost,
        residual_ratio=whole_rms[0],
        residual_limit=whole_rms[1],
        ring_ratio=ring_rms,
    )


class _Ground(NamedTuple):
    """One number that a verdict rests on; all of them are kept in the finding."""

    worse: bool
    words: str
    beyond: float
    """Over its limit."""

    limit: float
    """RMS."""


def _ground(words: str, rms: float, power_limit: float, *, tells: bool = True) -> _Ground:
    """Return an RMS against its limit, a power."""
    limit = float(np.sqrt(power_limit))
    return _Ground(tells and rms > limit, words.format(rms), rms / limit, limit)


def _in_words(grounds: list[_Ground], before: str, *, lost: bool) -> str:
    """Return the one number that an operator needs: the farthest beyond its limit, or nearest."""
    worse = [ground for ground in grounds if ground.worse]
    one = max(worse or grounds, key=lambda ground: ground.beyond)
    text = f"{one.words} as with {before} ({one.limit:.2f} is too much)"
    if lost:
        return f"the loop is lost: {text}" if worse else "the loop is lost: it corrects nothing"
    if worse:
        return text
    return f"as good: at most, {text}" if one.beyond <= 1.0 else f"as good: {text}, did not last"


def _lasts(before: Before, parts: tuple[Part, ...], mode: int, common: float) -> bool:
    """Return whether a mode moves more in each of the last parts, not only in one of them."""
    least = WORSE * np.exp(common) * before.power[mode]
    last = parts[-LASTING:]
    return len(last) > 1 and all(part.power[mode] > least * part.n_frames for part in last)


def _mean(parts: tuple[Part, ...]) -> Array:
    """Return the mean power per frame of all parts."""
    total = np.sum([part.power for part in parts], axis=0)
    return np.asarray(total / sum(part.n_frames for part in parts))


def _log_ratio(one: float, other: float) -> float:
    return float(np.log(other / one)) if min(one, other) > 0.0 else 0.0


def _residual(
    before: Before, parts: tuple[Part, ...], modes: NDArray[np.intp]
) -> tuple[float, float] | None:
    """Return power of the residual over that before, seeing taken out, and its limit."""
    level, after = before.level, total_of(_residuals(parts))
    if level is None or after is None:
        return None
    known = modes[modes < len(after.seen)]
    last = total_of(_residuals(parts[-GROUP:])) or after
    # it lasts: no single gust
    least = min(ratio(level.total, after, known), ratio(level.total, last, known))
    return least, level.limit(len(parts))


def _residuals(parts: tuple[Part, ...]) -> tuple[Residual, ...]:
    return tuple(part.residual for part in parts if part.residual is not None)


def not_compared(before: str, after: str, why: str) -> ProbationFinding:
    """Return that nothing is known of these two, and why."""
    return ProbationFinding(verdict=Verdict.UNKNOWN, before=before, after=after, text=why)
