"""Check a measured interaction matrix and prepare it for a fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import MatrixError
from service.estimation.solver import Columns
from service.model.instrument import Instrument, Mirror
from service.model.kinds import BasisKind
from service.model.pupil import rtc_valid_subapertures, valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.slopes import to_conventions

Array = NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference:
    """A measured interaction matrix in the RTC's own order, axes and signs."""

    matrix: NDArray[np.float64]
    """``(n_slopes, n_columns)`` slope per metre OPD, or per any unit when the stroke is unknown."""

    modes: NDArray[np.intp] | None = None
    """``(n_columns,)`` index of each column in the instrument's basis; None: the first ones."""

    noise: NDArray[np.float64] | None = None
    """``(n_columns,)`` 1 σ of one element of each column, in the matrix's unit; None: unknown."""

    double_pass: bool = False
    """True if the light met the mirror twice, so that the matrix is twice the model's."""

    left_out: tuple[str, ...] = ()
    """Columns that were no measurement and are removed, with the reason: one sentence per kind."""

    place_sigma_subap: float = 0.0
    """1 σ of the place of the grid on the pupil images, where slopes were made of frames."""

    @property
    def columns(self) -> NDArray[np.intp]:
        """Index of each column in the instrument's basis, ``(n_columns,)``."""
        if self.modes is None:
            return np.arange(self.matrix.shape[1])
        return self.modes

    def column_subset(self, columns: NDArray[Any], *left_out: str) -> Reference:
        """Return a reference of these columns only, with notes on the others."""
        noise = self.noise
        # Noise of another length is left to the check of the reference, which reports it.
        is_by_column = noise is not None and noise.shape == self.columns.shape
        return replace(
            self,
            matrix=self.matrix[:, columns],
            modes=self.columns[columns],
            noise=noise[columns] if noise is not None and is_by_column else noise,
            left_out=(*self.left_out, *left_out),
        )

    @property
    def passes(self) -> int:
        """Number of times the light met the mirror."""
        return 2 if self.double_pass else 1

    @property
    def noise_per_pass(self) -> NDArray[np.float64] | None:
        """``noise`` of the columns with the passes divided out."""
        return None if self.noise is None else self.noise / self.passes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target(Columns):
    """Measured columns in the order, axes and signs of conventions.md, passes divided out.

    Every mode counts alike, or by its noise.
    """

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


def target_of(reference: Reference, instrument: Instrument) -> Target:
    """Return what to fit, for an instrument whose orientation is settled.

    Slopes that are zero or not a number in every column are those of subapertures that the RTC
    keeps silent: they do not count, nor do those that the kind of sensor leaves out.

    Raises
    ------
    MatrixError
        If hardly any slope answers the mirror.
    """
    # The model's light meets the mirror once.
    single_pass = np.asarray(reference.matrix, dtype=np.float64) / reference.passes
    mask = rtc_valid_subapertures(instrument)
    matrix = to_conventions(single_pass, instrument.slopes, mask)
    rows = np.any(matrix != 0.0, axis=1)
    if rows.sum() < len(rows) // 2:
        raise MatrixError(
            f"reference: found {len(rows) - rows.sum()} of {len(rows)} slopes that are 0 in every "
            "column; expected most of them to answer the mirror"
        )
    valid, left_out = valid_subapertures(instrument), kind_of(instrument).left_out(instrument)
    if left_out is not None:
        rows &= ~np.tile(left_out.subapertures[valid], instrument.slopes.kind.n_planes)
    power = np.sum(matrix[rows] ** 2, axis=0)
    if reference.noise_per_pass is not None:
        # a noise-free column would otherwise count alone
        power = power * 1e-4 + rows.sum() * reference.noise_per_pass**2
    elif is_by_actuator(instrument):
        # an actuator behind the edge is seen by the border alone, where models are least true:
        # weighed by its share it pulls a far shift by 0.0015 subapertures
        power = np.maximum(power, np.median(power))
    weights = 1.0 / power
    return Target(
        matrix=matrix,
        weights=weights,
        rows=rows,
        modes=np.asarray(reference.columns),
        valid=valid,
    )


def is_by_actuator(instrument: Instrument) -> bool:
    """Return whether every column is one actuator of a drawn mirror."""
    mirror = instrument.mirror
    return (
        isinstance(mirror, Mirror)
        and mirror.basis is BasisKind.ZONAL
        and mirror.mode_to_actuator is None
    )
