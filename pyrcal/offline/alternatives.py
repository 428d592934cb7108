"""What a rival explanation would change: other instruments, weights and sets of modes.

Each is allowed its own registration, to first order about the one found. It says how far the
registration would move, and by its χ² whether the matrix prefers it. What is fitted beside the
registration is held where the file has it; what is not is fitted as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.disjoint_sets import SIGNIFICANT
from pyrcal.offline.instrument_checks import MIN_EXPLAINED, FileValuesFit, FoundOptic, Rival
from pyrcal.offline.methods import Settled
from pyrcal.offline.models import BETTER, FAR_BETTER, Optic
from pyrcal.offline.pupil_checks import Few, Lead, TriedPupil, gain_maps
from pyrcal.offline.solver import refine
from pyrcal.offline.uncertainty import OTHER_SHARE, Uncertainty
from service.model.kinds import SignalKind, Stop
from service.model.misregistration import BOUNDARY_SCALE
from service.model.sensors.registry import kind_of

Array = NDArray[np.float64]

OFFSET_STEP_SUBAP = 0.05
"""Of a pupil off the centre of the subapertures, for the difference that stands for a rate."""

NOTABLE_OFFSET_SUBAP = 0.05
"""Less is not worth a word: the border of a pupil drawn on a grid is not better known."""

NOTABLE_OFFSET_SHARE = 0.2
"""... nor less than this share of a shift: where the mirror is the stop, on the diffractive
telescope, a tenth of the shift looks like an offset."""

LEAST_OFFSET = 0.01
"""RMS share of the signal that an offset of the pupil has to explain."""

EXCLUDED = 3.0
"""An explanation is excluded where it is worse by this many σ of the difference."""

NOTABLE_AXES = 0.02
"""Of the gain of Sx over that of Sy, less 1."""

ARM_SUBAP = 0.5
"""Width of the arms that are tried, subapertures; that which explains most is found from it."""

PLAUSIBLE_DISPLACEMENT_PX = 0.5
"""Displacement of a pupil image beyond which it stands for something else: real pyramids have up to
0.3 pixel, and images whose response the model explains to 70 % only were fitted 1.7 pixels off."""

MODULATION_STEP = 0.1
"""Share by which a modulation is taken for another, to see what it moves."""

_FEWEST = 6
"""Modes below which a set tells nothing by itself."""

_WORST = 0.1
"""Share of the modes that fit worst, left out to see what they move."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alternative:
    """Another explanation of the matrix, or another way to weigh it."""

    words: str
    """What would be another, as the instrument file says it where it has a key."""

    share: float | None
    """χ² that it leaves over what the fit leaves, to first order; None: weights or modes are
    others, and the two cannot be compared."""

    moved: Array
    """``(4,)`` by how much the registration would be another, numeric units."""

    preferred: bool = False
    """Whether the matrix is explained better by it, as far as χ² tells."""

    undecided: bool = False
    """Whether the matrix cannot tell the two apart."""

    key: str = ""
    """What to write into the instrument file, or the option that tries it; empty: it has none."""

    counts: bool = False
    """Whether it is another explanation, whose move is an error of the registration until it is
    excluded; other weights and sets of modes are none."""

    is_number: bool = False
    """Whether it is a number at the value that explains most, of which the fit has another."""

    def weight(self, residual_fraction: float) -> float:
        """Return the weight of the square of its move in σ, 0 to 1.

        An explanation that the matrix prefers counts in full, one that is not excluded by its
        probability. Models of one instrument differ by ``MIN_EXPLAINED`` of the signal, and any
        number fitted besides explains some of that by chance: less is no evidence for it.
        """
        if not self.counts or not (self.preferred or self.undecided):
            return 0.0
        explained = residual_fraction
        if self.is_number and self.share is not None:
            explained *= float(np.sqrt(max(1.0 - self.share, 0.0)))
        probability = 1.0 if self.preferred else OTHER_SHARE
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
    """Return the alternatives that count in σ, the one that adds most first.

    Parameters
    ----------
    tried
        Every alternative.
    residual_fraction
        RMS of what the fit leaves over the RMS of the measurement.
    sigma
        ``(4,)`` 1 σ of the registration.
    """
    terms = [
        SigmaTerm(alternative=one, sigma=np.sqrt(weight) * np.abs(one.moved))
        for one in tried
        if (weight := one.weight(residual_fraction)) > 0.0
    ]
    return tuple(sorted(terms, key=lambda term: -float(np.max(term.sigma / sigma))))


def alternatives(
    settled: Settled,
    few: Few,
    others: tuple[Rival, ...],
    pupils: tuple[TriedPupil, ...],
    optics: tuple[FoundOptic, ...],
    without: FileValuesFit | None,
    arms_deg: tuple[float, ...] = (),
) -> tuple[Alternative, ...]:
    """Return every alternative that was tried, those that the matrix prefers first.

    Parameters
    ----------
    settled, few
        The fit, and some of its modes on the cheap grid.
    others
        Other instruments that were tried for the verdict.
    pupils
        Other obscurations and diameters.
    optics, without
        What was fitted of the instrument, and the fit without where they differ.
    arms_deg
        Directions of lines in what is left over.
    """
    beside = (_of_pupil(one, others) for one in pupils)
    found = [
        *(_of_rival(one, pupils) for one in others),
        *(one for one in beside if one is not None),
        *_that_can(_off_centre(few)),
        *_that_can(_axes_apart(few)),
        *_that_can(_uneven_light(few)),
        *_that_can(_spiders(few, arms_deg)),
        *_that_can(_optics(settled, optics, without)),
        *_that_can(_held(settled)),
        *_that_can(_images_in_place(settled)),
        *_that_can(_wavelength(few)),
        *_that_can(_weighted(settled)),
        *_that_can(_some_modes(settled)),
        *_that_can(_without_border(few)),
    ]
    sure = [one for one in found if np.all(np.isfinite(one.moved))]
    return tuple(sorted(sure, key=lambda one: (not one.preferred, not one.undecided, _share(one))))


def with_alternatives(
    before: Uncertainty,
    tried: Sequence[Alternative],
    residual_fraction: float,
    *,
    width: Array,
    without: FileValuesFit | None,
) -> Uncertainty:
    """Return the uncertainty with the moves of all alternatives that the data do not exclude.

    Parameters
    ----------
    before
        Without them.
    tried
        Every alternative.
    residual_fraction
        RMS of what the fit leaves over the RMS of the measurement.
    width
        ``(4,)`` move by a width of the influence functions that cannot be fitted.
    without
        The fit with coupling and modulation as in the file; None where they are as fitted.
    """
    open_share = OTHER_SHARE * min(1.0, residual_fraction / MIN_EXPLAINED) ** 2
    moves = [width, *(one.moved for one in tried)]
    shares = [open_share, *(one.weight(residual_fraction) for one in tried)]
    if without is not None and without.is_undecided:
        moves.append(without.moved)
        shares.append(open_share)
    return before.with_moves(np.array(moves), np.array(shares))


def off_centre(few: Few, others: tuple[Rival, ...]) -> Alternative | None:
    """Return a pupil off the middle that the matrix prefers, if a rival moves the pupil as well."""
    if not any(one.preferred and "stop" in one.change.words for one in others):
        return None
    return next((one for one in _that_can(_off_centre(few)) if one.preferred), None)


def _that_can(rivals: Iterator[Alternative]) -> Iterator[Alternative]:
    """Yield rivals as far as what was measured determines a registration under them."""
    try:
        yield from rivals
    except np.linalg.LinAlgError:
        return


def _share(one: Alternative) -> float:
    return float("inf") if one.share is None else one.share


def preference(one: Alternative, sigma: Array) -> str:
    """Return in a sentence that the matrix prefers an alternative, and what it would move."""
    move = np.abs(one.moved) / sigma
    share = "" if one.share is None else f" ({one.share:.0%} of the misfit)"
    return (
        f"the matrix is explained better with {one.words}{share}: the registration would move by "
        f"{moved_words(one.moved)}, at most {np.max(move):.1f} sigma"
    )


def moved_words(moved: Array) -> str:
    """Return how far a registration moves, boundary units."""
    x, y, turn, size = moved * BOUNDARY_SCALE
    return f"{x:+.2g}, {y:+.2g} subapertures, {turn:+.2g} deg, {size:+.2g}"


# --- other instruments


def _of_rival(rival: Rival, pupils: tuple[TriedPupil, ...]) -> Alternative:
    return Alternative(
        words=rival.change.words,
        share=rival.share,
        moved=rival.moved,
        preferred=rival.preferred,
        undecided=not rival.preferred and is_open(rival.lead),
        key=rival.change.words,
        counts=True,
        is_number=any(one.words == rival.change.words for one in pupils),
    )


def _of_pupil(one: TriedPupil, others: tuple[Rival, ...]) -> Alternative | None:
    """Return another pupil, unless it is among the rivals already."""
    if any(one.words == rival.change.words for rival in others):
        return None
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
    """Return whether the data do not exclude an explanation: it is not significantly worse."""
    return lead.significance > -EXCLUDED


def _off_centre(few: Few) -> Iterator[Alternative]:
    """Yield that the pupil's image is not in the middle of the subapertures."""
    about, alpha = few.models.instrument, few.here
    here = np.array(about.pupil_shift_subap or (0.0, 0.0))
    if about.stop is Stop.MIRROR:
        here = alpha.vector[:2]
    rates = []
    for step in np.eye(2) * OFFSET_STEP_SUBAP:
        beside = replace(about, stop=Stop.TELESCOPE, pupil_shift_subap=tuple(here + step))
        rates.append((few.matrix(few.of(beside)) - few.own) / OFFSET_STEP_SUBAP)
    if not all(few.tells(few.own, rate) for rate in rates):
        return
    (x, y), lead, moved = _fitted_as_well(few, *rates)
    explained = few.residual_fraction * float(np.sqrt(max(1.0 - lead.share, 0.0)))
    off = float(np.hypot(x, y))
    shift = float(np.hypot(*alpha.vector[:2])) if about.stop is Stop.MIRROR else 0.0
    notable = max(NOTABLE_OFFSET_SUBAP, NOTABLE_OFFSET_SHARE * shift)
    middle = "mirror's" if about.stop is Stop.MIRROR else "sensor's"
    yield Alternative(
        words=f"the pupil {x:+.2f}, {y:+.2f} subapertures off the {middle} middle",
        share=lead.share,
        moved=moved,
        preferred=bool(
            lead.share < FAR_BETTER
            and lead.significance > SIGNIFICANT
            and off > notable
            and explained > LEAST_OFFSET
        ),
        undecided=is_open(lead),
        key="pupil, or valid_subapertures, centred",
        counts=True,
        is_number=True,
    )


def _axes_apart(few: Few) -> Iterator[Alternative]:
    """Yield that Sx and Sy have gains of their own."""
    if few.models.instrument.slopes.kind is not SignalKind.XY:
        return
    half = len(few.own) // 2
    rate = np.concatenate([few.own[:half], -few.own[half:]])
    (value,), lead, moved = _fitted_as_well(few, rate)
    apart = float((1.0 + value) / (1.0 - value)) - 1.0
    side = "stronger" if apart > 0.0 else "weaker"
    yield Alternative(
        words=f"Sx {abs(apart):.1%} {side} than Sy",
        share=lead.share,
        moved=moved,
        preferred=bool(
            lead.share < BETTER and lead.significance > SIGNIFICANT and abs(apart) > NOTABLE_AXES
        ),
        undecided=is_open(lead),
        counts=True,
        is_number=True,
    )


def _uneven_light(few: Few) -> Iterator[Alternative]:
    """Yield that a smooth gain over the pupil is common to all modes."""
    maps = [pattern[:, None] * few.own for pattern in gain_maps(few)]
    _, lead, moved = _fitted_as_well(few, *maps)
    yield Alternative(
        words="uneven light (--gain-map)",
        share=lead.share,
        moved=moved,
        undecided=is_open(lead),
        key="--gain-map",
        counts=True,
        is_number=True,
    )


def _spiders(few: Few, arms_deg: tuple[float, ...]) -> Iterator[Alternative]:
    """Yield arms of a spider where lines in what is left over look like them."""
    about = few.models.instrument
    if not arms_deg or about.spiders_deg or about.pupil is not None:
        return
    width_m = ARM_SUBAP * about.subaperture_m
    shaded = few.matrix(few.of(replace(about, spiders_m=width_m, spiders_deg=arms_deg)))
    rate = shaded - few.own
    if not few.tells(few.own, rate):
        return
    (width,), lead, moved = _fitted_as_well(few, rate)
    if width <= 0.0:
        return  # brighter, not darker: no shadow
    angles = ", ".join(f"{angle:.0f}" for angle in arms_deg)
    words = f"spiders_m = {width * width_m:.2g}, spiders_deg = [{angles}]"
    yield Alternative(
        words=words,
        share=lead.share,
        moved=moved,
        preferred=bool(lead.share < BETTER and lead.significance > SIGNIFICANT),
        undecided=is_open(lead),
        key=words,
        counts=True,
        is_number=True,
    )


def _wavelength(few: Few) -> Iterator[Alternative]:
    """Yield a tenth more of the wavelength: the modulation, in λ/D, stays."""
    about = few.models.instrument
    wfs = replace(about.wfs, wavelength_m=1.1 * about.wfs.wavelength_m)
    matrix = few.matrix(few.of(replace(about, wfs=wfs)))
    matrix *= np.linalg.norm(few.own) / np.linalg.norm(matrix)  # the gains take that up
    seen = few.seen(matrix)
    yield Alternative(
        words=f"wavelength_m = {wfs.wavelength_m:.3g}",
        share=_ratio(seen.chi_at_best, few.left(few.own)),
        moved=seen.best_step[:4] - few.step(few.own)[:4],
        undecided=True,
    )


def _fitted_as_well(few: Few, *rates: Array) -> tuple[Array, Lead, Array]:
    """Return the values of more unknowns, their lead over the fit without, and α's move."""
    step = few.step(few.own, *rates)
    return step[-len(rates) :], few.lead(few.own, *rates), step[:4] - few.step(few.own)[:4]


def _ratio(chi: float, own: float) -> float:
    """Return χ² over the fit's; 1 where that leaves nothing."""
    return chi / own if own > 0.0 else 1.0


# --- what is fitted beside the registration, held


def _optics(
    settled: Settled, optics: tuple[FoundOptic, ...], without: FileValuesFit | None
) -> Iterator[Alternative]:
    """Yield coupling and modulation as the file says, and a modulation that is another."""
    stated = [one for one in optics if one.reported is not None]
    if without is not None:
        words = " and ".join(f"{one.key} = {one.reported:.3g}" for one in stated) or "as told"
        yield Alternative(words=words, share=1.0 / max(without.share, 1e-12), moved=without.moved)
    first = settled.nuisances.first_optic
    for place, one in enumerate(optics, first):
        if without is None and one.reported is not None:
            share, moved = _with(settled, {place: -one.change})
            near = share < 1.0 / BETTER
            words = f"{one.key} = {one.reported:.3g}, not fitted"
            yield Alternative(words=words, share=share, moved=moved, undecided=near)
        if one.optic is Optic.SENSOR and one.found is not None:
            share, moved = _with(settled, {place: float(np.log1p(MODULATION_STEP))})
            words = f"{one.key} = {one.found * (1.0 + MODULATION_STEP):.3g}"
            near = share < 1.0 / BETTER
            yield Alternative(words=words, share=share, moved=moved, undecided=near)


def _held(settled: Settled) -> Iterator[Alternative]:
    """Yield the slopes' axes as they are told, and an image that is not stretched."""
    nuisances, values = settled.nuisances, settled.solution.nuisances
    distance = nuisances.from_prior(values)
    groups = [("the slopes' axes not turned", [0])]
    if nuisances.anamorphosis:
        groups.append(("no anamorphosis fitted", [1, 2]))
    for words, places in groups:
        share, moved = _with(settled, {place: -float(distance[place]) for place in places})
        near = share < 1.0 / BETTER
        yield Alternative(words=words, share=share, moved=moved, undecided=near)


def _images_in_place(settled: Settled) -> Iterator[Alternative]:
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
    models = settled.models.displaced(-nuisances.displaced)
    others = replace(nuisances, images=np.zeros((0, 8)), displaced=np.zeros(8))
    there = refine(models, settled.target, solution.alpha, others, decides=models.cheap)
    share = _ratio(there.projection.chi, solution.projection.chi)
    yield Alternative(
        words="the pupil images in their places",
        share=share,
        moved=there.vector - solution.vector,
        undecided=bool(there.converged and share < 1.0 / FAR_BETTER),
        counts=True,
    )


def _with(settled: Settled, steps: dict[int, float]) -> tuple[float, Array]:
    """Return χ² over the fit's, and α's move, where nuisances are held so far from theirs."""
    seen = settled.solution.projection
    noise = seen.chi / max(seen.residual.size - len(seen.gains), 1)
    normal = seen.normal
    held = normal + np.diag(settled.prior * noise)
    places = np.array([4 + place for place in steps])
    free = np.setdiff1d(np.arange(len(normal)), places)
    step = np.zeros(len(normal))
    step[places] = list(steps.values())
    step[free] = -np.linalg.solve(
        held[np.ix_(free, free)], held[np.ix_(free, places)] @ step[places]
    )
    return 1.0 + _ratio(float(step @ normal @ step), seen.chi), step[:4]


# --- other weights, modes and slopes


def _weighted(settled: Settled) -> Iterator[Alternative]:
    """Yield modes weighed as if every slope had the same noise at the same stroke."""
    alike = np.full(len(settled.target.weights), np.mean(settled.target.weights))
    yield Alternative(
        words="every slope with the same weight", share=None, moved=_stepped(settled, alike)
    )


def _some_modes(settled: Settled) -> Iterator[Alternative]:
    """Yield halves of the modes, and all but those that fit worst."""
    n_modes = settled.target.n_modes
    order, numbers = np.argsort(settled.target.modes), np.arange(n_modes)
    worst = np.argsort(settled.by_mode)[: n_modes - int(np.ceil(_WORST * n_modes))]
    for words, kept in (
        ("the lower half of the modes", order[: (n_modes + 1) // 2]),
        ("the upper half of the modes", order[n_modes // 2 :]),
        ("without the tenth of the modes that fits worst", worst),
    ):
        if len(kept) < _FEWEST:
            continue
        weights = np.where(np.isin(numbers, kept), settled.target.weights, 0.0)
        yield Alternative(words=words, share=None, moved=_stepped(settled, weights))


def _stepped(settled: Settled, weights: Array) -> Array:
    """Return how far other weights of the modes ``(n_modes,)`` move α."""
    seen, nuisances = settled.solution.projection, settled.nuisances
    noise = seen.chi / max(seen.residual.size - len(seen.gains), 1)
    prior = settled.prior * noise
    values = np.concatenate([np.zeros(4), nuisances.from_prior(settled.solution.nuisances)])

    def step(weights: Array) -> Array:
        other = replace(seen, weights=weights)
        held = other.normal + np.diag(prior)
        return np.linalg.solve(held, other.scores.sum(axis=1) - prior * values)

    return np.asarray(step(weights) - step(seen.weights))[:4]


def _without_border(few: Few) -> Iterator[Alternative]:
    """Yield the fit without the subapertures at the border of the pupil."""
    border = border_of(few.target.valid)
    rows = np.tile(border[few.target.valid], len(few.own) // int(few.target.valid.sum()))
    if (few.target.rows & ~rows).sum() < len(rows) // 3:
        return
    inside = few.target.without(rows)
    moved = inside.project(few.own, few.derivatives).best_step - few.step(few.own)
    yield Alternative(words="without the border of the pupil", share=None, moved=moved[:4])


def border_of(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which valid subapertures ``(n, n)`` have a neighbour that is none."""
    wide = np.pad(valid, 1)
    inside = wide[:-2, 1:-1] & wide[2:, 1:-1] & wide[1:-1, :-2] & wide[1:-1, 2:]
    return np.asarray(valid & ~inside)
