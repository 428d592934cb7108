"""How far models of the pyramid lead astray at its working point.

The response of the diffractive telescope to a few modes is averaged, free of noise, over the
residual wavefronts of its own closed loop, and three models are fitted to it: the response to a
flat wavefront, the one at the working point that the instrument's r0 leads to expect, and the one
that follows the optical gains, as the service does. What remains is the floor that no integration
removes. Beside it, the flat model at a flat wavefront: what the drawing alone gets wrong. Run:
``python -m pyrcal_studies.working_point``.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.optical_gain import PROBE_M, closed_loop, telescope_of
from pyrcal_studies.registered import against, step_of
from service.instrument import load_instrument
from service.model.interaction import InteractionModel, Linearisation
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.model.modes import karhunen_loeve_basis
from service.model.sensors.pyramid.working_point import working_point
from sim_rtc.options import parse_options
from sim_rtc.telescope.diffractive import DiffractiveOptics

Array32 = NDArray[np.float32]

GAIN = 0.6
SNAPSHOT_FRAMES = 20
SETTLED_FRAMES = 500

SETS = ((409, 427, 445, 463), (405, 428, 451, 471), (409, 428, 451, 471), (451, 471, 485, 499))
"""Dithered together: evenly spread, then those that tell more and more of the rotation."""

MODES = tuple(sorted({mode for modes in SETS for mode in modes}))


def mean_columns(optics: DiffractiveOptics, residuals_m: Array32, n_modes: int) -> Array32:
    """Return the dithered columns of the interaction matrix, averaged over these wavefronts."""
    rng = np.random.default_rng(0)
    columns = np.zeros((optics.n_slopes, n_modes), dtype=np.float32)
    for mode in MODES:
        probe = PROBE_M * optics.opd_per_command[:, mode]
        for residual in residuals_m:
            push, pull = (optics.slopes(residual + s * probe, None, rng) for s in (1, -1))
            columns[:, mode] += (push - pull) / (2 * PROBE_M * len(residuals_m))
    return columns


def error_of(
    linearisation: Linearisation, columns: Array32, modes: tuple[int, ...]
) -> tuple[NDArray[np.float64], float]:
    """Return the error of α ``(4,)``, boundary units, about the truth, and the mean gain."""
    seen = against(linearisation, columns[:, list(modes)], modes)
    return step_of(seen) * BOUNDARY_SCALE, float(np.mean(seen.gains))


def main() -> None:
    """Print the error of each telescope by each model, for each set of modes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--telescopes", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=1.5, help="of each closed loop")
    parser.add_argument("--seeing", default="1.0")
    parser.add_argument("--truth", default="ideal", help="the simulator's set of imperfections")
    given = parser.parse_args()
    instrument = load_instrument("flao-lbt")
    basis = karhunen_loeve_basis(instrument)

    def at_work(strength: float) -> InteractionModel:
        r0_m = instrument.modes.r0_m * strength ** (-3 / 5)
        halo = working_point(instrument, n_controlled=400, r0_m=r0_m, sampling=3)
        return InteractionModel(instrument, basis, working_point=halo)

    flat, expected = InteractionModel(instrument, basis), at_work(1.0)
    sys.stdout.write(
        "seed  light  model      modes            gain  " + "  ".join(PARAMETERS) + "\n"
    )
    with threadpool_limits(1):
        for seed in range(given.telescopes):
            options = parse_options(
                f"--plant diffractive --imperfections {given.truth} --seed {seed} "
                f"--seeing {given.seeing}".split()
            )
            telescope = telescope_of(options)
            gains = np.full(len(telescope.reconstructor.matrix), GAIN, dtype=np.float32)
            n_frames = round(given.seconds * options.frame_rate_hz)
            run = closed_loop(telescope, gains, n_frames)
            residuals = run.residual_m[SETTLED_FRAMES::SNAPSHOT_FRAMES]
            still = np.zeros_like(residuals[:1])
            alpha, n_modes = run.optics.alpha, instrument.modes.n_modes
            by_day, at_night = (mean_columns(run.optics, w, n_modes) for w in (still, residuals))
            near = flat.linearise(alpha), expected.linearise(alpha)
            seen, left = (error_of(n, at_night, SETS[1])[1] for n in near)
            strength = np.log(seen) / np.log(seen / left)
            for light, columns, name, linearisation in (
                ("still", by_day, "flat    ", near[0]),
                ("loop ", at_night, "flat    ", near[0]),
                ("loop ", at_night, "expected", near[1]),
                ("loop ", at_night, "followed", at_work(strength).linearise(alpha)),
            ):
                for modes in SETS:
                    error, gain = error_of(linearisation, columns, modes)
                    numbers = "  ".join(f"{e:+.5f}" for e in error)
                    name_of = " ".join(str(mode) for mode in modes)
                    sys.stdout.write(
                        f"{seed:4d}  {light}  {name}   {name_of}  {gain:.3f}  {numbers}\n"
                    )
                    sys.stdout.flush()


if __name__ == "__main__":
    main()
