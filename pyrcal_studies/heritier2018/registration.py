"""The registration of a matrix: Table 1's procedure, and the joint fit beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.models import FitModels
from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.calibration import Answer, Measurement
from pyrcal_studies.heritier2018.store import Record, Store, Task
from service.errors import PyrcalError
from service.estimation.reference import target_of
from service.model.kinds import Method
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.slopes import Orientation

Array = NDArray[np.float64]

DERIVATIVE_STEPS = np.array([1e-2, 1e-2, 1e-3, 1e-3])
"""Steps of the derivatives of a matrix by the registration, numeric units."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitRun:
    """One fit to one measured matrix from one start."""

    source: Measurement | Answer
    method: Method
    start: Misregistration
    modes_every: int = 1
    """Only each such mode takes part."""

    @property
    def needs(self) -> tuple[Task, ...]:
        """The measurement."""
        return self.source.parts

    @property
    def modes(self) -> NDArray[np.intp]:
        """Modes that take part."""
        return np.arange(0, self.source.n_modes, self.modes_every)

    def compute(self, store: Store) -> Record:
        """Return the fit as arrays; α of one that gives up is NaN."""
        options = FitOptions(
            method=self.method, start=self.start, orientation=Orientation(), modes=self.modes
        )
        reference = self.source.reference(store)
        instrument, basis = telescope.instrument(), telescope.basis()
        try:
            fit = fit_matrix(instrument, reference, options, basis=basis)
        except PyrcalError:
            return {"alpha": np.full(4, np.nan), "n_evaluations": np.array(0)}
        return flattened(fit)


def flattened(fit: Fit) -> Record:
    """Return a fit as arrays."""
    record: dict[str, NDArray[Any]] = {
        "alpha": fit.alpha.vector * BOUNDARY_SCALE,
        "gains": fit.gains,
        "modes": fit.modes,
        "residual_fraction": np.array(fit.residual_fraction),
        "residual_by_mode": fit.residual_by_mode,
        "n_evaluations": np.array(fit.n_evaluations),
        "synthetic": fit.synthetic.astype(np.float32),
        "measured": fit.measured.astype(np.float32),
        "valid": fit.valid,
    }
    steps = fit.paper_table or ()
    record["steps"] = np.array([step.parameter for step in steps], dtype=np.str_)
    record["step_sizes"] = np.array([step.step for step in steps])
    record["minima"] = np.array([step.minimum for step in steps])
    for k, step in enumerate(steps):
        record[f"samples_{k}"] = step.samples
        record[f"chi_{k}"] = step.chi
        record[f"coefficients_{k}"] = step.coefficients
    return record


def fitted_alpha(record: Mapping[str, NDArray[Any]]) -> Misregistration:
    """Return the registration a fit found."""
    return Misregistration.from_vector(record["alpha"] / BOUNDARY_SCALE)


@dataclass(frozen=True, slots=True, kw_only=True)
class CriterionMinimum:
    """The minimum of the paper's criterion in all four parameters together.

    It is what Table 1's procedure would converge to. It is found by a Gauss-Newton step from the
    true registration, which only a study can do.
    """

    source: Measurement | Answer

    @property
    def needs(self) -> tuple[Task, ...]:
        """The measurement."""
        return self.source.parts

    def compute(self, store: Store) -> Record:
        """Return ``alpha``, and ``alpha_gains`` with a free gain per mode, boundary units."""
        plain = replace(telescope.instrument().slopes, orientation=Orientation())
        instrument = replace(telescope.instrument(), slopes=plain)
        basis = telescope.basis().subset(np.arange(self.source.n_modes))
        model = FitModels(instrument=instrument, basis=basis).fine
        target = target_of(self.source.reference(store), instrument)
        truth = self.source.alpha.vector

        def matrix_at(vector: Array) -> Array:
            found = model.interaction_matrix(Misregistration.from_vector(vector))
            return np.asarray(found, dtype=np.float64)[target.rows]

        nominal = matrix_at(truth)
        units = nominal / np.linalg.norm(nominal, axis=0)
        residual = np.asarray(target.matrix[target.rows], dtype=np.float64) - nominal
        steps = np.diag(DERIVATIVE_STEPS)
        derivatives = [
            (matrix_at(truth + step) - matrix_at(truth - step)) / (2.0 * step.sum())
            for step in steps
        ]

        def without_gains(values: Array) -> Array:
            return np.asarray(values - units * np.sum(units * values, axis=0))

        found = {}
        for name, prepare in (("alpha", np.asarray), ("alpha_gains", without_gains)):
            rows = np.array([prepare(one).ravel() for one in derivatives]).T
            step = np.linalg.lstsq(rows, prepare(residual).ravel(), rcond=None)[0]
            found[name] = (truth + step) * BOUNDARY_SCALE
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """Where a fit found the mirror, or a step away from there."""

    fit: FitRun
    step: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Shift along x and y in subapertures, rotation in degrees, magnification."""

    def at(self, store: Store) -> Misregistration:
        """Return the registration."""
        found = store.read(self.fit)["alpha"]
        return Misregistration.from_vector((found + np.array(self.step)) / BOUNDARY_SCALE)


def resolved(alpha: Misregistration | Found, store: Store) -> Misregistration:
    """Return a registration, whether it was given or found."""
    return alpha.at(store) if isinstance(alpha, Found) else alpha


def errors(record: Mapping[str, NDArray[Any]], truth: Misregistration) -> Array:
    """Return ``(4,)`` found less true: % of a subaperture (two), degrees, % of magnification."""
    off = record["alpha"] - truth.vector * BOUNDARY_SCALE
    return np.asarray(off * np.array([100.0, 100.0, 1.0, 100.0]))


TOLERANCE = np.array([5.0, 5.0, 0.3, 0.5])
"""Beyond this, in the units of :func:`errors`, a fit has found something else."""


def is_right(record: Mapping[str, NDArray[Any]], truth: Misregistration) -> bool:
    """Return whether a fit found the truth, be it roughly."""
    return bool(np.all(np.abs(errors(record, truth)) <= TOLERANCE))


ROUGH_ESTIMATE = np.array([1.0, 1.0, np.deg2rad(2.0), 0.02])
"""Error of the rough estimate that the paper assumes: ±1 subaperture and ±2 deg (section 4); of the
magnification, for which it assumes none, 2 % (numeric units)."""


def random_starts(
    truth: Misregistration, distance: float, n_starts: int, rng: np.random.Generator
) -> tuple[Misregistration, ...]:
    """Return starts at the corners of the rough estimate's box, scaled by a distance.

    The signs are random.
    """
    signs = rng.choice([-1.0, 1.0], (n_starts, 4))
    return tuple(
        Misregistration.from_vector(truth.vector + distance * row * ROUGH_ESTIMATE) for row in signs
    )
