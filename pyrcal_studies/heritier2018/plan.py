"""What is run: the truth, the budgets, and every task by the question it answers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from pyrcal_studies.heritier2018.calibration import Answer, Measurement
from pyrcal_studies.heritier2018.closing import GainTuning
from pyrcal_studies.heritier2018.loops import LoopRun
from pyrcal_studies.heritier2018.reconstructors import (
    FittedReconstructor,
    Kind,
    MeasuredReconstructor,
    ModelReconstructor,
)
from pyrcal_studies.heritier2018.registration import FitRun, Found, random_starts
from pyrcal_studies.heritier2018.store import Task
from pyrcal_studies.heritier2018.telescope import DRAWN, DRAWN_USUAL, Occasion
from service.model.kinds import Method
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration

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
"""The highest that the service's own ramp tries."""

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

    ramp_frames: int
    """Of each gain that the ramp tries."""

    n_starts: int
    every: int
    """Only each such point of a sweep, the first and the marked ones always."""


FULL = Budget(
    name="full",
    influence_frames=300,
    closed_frames=1200,
    n_average=10,
    ramp_frames=160,
    seeds=(1, 2, 3),
    n_starts=20,
    every=1,
)
QUICK = Budget(
    name="quick",
    influence_frames=100,
    closed_frames=200,
    n_average=1,
    ramp_frames=60,
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

    def step(self, value: float) -> tuple[float, float, float, float]:
        """Return the step from where it is registered, in the units of the boundary."""
        step = dict.fromkeys(PARAMETERS, 0.0)
        step[self.name] = value / (1.0 if self.unit == "deg" else 100.0)
        x, y, rotation, magnification = step.values()
        return x, y, rotation, magnification

    def alpha(self, value: float) -> Misregistration:
        """Return the registration at a value of the sweep."""
        return Misregistration.from_vector(
            Misregistration().vector + np.array(self.step(value)) / BOUNDARY_SCALE
        )

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

AROUND = (
    Sweep(
        name="rotation_deg",
        symbol="α_rot",
        unit="deg",
        values=(0.0, -2.0, -1.0, 1.0, 2.0),
        marked=(-2.0, 2.0),
    ),
    Sweep(
        name="shift_x_subap",
        symbol="α_x",
        unit="%",
        values=(0.0, -50.0, -25.0, 25.0, 50.0),
        marked=(-50.0, 50.0),
    ),
    Sweep(
        name="shift_y_subap",
        symbol="α_y",
        unit="%",
        values=(0.0, -50.0, -25.0, 25.0, 50.0),
        marked=(-50.0, 50.0),
    ),
    Sweep(
        name="magnification",
        symbol="α_magn",
        unit="%",
        values=(0.0, -4.0, -2.0, 2.0, 4.0),
        marked=(-4.0, 4.0),
    ),
)
"""Sweeps to both sides of the registration that was found."""

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


WITHOUT_BORDER = replace(TRUTH, magnification=1.0)
"""The same registration, but the pupil ends where the actuators do."""


def answers(budget: Budget, alpha: Misregistration) -> dict[str, Answer]:
    """Return what telescopes answer to small strokes there, by what is not as it is drawn."""
    first = budget.seeds[0]
    cases = {"as it is drawn": (DRAWN, first), "its own mirror": (IDEAL, first)}
    for seed in budget.seeds:
        cases[f"light and actuators, telescope {seed}"] = (DRAWN_USUAL, seed)
        cases[f"all of them, telescope {seed}"] = (USUAL, seed)
    return {name: answer(seed, alpha, kind) for name, (kind, seed) in cases.items()}


def answer(seed: int, alpha: Misregistration = TRUTH, imperfections: str = USUAL) -> Answer:
    """Return what a telescope answers to small strokes."""
    return Answer(
        occasion=Occasion(daytime=True, seed=seed, imperfections=imperfections),
        alpha=alpha,
        n_modes=N_MEASURED,
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


def reconstructor(
    budget: Budget, seed: int, variant: Variant, imperfections: str = USUAL
) -> MeasuredReconstructor | FittedReconstructor:
    """Return a variant's reconstructor for one telescope."""
    fit = joint_fit(budget, seed, imperfections)
    match variant:
        case Variant.MEASURED:
            return MeasuredReconstructor(measurement=fit.measurement)
        case Variant.MORE:
            return FittedReconstructor(fit=fit, n_modes=N_MORE, tuned=True)
        case _:
            return FittedReconstructor(fit=fit, n_modes=N_MEASURED, tuned=variant is Variant.TUNED)


def gain_tuning(budget: Budget, seed: int, variant: Variant) -> GainTuning:
    """Return the ramp of the gains of a variant's loop, at the telescope as it shakes."""
    return GainTuning(
        occasion=Occasion(daytime=True, seed=seed, vibrations=True),
        alpha=TRUTH,
        reconstructor=reconstructor(budget, seed, variant),
        frames_per_gain=budget.ramp_frames,
    )


def closed_run(budget: Budget, seed: int, variant: Variant, *, vibrations: bool) -> LoopRun:
    """Return a loop by day at the hidden registration, with one gain for every mode."""
    return LoopRun(
        occasion=Occasion(daytime=True, seed=seed, vibrations=vibrations),
        alpha=TRUTH,
        reconstructor=reconstructor(budget, seed, variant),
        gain=CLOSED_GAIN,
        n_frames=budget.closed_frames,
    )


def ramped_run(budget: Budget, seed: int, variant: Variant) -> LoopRun:
    """Return the same in a shaking dome with the gains that a ramp finds, higher ones tried too."""
    usual = closed_run(budget, seed, variant, vibrations=True)
    return replace(usual, gain=gain_tuning(budget, seed, variant))


def trials(budget: Budget, variant: Variant) -> dict[str, LoopRun]:
    """Return what is tried to find why a residual is as large as it is, first telescope, still.

    By what was changed; the first is the loop as it is.
    """
    usual = closed_run(budget, budget.seeds[0], variant, vibrations=False)
    strong = 2.0 ** (6 / 5)
    modes = usual.reconstructor.n_modes
    return {
        "as it is": usual,
        "gains by the ramp": replace(usual, gain=gain_tuning(budget, budget.seeds[0], variant)),
        "played: only modes that are controlled": replace(usual, played_modes=modes),
        "1 arcsec on the mirror, so twice the wavefront at the sensor": replace(
            usual, occasion=replace(usual.occasion, seeing_arcsec=strong)
        ),
        "no border: magnification 100 %, the model's matrix": replace(
            usual,
            alpha=WITHOUT_BORDER,
            reconstructor=ModelReconstructor(
                occasion=usual.occasion, alpha=WITHOUT_BORDER, n_modes=modes
            ),
        ),
    }


def in_simulator(
    budget: Budget,
    seed: int,
    variant: Variant,
    *,
    imperfections: str = USUAL,
    step: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> LoopRun:
    """Return a loop by night of the paper's simulator with a telescope's reconstructor.

    The simulator has the model's own mirror, lies where the fit to that telescope's measured
    matrix says, or a step away from there, and sees all of the turbulence.
    """
    return LoopRun(
        occasion=Occasion(daytime=False, seed=1, imperfections=DRAWN),
        alpha=Found(fit=joint_fit(budget, seed, imperfections), step=step),
        reconstructor=reconstructor(budget, seed, variant, imperfections),
        gain=INFLUENCE_GAIN,
        n_frames=budget.influence_frames,
    )


IN_SIMULATOR = (Variant.SYNTHETIC, Variant.MEASURED)


def simulator_runs(budget: Budget) -> list[LoopRun]:
    """Return the loops of the simulator: every telescope's, and around the first one's optimum."""
    first = budget.seeds[0]
    cases = [(budget, seed, USUAL) for seed in budget.seeds]
    cases += [(budget, first, IDEAL), (budget, first, REALISTIC), (hasty(budget), first, USUAL)]
    runs = [
        in_simulator(measured, seed, variant, imperfections=imperfections)
        for measured, seed, imperfections in cases
        for variant in IN_SIMULATOR
    ]
    for sweep in AROUND:
        for value in sweep.at(budget):
            runs += around_runs(budget, sweep, value)
    return runs


def around_runs(budget: Budget, sweep: Sweep, value: float) -> tuple[LoopRun, LoopRun]:
    """Return the simulator's loop so far from the optimum, and the one of a model that knows.

    The first has the first telescope's measured matrix.
    """
    away = in_simulator(budget, budget.seeds[0], Variant.MEASURED, step=sweep.step(value))
    known = ModelReconstructor(occasion=away.occasion, alpha=away.alpha, n_modes=N_MEASURED)
    return away, replace(away, reconstructor=known)


def every_task(budget: Budget) -> tuple[Task, ...]:
    """Return all that a report needs, what decides most first."""
    tasks: list[Task] = []
    for seed in budget.seeds:
        tasks += [joint_fit(budget, seed), paper_fit(budget, seed)]
    in_table = [
        (seed, variant)
        for seed in budget.seeds
        for variant in (Variant.MEASURED, Variant.TUNED, Variant.MORE)
    ]
    tasks += [closed_run(budget, seed, variant, vibrations=True) for seed, variant in in_table]
    brief = hasty(budget)
    for variant in (Variant.MEASURED, Variant.TUNED):
        tasks.append(closed_run(brief, brief.seeds[0], variant, vibrations=True))
    tasks += [ramped_run(budget, seed, variant) for seed, variant in in_table]
    for variant in (Variant.TUNED, Variant.MORE):
        tasks += trials(budget, variant).values()
    tasks += [joint_fit(budget, budget.seeds[0], other) for other in (IDEAL, REALISTIC)]
    tasks += simulator_runs(budget)
    for alpha in (TRUTH, WITHOUT_BORDER):
        tasks += answers(budget, alpha).values()
    tasks += closed_runs(budget)
    tasks += influence_runs(budget)
    for method in (Method.JOINT, Method.PAPER):
        tasks += fits_from_random_starts(budget, method)
    return tuple(tasks)


def closed_runs(budget: Budget) -> list[LoopRun]:
    """Return the loops by day of every telescope, and the first one's measured in haste."""
    brief, both = hasty(budget), (False, True)
    cases = [(budget, seed, v, shaken) for seed in budget.seeds for shaken in both for v in Variant]
    cases += [
        (brief, brief.seeds[0], v, shaken)
        for shaken in both
        for v in (Variant.MEASURED, Variant.TUNED)
    ]
    return [closed_run(b, seed, v, vibrations=shaken) for b, seed, v, shaken in cases]


def influence_runs(budget: Budget) -> list[LoopRun]:
    """Return the loops of all sweeps."""
    return [
        influence_run(budget, sweep.alpha(value), n_modes, kind)
        for sweep in SWEEPS
        for value in sweep.at(budget)
        for n_modes in INFLUENCE_MODES
        for kind in Kind
    ]
