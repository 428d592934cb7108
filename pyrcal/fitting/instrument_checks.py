"""Compare coupling and modulation with the instrument file, and try alternative instruments.

Coupling and modulation are fitted together with the registration and compared with the file. For
the stop, the normalisation and the kind of influence function, the alternative is tried as well,
and so are other pupils.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.disjoint_sets import SIGNIFICANT
from pyrcal.fitting.methods import SEARCH_RESIDUAL, Settled, settle
from pyrcal.fitting.models import (
    FAR_PREFERRED_SHARE,
    FitModels,
    InstrumentChange,
    Optic,
    moved_sensor_number,
)
from pyrcal.fitting.pupil_checks import FitSubset, Lead, TriedPupil
from pyrcal.fitting.solver import image_patterns, is_blurring, refine
from pyrcal.fitting.uncertainty import Uncertainty
from service.model.sensors.registry import kind_of

Array = NDArray[np.float64]

COUPLING_KEY = "coupling"
"""Key of the instrument file for the width of influence functions."""

UNKNOWN_IMAGES = 'image_offsets_px = "unknown"'
"""Entry of the instrument file by which the places of the pupil images are fitted."""

NOTABLE_CHANGE = 0.03
"""Smallest difference of a logarithm from the file's value that is reported."""

MIN_EXPLAINED = 0.01
"""RMS share of the signal that another instrument must explain to be preferred. Models of one
instrument differ by about as much: with HCIPy's lenslets 1.0 % is left over, and another stop
explains 0.7 % by coincidence with model errors."""

UNDECIDED_SHARE = 0.3
"""Share of χ² left by another coupling or modulation above which it may compensate something else.
With a wrong modulation in the file less than 0.05 was left; with push-only pokes of 200 nm 0.6 was
left."""

NO_SENSOR_NUMBER_LIMIT = 0.1
"""Fitted modulation, λ/D, below which 0 is reported: the matrices are the same to 1e-3."""

NOTABLE_SIGMA = 3.0
"""Smallest such difference that is reported, in units of its own σ."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlternativeInstrument:
    """An alternative instrument that might explain the matrix."""

    change: InstrumentChange
    """Change of the instrument file."""

    lead: Lead
    """Improvement of the misfit over the instrument of the file."""

    moved: Array
    """``(4,)`` change of the registration with this instrument, numeric units."""

    explained: float
    """RMS share of the signal that it explains and the file's instrument does not."""

    @property
    def share(self) -> float:
        """χ² that it leaves, over that of the file's instrument."""
        return self.lead.share

    @property
    def preferred(self) -> bool:
        """True if the matrix prefers it to the instrument of the file.

        Its residual must be clearly smaller, by more than chance and by more than models of one
        instrument differ.
        """
        return (
            self.share < self.change.max_misfit_ratio
            and self.lead.significance > SIGNIFICANT
            and self.explained > MIN_EXPLAINED
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundOptic:
    """An optical quantity that was fitted together with the registration."""

    optic: Optic
    """Kind of the quantity."""

    key: str
    """Key in the instrument file."""

    change: float
    """Logarithm of the fitted value over the file's value."""

    sigma: float
    """1 σ of ``change``."""

    found: float | None
    """Fitted coupling, or the sensor's number; None for a width of influence functions without a
    coupling."""

    reported: float | None
    """Value in the instrument file; None if it is unknown or has no key."""

    @property
    def found_sigma(self) -> float:
        """1 σ of the fitted value in its own unit; for a width, of its logarithm."""
        if self.found is None:
            return self.sigma
        if self.optic is Optic.SENSOR:
            # Upwards, because of no modulation there is no other side.
            return moved_sensor_number(self.found, self.sigma) - self.found
        # The derivative of coupling ** exp(-2 change) by the change.
        return -2.0 * self.found * float(np.log(self.found)) * self.sigma

    @property
    def found_words(self) -> str:
        """Fitted value in the notation of the file."""
        if self.found is None:
            wider = np.expm1(self.change)
            side = "wider" if wider > 0.0 else "narrower"
            return f"influence functions {abs(wider):.0%} {side}"
        return f"{self.key} = {self.found:.3g}"

    @property
    def file_words(self) -> str:
        """Value in the file."""
        if self.reported is None:
            return "than the instrument file's" if self.found is None else "the file does not say"
        return f"the instrument file says {self.reported:.3g}"

    @property
    def notable(self) -> bool:
        """True if the fitted value differs significantly from the file."""
        unknown = self.found is not None and self.reported is None
        return not unknown and abs(self.change) > max(NOTABLE_CHANGE, NOTABLE_SIGMA * self.sigma)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FileValuesFit:
    """The fit with coupling and modulation fixed to the values of the instrument file."""

    share: float
    """χ² with fitted values, over that with the file's values."""

    moved: Array
    """``(4,)`` change of the registration with the file's values, numeric units."""

    @property
    def is_undecided(self) -> bool:
        """True if the fitted values explain too little to justify a correction of the file.

        Pokes of a tenth of a wavelength, or push-only pokes, look like another modulation.
        """
        return self.share > UNDECIDED_SHARE


def compare_instruments(
    settled: Settled, few: FitSubset, pupils: tuple[TriedPupil, ...]
) -> tuple[AlternativeInstrument, ...]:
    """Return alternative instruments, sorted by how well each explains the matrix.

    Each has its own registration, coupling and sensor number, fitted to first order.
    """

    def share_explained(lead: Lead) -> float:
        return float(settled.share * np.sqrt(max(1.0 - lead.share, 0.0)))

    found = [
        AlternativeInstrument(
            change=InstrumentChange(words=one.words, max_misfit_ratio=FAR_PREFERRED_SHARE),
            lead=one.lead,
            moved=one.moved,
            explained=share_explained(one.lead),
        )
        for one in pupils
        if one.explains
    ]
    for change, other in settled.models.other_instruments.items():
        matrix = few.matrix(other)
        lead = few.lead(matrix)
        moved = few.step(matrix)[:4] - few.step(few.own)[:4]
        found.append(
            AlternativeInstrument(
                change=change, lead=lead, moved=moved, explained=share_explained(lead)
            )
        )
    found += _try_free_images(settled, few)
    # Changes have different limits, so each is ranked by its own.
    return tuple(sorted(found, key=lambda one: one.share / one.change.max_misfit_ratio))


def _try_free_images(settled: Settled, few: FitSubset) -> Iterator[AlternativeInstrument]:
    """Yield the fit with fitted pupil images, if the file states where they are."""
    about = settled.models.instrument
    other = kind_of(about).without_image_places(about)
    if other is None or len(settled.nuisances.images):
        return
    patterns = image_patterns(about.stop)
    nuisances = replace(
        settled.nuisances,
        images=patterns,
        image_sigma=kind_of(other).image_sigma_subap(other) or 0.0,
    )
    rates = nuisances.combine_images(few.model.image_derivatives(few.here), few.derivatives)
    # To first order first. Blurs have no effect to first order, and displacements never only blur.
    seen = [rate for one, rate in zip(patterns, rates, strict=True) if not is_blurring(one)]
    lead = few.lead(few.own, *seen)
    moved = few.step(few.own, *seen)[:4] - few.step(few.own)[:4]
    if settled.share * np.sqrt(max(1.0 - lead.share, 0.0)) > MIN_EXPLAINED:
        models, before = replace(settled.models, instrument=other), settled.solution
        after = settle(models, settled.target, before.alpha, nuisances).solution
        share = after.projection.chi / before.projection.chi
        # the fit may end where a blur has the wrong sign
        if after.converged and share < lead.share:
            lead, moved = replace(lead, share=share), after.vector - before.vector
    yield AlternativeInstrument(
        change=InstrumentChange(words=UNKNOWN_IMAGES, max_misfit_ratio=FAR_PREFERRED_SHARE),
        lead=lead,
        moved=moved,
        explained=settled.share * float(np.sqrt(max(1.0 - lead.share, 0.0))),
    )


def estimate_width_effect(settled: Settled, few: FitSubset) -> Array:
    """Return the change of α for a width of influence functions that is not fitted, ``(4,)``.

    Influence functions from a table or of a thin plate have no coupling. The change enters σ only
    and does not correct α: on the diffractive telescope, whose mirror is of another kind, the
    correction was not closer to the truth.
    """
    # A fitted coupling already follows the width.
    if Optic.WIDTH in settled.models.optics:
        return np.zeros(4)
    settled.models.counter.n += 1
    wider = few.model.width_derivative(few.here)
    fine = settled.solution.matrix[:, few.modes].astype(np.float64)
    return np.asarray(few.step(fine, wider)[:4] - few.step(fine)[:4])


def list_optics(models: FitModels, settled: Settled, sure: Uncertainty) -> tuple[FoundOptic, ...]:
    """Return coupling and modulation as fitted; ``models`` are of the file's instrument."""
    nuisances = settled.nuisances
    changes = nuisances.changes(settled.solution.nuisances)
    number, sensor_key = models.sensor_number, models.sensor_key
    found = []
    for k, (optic, change) in enumerate(changes.items(), nuisances.first_optic):
        stated, value = number, moved_sensor_number(number, change)
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
    """Return the fit with coupling and modulation fixed to those of the file's ``models``.

    Both are compared on the coarse grid, unless so little is left over that its own error counts.
    """
    nothing = replace(settled.nuisances, optics=())
    # The fitted places of the images are kept, so that the two fits differ in coupling and
    # modulation only.
    if np.any(nothing.displaced):
        models = models.with_displaced_images(nothing.displaced)
    found, coarse = settled.solution, settled.share > SEARCH_RESIDUAL
    if coarse:
        # The fit is repeated on the coarse grid as well: both χ² then contain that grid's error.
        found = refine(
            settled.models,
            settled.target,
            found.alpha,
            settled.nuisances,
            near=found,
            decides=settled.models.cheap,
        )
    there = refine(
        models,
        settled.target,
        found.alpha,
        nothing,
        decides=models.cheap if coarse else models.fine,
    )
    return FileValuesFit(
        share=found.projection.chi / there.projection.chi, moved=there.vector - found.vector
    )
