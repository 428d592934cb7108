"""Projection on sensitivity matrices, as the Adaptive Optics Facility does it.

The measured matrix less the synthetic one is projected on the derivatives of the synthetic one with
respect to each parameter. It is first order, so it is repeated about each answer.

References
----------
Kolb et al. 2012, Proc. SPIE 8447 (identification by sensitivity matrices at the VLT's AOF).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.fit.bench import Bench
from service.fit.joint import SETTLED, Solution
from service.fit.nuisance import Nuisances
from service.fit.search import settle
from service.fit.target import Target

MOST_REPEATS = 4
REACH = 20.0
"""Derivatives within so many settling lengths of where they were taken are as good as new."""


def project_on_sensitivities(
    bench: Bench, target: Target, start: NDArray[np.float64], nuisances: Nuisances
) -> tuple[Solution, Target]:
    """Return where the sensitivities lead from a start, without any search for a better one."""
    for _ in range(MOST_REPEATS):
        solution, seen = settle(bench, target, start, nuisances)
        if not solution.converged or np.all(np.abs(solution.vector - start) < REACH * SETTLED):
            break
        start = solution.vector
    return solution, seen
