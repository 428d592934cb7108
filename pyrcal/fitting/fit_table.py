"""A fit as text: what to do, the registration, and what it rests on."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.alternatives import PLAUSIBLE_DISPLACEMENT_PX, format_move, systematic_terms
from pyrcal.fitting.budget import advise_measurement
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.methods import ScanStep
from pyrcal.fitting.report import FitReport, orientation_words
from service.errors import list_first, shown
from service.model.defects import list_ranges
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS

_ROWS = (
    ("shift x", "subapertures", 4),
    ("shift y", "subapertures", 4),
    ("rotation", "deg", 4),
    ("magnification", "ratio, image of the mirror over its nominal size", 5),
)
"""Name, unit and decimals of each parameter."""

_FAR_GAIN = 0.2
"""Relative distance of a gain from the median above which the mode is listed."""

_MAX_LISTED = 8

_MAX_TERMS = 3
"""Number of alternatives in the systematic part of σ that are listed."""


def table(report: FitReport) -> str:
    """Return recommendation, verdict, registration and supporting results as text."""
    fit = report.fit
    lines = [
        *([fit.recommendation] if fit.recommendation else []),
        fit.verdict_line,
        *_verdict_lines(fit),
        "",
        *_registration_lines(fit),
        "",
        *_basis_lines(report),
        *_extra_lines(fit),
        *(f"note: {note}" for note in report.notes if not _repeats_findings(note, fit)),
    ]
    return "\n".join(shown(line) for line in lines)


def _verdict_lines(fit: Fit) -> Iterator[str]:
    if fit.registration is not None:
        yield f"registration: {'' if fit.registration.determined else 'not '}determined"
    if fit.reconstructor is not None:
        yield f"reconstructor: {fit.reconstructor.reason}"


def _repeats_findings(note: str, fit: Fit) -> bool:
    """Return True if a note repeats the line of the quantities that were found."""
    keys = [one.key for one in fit.origins if one.correct]
    return any(
        f"{key}: unknown; " in note
        or (note.startswith(f"{key} = ") and " was found, 1 sigma" in note)
        for key in keys
    )


def _registration_lines(fit: Fit) -> Iterator[str]:
    found = fit.registration
    parts = () if found is None else (found.sigma_statistical, found.sigma_systematic)
    columns = ("value", "1 sigma", *(("statistical", "systematic") if parts else ()), "subsets")
    yield f"{'':15s}" + "".join(f"{name:>12s}" for name in columns)
    values = fit.alpha.vector * BOUNDARY_SCALE
    sigma = fit.sigma * BOUNDARY_SCALE
    scatter = fit.subset_scatter * BOUNDARY_SCALE
    listed = (values, sigma, *(part * BOUNDARY_SCALE for part in parts), scatter)
    for (name, unit, decimals), *row in zip(_ROWS, *listed, strict=True):
        numbers = "".join(_number(number, decimals) for number in row)
        yield f"{name:15s}{numbers}  {unit}"


def _anamorphosis(found: NDArray[np.float64], sigma: NDArray[np.float64]) -> str:
    (along, askew), (one, other) = 100.0 * found, 100.0 * sigma
    return f"{along:+.3f} +- {one:.3f} % along x, {askew:+.3f} +- {other:.3f} % along 45 deg"


def _number(value: float, decimals: int) -> str:
    # without the sign of a zero
    return f"{value:z12.{decimals}f}" if np.isfinite(value) else f"{'-':>12s}"


def _basis_lines(report: FitReport) -> Iterator[str]:
    fit = report.fit
    yield f"{'residual':20s}{100.0 * fit.residual_fraction:.2f} % of the measured slopes"
    yield from _residual_lines(fit)
    yield f"{'modes used':20s}{len(fit.modes)} ({list_ranges(fit.modes, _MAX_LISTED)})"
    for sentence in fit.left_out:
        yield f"{'left out':20s}{sentence}"
    yield f"{'gains':20s}{_format_gains(fit)}"
    yield f"{'condition number':20s}{fit.condition_number:.2f}"
    yield f"{'slopes':20s}{_format_slopes(fit)}"
    yield from _finding_lines(fit)
    yield from _alternative_lines(fit)
    yield f"{'double pass':20s}{'yes' if report.double_pass else 'no'}"
    yield f"{'method':20s}{report.method}, {fit.n_evaluations} matrices, {report.seconds:.1f} s"
    yield f"{'reference':20s}{report.reference}"
    yield f"{'instrument':20s}{report.instrument}"


def _residual_lines(fit: Fit) -> Iterator[str]:
    left = fit.left_over
    if left is None:
        return
    if left.border is not None and np.isfinite(left.border):
        yield f"{'':20s}{left.border:.1f} times as much at the pupil's border as inside"
    if left.words:
        yield f"{'':20s}{left.words}"
    for one in fit.causes:
        yield f"{'':20s}{one.share:.0%} of its power +- {one.sigma:.0%}: {one.words}"
    if fit.causes:
        yield f"{'measure next':20s}{advise_measurement(fit.causes)}"


def _finding_lines(fit: Fit) -> Iterator[str]:
    """Yield the quantities that the matrix determined, except the orientation."""
    words = [one.words for one in fit.origins if one.correct and one.key != "orientation"]
    if words:
        yield f"{'determined by fit':20s}{'; '.join(words)}"
    if fit.stroke is not None and any(one.key == "stroke" for one in fit.origins):
        yield f"{'stroke':20s}{fit.stroke.words}"
    if fit.unknown_not_found:
        keys = ", ".join(fit.unknown_not_found)
        yield f"{'unknown, not found':20s}{keys}: the matrix does not determine it"


def _alternative_lines(fit: Fit) -> Iterator[str]:
    """Yield the number of alternatives, the preferred ones, and the changes of α."""
    tried = fit.alternatives
    if not tried:
        return
    sigma = fit.sigma
    preferred = [one for one in tried if one.preferred]
    named = f"{len(preferred)} preferred: see notes" if preferred else "none preferred"
    yield f"{'alternatives':20s}{len(tried)} tried, {named}"
    open_ = [one for one in tried if one.undecided]
    weights = [one for one in tried if one.share is None]
    for one, _ in systematic_terms(tried, fit.residual_fraction, sigma)[:_MAX_TERMS]:
        yield f"{'  in systematic':20s}{one.words}: {format_move(one.moved)}"
    for words, group in (
        ("not excluded: would move alpha by up to", open_),
        ("other weights and modes: by up to", weights),
    ):
        if group:
            most = max(group, key=lambda one: float(np.max(np.abs(one.moved / sigma))))
            far = float(np.max(np.abs(most.moved / sigma)))
            yield f"{'':20s}{words} {far:.1f} sigma ({most.words})"


NOTABLE_DISPLACEMENT_PX = 0.03
"""Smallest reported displacement of a pupil image; exact matrices give smaller ones."""


NOTABLE_DISTORTION_SUBAP = 0.03
"""Smallest reported distortion of the mirror, RMS over the pupil, subapertures."""


def displacement_words(offsets_px: NDArray[np.float64]) -> str:
    """Return displacements of the pupil images ``(4, 2)`` as the instrument file states them."""
    places = ", ".join(f"[{x:.2f}, {y:.2f}]" for x, y in offsets_px)
    return f"image_offsets_px = [{places}]"


def _format_slopes(fit: Fit) -> str:
    """Return order and orientation as ``[slopes]`` of the instrument file has them."""
    words = orientation_words(fit.orientation, fit.order)
    order = words.pop("order")
    axes = ", ".join(f"{name} = {json.dumps(value)}" for name, value in words.items())
    return f'order = "{order}", orientation = {{ {axes} }}'


def _extra_lines(fit: Fit) -> Iterator[str]:
    listed = {one.key for one in fit.origins if one.correct}
    for one in fit.optics:
        if one.found is not None and one.key not in listed:
            stated = "unknown" if one.reported is None else f"{one.reported:g}"
            words = f"{one.found:.4g} +- {one.found_sigma:.2g}"
            yield f"{one.key + ' ':20s}{words} (the instrument file says {stated})"
    if fit.anamorphosis_sigma is not None:
        words = _anamorphosis(fit.alpha.stretches, fit.anamorphosis_sigma)
        caveat = "" if fit.anamorphosis is not None else "not observable with these modes: "
        yield f"{'anamorphosis':20s}{caveat}{words}"
    places = fit.image_offsets_px
    if places is not None and np.abs(places).max() > NOTABLE_DISPLACEMENT_PX:
        plausible = np.abs(places).max() < PLAUSIBLE_DISPLACEMENT_PX
        large = "larger than pyramids have: model errors, or a pupil off the middle of the grid"
        why = "the file does not say" if plausible else large
        yield f"{'pupil images':20s}{displacement_words(places)} (fitted; {why})"
    distortion = None if fit.registration is None else fit.registration.distortion
    if distortion is not None and distortion.rms_subap > NOTABLE_DISTORTION_SUBAP:
        yield (
            f"{'distortion':20s}a mirror distorted by {distortion.rms_subap:.2f} subapertures RMS "
            f"would leave {distortion.share:.1%} of the misfit (not fitted; differences of sets "
            "allow for it)"
        )
    if fit.gain_map is not None:
        gains = fit.gain_map[fit.valid]
        yield f"{'gain over the pupil':20s}{gains.min():.2f} to {gains.max():.2f}"
    if fit.paper_table is not None:
        yield ""
        yield from paper_lines(fit.paper_table)


def paper_lines(steps: tuple[ScanStep, ...]) -> Iterator[str]:
    """Yield the paper's Table 1: parameter, range and step of each scan, and the value found."""
    yield f"{'step':>4s}  {'parameter':15s}{'from':>11s}{'to':>11s}{'by':>9s}{'value':>11s}  unit"
    rows = dict(zip(PARAMETERS, _ROWS, strict=True))
    for number, scan in enumerate(steps, start=1):
        name, unit, _ = rows[scan.parameter]
        yield (
            f"{number:4d}  {name:15s}{scan.samples.min():11.4f}"
            f"{scan.samples.max():11.4f}{scan.step:9.4f}{scan.minimum:11.4f}  "
            f"{unit.partition(',')[0]}"
        )


def _format_gains(fit: Fit) -> str:
    low, middle, high = np.percentile(fit.gains, [5.0, 50.0, 95.0])
    text = f"median {middle:.3g}, 90 % of them within {low:.3g} to {high:.3g}"
    far = fit.modes[np.abs(fit.gains / middle - 1.0) > _FAR_GAIN]
    if len(far):
        text += f"; more than {100 * _FAR_GAIN:.0f} % off: mode {list_first(far, _MAX_LISTED)}"
    return text
