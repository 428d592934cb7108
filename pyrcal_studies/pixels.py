"""Pixels beside slopes: the same registration from the same light, and what D costs.

A diffractive telescope, which shares nothing of the model but the drawing, is pushed and pulled
mode by mode at a registration of its own; slopes and normalised pixels are made of the same images
and each go through the fit as a user's matrix would.
Run: ``python -m pyrcal_studies.pixels --seeds 6``.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import fit_matrix
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import SignalKind
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import ModalBasis, karhunen_loeve_basis
from service.model.sensors.pyramid.signals import reference_slopes
from service.model.sensors.sensor import Mapper
from service.model.slopes import Orientation, SlopeRecipe
from sim_rtc.telescope.detector import Camera, PixelDetector
from sim_rtc.telescope.diffractive import DiffractivePlant
from sim_rtc.telescope.imperfections import SETS
from sim_rtc.telescope.registration import random_registration

STROKE_M = 10e-9
N_AVERAGE = 20
"""Frames of each push and of each pull, detected as one exposure."""

Matrices = dict[SignalKind, NDArray[np.floating]]


def told(instrument: Instrument, kind: SignalKind) -> Instrument:
    """Return the instrument whose RTC sends signals of this kind."""
    recipe = SlopeRecipe(order=kind.orders[0], orientation=Orientation())
    return replace(instrument, slopes=recipe)


def measured(
    instrument: Instrument, basis: ModalBasis, truth: str, seed: int, modes: range
) -> tuple[Misregistration, Matrices]:
    """Return the true registration, and both matrices of the same light, by kind."""
    plant_rng, noise_rng, alpha_rng = np.random.default_rng([11, seed]).spawn(3)
    alpha = random_registration(alpha_rng, instrument.start.rotation_rad)
    plant = DiffractivePlant(instrument, basis, rng=plant_rng, imperfections=SETS[truth])
    optics, camera = plant.optics(alpha), Camera()
    electrons = camera.electrons_per_frame(instrument, magnitude=7.0, frame_rate_hz=1000.0)
    read_noise = camera.read_noise_electrons * np.sqrt(N_AVERAGE)
    detector = PixelDetector(
        electrons_per_light=N_AVERAGE * electrons, camera=Camera(read_noise_electrons=read_noise)
    )
    columns: dict[SignalKind, list[NDArray[np.floating]]] = {kind: [] for kind in SignalKind}
    for mode in modes:
        opd_m = STROKE_M * optics.opd_per_command[:, mode]
        push, pull = (
            detector.read(optics.light(sign * opd_m) / optics.light_at_rest, noise_rng)
            for sign in (np.float32(1), np.float32(-1))
        )
        for kind in SignalKind:
            recipe = SlopeRecipe(order=kind.orders[0])
            up, down = (reference_slopes(one, plant.valid, recipe)[0] for one in (push, pull))
            columns[kind].append((up - down) / (2 * STROKE_M))
    return alpha, {kind: np.array(found).T for kind, found in columns.items()}


def line(name: str, alpha: Misregistration, fits: dict[SignalKind, Fit]) -> str:
    """Return one row of the table: errors of both, and how far they lie apart."""
    slopes, pixels = (fits[kind].alpha.vector for kind in SignalKind)
    apart = (slopes - alpha.vector, pixels - alpha.vector, pixels - slopes)
    shown = [" ".join(f"{value:+.5f}" for value in one * BOUNDARY_SCALE) for one in apart]
    left = " ".join(f"{fit.residual_fraction:.3f}" for fit in fits.values())
    good = " ".join("accepted" if fit.accepted else "REFUSED" for fit in fits.values())
    return f"| {name} | {' | '.join(shown)} | {left} | {good} |"


def cost(instrument: Instrument, basis: ModalBasis, mapper: Mapper) -> str:
    """Return the seconds of D, and of D with its derivatives, of both kinds."""
    rows = []
    for kind in SignalKind:
        model = InteractionModel(told(instrument, kind), basis, mapper=mapper)
        model.interaction_matrix(Misregistration())
        spent = []
        for k in range(1, 4):
            alpha = Misregistration(shift_x_subap=0.05 * k, rotation_rad=0.001 * k)
            began = time.perf_counter()
            model.interaction_matrix(alpha)
            middle = time.perf_counter()
            model.derivatives(alpha)
            spent.append((middle - began, time.perf_counter() - middle))
        matrix_s, derivatives_s = np.min(spent, axis=0)
        rows.append(f"{kind}: D {matrix_s:.2f} s, derivatives {derivatives_s:.2f} s")
    return "; ".join(rows)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--modes", type=int, default=400)
    parser.add_argument("--truth", choices=sorted(SETS), nargs="*", default=["ideal", "usual"])
    given = parser.parse_args()
    instrument = load_instrument("flao-lbt")
    basis = karhunen_loeve_basis(instrument)
    used = basis.subset(np.arange(given.modes))
    with threadpool_limits(1), ThreadPoolExecutor(2) as pool:
        print(cost(instrument, basis, pool.map), flush=True)
        for truth in given.truth:
            for seed in range(given.seeds):
                modes = range(given.modes)
                alpha, matrices = measured(instrument, basis, truth, seed, modes)
                fits = {
                    kind: fit_matrix(
                        told(instrument, kind),
                        Reference(matrix=matrix.astype(np.float64)),
                        basis=used,
                        mapper=pool.map,
                    )
                    for kind, matrix in matrices.items()
                }
                print(line(f"{truth} {seed}", alpha, fits), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
