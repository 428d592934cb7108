"""What is run: the truth, the budgets, and every task by the question it answers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from service.fit.matrix import Method
from service.model.misregistration import Misregistration
from studies.heritier2018.calibration import Measurement
from studies.heritier2018.loops import LoopRun
from studies.heritier2018.reconstructors import (
    AnyReconstructor,
    FittedReconstructor,
    Kind,
    MeasuredReconstructor,
    ModelReconstructor,
)
from studies.heritier2018.registration import FitRun, random_starts
from studies.heritier2018.store import Task
from studies.heritier2018.telescope import Occasion

TRUTH = Misregistration(
    shift_x_subap=-0.92, shift_y_subap=0.35, rotation_rad=np.deg2rad(65.08), magnification=0.98
)
"""What the paper found at the telescope; here it is hidden from everything but the simulator."""

ROUGH = Misregistration(rotation_rad=np.deg2rad(64.5))
"""Where the paper's scans began: the rotation as tip and tilt tell it."""

N_MEASURED = 400
N_MORE = 500
N_BASIS = 594

USUAL, IDEAL, REALISTIC = "usual", "ideal", "realistic"
"""How far a telescope is from the drawing, by the simulator's names."""

INFLUENCE_GAIN = 0.6
CLOSED_GAIN = 0.6

_STARTS_SEED = 2018


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """How much is run."""

    name: str
    influence_frames: int
    """Of each loop with a misregistered model, after settling."""

    closed_frames: int
    """Of each loop by day, after settling."""

    n_average: int
    """Pushes, and as many pulls, of each mode when the matrix is measured."""

    seeds: tuple[int, ...]
    """Telescopes: each with its own imperfections, measured matrix, fit and turbulence."""

    n_starts: int
    every: int
    """Only each such point of a sweep, the first and the marked ones always."""


FULL = Budget(
    name="full",
    influence_frames=300,
    closed_frames=1200,
    n_average=10,
    seeds=(1, 2, 3),
    n_starts=20,
    every=1,
)
QUICK = Budget(
    name="quick",
    influence_frames=100,
    closed_frames=200,
    n_average=1,
    seeds=(1,),
    n_starts=2,
    every=4,
)


def hasty(budget: Budget) -> Budget:
    """Return the same with every mode pushed and pulled only once, on the first telescope."""
    return replace(budget, n_average=1, seeds=budget.seeds[:1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """One parameter of the registration, taken away from where the model has it."""

    name: str
    """Of the parameter at the boundary."""

    symbol: str
    unit: str
    values: tuple[float, ...]
    """In ``unit``; 0: registered."""

    marked: tuple[float, ...] = ()
    """Values at which modal spectra are shown."""

    def alpha(self, value: float) -> Misregistration:
        """Return the registration at a value of the sweep."""
        boundary = Misregistration().to_boundary()
        boundary[self.name] += value / (1.0 if self.unit == "deg" else 100.0)
        return Misregistration.from_boundary(boundary)

    def border_subap(self, value: float) -> float:
        """Return how far a point at the border of the pupil moves, in subapertures."""
        radius = 15.0
        match self.name:
            case "rotation_deg":
                return radius * float(np.deg2rad(value))
            case "magnification":
                return radius * value / 100.0
            case _:
                return value / 100.0

    def at(self, budget: Budget) -> tuple[float, ...]:
        """Return the values this budget affords."""
        return tuple(
            value
            for k, value in enumerate(self.values)
            if k % budget.every == 0 or value in self.marked
        )


SWEEPS = (
    Sweep(
        name="rotation_deg",
        symbol="α_rot",
        unit="deg",
        values=(0.0, 0.4, 0.8, 1.0, 1.2, 1.5, 2.0, 2.5),
        marked=(0.8,),
    ),
    Sweep(
        name="shift_x_subap",
        symbol="α_x",
        unit="%",
        values=(0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0),
        marked=(40.0,),
    ),
    Sweep(
        name="magnification",
        symbol="α_magn",
        unit="%",
        values=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0),
    ),
)

INFLUENCE_MODES = (N_MEASURED, N_BASIS)


def influence_run(budget: Budget, alpha: Misregistration, n_modes: int, kind: Kind) -> LoopRun:
    """Return the loop, by night, of a telescope at ``alpha`` whose model says 0."""
    night = Occasion(daytime=False, seed=1, imperfections=IDEAL)
    return LoopRun(
        occasion=night,
        alpha=alpha,
        reconstructor=ModelReconstructor(
            occasion=night, alpha=Misregistration(), n_modes=n_modes, kind=kind
        ),
        gain=INFLUENCE_GAIN,
        n_frames=budget.influence_frames,
    )


def measurement(budget: Budget, seed: int, imperfections: str = USUAL) -> Measurement:
    """Return the measured matrix of a telescope, by day and in a shaking dome."""
    return Measurement(
        occasion=Occasion(daytime=True, seed=seed, imperfections=imperfections, vibrations=True),
        alpha=TRUTH,
        n_modes=N_MEASURED,
        n_average=budget.n_average,
    )


def joint_fit(budget: Budget, seed: int, imperfections: str = USUAL) -> FitRun:
    """Return the joint fit to it, begun where the paper began."""
    measured = measurement(budget, seed, imperfections)
    return FitRun(measurement=measured, method=Method.JOINT, start=ROUGH)


def paper_fit(budget: Budget, seed: int) -> FitRun:
    """Return the paper's scans, begun where the paper began."""
    return FitRun(measurement=measurement(budget, seed), method=Method.PAPER, start=ROUGH)


def fits_from_random_starts(budget: Budget, method: Method) -> tuple[FitRun, ...]:
    """Return fits of the first telescope's matrix from starts all over the capture range."""
    rng = np.random.default_rng(_STARTS_SEED)
    return tuple(
        FitRun(measurement=measurement(budget, budget.seeds[0]), method=method, start=start)
        for start in random_starts(TRUTH, budget.n_starts, rng)
    )


class Variant(StrEnum):
    """Which reconstructor closes the loop by day."""

    MEASURED = "measured matrix"
    SYNTHETIC = "synthetic matrix"
    TUNED = "synthetic, gains tuned"
    MORE = "synthetic, gains tuned, 500 modes"


def closed_run(budget: Budget, seed: int, variant: Variant, *, vibrations: bool) -> LoopRun:
    """Return a loop by day at the hidden registration."""
    fit = joint_fit(budget, seed)
    reconstructor: AnyReconstructor
    match variant:
        case Variant.MEASURED:
            reconstructor = MeasuredReconstructor(measurement=measurement(budget, seed))
        case Variant.MORE:
            reconstructor = FittedReconstructor(fit=fit, n_modes=N_MORE, tuned=True)
        case _:
            reconstructor = FittedReconstructor(
                fit=fit, n_modes=N_MEASURED, tuned=variant is Variant.TUNED
            )
    return LoopRun(
        occasion=Occasion(daytime=True, seed=seed, vibrations=vibrations),
        alpha=TRUTH,
        reconstructor=reconstructor,
        gain=CLOSED_GAIN,
        n_frames=budget.closed_frames,
    )


def every_task(budget: Budget) -> tuple[Task, ...]:
    """Return all that a report needs, what decides most first."""
    tasks: list[Task] = []
    for seed in budget.seeds:
        tasks += [joint_fit(budget, seed), paper_fit(budget, seed)]
    for seed in budget.seeds:
        for vibrations in (False, True):
            tasks += [closed_run(budget, seed, v, vibrations=vibrations) for v in Variant]
    tasks += [joint_fit(budget, budget.seeds[0], other) for other in (IDEAL, REALISTIC)]
    for vibrations in (False, True):
        for variant in (Variant.MEASURED, Variant.TUNED):
            brief = hasty(budget)
            tasks.append(closed_run(brief, brief.seeds[0], variant, vibrations=vibrations))
    tasks += influence_runs(budget)
    for method in (Method.JOINT, Method.PAPER):
        tasks += fits_from_random_starts(budget, method)
    return tuple(tasks)


def influence_runs(budget: Budget) -> list[LoopRun]:
    """Return the loops of all sweeps."""
    return [
        influence_run(budget, sweep.alpha(value), n_modes, kind)
        for sweep in SWEEPS
        for value in sweep.at(budget)
        for n_modes in INFLUENCE_MODES
        for kind in Kind
    ]
