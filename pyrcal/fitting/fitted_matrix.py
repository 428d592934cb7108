"""The record of a measured matrix and the model's: what the figures of a fit show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.left_over import ResidualLocation
from pyrcal.fitting.methods import ScanStep
from service.model.kinds import SlopeOrder
from service.model.misregistration import Determination


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedMatrix(Determination):
    """A measured matrix, the model's at the fitted registration, and their difference."""

    gains: NDArray[np.float64]
    """``(n_used,)`` amplitude of each measured column over the model's, number of passes included.
    """

    residual_fraction: float
    """RMS of the residual over RMS of the measurement, with all modes weighted equally."""

    residual_map: NDArray[np.float64]
    """``(n_planes, n, n)`` [x or y, or image; row, column] RMS of the residual over modes, in units
    of the measurement's own RMS; NaN outside the valid subapertures."""

    residual_by_mode: NDArray[np.float64]
    """``(n_used,)`` RMS of the residual over RMS of the measurement, for each mode."""

    modes: NDArray[np.intp]
    """``(n_used,)`` basis indices."""

    order: SlopeOrder
    """Order of the components, given or found."""

    verdict: str
    """Verdict in one line: accepted with its quality, or refused with the reason and the remedy."""

    left_out: tuple[str, ...] = ()
    """Unused columns and slopes, one sentence for each kind."""

    synthetic: NDArray[Any]
    """``(n_slopes, n_used)`` model matrix at ``alpha`` without gains, in the axes of
    conventions.md."""

    measured: NDArray[Any]
    """``(n_slopes, n_used)`` measured matrix in the same axes and unit, divided by the number of
    passes."""

    valid: NDArray[np.bool_]
    """``(n, n)`` [y, x] mask of the subapertures in both, in the axes of conventions.md."""

    left_over: ResidualLocation | None = None
    """Location of the residual in pupil and modes; None if it was not computed."""

    recommendation: str = ""
    """Recommended action, in one sentence."""

    paper_table: tuple[ScanStep, ...] | None = None
    """Scans of the paper's method, in order; None for the other methods."""

    @property
    def verdict_line(self) -> str:
        """Verdict and columns left out, on one line."""
        if not self.left_out:
            return self.verdict
        return f"{self.verdict}; left out: {'; '.join(self.left_out)}"
