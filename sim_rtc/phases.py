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

from sim_rtc.diffractive_plant import DiffractiveOptics
from sim_rtc.feed import BATCH_FRAMES, batch_boundary, batch_rows
from sim_rtc.loop import ControlTerms, LoopBlock, ModalLoop
from sim_rtc.motion import MovingOptics
from sim_rtc.pixels import PixelDetector
from sim_rtc.sky import Sky

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
    """``(n_frames, n_points)`` what comes in and stuck actuators; n_frames: whole batches."""

    played_m: Array32 | None
    """``(n_frames, n_modes)`` turbulence played on the mirror; None: none is."""

    detector: PixelDetector
    rng: np.random.Generator
    """Of the photons; used by the loop's thread alone."""

    @property
    def n_frames(self) -> int:
        """Frames of the block."""
        return len(self.phases_m)

    @property
    def batch_frames(self) -> int:
        """Frames of a batch: each takes milliseconds, so a message has few of them."""
        return BATCH_FRAMES

    def phase_at(self, row: int) -> Array32:
        """Return the OPD ``(n_points,)`` of a frame, commands left out."""
        return np.asarray(self.phases_m[row])

    def run(
        self, row: int, loop: ModalLoop, terms: ControlTerms, dither_m: Array32 | None
    ) -> LoopBlock:
        """Run the batch that begins at ``row`` through the loop."""

        def sense(k: int, command_m: Array32) -> Array32:
            opd_m = self.optics.mirror_opd_m(command_m)
            opd_m += self.phases_m[row + k]
            return self.optics.slopes(opd_m, self.detector, self.rng)

        played = batch_rows(self.played_m, row, BATCH_FRAMES)
        return loop.run_frames(BATCH_FRAMES, sense, terms, dither_m, played)


class PhaseFeed:
    """Blocks of phases, one after the other for ever."""

    batch_frames = BATCH_FRAMES

    def __init__(
        self,
        *,
        sky: Sky,
        optics: MovingOptics,
        detector: PixelDetector,
        frame_rate_hz: float,
        jump_times_s: tuple[float, ...],
        rng: np.random.Generator,
    ) -> None:
        self._sky = sky
        self._optics = optics
        self._detector = detector
        self._frame_rate_hz = frame_rate_hz
        self._jump_frames = [batch_boundary(time, frame_rate_hz) for time in jump_times_s]
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
            phases, played = self._sky.seen(time_s)
            phases += optics.stuck_opd_m
            yield PhaseBlock(
                first_frame=frame,
                optics=optics,
                phases_m=phases,
                played_m=played,
                detector=self._detector,
                rng=self._rng,
            )
            frame += n_frames
