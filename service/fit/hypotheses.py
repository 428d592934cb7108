"""Other instruments that the matrix might come from: another stop, another modulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.fit.bench import CHEAP, FINE, Bench, Other
from service.fit.joint import Solution, refine
from service.fit.nuisance import Nuisances
from service.fit.projection import project
from service.fit.target import Target
from service.model.instrument import Instrument
from service.model.misregistration import Misregistration

BETTER = 0.95
"""Another instrument is believed when it leaves less than this share of χ². On the diffractive
telescope the right stop has left 0.83 to 0.94 of what the wrong one does, noise included, from a
shift of 0.08 subaperture on; at no shift the two differ by less than 0.01."""

SUSPICIOUS = 0.008
"""RMS residual below which no other instrument need be asked: a wrong stop leaves as much at a
shift of 0.03 subaperture."""

MOST_MODES = 60
"""Modes, spread over those fitted, that are compared."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rival:
    """Another instrument that the matrix might come from."""

    change: Other
    """What to write into the file."""

    share: float
    """χ² that it leaves, over what this one leaves."""

    moved: Array | None
    """``(4,)`` by how much the registration is another when it is fitted with it, numeric units;
    None: not asked, or the fit did not come to rest."""


def rivals(
    bench: Bench, target: Target, solution: Solution, nuisances: Nuisances
) -> tuple[Rival, ...]:
    """Return other instruments, the one that explains the matrix best first.

    Each is allowed its own registration, to first order about the one found.
    """
    n_modes = target.n_modes
    modes = np.unique(np.linspace(0, n_modes - 1, min(MOST_MODES, n_modes)).astype(np.intp))
    few, subset = target.column_subset(modes), bench.basis.subset(modes)
    here = Misregistration.from_vector(solution.vector)
    # derivatives hardly depend on the hypothesis: those of the instrument as it is serve all
    derivatives = solution.derivatives[:, :, modes]

    def left(instrument: Instrument) -> float:
        bench.counter.n += 1
        matrix = bench.model(CHEAP, subset, instrument).interaction_matrix(here)
        seen = project(matrix, derivatives, few)
        step = np.linalg.solve(seen.normal, seen.scores.sum(axis=1))
        return seen.chi - float(step @ seen.scores.sum(axis=1))

    own = left(bench.instrument)
    found = []
    for change, other in bench.others.items():
        share, moved = left(other) / own, None
        if share < BETTER and not change.says_what_moves:
            fine, cheap = (bench.model(sampling, instrument=other) for sampling in (FINE, CHEAP))
            there = refine(fine, cheap, target, solution.vector, nuisances, bench.counter)
            moved = there.vector - solution.vector if there.converged else None
        found.append(Rival(change=change, share=share, moved=moved))
    return tuple(sorted(found, key=lambda rival: rival.share))
