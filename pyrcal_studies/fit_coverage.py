"""Is σ of a fitted matrix what it says? Measured matrices of many telescopes, against the truth.

Each seed is a diffractive telescope by day with another registration, other imperfections and other
photons: every mode is pushed and pulled, the light of both passes is detected, and the matrix goes
through the fit as a user's would, its noise unknown. Errors are compared with the predicted
covariance. Seeds already in the file of results are not done again.
Run: ``python -m pyrcal_studies.fit_coverage --truth realistic --seeds 100 --out
var/fit_realistic.jsonl``.
"""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal_studies.campaign.rows import RowFile
from pyrcal_studies.shared import study_parser
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import Basis, ModalBasis, karhunen_loeve_basis
from service.model.sensors.pyramid.signals import reference_slopes
from service.model.sensors.sensor import Mapper
from sim_rtc.telescope.detector import Camera, PixelDetector
from sim_rtc.telescope.diffractive import DiffractivePlant
from sim_rtc.telescope.imperfections import SETS
from sim_rtc.telescope.registration import random_registration
from sim_rtc.telescope.scene import Scene, SceneKind

N_MODES = 400
STROKE_M = 10e-9
N_AVERAGE = 20
MAGNITUDE = 7.0
FRAME_RATE_HZ = 1000.0
FIRST_SEED = 2000
"""Seeds below this were used to choose the constants of the uncertainty."""

SHOWN = BOUNDARY_SCALE * [100.0, 100.0, 1.0, 100.0]
"""From numeric units to percent of a subaperture, degrees, percent."""

Array = NDArray[np.float64]


def measured(
    instrument: Instrument, basis: ModalBasis, truth: str, seed: int
) -> tuple[Misregistration, NDArray[np.float32]]:
    """Return the true registration of one telescope and the matrix measured on it by day.

    ``truth`` names a set of imperfections. All frames of a push are detected as one exposure,
    with the photons and the read noise of them all.
    """
    plant_rng, noise_rng, alpha_rng = np.random.default_rng([7, seed]).spawn(3)
    alpha = random_registration(alpha_rng)
    plant = DiffractivePlant(
        instrument,
        basis,
        rng=plant_rng,
        imperfections=SETS[truth],
        scene=Scene(kind=SceneKind.DAYTIME),
    )
    optics = plant.optics(alpha)
    camera = Camera()
    electrons = camera.electrons_per_frame(
        instrument, magnitude=MAGNITUDE, frame_rate_hz=FRAME_RATE_HZ
    )
    read_noise = camera.read_noise_electrons * np.sqrt(N_AVERAGE)
    detector = PixelDetector(
        electrons_per_light=N_AVERAGE * electrons, camera=Camera(read_noise_electrons=read_noise)
    )
    columns = []
    for mode in range(N_MODES):
        slopes = []
        for stroke in (STROKE_M, -STROKE_M):
            opd = stroke * optics.opd_per_command[:, mode] + optics.static_opd_m
            light = optics.sensor.images(opd) / np.float32(optics.light_at_rest)
            slopes.append(reference_slopes(detector.read(light, noise_rng), plant.valid)[0])
        column = (slopes[0] - slopes[1]) / (2.0 * STROKE_M)
        columns.append(optics.errors.add_errors(column.astype(np.float32)))
    return alpha, np.array(columns).T


def fitted(
    instrument: Instrument,
    basis: Basis,
    alpha: Misregistration,
    matrix: NDArray[np.float32],
    mapper: Mapper,
) -> dict[str, Any]:
    """Return what the fit makes of a matrix, against the truth."""
    reference = Reference(matrix=matrix.astype(np.float64), double_pass=True)
    begun = time.process_time()
    fit = fit_matrix(instrument, reference, FitOptions(), basis=basis, mapper=mapper)
    error = fit.alpha.vector - alpha.vector
    return {
        "error": list(error * SHOWN),
        "sigma": list(fit.sigma * SHOWN),
        "chi2": float(error @ np.linalg.solve(fit.covariance, error)),
        "scatter": list(fit.subset_scatter * SHOWN),
        "residual": fit.residual_fraction,
        "accepted": fit.accepted,
        "verdict": fit.verdict,
        "cpu_s": time.process_time() - begun,
    }


def table(truth: str, found: list[dict[str, Any]]) -> str:
    """Return the campaign as lines of a table."""
    errors = np.array([one["error"] for one in found])
    sigmas = np.array([one["sigma"] for one in found])
    inside = np.mean([one["chi2"] < scipy.stats.chi2.ppf(0.95, 4) for one in found])
    accepted = sum(one["accepted"] for one in found)
    lines = [
        f"{truth}: {len(found)} telescopes, {accepted} accepted, {inside:.0%} inside the 95 % "
        f"ellipse, residual {np.mean([one['residual'] for one in found]):.1%}, "
        f"{np.median([one['cpu_s'] for one in found]):.1f} s of processor time per fit",
        f"{'':10s}{'x %':>9s}{'y %':>9s}{'rot deg':>9s}{'mag %':>9s}",
    ]
    for name, row in (
        ("mean", errors.mean(axis=0)),
        ("RMS", np.sqrt(np.mean(errors**2, axis=0))),
        ("largest", np.abs(errors).max(axis=0)),
        ("sigma", sigmas.mean(axis=0)),
    ):
        lines.append(f"{name:10s}" + "".join(f"{value:9.4f}" for value in row))
    return "\n".join(lines)


def main() -> int:
    """Run what is left of the campaign and print its table."""
    parser = study_parser("pyrcal_studies.fit_coverage", __doc__)
    parser.add_argument("--truth", choices=sorted(SETS), default="ideal")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--out", type=Path, required=True, help="results, a line of JSON each")
    given = parser.parse_args()
    file = RowFile(given.out)
    done = {one["seed"] for one in file.rows}
    instrument = load_instrument("flao-lbt")
    basis = karhunen_loeve_basis(instrument)
    with threadpool_limits(1), ThreadPoolExecutor(2) as pool:
        for seed in range(FIRST_SEED, FIRST_SEED + given.seeds):
            if seed in done:
                continue
            alpha, matrix = measured(instrument, basis, given.truth, seed)
            file.add({"seed": seed, **fitted(instrument, basis, alpha, matrix, pool.map)})
    sys.stdout.write(table(given.truth, file.rows) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
