"""Alternative explanations of a matrix: other instruments, weights and sets of modes.

The registration is fitted again to first order under each alternative. This gives the change of the
registration, and by χ² whether the matrix prefers the alternative. Quantities that the fit left
free are fixed to the file's values, and quantities that it fixed are fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.comparison import MIN_EXPLAINED, OTHER_SHARE, Alternative, FitSubset
from pyrcal.fitting.instrument_checks import (
    FoundOptic,
    may_compensate,
    try_aberration,
    try_ellipse,
    try_free_images,
    try_instruments,
    try_rooftop,
)
from pyrcal.fitting.left_over import find_arms, find_border
from pyrcal.fitting.methods import Settled
from pyrcal.fitting.models import FAR_PREFERRED_SHARE, PREFERRED_SHARE, Optic, moved_sensor_number
from pyrcal.fitting.pupil_checks import try_pupils
from pyrcal.fitting.solver import refine
from pyrcal.fitting.uncertainty import Uncertainty
from service.model.kinds import SignalKind, Stop
from service.model.misregistration import BOUNDARY_SCALE
from service.model.sensors.registry import kind_of

Array = NDArray[np.float64]

NOTABLE_OFFSET_SUBAP = 0.05
"""Smallest pupil offset that is reported: the border of a pupil on a grid is not known better."""

NOTABLE_OFFSET_SHARE = 0.2
"""Smallest pupil offset that is reported, over the shift. If the mirror is the stop, on the
diffractive telescope a tenth of the shift looks like an offset."""

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


def find_alternatives(
    few: FitSubset, optics: Sequence[FoundOptic], without: Alternative | None
) -> tuple[Alternative, ...]:
    """Return every alternative that was tried, preferred ones first.

    Parameters
    ----------
    few
        A subset of the fit's modes on the coarse grid.
    optics, without
        Fitted optical quantities, and the fit with the file's values if they differ.
    """
    found = [one for trial in TRIALS for one in _yield_determined(trial(few))]
    found += _yield_determined(_try_file_optics(few.settled, optics, without))
    # A nearly singular alternative gives no finite step and would make σ infinite.
    sure = [one for one in found if np.all(np.isfinite(one.moved))]
    return tuple(sorted(sure, key=lambda one: (not one.preferred, not one.undecided, one.misfit)))


def systematic_terms(
    tried: Sequence[Alternative], residual_fraction: float, sigma: Array
) -> list[tuple[Alternative, Array]]:
    """Return the alternatives that enter σ and what each adds, the largest contribution first.

    Parameters
    ----------
    tried
        Every alternative.
    residual_fraction
        RMS of the residual over the RMS of the measurement.
    sigma
        ``(4,)`` 1 σ of the registration.

    Returns
    -------
    Each alternative with the ``(4,)`` 1 σ that it adds, numeric units.
    """
    terms = [
        (one, np.sqrt(weight) * np.abs(one.moved))
        for one in tried
        if (weight := one.weight(residual_fraction)) > 0.0
    ]
    return sorted(terms, key=lambda term: -float(np.max(term[1] / sigma)))


def add_alternatives(
    before: Uncertainty,
    tried: Sequence[Alternative],
    residual_fraction: float,
    *,
    width: Array,
    without: Alternative | None,
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
    if without is not None and may_compensate(without):
        moves.append(without.moved)
        shares.append(open_share)
    return before.with_moves(np.array(moves), np.array(shares))


def find_decentred_pupil(tried: Sequence[Alternative]) -> Alternative | None:
    """Return the preferred alternative with a decentred pupil, or None.

    It is only considered if another stop is preferred, because that displaces the pupil as well.
    """
    preferred = {one.key: one for one in tried if one.preferred}
    return preferred.get(CENTRED_KEY) if any(key.startswith("stop") for key in preferred) else None


def _yield_determined(rivals: Iterator[Alternative]) -> Iterator[Alternative]:
    """Yield alternatives under which the measurement determines a registration."""
    try:
        yield from rivals
    except np.linalg.LinAlgError:
        return


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


# --- other numbers of the instrument


def _try_off_centre(few: FitSubset) -> Iterator[Alternative]:
    """Yield the alternative with the pupil image off the centre of the subapertures."""
    about, alpha = few.models.instrument, few.here
    if few.has_free_pupil:
        return  # the fit itself displaced the pupil
    rates = few.pupil_rates
    # Where the border cuts no subaperture, a displaced pupil changes no slope.
    if not all(few.depends_on(few.own, rate) for rate in rates):
        return
    found = few.compare(few.own, *rates)
    x, y = few.step(few.own, *rates)[-2:]
    # With the mirror as stop the pupil moves with it, and part of that shift looks like an offset.
    is_mirror = about.stop is Stop.MIRROR
    shift = float(np.hypot(*alpha.vector[:2])) if is_mirror else 0.0
    words = f"the pupil {x:+.2f}, {y:+.2f} subapertures off the"
    yield few.judge(
        found,
        f"{words} {'mirror' if is_mirror else 'sensor'}'s middle",
        FAR_PREFERRED_SHARE,
        # With the mirror as stop the pupil is where the mirror is: nothing can be centred.
        key="" if is_mirror else CENTRED_KEY,
        notable=np.hypot(x, y) > max(NOTABLE_OFFSET_SUBAP, NOTABLE_OFFSET_SHARE * shift),
        min_explained=MIN_EXPLAINED,
        is_number=True,
    )


def _try_separate_gains(few: FitSubset) -> Iterator[Alternative]:
    """Yield the alternative with separate gains of Sx and Sy."""
    # Pixels have no x and y components whose gains could differ.
    if few.models.instrument.slopes.kind is not SignalKind.XY:
        return
    half = len(few.own) // 2
    rate = np.concatenate([few.own[:half], -few.own[half:]])
    value = few.step(few.own, rate)[-1]
    # The unknown raises Sx and lowers Sy by the same share, so the ratio has it twice.
    apart = float((1.0 + value) / (1.0 - value)) - 1.0
    side = "stronger" if apart > 0.0 else "weaker"
    yield few.judge(
        few.compare(few.own, rate),
        f"Sx {abs(apart):.1%} {side} than Sy",
        PREFERRED_SHARE,
        notable=abs(apart) > NOTABLE_GAIN_RATIO,
        is_number=True,
    )


def _try_uneven_light(few: FitSubset) -> Iterator[Alternative]:
    """Yield the alternative with a smooth gain over the pupil, common to all modes."""
    words = f"uneven light ({LIGHT_KEY})"
    yield few.judge(few.uneven_light, words, key=LIGHT_KEY, is_number=True)


def _try_spiders(few: FitSubset) -> Iterator[Alternative]:
    """Yield the alternative with spider arms, if the residual shows lines like arms."""
    about = few.models.instrument
    # A file with spiders or with a pupil map already contains the shadows.
    if about.spiders_deg or about.pupil is not None:
        return
    arms_deg = tuple(arm.angle_deg for arm in find_arms(few.settled.residual_map))
    if not arms_deg:
        return
    width_m = ARM_SUBAP * about.subaperture_m
    rate = few.matrix_of(replace(about, spiders_m=width_m, spiders_deg=arms_deg)) - few.own
    if not few.depends_on(few.own, rate):
        return
    width = few.step(few.own, rate)[-1]
    if width <= 0.0:
        return  # a negative width means brighter lines, which are no shadows
    angles = ", ".join(f"{angle:.0f}" for angle in arms_deg)
    words = f"spiders_m = {width * width_m:.2g}, spiders_deg = [{angles}]"
    found = few.compare(few.own, rate)
    yield few.judge(found, words, PREFERRED_SHARE, key=words, is_number=True)


# --- nuisances of the fit, fixed


def _try_file_optics(
    settled: Settled, optics: Sequence[FoundOptic], without: Alternative | None
) -> Iterator[Alternative]:
    """Yield coupling and modulation as in the file, and a 10 % larger modulation."""
    if without is not None:
        yield without
    for place, one in enumerate(optics, settled.nuisances.first_optic):
        # The file's values were not fitted if none differs notably. To first order they are then
        # reached along the valley of χ², which takes no matrix.
        if without is None and one.reported is not None:
            words = f"{one.key} = {one.reported:.3g}, not fitted"
            yield _fix_nuisances(settled, words, {place: -one.change})
        if one.optic is Optic.SENSOR and one.found is not None:
            step = float(np.log1p(MODULATION_STEP))
            words = f"{one.key} = {moved_sensor_number(one.found, step):.3g}"
            yield _fix_nuisances(settled, words, {place: step})


def _try_fixed_nuisances(few: FitSubset) -> Iterator[Alternative]:
    """Yield alternatives with nominal slope axes and without anamorphosis."""
    nuisances, settled = few.settled.nuisances, few.settled
    distance = nuisances.from_prior(settled.solution.nuisances)
    yield _fix_nuisances(settled, "the slopes' axes not turned", {0: -float(distance[0])})
    if nuisances.anamorphosis:
        # Both stretches together, because one alone depends on the direction of the axes.
        steps = {place: -float(distance[place]) for place in (1, 2)}
        yield _fix_nuisances(settled, "no anamorphosis fitted", steps)


def _try_images_in_place(few: FitSubset) -> Iterator[Alternative]:
    """Yield pupil images that are not displaced, where the fit displaced them beyond belief.

    Such displacements make up for errors of the model, and there are several that do so about as
    well: on AO188 they reach 3 pixels, explain 3 % of the misfit and move a shift by 0.03
    subapertures.
    """
    settled = few.settled
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


def _ratio(chi: float, own: float) -> float:
    """Return χ² over that of the fit; 1 if the fit leaves no residual."""
    return chi / own if own > 0.0 else 1.0


def _fix_nuisances(settled: Settled, words: str, steps: dict[int, float]) -> Alternative:
    """Return the alternative with nuisances fixed at offsets."""
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
    share = 1.0 + _ratio(float(step @ normal @ step), seen.chi)
    near = share < 1.0 / PREFERRED_SHARE
    return Alternative(words=words, share=share, moved=step[:4], undecided=near)


# --- other weights, modes and slopes


def _try_other_weights(few: FitSubset) -> Iterator[Alternative]:
    """Yield equal weights of all slopes, each half of the modes, and the modes that fit best."""
    settled = few.settled
    target, n_modes = settled.target, settled.target.n_modes
    # Every slope has the same noise at the same stroke.
    alike = np.full(n_modes, np.mean(target.weights))
    found = {"every slope with the same weight": alike}
    # Halves by mode number, because columns may be in any order.
    order = np.argsort(target.modes)
    best = np.argsort(settled.by_mode)[: n_modes - int(np.ceil(_WORST_SHARE * n_modes))]
    for words, kept in (
        ("the lower half of the modes", order[: (n_modes + 1) // 2]),
        ("the upper half of the modes", order[n_modes // 2 :]),
        ("without the tenth of the modes that fits worst", best),
    ):
        if len(kept) >= _MIN_MODES:
            found[words] = np.where(np.isin(np.arange(n_modes), kept), target.weights, 0.0)
    for words, weights in found.items():
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


TRIALS: tuple[Callable[[FitSubset], Iterator[Alternative]], ...] = (
    try_pupils,
    try_instruments,
    try_ellipse,
    try_rooftop,
    try_aberration,
    try_free_images,
    _try_off_centre,
    _try_separate_gains,
    _try_uneven_light,
    _try_spiders,
    _try_fixed_nuisances,
    _try_images_in_place,
    _try_other_weights,
    _try_without_border,
)
"""Trials made on every fit; each yields none, one or several alternatives."""
