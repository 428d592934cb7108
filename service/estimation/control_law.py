"""Fit the loop to the commands: ``c[k+1] = leak c[k] - sum_d h_d (R s)[k+1-d]``.

A few modes are followed, on every frame. If the RTC's law is as it reports, its commands follow
exactly from earlier slopes and commands. A few modes then determine leak, gain and delay far better
than necessary, whatever turbulence and noise are. If there is a residual (clipping, turbulence
played on the mirror, another matrix), nothing is reported here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation.estimator import Change, FrameContext, LoopContext, Mark, Streaming
from service.estimation.frames import FrameBlock
from service.estimation.loop import last_seq
from service.estimation.loopcheck import RECHECK_INTERVAL_S, SIGNIFICANCE_SIGMA
from service.estimation.windows import ClosedLoop
from service.model.misregistration import unit_like

Array = NDArray[Any]

N_WATCHED_MODES = 12
"""Spread over those in the loop."""

KEPT_FRAMES = 640
"""Frames remembered."""

MIN_FRAMES = 240
"""Smallest number of usable frames: those with all frames before them that they follow from."""

VERDICT_INTERVAL_FRAMES = 200
"""Frames between two verdicts."""

N_AGREEING_VERDICTS = 2
"""Verdicts in a row that must agree on a difference."""

N_EXTRA_TAPS = 4
"""Frames beyond the stated delay: it may be longer, or the mirror may lag."""

MAX_UNEXPLAINED_SHARE = 0.002
"""Largest fraction of the steps' power that a mode may leave unexplained to be used."""

LEAK_TOLERANCE = 0.004
GAIN_TOLERANCE = 0.15
"""Relative: gains may follow the seeing between two status messages."""

DELAY_TOLERANCE_FRAMES = 0.75
"""Frames: a mirror that takes 0.7 of one to rise is none of the loop's delay."""

_STILL_M = 1e-13
"""Steps of a mode smaller than this, RMS, are rounding."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlLawCheck(Streaming):
    """Frames of a loop that has not changed, but for gains that follow the seeing."""

    resets = Change.GONE | Change.STATUS | Change.STANDSTILL
    unless = Mark.STANDS

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

    judged_seq: int = -VERDICT_INTERVAL_FRAMES
    """Up to here a verdict has been given."""

    errors: tuple[str, ...] = ()
    """Differences that the last verdicts found, without a break."""

    @classmethod
    @override
    def begin(cls, loop: LoopContext) -> ControlLawCheck:
        """Return one that has seen nothing."""
        return cls(from_seq=loop.from_seq)

    @override
    def update(self, frames: FrameContext) -> ControlLawCheck:
        """Return it after one more block."""
        return self if frames.terms is None else follow(self, frames.block, frames.terms)

    @override
    def on_status(self, loop: LoopContext, *, fresh: bool) -> ControlLawCheck:
        """Judge the frames up to a status."""
        rtc = loop.rtc
        if rtc is None or self.cm_id != rtc.cm_id:
            return self
        terms = loop.terms(rtc.cm_id)
        if terms is None:
            return self
        law, found = judge_frames(self, terms, last_seq(rtc))
        if found is None:
            return law
        if found.wrong:
            return replace(law, errors=(*law.errors, found.wrong)[-N_AGREEING_VERDICTS:])
        rests = round(RECHECK_INTERVAL_S * rtc.frame_rate_hz)
        return replace(law, judged_seq=law.judged_seq + rests, errors=())

    @property
    @override
    def conditions(self) -> tuple[str | None, ...]:
        """Return the description of a disagreement with the status, or None."""
        wrong = (
            f"the RTC's loop is not what its status says: {'; '.join(self.errors[-1:])}; mend "
            "its status, or its loop"
        )
        return (wrong if len(self.errors) >= N_AGREEING_VERDICTS else None,)


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentifiedLaw:
    """The loop that the frames show, and the one in the status."""

    leak: float
    gain: float
    """Over the stated gain; negative: of the other sign."""

    delay_frames: float
    wrong: str = ""
    """Difference with found and reported value; empty if there is none."""


def follow(law: ControlLawCheck, block: FrameBlock, loop: ClosedLoop) -> ControlLawCheck:
    """Return the law after one more block, as far as it is of this loop."""
    # Frames that will be forgotten before the next verdict on their matrix need not be kept.
    needed_seq = law.judged_seq + VERDICT_INTERVAL_FRAMES - KEPT_FRAMES
    needless = block.next_seq <= needed_seq and block.cm_id == law.cm_id
    if block.first_seq < law.from_seq or needless:
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


def judge_frames(
    law: ControlLawCheck, loop: ClosedLoop, last_seq: int
) -> tuple[ControlLawCheck, IdentifiedLaw | None]:
    """Return the law of the frames up to one; None if there is none, or no new one."""
    if last_seq - law.judged_seq < VERDICT_INTERVAL_FRAMES:
        return law, None
    n_taps = int(loop.delay_frames) + N_EXTRA_TAPS
    at = np.flatnonzero(law.seq <= last_seq)[n_taps:]
    # a frame counts where none of those before it was lost
    at = at[law.seq[at] - law.seq[at - n_taps] == n_taps]
    if len(at) < MIN_FRAMES:
        return law, None
    law = replace(law, judged_seq=int(law.seq[at[-1]]))
    fits = _fit_laws(law.commands_m.astype(float), law.seen_m.astype(float), at, n_taps)
    clear = np.flatnonzero(fits.clear)
    if 2 * len(clear) < len(law.modes) or not len(clear):
        return law, None
    return law, _compare_law(fits, clear, loop.gains[law.modes].astype(float), loop)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Fits:
    """The law of every mode watched, ``(n_watched,)`` each."""

    clear: NDArray[np.bool_]
    """True for each mode that moves and follows a law."""

    leak: Array
    leak_sigma: Array
    gain: Array
    delay_frames: Array


def _fit_laws(commands: Array, seen: Array, at: Array, n_taps: int) -> _Fits:
    """Return the law of every mode, by the normal equations: a few unknowns, hundreds of frames.

    A constant is free for every mode, and leaves with the means.
    """
    taps = np.arange(1, n_taps + 1)
    moved, answered = np.ascontiguousarray(commands.T), np.ascontiguousarray(seen.T)
    target, before = moved[:, at], moved[:, at - 1]
    inputs = np.stack([before, *(answered[:, at - tap] for tap in taps)], axis=1)
    inputs -= inputs.mean(axis=2, keepdims=True)
    scale = np.sqrt(np.einsum("mkn,mkn->mk", inputs, inputs))
    # A mode that rests divides by 1 and not by 0; it is not clear and does not count.
    scale[scale == 0.0] = 1.0
    inputs /= scale[:, :, None]
    wanted = (target - target.mean(axis=1, keepdims=True))[:, :, None]
    # pinv, because a mode that rests makes the normal matrix singular.
    inverse = np.linalg.pinv(inputs @ inputs.transpose(0, 2, 1), hermitian=True)
    weights = inverse @ (inputs @ wanted)
    missed = wanted - inputs.transpose(0, 2, 1) @ weights
    left, steps = np.sum(missed**2, axis=(1, 2)), target - before
    weights = weights[:, :, 0] / scale
    # Minus: the law subtracts g R s. A fraction of a frame of delay spreads the gain over
    # neighbouring taps.
    gain = -weights[:, 1:].sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # The delay is the mean tap, weighted by the gain of each.
        late = -(weights[:, 1:] @ taps) / gain
    return _Fits(
        clear=(steps.std(axis=1) >= _STILL_M)
        & (left <= MAX_UNEXPLAINED_SHARE * np.sum(steps**2, axis=1)),
        leak=weights[:, 0],
        # The regression was made with inputs scaled to 1: the result is scaled back.
        leak_sigma=np.sqrt(inverse[:, 0, 0] * left / len(at)) / scale[:, 0],
        gain=gain,
        delay_frames=np.where(gain == 0.0, np.inf, late),
    )


def _compare_law(fits: _Fits, clear: Array, gains: Array, loop: ClosedLoop) -> IdentifiedLaw:
    leak, sigma, late = (
        float(np.median(found[clear])) for found in (fits.leak, fits.leak_sigma, fits.delay_frames)
    )
    ratios = fits.gain[clear] / gains[clear]
    gain, spread = float(np.median(ratios)), float(np.median(np.abs(ratios - np.median(ratios))))
    wrong = []
    if abs(leak - loop.leak) > LEAK_TOLERANCE + SIGNIFICANCE_SIGMA * sigma:
        wrong.append(f"leak {leak:.3f} found, {loop.leak:.3f} in the status")
    # The spread is limited by the gain: modes that scatter wildly must not hide a gain that is far
    # off.
    tolerance = GAIN_TOLERANCE + SIGNIFICANCE_SIGMA * min(spread, abs(gain)) / np.sqrt(len(clear))
    if abs(gain - 1.0) > tolerance:
        wrong.append(f"gain {gain:.3g} times the one in the status{_hint(gain)}")
    if abs(late - loop.delay_frames) > DELAY_TOLERANCE_FRAMES:
        wrong.append(f"delay {late:.2f} frames found, {loop.delay_frames:.2f} in the status")
    return IdentifiedLaw(leak=leak, gain=gain, delay_frames=late, wrong="; ".join(wrong))


def _hint(gain: float) -> str:
    """Return a likely cause of a gain that no loop has."""
    if gain < 0.0:
        return ": slopes or commands have the other sign than the matrix that the RTC names"
    # Either side may have the wrong unit: the ratio is looked up as a factor above 1.
    unit = unit_like(max(gain, 1.0 / max(gain, 1e-30)), 1.0)
    whose = "commands" if gain > 1.0 else "the matrix's commands"
    return f": {whose} look like {unit}, metres of OPD are expected" if unit else ""


def _begun(law: ControlLawCheck, cm_id: str | None, loop: ClosedLoop) -> ControlLawCheck:
    in_loop = np.flatnonzero(loop.gains > 0.0)
    # unique: a loop with fewer modes than are watched would list some twice.
    chosen = np.unique(np.linspace(0, len(in_loop) - 1, N_WATCHED_MODES).round().astype(int))
    modes = in_loop[chosen] if len(in_loop) else in_loop
    none = np.zeros((0, len(modes)), np.float32)
    return ControlLawCheck(
        from_seq=law.from_seq,
        cm_id=cm_id,
        modes=modes,
        commands_m=none,
        seen_m=none,
        errors=law.errors,
    )
