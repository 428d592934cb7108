"""How far away a fit finds the registration from, and whether it ever believes a false one.

Random starts about the truth of a few measured matrices of the diffractive telescope by day, each
through the whole search of the joint fit. What a start leads to is fitted on the fine grid and
judged once for every different place where starts land: the fine fit begins from there alone.
Run: ``python -m pyrcal_studies.capture --starts 200 --truth realistic``.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.methods import SAME_MINIMUM, search_minimum
from pyrcal.fitting.models import FitModels
from pyrcal_studies.fit_coverage import FIRST_SEED, N_MODES, measured
from service.estimation.reference import Reference, Target, target_of
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.model.sensors.sensor import Mapper
from service.model.slopes import Orientation, SlopeRecipe
from sim_rtc.telescope.imperfections import SETS

RANGE = np.array([1.5, 1.5, np.deg2rad(6.0), 0.05])
"""Starts are spread evenly over plus and minus this (numeric units)."""

RIGHT = np.array([0.02, 0.02, np.deg2rad(0.05), 5e-3])
"""A registration further from the truth than this is a false one."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tally:
    """What became of the starts of one matrix."""

    found: int
    """Accepted and right."""

    refused: int
    false: int
    """Accepted and wrong."""

    n_places: int
    """Different places where they landed."""

    n_matrices: float
    """Interaction matrices on the coarse grid, mean of a start."""


def captured(
    bench: FitModels,
    target: Target,
    reference: Reference,
    truth: Array,
    starts: Array,
    mapper: Mapper,
) -> Tally:
    """Return what becomes of these starts ``(n_starts, 4)``."""
    places: list[tuple[Array, Fit]] = []
    found = refused = false = 0
    before = bench.counter.n
    for start in starts:
        landing = search_minimum(bench, target, Misregistration.from_vector(start))
        place = landing.best.alpha.vector
        known = [fit for where, fit in places if np.all(np.abs(where - place) < 0.1 * SAME_MINIMUM)]
        if known:
            fit = known[0]
        else:
            options = FitOptions(
                start=Misregistration.from_vector(start), orientation=Orientation()
            )
            fit = fit_matrix(bench.instrument, reference, options, basis=bench.basis, mapper=mapper)
            places.append((place, fit))
        right = bool(np.all(np.abs(fit.alpha.vector - truth) < RIGHT))
        found += fit.accepted and right
        false += fit.accepted and not right
        refused += not fit.accepted
    return Tally(
        found=found,
        refused=refused,
        false=false,
        n_places=len(places),
        n_matrices=(bench.counter.n - before) / len(starts),
    )


def matrix_of(instrument: Instrument, truth: str, seed: int) -> tuple[Array, Reference]:
    """Return the true registration and the measured matrix of one telescope."""
    alpha, matrix = measured(instrument, karhunen_loeve_basis(instrument), truth, seed)
    return alpha.vector, Reference(matrix=matrix.astype(np.float64), double_pass=True)


def main() -> int:
    """Run the campaign and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--starts", type=int, default=200, help="of all matrices together")
    parser.add_argument("--matrices", type=int, default=4)
    parser.add_argument("--truth", choices=sorted(SETS), default="realistic")
    given = parser.parse_args()
    slopes = SlopeRecipe(orientation=Orientation())
    instrument = replace(load_instrument("flao-lbt"), slopes=slopes)
    basis = karhunen_loeve_basis(instrument).subset(np.arange(N_MODES))
    each = given.starts // given.matrices
    sys.stdout.write(f"{'seed':>6s}{'starts':>8s}{'right':>7s}{'refused':>9s}{'false':>7s}")
    sys.stdout.write(f"{'places':>8s}{'matrices per start':>20s}\n")
    with threadpool_limits(1), ThreadPoolExecutor(2) as pool:
        for seed in range(FIRST_SEED, FIRST_SEED + given.matrices):
            truth, reference = matrix_of(instrument, given.truth, seed)
            bench = FitModels(instrument=instrument, basis=basis, mapper=pool.map)
            rng = np.random.default_rng(seed)
            starts = truth + rng.uniform(-1.0, 1.0, (each, 4)) * RANGE
            tally = captured(
                bench, target_of(reference, instrument), reference, truth, starts, pool.map
            )
            sys.stdout.write(
                f"{seed:6d}{each:8d}{tally.found:7d}{tally.refused:9d}{tally.false:7d}"
                f"{tally.n_places:8d}{tally.n_matrices:20.1f}\n"
            )
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
