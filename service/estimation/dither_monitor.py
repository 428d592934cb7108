"""Measure the dither in the telemetry, and the response of the slopes to it.

The telemetry contains the dither part of every command in separate columns, and modes outside the
loop move by nothing else. Once a second the amplitude of each mode at its frequency is compared
with the request, and the power of the slopes at these frequencies with the response of a mirror
that follows. Noise is measured next to the lines.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation.demodulation import cosines_and_sines
from service.estimation.estimator import Change, FrameContext, LoopContext, Mark, Streaming
from service.estimation.frames import FrameBlock
from service.estimation.loop import last_seq
from service.estimation.windows import ExpectedDither
from service.model.defects import list_ranges

Array = NDArray[Any]

CHECK_INTERVAL_S = 1.0
"""Duration of dithered frames between two results."""

MIN_FRAMES = 50

MAX_AMPLITUDE_RATIO, MIN_AMPLITUDE_RATIO = 1.25, 0.5
"""A mode is reported if its amplitude relative to the request is outside this range."""

MAX_AMPLIFICATION_RATIO = 3.0
"""Tolerated ratio of a mode's amplitude to its dither column if the loop has just begun to control
the mode: the status reports this up to a second after the frames show it."""

MAX_STRAY_SHARE = 0.2
"""Fraction of the requested amplitude that all other modes together may have."""

_MAX_LISTED_MODES = 4

_N_COMPARED_SLOPES = 8
"""Number of slopes per frame that are compared first, to decide if all must be."""

NOISE_OFFSETS_HZ = (-11, -7, -3, 3, 7, 11)
"""Frequencies at which the noise of the slopes is measured, relative to a line; whole periods per
second."""

MIN_RESPONSE_POWER_SHARE = 0.03
"""Share of the power expected below which, by 3 σ, nothing has moved: an optical gain of 0.17."""

MAX_REPEATED_SHARE = 0.02
"""Fraction of frames identical to the previous one above which the slopes count as frozen and are
not used."""

_nothing = partial(np.zeros, (), np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherMeasurement:
    """The dither in one second of frames."""

    found_m: float
    """RMS of all modes together, metres OPD."""

    asked_m: float
    text: str
    """Difference from the request in words; empty if there is none."""

    unanswered: str | None = None
    """Description of a missing response of the slopes; empty if they respond, None if there is too
    little light to decide."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitherMonitor:
    """Sums over the frames of a dither: feed it blocks with ``measured``."""

    asked: ExpectedDither
    n_frames: int = 0
    """Summed so far."""

    squares: Array = field(default_factory=_nothing)
    """``(n_modes,)`` sum of the squares of the dither columns, metres²."""

    lines: Array = field(default_factory=_nothing)
    """``(2, n_asked)`` dither columns and steps of the commands of the asked modes, demodulated."""

    last_m: Array | None = None
    """``(n_asked,)`` commands of the frame before the next block; None: it is not known."""

    next_seq: int = 0
    """The frame those are followed by."""

    slopes: Array = field(default_factory=_nothing)
    """``(2 * n_lines * (1 + n_sides), n_slopes)`` sums of slopes times cosines, then sines, on and
    next to each line."""

    n_repeated: int = 0
    """Frames with the very slopes of the frame before."""

    doubted: bool = False
    """True if the second before contained what the loop may have made of modes outside it."""

    powers: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Power of the slopes on the lines, its variance, and the expected power, summed until the
    response can be decided."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitherWatch(Streaming):
    """Checks that the requested dither is in the frames with the requested amplitude."""

    resets = Change.GONE | Change.RATE | Change.LOOP | Change.DITHER

    monitor: DitherMonitor | None = None
    """Measurement of its amplitude on the mirror; None if there is no dither or it cannot be
    measured."""

    measurement: DitherMeasurement | None = None
    """Result of the last second of frames; None if there are too few."""

    seen_seq: int = 0
    """Up to here the frames held it, or it need not have been there."""

    silent_s: float = 0.0
    """Duration for which frames that should contain the dither do not, seconds."""

    @classmethod
    @override
    def begin(cls, loop: LoopContext) -> DitherWatch:
        """Return one of the dither that plays; a status may announce one that began long ago."""
        dither, rtc = loop.dither, loop.rtc
        if dither is None or rtc is None:
            return cls()
        monitor = None if dither.plan is None else DitherMonitor(asked=dither)
        return cls(monitor=monitor, seen_seq=max(dither.first_seq, last_seq(rtc)))

    @override
    def restart(self, loop: LoopContext, why: Change) -> DitherWatch:
        """Return it for another dither, or for modes that have come into the loop, or left it."""
        if why != Change.LOOP:
            return self.begin(loop)
        if loop.dither is None or self.monitor is None:
            return self
        same = loop.dither.own == self.monitor.asked.own
        return self if same else replace(self, monitor=DitherMonitor(asked=loop.dither))

    @override
    def update(self, frames: FrameContext) -> DitherWatch:
        """Return the detector after one more block; frozen slopes are no missing response."""
        block, dither, watch = frames.block, frames.loop.dither, self
        if watch.monitor is not None:
            monitor, found = measure_block(watch.monitor, block)
            watch = replace(watch, monitor=monitor, measurement=found or watch.measurement)
        if Mark.STANDS in frames.marks:
            watch = replace(watch, measurement=None)
        if block.is_dithered:
            return replace(watch, seen_seq=block.next_seq, silent_s=0.0)
        if dither is None:
            return watch
        # Frames after the end of the dither need not contain it.
        silent = max(min(block.next_seq, dither.stop_seq) - watch.seen_seq, 0)
        return replace(watch, silent_s=silent / frames.rtc.frame_rate_hz)


def measure_block(
    monitor: DitherMonitor, block: FrameBlock
) -> tuple[DitherMonitor, DitherMeasurement | None]:
    """Add a block of frames; return what was found if a second of them is full."""
    asked, found = monitor.asked, None
    start = max(asked.first_seq - block.first_seq, 0)
    stop = max(min(asked.stop_seq - block.first_seq, block.n_frames), 0)
    while start < stop:
        end = min(start + _enough(asked) - monitor.n_frames, stop)
        monitor, new = _add_frames(monitor, block.rows(start, end))
        start, found = end, new or found
    return monitor, found


def _enough(asked: ExpectedDither) -> int:
    return max(round(CHECK_INTERVAL_S * asked.frame_rate_hz), MIN_FRAMES)


def _add_frames(
    monitor: DitherMonitor, block: FrameBlock
) -> tuple[DitherMonitor, DitherMeasurement | None]:
    """Add frames that fill a second at most."""
    asked, dither = monitor.asked, block.dither_m
    if dither is None or not block.is_dithered:
        return monitor, None
    squares = np.einsum("km,km->m", dither, dither).astype(float)
    monitor, lines = _demodulate(monitor, block, dither[:, list(asked.modes)])
    monitor = _add_slopes(monitor, block.slopes, block.first_seq)
    monitor = replace(
        monitor,
        n_frames=monitor.n_frames + len(dither),
        squares=monitor.squares + squares,
        lines=monitor.lines + lines,
    )
    if monitor.n_frames < _enough(asked):
        return monitor, None
    powers = _powers(monitor)
    unanswered = _check_response(powers, asked)
    found, doubted = _found(monitor)
    begun = DitherMonitor(
        asked=asked, last_m=monitor.last_m, next_seq=monitor.next_seq, doubted=doubted
    )
    if unanswered is None:
        begun = replace(begun, powers=powers)
    return begun, replace(found, unanswered=unanswered)


def _demodulate(
    monitor: DitherMonitor, block: FrameBlock, dither: Array
) -> tuple[DitherMonitor, Array]:
    """Return ``(2, n_asked)`` sums at the lines; random signs have none and are left out.

    Of the commands the steps from frame to frame: turbulence that is played on the mirror is slow.
    """
    asked = monitor.asked
    if not asked.frequency_hz:
        return monitor, np.zeros((2, len(asked.modes)), complex)
    commands = block.commands_m[:, list(asked.modes)].astype(float)
    # Across a gap the first step is unknown: it is set to 0.
    follows = monitor.last_m is not None and monitor.next_seq == block.first_seq
    before = monitor.last_m if follows else commands[0]
    steps = np.diff(commands, axis=0, prepend=np.asarray(before)[None])
    seq = block.first_seq + np.arange(len(commands))
    phasors = np.exp(-2j * np.pi * np.outer(seq / asked.frame_rate_hz, asked.frequency_hz))
    monitor = replace(monitor, last_m=commands[-1], next_seq=block.next_seq)
    return monitor, np.stack([(phasors * dither).sum(axis=0), (phasors * steps).sum(axis=0)])


def _add_slopes(monitor: DitherMonitor, slopes: Array, first_seq: int) -> DitherMonitor:
    """Add slopes to the sums on and next to the lines."""
    asked = monitor.asked
    lines = np.array(asked.frequency_hz)[asked.audible]
    if not len(lines):
        return monitor
    bins_hz = (lines[:, None] + np.array([0, *NOISE_OFFSETS_HZ])).ravel()
    seq = first_seq - asked.first_seq + np.arange(len(slopes))
    turns = np.outer(bins_hz / asked.frame_rate_hz, seq)
    summed = np.concatenate(cosines_and_sines(turns)) @ slopes
    first = slopes[:, :_N_COMPARED_SLOPES]
    # Only frames whose first slopes are those of the frame before are compared completely.
    again = 1 + np.flatnonzero((first[1:] == first[:-1]).all(axis=1))
    n_repeated = int(np.count_nonzero((slopes[again] == slopes[again - 1]).all(axis=1)))
    return replace(
        monitor, slopes=monitor.slopes + summed, n_repeated=monitor.n_repeated + n_repeated
    )


def _powers(monitor: DitherMonitor) -> tuple[float, float, float]:
    """Return the power on the lines above the noise, its variance, and the expected power.

    Earlier seconds are included if they were not sufficient for a decision.
    """
    asked, audible, before = monitor.asked, monitor.asked.audible, monitor.powers
    if not audible or monitor.n_repeated > MAX_REPEATED_SHARE * monitor.n_frames:
        return before
    parts = np.einsum("ks,ks->k", monitor.slopes, monitor.slopes).astype(float)
    power = parts.reshape(2, len(audible), -1).sum(axis=0)
    sides = power[:, 1:]
    beyond = np.sum(power[:, 0] - sides.mean(axis=1))
    # The second term is the error of the mean of the side bins, which was subtracted.
    variance = np.sum(sides.var(axis=1, ddof=1)) * (1.0 + 1.0 / sides.shape[1])
    expected = np.sum(np.abs(monitor.lines[0][audible]) ** 2 * np.array(asked.response)[audible])
    return before[0] + beyond, before[1] + variance, before[2] + expected


def _check_response(powers: tuple[float, float, float], asked: ExpectedDither) -> str | None:
    """Return how the slopes fail to answer the dither; empty: they answer; None: unknown."""
    beyond, variance, expected = powers
    if not expected:
        return None
    share, sigma = beyond / expected, np.sqrt(variance) / expected
    if share - 3.0 * sigma > MIN_RESPONSE_POWER_SHARE:
        return ""
    if share + 3.0 * sigma > MIN_RESPONSE_POWER_SHARE:
        return None
    modes = ", ".join(str(asked.modes[k]) for k in sorted(asked.audible))
    return (
        f"the slopes hold {100.0 * max(share, 0.0):.1f} ± {100.0 * sigma:.1f} % of the power that "
        f"modes {modes} should put on their lines"
    )


def _found(monitor: DitherMonitor) -> tuple[DitherMeasurement, bool]:
    """Return what a second of frames holds, and whether the loop may have made it of its dither."""
    asked = monitor.asked
    rms = np.sqrt(monitor.squares / monitor.n_frames)
    wanted, modes = np.array(asked.amplitude_m), list(asked.modes)
    # A sine of RMS a has the amplitude √2 a, of which half appears in the sum over n frames.
    reported_m, moved = np.abs(monitor.lines) * np.sqrt(2.0) / monitor.n_frames
    carried, own, doubted = rms[modes], np.array(asked.own), False
    if asked.frequency_hz:
        fraction = np.array(asked.frequency_hz) / asked.frame_rate_hz
        # Undoes the difference from frame to frame, which multiplies a sine by this factor.
        moved = moved / np.abs(2.0 * np.sin(np.pi * fraction))
        beyond = own & (moved > MAX_AMPLITUDE_RATIO * reported_m)
        doubted = bool(np.any(beyond & (moved <= MAX_AMPLIFICATION_RATIO * reported_m)))
        if doubted and not monitor.doubted:
            own = own & (moved > MAX_AMPLIFICATION_RATIO * reported_m)
        # a mode of the loop answers the dither: there its column alone tells how strong it is
        carried = np.maximum(carried, np.where(own, moved, 0.0))
    stray = rms.copy()
    stray[modes] = 0.0
    total = float(np.sqrt(np.sum(carried**2) + np.sum(stray**2)))
    wanted_total = float(np.sqrt(np.sum(wanted**2)))
    findings = [
        *_outside_tolerance(asked, carried, wanted, reported_m),
        *_strays(stray, wanted_total),
        *_find_hidden_modes(asked, own, reported_m, moved),
    ]
    head = f"the frames hold {1e9 * total:.3g} nm RMS of dither in total, requested were"
    text = f"{head} {1e9 * wanted_total:.3g} nm: {'; '.join(findings)}" if findings else ""
    return DitherMeasurement(found_m=total, asked_m=wanted_total, text=text), doubted


def _outside_tolerance(
    asked: ExpectedDither, carried: Array, wanted: Array, reported_m: Array
) -> list[str]:
    """Return requested modes with a wrong amplitude or frequency."""
    ratio = carried / wanted
    wrong = (ratio > MAX_AMPLITUDE_RATIO) | (ratio < MIN_AMPLITUDE_RATIO)
    findings = [
        f"mode {asked.modes[k]} carries {1e9 * carried[k]:.3g} nm "
        f"instead of {1e9 * wanted[k]:.3g} nm"
        for k in np.flatnonzero(wrong)[:_MAX_LISTED_MODES]
    ]
    if asked.frequency_hz:
        elsewhere = (ratio >= MIN_AMPLITUDE_RATIO) & (reported_m < MIN_AMPLITUDE_RATIO * carried)
        findings += [
            f"mode {asked.modes[k]} moves at another frequency than {asked.frequency_hz[k]:g} Hz"
            for k in np.flatnonzero(elsewhere)[:_MAX_LISTED_MODES]
        ]
    return findings


def _strays(stray: Array, wanted_m: float) -> list[str]:
    """Return the modes that carry a dither without a request."""
    together = float(np.sqrt(np.sum(stray**2)))
    if together <= MAX_STRAY_SHARE * wanted_m:
        return []
    worst = np.argsort(stray)[::-1]
    named = list_ranges(worst[stray[worst] > 0.0][:_MAX_LISTED_MODES])
    return [f"modes that were not requested carry {1e9 * together:.3g} nm, above all {named}"]


def _find_hidden_modes(
    asked: ExpectedDither, own: Array, reported_m: Array, moved: Array
) -> list[str]:
    """Return modes outside the loop that move more than their dither column says, or not at all.

    Commands that lack the dither look like slopes of the other sign where the loop answers it.
    """
    if not asked.frequency_hz:
        return []
    much = moved > MAX_AMPLITUDE_RATIO * reported_m + MIN_AMPLITUDE_RATIO * np.array(
        asked.amplitude_m
    )
    lacking = moved < MAX_STRAY_SHARE * reported_m
    hidden = np.flatnonzero(own & (much | lacking))
    return [
        f"the commands of mode {asked.modes[k]} hold {1e9 * moved[k]:.3g} nm at "
        f"{asked.frequency_hz[k]:g} Hz, its dither column {1e9 * reported_m[k]:.3g} nm"
        for k in hidden[:_MAX_LISTED_MODES]
    ]
