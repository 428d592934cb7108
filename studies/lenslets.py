"""Shack-Hartmann: matrices of OOPAO's and SPECULA's own sensors, fitted.

Each peer, in an environment of its own under ``var/peers``, measures modes by push-pull with its
own lenslets, pixels, centroids and valid subapertures, on a pupil sampled four times as finely as
the model's; pyrcal fits the matrix, starting from a perfect registration.
Run: ``python -m studies.lenslets``; minutes, kept matrices at once.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.matrix import Fit, fit_matrix
from service.config import load_instrument
from service.estimation.reference import Reference
from service.model.instrument import Instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration, rotation
from service.model.modes import ModalBasis, modal_basis
from service.model.pupil import instrument_pupil
from studies.peers import KEPT, ROOT, environment

Array = NDArray[Any]

SAMPLING = 12
"""Of the peers' pupils, points per subaperture."""

MODES = np.concatenate([np.arange(20), np.arange(20, 1000, 20)])
"""Columns of every matrix: the lowest, and every twentieth up to a mode of 40 by 40 that is seen
well."""

TRUTHS = {
    "small": Misregistration(
        shift_x_subap=0.31, shift_y_subap=-0.17, rotation_rad=np.deg2rad(0.6), magnification=1.004
    ),
    "large": Misregistration(
        shift_x_subap=-0.9, shift_y_subap=0.5, rotation_rad=np.deg2rad(-2.0), magnification=0.98
    ),
    "edge": Misregistration(
        shift_x_subap=1.0, shift_y_subap=-1.0, rotation_rad=np.deg2rad(3.0), magnification=1.03
    ),
}
"""The last one at the border of what is asked."""

FILE = """
[instrument]
name = "lenslets"
diameter_m = 8.0
obscuration_ratio = 0.14
stop = "telescope"

[wfs]
kind = "shack-hartmann"
n_subapertures = 40
wavelength_m = {wavelength_m}
pixels_per_subaperture = 6
flux_threshold = 0.5
{centroid}

[mirror]
layout = "grid"
pitch_m = 0.2
n_across = 41
diameter_m = 8.3
influence = "gaussian"
coupling = 0.35

[modes]
n_modes = 1000
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One matrix of one peer."""

    peer: str
    truth: str
    threshold: float = 0.0
    """Of its centroids, as a share of the brightest pixel."""

    told: bool = True
    """Whether the instrument file tells it, so that partly lit subapertures are left out."""

    binary: bool = False
    """Whether a cell of the peer's pupil is lit or dark, as shipped; else the share that is lit."""


CASES = (
    *(Case(peer=peer, truth=truth) for peer in ("oopao", "specula") for truth in TRUTHS),
    Case(peer="oopao", truth="small", binary=True),
    Case(peer="oopao", truth="small", threshold=0.01),
    Case(peer="oopao", truth="small", threshold=0.01, told=False),
    Case(peer="specula", truth="small", threshold=0.01),
)

WAVELENGTH_M = 790e-9
"""OOPAO's band I."""


def instrument(case: Case) -> Instrument:
    """Return what a user of the peer knows."""
    told = case.threshold if case.told else 0.0
    centroid = f'centroid = "threshold"\nthreshold = {told}' if told else ""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lenslets.toml"
        path.write_text(FILE.format(wavelength_m=WAVELENGTH_M, centroid=centroid), "utf-8")
        return load_instrument(path)


@cache
def basis() -> ModalBasis:
    """Return the mirror's modes."""
    modes = modal_basis(instrument(CASES[0]))
    if not isinstance(modes, ModalBasis):
        raise TypeError(f"found {type(modes).__name__}, expected the modes of a drawn mirror")
    return modes


def measured(case: Case) -> tuple[Array, Array]:
    """Return the peer's matrix and its valid subapertures, measured now unless kept."""
    folder = KEPT / case.peer
    kept = folder / f"lenslets-{case.truth}-{case.threshold:g}{'-binary' * case.binary}.npz"
    if not kept.exists():
        about, alpha = instrument(case), TRUTHS[case.truth]
        side = SAMPLING * about.wfs.n_subapertures
        line = (np.arange(side) - (side - 1) / 2) / SAMPLING
        points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        on_mirror = (points - alpha.vector[:2]) @ rotation(alpha.rotation_rad) / alpha.magnification
        rows = np.array_split(on_mirror, 64)
        modes = basis().subset(MODES)
        shapes = np.concatenate([modes.render(some).astype(np.float32) for some in rows])
        amplitude = instrument_pupil(about, SAMPLING).amplitude
        if case.binary:
            amplitude = (amplitude >= 0.5).astype(float)
        job = folder / "lenslets-job.npz"
        job.parent.mkdir(parents=True, exist_ok=True)
        np.savez(
            job,
            shapes=shapes.T.reshape(-1, side, side),
            diameter_m=about.diameter_m,
            amplitude=amplitude,
            wavelength_m=WAVELENGTH_M,
            n_subapertures=about.wfs.n_subapertures,
            n_pixels=6,
            threshold=case.threshold,
        )
        module = ["-m", "studies.lenslets_measured", case.peer, str(job), str(kept)]
        subprocess.run(
            [str(environment(case.peer)), *module],
            cwd=ROOT,
            env={**os.environ, "MPLBACKEND": "Agg"},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        job.unlink()
    with np.load(kept) as product:
        return product["matrix"], product["valid"]


def fitted(case: Case) -> Fit:
    """Return the fit of the peer's matrix, its own valid subapertures told."""
    matrix, valid = measured(case)
    about = instrument(case)
    about = replace(about, wfs=replace(about.wfs, valid_subapertures=valid))
    return fit_matrix(about, Reference(matrix=matrix, modes=MODES), basis=basis())


def row(case: Case) -> str:
    """Return a line of the page's table."""
    measured(case)
    start = time.perf_counter()
    found = fitted(case)
    seconds = time.perf_counter() - start
    error = (found.alpha.vector - TRUTHS[case.truth].vector) * BOUNDARY_SCALE
    sigma = np.asarray(found.sigma) * BOUNDARY_SCALE
    print(case, found.verdict, *found.left_out, *found.remarks, sep="\n  ", file=sys.stderr)
    cells = " | ".join(f"{e:+.5f} ± {s:.5f}" for e, s in zip(error, sigma, strict=True))
    threshold = f"{case.threshold:g}{'' if case.told or not case.threshold else ', not told'}"
    return (
        f"| {case.peer}{', binary pupil' * case.binary} | {case.truth} | {threshold} | {cells} | "
        f"{found.residual_fraction:.2%} | {seconds:.1f} |"
    )


def main() -> int:
    """Measure, fit, print the table."""
    print("| peer | α | threshold | x, subap | y | rotation, deg | magnification | left over | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for case in CASES:
        print(row(case), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
