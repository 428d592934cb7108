"""Do the commands obey the loop? ``c[k+d] = leak c[k+d-1] - g R s[k]``, watched on a few frames.

Telemetry holds the commands after clipping, and names the reconstructor, gains and delay that made
them. Where they do not follow from the slopes the mirror is saturated, or the RTC's account of
itself is wrong.

Both sides are differenced twice: what else moves the mirror (turbulence played on it by day, a
vibration) is slow, the sensor's noise is not. Then a mode that takes the share r of the steps it
is asked for shows r, whatever the turbulence does. A command that stays exactly where it was though
it was asked to move is at a limit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.telemetry.frames import FrameBlock

Array = NDArray[Any]

SAMPLES_PER_S = 20.0
"""Frames looked at: at 1 kHz one in 50."""

BATCH = 8
"""Samples multiplied at once: the reconstructor is read from memory once for all of them."""

KEPT_SAMPLES = 512
"""The oldest give way."""

ENOUGH_SAMPLES = 20
"""Fewer judge nothing."""

TOLERANCE = 0.2
"""A mode that takes less than 0.8 or more than 1.2 of its steps does not obey."""

SIGNIFICANCE = 5.0
"""Standard errors beyond the tolerance before a mode counts: hundreds are looked at each second."""

COMMON_TOLERANCE = 0.12
"""The same for the mean of all modes; a mirror that lags by 0.64 frames is short of 0.05."""

LARGEST_DELAY_FRAMES = 8

HELD_SHARE = 0.1
"""Of the samples in which a mode may stay where it is though asked to move."""

_STILL_M = 1e-12
"""Steps of a mode smaller than this, RMS, are rounding."""

_STEPS = 3
"""Steps that two differences take."""

_TAPS = 3
"""Frames whose slopes may have a part in one step: a mirror's lag, a part of a frame's delay."""

_SPANS_NAMED = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopTerms:
    """The loop as the RTC's account has it."""

    cm_id: str
    reconstructor: NDArray[np.float32]
    """``(n_controlled, n_slopes)`` metres per slope, of this ``cm_id``."""

    gains: NDArray[np.float32]
    """``(n_controlled,)``."""

    leak: float
    delay_frames: float
    frame_rate_hz: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopCheck:
    """Samples of a loop that has not changed: feed it blocks with ``observe``."""

    from_seq: int = 0
    """Frames before this may have been made by another loop."""

    cm_id: str | None = None
    """The reconstructor all samples are of; None: there are none."""

    tail: FrameBlock | None = None
    """The last few frames, for those that come."""

    waiting: tuple[_Sample, ...] = ()
    """Samples not multiplied yet."""

    batches: tuple[_Batch, ...] = ()
    """Oldest first, bounded."""


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
    """Samples with what the loop asks for."""

    seq: Array
    """``(n_samples,)``."""

    asked_m: Array
    """``(_TAPS, n_samples, n_controlled)``, by the slopes of each frame."""

    taken_m: Array
    """``(n_samples, n_controlled)``."""

    held: Array
    """``(n_samples, n_controlled)``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Obedience:
    """How far each mode follows the loop."""

    share: NDArray[np.float64]
    """``(n_controlled,)`` of the steps asked for; 1: obeys, NaN: was asked for none."""

    held: NDArray[np.float64]
    """``(n_controlled,)`` share of the frames in which it did not move at all."""

    disobeys: NDArray[np.bool_]
    """``(n_controlled,)``."""

    cm_id: str

    @property
    def holds(self) -> bool:
        """Whether every mode obeys."""
        return not self.disobeys.any()

    @property
    def text(self) -> str:
        """Return which modes do not, by how much, and what may be the cause."""
        off = np.flatnonzero(self.disobeys)
        shares = self.share[off]
        worst = int(off[np.argmin(shares)])
        return (
            f"commands are off the loop equation: {len(off)} of {len(self.share)} modes "
            f"({_spans(off)}) take {np.median(shares):.2f} of the steps asked for (median; least "
            f"mode {worst}: {self.share[worst]:.2f}) and stay where they are in up to "
            f"{self.held[off].max():.0%} of the frames: the mirror is saturated, or the RTC's "
            f"gains, its delay or its reconstructor are not those it names ({self.cm_id})"
        )


def observe(check: LoopCheck, block: FrameBlock, terms: LoopTerms) -> LoopCheck:
    """Return the check after one more block, as far as it is of this loop."""
    n_delay = int(terms.delay_frames)
    if n_delay > LARGEST_DELAY_FRAMES or block.cm_id != terms.cm_id:
        return replace(check, tail=None)
    if check.cm_id != terms.cm_id:  # frames of another matrix come before the status that tells it
        check = LoopCheck(from_seq=check.from_seq, cm_id=terms.cm_id)
    depth = n_delay + _STEPS + _TAPS - 1
    tail = check.tail if check.tail is not None and _follows(check.tail, block) else None
    stride = max(1, round(terms.frame_rate_hz / SAMPLES_PER_S))
    waiting = list(check.waiting)
    for row in range(-block.first_seq % stride, block.n_frames, stride):
        frames = _frames_before(tail, block, row, depth)
        if frames is not None and frames.first_seq >= check.from_seq:
            waiting.append(_sample(frames, terms))
    check = replace(check, tail=_joined(tail, block, depth), waiting=tuple(waiting))
    return _multiplied(check, terms) if len(waiting) >= BATCH else check


def obedience(
    check: LoopCheck,
    terms: LoopTerms,
    first_seq: int,
    last_seq: int,
    enough: int = ENOUGH_SAMPLES,
) -> tuple[LoopCheck, Obedience | None]:
    """Return how the modes obeyed in a span of frames, both ends included.

    None: too few of this reconstructor have been seen.

    The delay's part of a frame, and a mirror's lag, are fitted to all modes together: a lag is no
    disobedience.
    """
    if check.cm_id != terms.cm_id:
        return check, None
    check = _multiplied(check, terms)
    seq = np.concatenate([batch.seq for batch in check.batches] or [np.empty(0, int)])
    chosen = (seq >= first_seq) & (seq <= last_seq)
    if np.count_nonzero(chosen) < enough:
        return check, None
    asked = np.concatenate([b.asked_m for b in check.batches], axis=1)[:, chosen].astype(float)
    taken = np.concatenate([b.taken_m for b in check.batches])[chosen].astype(float)
    held = np.concatenate([b.held for b in check.batches])[chosen].mean(axis=0)
    return check, _judged(asked, taken, held, terms)


def last_samples(check: LoopCheck, before_seq: int) -> tuple[int, int] | None:
    """Return the span of the last ``ENOUGH_SAMPLES`` samples up to a frame; None: too few."""
    seq = np.concatenate([batch.seq for batch in check.batches] or [np.empty(0, int)])
    seq = seq[seq <= before_seq][-ENOUGH_SAMPLES:]
    return (int(seq[0]), int(seq[-1])) if len(seq) == ENOUGH_SAMPLES else None


def _judged(asked: Array, taken: Array, held: Array, terms: LoopTerms) -> Obedience:
    weights = _lag(asked, taken, terms)
    obeys = np.abs(_shares(np.tensordot(weights, asked, axes=1), taken)[0] - 1.0) < TOLERANCE
    if obeys.any():
        # those that do not must not decide how late the others are
        weights = _lag(asked[:, :, obeys], taken[:, obeys], terms)
    model = np.tensordot(weights, asked, axes=1)
    share, error = _shares(model, taken)
    asked_for = np.einsum("km,km->m", model, model) > len(model) * _STILL_M**2
    off = (np.abs(share - 1.0) > TOLERANCE + SIGNIFICANCE * error) | (held > HELD_SHARE)
    if asked_for.any():
        mean = abs(share[asked_for].mean() - 1.0)
        uncertain = np.linalg.norm(error[asked_for]) / np.count_nonzero(asked_for)
        if mean > COMMON_TOLERANCE + SIGNIFICANCE * uncertain:
            off |= np.abs(share - 1.0) > COMMON_TOLERANCE
    return Obedience(
        share=np.where(asked_for, share, np.nan),
        held=held,
        disobeys=off & asked_for,
        cm_id=terms.cm_id,
    )


def _shares(model: Array, taken: Array) -> tuple[Array, Array]:
    """Return ``(n_controlled,)`` regressions of what was taken on what was asked, and 1 σ."""
    power = np.einsum("km,km->m", model, model) + _STILL_M**2
    common = np.einsum("km,km->m", taken, model)
    left = np.maximum(np.einsum("km,km->m", taken, taken) - common**2 / power, 0.0)
    return common / power, np.sqrt(left / power / (len(model) - 1))


def _lag(asked: Array, taken: Array, terms: LoopTerms) -> Array:
    """Return ``(_TAPS,)`` weights of the frames, adding up to 1: how late the modes are.

    Fitted with every mode counting alike; where the fit is no delay the status' word stands.
    """
    late = terms.delay_frames - int(terms.delay_frames)
    scale = np.sqrt(np.einsum("lkm,lkm->m", asked, asked) + len(taken) * _STILL_M**2)
    inputs, seen = (asked / scale).reshape(_TAPS, -1), (taken / scale).ravel()
    fitted = np.linalg.lstsq(inputs @ inputs.T, inputs @ seen)[0]
    if fitted.sum() > TOLERANCE and (fitted > -0.1 * fitted.sum()).all():
        return np.asarray(fitted / fitted.sum())
    return np.array([1.0 - late, late, 0.0])


def _follows(tail: FrameBlock, block: FrameBlock) -> bool:
    """Return whether a block goes on where the tail ends, made by the same matrix."""
    after = tail.t0_ns_utc + tail.n_frames * tail.dt_ns
    return (
        (tail.session, tail.cm_id, tail.dt_ns) == (block.session, block.cm_id, block.dt_ns)
        and tail.first_seq + tail.n_frames == block.first_seq
        and abs(block.t0_ns_utc - after) <= block.dt_ns / 2
    )


def _frames_before(
    tail: FrameBlock | None, block: FrameBlock, row: int, depth: int
) -> FrameBlock | None:
    """Return the ``depth`` frames that end with this row; None: not all are there."""
    start = row + 1 - depth
    if start >= 0:
        return _rows(block, start, row + 1)
    if tail is None or tail.n_frames < -start:
        return None
    return _joined(tail, _rows(block, 0, row + 1), depth)


def _rows(block: FrameBlock, start: int, stop: int) -> FrameBlock:
    rows = slice(start, stop)
    return replace(
        block,
        first_seq=block.first_seq + start,
        t0_ns_utc=block.t0_ns_utc + start * block.dt_ns,
        slopes=block.slopes[rows],
        commands_m=block.commands_m[rows],
        dither_m=None if block.dither_m is None else block.dither_m[rows],
    )


def _joined(tail: FrameBlock | None, block: FrameBlock, depth: int) -> FrameBlock:
    """Return the last ``depth`` frames of both, the dither taken off the commands."""
    block = _own(_rows(block, max(block.n_frames - depth, 0), block.n_frames))
    missing = depth - block.n_frames
    if tail is None or missing <= 0:
        return block
    before = _own(_rows(tail, max(tail.n_frames - missing, 0), tail.n_frames))
    return replace(
        before,
        slopes=np.concatenate([before.slopes, block.slopes]),
        commands_m=np.concatenate([before.commands_m, block.commands_m]),
    )


def _own(block: FrameBlock) -> FrameBlock:
    """Return the frames with the integrator's own commands."""
    if block.dither_m is None:
        return block
    return replace(block, commands_m=block.commands_m - block.dither_m, dither_m=None)


def _sample(frames: FrameBlock, terms: LoopTerms) -> _Sample:
    frames = _own(frames)
    commands = frames.commands_m[-_STEPS - 1 :, : len(terms.gains)]
    slopes = frames.slopes
    return _Sample(
        seq=frames.first_seq + frames.n_frames - 1,
        # the frames reach back over the delay, the differences and the taps
        slopes=np.stack([_twice(slopes[tap : tap + _STEPS]) for tap in reversed(range(_TAPS))]),
        steps_m=_twice(commands[1:] - np.float32(terms.leak) * commands[:-1]),
        held=commands[-1] == commands[-2],
    )


def _twice(rows: Array) -> Array:
    """Return the second difference of three rows."""
    return np.asarray(rows[2] - 2 * rows[1] + rows[0])


def _multiplied(check: LoopCheck, terms: LoopTerms) -> LoopCheck:
    if not check.waiting:
        return check
    slopes = np.stack([sample.slopes for sample in check.waiting], axis=1)
    asked = (terms.reconstructor @ slopes.reshape(-1, slopes.shape[-1]).T).T
    batch = _Batch(
        seq=np.array([sample.seq for sample in check.waiting]),
        asked_m=(-terms.gains * asked).reshape(_TAPS, len(check.waiting), -1),
        taken_m=np.array([sample.steps_m for sample in check.waiting]),
        held=np.array([sample.held for sample in check.waiting]),
    )
    kept = (*check.batches, batch)
    while sum(len(b.seq) for b in kept) > KEPT_SAMPLES:
        kept = kept[1:]
    return replace(check, waiting=(), batches=kept)


def _spans(modes: Array) -> str:
    """Return modes as ranges: 0-5, 9, ..."""
    runs = [list(run) for _, run in groupby(enumerate(modes), key=lambda pair: pair[1] - pair[0])]
    spans = [
        str(run[0][1]) if len(run) == 1 else f"{run[0][1]}-{run[-1][1]}"
        for run in runs[:_SPANS_NAMED]
    ]
    return ", ".join(spans) + (", ..." if len(runs) > _SPANS_NAMED else "")
