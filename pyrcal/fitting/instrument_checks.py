"""Compare coupling and modulation with the instrument file, and try alternative instruments.

Coupling and modulation are fitted together with the registration and compared with the file. For
the stop, the normalisation and the kind of influence function, the alternative is tried as well,
and so are other pupils.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.comparison import MIN_EXPLAINED, Alternative, FitSubset
from pyrcal.fitting.methods import SEARCH_RESIDUAL, Settled, settle
from pyrcal.fitting.models import (
    ABERRATION,
    ABERRATION_KEY,
    ELLIPSE,
    ELLIPSE_KEY,
    FAR_PREFERRED_SHARE,
    LOGARITHM_ABOVE,
    PREFERRED_SHARE,
    ROOFTOP,
    ROOFTOP_KEY,
    SENSOR_STEP,
    FitModels,
    Optic,
    moved_sensor_number,
)
from pyrcal.fitting.solver import image_patterns, is_blurring, refine
from pyrcal.fitting.uncertainty import Uncertainty
from service.model.sensors.registry import kind_of

Array = NDArray[np.float64]

COUPLING_KEY = "coupling"
"""Key of the instrument file for the width of influence functions."""

ROOFTOP_FLOOR = 0.001
"""1 σ of a fitted rooftop by the last, linear step, λ/D: without noise it was up to 0.0012 off."""

UNKNOWN_ABERRATION = f'{ABERRATION_KEY} = "unknown"'
"""Entry of the instrument file by which a static aberration is fitted."""

UNKNOWN_IMAGES = 'image_offsets_px = "unknown"'
"""Entry of the instrument file by which the places of the pupil images are fitted."""

_KEPT = {*ABERRATION, *ROOFTOP}
"""Quantities of which the file has no value that could take the place of the fitted one."""

TRIED_ABERRATION = ABERRATION[2:7]
"""Polynomials with which a static aberration is tried, focus to coma: each takes a matrix, and a
beam that has others has some of these as well."""

NOTABLE_CHANGE = 0.03
"""Smallest difference of a logarithm from the file's value that is reported."""

UNDECIDED_SHARE = 0.3
"""Share of χ² left by another coupling or modulation above which it may compensate something else.
With a wrong modulation in the file less than 0.05 was left; with push-only pokes of 200 nm 0.6 was
left."""

NO_SENSOR_NUMBER_LIMIT = 0.1
"""Fitted modulation, λ/D, below which 0 is reported: the matrices are the same to 1e-3."""

NOTABLE_SIGMA = 3.0
"""Smallest such difference that is reported, in units of its own σ."""


MODEL_SENSOR_SHARE = 0.4
"""1 σ of a sensor number's logarithm over the share of the signal that the model cannot explain.
Halves of PAPYRUS's modes are fitted with 10.5 and 11.6 λ/D, or with 10.7 and 11.7, although each
has a scatter of its modes of 0.1 to 0.2: the model cannot explain 12 % of their signal."""


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
        if self.optic is Optic.ROOFTOP:
            return float(np.hypot(self.sigma, ROOFTOP_FLOOR))
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
    def is_adopted(self) -> bool:
        """True if a model of the matrix has the fitted value: the file has none, or another one."""
        return self.reported is None or self.notable

    @property
    def notable(self) -> bool:
        """True if the fitted value differs significantly from the file."""
        unknown = self.found is not None and self.reported is None
        return not unknown and abs(self.change) > max(NOTABLE_CHANGE, NOTABLE_SIGMA * self.sigma)


def try_instruments(few: FitSubset) -> Iterator[Alternative]:
    """Yield other stops, normalisations and kinds of influence functions.

    Each has its own registration, coupling and sensor number, fitted to first order.
    """
    for words, (max_share, models) in few.models.other_instruments.items():
        yield few.judge(
            few.compare(few.matrix(models)),
            words,
            max_share,
            key=words,
            min_explained=MIN_EXPLAINED,
            is_instrument=True,
        )


def try_ellipse(few: FitSubset) -> Iterator[Alternative]:
    """Yield an elliptic modulation, if the matrix prefers it to the file's circle.

    Only then, because a bench is aligned to a circle unless a matrix shows otherwise.
    """
    about = few.models.instrument
    if kind_of(about).stretch_modulation(about.wfs, (0.0, 0.0)) is None:
        return
    if Optic.STRETCH in few.models.optics or few.models.sensor_number < LOGARITHM_ABOVE:
        return
    found = _try_family(few, ELLIPSE, ELLIPSE_KEY, FAR_PREFERRED_SHARE)
    if found.preferred:
        yield replace(found, is_instrument=True)


def try_rooftop(few: FitSubset) -> Iterator[Alternative]:
    """Yield a rooftop, if the matrix prefers one to the tip of the file's pyramid."""
    has_faces = hasattr(few.models.instrument.wfs, ROOFTOP_KEY)
    if not has_faces or few.settled.share < MIN_EXPLAINED or Optic.ROOFTOP in few.models.optics:
        return
    found = _try_family(few, ROOFTOP, ROOFTOP_KEY, FAR_PREFERRED_SHARE)
    if found.preferred:
        yield replace(found, is_instrument=True)


def try_aberration(few: FitSubset) -> Iterator[Alternative]:
    """Yield a static aberration of the beam, unless less is left over than models differ by.

    Slopes change with the square of a large aberration, so that the misfit of this first step says
    little of what a fit with ``static_aberration_nm = "unknown"`` leaves.
    """
    about = few.models.instrument
    if kind_of(about).aberrate(about.wfs, 2, 0.0) is None or few.settled.share < MIN_EXPLAINED:
        return
    if Optic.FOCUS in few.models.optics:
        return
    yield _try_family(few, TRIED_ABERRATION, ABERRATION_KEY, PREFERRED_SHARE)


def _try_family(few: FitSubset, family: Sequence[Optic], key: str, max_share: float) -> Alternative:
    """Return the fit with quantities that are fitted if the file's ``key`` is unknown."""
    entry = f'{key} = "unknown"'
    rates = [
        (few.matrix(few.models.with_optic(one, SENSOR_STEP)) - few.own) / SENSOR_STEP
        for one in family
    ]
    return few.judge(
        few.compare(few.own, *rates),
        entry,
        max_share,
        key=entry,
        min_explained=MIN_EXPLAINED,
        is_number=True,
    )


def try_free_images(few: FitSubset) -> Iterator[Alternative]:
    """Yield the fit with fitted pupil images, if the file states where they are."""
    settled = few.settled
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
    found = few.compare(few.own, *seen)
    if found.explained(settled.share) > MIN_EXPLAINED:
        models, before = replace(settled.models, instrument=other), settled.solution
        after = settle(models, settled.target, before.alpha, nuisances).solution
        share = after.projection.chi / before.projection.chi
        # the fit may end where a blur has the wrong sign
        if after.converged and share < found.misfit:
            found = replace(found, share=share, moved=after.vector - before.vector)
    yield few.judge(
        found,
        UNKNOWN_IMAGES,
        FAR_PREFERRED_SHARE,
        key=UNKNOWN_IMAGES,
        min_explained=MIN_EXPLAINED,
        is_number=True,
        is_instrument=True,
    )


def estimate_width_effect(few: FitSubset) -> Array:
    """Return the change of α for a width of influence functions that is not fitted, ``(4,)``.

    Influence functions from a table or of a thin plate have no coupling. The change enters σ only
    and does not correct α: on the diffractive telescope, whose mirror is of another kind, the
    correction was not closer to the truth.
    """
    settled = few.settled
    # A fitted coupling already follows the width.
    if Optic.WIDTH in settled.models.optics:
        return np.zeros(4)
    settled.models.counter.n += 1
    wider = few.model.width_derivative(few.here)
    fine = settled.solution.matrix[:, few.modes].astype(np.float64)
    return np.asarray(few.step(fine, wider)[:4] - few.step(fine)[:4])


def list_optics(
    models: FitModels, settled: Settled, sure: Uncertainty, structure: float
) -> tuple[FoundOptic, ...]:
    """Return coupling and modulation as fitted; ``models`` are of the file's instrument.

    ``structure`` is the RMS share of the signal that is left over and is no noise.
    """
    nuisances = settled.nuisances
    changes = nuisances.changes(settled.solution.nuisances)
    keys = {Optic.ROOFTOP: ROOFTOP_KEY, Optic.SENSOR: models.sensor_key}
    number = models.sensor_number
    found = []
    for k, (optic, change) in enumerate(changes.items(), nuisances.first_optic):
        if optic in ELLIPSE or optic in ABERRATION:
            continue  # which no single number says: ``find_families``
        stated, value = number, moved_sensor_number(number, change)
        if optic is Optic.WIDTH and models.coupling is not None:
            stated, value = models.coupling, float(models.coupling ** np.exp(-2.0 * change))
        elif optic is Optic.SENSOR and value < NO_SENSOR_NUMBER_LIMIT:
            value = 0.0
        elif optic is Optic.ROOFTOP:
            stated, value = 0.0, round(change, 4) + 0.0  # without the sign of a zero
        known, sigma = models.exact(optic), float(sure.nuisance_sigma[k])
        if optic is Optic.SENSOR:
            sigma = float(np.hypot(sigma, MODEL_SENSOR_SHARE * structure))
        found.append(
            FoundOptic(
                optic=optic,
                key=keys.get(optic) or COUPLING_KEY,
                change=change,
                sigma=sigma,
                found=value if known else None,
                reported=stated if known and optic not in nuisances.unknown else None,
            )
        )
    return tuple(found)


def fit_file_values(
    models: FitModels, settled: Settled, optics: Sequence[FoundOptic]
) -> Alternative:
    """Return the fit with coupling and modulation fixed to those of the file's ``models``.

    Both are compared on the coarse grid, unless so little is left over that its own error counts.
    """
    nothing = replace(settled.nuisances, optics=())
    for optic, change in settled.nuisances.changes(settled.solution.nuisances).items():
        models = models.with_optic(optic, change) if optic in _KEPT else models
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
    # Values marked as unknown in the file cannot be restored, so only stated ones are named.
    stated = [f"{one.key} = {one.reported:.3g}" for one in optics if one.reported is not None]
    left = there.projection.chi
    return Alternative(
        words=" and ".join(stated) or "the values of the file",
        share=left / max(found.projection.chi, 1e-12 * left),
        moved=there.vector - found.vector,
    )


def may_compensate(with_file_values: Alternative) -> bool:
    """Return True if fitted values explain too little to justify a correction of the file.

    Pokes of a tenth of a wavelength, or push-only pokes, look like another modulation.
    """
    return with_file_values.misfit * UNDECIDED_SHARE < 1.0
