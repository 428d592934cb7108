"""Decide whether the loop is worse than before the swap.

A matrix at the edge of stability makes a few modes ring near a tenth of the frame rate, while
slopes and wavefront error hardly change: a pyramid that saturates holds what runs away. So every
mode's steps are compared with its own under the matrix before. A step of the integrator is
``g R s``, the residual as the loop sees it; its change over ``LAG_FRAMES`` frames keeps what rings
and leaves turbulence out. What all modes have in common, their median, is seeing, light, optical
gain.

Whatever single modes do, the residual as a whole is compared as well, as both matrices read it
(``residual``); and the slopes, block by block, for a loop that is lost has no tenth of a second.

Turbulence makes all of these vary with a healthy loop. How much is measured before the swap
(``comparison.measure_noise``), and a moderate change is decided once, after ``DECISION_PERIOD_S``,
from the median of all parts. Before that only what no turbulence does counts: divergence at once,
and a factor of several that lasts longer than a gust.

Numbers are from docs/results/reliability.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation import comparison
from service.estimation.description import EdgeWatch
from service.estimation.estimator import Change, FrameContext, LoopContext, Mark, Streaming
from service.estimation.frames import FrameBlock
from service.estimation.loop import same_but_for_modes
from service.estimation.residual import Reader
from service.records.operations import ProbationFinding, Verdict
from service.wire import Status

Array = NDArray[np.float64]

MAX_PROBATION_S = comparison.DECISION_PERIOD_S
"""Telemetry with the new matrix that is looked at; the verdict comes at the latest then."""

HISTORY_S = 10.0
"""Telemetry with the matrix before from which the noise of a healthy loop is measured."""

PART_S = 0.1
"""Duration of a part, between two evaluations."""

MAX_PART_S = 0.2
"""A block that lasts longer makes more than one part."""

MIN_PART_FRAMES = 50
"""Frames: fewer scatter too much to be looked at."""

MIN_HISTORY_S = 0.8
"""Telemetry with the matrix before; with less nothing is reported."""

SWAP_SETTLING_S = 0.03
"""Time after a swap in which the loop changes from one equilibrium to the other."""

LAG_FRAMES = 5
"""Frames: what rings at a tenth of the frame rate shows twice, what is slow not at all. An optical
gain of a half makes loops ring at a twentieth; with 3 it shows half as well, with 8 none at an
eighth."""

RUNAWAY_POWER_RATIO = 9.0
"""Power of the slopes of one frame over that of the strongest frame before, in so many of those
looked at in a row (``RUNAWAY_FRAMES``): nothing but a loop that is lost does that, and at once."""

RUNAWAY_FRAMES = 4

RETURN_PERIOD_S = 1.0
"""With the matrix before in use again, until the loop is reported to be as it was, or lost."""

N_RETURN_PARTS = 10
"""Number of the last parts that decide if the loop has returned."""

N_SINE_BASES = 8
"""Bases of sines that are kept: a dither's, for each of the few lengths of blocks that come."""

_LAG_SPAN_FRAMES = LAG_FRAMES + 1
_POWER_STRIDE_FRAMES = 4
"""One of so many frames is looked at for the power of all slopes."""

_DITHER_STRIDE_FRAMES = 7
"""One of so many frames is looked at for a dither: odd, or a sine of half or a quarter of the frame
rate may be 0 in all of them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison(Streaming):
    """Telemetry with the matrix in use and with the one before."""

    resets = Change.GONE | Change.REFERENCES
    unless = Mark.STANDS | Mark.ABSURD
    only_closed = True

    cm_id: str | None = None
    """Reconstructor of the last block."""

    modes: NDArray[np.intp] | None = None
    """Modes in the loop in the last block."""

    tail: FrameBlock | None = None
    """The last frames, as many as a step and its change reach back; None if the last block had
    fewer."""

    session: str | None = None
    """Session of the last block."""

    n_skipped: int = 0
    """Frames since the swap that do not count yet."""

    parts: tuple[comparison.Part, ...] = ()
    """Parts with the matrix in use, oldest first, up to the number that counts; the last is
    incomplete."""

    before: comparison.Before | None = None
    """None: nothing is being compared."""

    reader: Reader | None = None
    """Reads the residual: of the matrix in use, or of the one before while it is compared."""

    own: NDArray[np.float32] | None = None
    """The matrix in use, where it is not the reader's: it has read the telemetry before, too."""

    healthy: comparison.Before | None = None
    """Reference of the last matrix that was judged worse; the next matrix is compared with it as
    well."""

    returned: bool = False
    """True if the matrix in use replaced a worse one."""

    n_runaway: int = 0
    """Frames looked at in a row that are beyond all before."""

    dithered: frozenset[int] = frozenset()
    """Modes that a dither has moved: they do not count."""

    found: ProbationFinding | None = None
    """Result for the last swap; None if it is under way or there was none."""

    of_loop: Status | None = None
    """The loop that both must be of, but for how many modes are controlled."""

    @override
    def restart(self, loop: LoopContext, why: Change) -> Comparison:
        """Return it with nothing; new references are no swap, and settle as after one."""
        return replace(self, n_skipped=0) if why == Change.REFERENCES else self.begin(loop)

    @override
    def on_status(self, loop: LoopContext, *, fresh: bool) -> Comparison:
        """Compare only what one loop does, under two matrices; gains may follow the seeing."""
        before, rtc = self.of_loop, loop.rtc
        if rtc is None or before is None or not same_but_for_modes(before, rtc):
            begun = restart(self, "the loop was changed after the swap")
            return replace(begun, of_loop=rtc)
        return self if self.before is not None else replace(self, of_loop=rtc)

    @override
    def update(self, frames: FrameContext) -> Comparison:
        """Return it after one more block."""
        loop, terms = frames.loop, frames.terms
        matrix = None if terms is None else terms.reconstructor
        return observe(self, frames.block, loop.in_loop, frames.lines_hz, loop.edge, matrix)


def restart(state: Comparison, why: str) -> Comparison:
    """Return an empty comparison; one that was under way ends without a verdict."""
    found = state.found
    if state.before is not None and state.cm_id is not None:
        found = comparison.not_compared(state.before.id, state.cm_id, why)
    return Comparison(cm_id=state.cm_id, found=found)


def observe(
    state: Comparison,
    block: FrameBlock,
    modes: NDArray[np.intp],
    lines_hz: tuple[float, ...] = (),
    edge: EdgeWatch | None = None,
    matrix: NDArray[np.float32] | None = None,
) -> Comparison:
    """Add a block of a closed loop of these modes.

    ``lines_hz`` are those of the dither that plays; frames of a dither without lines do not count.
    ``matrix`` is the one that multiplied its slopes; None: its numbers are not known. A long block
    makes several parts: they scatter as those do that come one by one.
    """
    n_parts = int(np.ceil(block.n_frames * block.dt_ns * 1e-9 / MAX_PART_S))
    cuts = np.linspace(0, block.n_frames, max(n_parts, 1) + 1).astype(int).tolist()
    for start, stop in pairwise(cuts):
        some = block.rows(start, stop)
        if some.cm_id != state.cm_id or (state.session and some.session != state.session):
            state = _begin_comparison(state, some)
        if state.before is None and state.healthy is None:
            state = _believe(state, matrix)
        elif state.before is not None and matrix is not state.own:
            state = _read_by(state, state.before, matrix)
        state = _observe(_note_runaway(state, some), some, modes, lines_hz, edge)
    return state


def _believe(state: Comparison, matrix: NDArray[np.float32] | None) -> Comparison:
    """Have the residual read by this matrix; what another one has read does not count any more."""
    if matrix is None:
        return replace(state, reader=None)
    if state.reader is not None and state.reader.matrix is matrix:
        return state
    parts = tuple(replace(part, residual=None) for part in state.parts)
    # With ``own`` of the swap before, no samples are kept for the next matrix to read.
    return replace(state, reader=Reader.of(matrix), parts=parts, own=None)


def _read_by(
    state: Comparison, before: comparison.Before, matrix: NDArray[np.float32] | None
) -> Comparison:
    """Have the matrix in use read the telemetry before, too."""
    level = None if before.level is None else before.level.read_by(matrix)
    return replace(state, own=matrix, before=replace(before, level=level))


def _note_runaway(state: Comparison, block: FrameBlock) -> Comparison:
    """Check the slopes frame by frame: a loop that is lost at once waits for no part."""
    before = state.before
    if before is None or not before.peak or block.cm_id is None or state.returned:
        return state
    looked, n_runaway = block.slopes[::_POWER_STRIDE_FRAMES], state.n_runaway
    for power in np.einsum("ks,ks->k", looked, looked).tolist():
        n_runaway = n_runaway + 1 if power > RUNAWAY_POWER_RATIO * before.peak else 0
    state = replace(state, n_runaway=n_runaway)
    if n_runaway < RUNAWAY_FRAMES:
        return state
    text = (
        f"the slopes of {n_runaway} frames in a row, one of {_POWER_STRIDE_FRAMES}, are over "
        f"{np.sqrt(RUNAWAY_POWER_RATIO):.0f} times the strongest with {before.id}"
    )
    found = ProbationFinding(
        verdict=Verdict.WORSE, before=before.id, after=block.cm_id, text=text, lost=True
    )
    return _end_comparison(state, found)


def _end_comparison(state: Comparison, found: ProbationFinding) -> Comparison:
    """Return what is left of a comparison that is over.

    If the loop is no better with the matrix before, the level before both is out of reach, and the
    next matrix is compared with the loop as it is.
    """
    healthy = state.before if found.verdict is Verdict.WORSE and not state.returned else None
    return replace(state, found=found, before=None, healthy=healthy, n_runaway=0)


def _observe(
    state: Comparison,
    block: FrameBlock,
    modes: NDArray[np.intp],
    lines_hz: tuple[float, ...],
    edge: EdgeWatch | None,
) -> Comparison:
    tail, state = state.tail, replace(state, modes=modes)
    some = None if block.dither_m is None else block.dither_m[::_DITHER_STRIDE_FRAMES].any(axis=0)
    moved = () if some is None else np.flatnonzero(some).tolist()
    n_modes = int(modes[-1]) + 1
    rows = block.commands_m[:, :n_modes]
    if tail is not None and block.follows(tail):
        rows = np.concatenate((tail.commands_m[:, :n_modes], rows))
    last = block.last(_LAG_SPAN_FRAMES) if block.n_frames >= _LAG_SPAN_FRAMES else None
    state = replace(state, tail=last, session=block.session)
    if moved and not lines_hz:
        return state
    if not state.dithered.issuperset(moved):
        state = replace(state, dithered=state.dithered.union(moved))
    if state.n_skipped < SWAP_SETTLING_S * 1e9 / block.dt_ns:
        return replace(state, n_skipped=state.n_skipped + block.n_frames)
    steps = _changes(rows)
    lines = tuple(f * block.dt_ns * 1e-9 for f in lines_hz) if moved else ()
    reader, residual = (None, None) if state.reader is None else state.reader.read(block, state.own)
    state = replace(state, reader=reader)
    # The sines of each line take two dimensions of the steps: in a shorter block too little of the
    # loop's own motion is left.
    if len(steps) < 3 * (1 + 2 * len(lines)):
        return state
    part = replace(_part(block, steps, lines, edge), residual=residual)
    return _judge_parts(_add_sums(state, part, block), block)


def _begin_comparison(state: Comparison, block: FrameBlock) -> Comparison:
    """Return what is compared from now on: what there is of the matrix until now is the before."""
    same_session = state.session == block.session
    fresh = Comparison(cm_id=block.cm_id, dithered=state.dithered, of_loop=state.of_loop)
    if state.healthy is not None and block.cm_id is not None and same_session:
        return replace(fresh, before=state.healthy, reader=state.reader, returned=True)
    if state.cm_id is None or block.cm_id is None or state.modes is None or not same_session:
        return fresh
    lasted_s = sum(part.n_frames for part in state.parts) * block.dt_ns * 1e-9
    if lasted_s < MIN_HISTORY_S:
        why = f"only {lasted_s:.1f} s of telemetry with {state.cm_id} to compare with"
        return replace(fresh, found=comparison.not_compared(state.cm_id, block.cm_id, why))
    part_s = max(PART_S, MIN_PART_FRAMES * block.dt_ns * 1e-9)
    before = comparison.Before.of(state.cm_id, state.parts, state.modes, part_s)
    return replace(fresh, before=before, reader=state.reader)


def _changes(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the change of each step in ``LAG_FRAMES``, ``(n_rows - LAG_FRAMES - 1, n_modes)``."""
    steps = rows[1:] - rows[:-1]
    return np.asarray(steps[LAG_FRAMES:] - steps[:-LAG_FRAMES])


def _part(
    block: FrameBlock,
    steps: NDArray[np.float32],
    lines: tuple[float, ...],
    edge: EdgeWatch | None,
) -> comparison.Part:
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
    looked = block.slopes[::_POWER_STRIDE_FRAMES]
    power[comparison.SLOPES] = n_frames * np.vdot(looked, looked) / len(looked)
    peak = float(np.einsum("ks,ks->k", looked, looked).max())
    if edge is not None:
        last = block.commands_m[-1, edge.modes]
        outer = edge.outer @ last
        power[comparison.OUTER] = n_frames * (outer @ outer) / len(outer)
        # Rounding in single precision may make a small quadratic form negative.
        power[comparison.INNER] = n_frames * max(float(last @ (edge.inner @ last)), 0.0)
    return comparison.Part(n_frames=n_frames, power=power, peak=peak)


@lru_cache(maxsize=N_SINE_BASES)
def _sines(n_frames: int, lines: tuple[float, ...]) -> NDArray[np.float32]:
    """Return ``(n_frames, 2 n_lines)`` an orthonormal basis of sines, whatever their phases."""
    angles = 2.0 * np.pi * np.outer(np.arange(n_frames), lines)
    basis, _ = np.linalg.qr(np.hstack([np.cos(angles), np.sin(angles)]))
    return np.asarray(basis, np.float32)


def _add_sums(state: Comparison, part: comparison.Part, block: FrameBlock) -> Comparison:
    """Add sums to the part under way, or begin another one."""
    dt_s, parts = block.dt_ns * 1e-9, state.parts
    length = max(PART_S / dt_s, MIN_PART_FRAMES)
    last = parts[-1] if parts else None
    if last is not None and last.n_frames < length - _LAG_SPAN_FRAMES:
        part, parts = last.plus(part), parts[:-1]
    parts = (*parts, part)
    if state.before is not None:
        return replace(state, parts=parts)
    # the history of the next swap
    parts = parts[-round(HISTORY_S / dt_s / length) :]
    n_recent = round(comparison.REFERENCE_PERIOD_S / dt_s / length)
    if len(parts) > n_recent:
        # Samples of slopes are kept for recent parts only, from which the new matrix reads the
        # residual; older ones would take memory for nothing.
        old = parts[-n_recent - 1]
        if old.residual is not None:
            old = replace(old, residual=replace(old.residual, kept=()))
        parts = (*parts[: -n_recent - 1], old, *parts[-n_recent:])
    return replace(state, parts=parts)


def _judge_parts(state: Comparison, block: FrameBlock) -> Comparison:
    """Judge the data at the end of each part, if there are enough."""
    before = state.before
    if before is None or block.cm_id is None:
        return state
    dt_s = block.dt_ns * 1e-9
    # a block that does not follow another loses some frames to the filter
    if state.parts[-1].n_frames < max(PART_S / dt_s, MIN_PART_FRAMES) - _LAG_SPAN_FRAMES:
        return state
    known = np.intersect1d(before.modes, () if state.modes is None else state.modes)
    # A mode that was dithered in one part and not in another would look as if it had changed.
    modes = np.setdiff1d(known, np.fromiter(state.dithered, np.intp))
    after_s = sum(part.n_frames for part in state.parts) * dt_s
    if state.returned and after_s < RETURN_PERIOD_S:
        return state
    # After a rollback the loop recovers during the first parts: the last ones decide.
    looked_at = state.parts[-N_RETURN_PARTS:] if state.returned else state.parts
    over = after_s >= MAX_PROBATION_S - PART_S
    decides = over or state.returned
    found = comparison.compare_telemetry(
        before, looked_at, modes.astype(np.intp), block.cm_id, decides=decides
    )
    waits = found.verdict is (Verdict.WORSE if state.returned else Verdict.AS_GOOD)
    if waits and not over and not (state.returned and found.lost):
        return state
    return _end_comparison(state, replace(found, after_s=after_s))
