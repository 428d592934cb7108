"""Finding the hidden registration: the joint fit, and the paper's scans one after the other."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.fitted import Fit
from pyrcal.offline.matrix import FitOptions, fit_matrix
from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.calibration import Measurement
from pyrcal_studies.heritier2018.store import Record, Store, Task
from service.errors import PyrcalError
from service.model.kinds import Method
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.slopes import Orientation

Array = NDArray[np.float64]

_COST_S = {Method.JOINT: 3.0, Method.PAPER: 10.0, Method.SENSITIVITY: 5.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class FitRun:
    """One fit to one measured matrix from one start."""

    measurement: Measurement
    method: Method
    start: Misregistration

    @property
    def label(self) -> str:
        """What the progress bar shows."""
        rotation = self.start.to_boundary()["rotation_deg"]
        return f"fit ({self.method}) from {rotation:.1f} deg"

    @property
    def cost_s(self) -> float:
        """Rough time on one idle core, seconds."""
        return _COST_S[self.method]

    @property
    def needs(self) -> tuple[Task, ...]:
        """The measurement."""
        return self.measurement.parts

    def compute(self, store: Store) -> Record:
        """Return what the fit found, flattened; a fit that gives up is a record of its reason."""
        options = FitOptions(method=self.method, start=self.start, orientation=Orientation())
        reference = self.measurement.reference(store)
        instrument, basis = telescope.instrument(), telescope.basis()
        started = time.process_time()
        try:
            fit = fit_matrix(instrument, reference, options, basis=basis)
        except PyrcalError as error:
            return _gave_up(str(error), time.process_time() - started)
        return flattened(fit, time.process_time() - started)


def flattened(fit: Fit, seconds: float) -> Record:
    """Return a fit as arrays."""
    record: dict[str, NDArray[Any]] = {
        "alpha": fit.alpha.vector * BOUNDARY_SCALE,
        "sigma": np.sqrt(np.diag(fit.covariance)) * BOUNDARY_SCALE,
        "gains": fit.gains,
        "residual_fraction": np.array(fit.residual_fraction),
        "residual_by_mode": fit.residual_by_mode,
        "condition_number": np.array(fit.condition_number),
        "accepted": np.array(fit.accepted),
        "verdict": np.array(fit.verdict),
        "n_evaluations": np.array(fit.n_evaluations),
        "seconds": np.array(seconds),
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
    return record


def _gave_up(reason: str, seconds: float) -> Record:
    return {
        "alpha": np.full(4, np.nan),
        "sigma": np.full(4, np.nan),
        "accepted": np.array(False),
        "verdict": np.array(reason),
        "n_evaluations": np.array(0),
        "seconds": np.array(seconds),
    }


def fitted_alpha(record: Mapping[str, NDArray[Any]]) -> Misregistration:
    """Return the registration a fit found."""
    return Misregistration.from_vector(record["alpha"] / BOUNDARY_SCALE)


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


def random_starts(
    truth: Misregistration, n_starts: int, rng: np.random.Generator
) -> tuple[Misregistration, ...]:
    """Return starts about the truth: ±1.5 subapertures, ±6 deg, ±5 %, uniform."""
    reach = np.array([1.5, 1.5, np.deg2rad(6.0), 0.05])
    steps = rng.uniform(-1.0, 1.0, (n_starts, 4)) * reach
    return tuple(Misregistration.from_vector(truth.vector + step) for step in steps)
