"""Fits of matrices whose four pupil images lie beside the pixel grid.

``python -m pyrcal_studies.image_offsets`` draws displacements, registrations and stops, measures a
matrix of each with the FFT pyramid of the tests, which shares no code with the model, and fits it:
with the displacements in the instrument file, and without. It prints the table of
docs/results/image_offsets.md; 40 draws take some four minutes of processor time.
"""

from __future__ import annotations

import argparse

import numpy as np

from pyrcal.offline.matrix import FitOptions, fit_matrix
from service.estimation.reference import Reference
from service.model.kinds import Stop
from service.model.misregistration import BOUNDARY_SCALE
from tests.physics.test_image_offsets import TRUTH, as_told, basis, bench, displacements, measured

RMS = (0.0, 0.05, 0.1, 0.2, 0.3)
"""Of the displacements along either axis, subapertures."""


def main() -> None:
    """Print a line for each size of the displacements, told and not told."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--draws", type=int, default=8, help="of each size")
    draws = parser.parse_args().draws
    for rms in RMS:
        for told in (True, False):
            found = [_fitted(seed, rms, told=told) for seed in range(draws)]
            errors, sigmas, accepted = (np.array(part) for part in zip(*found, strict=True))
            worst = np.abs(errors / sigmas).max(axis=1)
            print(
                f"| {rms} | {'told' if told else 'not told'} | {accepted.sum()} of {draws} "
                f"| {np.sum(worst < 3.0)} | {worst.max():.1f} "
                f"| {np.abs(errors[:, :2]).max():.4f} | {sigmas[:, :2].mean():.4f} "
                f"| {np.abs(errors[:, 2]).max():.4f} | {np.abs(errors[:, 3]).max():.5f} |",
                flush=True,
            )


def _fitted(seed: int, rms: float, *, told: bool) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return error and 1 σ of the registration ``(4,)``, boundary units, and whether accepted."""
    instrument = bench(list(Stop)[seed % 2])
    offsets = displacements(seed, rms) if rms else np.zeros((2, 2, 2))
    matrix = measured(instrument, offsets)
    about = as_told(instrument, offsets) if told else instrument
    fit = fit_matrix(about, Reference(matrix=matrix), FitOptions(), basis=basis())
    error = (fit.alpha.vector - TRUTH.vector) * BOUNDARY_SCALE
    return error, np.sqrt(np.diag(fit.covariance)) * BOUNDARY_SCALE, fit.accepted


if __name__ == "__main__":
    main()
