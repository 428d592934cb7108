"""Streaming demodulation of telemetry at the dither's frequencies and beside them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.estimation.frames import FrameBlock
from service.estimation.span import Steps, Window, advanced, cut
from service.estimation.span import WindowRefused as WindowRefused

Array = NDArray[Any]

SIDE_OFFSETS_HZ = np.concatenate([np.arange(-20.0, -2.0), np.arange(3.0, 21.0)])
"""Where the noise is measured, relative to each dither line: 36 bins; 6 were too few."""

MIN_AMPLITUDE_RATIO = 0.5
"""A dither weaker than this share of its request was not applied as asked."""


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
        if np.abs(periods - np.round(periods)).max() > 1e-6:
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LockIn:
    """Windows under way: feed it blocks with ``accumulate``."""

    plan: LockInPlan
    window: Window[_Sums] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sums:
    """As in :class:`Spectra`."""

    slopes: Array
    commands: Array
    dither: Array


def accumulate(lock_in: LockIn, block: FrameBlock) -> tuple[LockIn, list[Spectra | WindowRefused]]:
    """Add a block of frames; return the new state and the windows that ended in it."""
    window, ended = cut(lock_in.plan, lock_in.window, block, _STEPS)
    return replace(lock_in, window=window), ended


def _begin(plan: LockInPlan, block: FrameBlock) -> _Sums:
    shape = plan.bins_hz.shape
    return _Sums(
        slopes=np.zeros((*shape, block.slopes.shape[1]), np.complex64),
        commands=np.zeros((*shape, block.commands_m.shape[1]), np.complex64),
        dither=np.zeros((shape[0], block.commands_m.shape[1]), np.complex64),
    )


def _add(plan: LockInPlan, window: Window[_Sums], block: FrameBlock, rows: slice) -> Window[_Sums]:
    n_rows = rows.stop - rows.start
    index = np.arange(n_rows) + (block.first_seq + rows.start - window.span.first_seq)
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * (index + 0.5) / plan.n_frames)
    turns = np.outer(plan.bins_hz.ravel() / plan.frame_rate_hz, index)
    phasors = (hann * np.exp(-2j * np.pi * turns)).astype(np.complex64)
    lines = phasors.reshape(*plan.bins_hz.shape, n_rows)[:, 0]
    # no block without dither columns comes this far
    dither = block.commands_m[:0] if block.dither_m is None else block.dither_m
    shape, sums = plan.bins_hz.shape, window.sums
    return replace(
        window,
        span=advanced(window.span, block, rows),
        sums=_Sums(
            slopes=sums.slopes + _project(phasors, block.slopes[rows]).reshape(*shape, -1),
            commands=sums.commands + _project(phasors, block.commands_m[rows]).reshape(*shape, -1),
            dither=sums.dither + _project(lines, dither[rows]),
        ),
    )


def _project(phasors: Array, columns: Array) -> Array:
    """Return ``phasors @ columns`` for real columns, as two real products."""
    return np.asarray(phasors.real @ columns + 1j * (phasors.imag @ columns))


def _close(plan: LockInPlan, window: Window[_Sums]) -> Spectra | WindowRefused:
    """Return the finished window, or why its dither is not the one asked for."""
    sums = window.sums
    weight = 0.5 * plan.n_frames / np.sqrt(2.0)
    applied = np.abs(sums.dither[np.arange(len(plan.modes)), list(plan.modes)]) / weight
    ratio = applied / np.array(plan.amplitude_m)
    if ratio.min() < MIN_AMPLITUDE_RATIO:
        weakest = int(ratio.argmin())
        return WindowRefused(
            reason=f"mode {plan.modes[weakest]} carries {applied[weakest] * 1e9:.2f} nm of dither "
            f"at {plan.frequencies_hz[weakest]} Hz, {plan.amplitude_m[weakest] * 1e9:.2f} nm were "
            "asked for: see whether the RTC clips it",
            t_ns_utc=window.span.next_t_ns,
        )
    return Spectra(
        plan=plan,
        session=window.span.session,
        cm_id=window.span.cm_id,
        first_seq=window.span.first_seq,
        t_end_ns_utc=window.span.next_t_ns - window.dt_ns,
        n_missing=window.span.n_missing,
        slopes=sums.slopes,
        commands=sums.commands,
        dither=sums.dither,
    )


_STEPS = Steps(begin=_begin, add=_add, close=_close)
