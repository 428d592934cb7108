"""What a fit is fitted to: the measurement in conventions' axes, and which of it counts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.errors import MatrixError
from service.fit.reference import Reference
from service.model.instrument import Instrument
from service.model.interaction import rtc_valid_subapertures, valid_subapertures
from service.model.slopes import Orientation, SlopeOrder, to_conventions

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """Measured columns in the order, axes and signs of conventions.md, passes divided out."""

    matrix: Array
    """``(n_slopes, n_columns)`` slope per unit command, as one pass would give it."""

    weights: Array
    """``(n_columns,)`` each column's share in χ²: every mode counts alike, or by its noise."""

    rows: NDArray[np.bool_]
    """``(n_slopes,)`` slopes that count."""

    modes: NDArray[np.intp]
    """``(n_columns,)`` basis indices."""

    valid: NDArray[np.bool_]
    """``(n, n)`` [y, x] subapertures that the rows list."""

    @property
    def n_modes(self) -> int:
        """Columns."""
        return int(self.matrix.shape[1])

    def column_subset(self, columns: NDArray[np.intp]) -> Target:
        """Return a target of these columns only."""
        return replace(
            self,
            matrix=self.matrix[:, columns],
            weights=self.weights[columns],
            modes=self.modes[columns],
        )

    def without(self, rows: NDArray[np.bool_]) -> Target:
        """Return a target in which these slopes do not count either."""
        return replace(self, rows=self.rows & ~rows)


def oriented(instrument: Instrument, order: SlopeOrder, orientation: Orientation) -> Instrument:
    """Return the instrument whose slopes are listed in this order and orientation."""
    recipe = replace(instrument.slopes, order=order, orientation=orientation)
    return replace(instrument, slopes=recipe)


def target_of(reference: Reference, instrument: Instrument) -> Target:
    """Return what to fit, for an instrument whose orientation is settled.

    Slopes that are zero or not a number in every column are those of subapertures that the RTC
    keeps silent: they do not count.

    Raises
    ------
    MatrixError
        If hardly any slope answers the mirror.
    """
    recipe = instrument.slopes
    matrix = to_conventions(
        np.asarray(reference.matrix, dtype=np.float64) / reference.passes,
        recipe.order,
        recipe.assumed_orientation,
        rtc_valid_subapertures(instrument),
    )
    rows = np.any(matrix != 0.0, axis=1)
    if rows.sum() < len(rows) // 2:
        raise MatrixError(
            f"reference: found {len(rows) - rows.sum()} of {len(rows)} slopes that are 0 in every "
            "column; expected most of them to answer the mirror"
        )
    power = np.sum(matrix[rows] ** 2, axis=0)
    if reference.noise is not None:
        # a noise-free column would otherwise count alone
        power = power * 1e-4 + rows.sum() * (reference.noise / reference.passes) ** 2
    weights = 1.0 / power
    return Target(
        matrix=matrix,
        weights=weights,
        rows=rows,
        modes=np.asarray(reference.columns),
        valid=valid_subapertures(instrument),
    )
