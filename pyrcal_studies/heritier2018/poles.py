"""Poles of the loop when the reconstructor's registration is wrong, from the model alone.

With D(α) the plant and R the inverse of D(0) the loop has the poles of the eigenvalues of g R D(α).
They say at which misregistration the loop becomes unstable, for any gain g, without turbulence and
without a simulated frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.closing import DELAY_FRAMES, LEAK
from pyrcal_studies.heritier2018.store import Record, Store, Task
from service.control.loop import pole_radius
from service.control.reconstructor import invert
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration

Array = NDArray[np.float64]

_COST_S = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PoleSweep:
    """Eigenvalues of R D(α) along a sweep."""

    alphas: tuple[Misregistration, ...]
    values: tuple[float, ...]
    """Of the swept parameter, in the sweep's unit."""

    n_modes: int

    @property
    def label(self) -> str:
        """What the progress bar shows."""
        return f"poles of {self.n_modes} modes"

    @property
    def cost_s(self) -> float:
        """Rough time on one idle core, seconds."""
        return _COST_S * len(self.alphas)

    @property
    def needs(self) -> tuple[Task, ...]:
        """Nothing but the model."""
        return ()

    def compute(self, store: Store) -> Record:
        """Return ``eigenvalues`` ``(n_values, n_modes)``, complex."""
        basis = telescope.basis().subset(np.arange(self.n_modes))
        model = InteractionModel(telescope.instrument(), basis)
        nominal = model.interaction_matrix(Misregistration())
        inverse = invert(np.asarray(nominal, dtype=np.float64), self.n_modes).matrix
        found = [
            np.linalg.eigvals(inverse @ np.asarray(model.interaction_matrix(alpha)))
            for alpha in self.alphas
        ]
        return {"eigenvalues": np.array(found).astype(np.complex128)}


def limit_of_stability(record: Record, values: tuple[float, ...], gain: float) -> float | None:
    """Return the first value at which a pole leaves the unit circle; None if none does."""
    radius = np.array([largest_pole(row, gain) for row in record["eigenvalues"]])
    unstable = np.flatnonzero(radius > 1.0)
    if not len(unstable) or unstable[0] == 0:
        return None
    k = int(unstable[0])
    share = (1.0 - radius[k - 1]) / (radius[k] - radius[k - 1])
    return float(values[k - 1] + share * (values[k] - values[k - 1]))


def largest_pole(eigenvalues: NDArray[np.complex128], gain: float) -> float:
    """Return the radius of the largest pole of the loop with these eigenvalues of R D."""
    radius = pole_radius(gain * eigenvalues, leak=LEAK, delay_frames=float(DELAY_FRAMES))
    return float(np.max(radius))
