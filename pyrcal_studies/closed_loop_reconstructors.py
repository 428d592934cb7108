"""Measured against synthetic matrix, and least squares against MAP, in closed loop.

By day on the diffractive telescope: 400 modes are measured with noise, the model is fitted to the
matrix, its columns tuned by the fitted gains, and the loop closed on the same sky with every
reconstructor. With more modes than were measured only the synthetic matrix goes on. The gate judges
each before it is used. Run: ``python -m pyrcal_studies.closed_loop_reconstructors --seeds 3``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.registered import (
    N_MEASURED,
    PASSES,
    Registered,
    measured_by_day,
    registered,
    telescope_of,
)
from service.control.gains import CalibrationGains
from service.control.gate import GateVerdict, judge
from service.control.loop import ControlLoop
from service.control.reconstructor import InversionMethod, Prior, Recipe, reconstruct
from service.instrument import load_instrument
from service.model.interaction import InteractionModel, Linearisation
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from sim_rtc.computer.feed import BATCH_FRAMES
from sim_rtc.computer.loop import LoopTerms, ModalLoop

Array32 = NDArray[np.float32]

SETTLING_FRAMES = 300
STROKE_M = 1e-5
BOUND = 0.95
SIGMA = np.array([0.002, 0.002, np.deg2rad(0.01), 0.0005])
"""1 σ of a registration fitted to 400 modes, model error included (numeric units)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """One reconstructor to be tried."""

    name: str
    matrix: Array32
    condition_number: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Dome:
    """What every loop of a seed has in common."""

    words: str
    """Options of the simulator."""

    gain: float
    n_frames: int
    """Judged, after settling."""


def candidates(
    model: InteractionModel, measured: NDArray[np.float64], fit: Registered, noise: float
) -> Iterator[Candidate]:
    """Yield the reconstructors, the measured matrix's own first."""
    synthetic = model.interaction_matrix(fit.alpha)
    n_basis = synthetic.shape[1]
    gains = CalibrationGains.of_modes(fit.gains, np.arange(N_MEASURED), n_basis)
    tuned = gains.tuned(synthetic)
    prior = Prior(variance_m2=model.basis.variance_m2, slope_noise=np.full(len(synthetic), noise))
    sources = [("measured", measured, InversionMethod.SVD, N_MEASURED)]
    sources += [("synthetic, gains 1", synthetic, InversionMethod.SVD, N_MEASURED)]
    for n_modes in (N_MEASURED, 500, n_basis):
        sources += [("synthetic, tuned", tuned, method, n_modes) for method in InversionMethod]
    for name, matrix, method, n_modes in sources:
        recipe = Recipe(n_modes=n_modes, prior=prior if method is InversionMethod.MAP else None)
        made = reconstruct(matrix, recipe)
        yield Candidate(
            name=f"{name}, {method} {n_modes}",
            matrix=made.matrix,
            condition_number=made.condition_number,
        )


def verdict(
    candidate: Candidate, linear: Linearisation, alpha: Misregistration, gain: float
) -> GateVerdict:
    """Return what the gate says, by day: the sensor shows twice the model's response."""
    loop = ControlLoop(
        frame_rate_hz=1000.0,
        gains=np.full(len(candidate.matrix), gain),
        leak=1.0,
        delay_frames=2.0,
        optical_gain=float(PASSES),
    )
    return judge(candidate.matrix, linear, alpha, np.diag(SIGMA**2), loop, bound=BOUND)


def wavefront_error_nm(matrix: Array32, dome: Dome) -> float:
    """Return the RMS of the residual wavefront of a closed loop, metres at the sensor in nm."""
    telescope = telescope_of(dome.words)
    weights = telescope.weights.astype(np.float32)
    loop = ModalLoop(
        n_modes=len(telescope.settings.gains),
        delay_frames=2,
        stroke_m=STROKE_M,
        drive=telescope.drive,
    )
    gains = np.full(len(matrix), dome.gain, dtype=np.float32)
    power: list[float] = []
    for block in telescope.feed.blocks():
        terms = LoopTerms.of(block.optics, matrix, gains, 1.0)
        for row in range(0, block.n_frames, BATCH_FRAMES):
            commands = block.run(row, loop, terms, None).commands_m
            # every second frame: the residual changes little from one to the next
            for k in range(0, len(commands), 2):
                left = block.phase_at(row + k) + block.optics.opd_per_command @ commands[k]
                left = left - weights @ left
                power.append(float(weights @ left**2))
        if 2 * len(power) >= dome.n_frames + SETTLING_FRAMES:
            break
    return float(1e9 * np.sqrt(np.mean(power[SETTLING_FRAMES // 2 :])))


def main() -> None:
    """Print a row for every seed and reconstructor."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each loop, after settling")
    parser.add_argument("--mag", default="7")
    parser.add_argument("--gain", type=float, default=0.3, help="doubled by the second pass")
    parser.add_argument("--averages", type=int, default=4, help="push-pulls per mode")
    parser.add_argument("--truth", default="usual", help="imperfections of the telescope")
    parser.add_argument("--only", default="", help="part of the reconstructors' names")
    given = parser.parse_args()
    instrument = load_instrument("flao-lbt")
    model = InteractionModel(instrument, karhunen_loeve_basis(instrument))
    sys.stdout.write("| seed | reconstructor | condition | pole radius | nm |\n")
    sys.stdout.write("| --- | --- | --- | --- | --- |\n")
    with threadpool_limits(1):
        for seed in range(given.first_seed, given.first_seed + given.seeds):
            words = (
                f"--plant diffractive --scene daytime --seed {seed} --mag {given.mag} "
                f"--imperfections {given.truth}"
            )
            n_frames = round(given.seconds * 1000)
            dome = Dome(words=words, gain=given.gain, n_frames=n_frames)
            measured, telescope = measured_by_day(words, given.averages)
            fit = registered(model, measured)
            noise = float(np.median(telescope.detector.sigma))
            linear = model.linearise(fit.alpha)
            for candidate in candidates(model, measured, fit, noise):
                if given.only not in candidate.name:
                    continue
                gate = verdict(candidate, linear, fit.alpha, given.gain)
                error = wavefront_error_nm(candidate.matrix, dome)
                sys.stdout.write(
                    f"| {seed} | {candidate.name} | {candidate.condition_number:.2f} | "
                    f"{gate.worst_pole_radius:.3f} | {error:.1f} |\n"
                )
                sys.stdout.flush()


if __name__ == "__main__":
    main()
