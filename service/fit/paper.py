"""One parameter at a time, with parabolas: the procedure of the paper, step by step.

Rotation, shift along x, shift along y and magnification are scanned in turn, the others held; the
lowest point of a parabola through χ² is kept, and the next round takes smaller steps. χ² is the sum
over modes of the squared difference of measured and synthetic slopes, each mode with a gain of its
own and unit weight, the first modes left out: vibrations and the edge of the pupil spoil them.

The order of the parameters and the parabolas are the paper's. Its step sizes are not reproduced
from its table; those here shrink by five from a fifth of the capture range to what noise allows.

References
----------
Heritier et al. 2018, MNRAS 481, 2829, section 4 and Table 1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from service.fit.bench import Bench
from service.fit.joint import LIMIT
from service.fit.options import ScanStep
from service.fit.projection import weighted_misfit
from service.fit.target import Target
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration

Array = NDArray[np.float64]

ORDER = (2, 0, 1, 3)
"""Indices of the parameters in the order they are scanned."""

ROUNDS = (
    np.array([0.5, 0.5, 2.0, 0.02]),
    np.array([0.1, 0.1, 0.4, 0.004]),
    np.array([0.02, 0.02, 0.08, 0.0008]),
)
"""Step of each parameter in each round, boundary units."""

HALF_WIDTH = 2
"""Samples on either side of where a scan begins."""

MOST_EXTENSIONS = 2
"""Times that a scan moves on when its lowest sample is its last."""

N_LEFT_OUT = 10
"""First modes that have no part in χ², where there are enough others."""


def scan(bench: Bench, target: Target, start: Array) -> tuple[Array, tuple[ScanStep, ...]]:
    """Return where the scans lead from a start, and each of them.

    ``start`` is ``(4,)`` in numeric units.
    """
    if target.n_modes >= 3 * N_LEFT_OUT:
        columns = np.arange(N_LEFT_OUT, target.n_modes)
    else:
        columns = np.arange(target.n_modes)
    model = bench.model(2, bench.basis.subset(columns))
    target = target.column_subset(columns)
    values = start * BOUNDARY_SCALE
    table = []

    def chi(tried: Array) -> float:
        bench.counter.n += 1
        alpha = Misregistration.from_vector(tried / BOUNDARY_SCALE)
        return weighted_misfit(model.interaction_matrix(alpha), target)

    for steps in ROUNDS:
        for index in ORDER:
            for _ in range(1 + MOST_EXTENSIONS):
                step = _scanned(chi, values, index, float(steps[index]))
                table.append(step)
                values[index] = step.minimum
                if step.samples[0] < step.minimum < step.samples[-1]:
                    break
    return values / BOUNDARY_SCALE, tuple(table)


def _scanned(chi: Callable[[Array], float], values: Array, index: int, step: float) -> ScanStep:
    offsets = step * np.arange(-HALF_WIDTH, HALF_WIDTH + 1)
    limit = LIMIT[index]
    centre = values[index]
    samples = centre + offsets
    if index == 3:
        samples = np.clip(samples, 1.0 - limit, 1.0 + limit)
    tried = np.tile(values, (len(samples), 1))
    tried[:, index] = samples
    found = np.array([chi(one) for one in tried])
    return ScanStep(
        parameter=PARAMETERS[index],
        step=step,
        samples=samples,
        chi=found,
        minimum=_lowest(samples, found),
    )


def _lowest(samples: Array, chi: Array) -> float:
    """Return the lowest point of the parabola through the lowest sample and its neighbours.

    At the end of a scan, or where χ² does not bend upwards, the sample itself.
    """
    best = int(np.argmin(chi))
    if best in {0, len(samples) - 1}:
        return float(samples[best])
    before, at, after = chi[best - 1 : best + 2]
    bend = before + after - 2.0 * at
    step = samples[best + 1] - samples[best]
    return (
        float(samples[best] + step * (before - after) / (2.0 * bend))
        if bend > 0
        else float(samples[best])
    )
