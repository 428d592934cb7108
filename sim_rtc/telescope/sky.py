"""Turbulence, vibrations and played commands on the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ConfigurationError
from sim_rtc.telescope.atmosphere import FrozenLayer, PhaseResponse, cubic_weights
from sim_rtc.telescope.imperfections import FOCUS, TILT, TIP, low_orders
from sim_rtc.telescope.scene import PlayedTurbulence

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_FRAMES_TOGETHER = 100
"""Frames interpolated together. The fewer, the fewer steps are read for nothing."""


class TurbulentFrames:
    """Consecutive frames of turbulence: phases, or a linear response to them."""

    def __init__(self, parts: list[_Between]) -> None:
        """Prepare the turbulence of frames at these positions in each layer."""
        self._parts = parts

    def phases_m(self, every: int = 1) -> Array32:
        """Return the OPD of each ``every``-th frame, ``(n_frames, n_points)``."""
        return _total([between.phases(every) for between in self._parts])

    def through(self, response: PhaseResponse) -> Array32:
        """Return ``response.matrix @ phase`` of every frame, ``(n_frames, n_outputs)``.

        Whatever is linear in the phase is interpolated in time as the phase is: it is computed for
        the steps of the screens, which are fewer than the frames.
        """
        return _total([between.through(response) for between in self._parts])


class Turbulence:
    """All layers together, scaled to the present seeing. Frames must be requested in order."""

    def __init__(self, layers: tuple[FrozenLayer, ...], seeing: SeeingSchedule) -> None:
        """Take layers whose strength is that of the seeing at time 0."""
        self._layers = layers
        self._seeing = seeing

    def at(self, time_s: Array) -> TurbulentFrames:
        """Return the frames at these times; they are good until the next call."""
        strength = self._seeing.strength(time_s)
        return TurbulentFrames([_Between.of(layer, time_s, strength) for layer in self._layers])

    def prepare(self, response: PhaseResponse) -> None:
        """Have ready what ``through`` needs of a response: it takes a second."""
        for layer in self._layers:
            response.spectra(layer)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sky:
    """The sources of a scene."""

    turbulence: Turbulence
    vibrations: Vibrations
    played: PlayedTurbulence | None = None
    """Turbulence played on the mirror by day, when there is none in the air; None at night."""

    def sample(self, time_s: Array) -> tuple[Array32, Array32 | None]:
        """Return the incoming OPD ``(n_frames, n_points)`` and the played commands, metres.

        The commands are ``(n_frames, n_modes)``; None: nothing is played.
        """
        frames = self.turbulence.at(time_s)
        shaken = self.vibrations.frames(len(time_s)) @ self.vibrations.phase_per_line.T
        if self.played is None:
            return shaken + frames.phases_m(), None
        return shaken, frames.through(self.played.response)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Between:
    """Frames between the steps of a layer: four of them make one frame."""

    layer: FrozenLayer
    step: NDArray[np.intp]
    """``(n_frames,)`` the step before each frame."""

    weights: Array32
    """``(n_frames, 4)`` of the steps from ``step - 1`` on."""

    @classmethod
    def of(cls, layer: FrozenLayer, time_s: Array, strength: Array) -> _Between:
        """Return the positions of these times in the layer.

        ``strength`` ``(n_frames,)`` is the factor of the phases.
        """
        # One step ahead: the cubic interpolation needs a step before the first frame.
        position = time_s * layer.steps_per_second + 1.0
        step = position.astype(np.intp)
        layer.reach(int(step[0]) - 1, int(step[-1]) + 2)
        weights = cubic_weights(position - step) * strength[:, None]
        return cls(layer=layer, step=step, weights=weights.astype(np.float32))

    def phases(self, every: int) -> Array32:
        """Return the phase of each ``every``-th frame ``(n_frames, n_points)``."""
        steps = self.step[::every, None] + np.arange(-1, 3)
        return self.layer.phases(steps, self.weights[::every], apart=every > 1)

    def through(self, response: PhaseResponse) -> Array32:
        """Return what the response makes of the frames ``(n_frames, n_outputs)``."""
        first_step = int(self.step[0]) - 1
        rows = self.layer.responses(first_step, response)
        out = np.empty((len(self.step), rows.shape[1]), dtype=np.float32)
        for start in range(0, len(out), _FRAMES_TOGETHER):
            piece = slice(start, start + _FRAMES_TOGETHER)
            row = self.step[piece] - first_step
            first = row[0] - 1
            near = np.zeros((len(row), row[-1] + 3 - first), dtype=np.float32)
            near[np.arange(len(row))[:, None], row[:, None] - first + np.arange(-1, 3)] = (
                self.weights[piece]
            )
            np.matmul(near, rows[first : row[-1] + 3], out=out[piece])
        return out


def _total(parts: list[Array32]) -> Array32:
    # In place: the parts are new arrays, and large ones.
    total = parts[0]
    for part in parts[1:]:
        total += part
    return total


@dataclass(frozen=True, slots=True, kw_only=True)
class SeeingSchedule:
    """The seeing at any time of a run."""

    start_arcsec: float
    """At time 0: FWHM at 500 nm, infinite outer scale."""

    later: tuple[tuple[float, float], ...] = ()
    """Times in seconds of loop time, and the seeing then, arcseconds; in any order."""

    def __post_init__(self) -> None:
        """Refuse two values for one time.

        Raises
        ------
        ConfigurationError
            If a time occurs twice.
        """
        times = sorted(time_s for time_s, _ in self.later)
        for earlier, later in pairwise(times):
            if earlier == later:
                raise ConfigurationError(f"--seeing-at: found {later:g} s twice; expected once")

    @property
    def changes(self) -> bool:
        """Return True if the seeing changes during the run."""
        return any(arcsec != self.start_arcsec for _, arcsec in self.later)

    def arcsec(self, time_s: Array) -> Array:
        """Return the seeing at these times, arcseconds.

        Between two times its logarithm follows ``3 t² - 2 t³``: no kink, no overshoot.
        """
        knots = sorted([(0.0, self.start_arcsec), *self.later])
        times, values = np.array(knots).T
        rise = np.diff(np.log(values), prepend=np.log(values[0]))
        width = np.diff(times, prepend=-1.0)
        share = np.clip((time_s[..., None] - times + width) / width, 0.0, 1.0)
        eased = share**2 * (3.0 - 2.0 * share)
        return np.asarray(values[0] * np.exp(eased @ rise))

    def strength(self, time_s: Array) -> Array:
        """Return the amplitude of the turbulence at these times over that at time 0.

        The variance of the phase goes with ``r0^(-5/3)`` and r0 with the inverse of the seeing,
        the outer scale staying as it is.
        """
        return np.asarray((self.arcsec(time_s) / self.start_arcsec) ** (5 / 6))


class Shape(StrEnum):
    """Shapes of vibrations."""

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
    """Damping of the oscillator driven by noise, relative to the critical one; 0 for a pure sine.
    """


DAYTIME_LINES = (
    VibrationLine(shape=Shape.TIP, frequency_hz=13.0, rms_m=60e-9),
    VibrationLine(shape=Shape.TILT, frequency_hz=22.0, rms_m=40e-9),
    VibrationLine(shape=Shape.FOCUS, frequency_hz=47.0, rms_m=15e-9),
)
"""Default vibrations of a telescope by day: swinging arms, pumps, fans."""


class Vibrations:
    """Wavefronts of the lines at the frames of a run. Frames must be requested in order."""

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
        # The first two values are drawn from the stationary distribution, so that the line does not
        # have to build up.
        before = line.rms_m * rng.standard_normal()
        last = (
            correlation * before
            + line.rms_m * np.sqrt(1.0 - correlation**2) * rng.standard_normal()
        )
        self._state = np.array([-a1 * last - a2 * before, -a2 * last])
        self._rng = rng
        self._filter = scipy.signal.lfilter  # its import takes a second: not between frames

    def next(self, n_frames: int) -> Array:
        noise = self._noise * self._rng.standard_normal(n_frames)
        moved, self._state = self._filter([1.0], self._denominator, noise, zi=self._state)
        return np.asarray(moved)


def _oscillator(
    line: VibrationLine, frame_rate_hz: float, rng: np.random.Generator
) -> _Sine | _Shaken:
    step = 2 * np.pi * line.frequency_hz / frame_rate_hz
    return _Sine(line, step, rng) if line.damping == 0.0 else _Shaken(line, step, rng)
