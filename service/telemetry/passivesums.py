"""A noisy interaction matrix from ordinary telemetry: sums over every frame.

The sensor's noise comes back as commands; those commands, with all that is as slow as turbulence
filtered out of them (:mod:`service.telemetry.highpass`), are the instrument of a regression of
slopes on commands. What comes of it is a measurement to fit a model to, never a matrix to control
with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.telemetry.frames import FrameBlock
from service.telemetry.highpass import LEAST_DELAY_FRAMES, high_pass

Array = NDArray[Any]

CHUNK_FRAMES = 512
"""Frames multiplied at once: the sums, a matrix of 2 MB, are read from memory once for all."""

TAPER_FRAMES = 32
"""Frames over which a run of telemetry fades in after a gap, and out before the next. Turbulence is
a thousand times stronger than the noise that is looked for: a sum of their products that is cut off
is worse than none. Runs of less than twice as many frames are left out."""

MOST_OTHER_MODES = 8
"""Modes outside the loop that a dither of sines may move; where more move it is turbulence or
random signs, which the filtered commands have nothing in common with."""

SAMPLES_KEPT = 64
"""Filtered frames kept, from which the fit learns how noisy slopes are."""

SAMPLE_FRAMES = 128
"""One sample in as many frames."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Passive:
    """Forgetting sums over filtered commands: feed it blocks with ``accumulate``."""

    n_modes: int
    """Controlled modes: the only ones that move by themselves."""

    memory_frames: float
    """Frames after which a sample's weight has fallen to 1/e."""

    delay_frames: float = 2.0
    """Of the loop; with less than two nothing is summed."""

    cross: NDArray[np.float32] | None = None
    """``(n_slopes, n_modes)`` sum of s z^T, metres; z are the filtered commands."""

    moved: NDArray[np.float32] | None = None
    """``(n_modes, n_modes)`` sum of c z^T, metres²."""

    power: NDArray[np.float32] | None = None
    """``(n_modes, n_modes)`` sum of z z^T, metres²."""

    n_effective: float = 0.0
    """Frames in the sums, forgetting included."""

    samples: tuple[tuple[Array, Array], ...] = ()
    """Filtered slopes ``(n_slopes,)`` and commands ``(n_modes,)`` of single frames."""

    tail: FrameBlock | None = None
    """The last frames, for those that come."""

    waiting: tuple[_Rows, ...] = ()
    """Frames of the run under way that are not multiplied yet."""

    begun: bool = False
    """Whether frames of this run have been multiplied."""

    since_ns_utc: int = 0
    """No frame in the sums is older, by the RTC's clock; 0: not known."""

    @property
    def n_waiting(self) -> int:
        """Frames that are not multiplied yet."""
        return sum(rows.n for rows in self.waiting)

    @property
    def why_unusable(self) -> str | None:
        """Return why this loop's telemetry says nothing, or None."""
        if self.delay_frames >= LEAST_DELAY_FRAMES:
            return None
        return (
            f"no passive estimate: the loop's delay is {self.delay_frames:g} frames, "
            f"{LEAST_DELAY_FRAMES} are needed to tell the mirror's response from noise"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rows:
    """Contiguous frames, ready to be multiplied."""

    slopes: Array
    """``(n_rows, n_slopes)``."""

    commands: Array
    """``(n_rows, n_modes)``."""

    filtered: Array
    """``(n_rows, n_modes)``."""

    others: Array
    """``(n_rows, 2 * n_others)`` modes outside the loop that move, of this frame and the last."""

    @property
    def n(self) -> int:
        """Number of frames."""
        return len(self.slopes)

    def between(self, start: int, stop: int) -> _Rows:
        """Return these of the rows."""
        rows = slice(start, stop)
        return _Rows(
            slopes=self.slopes[rows],
            commands=self.commands[rows],
            filtered=self.filtered[rows],
            others=self.others[rows],
        )


def accumulate(state: Passive, block: FrameBlock) -> Passive:
    """Add a block of frames.

    A dither of controlled modes is as good as their own motion. What moves outside the loop is
    taken out of the instrument, where its response would pass for that of controlled modes.
    """
    if state.why_unusable is not None:
        return state
    if state.tail is not None and not _follows(state.tail, block):
        state = replace(_ended(state), tail=None)
    frames = _joined(state.tail, block)
    reach = len(high_pass(state.delay_frames).taps) - 1
    state = replace(state, tail=_last(frames, reach))
    if frames.n_frames <= reach:
        return state
    rows = _rows(state, frames)
    if state.waiting and state.waiting[-1].others.shape[1] != rows.others.shape[1]:
        # a dither begins or ends: what it is taken out of must hold it from end to end
        state = _ended(state)
    state = replace(_sampled(state, frames, rows), waiting=(*state.waiting, rows))
    if sum(rows.n for rows in state.waiting) < CHUNK_FRAMES + TAPER_FRAMES:
        return state
    waiting = _together(state.waiting)
    n_ready = waiting.n - TAPER_FRAMES
    state = _summed(state, waiting.between(0, n_ready), last=False)
    return replace(state, waiting=(waiting.between(n_ready, waiting.n),), begun=True)


def _ended(state: Passive) -> Passive:
    """Return the state after the end of a run: what waits fades out, or was too short to count."""
    waiting = _together(state.waiting) if state.waiting else None
    if waiting is not None and (state.begun or waiting.n >= 2 * TAPER_FRAMES):
        state = _summed(state, waiting, last=True)
    return replace(state, waiting=(), begun=False)


def _follows(tail: FrameBlock, block: FrameBlock) -> bool:
    return (tail.session, tail.dt_ns, tail.first_seq + tail.n_frames) == (
        block.session,
        block.dt_ns,
        block.first_seq,
    )


def _joined(tail: FrameBlock | None, block: FrameBlock) -> FrameBlock:
    """Return the block with the frames before it in front."""
    if tail is None:
        return block
    return replace(
        block,
        first_seq=tail.first_seq,
        t0_ns_utc=tail.t0_ns_utc,
        slopes=np.concatenate([tail.slopes, block.slopes]),
        commands_m=np.concatenate([tail.commands_m, block.commands_m]),
        dither_m=None,
    )


def _last(frames: FrameBlock, n: int) -> FrameBlock:
    """Return the last ``n`` frames, copied: a view would keep the whole block."""
    start = max(frames.n_frames - n, 0)
    return replace(
        frames,
        first_seq=frames.first_seq + start,
        t0_ns_utc=frames.t0_ns_utc + start * frames.dt_ns,
        slopes=frames.slopes[start:].copy(),
        commands_m=frames.commands_m[start:].copy(),
        dither_m=None,
    )


def _rows(state: Passive, frames: FrameBlock) -> _Rows:
    """Return the frames that the filter reaches both ends of."""
    chosen, commands = high_pass(state.delay_frames), frames.commands_m
    now = slice(chosen.behind, frames.n_frames - chosen.ahead)
    before = slice(now.start - 1, now.stop - 1)
    others = state.n_modes + np.flatnonzero(commands[:, state.n_modes :].any(axis=0))
    if len(others) > MOST_OTHER_MODES:
        others = others[:0]
    return _Rows(
        slopes=frames.slopes[now],
        commands=commands[now, : state.n_modes],
        filtered=chosen(commands[:, : state.n_modes]),
        others=np.hstack([commands[now][:, others], commands[before][:, others]]),
    )


def _together(waiting: tuple[_Rows, ...]) -> _Rows:
    return _Rows(
        slopes=np.concatenate([rows.slopes for rows in waiting]),
        commands=np.concatenate([rows.commands for rows in waiting]),
        filtered=np.concatenate([rows.filtered for rows in waiting]),
        others=np.concatenate([rows.others for rows in waiting]),
    )


def _sampled(state: Passive, frames: FrameBlock, rows: _Rows) -> Passive:
    """Keep one filtered frame in ``SAMPLE_FRAMES``."""
    first = frames.first_seq
    if first // SAMPLE_FRAMES == (first + rows.n) // SAMPLE_FRAMES:
        return state
    taps = high_pass(state.delay_frames).taps
    slopes = taps[::-1] @ frames.slopes[: len(taps)]
    sample = (slopes, rows.filtered[0].copy())
    return replace(state, samples=(*state.samples, sample)[-SAMPLES_KEPT:])


def _summed(state: Passive, rows: _Rows, *, last: bool) -> Passive:
    """Add frames to the sums: the first of a run, the last, or some between."""
    n, filtered = rows.n, rows.filtered
    if rows.others.shape[1]:
        filtered = filtered - rows.others @ np.linalg.lstsq(rows.others, filtered, rcond=1e-6)[0]
    weight = np.ones((n, 1), np.float32)
    rise = np.sin(np.pi / 2 * (np.arange(TAPER_FRAMES) + 0.5) / TAPER_FRAMES)[:, None] ** 2
    if not state.begun:
        weight[:TAPER_FRAMES] *= rise[:n]
    if last:
        weight[-TAPER_FRAMES:] *= rise[::-1][-n:]
    faded = weight * filtered
    cross, moved = rows.slopes.T @ faded, rows.commands.T @ faded
    power = faded.T @ faded
    fade = np.float32(np.exp(-n / state.memory_frames))
    if state.cross is not None and state.moved is not None and state.power is not None:
        cross += fade * state.cross
        moved += fade * state.moved
        power += fade * state.power
    n_effective = float(fade) * state.n_effective + float(weight.sum())
    return replace(state, cross=cross, moved=moved, power=power, n_effective=n_effective)
