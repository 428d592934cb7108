"""What comes to the sensor besides the mirror's doing: turbulence, vibrations, played commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_rtc.atmosphere import FrozenLayer, cubic_weights
from sim_rtc.scene import PlayedTurbulence
from sim_rtc.seeing import SeeingSchedule
from sim_rtc.vibration import Vibrations

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_STEPS_TOGETHER = 350
"""Steps of a screen computed at a time: a product of 90 costs as much again for the copy of the
response that the library makes of it."""

_FRAMES_TOGETHER = 100
"""Frames interpolated at a time: the fewer, the fewer steps they do not lie between."""


class TurbulentFrames:
    """Consecutive frames of turbulence: phases, or what a linear response makes of them."""

    def __init__(self, parts: list[tuple[_LayerHistory, _Between]]) -> None:
        """Take for each layer where the frames lie in it."""
        self._parts = parts

    def phases_m(self, every: int = 1) -> Array32:
        """Return the OPD of each ``every``-th frame, ``(n_frames, n_points)``."""
        return _total([between.every(every).of(history.phases) for history, between in self._parts])

    def through(self, response: Array32) -> Array32:
        """Return ``response @ phase`` of every frame, ``(n_frames, n_outputs)``.

        ``response`` is ``(n_outputs, n_points)``. It is applied to the steps of the screens, which
        are fewer than the frames, and only to those it has not been applied to before.
        """
        return _total([between.of(history.responses(response)) for history, between in self._parts])


class Turbulence:
    """All layers together, in the seeing of the moment; frames are asked for in order."""

    def __init__(self, layers: tuple[FrozenLayer, ...], seeing: SeeingSchedule) -> None:
        """Take layers whose strength is that of the seeing at time 0."""
        self._histories = [_LayerHistory(layer) for layer in layers]
        self._seeing = seeing

    def at(self, time_s: Array) -> TurbulentFrames:
        """Return the frames at these times; they are good until the next call."""
        strength = self._seeing.strength(time_s)
        return TurbulentFrames(
            [(history, history.reach(time_s, strength)) for history in self._histories]
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sky:
    """The sources of a scene."""

    turbulence: Turbulence
    vibrations: Vibrations
    played: PlayedTurbulence | None = None
    """By day: the turbulence is played on the mirror and nothing of it is in the air."""

    def seen(self, time_s: Array) -> tuple[Array32, Array32 | None]:
        """Return what comes in, ``(n_frames, n_points)`` OPD, and the played commands, metres.

        The commands are ``(n_frames, n_modes)``; None: nothing is played.
        """
        frames = self.turbulence.at(time_s)
        shaken = self.vibrations.frames(len(time_s)) @ self.vibrations.phase_per_line.T
        if self.played is None:
            return shaken + frames.phases_m(), None
        return shaken, frames.through(self.played.commands_per_phase)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Between:
    """Frames between the steps of a layer: four of them make one frame."""

    step: NDArray[np.intp]
    """``(n_frames,)`` row in the history of the step before each frame."""

    weights: Array32
    """``(n_frames, 4)`` of the rows from ``step - 1`` on."""

    def every(self, n: int) -> _Between:
        """Return each n-th frame."""
        return _Between(step=self.step[::n], weights=self.weights[::n])

    def of(self, rows: Array32) -> Array32:
        """Return the frames ``(n_frames, n_columns)`` between these ``rows`` of the history."""
        out = np.empty((len(self.step), rows.shape[1]), dtype=np.float32)
        for start in range(0, len(out), _FRAMES_TOGETHER):
            piece = slice(start, start + _FRAMES_TOGETHER)
            step = self.step[piece]
            first = step[0] - 1
            near = np.zeros((len(step), step[-1] + 3 - first), dtype=np.float32)
            near[np.arange(len(step))[:, None], step[:, None] - first + np.arange(-1, 3)] = (
                self.weights[piece]
            )
            np.matmul(near, rows[first : step[-1] + 3], out=out[piece])
        return out


class _LayerHistory:
    """The last steps of one layer and some to come, and what the last response made of them."""

    def __init__(self, layer: FrozenLayer) -> None:
        self._layer = layer
        self._first_step = 0
        self.phases = layer.advance(0)
        """``(n_steps, n_points)``."""
        self._response: Array32 | None = None
        self._responses = np.empty((0, 0), dtype=np.float32)

    def reach(self, time_s: Array, strength: Array) -> _Between:
        """Keep the steps around these times; return where they lie between them.

        ``strength`` ``(n_frames,)`` is what the phases are multiplied by.
        """
        position = time_s * self._layer.steps_per_second + 1.0
        self._cover(int(position[0]) - 1, int(position[-1]) + 2)
        step = position.astype(np.intp)
        weights = cubic_weights(position - step) * strength[:, None]
        return _Between(step=step - self._first_step, weights=weights.astype(np.float32))

    def responses(self, response: Array32) -> Array32:
        """Return ``(n_steps, n_outputs)``."""
        if response is not self._response:
            self._response = response
            self._responses = np.empty((0, len(response)), dtype=np.float32)
        if len(self._responses) < len(self.phases):
            new = self.phases[len(self._responses) :] @ response.T
            self._responses = np.concatenate([self._responses, new])
        return self._responses

    def _cover(self, first_step: int, last_step: int) -> None:
        """Forget the steps before the first; add many at once when the last is not there yet."""
        known = self._first_step + len(self.phases)
        if last_step < known:
            return
        passed = min(first_step - self._first_step, len(self.phases))
        new = self._layer.advance(max(last_step + 1 - known, _STEPS_TOGETHER))
        self.phases = np.concatenate([self.phases[passed:], new])
        self._responses = self._responses[passed:]
        self._first_step += passed


def _total(parts: list[Array32]) -> Array32:
    total = parts[0]
    for part in parts[1:]:
        total += part
    return total
