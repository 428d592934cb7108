"""Wavefront error along the sweeps, and how far a registration may be off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pyrcal_studies.heritier2018.loops import wavefront_error_nm
from pyrcal_studies.heritier2018.plan import INFLUENCE_MODES, SWEEPS, Budget, Sweep, influence_run
from pyrcal_studies.heritier2018.reconstructors import Kind
from pyrcal_studies.heritier2018.store import Store

COSTLY_NM = 50.0
"""Added in quadrature to the registered loop's error: what a registration may not cost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Wavefront error along a sweep, with one reconstructor."""

    sweep: Sweep
    n_modes: int
    kind: Kind
    values: tuple[float, ...]
    errors_nm: tuple[float, ...]

    @property
    def name(self) -> str:
        """What a legend calls it."""
        return f"{self.n_modes} modes, {self.kind}"

    def tolerance(self) -> float | None:
        """Return the value at which the registration costs ``COSTLY_NM``; None: not reached."""
        limit = np.hypot(self.errors_nm[0], COSTLY_NM)
        errors = np.array(self.errors_nm)
        above = np.flatnonzero(errors > limit)
        if not len(above):
            return None
        k = int(above[0])
        # the error grows like a power: between two points its logarithm is the straighter line
        low, high = np.log(errors[k - 1]), np.log(errors[k])
        share = (np.log(limit) - low) / (high - low)
        return float(self.values[k - 1] + share * (self.values[k] - self.values[k - 1]))


def curves(budget: Budget, store: Store) -> tuple[Curve, ...]:
    """Return every curve of the three sweeps."""
    return tuple(
        Curve(
            sweep=sweep,
            n_modes=n_modes,
            kind=kind,
            values=sweep.at(budget),
            errors_nm=tuple(
                wavefront_error_nm(store.read(run))
                for run in (
                    influence_run(budget, sweep.alpha(value), n_modes, kind)
                    for value in sweep.at(budget)
                )
            ),
        )
        for sweep in SWEEPS
        for n_modes in INFLUENCE_MODES
        for kind in Kind
    )


def border_tolerances(found: tuple[Curve, ...], n_modes: int) -> dict[str, float]:
    """Return by symbol how far the border may move, in subapertures, with the truncated SVD."""
    tolerances = {}
    for curve in found:
        value = curve.tolerance()
        if curve.n_modes == n_modes and curve.kind is Kind.TRUNCATED and value is not None:
            tolerances[curve.sweep.symbol] = curve.sweep.border_subap(value)
    return tolerances
