"""Whether the loop is worse with a matrix than with the one before, seeing taken into account.

A matrix at the edge of stability makes a few modes ring near a tenth of the frame rate, while
slopes and wavefront error hardly change: a pyramid that saturates holds what runs away. So every
mode's steps are compared with its own under the matrix before. A step of the integrator is
``g R s``, the residual as the loop sees it; its change over ``LAG`` frames keeps what rings and
leaves turbulence out. What all modes have in common, their median, is seeing, light, optical gain.

Numbers are from docs/results/probation.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from service.telemetry.frames import FrameBlock
from service.telemetry.health import EdgeWatch

Array = NDArray[np.float64]

WITHIN_S = 3.0
"""Telemetry with the new matrix that is looked at; the verdict comes at the latest then."""

PART_S = 0.1
"""Between two looks."""

LONGEST_PART_S = 0.2
"""A block that lasts longer makes more than one part."""

LEAST_PART = 50
"""Frames: fewer scatter too much to be looked at."""

LEAST_BEFORE_S = 0.8
"""Telemetry with the matrix before; with less nothing is said."""

SETTLING_S = 0.03
"""After a swap the loop goes over from one equilibrium to the other."""

LAG = 5
"""Frames: what rings at a tenth of the frame rate shows twice, what is slow not at all. An optical
gain of a half makes loops ring at a twentieth; with 3 it shows half as well, with 8 none at an
eighth."""

WORSE = 1.7
"""Power of a mode over its own before: less is not worth a swap, whatever is known of it. Of
hundreds of modes the one that a good matrix makes worst has 1.6 after three seconds."""

LASTING = 3
"""Parts in a row, two at least, in each of which a mode moves so much more: turbulence does that
for one. A loop that is being lost has no time for more: soon everything moves."""

SIGMAS = 4.5
"""Of a part's scatter beyond that: hundreds of modes are looked at thirty times."""

LEAST_SCATTER = 0.1
"""Of the logarithm of a mode's power in one part."""

COMMON_WORSE = 4.0
"""Power of the steps of all modes, their median: seeing changes it by half in three seconds."""

SLOPES_WORSE = 6.0
"""Power of all slopes: seeing that doubles within three seconds makes it 3.2."""

RING_WORSE = 6.0
"""Power of the outer ring over that of the mirror inside of it."""

SLOW_PARTS = 10
"""Parts before slopes and ring are looked at: turbulence and vibrations are slow in them."""

_REACH = LAG + 1
_SAMPLED = 4
"""One of so many frames is looked at for the power of all slopes."""

_SPARSE = 7
"""One of so many frames is looked at for a dither: odd, or a sine of half or a quarter of the frame
rate may be 0 in all of them."""

_SLOPES, _OUTER, _INNER = -3, -2, -1


class Verdict(StrEnum):
    """What came of a comparison."""

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

    ring_ratio: float | None = None
    """RMS of the outer ring against the mirror inside, over that before; None: too few modes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """Sums over some frames of one matrix."""

    n_frames: float
    power: Array
    """``(n_modes + 3,)`` of squares: steps of each mode, metres²; slopes, ring, mirror inside."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Before:
    """What there is of the matrix before."""

    id: str
    modes: NDArray[np.intp]
    """In the loop with it."""

    n_parts: int
    power: Array
    """As in a part, per frame."""

    scatter: float
    """1 σ of the logarithm of a mode's power in one part, what all have in common taken out."""

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
            scatter=max(scatter, LEAST_SCATTER),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """Telemetry with the matrix in use and with the one before: feed it blocks with ``observe``."""

    cm_id: str | None = None
    """Of the last block."""

    modes: NDArray[np.intp] | None = None
    """In the loop, by the last block."""

    tail: FrameBlock | None = None
    """The last frames, as many as a step and its change reach back."""

    n_skipped: int = 0
    """Frames since the swap that do not count yet."""

    parts: tuple[Part, ...] = ()
    """Of the matrix in use, oldest first, as many as may count; the last one is under way."""

    before: Before | None = None
    """None: nothing is being compared."""

    dithered: frozenset[int] = frozenset()
    """Modes that a dither has moved: they do not count."""

    found: ProbationFinding | None = None
    """Of the last swap; None: it is being looked at, or there was none."""


def begun_anew(state: Comparison, why: str) -> Comparison:
    """Return a comparison that knows nothing; one that was under way ends without a verdict."""
    found = state.found
    if state.before is not None and state.cm_id is not None:
        found = _unknown(state.before.id, state.cm_id, why)
    return Comparison(cm_id=state.cm_id, found=found)


def observe(
    state: Comparison,
    block: FrameBlock,
    modes: NDArray[np.intp],
    lines_hz: tuple[float, ...] = (),
    edge: EdgeWatch | None = None,
) -> Comparison:
    """Add a block of a closed loop of these modes.

    ``lines_hz`` are those of the dither that plays; frames of a dither without lines do not count.
    A long block makes several parts: they scatter as those do that come one by one.
    """
    n_parts = int(np.ceil(block.n_frames * block.dt_ns * 1e-9 / LONGEST_PART_S))
    cuts = np.linspace(0, block.n_frames, max(n_parts, 1) + 1).astype(int).tolist()
    for start, stop in pairwise(cuts):
        state = _observed(state, block.rows(start, stop), modes, lines_hz, edge)
    return state


def _observed(
    state: Comparison,
    block: FrameBlock,
    modes: NDArray[np.intp],
    lines_hz: tuple[float, ...],
    edge: EdgeWatch | None,
) -> Comparison:
    if block.cm_id != state.cm_id or (state.tail and block.session != state.tail.session):
        state = _swapped(state, block)
    tail, state = state.tail, replace(state, modes=modes)
    some = None if block.dither_m is None else block.dither_m[::_SPARSE].any(axis=0)
    moved = () if some is None else np.flatnonzero(some).tolist()
    n_modes = int(modes[-1]) + 1
    rows = block.commands_m[:, :n_modes]
    if tail is not None and block.follows(tail):
        rows = np.concatenate((tail.commands_m[:, :n_modes], rows))
    state = replace(state, tail=block.last(_REACH) if block.n_frames >= _REACH else None)
    if moved and not lines_hz:
        return state
    if not state.dithered.issuperset(moved):
        state = replace(state, dithered=state.dithered.union(moved))
    if state.n_skipped < SETTLING_S * 1e9 / block.dt_ns:
        return replace(state, n_skipped=state.n_skipped + block.n_frames)
    steps = _changes(rows)
    lines = tuple(f * block.dt_ns * 1e-9 for f in lines_hz) if moved else ()
    if len(steps) < 3 * (1 + 2 * len(lines)):
        return state
    state = _added(state, _part(block, steps, lines, edge), block)
    return _looked(state, block)


def _swapped(state: Comparison, block: FrameBlock) -> Comparison:
    """Return what is compared from now on: what there is of the matrix until now is the before."""
    same_session = state.tail is not None and state.tail.session == block.session
    fresh = Comparison(cm_id=block.cm_id, dithered=state.dithered)
    if state.cm_id is None or block.cm_id is None or state.modes is None or not same_session:
        return fresh
    lasted_s = sum(part.n_frames for part in state.parts) * block.dt_ns * 1e-9
    if lasted_s < LEAST_BEFORE_S:
        why = f"only {lasted_s:.1f} s of telemetry with {state.cm_id} to compare with"
        return replace(fresh, found=_unknown(state.cm_id, block.cm_id, why))
    return replace(fresh, before=Before.of(state.cm_id, state.parts, state.modes))


def _changes(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return ``(n_rows - LAG - 1, n_modes)`` how each step differs from that ``LAG`` frames ago."""
    steps = rows[1:] - rows[:-1]
    return np.asarray(steps[LAG:] - steps[:-LAG])


def _part(
    block: FrameBlock,
    steps: NDArray[np.float32],
    lines: tuple[float, ...],
    edge: EdgeWatch | None,
) -> Part:
    """Return the sums of one block; sines of these frequencies, cycles per frame, are left out."""
    n_frames = float(len(steps))
    power = np.zeros(block.commands_m.shape[1] + 3)
    moved = np.einsum("km,km->m", steps, steps)
    if lines:
        sines = _sines(len(steps), lines)
        played = sines.T @ steps
        # of a basis: what is left has as much less power
        moved = np.maximum(moved - np.einsum("km,km->m", played, played), 0.0)
        moved *= n_frames / (n_frames - sines.shape[1])
    power[: steps.shape[1]] = moved
    looked = block.slopes[::_SAMPLED]
    power[_SLOPES] = n_frames * np.vdot(looked, looked) / len(looked)
    if edge is not None:
        last = block.commands_m[-1, edge.modes]
        outer = edge.outer @ last
        power[_OUTER] = n_frames * (outer @ outer) / len(outer)
        power[_INNER] = n_frames * max(float(last @ (edge.inner @ last)), 0.0)
    return Part(n_frames=n_frames, power=power)


@cache
def _sines(n_frames: int, lines: tuple[float, ...]) -> NDArray[np.float32]:
    """Return ``(n_frames, 2 n_lines)`` an orthonormal basis of sines, whatever their phases."""
    angles = 2.0 * np.pi * np.outer(np.arange(n_frames), lines)
    basis, _ = np.linalg.qr(np.hstack([np.cos(angles), np.sin(angles)]))
    return np.asarray(basis, np.float32)


def _added(state: Comparison, part: Part, block: FrameBlock) -> Comparison:
    """Add sums to the part under way, or begin another one."""
    dt_s, parts = block.dt_ns * 1e-9, state.parts
    length = max(PART_S / dt_s, LEAST_PART)
    last = parts[-1] if parts else None
    if last is not None and last.n_frames < length - _REACH:
        part = Part(n_frames=last.n_frames + part.n_frames, power=last.power + part.power)
        parts = parts[:-1]
    kept = round(WITHIN_S / dt_s / length)
    return replace(state, parts=(*parts, part)[-kept:])


def _looked(state: Comparison, block: FrameBlock) -> Comparison:
    """Judge what there is, at the end of each part; say nothing before there is enough."""
    before = state.before
    if before is None or block.cm_id is None:
        return state
    dt_s = block.dt_ns * 1e-9
    # a block that does not follow another loses some frames to the filter
    if state.parts[-1].n_frames < max(PART_S / dt_s, LEAST_PART) - _REACH:
        return state
    known = np.intersect1d(before.modes, () if state.modes is None else state.modes)
    modes = np.setdiff1d(known, np.fromiter(state.dithered, np.intp))
    found = compared(before, state.parts, modes.astype(np.intp), block.cm_id)
    after_s = sum(part.n_frames for part in state.parts) * dt_s
    if found.verdict is Verdict.AS_GOOD and after_s < WITHIN_S - PART_S:
        return state
    return replace(state, found=replace(found, after_s=after_s), before=None)


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
        return _unknown(before.id, after_id, "no mode is in the loop with both, and moves")
    grown = np.log(after[moving] / before.power[moving])
    common = float(np.median(grown))
    single = grown - max(common, 0.0)
    worst = int(np.argmax(single))
    scatter = before.scatter * np.sqrt(1.0 / before.n_parts + 1.0 / len(parts))
    limit = float(np.log(WORSE) + SIGMAS * scatter)
    rings = single[worst] > limit and _lasts(before, parts, int(moving[worst]), max(common, 0.0))
    slopes = _log_ratio(before.power[_SLOPES], after[_SLOPES])
    ring = None
    edges = [power[k] for power in (before.power, after) for k in (_OUTER, _INNER)]
    if min(edges) > 0.0:
        ring = _log_ratio(edges[0] / edges[1], edges[2] / edges[3])
    slow = len(parts) >= SLOW_PARTS
    worse = (
        rings
        or common > np.log(COMMON_WORSE)
        or (slow and slopes > np.log(SLOPES_WORSE))
        or (slow and ring is not None and ring > np.log(RING_WORSE))
    )
    rms = [float(np.exp(0.5 * x)) for x in (single[worst], limit, common, slopes)]
    ring_rms = None if ring is None else float(np.exp(0.5 * ring))
    text = (
        f"mode {moving[worst]} moves {rms[0]:.2f} times as much as with {before.id}, against all "
        f"modes ({rms[1]:.2f} is worse), the median mode {rms[2]:.2f} "
        f"({np.sqrt(COMMON_WORSE):.1f}), all slopes {rms[3]:.2f} ({np.sqrt(SLOPES_WORSE):.1f})"
    )
    if ring_rms is not None:
        text += f", the outer ring {ring_rms:.2f} ({np.sqrt(RING_WORSE):.1f})"
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
        ring_ratio=ring_rms,
    )


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


def _unknown(before: str, after: str, why: str) -> ProbationFinding:
    return ProbationFinding(verdict=Verdict.UNKNOWN, before=before, after=after, text=why)
