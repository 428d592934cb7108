"""Fit coupling and modulation, and try the other stop and normalisation.

The registration is fitted together with coupling and modulation, and both are compared with the
file. Of a stop, a normalisation or a kind of influence the other one is tried as well,
and so are other pupils.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.disjoint_sets import SIGNIFICANT
from pyrcal.offline.methods import Settled
from pyrcal.offline.models import FAR_BETTER, FitModels, Optic, Other
from pyrcal.offline.pupil_checks import Few, Lead, TriedPupil
from pyrcal.offline.solver import refine
from pyrcal.offline.uncertainty import Uncertainty

Array = NDArray[np.float64]

COUPLING_KEY = "coupling"
"""Of the instrument file, for the width of influence functions."""

NOTABLE = 0.03
"""A logarithm of the instrument's that differs by less from the file's is not worth a word."""

MIN_EXPLAINED = 0.005
"""RMS share of the signal that another instrument has to explain to be preferred. Models of one
instrument differ by about as much: with OOPAO's own Shack-Hartmann 0.2 % is left over, and another
stop, by chance of the model's errors, explains 0.12 %."""

LITTLE_EXPLAINED = 0.3
"""Share of χ² left by another coupling or modulation above which it may stand for something else.
Files told a wrong modulation left less than 0.05; pushes alone of 200 nm left 0.6."""

NO_SENSOR_NUMBER_LIMIT = 0.1
"""A modulation, λ/D, found below this is none: to the matrix they are the same to 1e-3."""

NOTABLE_SIGMA = 3.0
"""... nor one that differs by less than this many of its own σ."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rival:
    """Another instrument that the matrix might come from."""

    change: Other
    """What to write into the file."""

    lead: Lead
    """How much better it explains the matrix than this one."""

    moved: Array
    """``(4,)`` by how much the registration would be another, numeric units."""

    explained: float
    """RMS share of the signal that it explains and this one does not."""

    @property
    def share(self) -> float:
        """χ² that it leaves, over what this one leaves."""
        return self.lead.share

    @property
    def preferred(self) -> bool:
        """Whether the matrix prefers it to the instrument of the file.

        It leaves clearly less, by more than chance, and by more than models differ anyway.
        """
        return (
            self.share < self.change.max_misfit_ratio
            and self.lead.significance > SIGNIFICANT
            and self.explained > MIN_EXPLAINED
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundOptic:
    """A number of the instrument that was fitted beside the registration."""

    optic: Optic
    """Which."""

    key: str
    """Of the instrument file."""

    change: float
    """Found over told, as a logarithm."""

    sigma: float
    """1 σ of it."""

    found: float | None
    """Coupling, or the sensor's number; None: a width of influence functions without a coupling."""

    reported: float | None
    """The same in the instrument file; None as above, or said to be unknown."""

    @property
    def found_sigma(self) -> float:
        """1 σ of the value found, in its own unit; of a width as its logarithm."""
        if self.found is None:
            return self.sigma
        if self.optic is Optic.SENSOR:
            return self.found * self.sigma
        return -2.0 * self.found * float(np.log(self.found)) * self.sigma

    @property
    def found_words(self) -> str:
        """The value found, as the file would write it."""
        if self.found is None:
            wider = np.expm1(self.change)
            side = "wider" if wider > 0.0 else "narrower"
            return f"influence functions {abs(wider):.0%} {side}"
        return f"{self.key} = {self.found:.3g}"

    @property
    def file_words(self) -> str:
        """The value in the file."""
        if self.reported is None:
            return "than the instrument file's" if self.found is None else "the file does not say"
        return f"the instrument file says {self.reported:.3g}"

    @property
    def notable(self) -> bool:
        """Whether the file is wrong, as far as the matrix shows."""
        unknown = self.found is not None and self.reported is None
        return not unknown and abs(self.change) > max(NOTABLE, NOTABLE_SIGMA * self.sigma)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FileValuesFit:
    """The fit with coupling and modulation fixed to the values of the instrument file."""

    share: float
    """χ² left now, over what it leaves."""

    moved: Array
    """``(4,)`` by how much its registration is another, numeric units."""

    @property
    def is_undecided(self) -> bool:
        """Whether the values that were fitted explain too little to correct the file.

        Pokes of a tenth of a wavelength, or pushed only, look like another modulation.
        """
        return self.share > LITTLE_EXPLAINED


def rivals(settled: Settled, few: Few, pupils: tuple[TriedPupil, ...]) -> tuple[Rival, ...]:
    """Return other instruments, the one that explains the matrix best first.

    Each is allowed its own registration, coupling and sensor, to first order about those found.
    """

    def explained(lead: Lead) -> float:
        return float(settled.share * np.sqrt(max(1.0 - lead.share, 0.0)))

    found = [
        Rival(
            change=Other(words=one.words, max_misfit_ratio=FAR_BETTER),
            lead=one.lead,
            moved=one.moved,
            explained=explained(one.lead),
        )
        for one in pupils
        if one.explains
    ]
    for change, other in settled.models.other_instruments.items():
        matrix = few.matrix(other)
        lead = few.lead(matrix)
        moved = few.step(matrix)[:4] - few.step(few.own)[:4]
        found.append(Rival(change=change, lead=lead, moved=moved, explained=explained(lead)))
    return tuple(sorted(found, key=lambda one: one.share / one.change.max_misfit_ratio))


def doubt_of_width(settled: Settled, few: Few) -> Array:
    """Return how far a width of the influence functions that cannot be fitted moves α, ``(4,)``.

    Those of a table, or of a thin plate, have no coupling. What others would explain is not
    followed: on the diffractive telescope, whose mirror is of another kind, that was no nearer to
    the truth. It tells how sure the registration is.
    """
    if Optic.WIDTH in settled.models.optics:
        return np.zeros(4)
    settled.models.counter.n += 1
    wider = few.model.width_derivative(few.here)
    fine = settled.solution.matrix[:, few.modes].astype(np.float64)
    return np.asarray(few.step(fine, wider)[:4] - few.step(fine)[:4])


def found_optics(models: FitModels, settled: Settled, sure: Uncertainty) -> tuple[FoundOptic, ...]:
    """Return coupling and modulation as fitted; ``models`` are of the file's instrument."""
    nuisances = settled.nuisances
    changes = nuisances.changes(settled.solution.nuisances)
    number, sensor_key = models.sensor_number, models.sensor_key
    found = []
    for k, (optic, change) in enumerate(changes.items(), nuisances.first_optic):
        stated, value = number, number * float(np.exp(change))
        if optic is Optic.WIDTH and models.coupling is not None:
            stated, value = models.coupling, float(models.coupling ** np.exp(-2.0 * change))
        elif optic is Optic.SENSOR and value < NO_SENSOR_NUMBER_LIMIT:
            value = 0.0
        known = models.exact(optic)
        found.append(
            FoundOptic(
                optic=optic,
                key=sensor_key if optic is Optic.SENSOR and sensor_key else COUPLING_KEY,
                change=change,
                sigma=float(sure.nuisance_sigma[k]),
                found=value if known else None,
                reported=stated if known and optic not in nuisances.unknown else None,
            )
        )
    return tuple(found)


def fit_file_values(models: FitModels, settled: Settled) -> FileValuesFit:
    """Return the fit with coupling and modulation fixed to those of the file's ``models``."""
    nothing = replace(settled.nuisances, optics=())
    there = refine(models, settled.target, settled.solution.alpha, nothing)
    return FileValuesFit(
        share=settled.solution.projection.chi / there.projection.chi,
        moved=there.vector - settled.solution.vector,
    )
