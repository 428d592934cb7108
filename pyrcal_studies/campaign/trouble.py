"""What goes wrong in a night of a campaign: on the telescope, or on the way from it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from enum import StrEnum

import numpy as np

from service.estimation.frames import FrameBlock
from service.wire import Loop, LoopRequest
from sim_rtc.computer.real_time_computer import RealTimeComputer

GAPS = 0.05
"""Share of frames that never come."""

BURST_EVERY_S = 7.0
BURST_S = 1.0

LATE_S = 2.0
"""From the announced begin of a dither to the true one."""

SHORT_STROKE_M = 300e-9
"""RMS of a mode: the lowest ones ask for more most of the time."""

NEVER = 10**9


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

    DELAY_1 = "delay-1"
    """One frame of delay less than usual; the status says so."""

    DELAY_3 = "delay-3"
    """One frame of delay more than usual; the status says so."""

    LATE_MIRROR = "late-mirror"
    """A mirror that takes 0.7 ms to rise: the command column is what it was told."""

    LATE_DITHER = "late-dither"
    """It begins two seconds after the RTC said it would."""

    NO_DITHER = "no-dither"
    """The RTC accepts it, and never applies it."""

    OPENED = "opened"
    """The loop is opened in the middle of a window, then closed and dithered again."""

    SATURATED = "saturated"
    """A mirror whose lowest modes are clipped most of the time."""

    SWAPPED = "swapped"
    """Another reconstructor in the middle of a window."""

    WRONG_BASIS = "wrong-basis"
    """Modes that are numbered otherwise than the model's, and nobody says so."""


def options_for(trouble: Trouble, line_fraction: float) -> list[str]:
    """Return the simulator's options that bring this trouble about."""
    match trouble:
        case Trouble.VIBRATION:
            return [f"--vibration=tip:{1000.0 * line_fraction:g}:20:0"]
        case Trouble.GAIN_SWING:
            swing = ((2 * k, 0.85 if k % 2 else 1.15) for k in range(1, 30))
            return [f"--seeing-at={t}:{arcsec}" for t, arcsec in swing]
        case Trouble.DELAY_1 | Trouble.DELAY_3:
            return [f"--delay={trouble.removeprefix('delay-')}"]
        case Trouble.LATE_MIRROR:
            return ["--rise-ms=0.7"]
        case _:
            return []


def told(trouble: Trouble, modes: tuple[int, ...]) -> tuple[int, ...]:
    """Return what the RTC calls these modes of the model."""
    return tuple(mode ^ 1 for mode in modes) if trouble is Trouble.WRONG_BASIS else modes


def prepare(trouble: Trouble, computer: RealTimeComputer, rate_hz: float) -> None:
    """Have the RTC do what it should not, from before the dither on."""
    match trouble:
        case Trouble.LATE_DITHER:
            computer.delay_dithers(round(LATE_S * rate_hz))
        case Trouble.NO_DITHER:
            computer.delay_dithers(NEVER)
        case Trouble.SATURATED:
            computer.limit_stroke(SHORT_STROKE_M)
        case _:
            pass


def strike(trouble: Trouble, computer: RealTimeComputer) -> bool:
    """Have happen what comes in the middle of a window; return whether the dither is over."""
    match trouble:
        case Trouble.SWAPPED:
            in_use = computer.reconstructor
            other = replace(in_use.manifest, id=f"{in_use.manifest.id}-again")
            computer.stage(replace(in_use, manifest=other))
        case Trouble.OPENED:
            for state in (Loop.OPEN, Loop.CLOSED):
                computer.execute(LoopRequest(id=f"campaign-{state}", loop=state))
            return True
        case _:
            pass
    return False


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
        elif trouble is Trouble.WRONG_BASIS:
            yield _renumbered(block)
        else:
            yield block


def _renumbered(block: FrameBlock) -> FrameBlock:
    """Return a block whose neighbouring modes have changed places."""
    n_modes = block.commands_m.shape[1]
    order = np.arange(n_modes).reshape(-1, 2)[:, ::-1].ravel()
    dither = block.dither_m
    return replace(
        block,
        commands_m=block.commands_m[:, order],
        dither_m=None if dither is None else dither[:, order],
    )


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
