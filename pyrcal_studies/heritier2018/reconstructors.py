"""Reconstructors of the study: from the model, from a measurement, from a fit to one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.calibration import Answer, Measurement
from pyrcal_studies.heritier2018.registration import FitRun, Found, fitted_alpha, resolved
from pyrcal_studies.heritier2018.store import Record, Store, Task
from pyrcal_studies.heritier2018.telescope import Occasion
from service.control.gains import CalibrationGains
from service.control.reconstructor import invert
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration


class Inverse(Task, Protocol):
    """A task whose result is a reconstructor."""

    @property
    def n_modes(self) -> int:
        """Modes it controls."""

    @property
    def passes(self) -> int:
        """How often the light meets the mirror whose commands it gives."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelReconstructor:
    """Inverse of the model's matrix at a registration that is taken for granted."""

    occasion: Occasion
    alpha: Misregistration | Found
    n_modes: int

    @property
    def passes(self) -> int:
        """How often the light meets the mirror whose commands it gives."""
        return self.occasion.passes

    @property
    def needs(self) -> tuple[Task, ...]:
        """Nothing but the model, and the fit where that says where it lies."""
        return (self.alpha.fit,) if isinstance(self.alpha, Found) else ()

    def compute(self, store: Store) -> Record:
        """Return ``matrix`` ``(n_modes, n_slopes)``."""
        alpha = resolved(self.alpha, store)
        matrix = synthetic_matrix(alpha) * self.occasion.passes
        return {"matrix": invert(matrix, self.n_modes).matrix}


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredReconstructor:
    """Inverse of the measured matrix itself, its noise included."""

    measurement: Measurement | Answer

    @property
    def passes(self) -> int:
        """How often the light met the mirror when it was measured."""
        return self.measurement.occasion.passes

    @property
    def needs(self) -> tuple[Task, ...]:
        """The measurement."""
        return self.measurement.parts

    @property
    def n_modes(self) -> int:
        """Modes it controls."""
        return self.measurement.n_modes

    def compute(self, store: Store) -> Record:
        """Return ``matrix`` ``(n_modes, n_slopes)``."""
        return {"matrix": invert(self.measurement.matrix(store), self.n_modes).matrix}


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedReconstructor:
    """Inverse of the model's matrix at the registration that a fit found."""

    fit: FitRun
    n_modes: int
    tuned: bool
    """Whether the columns have the gains of the measurement."""

    @property
    def passes(self) -> int:
        """How often the light met the mirror when the fitted matrix was measured."""
        return self.fit.source.occasion.passes

    @property
    def needs(self) -> tuple[Task, ...]:
        """The fit."""
        return (self.fit,)

    def compute(self, store: Store) -> Record:
        """Return ``matrix`` ``(n_modes, n_slopes)``."""
        fit = store.read(self.fit)
        matrix = synthetic_matrix(fitted_alpha(fit))
        if self.tuned:
            matrix = calibration_gains(fit, matrix.shape[1]).tuned(matrix)
        return {"matrix": invert(self.passes * matrix, self.n_modes).matrix}


def calibration_gains(fit: Record, n_basis: int) -> CalibrationGains:
    """Return the gains that a fit found, for every mode of the basis."""
    return CalibrationGains.of_modes(fit["gains"], fit["modes"], n_basis)


def synthetic_matrix(
    alpha: Misregistration, instrument: Instrument | None = None
) -> NDArray[np.float64]:
    """Return the model's matrix ``(n_slopes, n_modes)`` for light that meets the mirror once.

    ``instrument`` is None for the study's own.
    """
    model = InteractionModel(instrument or telescope.instrument(), telescope.basis())
    return np.asarray(model.interaction_matrix(alpha), dtype=np.float64)
