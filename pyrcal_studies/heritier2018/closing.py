"""A loop around the study's telescope, batch by batch, and the gains that a ramp finds for it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.calibration import FRAME_COST_S
from pyrcal_studies.heritier2018.reconstructors import Inverse
from pyrcal_studies.heritier2018.store import Record, Store, Task
from pyrcal_studies.heritier2018.telescope import Occasion
from service.model.misregistration import Misregistration
from service.wire import RampRequest
from sim_rtc.computer.feed import BATCH_FRAMES, PhaseBlock
from sim_rtc.computer.gains import GROUP_ENDS, GainRamp
from sim_rtc.computer.loop import LoopBlock, LoopTerms, ModalLoop

Array32 = NDArray[np.float32]

DELAY_FRAMES = 2
LEAK = 0.999
STROKE_M = 10e-6
"""Largest command of a mode: a loop that diverges stays finite."""

RAMP_GAINS = (0.4, 0.6, 0.8, 1.0)
"""Tried in this order on every group."""

RAMP_START = 0.4
"""Of groups whose turn has not come."""

OVERHEAD_S = 2.5


class ClosedLoop:
    """The loop of an occasion, from rest, on the turbulence that all its loops share."""

    def __init__(
        self,
        occasion: Occasion,
        alpha: Misregistration,
        matrix: Array32,
        n_frames: int,
        *,
        played_modes: int | None = None,
    ) -> None:
        """Take the truth, and how many modes the played turbulence has (None: all there are)."""
        self.optics = telescope.optics(occasion, alpha)
        phases, played = telescope.incoming(occasion, n_frames)
        if played is not None and played_modes is not None:
            played = played.copy()
            played[:, played_modes:] = 0.0
        self.block = PhaseBlock(
            first_frame=0,
            optics=self.optics,
            phases_m=phases,
            played_m=played,
            detector=telescope.pixels(occasion, self.optics),
            rng=telescope.photons(occasion),
        )
        self.matrix = matrix
        self._loop = ModalLoop(
            n_modes=self.optics.opd_per_command.shape[1],
            delay_frames=DELAY_FRAMES,
            stroke_m=STROKE_M,
        )

    def batch(self, row: int, gains: NDArray[np.floating]) -> LoopBlock:
        """Run the batch of frames that begins at ``row`` with these gains, ``(n_controlled,)``."""
        terms = LoopTerms.of(self.optics, self.matrix, gains.astype(np.float32), LEAK)
        return self.block.run(row, self._loop, terms, None)

    def residual_m(self, row: int, result: LoopBlock) -> Array32:
        """Return the OPD ``(n_points,)`` left in the first frame of that batch."""
        return self.block.phase_at(row) + self.optics.mirror_opd_m(result.commands_m[0])

    def incoming_m(self, first: int) -> Array32:
        """Return each batch's first OPD before any correction, ``(n, n_points)``, from a row on."""
        coming = self.block.phases_m[first::BATCH_FRAMES]
        if self.block.played_m is None:
            return coming
        played = self.block.played_m[first::BATCH_FRAMES]
        return np.asarray(coming + played @ self.optics.opd_per_command.T)


@dataclass(frozen=True, slots=True, kw_only=True)
class GainTuning:
    """The paper's gain ramp: tip and tilt, modes to 100, the rest, each by its residual slopes."""

    occasion: Occasion
    alpha: Misregistration
    """The truth."""

    reconstructor: Inverse
    frames_per_gain: int
    """Half of them settle."""

    @property
    def label(self) -> str:
        """What the progress bar shows."""
        return f"gain ramp, {self.reconstructor.label}"

    @property
    def cost_s(self) -> float:
        """Rough time on one idle core, seconds."""
        return self.n_frames * FRAME_COST_S + OVERHEAD_S

    @property
    def needs(self) -> tuple[Task, ...]:
        """The reconstructor."""
        return (self.reconstructor,)

    @property
    def n_frames(self) -> int:
        """Frames it takes at most."""
        return self.frames_per_gain * len(RAMP_GAINS) * (len(GROUP_ENDS) + 1)

    def compute(self, store: Store) -> Record:
        """Return ``gains`` one per mode, and what was tried: ``group``, ``gain``, ``residual_nm``.

        ``by_group`` has the gain of each group.
        """
        matrix = store.read(self.reconstructor)["matrix"]
        ramp = GainRamp(
            (RAMP_START,) * len(matrix), self.request(len(matrix)), frame_rate_hz=1000.0
        )
        closed = ClosedLoop(self.occasion, self.alpha, matrix, self.n_frames)
        for row in range(0, self.n_frames, BATCH_FRAMES):
            if ramp.done:
                break
            modes = ramp.modes
            result = closed.batch(row, np.array(ramp.gains))
            ramp.take(result.slopes @ matrix[modes].T)
        return {
            "gains": np.array(ramp.gains),
            "by_group": np.array(ramp.gains_by_group),
            "group": np.array([step.group for step in ramp.steps]),
            "gain": np.array([step.gain for step in ramp.steps]),
            "residual_nm": np.array([step.residual_m * 1e9 for step in ramp.steps]),
        }

    def request(self, n_modes: int) -> RampRequest:
        """Return what would be asked of an RTC."""
        starts = (0, *(end for end in GROUP_ENDS if end < n_modes))
        return RampRequest(
            id="paper",
            groups=tuple((first, after - 1) for first, after in pairwise((*starts, n_modes))),
            gains=RAMP_GAINS,
            frames_per_gain=self.frames_per_gain,
        )
