"""Decide whether a fit determines the registration.

The verdict depends on changes of the registration, never on the size of the residual: uneven light
leaves a third of the signal although the registration is correct, and a wrong stop leaves a tenth
although it is wrong. The registration is determined if disjoint sets of modes agree, if no other
minimum is nearly as good, if one orientation is clearly the best, if no other instrument explains
the matrix better and changes the registration by more than σ, if the gains are those of one basis,
and if σ is small enough to be useful. Whether the model is good enough for control is checked
separately: :mod:`pyrcal.fitting.control_check`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.alternatives import LIGHT_KEY, find_decentred_pupil
from pyrcal.fitting.comparison import Alternative
from pyrcal.fitting.instrument_checks import FoundOptic
from pyrcal.fitting.methods import Landing, Settled
from pyrcal.fitting.pupil_width import SeenPupil
from pyrcal.fitting.solver import OPTIC_SIGMA, UNKNOWN_SIGMA, Solution
from pyrcal.fitting.uncertainty import Uncertainty
from service.model.misregistration import BOUNDARY_SCALE

Array = NDArray[np.float64]

MAX_UNEXPLAINED_RATIO = 2.0
"""Largest power of the structured residual over the power that the model explains. With the modes
of another basis or in a false minimum the model explains a quarter of the signal or less."""

MIN_CHANCE_RATIO = 4.0
"""Smallest power that the model explains over what it explains of pure noise, with one gain fitted
for each mode."""

MAX_WITHOUT_CAUSE = 0.4
"""Largest RMS share of the signal that may be left over beyond noise where nothing that was tried
explains any of it."""

MOST_OF_SIGNAL = 0.9
"""RMS share of the signal left over by a fit that did not converge above which noise may be the
cause: four times as much noise as signal left 0.94."""

NOTABLE_STRUCTURE = 0.09
"""RMS share of the signal in the structured residual above which a note names a cause."""

MAX_TENSION = 5.0
"""Largest distance of a set of modes from the others, in its own σ."""

MAX_GAIN_RATIO = 500.0
"""Largest median gain, and the reciprocal of the smallest: illumination cannot explain a factor of
1000, a unit can."""

MAX_SCATTER = 0.35
"""Largest robust relative scatter of the gains; modes of another basis have a larger one."""

LARGEST_SIGMA = np.array([0.3, 0.3, np.deg2rad(3.0), 0.06])
"""Largest 1 σ of a determined registration (numeric units)."""

MAX_OPTIC_DEVIATION = 3.0
"""Largest plausible deviation of a logarithm from the file's, in units of its prior σ."""

EQUAL_MISFIT_RATIO = 2.0
"""Ratio of two alternatives' misfits within which neither is preferred: both are first order."""

MAX_DISPLACEMENT = 1.0
"""Change of the registration in σ up to which a better explanation does not make it undetermined:
the change enters σ, and the advice is to correct the file."""

MIN_EDGE_MOVE_SUBAP = 0.01
"""Smallest displacement at the pupil's edge by which another instrument, or the scatter of sets of
modes, makes the registration undetermined, subapertures. A smaller one is part of σ and changes no
reconstructor: with a matrix of HCIPy's lenslets, fitted to 0.0004 subaperture, the wrong stop left
half of the misfit of 1 %."""

_PASS_TOLERANCE = 0.12
"""Largest relative deviation from a factor of two, and scatter, that indicates a forgotten pass."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitFindings:
    """All inputs of a verdict."""

    settled: Settled
    structure: float
    """RMS share of the signal that is left over and is not noise."""

    uncertainty: Uncertainty
    before: Uncertainty
    """Uncertainty without the alternatives that the data do not exclude."""

    landing: Landing | None
    """Result of the coarse search; None for methods without one."""

    alternatives: tuple[Alternative, ...]
    """Every alternative that was tried."""

    optics: tuple[FoundOptic, ...]
    """Fitted optical quantities."""

    narrow: SeenPupil | None
    """Pupil image that is narrower than in the file; None if it is as wide."""

    with_file_values: Alternative | None
    """Fit with the file's values of ``optics``; None if none differs significantly."""

    axes: str
    """Reason if the orientation cannot be determined; empty if it can."""

    passes: int
    """Stated number of reflections by the mirror."""

    stroke_known: bool

    noise_share: float
    """Largest share of the residual's power that is noise, 0 to 1."""

    weakly_modulated: bool
    """True for a pyramid with hardly any modulation, by the file or by the fit."""

    @property
    def solution(self) -> Solution:
        """Minimum on the fine grid."""
        return self.settled.solution

    @property
    def residual_fraction(self) -> float:
        """RMS of the residual over RMS of the measurement, with all modes weighted equally."""
        return self.settled.share

    @property
    def radius_subap(self) -> float:
        """Radius of the pupil, subapertures."""
        return self.settled.models.instrument.wfs.pupil_diameter / 2.0

    @property
    def instruments(self) -> list[Alternative]:
        """Other instruments that the matrix prefers, the best explanation first."""
        found = [one for one in self.alternatives if one.is_instrument and one.preferred]
        # Changes have different limits, so each is ranked by its own.
        return sorted(found, key=lambda one: one.misfit / one.max_share)

    @property
    def sigma_of_sets(self) -> Array:
        """``(4,)`` 1 σ without alternatives: noise, disjoint sets, floor of the model."""
        return np.asarray(np.sqrt(np.diag(self.before.covariance)))

    @property
    def explained(self) -> bool:
        """True if the model explains enough for fitted quantities to be meaningful."""
        power = 1.0 - self.residual_fraction**2
        n_rows = len(self.solution.projection.residual)
        return (
            MAX_UNEXPLAINED_RATIO * power > self.structure**2 and power * n_rows > MIN_CHANCE_RATIO
        )


class Refusal(StrEnum):
    """Reason of a refused fit."""

    AXES = "axes"
    ANOTHER_PUPIL = "another pupil"
    UNSETTLED = "unsettled"
    UNDETERMINED = "undetermined"
    UNEXPLAINED = "unexplained"
    ANOTHER_MINIMUM = "another minimum"
    ANOTHER_INSTRUMENT = "another instrument"
    ANOTHER_BASIS = "another basis"
    ANOTHER_UNIT = "another unit"
    DIVIDED = "divided"
    WITHOUT_CAUSE = "without cause"


class Reason(NamedTuple):
    """Reason of a verdict."""

    words: str = ""
    """One sentence; empty if there is nothing to refuse."""

    entries: tuple[str, ...] = ()
    """Entries of the instrument file that it advises."""

    named: tuple[str, ...] = ()
    """Alternatives that it names, by their ``words``."""

    undecided: str = ""
    """Advice on what to check where the matrix does not distinguish two alternatives."""


def judge_fit(findings: FitFindings) -> tuple[Refusal | None, Reason]:
    """Return the kind of a refusal, or None, and the reason of the verdict."""
    for refusal, reason in (
        (Refusal.AXES, Reason(findings.axes)),
        (Refusal.ANOTHER_PUPIL, Reason(_check_pupil(findings))),
        (Refusal.UNSETTLED, Reason(_check_convergence(findings))),
        (Refusal.UNDETERMINED, Reason(_check_determination(findings))),
        (Refusal.UNEXPLAINED, Reason(_check_explanation(findings))),
        (Refusal.ANOTHER_MINIMUM, Reason(_check_minimum(findings))),
        (Refusal.ANOTHER_INSTRUMENT, _check_instrument(findings)),
        (Refusal.ANOTHER_BASIS, _check_basis(findings)),
        (Refusal.ANOTHER_UNIT, _check_unit(findings)),
        (Refusal.DIVIDED, Reason(_check_agreement(findings))),
        (Refusal.WITHOUT_CAUSE, Reason(_check_cause(findings))),
    ):
        if reason.words:
            return refusal, reason
    return None, Reason(_describe_quality(findings))


def _describe_quality(findings: FitFindings) -> str:
    shares = f"residual {findings.residual_fraction:.1%} of the signal"
    if len(findings.uncertainty.subset_steps) < 2:
        return f"{shares}; too few modes to split into sets that check each other"
    tension = findings.uncertainty.subset_tension
    n_sets = len(findings.uncertainty.subset_steps)
    return f"{n_sets} sets of modes agree within {tension:.1f} sigma, {shares}"


def _check_convergence(findings: FitFindings) -> str:
    if findings.solution.converged:
        return ""
    noise = "" if findings.residual_fraction < MOST_OF_SIGNAL else "there is too much noise, "
    return (
        f"the fit did not converge: {noise}the modes (basis or order) or the instrument file do "
        "not match the matrix, or a start that was given (--start) is outside the capture range"
    )


def _check_determination(findings: FitFindings) -> str:
    sigma = np.sqrt(np.diag(findings.uncertainty.covariance))
    if np.all(sigma < LARGEST_SIGMA):
        return ""
    shown = sigma * BOUNDARY_SCALE
    return (
        f"the modes do not determine the registration (1 sigma: {shown[0]:.2g} and {shown[1]:.2g} "
        f"subaperture, {shown[2]:.2g} deg, {shown[3]:.2g}); measure more modes, or with less noise"
    )


def _check_explanation(findings: FitFindings) -> str:
    if findings.explained:
        return ""
    return (
        f"the model explains {1.0 - findings.residual_fraction**2:.0%} of the signal's power, and "
        f"what it leaves is not noise alone ({findings.structure:.0%} of the signal): a false "
        "minimum (start closer), or another basis or instrument than the file's"
    )


def _check_cause(findings: FitFindings) -> str:
    # Uneven light is a cause as well, although it is no correction of the instrument file.
    light = (one.misfit for one in findings.alternatives if one.key == LIGHT_KEY)
    share = min(light, default=1.0)
    left = findings.residual_fraction * float(np.sqrt(share * (1.0 - findings.noise_share)))
    if left < MAX_WITHOUT_CAUSE or any(one.preferred and one.key for one in findings.alternatives):
        return ""
    return (
        f"{findings.residual_fraction:.0%} of the signal is left over, at most "
        f"{findings.noise_share:.0%} of its power is noise, and no cause was found: the sensor, "
        "the mirror, the modes or the pupil are not those of the instrument file"
    )


def _check_minimum(findings: FitFindings) -> str:
    # Methods from one start have seen no other minimum.
    if findings.landing is None or not findings.landing.rivals:
        return ""
    rival = findings.landing.rivals[0].alpha.to_boundary()
    return (
        f"another minimum is nearly as good: shift {rival['shift_x_subap']:.2f}, "
        f"{rival['shift_y_subap']:.2f} subaperture, {rival['rotation_deg']:.1f} deg, "
        f"{rival['magnification']:.3f}; give a start near the right one (--start) or more modes"
    )


def _check_pupil(findings: FitFindings) -> str:
    if findings.narrow is None:
        return ""
    return (
        f"{findings.narrow.words}; write that into the instrument file (pupil_diameter_subap), or "
        "leave them out of the mask of valid subapertures"
    )


def _check_instrument(findings: FitFindings) -> Reason:
    for rival in findings.instruments:
        if _moves_registration(findings, rival.moved):
            return _describe_instrument(findings, rival)
    for optic in findings.optics:
        # any usual modulation is far from a stated 0
        usual = OPTIC_SIGMA[optic.optic] if optic.reported else UNKNOWN_SIGMA
        # the logarithm of a fitted modulation of 0 is meaningless
        if abs(optic.change) > MAX_OPTIC_DEVIATION * usual and optic.found != 0.0:
            return Reason(
                f"only {optic.found_words} would explain the matrix, {optic.file_words}: the "
                "mirror, the sensor or the modes are not those of the instrument file"
            )
    return Reason()


def _moves_registration(findings: FitFindings, moved: Array) -> bool:
    """Return True if an explanation changes the registration by more than σ and notably."""
    beyond_sigma = np.any(np.abs(moved) > MAX_DISPLACEMENT * findings.sigma_of_sets)
    return bool(beyond_sigma) and edge_move(moved, findings.radius_subap) > MIN_EDGE_MOVE_SUBAP


def edge_move(step: Array, radius_subap: float) -> float:
    """Return the displacement at the pupil's edge for a change of α ``(4,)``, subapertures."""
    return float(np.sqrt(np.max(step[:2] ** 2) + radius_subap**2 * np.sum(step[2:] ** 2)))


def _describe_instrument(findings: FitFindings, rival: Alternative) -> Reason:
    """Return the other instrument, or both if the matrix does not distinguish them."""
    better = "another instrument explains the matrix better:"
    of_rival = f"with {rival.words} the misfit is {rival.misfit:.0%} of what it is now"
    off = find_decentred_pupil(findings.alternatives)
    if off is None or off.misfit > EQUAL_MISFIT_RATIO * rival.misfit:
        return Reason(f"{better} {of_rival}; correct the instrument file", named=(rival.words,))
    if rival.misfit > EQUAL_MISFIT_RATIO * off.misfit:
        return Reason(
            f"{better} with {off.words} the misfit is {off.misfit:.0%} of what it is now; centre "
            "the pupil, or correct the mask of valid subapertures",
            named=(off.words,),
        )
    both = (
        f"{of_rival}, with {off.words} {off.misfit:.0%}: the matrix does not show which; check the "
        "pupil's position and correct the file"
    )
    return Reason(f"{better} {both}", named=(rival.words, off.words), undecided=both)


def _check_basis(findings: FitFindings) -> Reason:
    gains = findings.solution.projection.gains
    # Medians, because a few columns with other strokes do not make another basis.
    middle = float(np.median(gains))
    scatter = float(np.median(np.abs(gains - middle)) / abs(middle)) * 1.4826
    negative = int(np.sum(gains <= 0.0))
    # With unknown strokes gains may scatter freely, but their signs still belong to the basis.
    if negative == 0 and (scatter <= MAX_SCATTER or not findings.stroke_known):
        return Reason()
    if negative:
        return Reason(
            f"{negative} of {len(gains)} modes answer with the wrong sign: signs of single modes, "
            "or the basis, are another's"
        )
    entry = 'stroke = "unknown"'
    return Reason(
        f"the gains of the modes scatter by {scatter:.0%} about {middle:.3g}: the modes are scaled "
        f"another way or are another basis; say {entry} if only their shapes are known",
        (entry,),
    )


def _check_unit(findings: FitFindings) -> Reason:
    if not findings.stroke_known:
        return Reason()
    gains = findings.solution.projection.gains
    middle = float(np.median(gains))
    if not 1.0 / MAX_GAIN_RATIO < middle < MAX_GAIN_RATIO:
        return Reason(
            f"the measured slopes are {middle:.1e} times the model's: the matrix is in another "
            "unit than slope per metre of OPD (per nanometre would be 1e-09)"
        )
    factor = factor_of_passes(findings)
    # A pass is a factor common to all modes, so gains that scatter have another cause.
    if factor is None or float(np.std(gains) / middle) >= _PASS_TOLERANCE:
        return Reason()
    twice = factor > 1.0
    if (findings.passes, factor) == (2, 2.0):
        entry = 'modes_kind = "surface"'
        cause = (
            "the matrix is per metre of the mirror's surface, which is half the OPD: divide it by "
            f"two, or write {entry} where the modes were measured"
        )
    else:
        entry = f"double_pass = {str(twice).lower()}"
        cause = (
            f"the light met the mirror {'twice' if twice else 'once'}; set {entry}, or correct the "
            "unit (surface for OPD)"
        )
    return Reason(
        f"the measured slopes are {'twice' if twice else 'half'} the model's in every mode "
        f"({middle:.2f}): {cause}",
        (entry,),
    )


def factor_of_passes(findings: FitFindings) -> float | None:
    """Return 2 or 0.5 if the gains indicate a forgotten factor, else None.

    Half the slopes after one pass are no such case: residual turbulence reduces the gain by as
    much.
    """
    middle = float(np.median(findings.solution.projection.gains))
    if not findings.stroke_known:
        return None
    for factor in (2.0,) if findings.passes == 1 else (2.0, 0.5):
        if abs(middle / factor - 1.0) < _PASS_TOLERANCE:
            return factor
    return None


def _check_agreement(findings: FitFindings) -> str:
    tension, scatter = findings.uncertainty.subset_tension, findings.uncertainty.subset_scatter
    # With little noise the model's own error divides the sets by many σ and by thousandths of a
    # subaperture.
    if tension <= MAX_TENSION or edge_move(scatter, findings.radius_subap) < MIN_EDGE_MOVE_SUBAP:
        return ""
    scatter = scatter * BOUNDARY_SCALE
    return (
        f"sets of modes disagree by {tension:.1f} sigma (scatter {scatter[0]:.2g} and "
        f"{scatter[1]:.2g} subaperture, {scatter[2]:.2g} deg, {scatter[3]:.2g}): the stop, the "
        "modulation, the modes or the mask are not those of the instrument file"
    )
