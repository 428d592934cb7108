"""The loop's law as the frames show it: ``c[k+1] = leak c[k] - sum_d h_d (R s)[k+1-d]``.

An RTC that does what it says leaves nothing over: its commands follow from slopes and commands
before them to the last digit. So the leak, the gain and the delay that a few modes show are known
far better than they need be, whatever turbulence and noise are; where something is left over
(clipping, turbulence played on the mirror, another matrix) nothing is said here.
:mod:`service.telemetry.loopcheck` looks at every mode instead, on a few frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.telemetry.frames import FrameBlock
from service.telemetry.loopcheck import LoopTerms

Array = NDArray[Any]

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

SIGNIFICANCE = 5.0
"""Standard errors beyond a tolerance before anything is said."""

LEAK_TOLERANCE = 0.004
GAIN_TOLERANCE = 0.15
"""Relative: gains may follow the seeing between two status messages."""

DELAY_TOLERANCE = 0.75
"""Frames: a mirror that takes 0.7 of one to rise is none of the loop's delay."""

_STILL_M = 1e-13
"""Steps of a mode smaller than this, RMS, are rounding."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopLaw:
    """Frames of a loop that has not changed: feed it blocks with ``follow``."""

    from_seq: int = 0
    """Frames before this may have been made by another loop."""

    cm_id: str | None = None
    """The matrix that made them."""

    modes: NDArray[np.intp] | None = None
    """``(n_watched,)``; None: nothing was fed yet."""

    seq: NDArray[np.int64] | None = None
    """``(n_frames,)`` oldest first, holes where frames were lost."""

    commands_m: Array | None = None
    """``(n_frames, n_watched)`` the integrator's own: no dither."""

    seen_m: Array | None = None
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


def follow(law: LoopLaw, block: FrameBlock, terms: LoopTerms) -> LoopLaw:
    """Return the law after one more block, as far as it is of this loop."""
    if block.first_seq < law.from_seq:
        return law
    if law.cm_id != block.cm_id or law.seq is None:
        # the first frames of a matrix follow from slopes that another one multiplied
        law = _begun(law, block.cm_id, terms)
    if law.modes is None or not len(law.modes):
        return law
    own = block.commands_m[:, law.modes]
    if block.dither_m is not None:
        own = own - block.dither_m[:, law.modes]
    seen = block.slopes @ terms.reconstructor[law.modes].T
    seq = np.arange(block.first_seq, block.first_seq + block.n_frames)
    return replace(
        law,
        seq=_last(law.seq, seq),
        commands_m=_last(law.commands_m, own),
        seen_m=_last(law.seen_m, seen),
    )


def judged(law: LoopLaw, terms: LoopTerms, last_seq: int) -> tuple[LoopLaw, FoundLaw | None]:
    """Return what the frames up to one say of the loop; None: nothing, or nothing new."""
    modes, commands, seen = law.modes, law.commands_m, law.seen_m
    if law.seq is None or modes is None or commands is None or seen is None:
        return law, None
    if last_seq - law.judged_seq < JUDGED_EVERY:
        return law, None
    n_taps = int(terms.delay_frames) + MORE_TAPS
    at = np.flatnonzero(law.seq <= last_seq)[n_taps:]
    # a frame counts where none of those before it was lost
    at = at[law.seq[at] - law.seq[at - n_taps] == n_taps]
    if len(at) < ENOUGH_FRAMES:
        return law, None
    law = replace(law, judged_seq=int(law.seq[at[-1]]))
    commands, seen = commands.astype(float), seen.astype(float)
    fits = [_fitted(commands[:, m], seen[:, m], at, n_taps) for m in range(len(modes))]
    clear = [number for number, fit in enumerate(fits) if fit is not None]
    if 2 * len(clear) < len(fits) or not clear:
        return law, None
    gains = terms.gains[modes[clear]].astype(float)
    return law, _compared([fit for fit in fits if fit is not None], gains, terms)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fit:
    """The law of one mode."""

    leak: float
    leak_sigma: float
    gain: float
    delay_frames: float


def _fitted(commands: Array, seen: Array, at: Array, n_taps: int) -> _Fit | None:
    """Return the law of one mode; None: it does not follow one, or does not move."""
    target, before = commands[at], commands[at - 1]
    if np.std(target - before) < _STILL_M:
        return None
    inputs = np.column_stack(
        [before, *(seen[at - tap] for tap in range(1, n_taps + 1)), np.ones(len(at))]
    )
    scale = np.linalg.norm(inputs, axis=0)
    scale[scale == 0.0] = 1.0
    weights, _, _, _ = np.linalg.lstsq(inputs / scale, target)
    left = float(np.sum((target - inputs / scale @ weights) ** 2))
    if left > EXPLAINED * float(np.sum((target - before) ** 2)):
        return None
    spread = np.linalg.pinv((inputs / scale).T @ (inputs / scale)) * left / len(at)
    taps = -(weights / scale)[1:-1]
    gain = float(taps.sum())
    late = float(taps @ np.arange(1, n_taps + 1)) / gain if gain else np.inf
    return _Fit(
        leak=float(weights[0] / scale[0]),
        leak_sigma=float(np.sqrt(spread[0, 0]) / scale[0]),
        gain=gain,
        delay_frames=late,
    )


def _compared(fits: list[_Fit], gains: Array, terms: LoopTerms) -> FoundLaw:
    leak = float(np.median([fit.leak for fit in fits]))
    sigma = float(np.median([fit.leak_sigma for fit in fits]))
    ratios = np.array([fit.gain for fit in fits]) / gains
    gain, spread = float(np.median(ratios)), float(np.median(np.abs(ratios - np.median(ratios))))
    late = float(np.median([fit.delay_frames for fit in fits]))
    wrong = []
    if abs(leak - terms.leak) > LEAK_TOLERANCE + SIGNIFICANCE * sigma:
        wrong.append(f"leak {leak:.3f} found, {terms.leak:.3f} told")
    tolerance = GAIN_TOLERANCE + SIGNIFICANCE * min(spread, abs(gain)) / np.sqrt(len(fits))
    if abs(gain - 1.0) > tolerance:
        wrong.append(f"gain {gain:.3g} times the one told{_hint(gain)}")
    if abs(late - terms.delay_frames) > DELAY_TOLERANCE:
        wrong.append(f"delay {late:.2f} frames found, {terms.delay_frames:.2f} told")
    return FoundLaw(leak=leak, gain=gain, delay_frames=late, wrong="; ".join(wrong))


def _hint(gain: float) -> str:
    """Return what a gain that no loop has looks like."""
    if gain < 0.0:
        return ": slopes or commands have the other sign than the matrix that the RTC names"
    decades = np.log10(gain)
    for decade, unit in ((9, "nanometres"), (6, "micrometres"), (3, "millimetres")):
        if abs(abs(decades) - decade) < 1.0:
            whose = "commands" if decades > 0 else "the matrix's commands"
            return f": {whose} look like {unit}, metres of OPD are expected"
    return ""


def _begun(law: LoopLaw, cm_id: str | None, terms: LoopTerms) -> LoopLaw:
    in_loop = np.flatnonzero(terms.gains > 0.0)
    chosen = np.unique(np.linspace(0, len(in_loop) - 1, MODES_WATCHED).round().astype(int))
    return LoopLaw(
        from_seq=law.from_seq, cm_id=cm_id, modes=in_loop[chosen] if len(in_loop) else in_loop
    )


def _last(kept: Array | None, new: Array) -> Array:
    return new[-KEPT_FRAMES:] if kept is None else np.concatenate([kept, new])[-KEPT_FRAMES:]
