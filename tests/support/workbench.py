"""What tests of several modules share of unit.runtime.test_workbench."""

from __future__ import annotations

import numpy as np

from service.control.dither import COARSE_BAND, spread_lines, spread_modes
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.estimation.windows import ClosedLoop
from service.model.misregistration import Misregistration

ALPHA = Misregistration(
    shift_x_subap=0.12, shift_y_subap=-0.08, rotation_rad=0.004, magnification=1.003
)


LINES = (210.0, 240.0, 280.0, 330.0)


MODES = (63, 69, 75, 81)


AMPLITUDE_M = 2e-8


def dithered_window(bench, alpha, *, gain=1.0, noise=1e-4, seed=1):
    """An open loop with a dither and noise: slopes are D(α) times the commands."""
    rng = np.random.default_rng(seed)
    matrix = bench._model.interaction_matrix(alpha)
    time = np.arange(1000) / 1000.0
    dither = np.zeros((1000, matrix.shape[1]), np.float32)
    for mode, line in zip(MODES, LINES, strict=True):
        dither[:, mode] = AMPLITUDE_M * np.sqrt(2) * np.sin(2 * np.pi * line * time)
    slopes = gain * dither @ matrix.T + noise * rng.standard_normal((1000, len(matrix)))
    block = FrameBlock(
        session="s1",
        first_seq=0,
        t0_ns_utc=0,
        dt_ns=1_000_000,
        slopes=slopes.astype(np.float32),
        commands_m=dither,
        dither_m=dither,
        cm_id="initial",
    )
    plan = LockInPlan(
        modes=MODES,
        frequencies_hz=LINES,
        amplitude_m=(AMPLITUDE_M,) * 4,
        frame_rate_hz=1000.0,
        n_frames=1000,
        first_seq=0,
    )
    _, (window,) = LockIn(plan=plan).accumulate(block)
    assert isinstance(window, Spectra)
    return window


def open_loop(reconstructor):
    return ClosedLoop(
        reconstructor=reconstructor,
        gains=np.zeros(90),
        leak=0.999,
        delay_frames=2.0,
        frame_rate_hz=1000.0,
    )


FAR = Misregistration(
    shift_x_subap=-1.2, shift_y_subap=0.8, rotation_rad=np.deg2rad(5.0), magnification=0.96
)


def window(bench, reach=COARSE_BAND, *, seed=1, noise=1e-3):
    """An open loop whose mirror lies at ``FAR``, with half the model's response."""
    lines = spread_lines(1000.0, 1.0, 8)
    matrix = bench._model.interaction_matrix(FAR)
    modes = spread_modes(reach, matrix.shape[1], len(lines))
    plan = LockInPlan(
        modes=modes,
        frequencies_hz=lines[: len(modes)],
        amplitude_m=(5e-8,) * len(modes),
        frame_rate_hz=1000.0,
        n_frames=1000,
        first_seq=0,
    )
    turns = np.outer(np.arange(1000) / 1000.0, plan.frequencies_hz)
    dither = np.zeros((1000, matrix.shape[1]), np.float32)
    dither[:, list(modes)] = 5e-8 * np.sqrt(2) * np.sin(2 * np.pi * turns)
    rng = np.random.default_rng(seed)
    slopes = 0.5 * dither @ matrix.T + noise * rng.standard_normal((1000, len(matrix)))
    block = FrameBlock(
        session="s1",
        first_seq=0,
        t0_ns_utc=0,
        dt_ns=1_000_000,
        slopes=slopes.astype(np.float32),
        commands_m=dither,
        dither_m=dither,
        cm_id=None,
    )
    _, (spectra,) = LockIn(plan=plan).accumulate(block)
    return spectra
