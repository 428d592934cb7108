"""Streaming demodulation of telemetry at the dither's frequencies and beside them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.telemetry.frames import FrameBlock
from service.telemetry.span import Steps, Window, advanced, cut
from service.telemetry.span import WindowRefused as WindowRefused

Array = NDArray[Any]

SIDE_OFFSETS_HZ = np.concatenate([np.arange(-20.0, -2.0), np.arange(3.0, 21.0)])
"""Where the noise is measured, relative to each dither line: 36 bins; 6 were too few."""

CHUNK_FRAMES = 512
"""Frames multiplied at once: the sums, 2 MB, are read from memory once for all of them."""

CUT_PERIODS = 0.01
"""Of a line, by which a window may be too long or too short: a rate of the RTC's that differs by
parts per million. The Hann window keeps what that costs below 1e-4 of the amplitude."""

MIN_AMPLITUDE_RATIO = 0.5
MAX_AMPLITUDE_RATIO = 1.5
"""A dither weaker or stronger than these shares of its request was not applied as asked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LockInPlan:
    """What is demodulated: one sinusoid on each of a few modes."""

    modes: tuple[int, ...]
    """0-based basis indices."""

    frequencies_hz: tuple[float, ...]
    """One for each mode."""

    amplitude_m: tuple[float, ...]
    """RMS of each sinusoid, metres OPD."""

    frame_rate_hz: float
    n_frames: int
    """Length of a window: an integer number of periods of every frequency."""

    first_seq: int
    """No window starts before this frame: the dither is on and the loop has settled."""

    def __post_init__(self) -> None:
        """Refuse a plan whose lines or side bins would leave the spectrum or be cut short.

        Raises
        ------
        ModelError
            If the lists differ in length, a frequency leaves (20 Hz, Nyquist - 20 Hz), two lines
            lie within 4 bins of one another, or the window cuts a period.
        """
        lines = np.array(self.frequencies_hz)
        edge = SIDE_OFFSETS_HZ.max()
        if not len(self.modes) == len(lines) == len(self.amplitude_m) > 0:
            raise ModelError("lock-in: modes, frequencies and amplitudes differ in length")
        if lines.min() <= edge or lines.max() >= self.frame_rate_hz / 2 - edge:
            raise ModelError(
                f"lock-in: found lines at {lines.min()} to {lines.max()} Hz; expected between "
                f"{edge} and {self.frame_rate_hz / 2 - edge} Hz, room for the side bins"
            )
        periods = lines * self.n_frames / self.frame_rate_hz
        if np.abs(periods - np.round(periods)).max() > CUT_PERIODS:
            raise ModelError(
                f"lock-in: {self.n_frames} frames cut a period of {lines} Hz; expected whole ones"
            )
        gaps = np.diff(np.sort(lines)) * self.n_frames / self.frame_rate_hz
        if gaps.size and gaps.min() < 4:
            raise ModelError(f"lock-in: lines {lines} Hz closer than 4 bins in one window")

    @property
    def bins_hz(self) -> NDArray[np.float64]:
        """``(n_lines, 1 + n_side)`` frequencies: each line, then its side bins."""
        lines = np.array(self.frequencies_hz)[:, None]
        return np.hstack([lines, lines + SIDE_OFFSETS_HZ])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spectra:
    """One window of telemetry at the plan's bins: sums of ``h_k x_k exp(-i w k)``, Hann h."""

    plan: LockInPlan
    session: str
    cm_id: str | None
    first_seq: int
    t_end_ns_utc: int
    """End of exposure of the last frame."""

    n_missing: int
    """Frames that never came; they count as zeros, which the side bins notice."""

    slopes: NDArray[np.complex64]
    """``(n_lines, 1 + n_side, n_slopes)``."""

    commands: NDArray[np.complex64]
    """``(n_lines, 1 + n_side, n_modes)`` total command on the mirror, metres."""

    dither: NDArray[np.complex64]
    """``(n_lines, n_modes)`` its known dither part at the lines, metres."""

    n_windows: int = 1
    """Windows, one after the other, that this is the mean of."""

    @property
    def window_s(self) -> float:
        """Seconds of telemetry in it."""
        return self.n_windows * self.plan.n_frames / self.plan.frame_rate_hz


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LockIn:
    """Windows under way: feed it blocks with ``accumulate``."""

    plan: LockInPlan
    window: Window[_Sums] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sums:
    """Sums so far, and the rows that wait to be added to them."""

    slopes: Array
    """``(2 * n_bins, n_slopes)``: real parts of every bin, then imaginary ones; so the others."""

    commands: Array
    """``(2 * n_bins, n_modes)``."""

    dither: Array
    """``(2 * n_lines, n_modes)``."""

    waiting: tuple[_Rows, ...] = ()

    @property
    def n_waiting(self) -> int:
        """Frames that wait."""
        return sum(len(rows.slopes) for rows in self.waiting)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rows:
    """Contiguous frames of a window."""

    first: int
    """Their place in the window."""

    slopes: Array
    commands: Array
    dither: Array


def accumulate(lock_in: LockIn, block: FrameBlock) -> tuple[LockIn, list[Spectra | WindowRefused]]:
    """Add a block of frames; return the new state and the windows that ended in it."""
    window, ended = cut(lock_in.plan, lock_in.window, block, _STEPS)
    return replace(lock_in, window=window), ended


def joined(one: Spectra, other: Spectra) -> Spectra | None:
    """Return two windows of the same dither, one right after the other, as a longer one.

    Their mean, each bin turned to the phase it has in the first: what the loop and the sensor make
    of a line is the same in both, and the noise at the side bins falls as it does at the lines.
    None: they are of different loops or dithers, or too far apart.
    """
    later = other.first_seq - one.first_seq
    follows = later // one.plan.n_frames in {one.n_windows, one.n_windows + 1}
    same = replace(one.plan, first_seq=0) == replace(other.plan, first_seq=0)
    if not (same and follows and (one.session, one.cm_id) == (other.session, other.cm_id)):
        return None
    turns = np.exp(-2j * np.pi * later * one.plan.bins_hz / one.plan.frame_rate_hz)
    n_windows = one.n_windows + other.n_windows
    share = np.float32(one.n_windows / n_windows)
    turned = ((1 - share) * turns).astype(np.complex64)[:, :, None]
    return replace(
        other,
        first_seq=one.first_seq,
        n_missing=one.n_missing + other.n_missing,
        slopes=share * one.slopes + turned * other.slopes,
        commands=share * one.commands + turned * other.commands,
        dither=share * one.dither + turned[:, 0] * other.dither,
        n_windows=n_windows,
    )


def _begin(plan: LockInPlan, block: FrameBlock) -> _Sums:
    n_bins, n_modes = plan.bins_hz.size, block.commands_m.shape[1]
    return _Sums(
        slopes=np.zeros((2 * n_bins, block.slopes.shape[1]), np.float32),
        commands=np.zeros((2 * n_bins, n_modes), np.float32),
        dither=np.zeros((2 * len(plan.modes), n_modes), np.float32),
    )


def _add(plan: LockInPlan, window: Window[_Sums], block: FrameBlock, rows: slice) -> Window[_Sums]:
    # no block without dither columns comes this far
    dither = block.commands_m[:0] if block.dither_m is None else block.dither_m
    sums = window.sums
    while rows.start < rows.stop:
        part = slice(rows.start, min(rows.stop, rows.start + CHUNK_FRAMES))
        new = _Rows(
            first=block.first_seq + part.start - window.span.first_seq,
            slopes=block.slopes[part],
            commands=block.commands_m[part],
            dither=dither[part],
        )
        window = replace(window, span=advanced(window.span, block, part))
        sums = replace(sums, waiting=(*sums.waiting, new))
        if sums.n_waiting >= CHUNK_FRAMES:
            sums = _projected(plan, sums)
        rows = slice(part.stop, rows.stop)
    return replace(window, sums=sums)


def _projected(plan: LockInPlan, sums: _Sums) -> _Sums:
    """Return the sums with the rows that waited in them."""
    if not sums.waiting:
        return sums
    turning = _turning(plan)
    phasors = np.concatenate([_phasors(plan, turning, rows) for rows in sums.waiting], axis=1)
    lines = phasors[:: plan.bins_hz.shape[1]]
    slopes, commands, dither = (
        np.concatenate([getattr(rows, name) for rows in sums.waiting])
        for name in ("slopes", "commands", "dither")
    )
    # real products: the columns are real
    parts = np.concatenate([phasors.real, phasors.imag])
    return _Sums(
        slopes=sums.slopes + parts @ slopes,
        commands=sums.commands + parts @ commands,
        dither=sums.dither + np.concatenate([lines.real, lines.imag]) @ dither,
    )


@lru_cache(maxsize=4)
def _turning(plan: LockInPlan) -> Array:
    """Return ``exp(-i w k)`` of every bin, ``(n_bins, CHUNK_FRAMES)``, from k = 0."""
    turns = np.outer(plan.bins_hz.ravel() / plan.frame_rate_hz, np.arange(CHUNK_FRAMES))
    return np.asarray(np.exp(-2j * np.pi * turns), np.complex64)


def _phasors(plan: LockInPlan, turning: Array, rows: _Rows) -> Array:
    """Return ``h_k exp(-i w k)`` of these rows, ``(n_bins, n_rows)``."""
    index = rows.first + np.arange(len(rows.slopes))
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * (index + 0.5) / plan.n_frames)
    start = np.exp(-2j * np.pi * rows.first * plan.bins_hz.ravel() / plan.frame_rate_hz)
    phasors = turning[:, : len(index)] * start.astype(np.complex64)[:, None]
    return np.asarray(phasors * hann.astype(np.float32))


def _complex(parts: Array, *shape: int) -> Array:
    """Return real and imaginary parts, one above the other, as complex numbers."""
    real, imaginary = np.split(parts, 2)
    return np.asarray((real + 1j * imaginary).reshape(*shape, -1))


def _close(plan: LockInPlan, window: Window[_Sums]) -> Spectra | WindowRefused:
    """Return the finished window, or why its dither is not the one asked for."""
    sums = _projected(plan, window.sums)
    dither = _complex(sums.dither, len(plan.modes))
    weight = 0.5 * plan.n_frames / np.sqrt(2.0)
    applied = np.abs(dither[np.arange(len(plan.modes)), list(plan.modes)]) / weight
    ratio = applied / np.array(plan.amplitude_m)
    if ratio.min() < MIN_AMPLITUDE_RATIO or ratio.max() > MAX_AMPLITUDE_RATIO:
        weak = ratio.min() < MIN_AMPLITUDE_RATIO
        worst = int(ratio.argmin() if weak else ratio.argmax())
        see = "see whether the RTC clips it" if weak else "see the RTC's units"
        return WindowRefused(
            reason=f"mode {plan.modes[worst]} carries {applied[worst] * 1e9:.2f} nm of dither at "
            f"{plan.frequencies_hz[worst]} Hz, {plan.amplitude_m[worst] * 1e9:.2f} nm were asked "
            f"for: {see}",
            t_ns_utc=window.span.next_t_ns,
        )
    return Spectra(
        plan=plan,
        session=window.span.session,
        cm_id=window.span.cm_id,
        first_seq=window.span.first_seq,
        t_end_ns_utc=window.span.next_t_ns - window.dt_ns,
        n_missing=window.span.n_missing,
        slopes=_complex(sums.slopes, *plan.bins_hz.shape),
        commands=_complex(sums.commands, *plan.bins_hz.shape),
        dither=dither,
    )


_STEPS = Steps(begin=_begin, add=_add, close=_close)
