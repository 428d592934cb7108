"""Quantities that the fit determined: key, value in the file, fitted value, and method."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.comparison import Alternative
from pyrcal.fitting.instrument_checks import FoundOptic, may_compensate
from pyrcal.fitting.methods import Settled
from pyrcal.fitting.models import ELLIPSE, FAMILIES, ROOFTOP, Optic
from service.model.instrument import Instrument
from service.model.sensors.registry import kind_of
from service.model.slopes import FLIPS, Orientation, SlopeRecipe

MAX_STRUCTURE = 0.09
"""Largest RMS share of the signal, left over and not noise, at which a fitted number that the file
does not have is accepted. Beyond it the number may compensate errors of the model: on PAPYRUS, with
14 % left over, every disjoint set finds a modulation of 10.6 λ/D, although the bench is set to 5.
"""

MAX_LOG_SIGMA = 0.5
"""Largest 1 σ of a number's logarithm at which it is accepted: half the prior of an unknown number.
"""


MODEL_GAIN_SIGMA = 0.01
"""1 σ of the gain of all modes by errors of the model: matrices of OOPAO with 10 % noise and a
modulation of 5 λ/D have gains of 0.989, others of 0.9999 to 1.0005."""

N_NAMED = 3
"""Number of polynomials of a static aberration that are named."""

MAX_GAIN_SCATTER = 0.35
"""Relative scatter of the gains above which their median says nothing of the wavelength."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """A number or choice determined from the matrix."""

    key: str
    """Key in the instrument file."""

    found: str
    """Fitted value, in the notation of the file."""

    reported: str
    """Value in the file."""

    how: str
    """Method by which it was determined."""

    correct: bool
    """True if the file should be corrected or completed."""

    @property
    def entry(self) -> str:
        """Entry for the instrument file."""
        return f"{self.key} = {self.found}"

    @property
    def words(self) -> str:
        """Summary of key, values and method."""
        return f"{self.entry} ({self.how}; the file says {self.reported})"


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundStroke:
    """Unit and sign of the commands."""

    metres_per_unit: float | None
    """OPD of one unit of a command in metres, negative if commands have the other sign; None if the
    matrix does not determine it."""

    sigma: float | None
    """1 σ of ``metres_per_unit``."""

    condition: str
    """Condition of the value, or the reason why there is none; empty if there is no condition."""

    @property
    def words(self) -> str:
        """Value and condition as text."""
        if self.metres_per_unit is None or self.sigma is None:
            return f"the unit of the commands is not determined: {self.condition}"
        value = f"a unit of command is {self.metres_per_unit:.3g} +- {self.sigma:.1g} m of OPD"
        return f"{value}, if {self.condition}" if self.condition else value


def list_origins(
    about: Instrument,
    reported: SlopeRecipe,
    found: SlopeRecipe,
    optics: tuple[FoundOptic, ...],
    with_file_values: Alternative | None,
    structure: float,
    gains: NDArray[np.float64],
) -> tuple[Origin, ...]:
    """Return the quantities of instrument and slopes that the fit determined.

    Parameters
    ----------
    about
        Instrument as the file describes it.
    reported, found
        Slope recipes: requested and fitted.
    optics
        Optical quantities that were fitted together with the registration.
    with_file_values
        Fit with the file's values of these; None if none differs significantly.
    structure
        RMS share of the signal that is left over and is not noise.
    gains
        ``(n_used,)`` gains of the modes.
    """
    return (
        *_find_slopes(reported, found),
        *(
            _describe_optic(one, determined=is_determined(one, with_file_values, structure))
            for one in optics
            if one.found is not None and one.sigma < MAX_LOG_SIGMA
        ),
        *_find_wavelength(about, gains),
        *_find_strokes(about),
    )


def _find_slopes(reported: SlopeRecipe, found: SlopeRecipe) -> Iterator[Origin]:
    if reported.order is not found.order:
        yield Origin(
            key="order",
            found=f'"{found.order}"',
            reported=f'"{reported.order}"',
            how="scanned: the lowest modes",
            correct=True,
        )
    # The file leaves the orientation to the search on purpose, so there is nothing to correct.
    if reported.orientation is None:
        yield Origin(
            key="orientation",
            found=format_orientation(found.assumed_orientation),
            reported='"auto"',
            how="scanned: the lowest modes",
            correct=False,
        )


def format_orientation(orientation: Orientation) -> str:
    """Return an orientation as the instrument file writes it."""
    flips = ", ".join(f"{name} = {str(getattr(orientation, name)).lower()}" for name in FLIPS)
    both = [orientation.sign_x, orientation.sign_y]
    return f"{{ {flips}, sign = {both[0] if both[0] == both[1] else both} }}"


def is_determined(one: FoundOptic, with_file_values: Alternative | None, structure: float) -> bool:
    """Return True if a fitted number is reliable, rather than compensating model errors.

    A number of the file is corrected if the file's value leaves several times the residual. A
    number that the file does not have is accepted if hardly more than noise is left over. Agreement
    of disjoint sets proves nothing: they share the errors of the model.
    """
    # Such a number is hardly better known than its prior.
    if one.sigma > MAX_LOG_SIGMA:
        return False
    if one.reported is None or with_file_values is None:
        return structure < MAX_STRUCTURE
    return not may_compensate(with_file_values)


def list_undetermined_keys(about: Instrument, found: tuple[Origin, ...]) -> tuple[str, ...]:
    """Return the keys marked as unknown in the file that the matrix does not determine.

    The positions of the pupil images are excluded: they are fitted whenever the file has none.
    """
    keys = {one.key for one in found} | {"image_offsets_px"}
    return tuple(key for key in about.unknown if key.rpartition(".")[2] not in keys)


def _describe_optic(one: FoundOptic, *, determined: bool) -> Origin:
    unknown = one.reported is None
    doubt = "" if determined else ", may compensate errors of the model"
    return Origin(
        key=one.key,
        found=f"{one.found:.3g}",
        reported='"unknown"' if unknown else f"{one.reported:.3g}",
        how=f"fitted, 1 sigma {one.found_sigma:.1g}{doubt if unknown or one.notable else ''}",
        correct=determined and (unknown or one.notable),
    )


def find_families(
    settled: Settled, sigma: NDArray[np.float64], structure: float
) -> Iterator[Origin]:
    """Yield an elliptic modulation and a static aberration, if they were fitted.

    ``sigma`` ``(n_nuisances,)`` is 1 σ of all nuisances, ``structure`` that of ``list_origins``.
    """
    models, nuisances = settled.models, settled.nuisances
    places: dict[Optic, int] = {
        optic: k
        for k, (optic, _) in enumerate(nuisances.optics, nuisances.first_optic)
        if optic is not Optic.WIDTH
    }
    # The models have all but the last, linear steps.
    for optic, k in places.items():
        models = models.with_optic(optic, float(settled.solution.nuisances[k]))
    about, determined = models.instrument, structure < MAX_STRUCTURE
    kind, unit_nm = kind_of(about), about.wfs.wavelength_m / (2.0 * np.pi * 1e-9)
    doubt = "" if determined else ", may compensate errors of the model"
    for key, family in FAMILIES.items():
        if family is ROOFTOP or not places.keys() >= set(family):
            continue  # a rooftop is one number, see ``list_optics``
        if family is ELLIPSE:
            axes = {Optic.SENSOR, *ELLIPSE}
            largest = max(sigma[k] for optic, k in places.items() if optic in axes)
            found, words = kind.modulation_entry(about.wfs), f"of an axis {largest:.1%}"
        else:
            sigma_nm = unit_nm * max(sigma[places[optic]] for optic in family)
            found, words = kind.aberration_entry(about.wfs), f"of each {sigma_nm:.2g} nm"
            sizes = sorted(
                zip(json.loads(found), family, strict=True), key=lambda one: -abs(one[0])
            )
            largest = ", ".join(f"{optic} {size:+.0f} nm" for size, optic in sizes[:N_NAMED])
            words += f"; the largest are {largest}"
        yield Origin(
            key=key,
            found=found,
            reported='"unknown"',
            how=f"fitted, 1 sigma {words}{doubt}",
            correct=determined,
        )


def _find_wavelength(about: Instrument, gains: NDArray[np.float64]) -> Iterator[Origin]:
    middle = float(np.median(gains))
    # Slopes per metre go as one over the wavelength. If strokes are unknown too, both scale all
    # columns alike and cannot be separated.
    if "wfs.wavelength_m" in about.unknown and about.mirror.stroke_known and middle > 0.0:
        scatter = float(np.std(gains)) / middle
        yield Origin(
            key="wavelength_m",
            found=f"{about.wfs.wavelength_m / middle:.3g}",
            reported='"unknown"',
            how=f"from the gains, which scatter by {scatter:.1%}",
            correct=scatter < MAX_GAIN_SCATTER,
        )


def _find_strokes(about: Instrument) -> Iterator[Origin]:
    # One gain for each mode is free in every fit, so that unknown strokes cost no information on α.
    if not about.mirror.stroke_known:
        yield Origin(
            key="stroke",
            found="one gain for each mode",
            reported='"unknown"',
            how="fitted: the shapes alone determine the registration",
            correct=False,
        )


def find_stroke(
    about: Instrument,
    found: SlopeRecipe,
    gains: NDArray[np.float64],
    optics: tuple[FoundOptic, ...],
    structure: float,
) -> FoundStroke:
    """Return the unit and the sign of the commands, of the gains of the modes.

    Parameters are those of ``list_origins``; ``found`` is the fitted recipe.
    """
    middle = float(np.median(gains))
    scatter = float(np.std(gains)) / abs(middle) if middle else np.inf
    reason = ""
    if "wfs.wavelength_m" in about.unknown:
        reason = "an unknown wavelength scales all columns as the unit does"
    elif structure > MAX_STRUCTURE:
        reason = f"{structure:.0%} of the signal is left over and is not noise"
    elif scatter > MAX_GAIN_SCATTER:
        reason = f"gains of the modes scatter by {scatter:.0%}, so that they have no common unit"
    if reason:
        return FoundStroke(metres_per_unit=None, sigma=None, condition=reason)
    of_sensor = [one.sigma for one in optics if one.optic is Optic.SENSOR]
    parts = [MODEL_GAIN_SIGMA, structure, scatter / np.sqrt(len(gains)), *of_sensor]
    conditions = []
    # Frames are made into slopes here; those of an RTC may have any scale.
    if about.frames is None:
        conditions.append("the slopes have the normalisation of the instrument file")
    elif kind_of(about).knows_mean_light(about):
        conditions.append("the frames are divided by the sum of the detector")
    axes = found.assumed_orientation
    if about.slopes.orientation is None and axes.sign_x == axes.sign_y == -1:
        conditions.append("the slopes have the other sign; otherwise the commands have")
    return FoundStroke(
        metres_per_unit=middle,
        sigma=abs(middle) * float(np.linalg.norm(parts)),
        condition=" and ".join(conditions),
    )
