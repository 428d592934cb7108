"""Compare the mean of the commands before and after a change of reference slopes.

A wrong offset looks perfect in the slopes, from which the RTC has subtracted it: only the commands
show it. Their mean over the turbulence changes by what the mirror holds in addition to the shape
before. What it holds, over the shape that was sent, is 1 where sign, scale and numbers are as sent.
Turbulence moves the mean as well: σ is taken from the scatter of blocks on both sides.

What was sent is compared with each of the ways in which references go wrong: another sign, twice
the size, none, and the former ones. For two shapes, c as it was sent and h, the mean is projected
on ``c - h``, with the inverse of what turbulence leaves in each mode as weights. The ratio of the
likelihoods of the result under both says which one is applied. An optical gain that is not the one
of the references scales all of them by a common factor, which is not known exactly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation.estimator import Change, FrameContext, LoopContext, Mark, Streaming

Array = NDArray[np.float64]

BLOCK_S = 0.5
"""Duration of a block, longer than the turbulence of all but the lowest modes remembers."""

BLOCKS_BEFORE = 120
"""Blocks before the references in use; more would meet other drifts."""

BLOCKS_AFTER = 55
"""Blocks with the references after a change: a finding comes within 28 s or not at all."""

REPORT_BLOCKS = 5
"""Number of blocks between two findings."""

MAX_MODES = 300
"""Modes that are compared; shapes are smooth."""

SETTLING_S = 0.3
"""Time after the ramp within which the loop reaches the shape."""

CLOSING_S = 10.0
"""Time after the loop was closed in which its commands still change by more than a shape: a segment
that has slipped comes back by the leak, with a time constant of 4 s at 0.999 and 250 Hz."""


GAIN_SIGMA = 0.15
"""Relative 1 σ of what a loop holds, by optical gains that are inferred from other modes."""

GAIN_EXPONENT = 0.6
"""Relative change of the optical gain over that of the variance of the commands, at most: from 0.6
to 1.2 arcsec the variance becomes 3.2 times and the gain of FLAO half as large."""

LEAST_MEMORY = 0.4
"""Least variance of a mean over that of blocks without memory. Frozen flow takes the lowest
frequencies out of some modes, which a few blocks cannot show exactly."""


class HeldShape(NamedTuple):
    """Share of a shape that the mirror holds, and whether it holds another one."""

    ratio: float
    """1 if it was applied as it was sent."""

    sigma: float
    """1 σ of it."""

    other: str
    """The wrong way to apply it that agrees best with the commands."""

    log_odds: float
    """Natural logarithm of the likelihood of that way over that of the shape as it was sent."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeanCommands(Streaming):
    """Means of the commands with the references in use and with those before them."""

    resets = Change.GONE | Change.SESSION | Change.RATE | Change.OPEN
    unless = Mark.STANDS | Mark.ABSURD
    only_closed = True

    name: str = ""
    """References of the last block; those of a ramp do not count."""

    before: tuple[tuple[str, Array], ...] = ()
    """References before, and means of the commands ``(n_modes,)`` of a block, metres, oldest
    first."""

    blocks: tuple[Array, ...] = ()
    """The means with the references in use."""

    total: Array | None = None
    """Sum of the block under way."""

    n_frames: int = 0
    """Frames in that sum; negative while the loop settles."""

    @override
    def restart(self, loop: LoopContext, why: Change) -> MeanCommands:
        rate_hz = 0.0 if loop.rtc is None else loop.rtc.frame_rate_hz
        return MeanCommands(n_frames=-round(CLOSING_S * rate_hz))

    @override
    def update(self, frames: FrameContext) -> MeanCommands:
        block, rate_hz = frames.block, frames.rtc.frame_rate_hz
        name, now = block.reference_name or "", self
        if name.endswith("~"):
            return self
        if name != self.name:
            wait = -round(SETTLING_S * rate_hz)
            before = (*self.before, *((self.name, one) for one in self.blocks))[-BLOCKS_BEFORE:]
            now = replace(self, name=name, before=before, blocks=(), total=None)
            now = replace(now, n_frames=min(self.n_frames, wait if self.name else 0))
        n_frames = now.n_frames + len(block.commands_m)
        if now.n_frames < 0:
            return replace(now, n_frames=min(n_frames, 0))
        total = block.commands_m[:, :MAX_MODES].sum(axis=0, dtype=np.float64)
        total = total if now.total is None else now.total + total
        if n_frames < BLOCK_S * rate_hz:
            return replace(now, total=total, n_frames=n_frames)
        kept = now.blocks[-BLOCKS_BEFORE + 1 :]
        return replace(now, blocks=(*kept, total / n_frames), total=None, n_frames=0)

    @property
    def duration_s(self) -> float:
        """Duration of the telemetry that is compared, without the ramp."""
        return BLOCK_S * (len(self.before) + len(self.blocks))

    def is_due(self, earlier: MeanCommands) -> bool:
        """Return True if there is a new finding since an earlier state."""
        n_blocks = len(self.blocks)
        new = n_blocks != len(earlier.blocks) or self.name != earlier.name
        looks = range(REPORT_BLOCKS, BLOCKS_AFTER + 1, REPORT_BLOCKS)
        return new and bool(self.before) and n_blocks in looks

    def measure(self, shapes_m: Mapping[str, Array], expected: float = 1.0) -> HeldShape | None:
        """Return how much of its shape the mirror holds, and whether it holds another one.

        Parameters
        ----------
        shapes_m
            The shapes ``(n_modes,)`` of the references in use and of those before, metres, which
            the mirror is taken to have held; blocks with other references do not count.
        expected
            Ratio that optical gains lead to which have changed since the references were made.

        Returns
        -------
        HeldShape or None
            None without a shape, or with less than five blocks on a side.
        """
        shape_m, after = shapes_m[self.name][:MAX_MODES], np.array(self.blocks[:BLOCKS_AFTER])
        known = [(shapes_m[name], block) for name, block in self.before if name in shapes_m]
        if min(len(known), len(after)) < REPORT_BLOCKS or not shape_m.any():
            return None
        n_modes = min(len(shape_m), after.shape[1])
        shape_m, after = shape_m[:n_modes], after[:, :n_modes]
        before = np.array([block[:n_modes] - held[:n_modes] for held, block in known])
        apart = np.concatenate([part - part.mean(axis=0) for part in (before, after)])
        moving = before.any(axis=0) & after.any(axis=0)
        strength = np.mean(
            after[:, moving].var(axis=0, ddof=1) / before[:, moving].var(axis=0, ddof=1)
        )
        gain_sigma = expected * float(np.hypot(GAIN_SIGMA, GAIN_EXPONENT * np.log(strength)))
        held_m = after.mean(axis=0) - before.mean(axis=0)
        n_mean = 1.0 / (1.0 / len(before) + 1.0 / len(after))
        others = {
            "not at all": np.zeros(n_modes),
            "with the sign turned": -shape_m,
            "twice as large": 2.0 * shape_m,
            "as the former ones": known[-1][0][:n_modes],
        }
        odds: dict[str, float] = {}
        for other, other_m in others.items():
            apart_m = shape_m - other_m
            if not apart_m.any():
                continue
            weights = apart_m / _long_variance(apart)
            weights /= weights @ apart_m
            variance = float(_long_variance(apart @ weights)) / n_mean
            if other == "not at all":
                ratio, sigma = float(held_m @ weights), variance**0.5
            sent, wrong = (
                _log_likelihood(
                    float(held_m @ weights),
                    expected * float(one @ weights),
                    variance + (gain_sigma * float(one @ weights)) ** 2,
                )
                for one in (shape_m, other_m)
            )
            odds[other] = wrong - sent
        likeliest = max(odds, key=odds.__getitem__)
        return HeldShape(ratio=ratio, sigma=sigma, other=likeliest, log_odds=odds[likeliest])


def _long_variance(apart: Array) -> Array:
    """Return the variance of blocks ``(n_blocks, ...)`` as it counts in a mean over many of them.

    The correlation of neighbours shows how much the blocks remember.
    """
    variance = (apart**2).sum(axis=0) / (len(apart) - 2)
    neighbours = (apart[1:] * apart[:-1]).sum(axis=0) / (len(apart) - 2)
    least = np.maximum(LEAST_MEMORY * variance, np.finfo(float).tiny)
    return np.asarray(np.maximum(variance + 2.0 * neighbours, least))


def _log_likelihood(found: float, expected: float, variance: float) -> float:
    return -0.5 * ((found - expected) ** 2 / variance + math.log(variance))
