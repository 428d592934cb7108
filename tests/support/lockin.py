"""What tests of several modules share of unit.estimation.test_lockin."""

from __future__ import annotations

import numpy as np

from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.records.estimates import WindowRefused
from tests.support.numerics import FRAME_RATE_HZ, block_of, sines

N_FRAMES = 1000


N_SLOPES, N_SMALL_MODES = 6, 5


PLAN = LockInPlan(
    modes=(3, 1),
    frequencies_hz=(230.0, 270.0),
    amplitude_m=(5e-9, 8e-9),
    frame_rate_hz=FRAME_RATE_HZ,
    n_frames=N_FRAMES,
    first_seq=100,
)


def telemetry(n_frames: int = 2500, plan: LockInPlan = PLAN) -> FrameBlock:
    """Noise with the dither in the commands, from frame 0."""
    rng = np.random.default_rng(7)
    dither = sines(plan, n_frames, N_SMALL_MODES)
    commands = dither + 1e-8 * rng.normal(size=dither.shape)
    return block_of(rng.normal(size=(n_frames, N_SLOPES)), commands, dither)


def run(*blocks: FrameBlock, plan: LockInPlan = PLAN) -> list[Spectra | WindowRefused]:
    lock_in, ended = LockIn(plan=plan), []
    for block in blocks:
        lock_in, more = lock_in.accumulate(block)
        ended += more
    return ended


def plan(*frequencies_hz: float, amplitude_m: float = 10e-9) -> LockInPlan:
    """Two of the modes that the loop does not control, one-second windows."""
    return LockInPlan(
        modes=(33, 37),
        frequencies_hz=frequencies_hz,
        amplitude_m=(amplitude_m, amplitude_m),
        frame_rate_hz=FRAME_RATE_HZ,
        n_frames=1000,
        first_seq=0,
    )
