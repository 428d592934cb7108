"""Whether the commands obey the loop that the RTC tells: ``c[k+d] = leak c[k+d-1] - g R s[k]``.

Telemetry holds the commands after clipping, and names the reconstructor, gains and delay that made
them. Where they do not follow from the slopes the mirror is saturated, or the RTC's account of
itself is wrong.

**Every mode, on a few frames** (``observe``, ``obedience``). Both sides are differenced twice: what
else moves the mirror (turbulence played on it by day, a vibration) is slow, the sensor's noise is
not. Then a mode that takes the share r of its steps shows r, whatever the turbulence does. A
command that stays exactly where it was though it was asked to move is at a limit.

**A few modes, on every frame** (``follow``, ``judged``): ``c[k+1] = leak c[k] - sum_d h_d (R
s)[k+1-d]``. An RTC that does what it says leaves nothing over: its commands follow from slopes and
commands before them to the last digit. So the leak, the gain and the delay that a few modes show
are known far better than they need be, whatever turbulence and noise are; where something is left
over (clipping, turbulence played on the mirror, another matrix) nothing is said here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import unit_like
from service.telemetry.frames import FrameBlock, joined_frames
from service.telemetry.windows import ClosedLoop

Array = NDArray[Any]

SAMPLES_PER_S = 20.0
"""Frames looked at: at 1 kHz one in 50."""

BATCH = 32
"""Samples that may wait to be multiplied: the reconstructor is read once for all of them."""

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

MODES_WATCHED = 12
"""Spread over those in the loop."""

KEPT_FRAMES = 640
"""Frames remembered."""

ENOUGH_FRAMES = 240
"""Frames with all before them that they follow from; fewer say nothing."""

JUDGED_EVERY = 200
"""Frames between two verdicts."""

MORE_TAPS = 4
"""Frames looked back beyond the delay told: it may be longer, or the mirror lag."""

EXPLAINED = 0.002
"""Largest share of the steps' power that a mode may leave over to be believed."""

LEAK_TOLERANCE = 0.004
GAIN_TOLERANCE = 0.15
"""Relative: gains may follow the seeing between two status messages."""

DELAY_TOLERANCE = 0.75
"""Frames: a mirror that takes 0.7 of one to rise is none of the loop's delay."""

_STILL_LAW_M = 1e-13
"""The same of the few modes of every frame."""


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


def observe(check: LoopCheck, block: FrameBlock, loop: ClosedLoop) -> LoopCheck:
    """Return the check after one more block, as far as it is of this loop."""
    n_delay = int(loop.delay_frames)
    if n_delay > LARGEST_DELAY_FRAMES or block.cm_id != loop.cm_id:
        return replace(check, tail=None)
    if check.cm_id != loop.cm_id:  # frames of another matrix come before the status that tells it
        check = LoopCheck(from_seq=check.from_seq, cm_id=loop.cm_id)
    depth = n_delay + _STEPS + _TAPS - 1
    tail = check.tail
    if tail is not None and not _goes_on(tail, block):
        tail = None
    stride = max(1, round(loop.frame_rate_hz / SAMPLES_PER_S))
    waiting = list(check.waiting)
    for row in range(-block.first_seq % stride, block.n_frames, stride):
        frames = _last(tail, block.rows(0, row + 1), depth)
        if frames.n_frames == depth and frames.first_seq >= check.from_seq:
            waiting.append(_sample(frames, loop))
    check = replace(check, tail=_last(tail, block, depth), waiting=tuple(waiting))
    return _multiplied(check, loop) if len(waiting) >= BATCH else check


def obedience(
    check: LoopCheck,
    loop: ClosedLoop,
    first_seq: int,
    last_seq: int,
    enough: int = ENOUGH_SAMPLES,
) -> tuple[LoopCheck, Obedience | None]:
    """Return how the modes obeyed in a span of frames, both ends included.

    None: too few of this reconstructor have been seen.

    The delay's part of a frame, and a mirror's lag, are fitted to all modes together: a lag is no
    disobedience.
    """
    if check.cm_id != loop.cm_id:
        return check, None
    check = _multiplied(check, loop)
    near = [b for b in check.batches if b.seq[-1] >= first_seq and b.seq[0] <= last_seq]
    seq = np.concatenate([batch.seq for batch in near] or [np.empty(0, int)])
    chosen = (seq >= first_seq) & (seq <= last_seq)
    if np.count_nonzero(chosen) < enough:
        return check, None
    asked = np.concatenate([batch.asked_m for batch in near], axis=1)[:, chosen].astype(float)
    taken = np.concatenate([batch.taken_m for batch in near])[chosen].astype(float)
    held = np.concatenate([batch.held for batch in near])[chosen].mean(axis=0)
    return check, _judged(asked, taken, held, loop)


def last_samples(check: LoopCheck, before_seq: int) -> tuple[int, int] | None:
    """Return the span of the last ``ENOUGH_SAMPLES`` samples up to a frame; None: too few."""
    seq = np.array([k for b in check.batches for k in b.seq] + [s.seq for s in check.waiting])
    seq = seq[seq <= before_seq][-ENOUGH_SAMPLES:]
    return (int(seq[0]), int(seq[-1])) if len(seq) == ENOUGH_SAMPLES else None


def _judged(asked: Array, taken: Array, held: Array, loop: ClosedLoop) -> Obedience:
    weights = _lag(asked, taken, loop)
    obeys = np.abs(_shares(np.tensordot(weights, asked, axes=1), taken)[0] - 1.0) < TOLERANCE
    if obeys.any():
        # those that do not must not decide how late the others are
        weights = _lag(asked[:, :, obeys], taken[:, obeys], loop)
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
        cm_id=loop.cm_id or "unknown",
    )


def _shares(model: Array, taken: Array) -> tuple[Array, Array]:
    """Return ``(n_controlled,)`` regressions of what was taken on what was asked, and 1 σ."""
    power = np.einsum("km,km->m", model, model) + _STILL_M**2
    common = np.einsum("km,km->m", taken, model)
    left = np.maximum(np.einsum("km,km->m", taken, taken) - common**2 / power, 0.0)
    return common / power, np.sqrt(left / power / (len(model) - 1))


def _lag(asked: Array, taken: Array, loop: ClosedLoop) -> Array:
    """Return ``(_TAPS,)`` weights of the frames, adding up to 1: how late the modes are.

    Fitted with every mode counting alike; where the fit is no delay the status' word stands.
    """
    late = loop.delay_frames - int(loop.delay_frames)
    scale = np.sqrt(np.einsum("lkm,lkm->m", asked, asked) + len(taken) * _STILL_M**2)
    inputs, seen = (asked / scale).reshape(_TAPS, -1), (taken / scale).ravel()
    fitted = np.linalg.lstsq(inputs @ inputs.T, inputs @ seen)[0]
    if fitted.sum() > TOLERANCE and (fitted > -0.1 * fitted.sum()).all():
        return np.asarray(fitted / fitted.sum())
    return np.array([1.0 - late, late, 0.0])


def _last(tail: FrameBlock | None, block: FrameBlock, n: int) -> FrameBlock:
    """Return the last ``n`` frames of both, or as many as there are, the dither taken off."""
    part = block.last(n).without_dither()
    if tail is None or part.n_frames == n:
        return part
    return joined_frames((tail, part)).last(n)


def _goes_on(tail: FrameBlock, block: FrameBlock) -> bool:
    """Return whether a block goes on where the tail ends, by the clock too and one matrix."""
    late_ns = abs(block.t0_ns_utc - tail.next_t_ns)
    return block.follows(tail) and block.cm_id == tail.cm_id and late_ns <= block.dt_ns / 2


def _sample(frames: FrameBlock, loop: ClosedLoop) -> _Sample:
    commands = frames.commands_m[-_STEPS - 1 :, : len(loop.gains)]
    slopes = frames.slopes
    return _Sample(
        seq=frames.first_seq + frames.n_frames - 1,
        # the frames reach back over the delay, the differences and the taps
        slopes=np.stack([_twice(slopes[tap : tap + _STEPS]) for tap in reversed(range(_TAPS))]),
        steps_m=_twice(commands[1:] - np.float32(loop.leak) * commands[:-1]),
        held=commands[-1] == commands[-2],
    )


def _twice(rows: Array) -> Array:
    """Return the second difference of three rows."""
    return np.asarray(rows[2] - 2 * rows[1] + rows[0])


def _multiplied(check: LoopCheck, loop: ClosedLoop) -> LoopCheck:
    if not check.waiting:
        return check
    slopes = np.stack([sample.slopes for sample in check.waiting], axis=1)
    asked = (loop.reconstructor @ slopes.reshape(-1, slopes.shape[-1]).T).T
    batch = _Batch(
        seq=np.array([sample.seq for sample in check.waiting]),
        asked_m=(-loop.gains.astype(np.float32) * asked).reshape(_TAPS, len(check.waiting), -1),
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopLaw:
    """Frames of a loop that has not changed: feed it blocks with ``follow``."""

    from_seq: int = 0
    """Frames before this may have been made by another loop."""

    cm_id: str | None = None
    """The matrix that made them."""

    modes: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    """``(n_watched,)``."""

    seq: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """``(n_frames,)`` oldest first, holes where frames were lost."""

    commands_m: Array = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """``(n_frames, n_watched)`` the integrator's own: no dither."""

    seen_m: Array = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """``(n_frames, n_watched)`` R s."""

    judged_seq: int = -JUDGED_EVERY
    """Up to here a verdict has been given."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundLaw:
    """What the frames say of the loop, and what was told."""

    leak: float
    gain: float
    """Over the gain told; negative: of the other sign."""

    delay_frames: float
    wrong: str = ""
    """What disagrees, found and told; empty: nothing does."""


def follow(law: LoopLaw, block: FrameBlock, loop: ClosedLoop) -> LoopLaw:
    """Return the law after one more block, as far as it is of this loop."""
    if block.first_seq < law.from_seq:
        return law
    if law.cm_id != block.cm_id or not len(law.seq):
        # the first frames of a matrix follow from slopes that another one multiplied
        law = _begun(law, block.cm_id, loop)
    if not len(law.modes):
        return law
    own = block.commands_m[:, law.modes]
    if block.dither_m is not None:
        own = own - block.dither_m[:, law.modes]
    seen = block.slopes @ loop.reconstructor[law.modes].T
    seq = np.arange(block.first_seq, block.next_seq)
    return replace(
        law,
        seq=np.concatenate([law.seq, seq])[-KEPT_FRAMES:],
        commands_m=np.concatenate([law.commands_m, own])[-KEPT_FRAMES:],
        seen_m=np.concatenate([law.seen_m, seen])[-KEPT_FRAMES:],
    )


def judged(law: LoopLaw, loop: ClosedLoop, last_seq: int) -> tuple[LoopLaw, FoundLaw | None]:
    """Return what the frames up to one say of the loop; None: nothing, or nothing new."""
    if last_seq - law.judged_seq < JUDGED_EVERY:
        return law, None
    n_taps = int(loop.delay_frames) + MORE_TAPS
    at = np.flatnonzero(law.seq <= last_seq)[n_taps:]
    # a frame counts where none of those before it was lost
    at = at[law.seq[at] - law.seq[at - n_taps] == n_taps]
    if len(at) < ENOUGH_FRAMES:
        return law, None
    law = replace(law, judged_seq=int(law.seq[at[-1]]))
    fits = _fitted(law.commands_m.astype(float), law.seen_m.astype(float), at, n_taps)
    clear = np.flatnonzero(fits.clear)
    if 2 * len(clear) < len(law.modes) or not len(clear):
        return law, None
    return law, _compared(fits, clear, loop.gains[law.modes].astype(float), loop)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Fits:
    """The law of every mode watched, ``(n_watched,)`` each."""

    clear: NDArray[np.bool_]
    """Whether the mode moves and follows a law."""

    leak: Array
    leak_sigma: Array
    gain: Array
    delay_frames: Array


def _fitted(commands: Array, seen: Array, at: Array, n_taps: int) -> _Fits:
    """Return the law of every mode, by the normal equations: a few unknowns, hundreds of frames.

    A constant is free for every mode, and leaves with the means.
    """
    taps = np.arange(1, n_taps + 1)
    moved, answered = np.ascontiguousarray(commands.T), np.ascontiguousarray(seen.T)
    target, before = moved[:, at], moved[:, at - 1]
    inputs = np.stack([before, *(answered[:, at - tap] for tap in taps)], axis=1)
    inputs -= inputs.mean(axis=2, keepdims=True)
    scale = np.sqrt(np.einsum("mkn,mkn->mk", inputs, inputs))
    scale[scale == 0.0] = 1.0
    inputs /= scale[:, :, None]
    wanted = (target - target.mean(axis=1, keepdims=True))[:, :, None]
    inverse = np.linalg.pinv(inputs @ inputs.transpose(0, 2, 1), hermitian=True)
    weights = inverse @ (inputs @ wanted)
    missed = wanted - inputs.transpose(0, 2, 1) @ weights
    left, steps = np.sum(missed**2, axis=(1, 2)), target - before
    weights = weights[:, :, 0] / scale
    gain = -weights[:, 1:].sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        late = -(weights[:, 1:] @ taps) / gain
    return _Fits(
        clear=(steps.std(axis=1) >= _STILL_LAW_M) & (left <= EXPLAINED * np.sum(steps**2, axis=1)),
        leak=weights[:, 0],
        leak_sigma=np.sqrt(inverse[:, 0, 0] * left / len(at)) / scale[:, 0],
        gain=gain,
        delay_frames=np.where(gain == 0.0, np.inf, late),
    )


def _compared(fits: _Fits, clear: Array, gains: Array, loop: ClosedLoop) -> FoundLaw:
    leak, sigma, late = (
        float(np.median(found[clear])) for found in (fits.leak, fits.leak_sigma, fits.delay_frames)
    )
    ratios = fits.gain[clear] / gains[clear]
    gain, spread = float(np.median(ratios)), float(np.median(np.abs(ratios - np.median(ratios))))
    wrong = []
    if abs(leak - loop.leak) > LEAK_TOLERANCE + SIGNIFICANCE * sigma:
        wrong.append(f"leak {leak:.3f} found, {loop.leak:.3f} told")
    tolerance = GAIN_TOLERANCE + SIGNIFICANCE * min(spread, abs(gain)) / np.sqrt(len(clear))
    if abs(gain - 1.0) > tolerance:
        wrong.append(f"gain {gain:.3g} times the one told{_hint(gain)}")
    if abs(late - loop.delay_frames) > DELAY_TOLERANCE:
        wrong.append(f"delay {late:.2f} frames found, {loop.delay_frames:.2f} told")
    return FoundLaw(leak=leak, gain=gain, delay_frames=late, wrong="; ".join(wrong))


def _hint(gain: float) -> str:
    """Return what a gain that no loop has looks like."""
    if gain < 0.0:
        return ": slopes or commands have the other sign than the matrix that the RTC names"
    unit = unit_like(max(gain, 1.0 / max(gain, 1e-30)), 1.0)
    whose = "commands" if gain > 1.0 else "the matrix's commands"
    return f": {whose} look like {unit}, metres of OPD are expected" if unit else ""


def _begun(law: LoopLaw, cm_id: str | None, loop: ClosedLoop) -> LoopLaw:
    in_loop = np.flatnonzero(loop.gains > 0.0)
    chosen = np.unique(np.linspace(0, len(in_loop) - 1, MODES_WATCHED).round().astype(int))
    modes = in_loop[chosen] if len(in_loop) else in_loop
    none = np.zeros((0, len(modes)), np.float32)
    return LoopLaw(from_seq=law.from_seq, cm_id=cm_id, modes=modes, commands_m=none, seen_m=none)
