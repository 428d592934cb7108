"""Recommend an action for a fit, in one sentence."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.alternatives import (
    CENTRED_KEY,
    describe_preference,
    format_move,
    systematic_terms,
)
from pyrcal.fitting.comparison import Alternative
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.left_over import locate_residual
from pyrcal.fitting.origins import Origin
from pyrcal.fitting.pupil_checks import MAP_WORDS, WITHOUT_ARMS
from pyrcal.fitting.verdict import Reason, Refusal, edge_move
from service.instrument.schema import AboutTable, MirrorTable, SlopesTable

Array = NDArray[np.float64]

ENOUGH_SUBAP = 0.03
"""Sufficient 1 σ of the mirror's position at the pupil's edge: 3 σ are then a tenth of a
subaperture, the accuracy that Heritier et al. 2018, section 3.2, require of a shift."""

MAX_USABLE_SUBAP = 0.1
"""Largest 1 σ at the pupil's edge of a registration that is recommended, even if the reconstructor
is stable with all modes."""

MIN_NOISE_SHARE = 0.5
"""Share of the residual's power that must be noise for averaging to be advised. With pokes of
0.2 µm the elements with a weak response have 6 % of the residual's mean power, with noise 100 %."""

FEWEST_SETS = 2
"""Sets of modes that can check each other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grounds:
    """Inputs of a recommendation, besides the fit's own numbers."""

    refusal: Refusal | None
    """Kind of the refusal; None if the fit was accepted."""

    reason: Reason

    structure: float
    """RMS share of the signal that is left over and is not noise."""

    n_sets: int
    """Number of disjoint sets of modes that were fitted separately."""

    columns: tuple[str, ...] = ()
    """Sentences on columns with wrong signs or in wrong places."""

    axes_entry: str = ""
    """Order and orientation of the slopes that explain the matrix better than those stated."""

    numbers_share: float = 1.0
    """χ² left with coupling and modulation as fitted, over that with those of the file."""

    gains: tuple[str, ...] = ()
    """Causes of gains that are far from 1."""

    noise_share: float = 1.0
    """Largest share of the residual's power that is noise, 0 to 1."""

    large_pokes: bool = False
    """True if another modulation than the file's explains part of what is left over, as of pokes
    beyond the linear range of a weakly modulated pyramid."""


class Advice(StrEnum):
    """Recommended action for a fit."""

    USE = "use it"
    MEASURE_MORE = "measure more"
    DO_NOT_USE = "do not use it"


_Action = tuple[str, tuple[str, ...]]
"""Recommended action in one sentence, and the entries of the instrument file that it changes."""

_BY_ANOTHER_INSTRUMENT = {Refusal.ANOTHER_INSTRUMENT, Refusal.UNSETTLED, Refusal.UNDETERMINED}
"""Reasons of a refusal that a wrong value of the instrument file also causes."""


def add_explanations(fit: Fit, grounds: Grounds) -> Fit:
    """Return the fit with preferred alternatives, residual analysis and recommendation."""
    preferred = (
        describe_preference(one, fit.sigma)
        for one in fit.alternatives
        # The verdict already names the alternative that led to a refusal.
        if one.preferred and one.words not in grounds.reason.named
    )
    sentences = (*fit.remarks, *grounds.gains, *preferred)
    size = np.linalg.norm(np.asarray(fit.measured, dtype=np.float64), axis=0)
    left = locate_residual(
        fit.residual_map, fit.residual_by_mode, valid=fit.valid, modes=fit.modes, size=size
    )
    fit = replace(fit, remarks=sentences, left_over=left)
    return add_recommendation(fit, grounds)


def add_displaced(fit: Fit, columns: tuple[str, ...]) -> Fit:
    """Return a refused fit whose cause is that all columns are displaced."""
    if not columns:
        return fit
    advised = f"{Advice.DO_NOT_USE}: {columns[0]}"
    remarks = (*fit.remarks, *columns)
    return replace(fit, remarks=remarks, recommendation=advised, corrections={})


def add_recommendation(fit: Fit, grounds: Grounds) -> Fit:
    """Return the fit with the recommended action, in one sentence and as values to be set."""
    words, entries = _choose_action(fit, grounds)
    return replace(fit, recommendation=words, corrections=read_entries(entries))


def read_entries(entries: Iterable[str]) -> Mapping[str, Any]:
    """Return the values that entries of the instrument file set, by table and key.

    None removes a key. The name of a map has words on how to turn it.
    """
    values: dict[str, Any] = {}
    for entry in entries:
        if entry == WITHOUT_ARMS:
            values |= {"spiders_m": None, "spiders_deg": None}
        elif entry.startswith(MAP_WORDS):
            values["pupil"] = entry.removeprefix(MAP_WORDS)
        elif entry != CENTRED_KEY:  # no key of a file moves a pupil
            values |= tomllib.loads(f"it = {{ {entry} }}")["it"]
    if isinstance(values.get("modulation_ellipse"), dict):
        values["modulation_lambda_over_d"] = None
    tables = {
        "instrument": {field.name for field in fields(AboutTable)},
        "mirror": {field.name for field in fields(MirrorTable)},
        "slopes": SlopesTable.model_fields,
    }
    place = {key: next((name for name in tables if key in tables[name]), "wfs") for key in values}
    return {f"{place[key]}.{key}": value for key, value in values.items()}


def _choose_action(fit: Fit, grounds: Grounds) -> _Action:
    if grounds.refusal is not None:
        return _advise_refused(fit, grounds)
    radius = _radius(fit)
    edge = edge_move(fit.sigma, radius)
    control = fit.reconstructor
    if control is not None and not control.usable:
        return f"{Advice.MEASURE_MORE}: the reconstructor is not stable: {control.reason}", ()
    # a reconstructor that is stable with all modes is good enough, unless sigma says nothing
    enough = MAX_USABLE_SUBAP if control is not None and control.holds else ENOUGH_SUBAP
    if edge > enough:
        best = _choose_correction(fit)
        words = _explain_uncertainty(fit, grounds, edge, radius)
        return f"{Advice.MEASURE_MORE}: {words}", () if best is None else (best.key,)
    if grounds.n_sets < FEWEST_SETS:
        return (
            f"{Advice.MEASURE_MORE}: too few modes ({len(fit.modes)}) to check each other; push "
            "six or more"
        ), ()
    if grounds.columns:
        return f"{Advice.USE} for the registration alone: {'; '.join(grounds.columns)}", ()
    known = f"the mirror is known to {edge:.2g} subapertures at the pupil's edge (1 sigma)"
    if control is not None and not control.holds:
        known = f"{known}; the reconstructor is {control.reason}"
    entries = tuple(_list_corrections(fit))
    if entries:
        listed = ", ".join(entries)
        return f"{Advice.USE}, and correct the instrument file ({listed}): {known}", entries
    return f"{Advice.USE}: {known}", ()


def _explain_uncertainty(fit: Fit, grounds: Grounds, edge: float, radius: float) -> str:
    """Return the uncertainty of the registration and how to reduce it."""
    known = (
        f"at the pupil's edge the mirror is known to {edge:.3f} subapertures (1 sigma), "
        f"{ENOUGH_SUBAP:g} is enough"
    )
    if grounds.columns:
        return f"{known}; {'; '.join(grounds.columns)}"
    found, best = fit.registration, _choose_correction(fit)
    if best is not None:
        return (
            f"{known}; with {best.words} the misfit is {best.share:.0%} of what it is: correct "
            "that and fit again"
        )
    # Averaging and more modes reduce the statistical part only.
    statistical = found is None or edge_move(found.sigma_statistical, radius) > 0.7 * edge
    if statistical and grounds.noise_share >= MIN_NOISE_SHARE:
        return f"{known}; average more, or push more modes"
    left = (
        f"{known}; {fit.residual_fraction:.1%} of the signal is left over and hardly any of it "
        "is noise, so that averaging does not help"
    )
    if grounds.large_pokes and grounds.noise_share < MIN_NOISE_SHARE:
        return (
            f"{left}: the sensor may be beyond its linear range; poke with a smaller stroke, "
            "and push and pull"
        )
    if statistical:
        return f"{left}: the model differs from the bench, and only more modes average that out"
    terms = systematic_terms(fit.alternatives, fit.residual_fraction, fit.sigma)
    most = max(terms, key=lambda term: edge_move(term[1], radius), default=None)
    if most is None or edge_move(most[1], radius) < 0.5 * edge:
        return f"{known}; the model differs from the bench, and more averaging does not help"
    other, _ = most
    return (
        f"{known}; the matrix does not exclude {other.words}, which would move the registration "
        f"by {format_move(other.moved)}"
    )


def _advise_refused(fit: Fit, grounds: Grounds) -> _Action:
    match grounds.refusal:
        # an explanation that the matrix prefers widens sigma: it is the cause then
        case Refusal.UNDETERMINED if _choose_correction(fit) is None:
            return f"{Advice.MEASURE_MORE}: the modes do not determine the registration", ()
        case Refusal.ANOTHER_MINIMUM:
            return (
                f"{Advice.MEASURE_MORE}: two registrations explain the matrix nearly as well; push "
                "more modes, or give a start near the true registration (--start)"
            ), ()
        # Mostly noise: averaging helps. If most of it is structure, averaging does not change it.
        case Refusal.UNEXPLAINED if grounds.structure < 0.5 * fit.residual_fraction:
            return (
                f"{Advice.MEASURE_MORE}: {fit.residual_fraction:.0%} of the signal is noise; "
                "average more, or push further"
            ), ()
    cause, entries = _find_cause(fit, grounds)
    return f"{Advice.DO_NOT_USE}: {cause}", entries


def _find_cause(fit: Fit, grounds: Grounds) -> _Action:
    """Return the most likely cause of a refusal; a definite cause precedes the verdict."""
    if grounds.refusal in {Refusal.ANOTHER_BASIS, Refusal.ANOTHER_UNIT} and grounds.gains:
        return grounds.gains[0], ()
    # Columns are compared with the model in the axes found, which are in doubt in that case.
    if grounds.columns and grounds.refusal is not Refusal.AXES:
        return "; ".join(grounds.columns), ()
    best = _choose_correction(fit)
    if best is not None and grounds.refusal in _BY_ANOTHER_INSTRUMENT:
        number = next(_list_wrong_numbers(fit), None)
        if number is not None and grounds.numbers_share < (best.share or 0.0):
            return f"{number.words}; correct that and fit again", (number.entry,)
        # The verdict names both explanations if the matrix does not distinguish them.
        if grounds.reason.undecided:
            return grounds.reason.undecided, ()
        return (
            f"with {best.words} the misfit is {best.share:.0%} of what it is; correct that and fit "
            "again"
        ), (best.key,)
    left = fit.left_over
    if grounds.refusal is Refusal.DIVIDED and left is not None and left.modes:
        return f"{left.words}; measure these again, or leave them out (--modes)", ()
    entries = (grounds.axes_entry,) if grounds.axes_entry else grounds.reason.entries
    return grounds.reason.words, entries


def _list_corrections(fit: Fit) -> Iterator[str]:
    """Yield corrections of the instrument file, in its own notation."""
    for one in fit.origins:
        if one.correct:
            yield one.entry
    best = _choose_correction(fit)
    if best is not None:
        yield best.key


def _list_wrong_numbers(fit: Fit) -> Iterator[Origin]:
    """Yield numbers of the file that the matrix contradicts.

    With a wrong modulation another stop explains part of the misfit that the fitted number leaves.
    What reduces the misfit by the larger factor is corrected first.
    """
    notable = {one.key for one in fit.optics if one.notable}
    return (one for one in fit.origins if one.correct and one.key in notable)


def _choose_correction(fit: Fit) -> Alternative | None:
    """Return the preferred alternative with a key that leaves the smallest misfit, or None."""
    found = [
        one
        for one in fit.alternatives
        if one.preferred and one.key and one.share is not None and one.share < 1.0
    ]
    return min(found, key=lambda one: one.share or 0.0, default=None)


def _radius(fit: Fit) -> float:
    """Return the radius of the pupil, in subapertures."""
    return float(np.sqrt(fit.valid.sum() / np.pi))
