"""Notes that accompany the verdict: overruled entries of the file, and unusual values."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pyrcal.fitting.alternatives import LIGHT_KEY
from pyrcal.fitting.comparison import Alternative
from pyrcal.fitting.instrument_checks import may_compensate
from pyrcal.fitting.models import Optic
from pyrcal.fitting.origins import MAX_LOG_SIGMA, is_determined
from pyrcal.fitting.verdict import NOTABLE_STRUCTURE, FitFindings, factor_of_passes
from service.model.instrument import Instrument
from service.model.kinds import SlopeOrder
from service.model.misregistration import BOUNDARY_SCALE
from service.model.slopes import FLIPS, SlopeRecipe

NOTABLE_MAGNIFICATION = 0.01
"""Distance of the magnification from 1 above which pitch or diameter may be wrong in the file."""

MAX_COMMON_SCATTER = 0.06
"""Largest relative scatter of gains that have a common offset."""

MIN_COMMON_OFFSET = 0.08
"""Smallest common offset of the gains that is reported."""

MAX_COMMON_RESIDUAL = 0.1
"""Largest residual share of the signal at which a common offset is reported."""

WAVELENGTH_RANGE = (0.3, 3.0)
"""Range of a wavelength's relative error that is reported."""


def collect_remarks(
    findings: FitFindings,
    *,
    reported: SlopeRecipe,
    found: SlopeRecipe,
    about: Instrument,
) -> tuple[str, ...]:
    """Return the notes on a fit, one sentence each; none if the result is mostly noise.

    Parameters
    ----------
    findings
        Findings of the fit.
    reported, found
        Slope recipes: as in the instrument file, and as the matrix shows.
    about
        Instrument as the file describes it.
    """
    if not findings.explained:
        return ()
    return (
        *_note_order(reported.order, found.order),
        *_note_mirrored(reported, found),
        *_note_optics(findings),
        *_note_light(findings),
        *_note_size(findings),
        *_note_passes(findings),
        *_note_scale(findings, about),
    )


def _note_order(reported: SlopeOrder, found: SlopeOrder) -> Iterator[str]:
    if reported is not found:
        yield (
            f'the instrument file says order = "{reported}", the matrix lists its slopes '
            f'"{found}": '
            f'taken as found; write order = "{found}" into [slopes]'
        )


def _note_mirrored(reported: SlopeRecipe, found: SlopeRecipe) -> Iterator[str]:
    """Yield a note if the sensor sees the nominal actuator geometry mirrored."""
    axes = found.assumed_orientation
    flags = [f"{name} = true" for name in FLIPS if getattr(axes, name)]
    # Each flip is a mirror image; two of them make a rotation, which is nothing to report.
    if reported.orientation is None and len(flags) % 2:
        yield (
            f"the slopes' grid is mirrored against the nominal actuator positions "
            f"({', '.join(flags)}): the detector is read from another corner, or the coordinates "
            "of the actuators are mirrored or exchanged (parity = -1); a matrix looks the same in "
            "both cases, and shift and rotation count in the axes found"
        )


def _note_optics(findings: FitFindings) -> Iterator[str]:
    """Yield coupling and modulation that differ from the file, or that it left unknown."""
    elliptic = Optic.STRETCH in findings.settled.models.optics
    for optic in findings.optics:
        if elliptic and optic.optic is Optic.SENSOR:
            continue  # the file has the two axes instead
        if optic.found is None or optic.reported is not None or optic.sigma > MAX_LOG_SIGMA:
            continue
        found = f"{optic.found_words} was found, 1 sigma {optic.found_sigma:.2g}"
        if is_determined(optic, findings.with_file_values, findings.structure):
            yield f"{found}: write it into the instrument file"
        else:
            yield (
                f"{found}; {findings.structure:.0%} of the signal is left over and is not noise, "
                'so it may compensate errors of the model: leave it "unknown", or measure it'
            )
    wrong = [optic for optic in findings.optics if optic.notable]
    if not wrong or findings.with_file_values is None:
        return
    found = " and ".join(f"{optic.found_words} ({optic.file_words})" for optic in wrong)
    there = findings.with_file_values
    moved = there.moved * BOUNDARY_SCALE
    yield (
        f"with {found} the misfit is {1.0 / there.misfit:.0%} of what it would be: the "
        f"registration allows for it, which moved it by {moved[0]:.2g}, {moved[1]:.2g} "
        f"subaperture, {moved[2]:.2g} deg, {moved[3]:.2g}; {_advice(there)}"
    )


def _advice(without: Alternative) -> str:
    """Return what to do about an instrument that was found unlike its file."""
    if not may_compensate(without):
        return "correct the instrument file"
    return (
        "large pokes, pushes without pulls or other errors of the model do the same, so sigma "
        "allows for both: do not change the file before these numbers are measured otherwise"
    )


def _note_light(findings: FitFindings) -> Iterator[str]:
    """Yield that uneven light explains the residual, unless a value of the file explains more."""
    # A gain over the pupil follows part of what another stop, hole or modulation does.
    shares = {
        one.key: one.misfit
        for one in findings.alternatives
        if one.preferred or one.key == LIGHT_KEY
    }
    if min(shares, key=lambda key: shares[key], default=LIGHT_KEY) != LIGHT_KEY:
        return
    # Not ``structure``: a gain over the pupil spreads what it leaves over all directions.
    left = findings.residual_fraction * float(np.sqrt(1.0 - findings.noise_share))
    if left > NOTABLE_STRUCTURE >= left * np.sqrt(shares.get(LIGHT_KEY, 1.0)):
        yield (
            f"{left:.0%} of the signal is left over and is not noise; a smooth gain "
            "over the pupil explains it: uneven light, which sigma allows for; give the light "
            "(--flux-map), or have the gain fitted (--gain-map)"
        )


def _note_size(findings: FitFindings) -> Iterator[str]:
    """Yield that the mirror is drawn in another size than the pupil."""
    magnification = float(findings.solution.vector[3])
    if abs(magnification - 1.0) > NOTABLE_MAGNIFICATION:
        yield (
            f"magnification {magnification:.3f}: a matrix determines only the mirror's size on "
            "the sensor, so pitch_m or positions (modes_pitch_m), diameter_m or "
            f"pupil_diameter_subap may be off by {abs(magnification - 1.0):.1%} instead"
        )


def _note_scale(findings: FitFindings, about: Instrument) -> Iterator[str]:
    """Yield that all gains are off together: the wavelength, or the unit."""
    gains = findings.solution.projection.gains
    middle = float(np.median(gains))
    wavelength_m = about.wfs.wavelength_m / middle
    if "wfs.wavelength_m" in about.unknown and about.mirror.stroke_known and middle > 0.0:
        yield (
            f"wavelength_m = {wavelength_m:.3g} was found, if the matrix is per metre of OPD on a "
            f"flat wavefront: gains of the modes scatter by {float(np.std(gains)) / middle:.1%}"
        )
    together = (
        float(np.std(gains)) < MAX_COMMON_SCATTER * abs(middle)
        and abs(middle - 1.0) > MIN_COMMON_OFFSET
    )
    explained = (
        findings.residual_fraction < MAX_COMMON_RESIDUAL
        and WAVELENGTH_RANGE[0] < middle < WAVELENGTH_RANGE[1]
    )
    if findings.stroke_known and explained and together and factor_of_passes(findings) is None:
        yield (
            f"the gain of every mode is {middle:.3g}: a wavelength of {wavelength_m:.3g} "
            "m instead of the file's would do that, or another unit of strokes; the registration "
            "does not depend on it"
        )


def _note_passes(findings: FitFindings) -> Iterator[str]:
    factor = factor_of_passes(findings)
    if factor is None:
        return
    passes = f"double_pass = {str(findings.passes == 2).lower()}"
    cause = {
        (1, 2.0): "double_pass = true if the light meets the mirror twice",
        (2, 2.0): 'per metre of surface? Then divide it by two, or write modes_kind = "surface"',
        (2, 0.5): "double_pass = false if the light meets the mirror once",
    }[findings.passes, factor]
    middle = float(np.median(findings.solution.projection.gains))
    yield (
        f"the gains' median is {middle:.2f} with {passes}: "
        f"{'twice' if factor > 1.0 else 'half'} what was expected; {cause}"
    )
