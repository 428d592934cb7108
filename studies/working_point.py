"""How far the flat-reference model leads astray at the pyramid's working point.

The response of the diffractive telescope to the modes the service dithers is averaged, free of
noise, over the residual wavefronts of its own closed loop, and the service's model is fitted to
it: what remains is the floor that no integration removes. Beside it, the same around a flat
wavefront: what the drawing alone gets wrong. Run: ``python -m studies.working_point``.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from service.config import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.model.modes import karhunen_loeve_basis
from sim_rtc.diffractive_plant import DiffractiveOptics
from sim_rtc.options import parse_options
from studies.model_floor import MODES, fitted
from studies.optical_gain import PROBE_M, closed_loop, telescope_of

Array32 = NDArray[np.float32]

GAIN = 0.6
SNAPSHOT_FRAMES = 25


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


def main() -> None:
    """Print the error of each telescope, flat and at work."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--telescopes", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=1.8, help="of each closed loop")
    parser.add_argument("--seeing", default="1.0")
    given = parser.parse_args()
    instrument = load_instrument("flao-lbt")
    basis = karhunen_loeve_basis(instrument)
    model = InteractionModel(instrument, basis)
    sys.stdout.write("seed  residuals  " + "  ".join(PARAMETERS) + "\n")
    with threadpool_limits(1):
        for seed in range(given.telescopes):
            options = parse_options(
                f"--plant diffractive --seed {seed} --seeing {given.seeing}".split()
            )
            gains = np.full(options.n_controlled, GAIN, dtype=np.float32)
            n_frames = round(given.seconds * options.frame_rate_hz)
            run = closed_loop(telescope_of(options), gains, n_frames)
            true = run.optics.alpha
            at_work = run.residual_m[::SNAPSHOT_FRAMES]
            for name, residuals in (("flat", np.zeros_like(at_work[:1])), ("loop", at_work)):
                columns = mean_columns(run.optics, residuals, instrument.modes.n_modes)
                error = (fitted(model, columns, true) - true.vector) * BOUNDARY_SCALE
                sys.stdout.write(
                    f"{seed:4d}  {name:9s}  " + "  ".join(f"{e:+.5f}" for e in error) + "\n"
                )
                sys.stdout.flush()


if __name__ == "__main__":
    main()
