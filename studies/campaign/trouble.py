"""What goes wrong in a night of a campaign: on the telescope, or on the way from it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from enum import StrEnum

import numpy as np

from service.estimation.frames import FrameBlock

GAPS = 0.05
"""Share of frames that never come."""

BURST_EVERY_S = 7.0
BURST_S = 1.0


class Trouble(StrEnum):
    """One thing that goes wrong."""

    NONE = "none"
    GAPS = "gaps"
    """Frames missing at random, as many as a window may lack."""

    BURST = "burst"
    """A second missing every seven."""

    VIBRATION = "vibration"
    """A line of 20 nm on tip at the very frequency of a dither."""

    GAIN_SWING = "gain-swing"
    """Seeing that swings by 30 % in four seconds, and the optical gain with it."""

    DELAY_3 = "delay-3"
    """One frame of delay more than usual; the status says so."""

    LATE_MIRROR = "late-mirror"
    """A mirror that takes 0.7 ms to rise: the command column is what it was told."""


def options_for(trouble: Trouble, line_fraction: float) -> list[str]:
    """Return the simulator's options that bring this trouble about."""
    match trouble:
        case Trouble.VIBRATION:
            return [f"--vibration=tip:{1000.0 * line_fraction:g}:20:0"]
        case Trouble.GAIN_SWING:
            swing = ((2 * k, 0.85 if k % 2 else 1.15) for k in range(1, 30))
            return [f"--seeing-at={t}:{arcsec}" for t, arcsec in swing]
        case Trouble.DELAY_3:
            return ["--delay=3"]
        case Trouble.LATE_MIRROR:
            return ["--rise-ms=0.7"]
        case _:
            return []


def troubled(
    blocks: Iterable[FrameBlock], trouble: Trouble, rng: np.random.Generator
) -> Iterator[FrameBlock]:
    """Yield the frames that arrive, contiguous ones together."""
    for block in blocks:
        if trouble is Trouble.GAPS:
            yield from _runs(block, rng.random(block.n_frames) >= 0.9 * GAPS)
        elif trouble is Trouble.BURST:
            t_s = (block.first_seq + np.arange(block.n_frames)) * block.dt_ns * 1e-9
            yield from _runs(block, t_s % BURST_EVERY_S < BURST_EVERY_S - BURST_S)
        else:
            yield block


def _runs(block: FrameBlock, arrives: np.ndarray) -> Iterator[FrameBlock]:
    """Yield each stretch of frames that arrive."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], arrives, [False]]).astype(int)))
    for start, stop in edges.reshape(-1, 2):
        rows = slice(int(start), int(stop))
        yield replace(
            block,
            first_seq=block.first_seq + rows.start,
            t0_ns_utc=block.t0_ns_utc + rows.start * block.dt_ns,
            slopes=block.slopes[rows],
            commands_m=block.commands_m[rows],
            dither_m=None if block.dither_m is None else block.dither_m[rows],
        )
