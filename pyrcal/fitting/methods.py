"""Three methods to fit the registration of a matrix from a start.

**joint**: all four parameters together (:mod:`service.estimation.solver`), from one start or from
many.

**sensitivity**: as at the Adaptive Optics Facility, the measured matrix less the synthetic one is
projected on the derivatives of the synthetic one. The method is first order, so it is repeated at
each result.

**paper**: the ten steps of Table 1 of Heritier et al. 2018. One parameter is scanned at a time with
the others fixed, in the order and with the step sizes of :data:`TABLE_1`. The criterion is χ_N of
section 4.2, :func:`chi_n`: all modes, no free gain. The value of a step is the minimum of a second
order polynomial through the samples near the lowest one. The modal gains are fitted afterwards, at
the registration found (section 4.3).

References
----------
Heritier et al. 2018, MNRAS 481, 2829, section 4, equations 7 and 8, Table 1; Kolb et al. 2012,
Proc. SPIE 8447 (identification by sensitivity matrices at the VLT's AOF).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.models import FitModels, Optic, sensor_coordinate
from pyrcal.fitting.solver import (
    LONGEST_OPTIC_STEP,
    Nuisances,
    Solution,
    is_blurring,
    refine,
)
from service.estimation.reference import Target
from service.estimation.solver import (
    SETTLED_STEP,
    Approach,
    Columns,
    approach,
    vertex,
    within_limits,
)
from service.model.interaction import InteractionModel
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration

Array = NDArray[np.float64]

GOOD_MISFIT = 0.10
"""Largest share of χ² left to the smooth shapes at the true minimum, even with uneven light and
another mirror; a false minimum leaves several times as much."""

SAME_MINIMUM = np.array([0.15, 0.15, np.deg2rad(0.5), 0.01])
"""Distance below which two minima are the same (numeric units)."""

SAME_SENSOR = 0.1
"""Largest logarithmic change of the sensor number for which other derivatives are reused."""

ALTERNATIVE_MISFIT_RATIO = 1.3
"""Misfit of another minimum over the smallest one, below which it is an alternative."""

MAX_REPEATS = 6
ABERRATION_REPEATS = 15
"""The same with an unknown static aberration: one of 1 rad without modulation takes 12."""

LINEAR_CHANGE = 0.01
"""Logarithmic change of an optical quantity below which the model is linear."""

LINEAR_DISPLACEMENT = 0.02
"""Displacement of a pupil image below which the model is linear, subapertures."""

LINEAR_DISPLACEMENT_RATIO = 0.08
"""The same limit over the root of the residual share of the signal: the second order of a
displacement d, at most (π d)² / 2 of the signal, is then a thirtieth of that share."""

BLUR_STEPS = np.arange(-2, 3) * 0.25
"""Trial amplitudes of a blurring pattern, subapertures: half of each in every image."""

LONGEST_MOVE = 0.3
"""Longest change of one displacement pattern, subapertures; the derivatives hold no further."""

IMAGES_GAIN = 0.9
"""Ratio of χ² below which a fit with displaced images is repeated: four of the displacements hardly
change a matrix, and would drift without end."""

REUSE_DISTANCE = 20.0
"""Number of settling lengths within which derivatives are reused."""

TABLE_1 = (
    ("rotation_deg", 0.125),
    ("shift_x_subap", 0.25),
    ("shift_y_subap", 0.25),
    ("rotation_deg", 0.1),
    ("shift_x_subap", 0.02),
    ("shift_y_subap", 0.02),
    ("rotation_deg", 0.025),
    ("shift_x_subap", 0.02),
    ("shift_y_subap", 0.02),
    ("magnification", 0.0045),
)
"""Parameter and distance of two samples of each step of the paper's Table 1, boundary units."""

ROUGH_RANGE = {"rotation_deg": 2.0, "shift_x_subap": 1.0, "shift_y_subap": 1.0}
"""Error of the rough first estimate that the paper assumes (section 4), boundary units. The first
scan of each parameter covers it."""

HALF_WIDTH = 5
"""Samples on either side of the start of the later scans. The paper does not print a number."""

MAX_EXTENSION = 60
"""Largest number of samples added to a scan whose lowest sample is its last."""

FITTED_HALF_WIDTH = 2
"""Samples on either side of the lowest one that the polynomial is fitted to."""

MAX_MODES = 60
"""Largest number of modes used for comparisons that do not need all modes."""

SENSOR_CHANGES = np.arange(-4, 5) * 0.3
"""Logarithms of the factors of the sensor number that are tried, from a third to three."""

OTHER_SENSOR_NUMBERS = (0.0, 1.0)
"""Modulations, λ/D, at which a fit begins that finds little of the smooth shapes explained with an
unknown one at its usual value."""

SEARCH_RESIDUAL = 0.05
"""RMS residual share of the signal above which the sensor number is searched over a wide range."""

SEARCH_STEP = 0.03
"""Logarithmic step of the sensor number above which it is searched over a wide range."""

_SHIFTS = (-1.3, 1.3)
_TURNS_RAD = np.deg2rad([-6.0, 6.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanStep:
    """One line of the paper's Table 1: a scan of one parameter with the others fixed."""

    parameter: str
    """Name at the boundary, as in ``PARAMETERS``."""

    step: float
    """Distance of two samples, in boundary units (subaperture, degree, ratio)."""

    samples: NDArray[np.float64]
    """``(n_samples,)`` values tried, ascending, in boundary units."""

    chi: NDArray[np.float64]
    """``(n_samples,)`` criterion χ_N at each, (slope per metre)²."""

    minimum: float
    """Minimum of the polynomial, in boundary units: the parameter's value after this step."""

    coefficients: NDArray[np.float64]
    """``(3,)`` polynomial coefficients, highest order first, in ``(value - minimum) / step``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landing:
    """Result of the coarse steps from one or many starts."""

    best: Approach
    rivals: tuple[Approach, ...]
    """Other minima that are nearly as good."""


def search_minimum(models: FitModels, target: Target, start: Misregistration) -> Landing:
    """Return the result from a start; if it explains little, the best of many starts."""
    # Weights by the power of each combination, so that large strokes do not decide alone.
    matrix = models.low_order.combine_columns(target.matrix)
    low = Columns(
        matrix=matrix, weights=1.0 / np.sum(matrix[target.rows] ** 2, axis=0), rows=target.rows
    )
    # the smooth combinations of the modes have the widest capture range
    found: list[Approach] = []
    for tried in (start, *map(start.with_vector, _other_starts(start.vector))):
        found.append(approach(models.far, low, tried))
        models.counter.n += found[-1].n_matrices
        # The seven other starts are needed only if the first one ends in a false minimum.
        if found[-1].converged and found[-1].misfit < GOOD_MISFIT:
            break
    # an end that has not converged is used only if no other has
    best = min(found, key=lambda one: (not one.converged, one.misfit))
    rivals = [
        one
        for one in found
        if one.converged
        and one.misfit < ALTERNATIVE_MISFIT_RATIO * best.misfit
        and np.any(np.abs(one.alpha.vector - best.alpha.vector) > SAME_MINIMUM)
    ]
    return Landing(best=best, rivals=tuple(rivals))


def land(
    models: FitModels, target: Target, start: Misregistration, nuisances: Nuisances
) -> tuple[Landing, FitModels, Nuisances]:
    """Return the result of the coarse steps, with models of the sensor number that suits them.

    From an unknown modulation of 3 λ/D a fit of an unmodulated matrix ended at 9, because α had
    made up for the difference. The smooth shapes show the difference before that.
    """
    landing = search_minimum(models, target, start)
    found = [(landing, models, nuisances)]
    explained = landing.best.converged and landing.best.misfit < GOOD_MISFIT
    if explained or Optic.SENSOR not in nuisances.unknown:
        return found[0]
    for number in OTHER_SENSOR_NUMBERS:
        change = sensor_coordinate(number) - sensor_coordinate(models.sensor_number)
        other = models.with_optic(Optic.SENSOR, change)
        found.append(
            (search_minimum(other, target, start), other, nuisances.with_sensor_moved(change))
        )
    return min(found, key=lambda one: (not one[0].best.converged, one[0].best.misfit))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Settled:
    """Minimum on the fine grid, and the models used."""

    solution: Solution
    target: Target
    """Measured columns without the slopes of unknown surface."""

    models: FitModels
    """Models of the fitted instrument; their basis may have another coupling."""

    nuisances: Nuisances
    """Nuisances relative to these models."""

    @property
    def prior(self) -> Array:
        """``(4 + n_nuisances,)`` effective weight of the prior of each unknown, 1 / σ²."""
        # Correlated slopes carry less information than their number suggests, so that the prior
        # weighs more against them.
        return self.nuisances.prior * self.solution.dispersion

    @property
    def by_mode(self) -> Array:
        """``(n_modes,)`` RMS of the residual over the RMS of the measurement."""
        left = np.sum(self.solution.projection.residual**2, axis=0)
        power = np.sum(self.target.matrix[self.target.rows] ** 2, axis=0)
        return np.asarray(np.sqrt(left / power))

    @property
    def share(self) -> float:
        """RMS of the residual, with all modes weighted equally."""
        return float(np.sqrt(np.mean(self.by_mode**2)))

    @property
    def residual_map(self) -> Array:
        """RMS residual of each slope over the RMS of all, ``(n_planes, n, n)``.

        All modes count alike. NaN where no slope is used.
        """
        target = self.target
        scale = np.sqrt(target.weights)
        # Weighted as the fit weighs them, or the modes with the largest strokes would decide.
        typical = np.sqrt(np.mean((target.matrix[target.rows] * scale) ** 2))
        left = self.solution.projection.residual * scale
        return draw_planes(np.sqrt(np.mean(left**2, axis=1)) / typical, target)


def draw_planes(values: Array, target: Target) -> Array:
    """Return values of the used slopes ``(n_rows, ...)`` as maps ``(n_planes, n, n, ...)``.

    NaN where no slope is used.
    """
    rest = values.shape[1:]
    by_slope = np.full((len(target.rows), *rest), np.nan)
    by_slope[target.rows] = values
    by_plane = by_slope.reshape(-1, int(target.valid.sum()), *rest)
    planes = np.full((len(by_plane), *target.valid.shape, *rest), np.nan)
    planes[:, target.valid] = by_plane
    return planes


def settle(
    models: FitModels, target: Target, start: Misregistration, nuisances: Nuisances
) -> Settled:
    """Return the minimum on the fine grid.

    The effect of optical quantities is linear only nearby, so the fit is repeated with updated
    models: on the coarse grid until it converges, then on the fine one. A table of modes has an
    edge, whose position depends on the registration. The slopes near the edge are left out, and the
    fit is repeated if their set has changed.
    """
    seen = _remove_unknown_rows(models, target, start)
    # where little is left over, the cheap grid's own error would displace pupil images
    solution = refine(
        models, seen, start, nuisances, decides=models.cheap, fine_below=SEARCH_RESIDUAL
    )
    settled = Settled(solution=solution, target=seen, models=models, nuisances=nuisances)
    if not solution.on_fine_grid and settled.share < SEARCH_RESIDUAL:
        solution = refine(models, seen, solution.alpha, nuisances, near=solution)
        settled = replace(settled, solution=solution)
    # Before the repeated fits: far from the true instrument their linear steps converge slowly.
    settled = _with_nearest_instrument(settled)
    models, nuisances = settled.models, settled.nuisances
    # ``approaching``: iterate on the coarse grid, which is cheaper, until that has converged
    before, approaching, taken = np.inf, True, settled
    aberrated = Optic.FOCUS in models.optics
    for _ in range(ABERRATION_REPEATS if aberrated else MAX_REPEATS):
        left = settled.solution.projection.chi
        if models is settled.models:
            models, nuisances = _update_models(settled, move_images=left < IMAGES_GAIN * before)
        before = left
        there, near = _remove_unknown_rows(models, target, settled.solution.alpha), None
        if models is settled.models and np.array_equal(there.rows, settled.target.rows):
            if settled.solution.on_fine_grid:
                break
            # Nothing changed on the coarse grid: the derivatives still hold for the fine one.
            approaching, near = False, settled.solution
        decides = models.cheap if approaching else models.fine
        start, images = settled.solution.alpha, reuse_image_derivatives(taken, start, nuisances)
        solution = refine(
            models, there, start, nuisances, near=near, of_images=images, decides=decides
        )
        settled = Settled(
            solution=solution,
            target=there,
            models=models,
            nuisances=nuisances,
        )
        taken = settled if images is None and near is None else taken
    if settled.solution.on_fine_grid:
        return settled
    # The repetitions ended on the coarse grid, but the residual on the fine one defines α.
    solution = refine(models, settled.target, settled.solution.alpha, nuisances)
    return replace(settled, solution=solution)


def reuse_image_derivatives(
    settled: Settled, alpha: Misregistration, nuisances: Nuisances
) -> Array | None:
    """Return the derivatives by image displacements of an earlier fit, if they still hold.

    They take as long as all others together. None if α, the images or the sensor differ too much.
    """
    before = settled.nuisances
    sensors = [dict(one.optics).get(Optic.SENSOR, 0.0) for one in (before, nuisances)]
    apart = np.abs(alpha.vector - settled.solution.near_alpha.vector)
    if (
        abs(sensors[1] - sensors[0]) > SAME_SENSOR
        or np.any(apart > SAME_MINIMUM)
        or not np.array_equal(before.displaced, nuisances.displaced)
    ):
        return None
    first = 4 + before.image_places.start
    return settled.solution.near[first : first + len(before.images)]


def _with_nearest_instrument(settled: Settled) -> Settled:
    """Return the fit with the best images and sensor number, if they may be far off.

    Displaced images look like another modulation, so they are searched first if the modulation is
    known.
    """
    # the order matters: the first search absorbs part of the other's effect
    searches = [_with_nearest_images, _with_nearest_sensor]
    if Optic.SENSOR in settled.nuisances.unknown:
        searches.reverse()
    for search in searches:
        models, nuisances = search(settled)
        if models is not settled.models:
            start = settled.solution.alpha
            solution = refine(models, settled.target, start, nuisances, decides=models.cheap)
            settled = replace(settled, solution=solution, models=models, nuisances=nuisances)
    return settled


def _with_nearest_sensor(settled: Settled) -> tuple[FitModels, Nuisances]:
    """Return the models with the best sensor number, if it may be far off.

    Steps converge slowly there, because gains hide much of a modulation's effect. So a few modes
    are compared on the coarse grid, each with its own registration to first order.
    """
    models, nuisances, solution = settled.models, settled.nuisances, settled.solution
    places = [k for k, (o, _) in enumerate(nuisances.optics) if o is Optic.SENSOR]
    if not places:
        return models, nuisances
    step = solution.nuisances[nuisances.first_optic + places[0]]
    unknown = Optic.SENSOR in nuisances.unknown
    if settled.share < SEARCH_RESIDUAL and abs(step) < SEARCH_STEP and not unknown:
        return models, nuisances
    modes = spread(settled.target.n_modes)
    few = settled.target.column_subset(modes)
    subset = replace(models, basis=models.basis.subset(modes))
    every = solution.derivatives[:, :, modes]

    def left(change: float) -> float:
        models.counter.n += 1
        changed = subset.with_optic(Optic.SENSOR, change) if change else subset
        matrix = changed.model(models.cheap_sampling, once=True).interaction_matrix(solution.alpha)
        return few.project(matrix, every).chi_at_best

    nothing = sensor_coordinate(0.0) - sensor_coordinate(models.sensor_number)
    changes = np.maximum(SENSOR_CHANGES, nothing)
    found = _scan_outwards(left, changes, left(0.0))
    # The scan stops where χ² grows, so the rest is infinite and never the minimum.
    best = int(np.argmin(found))
    change = changes[best]
    # The scan ends at a third of the number, and a sensor without modulation may be beyond.
    if best == 0 and changes[0] > nothing and left(nothing) < found[0]:
        change = nothing
    # The vertex of a parabola needs a sample on both sides; at an end the sample itself is used.
    elif 0 < best < len(found) - 1 and changes[best - 1] > nothing:
        change += vertex(*found[best - 1 : best + 2]) * (changes[best + 1] - change)
    if abs(change) < LINEAR_CHANGE:
        return models, nuisances
    moved = models.with_optic(Optic.SENSOR, float(change))
    return moved, nuisances.with_sensor_moved(float(change))


def _scan_outwards(
    left: Callable[[float], float], changes: NDArray[np.floating], at_none: float
) -> Array:
    """Return χ² at some changes, outwards from the middle one until it grows; infinite beyond.

    ``at_none`` is χ² without a change, the middle one. The widest modulations take longest, so they
    are not computed without need.
    """
    found = np.full(len(changes), np.inf)
    middle = len(changes) // 2
    found[middle] = at_none
    # Both sides: four low modes have a minimum of the modulation on each, and the first may be the
    # wrong one. The sign of a blur is hardly measurable.
    for side in (-1, 1):
        k = middle + side
        while 0 <= k < len(found):
            found[k] = left(float(changes[k]))
            if found[k] > found[k - side]:
                break
            k += side
    return found


def _with_nearest_images(settled: Settled) -> tuple[FitModels, Nuisances]:
    """Return the models with the pupil images that best explain a few modes.

    This is done only if the first steps displace the images, and within plausible displacements.
    Quadrupoles and common displacements change a matrix to first order. The others blur it, and the
    sign of a blur is hardly measurable: so each of them is searched in turn on the coarse grid,
    with all other unknowns free to first order.
    """
    models, nuisances, solution = settled.models, settled.nuisances, settled.solution
    values = solution.nuisances[nuisances.image_places]
    if not np.any(np.abs(values @ nuisances.images) > _linear_images(settled)):
        return models, nuisances
    modes = spread(settled.target.n_modes)
    few = settled.target.column_subset(modes)
    subset = replace(models, basis=models.basis.subset(modes))
    own = subset.cheap
    blurring = np.array([is_blurring(pattern) for pattern in nuisances.images])
    # derivatives by a blur, evaluated without blur, would fit any residual
    free = np.ones(len(solution.derivatives), dtype=bool)
    free[4:][nuisances.image_places] = ~blurring
    every = solution.derivatives[:, :, modes][free]
    seen = solution.projection
    noise = seen.chi / max(seen.residual.size - len(seen.gains), 1)
    unlikely = solution.dispersion * noise / nuisances.image_sigma**2

    def left(displaced: Array) -> float:
        away = nuisances.images @ (displaced - nuisances.expected)
        improbable = unlikely * float(np.sum(away**2))
        # Without computing the matrix: no fit could make up for a prior that costs this much.
        if improbable > seen.chi:
            return np.inf
        models.counter.n += 1
        moved = subset.with_displaced_images(displaced)
        model = moved.model(models.cheap_sampling, once=True)
        model.share_modes(own)
        return few.project(model.interaction_matrix(solution.alpha), every).chi_at_best + improbable

    def blurred(displaced: Array, pattern: Array, size: float) -> float:
        return left(displaced + size * pattern)

    # Fitted values of blurs are dropped: a blur has no effect to first order, so that its value
    # from linear steps is arbitrary.
    displaced = nuisances.displaced + np.where(blurring, 0.0, values) @ nuisances.images
    least = left(displaced)
    for pattern in nuisances.images[blurring]:
        found = _scan_outwards(partial(blurred, displaced, pattern), BLUR_STEPS, least)
        displaced = displaced + BLUR_STEPS[np.argmin(found)] * pattern
        least = float(found.min())
    return models.with_displaced_images(displaced), replace(nuisances, displaced=displaced)


def spread(n_modes: int) -> NDArray[np.intp]:
    """Return indices of a few columns, evenly spread over all."""
    return np.unique(np.linspace(0, n_modes - 1, min(MAX_MODES, n_modes)).astype(np.intp))


def _linear_images(settled: Settled) -> float:
    """Return the displacement of a pupil image below which the model is linear, subapertures."""
    return max(LINEAR_DISPLACEMENT, LINEAR_DISPLACEMENT_RATIO * float(np.sqrt(settled.share)))


def _update_models(settled: Settled, *, move_images: bool) -> tuple[FitModels, Nuisances]:
    """Return models updated with the fitted optical quantities, and nuisances relative to them."""
    models, nuisances = settled.models, settled.nuisances
    optics = []
    for k, (optic, offset) in enumerate(nuisances.optics, nuisances.first_optic):
        change = float(settled.solution.nuisances[k])
        if optic is Optic.SENSOR:  # beyond no modulation there is none to be built
            nothing = sensor_coordinate(0.0) - sensor_coordinate(models.sensor_number)
            change = max(change, nothing)
        # Smaller changes are described by the derivative. The models, with the matrices already
        # computed, are then kept, which also ends the repetitions.
        if abs(change) > LINEAR_CHANGE and models.exact(optic):
            change = float(np.clip(change, -LONGEST_OPTIC_STEP, LONGEST_OPTIC_STEP))
            models, offset = models.with_optic(optic, change), offset + change
        optics.append((optic, offset))
    nuisances = replace(nuisances, optics=tuple(optics))
    step = settled.solution.nuisances[nuisances.image_places]
    step = np.clip(step, -LONGEST_MOVE, LONGEST_MOVE) @ nuisances.images
    displaced = nuisances.displaced + step
    far = np.any(np.abs(displaced - nuisances.displaced) > _linear_images(settled))
    if move_images and far:
        return models.with_displaced_images(displaced), replace(nuisances, displaced=displaced)
    return models, nuisances


def settle_at(
    models: FitModels, target: Target, alpha: Misregistration, nuisances: Nuisances
) -> Settled:
    """Return the model evaluated at a registration from another method."""
    seen = _remove_unknown_rows(models, target, alpha)
    there = refine(models, seen, alpha, nuisances, max_steps=0)
    # No step was made here, so only the limits can be checked.
    solution = replace(there, converged=within_limits(alpha.vector))
    return Settled(solution=solution, target=seen, models=models, nuisances=nuisances)


def project_on_sensitivities(
    models: FitModels, target: Target, start: Misregistration, nuisances: Nuisances
) -> Settled:
    """Return the result of repeated projections on sensitivities from one start."""
    for _ in range(MAX_REPEATS):
        settled = settle(models, target, start, nuisances)
        step = settled.solution.vector - start.vector
        if not settled.solution.converged or np.all(np.abs(step) < REUSE_DISTANCE * SETTLED_STEP):
            break
        start = settled.solution.alpha
    return settled


def scan(
    models: FitModels,
    target: Target,
    start: Misregistration,
    steps: Sequence[tuple[str, float]] = TABLE_1,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[Misregistration, tuple[ScanStep, ...]]:
    """Scan the parameters one by one and return the last values and every scan.

    ``steps`` are the parameter and the step size of each scan, in boundary units. ``progress`` is a
    callback that receives a line after each scan.
    """
    values = start.vector * BOUNDARY_SCALE
    table: list[ScanStep] = []
    for number, (parameter, step) in enumerate(steps):
        # only the last scan of a parameter sets its value, so earlier ones use the coarse model
        last = all(later != parameter for later, _ in steps[number + 1 :])
        model = models.fine if last else models.cheap
        index, known = PARAMETERS.index(parameter), values.copy()

        chi = partial(_compute_chi, models, model, target, start, known, index)
        first = all(done.parameter != parameter for done in table)
        reach = ROUGH_RANGE.get(parameter, 0.0) if first else 0.0
        # The first scan must cover the error of the rough estimate; later ones start near the
        # minimum.
        half_width = max(HALF_WIDTH, round(reach / step))
        table.append(_scan_parameter(chi, parameter, float(values[index]), step, half_width))
        values[index] = table[-1].minimum
        progress(f"step {len(table)}: {parameter} by {step:g}: {table[-1].minimum:.4f}")
    return start.with_vector(values / BOUNDARY_SCALE), tuple(table)


def _compute_chi(
    models: FitModels,
    model: InteractionModel,
    target: Target,
    start: Misregistration,
    known: Array,
    index: int,
    tried: float,
) -> float:
    """Return χ_N with one parameter at a tried value, boundary units."""
    there = np.where(np.arange(4) == index, tried, known)
    return chi_n(target, models.matrix(model, start.with_vector(there / BOUNDARY_SCALE)))


def chi_n(target: Target, matrix: NDArray[Any]) -> float:
    """Return the paper's criterion χ_N of a synthetic matrix, (slope per metre)².

    It is the squared norm over the modes (equation 8) of the RMS difference between measured and
    synthetic slopes of each mode (equation 7). There is no free gain.
    """
    difference = target.matrix[target.rows] - matrix[target.rows]
    return float(np.sum(np.mean(difference**2, axis=0, dtype=np.float64)))


def _remove_unknown_rows(models: FitModels, target: Target, alpha: Misregistration) -> Target:
    """Return the target without slopes from surface outside a table of modes."""
    return target.without(models.fine.unknown_rows(alpha))


def _other_starts(start: Array) -> list[Array]:
    """Return further starts: corners of the range, and rotations."""
    corners = [np.array([x, y, 0.0, 0.0]) for x, y in product(_SHIFTS, _SHIFTS)]
    turns = [np.array([0.0, 0.0, turn, 0.0]) for turn in _TURNS_RAD]
    # The rotation is kept: it is from the orientation search or was given.
    nominal = np.array([0.0, 0.0, start[2], 1.0])
    return [nominal, *(nominal + step for step in [*turns, *corners])]


def _scan_parameter(
    chi: Callable[[float], float], parameter: str, start: float, step: float, half_width: int
) -> ScanStep:
    """Scan one parameter around a start, and continue while the lowest sample is the last one."""
    found = {k: chi(start + k * step) for k in range(-half_width, half_width + 1)}
    for _ in range(MAX_EXTENSION):
        best = min(found, key=lambda k: found[k])
        beyond = best - 1 if best == min(found) else best + 1
        if beyond in found:
            break
        found[beyond] = chi(start + beyond * step)
    places = np.array(sorted(found))
    values = np.array([found[k] for k in places])
    # Only near the lowest sample: over a wide scan the criterion is not a parabola.
    near = np.abs(places - best) <= FITTED_HALF_WIDTH
    bend, slope, least = np.polyfit(places[near] - best, values[near], 2)
    # without a minimum near the lowest sample, the polynomial is no better than the sample
    turn = -slope / (2.0 * bend) if bend > 0.0 and abs(slope) <= 2.0 * bend else 0.0
    level = least + turn * (slope + bend * turn)
    return ScanStep(
        parameter=parameter,
        step=step,
        samples=start + step * places,
        chi=values,
        minimum=float(start + step * (best + turn)),
        coefficients=np.array([bend, slope + 2.0 * bend * turn, level]),
    )
