"""Vibration lines in the slopes, so that no dither is put on one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.telemetry.frames import FrameBlock

Array = NDArray[Any]

SEGMENT_FRAMES = 1024
"""Length of a spectrum: 1 Hz per bin at 1 kHz."""

MIN_SEGMENTS = 8
"""Fewer spectra scatter too much for a line to be told from noise."""

LINE_RATIO = 8.0
"""Power of a line over its neighbourhood's median: a mean of eight spectra of noise never gets
there, so that what does is worth moving a dither for."""

LOOK_SEGMENTS = 4
"""Spectra between two looks for lines: a look costs as much as hundreds of frames."""

_NEIGHBOURHOOD = 20
_MEMORY_SEGMENTS = 32.0
_N_PATTERNS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vibrations:
    """Mean spectra of a few combinations of slopes: feed it blocks with ``listen``."""

    views: NDArray[np.float32]
    """``(n_views, n_slopes)``: tip, tilt, and patterns that every other mode is seen by."""

    power: NDArray[np.float64] | None = None
    """``(n_views, n_bins)`` forgetting mean."""

    n_segments: int = 0
    frame_rate_hz: float = 0.0
    next_seq: int = -1
    session: str = ""
    collected: NDArray[np.float32] | None = None
    """``(n, n_views)`` of the segment under way."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hearing:
    """What is heard while no dither plays, and under one.

    Apart, because only a pause tells a vibration from a dither that plays on it.
    """

    quiet: Vibrations
    dithered: Vibrations
    dither_hz: tuple[float, ...] = ()
    """Lines of the dither that ``dithered`` was heard under."""

    lines_hz: tuple[float, ...] = ()
    """Vibration lines as of the last look, lowest first."""


def hearing(n_slopes: int) -> Hearing:
    """Return the hearing of slopes of which nothing has been heard yet."""
    deaf = Vibrations(views=views_of(n_slopes))
    return Hearing(quiet=deaf, dithered=deaf)


def heard(state: Hearing, block: FrameBlock, dither_hz: tuple[float, ...]) -> Hearing:
    """Add a block of frames, played under these dither lines; look for lines now and then."""
    before = state.quiet.n_segments + state.dithered.n_segments
    if block.dither_m is None:
        state = replace(state, quiet=listen(state.quiet, block))
    else:
        if dither_hz != state.dither_hz:
            deaf = Vibrations(views=state.dithered.views)
            state = replace(state, dithered=deaf, dither_hz=dither_hz)
        state = replace(state, dithered=listen(state.dithered, block))
    n_segments = state.quiet.n_segments + state.dithered.n_segments
    if n_segments == before or n_segments % LOOK_SEGMENTS:
        return state
    quiet = lines_hz(state.quiet)
    under = lines_hz(state.dithered, (*state.dither_hz, *quiet))
    return replace(state, lines_hz=tuple(sorted((*quiet, *under))))


def views_of(n_slopes: int) -> NDArray[np.float32]:
    """Return what is listened to: mean x and y slopes, and fixed patterns of random signs."""
    half = n_slopes // 2
    views = np.zeros((2 + _N_PATTERNS, n_slopes), np.float32)
    views[0, :half] = views[1, half:] = 1.0 / np.sqrt(half)
    signs = np.random.default_rng(1).choice([-1.0, 1.0], size=(_N_PATTERNS, n_slopes))
    views[2:] = signs / np.sqrt(n_slopes)
    return views


def listen(state: Vibrations, block: FrameBlock) -> Vibrations:
    """Add a block of frames; a gap or a new session starts the segment anew."""
    rate_hz = 1e9 / block.dt_ns
    unbroken = block.session == state.session and block.first_seq == state.next_seq
    rows = (block.slopes @ state.views.T).astype(np.float32)
    if unbroken and state.collected is not None:
        rows = np.vstack([state.collected, rows])
    state = replace(
        state,
        frame_rate_hz=rate_hz,
        session=block.session,
        next_seq=block.first_seq + block.n_frames,
    )
    while len(rows) >= SEGMENT_FRAMES:
        state = _with_segment(state, rows[:SEGMENT_FRAMES])
        rows = rows[SEGMENT_FRAMES:]
    return replace(state, collected=rows)


def _with_segment(state: Vibrations, rows: Array) -> Vibrations:
    window = np.hanning(SEGMENT_FRAMES)[:, None]
    power = np.abs(np.fft.rfft((rows - rows.mean(axis=0)) * window, axis=0)).T ** 2
    share = max(1.0 / (state.n_segments + 1), 1.0 / _MEMORY_SEGMENTS)
    if state.power is not None:
        power = (1.0 - share) * state.power + share * power
    return replace(state, power=power, n_segments=state.n_segments + 1)


def lines_hz(state: Vibrations, known_hz: tuple[float, ...] = ()) -> tuple[float, ...]:
    """Return the vibration lines, lowest first, without those known: the dither's own.

    A bin is a line when in any view it stands ``LINE_RATIO`` above the median of its
    neighbourhood and is the highest within two bins. Below 2 % of the frame rate turbulence falls
    too steeply for a neighbourhood to tell, and no dither goes there.
    """
    if state.power is None or state.n_segments < MIN_SEGMENTS:
        return ()
    step = state.frame_rate_hz / SEGMENT_FRAMES
    found: set[float] = set()
    for power in state.power:
        padded = np.pad(power, _NEIGHBOURHOOD, mode="reflect")
        around = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBOURHOOD + 1)
        highest = np.lib.stride_tricks.sliding_window_view(np.pad(power, 2), 5).max(axis=1)
        peaks = (power > LINE_RATIO * np.median(around, axis=1)) & (power == highest)
        found |= {float(step * k) for k in np.flatnonzero(peaks) if k > _NEIGHBOURHOOD}
    return tuple(sorted(f for f in found if all(abs(f - k) > 3.0 * step for k in known_hz)))
