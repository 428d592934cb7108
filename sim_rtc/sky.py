"""What comes to the sensor besides the mirror's doing: turbulence, vibrations, played commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_rtc.flow import FrozenLayer, PhaseResponse, cubic_weights
from sim_rtc.scene import PlayedTurbulence
from sim_rtc.seeing import SeeingSchedule
from sim_rtc.vibration import Vibrations

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_FRAMES_TOGETHER = 100
"""Frames interpolated at a time: the fewer, the fewer steps they do not lie between."""


class TurbulentFrames:
    """Consecutive frames of turbulence: phases, or what a linear response makes of them."""

    def __init__(self, parts: list[tuple[FrozenLayer, _Between]]) -> None:
        """Take for each layer where the frames lie in it."""
        self._parts = parts

    def phases_m(self, every: int = 1) -> Array32:
        """Return the OPD of each ``every``-th frame, ``(n_frames, n_points)``."""
        return _total(
            [between.every(every).phases(layer, apart=every > 1) for layer, between in self._parts]
        )

    def through(self, response: PhaseResponse) -> Array32:
        """Return ``response.matrix @ phase`` of every frame, ``(n_frames, n_outputs)``.

        Whatever is linear in the phase is interpolated in time as the phase is: it is computed for
        the steps of the screens, which are fewer than the frames.
        """
        return _total([between.through(layer, response) for layer, between in self._parts])


class Turbulence:
    """All layers together, in the seeing of the moment; frames are asked for in order."""

    def __init__(self, layers: tuple[FrozenLayer, ...], seeing: SeeingSchedule) -> None:
        """Take layers whose strength is that of the seeing at time 0."""
        self._layers = layers
        self._seeing = seeing

    def at(self, time_s: Array) -> TurbulentFrames:
        """Return the frames at these times; they are good until the next call."""
        strength = self._seeing.strength(time_s)
        return TurbulentFrames(
            [(layer, _Between.of(layer, time_s, strength)) for layer in self._layers]
        )

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
    """By day: the turbulence is played on the mirror and nothing of it is in the air."""

    def seen(self, time_s: Array) -> tuple[Array32, Array32 | None]:
        """Return what comes in, ``(n_frames, n_points)`` OPD, and the played commands, metres.

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

    step: NDArray[np.intp]
    """``(n_frames,)`` the step before each frame."""

    weights: Array32
    """``(n_frames, 4)`` of the steps from ``step - 1`` on."""

    @classmethod
    def of(cls, layer: FrozenLayer, time_s: Array, strength: Array) -> _Between:
        """Return where these times lie, the layer having gone as far.

        ``strength`` ``(n_frames,)`` is what the phases are multiplied by.
        """
        position = time_s * layer.steps_per_second + 1.0
        step = position.astype(np.intp)
        layer.reach(int(step[0]) - 1, int(step[-1]) + 2)
        weights = cubic_weights(position - step) * strength[:, None]
        return cls(step=step, weights=weights.astype(np.float32))

    def every(self, n: int) -> _Between:
        """Return each n-th frame."""
        return _Between(step=self.step[::n], weights=self.weights[::n])

    def phases(self, layer: FrozenLayer, *, apart: bool) -> Array32:
        """Return the phase of the frames ``(n_frames, n_points)``."""
        return layer.phases(self.step[:, None] + np.arange(-1, 3), self.weights, apart=apart)

    def through(self, layer: FrozenLayer, response: PhaseResponse) -> Array32:
        """Return what the response makes of the frames ``(n_frames, n_outputs)``."""
        first_step = int(self.step[0]) - 1
        rows = layer.responses(first_step, response)
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
    total = parts[0]
    for part in parts[1:]:
        total += part
    return total
