"""Compare commands with the loop law that the RTC reports: ``c[k+d] = leak c[k+d-1] - g R s[k]``.

Telemetry contains the commands after clipping, and names the reconstructor, gains and delay that
produced them. If they do not follow from the slopes, the mirror is saturated or the RTC reports a
wrong loop.

Every mode is checked on a few frames. Both sides are differenced twice: other motions of the mirror
(turbulence played on it by day, a vibration) are slow, the sensor's noise is fast. A mode that
takes the fraction r of its steps then shows r, whatever the turbulence does. A command that does
not change although it should is at a limit. ``control_law`` checks a few modes on every frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation.estimator import Change, FrameContext, LoopContext, Mark, Streaming
from service.estimation.frames import FrameBlock, join_frames
from service.estimation.loop import last_seq
from service.estimation.windows import ClosedLoop, Telemetry
from service.model.defects import list_ranges
from service.records.messages import Message, compose

Array = NDArray[Any]

SAMPLES_PER_S = 20.0
"""Frames looked at: at 1 kHz one in 50."""

BATCH_SAMPLES = 32
"""Samples that may wait to be multiplied: the reconstructor is read once for all of them."""

KEPT_SAMPLES = 512
"""The oldest give way."""

MIN_SAMPLES = 20
"""Fewer judge nothing."""

WINDOW_SAMPLES = 5
"""Frames of a window that must have been looked at before it can be reported as off the loop."""

RECHECK_INTERVAL_S = 1.3
"""A loop that was found correct is not checked again for this time."""

STEP_TOLERANCE = 0.2
"""A mode that takes less than 0.8 or more than 1.2 of its steps does not obey."""

SIGNIFICANCE_SIGMA = 5.0
"""Standard errors beyond the tolerance before a mode counts: hundreds are looked at each second."""

MEAN_STEP_TOLERANCE = 0.12
"""The same for the mean of all modes; a mirror that lags by 0.64 frames is short of 0.05."""

MAX_DELAY_FRAMES = 8

MAX_OPPOSITE_SHARE = -0.5
"""Median of the steps of all modes below which another matrix than the named one has made them. A
mirror at its limits takes less of its steps, never the opposite of them."""

MAX_CONSTANT_SHARE = 0.1
"""Fraction of the samples in which a mode may stay constant although it should move."""

_STILL_M = 1e-12
"""Steps of a mode smaller than this, RMS, are rounding."""

_STEPS = 3
"""Steps that two differences take."""

_TAPS = 3
"""Frames whose slopes may have a part in one step: a mirror's lag, a part of a frame's delay."""

_SPANS_NAMED = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopCheck(Streaming):
    """Samples of an unchanged loop, and the result of the last of them."""

    resets = Change.GONE | Change.LOOP | Change.STANDSTILL
    unless = Mark.STANDS

    from_seq: int = 0
    """Frames before this may have been made by another loop."""

    cm_id: str | None = None
    """The reconstructor all samples are of; None: there are none."""

    swap_seq: int | None = None
    """First frame of this reconstructor; None once its first frames have been judged."""

    opposite_id: str | None = None
    """Its id if its first commands went the opposite way; None if they did not."""

    tail: FrameBlock | None = None
    """The last few frames, for those that come."""

    waiting: tuple[_Sample, ...] = ()
    """Samples not multiplied yet."""

    batches: tuple[_Batch, ...] = ()
    """Oldest first, bounded."""

    obeyed_seq: int = 0
    """Up to here the commands were found to obey the loop."""

    residual: CommandResidual | None = None
    """Departure of the commands from the loop law; None if they agree or it is unknown."""

    @classmethod
    @override
    def begin(cls, loop: LoopContext) -> LoopCheck:
        """Return one that has seen nothing: frames on their way may be of the loop as it was."""
        return cls(from_seq=loop.from_seq)

    @override
    def update(self, frames: FrameContext) -> LoopCheck:
        """Return it after one more block."""
        return self if frames.terms is None else observe(self, frames.block, frames.terms)

    @override
    def on_status(self, loop: LoopContext, *, fresh: bool) -> LoopCheck:
        """Judge the frames up to a status that shows the same loop as the one before."""
        rtc = loop.rtc
        if rtc is None or not fresh:
            return self
        seq, terms = last_seq(rtc), loop.terms(rtc.cm_id)
        if self.residual is None and seq < self.obeyed_seq + RECHECK_INTERVAL_S * rtc.frame_rate_hz:
            return self
        span = last_samples(self, seq)
        if span is None or terms is None:
            return self
        check, found = command_residual(self, terms, *span)
        if found is None or found.holds:
            return replace(check, residual=None, obeyed_seq=seq)
        return replace(check, residual=found)

    @override
    def vet(self, window: Telemetry, loop: LoopContext) -> tuple[LoopCheck, Message | None]:
        """Return why the commands of a window are not what the loop makes of its slopes."""
        terms = loop.terms(window.cm_id)
        if terms is None:
            return self, None
        last, n_frames = window.first_seq + window.plan.n_frames - 1, window.plan.n_frames
        check, found = command_residual(self, terms, window.first_seq, last, WINDOW_SAMPLES)
        if found is None:
            return check, None
        if not found.holds:
            return check, compose("window.off-loop", text=found.text)
        if n_frames / terms.frame_rate_hz >= MIN_SAMPLES / SAMPLES_PER_S:
            # what a long window has shown is not checked again
            check = replace(check, obeyed_seq=max(last, check.obeyed_seq))
        return check, None

    @property
    @override
    def conditions(self) -> tuple[str | None, ...]:
        """Return the description of a disagreement, or None."""
        return (None if self.residual is None else self.residual.text,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sample:
    """One frame, both sides of the equation differenced twice."""

    seq: int
    slopes: Array
    """``(_TAPS, n_slopes)``: ``floor(d)`` frames before, one and two frames before that."""

    steps_m: Array
    """``(n_controlled,)``."""

    held: Array
    """``(n_controlled,)`` whether the command stayed exactly where it was."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Batch:
    """Samples with the commands that the loop requests."""

    seq: Array
    """``(n_samples,)``."""

    asked_m: Array
    """``(_TAPS, n_samples, n_controlled)``, by the slopes of each frame."""

    taken_m: Array
    """``(n_samples, n_controlled)``."""

    held: Array
    """``(n_samples, n_controlled)``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandResidual:
    """Departure of each mode from the loop law."""

    share: NDArray[np.float64]
    """``(n_controlled,)`` fraction of the steps that the law requires; 1 if it agrees, NaN if there
    were no steps."""

    held: NDArray[np.float64]
    """``(n_controlled,)`` share of the frames in which it did not move at all."""

    disobeys: NDArray[np.bool_]
    """``(n_controlled,)``."""

    cm_id: str

    @property
    def holds(self) -> bool:
        """Return True if every mode obeys the law."""
        return not self.disobeys.any()

    @property
    def is_opposite(self) -> bool:
        """Return True if most modes move against the steps that the law requires."""
        moving = self.share[~np.isnan(self.share)]
        return len(moving) > 0 and bool(np.median(moving) < MAX_OPPOSITE_SHARE)

    @property
    def text(self) -> str:
        """Return which modes do not, by how much, and what may be the cause."""
        off = np.flatnonzero(self.disobeys)
        shares = self.share[off]
        worst = int(off[np.argmin(shares)])
        return (
            f"commands are off the loop equation: {len(off)} of {len(self.share)} modes "
            f"({list_ranges(off, _SPANS_NAMED)}) take {np.median(shares):.2f} of the commanded "
            f"steps (median; least mode {worst}: {self.share[worst]:.2f}) and stay where they are "
            f"in up to {self.held[off].max():.0%} of the frames: the mirror is saturated, or "
            f"the RTC's gains, its delay or its reconstructor are not those it names ({self.cm_id})"
        )


def observe(check: LoopCheck, block: FrameBlock, loop: ClosedLoop) -> LoopCheck:
    """Return the check after one more block, as far as it is of this loop."""
    n_delay = int(loop.delay_frames)
    if n_delay > MAX_DELAY_FRAMES or block.cm_id != loop.cm_id:
        return replace(check, tail=None)
    if check.cm_id != loop.cm_id:  # frames of another matrix come before the status that tells it
        first_seq = max(block.first_seq, check.from_seq)
        check = replace(check, cm_id=loop.cm_id, tail=None, waiting=(), batches=())
        check = replace(check, swap_seq=first_seq, opposite_id=None)
    depth = n_delay + _STEPS + _TAPS - 1
    tail = check.tail
    if tail is not None and not _goes_on(tail, block):
        tail = None
    stride = max(1, round(loop.frame_rate_hz / SAMPLES_PER_S))
    waiting = list(check.waiting)
    # A matrix of the wrong sign loses the loop within some tens of frames: each of the first is
    # looked at. By frame number: the samples do not depend on how frames are cut into blocks.
    judged_seq = -1 if check.swap_seq is None else check.swap_seq + depth - 1 + MIN_SAMPLES
    n_first = min(max(judged_seq - block.first_seq, 0), block.n_frames)
    later = n_first + -(block.first_seq + n_first) % stride
    for row in (*range(n_first), *range(later, block.n_frames, stride)):
        if row + 1 < depth:
            frames = _last(tail, block.rows(0, row + 1), depth)
        else:
            frames = block.rows(row + 1 - depth, row + 1).without_dither()
        if frames.n_frames == depth and frames.first_seq >= check.from_seq:
            waiting.append(_sample(frames, loop))
    check = replace(check, tail=_last(tail, block, depth), waiting=tuple(waiting))
    if check.swap_seq is not None and block.next_seq >= judged_seq:
        _, found = command_residual(check, loop, check.swap_seq, judged_seq - 1, WINDOW_SAMPLES)
        opposite_id = loop.cm_id if found is not None and found.is_opposite else None
        kept = tuple(s for s in waiting if s.seq >= judged_seq or s.seq % stride == 0)
        check = replace(check, swap_seq=None, opposite_id=opposite_id, waiting=kept)
    return _multiply_waiting(check, loop) if len(check.waiting) >= BATCH_SAMPLES else check


def command_residual(
    check: LoopCheck,
    loop: ClosedLoop,
    first_seq: int,
    last_seq: int,
    enough: int = MIN_SAMPLES,
) -> tuple[LoopCheck, CommandResidual | None]:
    """Return how the modes obeyed in a span of frames, both ends included.

    None: too few of this reconstructor have been seen.

    The delay's part of a frame, and a mirror's lag, are fitted to all modes together: a lag is no
    disobedience.
    """
    if check.cm_id != loop.cm_id:
        return check, None
    check = _multiply_waiting(check, loop)
    near = [b for b in check.batches if b.seq[-1] >= first_seq and b.seq[0] <= last_seq]
    seq = np.concatenate([batch.seq for batch in near] or [np.empty(0, int)])
    chosen = (seq >= first_seq) & (seq <= last_seq)
    if np.count_nonzero(chosen) < enough:
        return check, None
    asked = np.concatenate([batch.asked_m for batch in near], axis=1)[:, chosen].astype(float)
    taken = np.concatenate([batch.taken_m for batch in near])[chosen].astype(float)
    held = np.concatenate([batch.held for batch in near])[chosen].mean(axis=0)
    return check, _judge(asked, taken, held, loop)


def last_samples(check: LoopCheck, before_seq: int) -> tuple[int, int] | None:
    """Return the span of the last ``MIN_SAMPLES`` samples up to a frame; None: too few."""
    seq = np.array([k for b in check.batches for k in b.seq] + [s.seq for s in check.waiting])
    seq = seq[seq <= before_seq][-MIN_SAMPLES:]
    return (int(seq[0]), int(seq[-1])) if len(seq) == MIN_SAMPLES else None


def _judge(asked: Array, taken: Array, held: Array, loop: ClosedLoop) -> CommandResidual:
    """Compare requested steps ``(_TAPS, n_samples, n_modes)`` with those taken."""
    weights = _lag(asked, taken, loop)
    obeys = np.abs(_shares(asked, taken, weights)[0] - 1.0) < STEP_TOLERANCE
    if obeys.any():
        # those that do not must not decide how late the others are
        weights = _lag(asked[:, :, obeys], taken[:, obeys], loop)
    share, error, power = _shares(asked, taken, weights)
    asked_for = power > len(taken) * _STILL_M**2
    off = (np.abs(share - 1.0) > STEP_TOLERANCE + SIGNIFICANCE_SIGMA * error) | (
        held > MAX_CONSTANT_SHARE
    )
    if asked_for.any():
        mean = abs(share[asked_for].mean() - 1.0)
        # 1 σ of a mean of independent modes.
        uncertain = np.linalg.norm(error[asked_for]) / np.count_nonzero(asked_for)
        if mean > MEAN_STEP_TOLERANCE + SIGNIFICANCE_SIGMA * uncertain:
            off |= np.abs(share - 1.0) > MEAN_STEP_TOLERANCE
    return CommandResidual(
        share=np.where(asked_for, share, np.nan),
        held=held,
        disobeys=off & asked_for,
        cm_id=loop.cm_id or "unknown",
    )


def _shares(asked: Array, taken: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Return regressions of the steps taken on those requested, 1 σ, and the power requested.

    ``(n_controlled,)`` each, for frames with these ``weights``.
    """
    steps = np.tensordot(weights, asked, axes=1)
    power = np.einsum("km,km->m", steps, steps)
    # No division by zero for a mode that rests.
    share = np.einsum("km,km->m", steps, taken) / (power + _STILL_M**2)
    left = np.einsum("km,km->m", taken, taken) - share**2 * (power + _STILL_M**2)
    variance = np.maximum(left, 0.0) / (power + _STILL_M**2) / (len(taken) - 1)
    return share, np.sqrt(variance), power


def _lag(asked: Array, taken: Array, loop: ClosedLoop) -> Array:
    """Return ``(_TAPS,)`` weights of the frames, with sum 1: the delay of the modes.

    Fitted with equal weight for all modes. If the result is no delay, the delay in the status is
    used.
    """
    late = loop.delay_frames - int(loop.delay_frames)
    # Each mode's own power, so that all modes have the same weight whatever their amplitudes; the
    # second term avoids a division by zero for modes that rest.
    scale = np.sqrt(np.einsum("ikm,ikm->m", asked, asked) + len(taken) * _STILL_M**2)
    asked, taken = asked / scale, taken / scale
    normal = np.einsum("ikm,jkm->ij", asked, asked)
    fitted = np.linalg.lstsq(normal, np.einsum("ikm,km->i", asked, taken))[0]
    if fitted.sum() > STEP_TOLERANCE and (fitted > -0.1 * fitted.sum()).all():
        return np.asarray(fitted / fitted.sum())
    # A delay of n and a fraction splits each step between two frames in that proportion.
    return np.array([1.0 - late, late, 0.0])


def _last(tail: FrameBlock | None, block: FrameBlock, n: int) -> FrameBlock:
    """Return the last ``n`` frames of both, or as many as there are, the dither taken off."""
    part = block.last(n).without_dither()
    if tail is None or part.n_frames == n:
        return part
    return join_frames((tail, part)).last(n)


def _goes_on(tail: FrameBlock, block: FrameBlock) -> bool:
    """Return whether a block goes on where the tail ends, by the clock too and one matrix."""
    late_ns = abs(block.t0_ns_utc - tail.next_t_ns)
    return block.follows(tail) and block.cm_id == tail.cm_id and late_ns <= block.dt_ns / 2


def _sample(frames: FrameBlock, loop: ClosedLoop) -> _Sample:
    commands = frames.commands_m[-_STEPS - 1 :, : len(loop.gains)]
    # the frames reach back over the delay, the differences and the taps
    slopes = frames.slopes[: _TAPS + _STEPS - 1]
    return _Sample(
        seq=frames.first_seq + frames.n_frames - 1,
        slopes=_twice(slopes)[::-1],
        # The part of the command that the leak keeps is known: what remains is -g R s.
        steps_m=_twice(commands[1:] - np.float32(loop.leak) * commands[:-1])[0],
        # Exactly equal: noise moves a free command by more than single precision resolves.
        held=commands[-1] == commands[-2],
    )


def _twice(rows: Array) -> Array:
    """Return the second differences of rows."""
    return np.asarray(rows[2:] - 2 * rows[1:-1] + rows[:-2])


def _multiply_waiting(check: LoopCheck, loop: ClosedLoop) -> LoopCheck:
    if not check.waiting:
        return check
    slopes = np.stack([sample.slopes for sample in check.waiting], axis=1)
    asked = (loop.reconstructor @ slopes.reshape(-1, slopes.shape[-1]).T).T
    batch = _Batch(
        seq=np.array([sample.seq for sample in check.waiting]),
        # Minus, as in the loop law at the top: a command counteracts the slopes.
        asked_m=(-loop.gains.astype(np.float32) * asked).reshape(_TAPS, len(check.waiting), -1),
        taken_m=np.array([sample.steps_m for sample in check.waiting]),
        held=np.array([sample.held for sample in check.waiting]),
    )
    kept = (*check.batches, batch)
    while sum(len(b.seq) for b in kept) > KEPT_SAMPLES:
        kept = kept[1:]
    return replace(check, waiting=(), batches=kept)
