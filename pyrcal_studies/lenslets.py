"""Shack-Hartmann: matrices of OOPAO's and SPECULA's own sensors, fitted.

Each peer, in an environment of its own under ``var/peers``, measures modes by push-pull with its
own lenslets, pixels, centroids and valid subapertures, on a pupil sampled four times as finely as
the model's; pyrcal fits the matrix, starting from a perfect registration.
Run: ``python -m pyrcal_studies.lenslets``; minutes, kept matrices at once. ``--cases 24``: matrices
of OOPAO at so many registrations drawn at random, on 20 by 20 lenslets, and how often σ holds.
"""

from __future__ import annotations

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

from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import fit_matrix
from pyrcal_studies.peers import KEPT, ROOT, environment, variables
from pyrcal_studies.shared import study_parser
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration, rotation
from service.model.modes import ModalBasis, modal_basis
from service.model.pupil import instrument_pupil

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

FEW_MODES = np.concatenate([np.arange(20), np.arange(20, 250, 10)])
"""The same of 20 by 20 lenslets."""

RANGE = np.array([1.0, 1.0, np.deg2rad(3.0), 0.03])
"""Registrations are drawn within, uniformly: what is asked to be captured."""

FILE = """
[instrument]
name = "lenslets"
diameter_m = 8.0
obscuration_ratio = 0.14
stop = "telescope"

[wfs]
kind = "shack-hartmann"
n_subapertures = {n}
wavelength_m = {wavelength_m}
pixels_per_subaperture = 6
flux_threshold = 0.5
{centroid}

[mirror]
layout = "grid"
pitch_m = {pitch_m}
n_across = {n_across}
diameter_m = {mirror_m}
influence = "gaussian"
coupling = 0.35

[modes]
n_modes = {n_modes}
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One matrix of one peer."""

    peer: str
    truth: str
    threshold: float = 0.0
    """Of its centroids, as a share of the brightest pixel."""

    drawn: Misregistration | None = None
    """Its registration; None: that of ``truth``."""

    @property
    def alpha(self) -> Misregistration:
        """The registration that it was measured at."""
        return self.drawn or TRUTHS[self.truth]

    @property
    def modes(self) -> NDArray[np.intp]:
        """Its columns."""
        return MODES if self.n_subapertures == 40 else FEW_MODES

    told: bool = True
    """Whether the instrument file tells it, so that partly lit subapertures are left out."""

    n_subapertures: int = 40

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
        n = case.n_subapertures
        text = FILE.format(
            wavelength_m=WAVELENGTH_M,
            centroid=centroid,
            n=n,
            pitch_m=8.0 / n,
            n_across=n + 1,
            mirror_m=8.0 + 12.0 / n,
            n_modes=25 * n if n == 40 else 300,
        )
        path.write_text(text, "utf-8")
        return load_instrument(path)


@cache
def basis(n_subapertures: int = 40) -> ModalBasis:
    """Return the mirror's modes."""
    modes = modal_basis(instrument(replace(CASES[0], n_subapertures=n_subapertures)))
    if not isinstance(modes, ModalBasis):
        raise TypeError(f"found {type(modes).__name__}, expected the modes of a drawn mirror")
    return modes


def measured(case: Case) -> tuple[Array, Array]:
    """Return the peer's matrix and its valid subapertures, measured now unless kept."""
    folder = KEPT / case.peer
    size = "" if case.n_subapertures == 40 else f"{case.n_subapertures}-"
    kept = folder / f"lenslets-{size}{case.truth}-{case.threshold:g}{'-binary' * case.binary}.npz"
    if not kept.exists():
        about, alpha = instrument(case), case.alpha
        side = SAMPLING * about.wfs.n_subapertures
        line = (np.arange(side) - (side - 1) / 2) / SAMPLING
        points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        on_mirror = (points - alpha.vector[:2]) @ rotation(alpha.rotation_rad) / alpha.magnification
        rows = np.array_split(on_mirror, 64)
        modes = basis(case.n_subapertures).subset(case.modes)
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
        module = ["-m", "pyrcal_studies.lenslets_measured", case.peer, str(job), str(kept)]
        subprocess.run(
            [str(environment(case.peer)), *module],
            cwd=ROOT,
            env=variables(),
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
    reference = Reference(matrix=matrix, modes=case.modes)
    return fit_matrix(about, reference, basis=basis(case.n_subapertures))


def row(case: Case) -> str:
    """Return a line of the page's table."""
    measured(case)
    start = time.perf_counter()
    found = fitted(case)
    seconds = time.perf_counter() - start
    error = (found.alpha.vector - case.alpha.vector) * BOUNDARY_SCALE
    sigma = np.asarray(found.sigma) * BOUNDARY_SCALE
    print(case, found.verdict, *found.left_out, *found.remarks, sep="\n  ", file=sys.stderr)
    cells = " | ".join(f"{e:+.5f} ± {s:.5f}" for e, s in zip(error, sigma, strict=True))
    threshold = f"{case.threshold:g}{'' if case.told or not case.threshold else ', not told'}"
    return (
        f"| {case.peer}{', binary pupil' * case.binary} | {case.truth} | {threshold} | {cells} | "
        f"{found.residual_fraction:.2%} | {seconds:.1f} |"
    )


def drawn(n_cases: int) -> list[Case]:
    """Return cases at random registrations, the same every time."""
    rng = np.random.default_rng(25)
    steps = RANGE * rng.uniform(-1.0, 1.0, (n_cases, 4))
    nominal = Misregistration()
    return [
        Case(peer="oopao", truth=f"drawn-{k}", drawn=nominal.add_step(step), n_subapertures=20)
        for k, step in enumerate(steps)
    ]


def coverage(n_cases: int) -> None:
    """Print each error over its σ, and what all of them say together."""
    print("| case | x | y | rotation | magnification |\n| --- | --- | --- | --- | --- |")
    errors, sigmas = [], []
    for case in drawn(n_cases):
        found = fitted(case)
        errors.append((found.alpha.vector - case.alpha.vector) * BOUNDARY_SCALE)
        sigmas.append(np.asarray(found.sigma) * BOUNDARY_SCALE)
        ratios = " | ".join(f"{ratio:+.2f}" for ratio in errors[-1] / sigmas[-1])
        print(f"| {case.truth} | {ratios} |", flush=True)
    rms, typical = (np.sqrt(np.mean(np.square(values), axis=0)) for values in (errors, sigmas))
    for name, values in (
        ("RMS error", rms),
        ("σ", typical),
        ("σ / RMS error", typical / rms),
        ("inside 1.96 σ", np.mean(np.abs(errors) < 1.96 * np.array(sigmas), axis=0)),
    ):
        print(f"{name}: " + ", ".join(f"{value:.2g}" for value in values))


def main() -> int:
    """Measure, fit, print the table."""
    parser = study_parser("pyrcal_studies.lenslets", __doc__)
    parser.add_argument("--cases", type=int, metavar="N", help="registrations drawn at random")
    given = parser.parse_args()
    if given.cases:
        coverage(given.cases)
        return 0
    print("| peer | α | threshold | x, subap | y | rotation, deg | magnification | left over | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for case in CASES:
        print(row(case), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
