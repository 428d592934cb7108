"""How far a perfect, noise-free measurement of the dithered modes leads the model astray.

Fits the service's model to the simulated plant's own interaction matrix (finer grid, displaced
actuators, uneven light), at the four modes the service dithers, for several telescopes. The scatter
is the model-error floor: what no integration removes. Run:
``python -m pyrcal_studies.model_floor``.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.registered import against, step_of
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration
from service.model.modes import karhunen_loeve_basis
from sim_rtc.telescope.linear import LinearPlant
from sim_rtc.telescope.registration import random_registration

MODES = [509, 527, 545, 563]
N_STEPS = 3


def fitted(
    model: InteractionModel, measured: NDArray[np.float32], start: Misregistration
) -> NDArray[np.float64]:
    """Return the α that best explains these columns, with a free gain for each."""
    vector = start.vector
    for _ in range(N_STEPS):
        linear = model.linearise(Misregistration.from_vector(vector))
        vector = vector + step_of(against(linear, measured[:, MODES], MODES))
    return vector


def main() -> None:
    """Print the error of each telescope and their RMS."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--telescopes", type=int, default=20)
    options = parser.parse_args()
    threadpool_limits(1)
    instrument = load_instrument("flao-lbt")
    basis = karhunen_loeve_basis(instrument)
    with ThreadPoolExecutor(2) as threads:
        model = InteractionModel(instrument, basis, mapper=threads.map)
        errors = []
        sys.stdout.write("seed  " + "  ".join(PARAMETERS) + "\n")
        for seed in range(options.telescopes):
            plant_rng, alpha_rng = np.random.default_rng(seed).spawn(2)
            true = random_registration(alpha_rng)
            measured = LinearPlant(instrument, basis, rng=plant_rng).optics(true).slopes_per_command
            error = (fitted(model, measured, true) - true.vector) * BOUNDARY_SCALE
            errors.append(error)
            sys.stdout.write(f"{seed:4d}  " + "  ".join(f"{e:+.5f}" for e in error) + "\n")
            sys.stdout.flush()
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    sys.stdout.write("rms   " + "  ".join(f"{e:.5f}" for e in rms) + "\n")


if __name__ == "__main__":
    main()
