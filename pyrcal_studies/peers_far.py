"""Matrices of other codes far off: 1.4 subapertures, 8 deg, 2 %, an anamorphosis of 1 %.

OOPAO, HCIPy and SPECULA push the 357 actuators of the bench of ``pyrcal_studies.mistold_matrices``
with their own optics; SynIM has lenslets of as many subapertures, and differentiates the same
shapes. Each matrix is fitted as it is, its instrument file told rightly with any orientation:
actuators, and 250 KL modes, which are combinations of the same columns.
Run: ``python -m pyrcal_studies.peers_far``, or with ``--peers hcipy`` for some; matrices are kept.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal_studies.mistold_fits import AS_IT_IS, bench, error
from pyrcal_studies.mistold_matrices import COUPLING, FRESH, PITCH_M, ZonalCase, actuators_m
from pyrcal_studies.peers import KEPT, ROOT, environment, variables
from pyrcal_studies.peers_pushpull import Bench, Measured, read_product, write_job
from service.estimation.reference import Reference
from service.model.instrument import Instrument
from service.model.kinds import Stop
from service.model.misregistration import BOUNDARY_SCALE, Misregistration, rotation
from service.model.modes import karhunen_loeve_basis
from service.model.sensors.shack_hartmann.description import ShackHartmann
from service.model.sensors.shack_hartmann.table import Centroid

Array = NDArray[Any]

PEERS = ("hcipy", "oopao", "specula", "synim")
LENSLETS = "synim"
"""The peer whose sensor is a Shack-Hartmann, of mean gradients."""

FINE = 12
"""Its points across a subaperture: it differentiates on them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Far:
    """A registration far off."""

    name: str
    alpha: Misregistration
    stretch: tuple[float, float]
    """Anamorphosis: along x over the mean of both axes, less 1, and along 45 deg."""


CASES = (
    Far(
        name="far-plus",
        alpha=replace(
            FRESH,
            shift_x_subap=1.1,
            shift_y_subap=-0.85,
            rotation_rad=np.deg2rad(8.0),
            magnification=1.02,
        ),
        stretch=(0.01, 0.0),
    ),
    Far(
        name="far-minus",
        alpha=replace(
            FRESH,
            shift_x_subap=-0.75,
            shift_y_subap=1.15,
            rotation_rad=np.deg2rad(-8.0),
            magnification=0.98,
        ),
        stretch=(-0.006, 0.008),
    ),
    Far(
        name="middle",
        alpha=replace(
            FRESH,
            shift_x_subap=0.5,
            shift_y_subap=0.4,
            rotation_rad=np.deg2rad(3.0),
            magnification=1.01,
        ),
        stretch=(0.004, -0.003),
    ),
)


def told_bench(peer: str) -> Bench:
    """Return what the peer is told of the optics."""
    told = _case(peer).bench
    return replace(told, sampling=FINE) if peer == LENSLETS else told


def _case(peer: str) -> ZonalCase:
    return ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=FRESH)


def told_instrument(peer: str, measured: Measured, strokes: Array | None) -> Instrument:
    """Return what a user of the peer knows."""
    if peer != LENSLETS:
        return bench(_case(peer), measured, strokes)
    about = bench(_case("oopao"), measured, strokes)
    lenslets = ShackHartmann(
        n_subapertures=about.wfs.n_subapertures,
        wavelength_m=measured.wavelength_m,
        valid_subapertures=measured.valid,
        centroid=Centroid.GRADIENT,
    )
    return replace(about, name=peer, wfs=lenslets)


def shapes_m(told: Bench, far: Far) -> Array:
    """Return every actuator's shape on the peer's pupil, ``(n_actuators, n, n)``: written out."""
    along, askew = far.stretch
    axis = (np.arange(told.n_pupil) - (told.n_pupil - 1) / 2) / told.sampling
    x, y = np.meshgrid(axis, axis)
    points = np.column_stack([x.ravel(), y.ravel()]) - far.alpha.vector[:2]
    points = points @ np.linalg.inv([[1.0 + along, askew], [askew, 1.0 - along]])
    points = points @ rotation(far.alpha.rotation_rad) / far.alpha.magnification
    metres = points * told.diameter_m / told.n_subapertures
    apart = np.linalg.norm(metres - actuators_m()[:, None], axis=2)
    shapes = COUPLING ** ((apart / PITCH_M) ** 2)
    return np.asarray(shapes.reshape(-1, told.n_pupil, told.n_pupil))


def measured(peer: str, far: Far) -> Measured:
    """Return the peer's matrix, measured now unless it is kept."""
    kept = KEPT / peer / f"{far.name}.npz"
    if not kept.exists():
        interpreter = environment(peer)
        print(f"{peer}, {far.name}: measuring", file=sys.stderr, flush=True)
        job, told = kept.with_name(f"{far.name}-job.npz"), told_bench(peer)
        write_job(job, told, shapes_m=shapes_m(told, far))
        subprocess.run(
            [str(interpreter), "-m", f"pyrcal_studies.peers_{peer}", str(job), str(kept)],
            cwd=ROOT,
            env=variables(),
            stdout=subprocess.DEVNULL,
            check=True,
        )
        job.unlink()
    return read_product(kept)[0]


def strokes_of(about: Instrument) -> Array:
    """Return the bench's KL modes as strokes ``(n_actuators, n_modes)``, of its whole pupil."""
    whole = replace(about, wfs=replace(about.wfs, valid_subapertures=None))
    return karhunen_loeve_basis(whole).mode_to_actuator


def fitted(peer: str, far: Far, *, modal: bool) -> dict[str, Any]:
    """Return what the fit says of one matrix, and how far off that is."""
    matrix = measured(peer, far)
    strokes = strokes_of(told_instrument(peer, matrix, None)) if modal else None
    values = np.asarray(matrix.matrix, dtype=np.float64)
    begun = time.process_time()
    with threadpool_limits(1):
        fit = fit_matrix(
            told_instrument(peer, matrix, strokes),
            Reference(matrix=values if strokes is None else values @ strokes),
            FitOptions(explain=True),
        )
    sigma = fit.anamorphosis_sigma
    return {
        "peer": f"{peer} {matrix.version}",
        "case": far.name,
        "columns": "KL" if modal else "actuators",
        "accepted": fit.accepted,
        "error": (error(fit.alpha, far.alpha, AS_IT_IS) * BOUNDARY_SCALE).tolist(),
        "sigma": (fit.sigma * BOUNDARY_SCALE).tolist(),
        "stretch": fit.alpha.stretches.tolist(),
        "stretch_told": list(far.stretch),
        "stretch_sigma": None if sigma is None else sigma.tolist(),
        "residual": fit.residual_fraction,
        "said": fit.recommendation,
        "remarks": list(fit.remarks),
        "seconds": time.process_time() - begun,
    }


def main() -> int:
    """Measure, fit, and write a line of JSON for each fit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=PEERS)
    parser.add_argument("--cases", nargs="+", default=[one.name for one in CASES])
    parser.add_argument("--output", type=Path, default=KEPT / "far.jsonl")
    given = parser.parse_args()
    for peer in given.peers:
        for far in (one for one in CASES if one.name in given.cases):
            for modal in (True, False):
                found = fitted(peer, far, modal=modal)
                print(json.dumps(found), flush=True)
                given.output.parent.mkdir(parents=True, exist_ok=True)
                with given.output.open("a") as file:
                    print(json.dumps(found), file=file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
