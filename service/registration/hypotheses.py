"""Other instruments that the matrix might come from: another stop, another modulation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import Misregistration
from service.registration.bench import CHEAP, Bench
from service.registration.joint import Solution
from service.registration.projection import project
from service.registration.target import Target

SUSPICIOUS = 0.008
"""RMS residual below which no other instrument need be asked: a wrong stop leaves as much at a
shift of 0.03 subaperture."""

MOST_MODES = 60
"""Modes, spread over those fitted, that are compared."""


def rivals(bench: Bench, target: Target, solution: Solution) -> dict[str, float]:
    """Return χ² of other instruments over this one's, by what to change in the file.

    Each is allowed its own registration, to first order about the one found.
    """
    n_modes = target.n_modes
    modes = np.unique(np.linspace(0, n_modes - 1, min(MOST_MODES, n_modes)).astype(np.intp))
    few = target.column_subset(modes)
    here = Misregistration.from_vector(solution.vector)
    # derivatives hardly depend on the hypothesis: those of the instrument as it is serve all
    derivatives = solution.derivatives[:, :, modes]

    def left(matrix: NDArray[Any]) -> float:
        seen = project(matrix, derivatives, few)
        step = np.linalg.solve(seen.normal, seen.scores.sum(axis=1))
        return seen.chi - float(step @ seen.scores.sum(axis=1))

    bench.counter.n += 1
    own = left(bench.model(CHEAP, bench.basis.subset(modes)).interaction_matrix(here))
    found = {}
    for words, other in bench.others(modes).items():
        bench.counter.n += 1
        found[words] = left(other.interaction_matrix(here)) / own
    return found
