"""Alternative explanations of a matrix: other instruments, weights and sets of modes.

The registration is fitted again to first order under each alternative. This gives the change of the
registration, and by χ² whether the matrix prefers the alternative. Quantities that the fit left
free are fixed to the file's values, and quantities that it fixed are fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.disjoint_sets import SIGNIFICANT
from pyrcal.fitting.instrument_checks import (
    MIN_EXPLAINED,
    UNKNOWN_IMAGES,
    AlternativeInstrument,
    FileValuesFit,
    FoundOptic,
)
from pyrcal.fitting.methods import Settled
from pyrcal.fitting.models import FAR_PREFERRED_SHARE, PREFERRED_SHARE, Optic, moved_sensor_number
from pyrcal.fitting.pupil_checks import FitSubset, Lead, TriedPupil, gain_maps
from pyrcal.fitting.solver import refine
from pyrcal.fitting.uncertainty import OTHER_SHARE, Uncertainty
from service.model.kinds import SignalKind, Stop
from service.model.misregistration import BOUNDARY_SCALE
from service.model.sensors.registry import kind_of

Array = NDArray[np.float64]

NOTABLE_OFFSET_SUBAP = 0.05
"""Smallest pupil offset that is reported: the border of a pupil on a grid is not known better."""

NOTABLE_OFFSET_SHARE = 0.2
"""Smallest pupil offset that is reported, over the shift. If the mirror is the stop, on the
diffractive telescope a tenth of the shift looks like an offset."""

MIN_OFFSET_EXPLAINED = 0.01
"""RMS share of the signal that a pupil offset must explain to be preferred."""

EXCLUSION_SIGMA = 3.0
"""Number of σ by which an alternative must be worse to be excluded."""

EXCLUSION_RATIO = 10.0
"""χ² over that of the fit above which an alternative is excluded whatever its scatter. Misfit that
is concentrated in a few modes or at one side scatters as much as it grows: Gaussian influence
functions left 94 times the χ² of a matrix of HCIPy, and with 2.9 σ they made σ ten times wider."""

NOTABLE_GAIN_RATIO = 0.02
"""Smallest reported ratio of the gains of Sx and Sy, less 1."""

CENTRED_KEY = "pupil, or valid_subapertures, centred"
"""Keys of the instrument file to correct if the pupil is not centred."""

LIGHT_KEY = "--gain-map"
"""Option by which uneven light is fitted."""

ARM_SUBAP = 0.5
"""Width of the arms in the trial model, subapertures; the best width is extrapolated from it."""

PLAUSIBLE_DISPLACEMENT_PX = 0.5
"""Displacement of a pupil image that indicates another error of the model: real pyramids have up to
0.3 pixel, and images whose response the model explains to 70 % only were fitted 1.7 pixels off."""

MODULATION_STEP = 0.1
"""Relative change of the modulation for the alternative with another modulation."""

_MIN_MODES = 6
"""Smallest number of modes in a set that is fitted as an alternative."""

_WORST_SHARE = 0.1
"""Share of the modes, those with the largest residual, that one alternative leaves out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alternative:
    """Another explanation of the matrix, or another weighting of it."""

    words: str
    """Description of the change, in the notation of the instrument file if it has a key."""

    share: float | None
    """χ² that it leaves over that of the fit, to first order; None if weights or modes differ, so
    that the two are not comparable."""

    moved: Array
    """``(4,)`` change of the registration, numeric units."""

    preferred: bool = False
    """True if it explains the matrix better, by χ²."""

    undecided: bool = False
    """True if the matrix does not distinguish it from the fit."""

    key: str = ""
    """Entry for the instrument file, or option of the command; empty if there is none."""

    counts: bool = False
    """True if its change of α is an error of the registration until it is excluded; False for other
    weights and sets of modes."""

    is_number: bool = False
    """True if it is a number at its best-fitting value, for which the fit has another value."""

    def weight(self, residual_fraction: float) -> float:
        """Return the weight of the square of its change of α in σ, 0 to 1.

        An explanation that the matrix prefers counts in full, one that is not excluded by its
        probability, which is smaller the larger its misfit is. Models of one instrument differ by
        ``MIN_EXPLAINED`` of the signal, and any additional fitted number explains some of that by
        coincidence: smaller improvements are no evidence for it.
        """
        if not self.counts or not (self.preferred or self.undecided):
            return 0.0
        explained = residual_fraction
        if self.is_number and self.share is not None:
            explained *= float(np.sqrt(max(1.0 - self.share, 0.0)))
        worse = 1.0 if self.share is None else max(self.share, 1.0)
        probability = 1.0 if self.preferred else OTHER_SHARE / worse**2
        return probability * min(1.0, explained / MIN_EXPLAINED) ** 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SigmaTerm:
    """An alternative that counts in the systematic part of σ."""

    alternative: Alternative

    sigma: Array
    """``(4,)`` 1 σ that it adds, numeric units."""


def systematic_terms(
    tried: Sequence[Alternative], residual_fraction: float, sigma: Array
) -> tuple[SigmaTerm, ...]:
    """Return the alternatives that enter σ, the largest contribution first.

    Parameters
    ----------
    tried
        Every alternative.
    residual_fraction
        RMS of the residual over the RMS of the measurement.
    sigma
        ``(4,)`` 1 σ of the registration.
    """
    terms = [
        SigmaTerm(alternative=one, sigma=np.sqrt(weight) * np.abs(one.moved))
        for one in tried
        if (weight := one.weight(residual_fraction)) > 0.0
    ]
    return tuple(sorted(terms, key=lambda term: -float(np.max(term.sigma / sigma))))


def find_alternatives(
    settled: Settled,
    few: FitSubset,
    others: tuple[AlternativeInstrument, ...],
    pupils: tuple[TriedPupil, ...],
    optics: tuple[FoundOptic, ...],
    without: FileValuesFit | None,
    arms_deg: tuple[float, ...] = (),
) -> tuple[Alternative, ...]:
    """Return every alternative that was tried, preferred ones first.

    Parameters
    ----------
    settled, few
        The fit, and a subset of its modes on the coarse grid.
    others
        Other instruments, as tried for the verdict.
    pupils
        Other obscurations and diameters.
    optics, without
        Fitted optical quantities, and the fit with the file's values if they differ.
    arms_deg
        Directions of lines in the residual, degrees.
    """
    pupil_alternatives = (_describe_pupil(one, others) for one in pupils)
    found = [
        *(_describe_rival(one, pupils) for one in others),
        *(one for one in pupil_alternatives if one is not None),
        *_yield_determined(_try_off_centre(few)),
        *_yield_determined(_try_separate_gains(few)),
        *_yield_determined(_try_uneven_light(few)),
        *_yield_determined(_try_spiders(few, arms_deg)),
        *_yield_determined(_try_file_optics(settled, optics, without)),
        *_yield_determined(_try_fixed_nuisances(settled)),
        *_yield_determined(_try_images_in_place(settled)),
        *_yield_determined(_try_equal_weights(settled)),
        *_yield_determined(_try_mode_subsets(settled)),
        *_yield_determined(_try_without_border(few)),
    ]
    # A nearly singular alternative gives no finite step and would make σ infinite.
    sure = [one for one in found if np.all(np.isfinite(one.moved))]
    return tuple(sorted(sure, key=lambda one: (not one.preferred, not one.undecided, _share(one))))


def add_alternatives(
    before: Uncertainty,
    tried: Sequence[Alternative],
    residual_fraction: float,
    *,
    width: Array,
    without: FileValuesFit | None,
) -> Uncertainty:
    """Return the uncertainty including all alternatives that the data do not exclude.

    Parameters
    ----------
    before
        Uncertainty without alternatives.
    tried
        Every alternative.
    residual_fraction
        RMS of the residual over the RMS of the measurement.
    width
        ``(4,)`` change of α by a width of the influence functions that is not fitted.
    without
        Fit with the file's coupling and modulation; None if they equal the fitted ones.
    """
    # a fit with a residual below the model differences leaves no room for another explanation
    open_share = OTHER_SHARE * min(1.0, residual_fraction / MIN_EXPLAINED) ** 2
    moves = [width, *(one.moved for one in tried)]
    shares = [open_share, *(one.weight(residual_fraction) for one in tried)]
    # If the fitted values explain clearly more, the file's values are excluded and add nothing.
    if without is not None and without.is_undecided:
        moves.append(without.moved)
        shares.append(open_share)
    return before.with_moves(np.array(moves), np.array(shares))


def find_decentred_pupil(
    tried: Sequence[Alternative], others: tuple[AlternativeInstrument, ...]
) -> Alternative | None:
    """Return the preferred alternative with a decentred pupil, or None.

    It is only considered if another stop is preferred, because that displaces the pupil as well.
    """
    if not any(one.preferred and "stop" in one.change.words for one in others):
        return None
    return next((one for one in tried if one.preferred and one.key == CENTRED_KEY), None)


def _yield_determined(rivals: Iterator[Alternative]) -> Iterator[Alternative]:
    """Yield alternatives under which the measurement determines a registration."""
    try:
        yield from rivals
    except np.linalg.LinAlgError:
        return


def _share(one: Alternative) -> float:
    return float("inf") if one.share is None else one.share


def describe_preference(one: Alternative, sigma: Array) -> str:
    """Return a sentence that the matrix prefers an alternative, with the change of α."""
    move = np.abs(one.moved) / sigma
    share = "" if one.share is None else f" ({one.share:.0%} of the misfit)"
    return (
        f"the matrix is explained better with {one.words}{share}: the registration would move by "
        f"{format_move(one.moved)}, at most {np.max(move):.1f} sigma"
    )


def format_move(moved: Array) -> str:
    """Return a change of the registration in boundary units, as text."""
    x, y, turn, size = moved * BOUNDARY_SCALE
    return f"{x:+.2g}, {y:+.2g} subapertures, {turn:+.2g} deg, {size:+.2g}"


# --- other instruments


def _describe_rival(rival: AlternativeInstrument, pupils: tuple[TriedPupil, ...]) -> Alternative:
    return Alternative(
        words=rival.change.words,
        share=rival.share,
        moved=rival.moved,
        preferred=rival.preferred,
        undecided=not rival.preferred and is_open(rival.lead),
        key=rival.change.words,
        counts=True,
        is_number=rival.change.words in {UNKNOWN_IMAGES, *(one.words for one in pupils)},
    )


def _describe_pupil(
    one: TriedPupil, others: tuple[AlternativeInstrument, ...]
) -> Alternative | None:
    """Return an alternative with another pupil, or None if it is already in ``others``."""
    # Listed once, or its change of α would enter σ twice.
    if any(one.words == rival.change.words for rival in others):
        return None
    # Never preferred here: a pupil that explains enough is among the other instruments.
    return Alternative(
        words=one.words,
        share=one.lead.share,
        moved=one.moved,
        undecided=is_open(one.lead),
        key=one.words,
        counts=True,
        is_number=True,
    )


def is_open(lead: Lead) -> bool:
    """Return True if an alternative is not excluded: it is not significantly worse."""
    return lead.share < EXCLUSION_RATIO and lead.significance > -EXCLUSION_SIGMA


def _try_off_centre(few: FitSubset) -> Iterator[Alternative]:
    """Yield the alternative with the pupil image off the centre of the subapertures."""
    about, alpha = few.models.instrument, few.here
    if few.has_free_pupil:
        return  # the fit itself displaced the pupil
    rates = few.pupil_rates
    # Where the border cuts no subaperture, a displaced pupil changes no slope.
    if not all(few.tells(few.own, rate) for rate in rates):
        return
    (x, y), lead, moved = _fit_with_rates(few, *rates)
    explained = few.residual_fraction * float(np.sqrt(max(1.0 - lead.share, 0.0)))
    off = float(np.hypot(x, y))
    # With the mirror as stop the pupil moves with it, and part of that shift looks like an offset.
    shift = float(np.hypot(*alpha.vector[:2])) if about.stop is Stop.MIRROR else 0.0
    notable = max(NOTABLE_OFFSET_SUBAP, NOTABLE_OFFSET_SHARE * shift)
    middle = "mirror's" if about.stop is Stop.MIRROR else "sensor's"
    yield Alternative(
        words=f"the pupil {x:+.2f}, {y:+.2f} subapertures off the {middle} middle",
        share=lead.share,
        moved=moved,
        preferred=bool(
            lead.share < FAR_PREFERRED_SHARE
            and lead.significance > SIGNIFICANT
            and off > notable
            and explained > MIN_OFFSET_EXPLAINED
        ),
        undecided=is_open(lead),
        # With the mirror as stop the pupil is where the mirror is: nothing can be centred.
        key="" if about.stop is Stop.MIRROR else CENTRED_KEY,
        counts=True,
        is_number=True,
    )


def _try_separate_gains(few: FitSubset) -> Iterator[Alternative]:
    """Yield the alternative with separate gains of Sx and Sy."""
    # Pixels have no x and y components whose gains could differ.
    if few.models.instrument.slopes.kind is not SignalKind.XY:
        return
    half = len(few.own) // 2
    rate = np.concatenate([few.own[:half], -few.own[half:]])
    (value,), lead, moved = _fit_with_rates(few, rate)
    # The unknown raises Sx and lowers Sy by the same share, so the ratio has it twice.
    apart = float((1.0 + value) / (1.0 - value)) - 1.0
    side = "stronger" if apart > 0.0 else "weaker"
    yield Alternative(
        words=f"Sx {abs(apart):.1%} {side} than Sy",
        share=lead.share,
        moved=moved,
        preferred=bool(
            lead.share < PREFERRED_SHARE
            and lead.significance > SIGNIFICANT
            and abs(apart) > NOTABLE_GAIN_RATIO
        ),
        undecided=is_open(lead),
        counts=True,
        is_number=True,
    )


def _try_uneven_light(few: FitSubset) -> Iterator[Alternative]:
    """Yield the alternative with a smooth gain over the pupil, common to all modes."""
    maps = [pattern[:, None] * few.own for pattern in gain_maps(few)]
    _, lead, moved = _fit_with_rates(few, *maps)
    yield Alternative(
        words=f"uneven light ({LIGHT_KEY})",
        share=lead.share,
        moved=moved,
        undecided=is_open(lead),
        key=LIGHT_KEY,
        counts=True,
        is_number=True,
    )


def _try_spiders(few: FitSubset, arms_deg: tuple[float, ...]) -> Iterator[Alternative]:
    """Yield the alternative with spider arms, if the residual shows lines like arms."""
    about = few.models.instrument
    # A file with spiders or with a pupil map already contains the shadows.
    if not arms_deg or about.spiders_deg or about.pupil is not None:
        return
    width_m = ARM_SUBAP * about.subaperture_m
    shaded = few.matrix(few.of(replace(about, spiders_m=width_m, spiders_deg=arms_deg)))
    rate = shaded - few.own
    if not few.tells(few.own, rate):
        return
    (width,), lead, moved = _fit_with_rates(few, rate)
    if width <= 0.0:
        return  # a negative width means brighter lines, which are no shadows
    angles = ", ".join(f"{angle:.0f}" for angle in arms_deg)
    words = f"spiders_m = {width * width_m:.2g}, spiders_deg = [{angles}]"
    yield Alternative(
        words=words,
        share=lead.share,
        moved=moved,
        preferred=bool(lead.share < PREFERRED_SHARE and lead.significance > SIGNIFICANT),
        undecided=is_open(lead),
        key=words,
        counts=True,
        is_number=True,
    )


def _fit_with_rates(few: FitSubset, *rates: Array) -> tuple[Array, Lead, Array]:
    """Return the values of further unknowns, their improvement, and the change of α."""
    # Both steps are from the same grid, so that its error cancels in their difference.
    step = few.step(few.own, *rates)
    return step[-len(rates) :], few.lead(few.own, *rates), step[:4] - few.step(few.own)[:4]


def _ratio(chi: float, own: float) -> float:
    """Return χ² over that of the fit; 1 if the fit leaves no residual."""
    return chi / own if own > 0.0 else 1.0


# --- nuisances of the fit, fixed


def _try_file_optics(
    settled: Settled, optics: tuple[FoundOptic, ...], without: FileValuesFit | None
) -> Iterator[Alternative]:
    """Yield coupling and modulation as in the file, and a 10 % larger modulation."""
    # Values marked as unknown in the file cannot be restored, so only stated ones are named.
    stated = [one for one in optics if one.reported is not None]
    if without is not None:
        words = (
            " and ".join(f"{one.key} = {one.reported:.3g}" for one in stated)
            or "the values of the file"
        )
        yield Alternative(words=words, share=1.0 / max(without.share, 1e-12), moved=without.moved)
    first = settled.nuisances.first_optic
    for place, one in enumerate(optics, first):
        # The file's values were not fitted if none differs notably. To first order they are then
        # reached along the valley of χ², which takes no matrix.
        if without is None and one.reported is not None:
            share, moved = _fix_nuisances(settled, {place: -one.change})
            near = share < 1.0 / PREFERRED_SHARE
            words = f"{one.key} = {one.reported:.3g}, not fitted"
            yield Alternative(words=words, share=share, moved=moved, undecided=near)
        if one.optic is Optic.SENSOR and one.found is not None:
            share, moved = _fix_nuisances(settled, {place: float(np.log1p(MODULATION_STEP))})
            wider = moved_sensor_number(one.found, float(np.log1p(MODULATION_STEP)))
            words = f"{one.key} = {wider:.3g}"
            near = share < 1.0 / PREFERRED_SHARE
            yield Alternative(words=words, share=share, moved=moved, undecided=near)


def _try_fixed_nuisances(settled: Settled) -> Iterator[Alternative]:
    """Yield alternatives with nominal slope axes and without anamorphosis."""
    nuisances, values = settled.nuisances, settled.solution.nuisances
    distance = nuisances.from_prior(values)
    groups = [("the slopes' axes not turned", [0])]
    if nuisances.anamorphosis:
        # Both stretches together, because one alone depends on the direction of the axes.
        groups.append(("no anamorphosis fitted", [1, 2]))
    for words, places in groups:
        share, moved = _fix_nuisances(settled, {place: -float(distance[place]) for place in places})
        near = share < 1.0 / PREFERRED_SHARE
        yield Alternative(words=words, share=share, moved=moved, undecided=near)


def _try_images_in_place(settled: Settled) -> Iterator[Alternative]:
    """Yield pupil images that are not displaced, where the fit displaced them beyond belief.

    Such displacements make up for errors of the model, and there are several that do so about as
    well: on AO188 they reach 3 pixels, explain 3 % of the misfit and move a shift by 0.03
    subapertures.
    """
    nuisances, solution, about = settled.nuisances, settled.solution, settled.models.instrument
    if not len(nuisances.images):
        return
    found = kind_of(about).offsets_px(about, nuisances.image_offsets(solution.nuisances))
    if np.abs(found).max() < PLAUSIBLE_DISPLACEMENT_PX:
        return
    models = settled.models.with_displaced_images(np.zeros_like(nuisances.displaced))
    others = replace(
        nuisances, images=np.zeros((0, 8)), displaced=np.zeros_like(nuisances.displaced)
    )
    # A fit of its own: displacements that large are far outside the linear range.
    there = refine(models, settled.target, solution.alpha, others, decides=models.cheap)
    share = _ratio(there.projection.chi, solution.projection.chi)
    yield Alternative(
        words="the pupil images in their places",
        share=share,
        moved=there.vector - solution.vector,
        undecided=bool(there.converged and share < 1.0 / FAR_PREFERRED_SHARE),
        counts=True,
    )


def _fix_nuisances(settled: Settled, steps: dict[int, float]) -> tuple[float, Array]:
    """Return χ² over that of the fit, and the change of α, with nuisances fixed at offsets."""
    seen = settled.solution.projection
    noise = seen.chi / max(seen.residual.size - len(seen.gains), 1)
    normal = seen.normal
    held = normal + np.diag(settled.prior * noise)
    places = np.array([4 + place for place in steps])
    free = np.setdiff1d(np.arange(len(normal)), places)
    # the free unknowns follow the fixed ones along the valley of χ²
    step = np.zeros(len(normal))
    step[places] = list(steps.values())
    step[free] = -np.linalg.solve(
        held[np.ix_(free, free)], held[np.ix_(free, places)] @ step[places]
    )
    # Near the minimum χ² grows by the quadratic form. The prior shapes the step but is no misfit.
    return 1.0 + _ratio(float(step @ normal @ step), seen.chi), step[:4]


# --- other weights, modes and slopes


def _try_equal_weights(settled: Settled) -> Iterator[Alternative]:
    """Yield the alternative in which every slope has the same noise at the same stroke."""
    alike = np.full(len(settled.target.weights), np.mean(settled.target.weights))
    yield Alternative(
        words="every slope with the same weight",
        share=None,
        moved=_move_with_weights(settled, alike),
    )


def _try_mode_subsets(settled: Settled) -> Iterator[Alternative]:
    """Yield each half of the modes, and all modes but those with the largest residual."""
    n_modes = settled.target.n_modes
    # Halves by mode number, because columns may be in any order.
    order, numbers = np.argsort(settled.target.modes), np.arange(n_modes)
    worst = np.argsort(settled.by_mode)[: n_modes - int(np.ceil(_WORST_SHARE * n_modes))]
    for words, kept in (
        ("the lower half of the modes", order[: (n_modes + 1) // 2]),
        ("the upper half of the modes", order[n_modes // 2 :]),
        ("without the tenth of the modes that fits worst", worst),
    ):
        if len(kept) < _MIN_MODES:
            continue
        weights = np.where(np.isin(numbers, kept), settled.target.weights, 0.0)
        yield Alternative(words=words, share=None, moved=_move_with_weights(settled, weights))


def _move_with_weights(settled: Settled, weights: Array) -> Array:
    """Return the change of α with other weights of the modes ``(n_modes,)``."""
    seen, nuisances = settled.solution.projection, settled.nuisances
    noise = seen.chi / max(seen.residual.size - len(seen.gains), 1)
    prior = settled.prior * noise
    values = np.concatenate([np.zeros(4), nuisances.from_prior(settled.solution.nuisances)])

    def step(weights: Array) -> Array:
        ratio = weights / seen.weights
        held = np.tensordot(ratio, seen.normals, axes=1) + np.diag(prior)
        return np.linalg.solve(held, seen.scores @ ratio - prior * values)

    # the step with the fit's own weights is subtracted, because it is not exactly zero
    return np.asarray(step(weights) - step(seen.weights))[:4]


def _try_without_border(few: FitSubset) -> Iterator[Alternative]:
    """Yield the fit without the subapertures at the border of the pupil."""
    border = find_border(few.target.valid)
    rows = np.tile(border[few.target.valid], len(few.own) // int(few.target.valid.sum()))
    # On a coarse sensor most subapertures are at the border: too few would remain.
    if (few.target.rows & ~rows).sum() < len(rows) // 3:
        return
    inside = few.target.without(rows)
    moved = inside.project(few.own, few.derivatives).best_step - few.step(few.own)
    yield Alternative(words="without the border of the pupil", share=None, moved=moved[:4])


def find_border(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the valid subapertures ``(n, n)`` that have an invalid neighbour."""
    # Padded with False: subapertures at the edge of the grid are at the border.
    wide = np.pad(valid, 1)
    inside = wide[:-2, 1:-1] & wide[2:, 1:-1] & wide[1:-1, :-2] & wide[1:-1, 2:]
    return np.asarray(valid & ~inside)
