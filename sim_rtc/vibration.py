"""Vibrations: lines on tip, tilt and focus that the telescope adds to the wavefront."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from sim_rtc.shapes import FOCUS, TILT, TIP, low_orders

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


class Shape(StrEnum):
    """What vibrates."""

    TIP = "tip"
    """Tilt of the wavefront along +x."""

    TILT = "tilt"
    """Tilt of the wavefront along +y."""

    FOCUS = "focus"


_COLUMNS = {Shape.TIP: TIP, Shape.TILT: TILT, Shape.FOCUS: FOCUS}


@dataclass(frozen=True, slots=True, kw_only=True)
class VibrationLine:
    """One line of the vibration spectrum."""

    shape: Shape
    frequency_hz: float
    rms_m: float
    """Wavefront on the sensor, metres RMS over pupil and time."""

    damping: float = 0.01
    """Of the oscillator that noise shakes, over the critical one; 0: a pure sine."""


DAYTIME_LINES = (
    VibrationLine(shape=Shape.TIP, frequency_hz=13.0, rms_m=60e-9),
    VibrationLine(shape=Shape.TILT, frequency_hz=22.0, rms_m=40e-9),
    VibrationLine(shape=Shape.FOCUS, frequency_hz=47.0, rms_m=15e-9),
)
"""What shakes a telescope by day when nothing else is asked for: swinging arms, pumps, fans."""


class Vibrations:
    """Wavefronts of the lines at the frames of a run, asked for in order."""

    def __init__(
        self,
        lines: tuple[VibrationLine, ...],
        *,
        points: Array,
        weights: Array,
        frame_rate_hz: float,
        rng: np.random.Generator,
    ) -> None:
        """Take the pupil points ``(n_points, 2)`` in any unit, and their share of the area."""
        shapes = low_orders(points, weights, 2)
        self.phase_per_line: Array32 = shapes[:, [_COLUMNS[line.shape] for line in lines]].astype(
            np.float32
        )
        """``(n_points, n_lines)`` OPD per metre RMS."""
        self._oscillators = [
            _oscillator(line, frame_rate_hz, child)
            for line, child in zip(lines, rng.spawn(len(lines)), strict=True)
        ]

    def frames(self, n_frames: int) -> Array32:
        """Return the strengths of the next frames ``(n_frames, n_lines)``, metres RMS."""
        strengths = [oscillator.next(n_frames) for oscillator in self._oscillators]
        return np.array(strengths, dtype=np.float32).reshape(-1, n_frames).T


class _Sine:
    """A sine of random phase."""

    def __init__(self, line: VibrationLine, step: float, rng: np.random.Generator) -> None:
        self._amplitude = line.rms_m * np.sqrt(2.0)
        self._step = step
        self._start = rng.uniform(0.0, 2 * np.pi)
        self._frame = 0

    def next(self, n_frames: int) -> Array:
        angle = self._start + self._step * (self._frame + np.arange(n_frames))
        self._frame += n_frames
        return np.asarray(self._amplitude * np.sin(angle))


class _Shaken:
    """A damped oscillator shaken by white noise: ``x[k] = 2 ρ cos θ x[k-1] - ρ² x[k-2] + noise``.

    Its line is as wide as its damping; amplitude and phase wander, the RMS is exact.
    """

    def __init__(self, line: VibrationLine, step: float, rng: np.random.Generator) -> None:
        decay = np.exp(-line.damping * step)
        turn = step * np.sqrt(1.0 - line.damping**2)
        a1, a2 = -2.0 * decay * np.cos(turn), decay**2
        self._denominator = np.array([1.0, a1, a2])
        # Variance of an AR(2) process driven by unit noise.
        gain2 = (1.0 + a2) / ((1.0 - a2) * ((1.0 + a2) ** 2 - a1**2))
        self._noise = line.rms_m / np.sqrt(gain2)
        correlation = -a1 / (1.0 + a2)
        before = line.rms_m * rng.standard_normal()
        last = (
            correlation * before
            + line.rms_m * np.sqrt(1.0 - correlation**2) * rng.standard_normal()
        )
        self._state = np.array([-a1 * last - a2 * before, -a2 * last])
        self._rng = rng

    def next(self, n_frames: int) -> Array:
        noise = self._noise * self._rng.standard_normal(n_frames)
        moved, self._state = lfilter([1.0], self._denominator, noise, zi=self._state)
        return np.asarray(moved)


def _oscillator(
    line: VibrationLine, frame_rate_hz: float, rng: np.random.Generator
) -> _Sine | _Shaken:
    step = 2 * np.pi * line.frequency_hz / frame_rate_hz
    return _Sine(line, step, rng) if line.damping == 0.0 else _Shaken(line, step, rng)
