"""Fit coupling and modulation, and try the other stop and normalisation.

The registration is fitted together with coupling and modulation, and both are compared with the
file. Of a stop, a normalisation or a kind of influence the other one is tried as well,
and so are other pupils.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.methods import Settled
from pyrcal.offline.models import BETTER, CHEAP, FAR_BETTER, FitModels, Optic, Other
from pyrcal.offline.pupil_checks import Few, TriedPupil
from pyrcal.offline.solver import Solution, refine
from pyrcal.offline.uncertainty import Uncertainty
from service.model.kinds import Stop

Array = NDArray[np.float64]

COUPLING_KEY = "coupling"
"""Of the instrument file, for the width of influence functions."""

NOTABLE = 0.03
"""A logarithm of the instrument's that differs by less from the file's is not worth a word."""

NOTABLE_SIGMA = 3.0
"""... nor one that differs by less than this many of its own σ."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rival:
    """Another instrument that the matrix might come from."""

    change: Other
    """What to write into the file."""

    share: float
    """χ² that it leaves, over what this one leaves."""

    moved: Array
    """``(4,)`` by how much the registration would be another, where the matrix cannot tell the two
    instruments apart, numeric units; 0 where it can."""

    estimate: Array
    """``(4,)`` the same, to first order, whether it can or not."""

    @property
    def believed(self) -> bool:
        """Whether it is the instrument, rather than the one of the file."""
        return self.share < self.change.believed


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
    def told_words(self) -> str:
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
class AsTold:
    """The fit in which nothing of the instrument is unknown."""

    share: float
    """χ² left now, over what it leaves."""

    moved: Array
    """``(4,)`` by how much its registration is another, numeric units."""


def rivals(settled: Settled, few: Few, pupils: tuple[TriedPupil, ...]) -> tuple[Rival, ...]:
    """Return other instruments, the one that explains the matrix best first.

    Each is allowed its own registration, coupling and sensor, to first order about those found;
    where the matrix cannot tell, it is fitted as well.
    """
    own = few.left(few.own)
    found = [
        Rival(
            change=Other(words=one.words, believed=FAR_BETTER),
            share=one.share,
            moved=one.moved,
            estimate=one.moved,
        )
        for one in pupils
        if one.explains
    ]
    for change, other in settled.models.other_instruments.items():
        seen = few.seen(few.matrix(other))
        share, moved = seen.chi_at_best / own, np.zeros(4)
        estimate = seen.best_step[:4] - few.step(few.own)[:4]
        if change.believed <= share < 1.0 / BETTER:
            there, here = _fitted_alike(other, settled), _fitted_alike(settled.models, settled)
            moved = there.vector - here.vector if there.converged else moved
            estimate = moved if there.converged else estimate
        found.append(Rival(change=change, share=share, moved=moved, estimate=estimate))
    return tuple(sorted(found, key=lambda one: one.share / one.change.believed))


def _fitted_alike(models: FitModels, settled: Settled) -> Solution:
    """Return the fit of an instrument on the cheap grid, by the derivatives of the solution.

    Two instruments are compared by fits that are alike in all but the instrument.
    """
    start, near = settled.solution.alpha, settled.solution.near
    # with the mirror as stop every shift has a response of its own: none is worth keeping
    cheap = models.model(CHEAP, once=models.instrument.stop is Stop.MIRROR)
    return refine(models, settled.target, start, settled.nuisances, near=near, decides=cheap)


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


def as_told(models: FitModels, settled: Settled) -> AsTold:
    """Return the fit with the instrument that the file describes; ``models`` are its."""
    nothing = replace(settled.nuisances, optics=())
    there = refine(models, settled.target, settled.solution.alpha, nothing)
    return AsTold(
        share=settled.solution.projection.chi / there.projection.chi,
        moved=there.vector - settled.solution.vector,
    )
