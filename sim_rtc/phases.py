"""What a diffractive plant sees without the mirror: the turbulence's phase, frame by frame.

Screens are extruded a row at a time and the phase is interpolated between rows for every frame, in
a thread of its own and ahead of the loop. Slopes follow one frame at a time, when the loop knows
what the mirror is doing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_rtc.atmosphere import FrozenLayer, cubic_weights
from sim_rtc.diffractive_plant import DiffractiveOptics
from sim_rtc.feed import BATCH_FRAMES
from sim_rtc.loop import ControlTerms, LoopBlock, ModalLoop
from sim_rtc.motion import MovingOptics
from sim_rtc.pixels import PixelDetector

Array32 = NDArray[np.float32]

_BLOCK_BATCHES = 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhaseBlock:
    """Consecutive frames through one set of diffractive optics, commands left out."""

    first_frame: int
    """Number of row 0 since the start of the run."""

    optics: DiffractiveOptics
    """Valid for all of it."""

    phases_m: Array32
    """``(n_frames, n_points)`` turbulence and stuck actuators; n_frames a multiple of the batch."""

    detector: PixelDetector
    rng: np.random.Generator
    """Of the photons; used by the loop's thread alone."""

    @property
    def n_frames(self) -> int:
        """Frames of the block."""
        return len(self.phases_m)

    def phase_at(self, row: int) -> Array32:
        """Return the OPD ``(n_points,)`` of a frame, commands left out."""
        return np.asarray(self.phases_m[row])

    def run(
        self, row: int, loop: ModalLoop, terms: ControlTerms, dither_m: Array32 | None
    ) -> LoopBlock:
        """Run the batch that begins at ``row`` through the loop."""

        def sense(k: int, command_m: Array32) -> Array32:
            opd_m = self.optics.opd_per_command @ command_m
            opd_m += self.phases_m[row + k]
            return self.optics.slopes(opd_m, self.detector, self.rng)

        return loop.run_frames(BATCH_FRAMES, sense, terms, dither_m)


class PhaseFeed:
    """Blocks of phases, one after the other for ever."""

    def __init__(
        self,
        *,
        layers: tuple[FrozenLayer, ...],
        optics: MovingOptics,
        detector: PixelDetector,
        frame_rate_hz: float,
        jump_times_s: tuple[float, ...],
        rng: np.random.Generator,
    ) -> None:
        self._histories = [_LayerPhases(layer) for layer in layers]
        self._optics = optics
        self._detector = detector
        self._frame_rate_hz = frame_rate_hz
        self._jump_frames = [
            int(np.ceil(time_s * frame_rate_hz / BATCH_FRAMES)) * BATCH_FRAMES
            for time_s in jump_times_s
        ]
        self._rng = rng

    def blocks(self) -> Iterator[PhaseBlock]:
        """Yield the blocks; one ends where a jump falls."""
        frame = 0
        while True:
            n_frames = min(
                [_BLOCK_BATCHES * BATCH_FRAMES]
                + [jump - frame for jump in self._jump_frames if jump > frame]
            )
            time_s = (frame + np.arange(n_frames)) / self._frame_rate_hz
            optics = self._optics.at(float(time_s[0]))
            if not isinstance(optics, DiffractiveOptics):
                raise TypeError(f"feed: found {type(optics).__name__}; expected DiffractiveOptics")
            phases = np.tile(optics.stuck_opd_m, (n_frames, 1))
            for history in self._histories:
                phases += history.frames(time_s)
            yield PhaseBlock(
                first_frame=frame,
                optics=optics,
                phases_m=phases,
                detector=self._detector,
                rng=self._rng,
            )
            frame += n_frames


class _LayerPhases:
    """The last steps of one layer."""

    def __init__(self, layer: FrozenLayer) -> None:
        self._layer = layer
        self._first_step = 0
        self._phases = layer.advance(1)

    def frames(self, time_s: NDArray[np.float64]) -> Array32:
        """Return the phases ``(n_frames, n_points)`` at these times, later than all before."""
        position = time_s * self._layer.steps_per_second + 1.0
        self._cover(int(position[0]) - 1, int(position[-1]) + 2)
        step = position.astype(np.intp)
        weights = np.zeros((len(time_s), len(self._phases)), dtype=np.float32)
        rows = np.arange(len(time_s))[:, None]
        weights[rows, step[:, None] - self._first_step + np.arange(-1, 3)] = cubic_weights(
            position - step
        )
        return np.asarray(weights @ self._phases)

    def _cover(self, first_step: int, last_step: int) -> None:
        known = self._first_step + len(self._phases)
        new = self._layer.advance(last_step + 1 - known)
        self._phases = np.concatenate([self._phases, new])[first_step - self._first_step :]
        self._first_step = first_step
