"""Three methods from a start to the registration of a matrix.

**joint**: all four parameters together (:mod:`service.estimation.solver`), from one start or
from many.

**sensitivity**: as the Adaptive Optics Facility does it, the measured matrix less the synthetic one
is projected on the derivatives of the synthetic one. It is first order, so it is repeated about
each answer.

**paper**: rotation, shift along x, shift along y and magnification are scanned in turn, the others
held; the lowest point of a parabola through χ² is kept, and the next round takes smaller steps. χ²
is the sum over modes of the squared difference of measured and synthetic slopes, each mode with a
gain of its own and unit weight, the first modes left out: vibrations and the edge of the pupil
spoil them. The order of the parameters and the parabolas are the paper's. Its step sizes are not
reproduced from its table; those here shrink by five from a fifth of the capture range to what noise
allows.

References
----------
Heritier et al. 2018, MNRAS 481, 2829, section 4 and Table 1 (the scans); Kolb et al. 2012, Proc.
SPIE 8447 (identification by sensitivity matrices at the VLT's AOF).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.models import CHEAP, FitModels, Optic
from pyrcal.offline.solver import (
    LONGEST_OPTIC_STEP,
    Nuisances,
    Solution,
    is_blurring,
    refine,
)
from service.estimation.reference import Target
from service.estimation.solver import (
    LIMIT,
    SETTLED,
    Approach,
    Columns,
    approach,
    vertex,
    within_limits,
)
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration

Array = NDArray[np.float64]

GOOD = 0.10
"""Share of χ² that even uneven light and another mirror leave to the smooth shapes; a false
minimum leaves several times as much."""

SAME = np.array([0.15, 0.15, np.deg2rad(0.5), 0.01])
"""Minima nearer than this are one (numeric units)."""

SAME_SENSOR = 0.1
"""Logarithm by which the sensor's number may differ for derivatives with respect to other unknowns
to be as good."""

NEARLY_AS_GOOD = 1.3
"""A minimum with less than this times the least misfit is a rival."""

MAX_REPEATS = 6
LINEAR = 0.01
"""A logarithm of the instrument's that differs by less is as good as linear."""

LINEAR_IMAGES = 0.02
"""A pupil image displaced by less, in subapertures, is as good as linear, ..."""

LINEAR_IMAGES_LEFT = 0.08
"""... or by less than this times the root of the share of the signal that is left over: the second
order of a displacement d, at most (π d)² / 2 of the signal, is then a thirtieth of that."""

BLURS = (-0.5, -0.25, 0.25, 0.5)
"""Displacements of a pattern that are tried, subapertures: half of each in every image."""

LONGEST_MOVE = 0.3
"""Of one pattern of displaced images, subapertures: beyond it their derivatives point elsewhere."""

IMAGES_GAIN = 0.9
"""Share of χ² below which a fit about displaced images is worth another: four of the displacements
hardly change a matrix, and would wander without end."""

REACH = 20.0
"""Derivatives within so many settling lengths of where they were taken are as good as new."""

ORDER = (2, 0, 1, 3)
"""Indices of the parameters in the order they are scanned."""

ROUNDS = (
    np.array([0.5, 0.5, 2.0, 0.02]),
    np.array([0.1, 0.1, 0.4, 0.004]),
    np.array([0.02, 0.02, 0.08, 0.0008]),
)
"""Step of each parameter in each round, boundary units."""

HALF_WIDTH = 2
"""Samples on either side of where a scan begins."""

MAX_EXTENSIONS = 2
"""Times that a scan moves on when its lowest sample is its last."""

N_LEFT_OUT = 10
"""First modes that have no part in χ², where there are enough others."""

MAX_MODES = 60
"""Modes, spread over those fitted, that are compared where a few will do."""

CHANGES = np.arange(-4, 5) * 0.3
"""Logarithms of the factors that the sensor's number is looked for at, from a third to three."""

NO_SENSOR_NUMBER = 0.02
"""A modulation, λ/D, that stands for none: a logarithm never comes to 0."""

STRANGE = 0.05
"""RMS share of the signal left over beyond which the sensor is looked for from afar, ..."""

FAR_OFF = 0.03
"""... as it is where its logarithm seems off by this."""

_SHIFTS = (-1.3, 1.3)
_TURNS_RAD = np.deg2rad([-6.0, 6.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanStep:
    """One line of the paper's Table 1: one parameter scanned, the others held."""

    parameter: str
    """Name at the boundary, as in ``PARAMETERS``."""

    step: float
    """Distance of two samples, in boundary units (subaperture, degree, ratio)."""

    samples: NDArray[np.float64]
    """``(n_samples,)`` values tried, in boundary units."""

    chi: NDArray[np.float64]
    """``(n_samples,)`` χ² at each."""

    minimum: float
    """Lowest point of the parabola, in boundary units: where the next line begins."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landing:
    """End of the steps from one or many starts."""

    best: Approach
    rivals: tuple[Approach, ...]
    """Other minima nearly as good."""


def land(models: FitModels, target: Target, start: Misregistration) -> Landing:
    """Return where a start leads; if that explains little, where the best of many leads."""
    matrix = models.low_order.measured(target.matrix)
    low = Columns(
        matrix=matrix, weights=1.0 / np.sum(matrix[target.rows] ** 2, axis=0), rows=target.rows
    )
    found: list[Approach] = []
    for tried in (start, *map(start.moved_to, _other_starts(start.vector))):
        found.append(approach(models.far, low, tried))
        models.counter.n += found[-1].n_matrices
        if found[-1].converged and found[-1].misfit < GOOD:
            break
    best = min(found, key=lambda one: (not one.converged, one.misfit))
    rivals = [
        one
        for one in found
        if one.converged
        and one.misfit < NEARLY_AS_GOOD * best.misfit
        and np.any(np.abs(one.alpha.vector - best.alpha.vector) > SAME)
    ]
    return Landing(best=best, rivals=tuple(rivals))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Settled:
    """Minimum on the fine grid, and the models used."""

    solution: Solution
    target: Target
    """Without the slopes of unknown surface."""

    models: FitModels
    """Of the instrument that was found; its basis may have another coupling."""

    nuisances: Nuisances
    """About these models."""

    on_fine_grid: bool = True
    """Whether the fine model has decided."""

    @property
    def prior(self) -> Array:
        """``(4 + n_nuisances,)`` weight of the prior of each unknown, 1 / σ², as it counts."""
        return self.nuisances.prior * self.solution.dispersion

    @property
    def by_mode(self) -> Array:
        """``(n_modes,)`` RMS of the residual over the RMS of the measurement."""
        left = np.sum(self.solution.projection.residual**2, axis=0)
        power = np.sum(self.target.matrix[self.target.rows] ** 2, axis=0)
        return np.asarray(np.sqrt(left / power))

    @property
    def share(self) -> float:
        """RMS of the residual, each mode counted alike."""
        return float(np.sqrt(np.mean(self.by_mode**2)))


def settle(
    models: FitModels, target: Target, start: Misregistration, nuisances: Nuisances
) -> Settled:
    """Return the minimum on the fine grid.

    What is found of the instrument is linear only close by, so the fit is done again about it: on
    the cheap grid until that has come to rest, then on the fine one. A table of modes ends
    somewhere, and where depends on the registration: the slopes near its edge are left out, and the
    fit is done again if that changed anything.
    """
    seen = _known(models, target, start)
    solution = refine(models, seen, start, nuisances, decides=models.cheap)
    settled = Settled(
        solution=solution, target=seen, models=models, nuisances=nuisances, on_fine_grid=False
    )
    if settled.share < STRANGE:
        # so little is left over that the cheap grid's own error would displace pupil images
        solution = refine(models, seen, solution.alpha, nuisances, near=solution.near)
        settled = replace(settled, solution=solution, on_fine_grid=True)
    settled = _with_nearest_instrument(settled)
    models, nuisances = settled.models, settled.nuisances
    before, approaching, taken = np.inf, True, settled
    for _ in range(MAX_REPEATS):
        left = settled.solution.projection.chi
        if models is settled.models:
            models, nuisances = _adjusted(settled, move_images=left < IMAGES_GAIN * before)
        before = left
        there, near = _known(models, target, settled.solution.alpha), None
        if models is settled.models and np.array_equal(there.rows, settled.target.rows):
            if settled.on_fine_grid:
                break
            approaching, near = False, settled.solution.near
        decides = models.cheap if approaching else models.fine
        start, images = settled.solution.alpha, _images_of(taken, start, nuisances)
        solution = refine(
            models, there, start, nuisances, near=near, of_images=images, decides=decides
        )
        settled = Settled(
            solution=solution,
            target=there,
            models=models,
            nuisances=nuisances,
            on_fine_grid=not approaching,
        )
        taken = settled if images is None and near is None else taken
    if settled.on_fine_grid:
        return settled
    solution = refine(models, settled.target, settled.solution.alpha, nuisances)
    return replace(settled, solution=solution, on_fine_grid=True)


def _images_of(settled: Settled, alpha: Misregistration, nuisances: Nuisances) -> Array | None:
    """Return the derivatives of a fit with the images' places, if they hold for another nearby.

    They take as long as all others together. None if α, the images or the sensor differ too much.
    """
    before = settled.nuisances
    sensors = [dict(one.optics).get(Optic.SENSOR, 0.0) for one in (before, nuisances)]
    apart = np.abs(alpha.vector - settled.solution.alpha.vector)
    if (
        abs(sensors[1] - sensors[0]) > SAME_SENSOR
        or np.any(apart > SAME)
        or not np.array_equal(before.displaced, nuisances.displaced)
    ):
        return None
    first = 4 + before.image_places.start
    return settled.solution.near[first : first + len(before.images)]


def _with_nearest_instrument(settled: Settled) -> Settled:
    """Return the fit with images and sensor that explain the matrix best, where they seem far off.

    Displaced images look like another modulation, so they come first where a modulation is known.
    """
    searches = [_with_nearest_images, _with_nearest_sensor]
    if Optic.SENSOR in settled.nuisances.unknown:
        searches.reverse()
    for search in searches:
        models, nuisances = search(settled)
        if models is not settled.models:
            start = settled.solution.alpha
            solution = refine(models, settled.target, start, nuisances, decides=models.cheap)
            settled = replace(
                settled, solution=solution, models=models, nuisances=nuisances, on_fine_grid=False
            )
    return settled


def _with_nearest_sensor(settled: Settled) -> tuple[FitModels, Nuisances]:
    """Return the models of the sensor that explains the matrix best, where it seems far off.

    Steps lead slowly there: gains hide much of what a modulation does. So a few modes are looked at
    on the cheap grid; each sensor is allowed its own registration, to first order.
    """
    models, nuisances, solution = settled.models, settled.nuisances, settled.solution
    places = [k for k, (o, _) in enumerate(nuisances.optics) if o is Optic.SENSOR]
    if not places:
        return models, nuisances
    step = solution.nuisances[nuisances.first_optic + places[0]]
    unknown = Optic.SENSOR in nuisances.unknown
    if settled.share < STRANGE and abs(step) < FAR_OFF and not unknown:
        return models, nuisances
    modes = spread(settled.target.n_modes)
    few = settled.target.column_subset(modes)
    subset = replace(models, basis=models.basis.subset(modes))
    every = np.concatenate([solution.derivatives, solution.nuisance_derivatives])[:, :, modes]

    def left(change: float) -> float:
        models.counter.n += 1
        changed = subset.adjusted(Optic.SENSOR, change) if change else subset
        matrix = changed.model(CHEAP, once=True).interaction_matrix(solution.alpha)
        return few.project(matrix, every).chi_at_best

    found = _descended(left)
    best = int(np.argmin(found))
    change = CHANGES[best]
    nothing = float(np.log(NO_SENSOR_NUMBER / models.sensor_number))
    if best == 0 and left(nothing) < found[0]:
        change = nothing
    elif 0 < best < len(found) - 1:
        change += vertex(*found[best - 1 : best + 2]) * (CHANGES[1] - CHANGES[0])
    if abs(change) < LINEAR:
        return models, nuisances
    optics = [
        (optic, offset + change * (optic is Optic.SENSOR)) for optic, offset in nuisances.optics
    ]
    moved = models.adjusted(Optic.SENSOR, float(change))
    return moved, replace(nuisances, optics=tuple(optics))


def _descended(left: Callable[[float], float]) -> Array:
    """Return χ² at ``CHANGES``, outwards from none until it grows; infinite beyond.

    The widest modulations take longest.
    """
    found = np.full(len(CHANGES), np.inf)
    middle = len(CHANGES) // 2
    found[middle] = left(0.0)
    for side in (-1, 1):
        k = middle + side
        while 0 <= k < len(found):
            found[k] = left(CHANGES[k])
            if found[k] > found[k - side]:
                break
            k += side
    return found


def _with_nearest_images(settled: Settled) -> tuple[FitModels, Nuisances]:
    """Return the models with their pupil images where a few modes are explained best.

    Only where the first steps displace them, and no further than is likely. Quadrupoles and common
    displacements change a matrix to first order. The others blur it, and a blur hardly tells its
    sign: so each of them is looked for in turn, on the cheap grid, all other unknowns left free to
    first order.
    """
    models, nuisances, solution = settled.models, settled.nuisances, settled.solution
    values = solution.nuisances[nuisances.image_places]
    if not np.any(np.abs(values @ nuisances.images) > _linear_images(settled)):
        return models, nuisances
    modes = spread(settled.target.n_modes)
    few = settled.target.column_subset(modes)
    subset = replace(models, basis=models.basis.subset(modes))
    blurring = np.array([is_blurring(pattern) for pattern in nuisances.images])
    # the derivatives with a blur, taken without one, would explain anything
    free = np.ones(len(solution.nuisance_derivatives), dtype=bool)
    free[nuisances.image_places] = ~blurring
    every = np.concatenate([solution.derivatives, solution.nuisance_derivatives[free]])
    every = every[:, :, modes]
    seen = solution.projection
    noise = seen.chi / max(seen.residual.size - len(seen.gains), 1)
    unlikely = solution.dispersion * noise / nuisances.image_sigma**2

    def left(displaced: Array) -> float:
        improbable = unlikely * float(np.sum((nuisances.images @ displaced) ** 2))
        if improbable > seen.chi:
            return np.inf
        models.counter.n += 1
        matrix = subset.displaced(displaced).cheap.interaction_matrix(solution.alpha)
        return few.project(matrix, every).chi_at_best + improbable

    displaced = nuisances.displaced + np.where(blurring, 0.0, values) @ nuisances.images
    least = left(displaced)
    for pattern in nuisances.images[blurring]:
        tried = [displaced + size * pattern for size in BLURS]
        found = [left(one) for one in tried]
        best = int(np.argmin(found))
        if found[best] < least:
            displaced, least = tried[best], found[best]
    return models.displaced(displaced), replace(nuisances, displaced=displaced)


def spread(n_modes: int) -> NDArray[np.intp]:
    """Return a few columns, spread over all."""
    return np.unique(np.linspace(0, n_modes - 1, min(MAX_MODES, n_modes)).astype(np.intp))


def _linear_images(settled: Settled) -> float:
    """Return the displacement of a pupil image below which it is as good as linear, subap."""
    return max(LINEAR_IMAGES, LINEAR_IMAGES_LEFT * float(np.sqrt(settled.share)))


def _adjusted(settled: Settled, *, move_images: bool) -> tuple[FitModels, Nuisances]:
    """Return the models of the instrument that was found, and the unknowns about it."""
    models, nuisances = settled.models, settled.nuisances
    optics = []
    for k, (optic, offset) in enumerate(nuisances.optics, nuisances.first_optic):
        change = float(settled.solution.nuisances[k])
        if abs(change) > LINEAR and models.exact(optic):
            change = float(np.clip(change, -LONGEST_OPTIC_STEP, LONGEST_OPTIC_STEP))
            models, offset = models.adjusted(optic, change), offset + change
        optics.append((optic, offset))
    nuisances = replace(nuisances, optics=tuple(optics))
    step = settled.solution.nuisances[nuisances.image_places]
    step = np.clip(step, -LONGEST_MOVE, LONGEST_MOVE) @ nuisances.images
    displaced = nuisances.displaced + step
    far = np.any(np.abs(displaced - nuisances.displaced) > _linear_images(settled))
    if move_images and far:
        return models.displaced(displaced), replace(nuisances, displaced=displaced)
    return models, nuisances


def settle_at(
    models: FitModels, target: Target, alpha: Misregistration, nuisances: Nuisances
) -> Settled:
    """Return the model as it stands at a registration that another method has found."""
    seen = _known(models, target, alpha)
    there = refine(models, seen, alpha, nuisances, max_steps=0)
    solution = replace(there, converged=within_limits(alpha.vector))
    return Settled(solution=solution, target=seen, models=models, nuisances=nuisances)


def project_on_sensitivities(
    models: FitModels, target: Target, start: Misregistration, nuisances: Nuisances
) -> Settled:
    """Return the end of projections on sensitivities from one start."""
    for _ in range(MAX_REPEATS):
        settled = settle(models, target, start, nuisances)
        step = settled.solution.vector - start.vector
        if not settled.solution.converged or np.all(np.abs(step) < REACH * SETTLED):
            break
        start = settled.solution.alpha
    return settled


def scan(
    models: FitModels, target: Target, start: Misregistration
) -> tuple[Misregistration, tuple[ScanStep, ...]]:
    """Return the end of the scans from a start, and each of them."""
    first = N_LEFT_OUT if target.n_modes >= 3 * N_LEFT_OUT else 0
    columns = np.arange(first, target.n_modes)
    model = models.model(2, models.basis.subset(columns))
    target = target.column_subset(columns)
    values = start.vector * BOUNDARY_SCALE
    table = []

    def chi(tried: Array) -> float:
        return target.misfit(models.matrix(model, start.moved_to(tried / BOUNDARY_SCALE)))

    for steps in ROUNDS:
        for index in ORDER:
            for _ in range(1 + MAX_EXTENSIONS):
                step = _scanned(chi, values, index, float(steps[index]))
                table.append(step)
                values[index] = step.minimum
                if step.samples[0] < step.minimum < step.samples[-1]:
                    break
    return start.moved_to(values / BOUNDARY_SCALE), tuple(table)


def _known(models: FitModels, target: Target, alpha: Misregistration) -> Target:
    """Return the target without slopes that see surface a table of modes does not know."""
    return target.without(models.fine.unknown_rows(alpha))


def _other_starts(start: Array) -> list[Array]:
    """Return other starts: corners of the range, and turns."""
    corners = [np.array([x, y, 0.0, 0.0]) for x, y in product(_SHIFTS, _SHIFTS)]
    turns = [np.array([0.0, 0.0, turn, 0.0]) for turn in _TURNS_RAD]
    nominal = np.array([0.0, 0.0, start[2], 1.0])
    return [nominal, *(nominal + step for step in [*turns, *corners])]


def _scanned(chi: Callable[[Array], float], values: Array, index: int, step: float) -> ScanStep:
    samples = values[index] + step * np.arange(-HALF_WIDTH, HALF_WIDTH + 1)
    if index == 3:
        samples = np.clip(samples, 1.0 - LIMIT[index], 1.0 + LIMIT[index])
    tried = np.tile(values, (len(samples), 1))
    tried[:, index] = samples
    found = np.array([chi(one) for one in tried])
    return ScanStep(
        parameter=PARAMETERS[index],
        step=step,
        samples=samples,
        chi=found,
        minimum=_lowest(samples, found),
    )


def _lowest(samples: Array, chi: Array) -> float:
    """Return the lowest point of the parabola through the lowest sample and its neighbours.

    At the end of a scan the sample itself.
    """
    best = int(np.argmin(chi))
    if best in {0, len(samples) - 1}:
        return float(samples[best])
    step = samples[best + 1] - samples[best]
    return float(samples[best] + step * vertex(*chi[best - 1 : best + 2]))
