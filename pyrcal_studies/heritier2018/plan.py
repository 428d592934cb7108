"""What is run: the truth, the budgets, and every task by the part of the paper it belongs to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from pyrcal_studies.heritier2018.calibration import Answer, Measurement
from pyrcal_studies.heritier2018.illumination import Change, ChangedReconstructor, Feature
from pyrcal_studies.heritier2018.loops import GainTuning, LoopRun, PoleSweep
from pyrcal_studies.heritier2018.patterns import Pattern, PatternRun
from pyrcal_studies.heritier2018.reconstructors import (
    FittedReconstructor,
    Inverse,
    MeasuredReconstructor,
    ModelReconstructor,
)
from pyrcal_studies.heritier2018.registration import CriterionMinimum, FitRun, Found, random_starts
from pyrcal_studies.heritier2018.store import Task
from pyrcal_studies.heritier2018.telescope import DRAWN, Occasion, ShakenOccasion
from service.model.kinds import Method
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration

TRUTH = Misregistration(
    shift_x_subap=-0.92, shift_y_subap=0.35, rotation_rad=np.deg2rad(65.08), magnification=0.98
)
"""Registration of the simulated telescope: equation 10. Only the simulator has it."""

ROUGH = Misregistration(rotation_rad=np.deg2rad(64.5))
"""Start of the procedure: equation 9."""

NEAR_ZERO = Misregistration(
    shift_x_subap=0.03, shift_y_subap=-0.02, rotation_rad=np.deg2rad(0.1), magnification=1.001
)
"""A registration close to the nominal one."""

WITHOUT_BORDER = replace(TRUTH, magnification=1.0)
"""The registration of equation 10 with 100 % of magnification: the pupil ends at the actuators."""

N_MEASURED = 400
N_MORE = 500
N_BASIS = 594

USUAL, IDEAL = "usual", "ideal"
"""Named sets of imperfections of the simulator."""

NIGHT_GAIN = 0.6
"""Integrator gain of the loops by night. The paper does not print one."""

POLE_GAINS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
"""Gains for which the limit of stability is computed."""

_STARTS_SEED = 2018


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """How much is run."""

    name: str
    settling_frames: int
    """Frames of each loop before it has settled."""

    influence_frames: int
    """Frames of each loop by night, after settling."""

    closed_frames: int
    """Frames of each loop by day, after settling."""

    n_average: int
    """Pushes, and as many pulls, of each mode in the measurement of the matrix."""

    seeds: tuple[int, ...]
    """Telescopes: each has its own imperfections, measured matrix, registration and turbulence."""

    ramp_frames: int
    """Frames of each gain that the ramp tries."""

    start_distances: tuple[float, ...]
    """Distances of starts from the truth, in units of the paper's rough estimate."""

    every: int
    """Only each such point of a sweep is run; the first and the marked ones always."""

    modes_every: int
    """Only each such mode takes part in the fits."""


FULL = Budget(
    name="full",
    settling_frames=100,
    influence_frames=100,
    closed_frames=300,
    n_average=10,
    seeds=(1, 2, 3),
    ramp_frames=80,
    start_distances=(3.0,),
    every=1,
    modes_every=1,
)
QUICK = Budget(
    name="quick",
    settling_frames=50,
    influence_frames=60,
    closed_frames=100,
    n_average=1,
    seeds=(1,),
    ramp_frames=40,
    start_distances=(1.0,),
    every=8,
    modes_every=8,
)

CAPTURE_MODES_EVERY = 16
"""Modes of the fits that measure the capture range: each sixteenth of the 400."""


def measured_once(budget: Budget) -> Measurement:
    """Return the first telescope's matrix with every mode pushed and pulled only once."""
    return measurement(replace(budget, n_average=1), budget.seeds[0])


# --- registration: section 4, equations 6 to 10, table 1, figures 7 and 8


def measurement(
    budget: Budget, seed: int, imperfections: str = USUAL, alpha: Misregistration = TRUTH
) -> Measurement:
    """Return the measured matrix of a telescope, by day and in a shaking dome."""
    return Measurement(
        occasion=Occasion(daytime=True, seed=seed, imperfections=imperfections, vibrations=True),
        alpha=alpha,
        n_modes=N_MEASURED,
        n_average=budget.n_average,
    )


def answer(seed: int, alpha: Misregistration = TRUTH, imperfections: str = USUAL) -> Answer:
    """Return the noise-free matrix of a telescope."""
    return Answer(
        occasion=Occasion(daytime=True, seed=seed, imperfections=imperfections),
        alpha=alpha,
        n_modes=N_MEASURED,
    )


def answers(budget: Budget, alpha: Misregistration) -> dict[str, Answer]:
    """Return the noise-free matrices of the first telescope and of one with the model's mirror."""
    first = budget.seeds[0]
    return {name: answer(first, alpha, name) for name in (DRAWN, USUAL)}


def fit_of(
    budget: Budget,
    source: Measurement | Answer,
    method: Method = Method.PAPER,
    start: Misregistration = ROUGH,
) -> FitRun:
    """Return a fit to a matrix."""
    return FitRun(source=source, method=method, start=start, modes_every=budget.modes_every)


def paper_fit(budget: Budget, seed: int) -> FitRun:
    """Return Table 1's procedure on the measured matrix of a telescope."""
    return fit_of(budget, measurement(budget, seed))


def near_zero_sources(budget: Budget) -> dict[str, Answer]:
    """Return noise-free matrices of telescopes close to the nominal registration."""
    return {f"clean, telescope {s}": answer(s, NEAR_ZERO) for s in budget.seeds[:1]}


def telescope_sources(budget: Budget) -> dict[str, Measurement | Answer]:
    """Return the matrices of all telescopes, noise-free and measured."""
    return {
        **{f"clean, telescope {s}": answer(s) for s in budget.seeds},
        **{f"noisy, telescope {s}": measurement(budget, s) for s in budget.seeds},
    }


def registration_sources(budget: Budget) -> dict[str, Measurement | Answer]:
    """Return the matrices at the paper's registration, noise-free and measured."""
    drawn = answer(budget.seeds[0], TRUTH, DRAWN)
    return {"clean, the model's mirror": drawn, **telescope_sources(budget)}


def capture_fits(budget: Budget, method: Method) -> dict[float, tuple[FitRun, ...]]:
    """Return fits of every telescope's noise-free matrix by the distance of their start.

    Distances are in units of the paper's rough estimate. Both methods have the same starts.
    """
    rng = np.random.default_rng(_STARTS_SEED)
    return {
        distance: tuple(
            FitRun(source=answer(seed), method=method, start=start, modes_every=CAPTURE_MODES_EVERY)
            for seed, start in zip(
                budget.seeds, random_starts(TRUTH, distance, len(budget.seeds), rng), strict=True
            )
        )
        for distance in budget.start_distances
    }


def registration_tasks(budget: Budget) -> list[Task]:
    """Return all fits."""
    sources = registration_sources(budget).values()
    tasks: list[Task] = [fit_of(budget, source) for source in sources]
    tasks += [CriterionMinimum(source=source) for source in sources]
    tasks += [fit_of(budget, source, Method.JOINT) for source in telescope_sources(budget).values()]
    near = near_zero_sources(budget).values()
    tasks += [fit_of(budget, source, Method.PAPER, Misregistration()) for source in near]
    return tasks


# --- sensitivity: section 3.2, figures 5 and 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """One parameter of the registration, moved away from where the model has it."""

    name: str
    """Name of the parameter at the boundary."""

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


ROTATION = Sweep(
    name="rotation_deg",
    symbol="α_rot",
    unit="deg",
    values=(0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.5, 2.0),
    marked=(0.8,),
)
SHIFT = Sweep(
    name="shift_x_subap",
    symbol="α_x",
    unit="%",
    values=(0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0),
    marked=(40.0,),
)
MAGNIFICATION = Sweep(
    name="magnification",
    symbol="α_magn",
    unit="%",
    values=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0),
)
SWEEPS = (ROTATION, SHIFT, MAGNIFICATION)
INFLUENCE_MODES = (N_MEASURED, N_BASIS)
RULES = ((ROTATION, 0.1), (SHIFT, 10.0))
"""Accuracy that the paper asks for (end of section 3.2)."""

POLE_STEPS = {"rotation_deg": 0.4, "shift_x_subap": 12.0}
"""Distance of two points at which the poles are computed, in the sweep's unit."""


def influence_run(budget: Budget, alpha: Misregistration, n_modes: int) -> LoopRun:
    """Return the loop, by night, of a telescope at ``alpha`` whose reconstructor is that of 0."""
    night = Occasion(daytime=False, seed=1, imperfections=IDEAL)
    return LoopRun(
        occasion=night,
        alpha=alpha,
        reconstructor=ModelReconstructor(occasion=night, alpha=Misregistration(), n_modes=n_modes),
        gain=NIGHT_GAIN,
        n_frames=budget.influence_frames,
        settling_frames=budget.settling_frames,
    )


def influence_values(budget: Budget, sweep: Sweep, n_modes: int) -> tuple[float, ...]:
    """Return the values of a curve of figure 5: with few modes, which drop slowly, every second."""
    values = sweep.at(budget)
    return values if n_modes == N_BASIS or budget.every > 1 else values[::2]


def pole_sweep(budget: Budget, sweep: Sweep, n_modes: int) -> PoleSweep:
    """Return the poles of the model's loop along a sweep."""
    step = POLE_STEPS[sweep.name] * budget.every
    values = np.arange(0.0, max(sweep.values) * 0.8 + step / 2, step)
    return PoleSweep(
        alphas=tuple(sweep.alpha(float(value)) for value in values),
        values=tuple(np.round(values, 6).tolist()),
        n_modes=n_modes,
    )


def influence_tasks(budget: Budget) -> list[Task]:
    """Return the loops of figures 5 and 6, and the poles."""
    tasks: list[Task] = [
        influence_run(budget, sweep.alpha(value), n_modes)
        for n_modes in INFLUENCE_MODES
        for sweep in SWEEPS
        for value in influence_values(budget, sweep, n_modes)
    ]
    tasks += [influence_run(budget, s.alpha(v), n) for s, v in RULES for n in INFLUENCE_MODES]
    return tasks + [pole_sweep(budget, sweep, N_BASIS) for sweep in (ROTATION, SHIFT)]


# --- closed loop by day: section 5, table 2, figures 13 and 14


class Variant(StrEnum):
    """Reconstructors of Table 2."""

    SYNTHETIC = "PSIM 400 Modes"
    MEASURED = "LBT 400 Modes"
    MORE = "PSIM 500 Modes"


def reconstructor(
    budget: Budget, seed: int, variant: Variant
) -> MeasuredReconstructor | FittedReconstructor:
    """Return a variant's reconstructor for one telescope."""
    fit = paper_fit(budget, seed)
    match variant:
        case Variant.MEASURED:
            return MeasuredReconstructor(measurement=measurement(budget, seed))
        case Variant.MORE:
            return FittedReconstructor(fit=fit, n_modes=N_MORE, tuned=True)
        case Variant.SYNTHETIC:
            return FittedReconstructor(fit=fit, n_modes=N_MEASURED, tuned=True)


def gain_tuning(budget: Budget, seed: int) -> GainTuning:
    """Return the ramp of the gains, in three groups, on the measured matrix."""
    return GainTuning(
        occasion=Occasion(daytime=True, seed=seed, vibrations=True),
        alpha=TRUTH,
        reconstructor=reconstructor(budget, seed, Variant.MEASURED),
        frames_per_gain=budget.ramp_frames,
    )


def closed_run(
    budget: Budget,
    seed: int,
    inverse: MeasuredReconstructor | FittedReconstructor,
    occasion: Occasion | None = None,
) -> LoopRun:
    """Return a loop by day in a shaking dome, with the gains tuned on the measured matrix."""
    return LoopRun(
        occasion=occasion or Occasion(daytime=True, seed=seed, vibrations=True),
        alpha=TRUTH,
        reconstructor=inverse,
        gain=gain_tuning(budget, seed),
        n_frames=budget.closed_frames,
        settling_frames=budget.settling_frames,
    )


def variant_run(budget: Budget, seed: int, variant: Variant) -> LoopRun:
    """Return the loop of a variant of Table 2."""
    return closed_run(budget, seed, reconstructor(budget, seed, variant))


SHAKING = 2.64
"""Vibrations over the simulator's: with them tip and tilt of the mirror's positions have the
190 nm of the paper's Table 2, instead of the 72 nm of the simulated dome."""


def shaken_run(budget: Budget) -> LoopRun:
    """Return the first telescope's loop with the synthetic matrix and stronger vibrations."""
    seed = budget.seeds[0]
    shaken = ShakenOccasion(daytime=True, seed=seed, vibrations=True, times=SHAKING)
    return closed_run(budget, seed, reconstructor(budget, seed, Variant.SYNTHETIC), shaken)


def once_run(budget: Budget) -> LoopRun:
    """Return the first telescope's loop with the matrix that was measured once."""
    inverse = MeasuredReconstructor(measurement=measured_once(budget))
    return closed_run(budget, budget.seeds[0], inverse)


LOW_GAIN = 0.4
"""Gain of all modes by day at which 500 modes are compared with 400 once more."""


def low_gain_run(budget: Budget, seed: int, variant: Variant) -> LoopRun:
    """Return the loop of a variant of Table 2 with one low gain for all modes."""
    return replace(variant_run(budget, seed, variant), gain=LOW_GAIN)


def closed_tasks(budget: Budget) -> list[Task]:
    """Return the loops of Table 2, and those that show what its columns depend on."""
    tasks: list[Task] = [variant_run(budget, s, v) for s in budget.seeds for v in Variant]
    tasks += [
        low_gain_run(budget, seed, variant)
        for seed in budget.seeds
        for variant in (Variant.SYNTHETIC, Variant.MORE)
    ]
    return [*tasks, shaken_run(budget), once_run(budget)]


# --- the simulator: section 4.4, figures 11 and 12


SIMULATOR = Occasion(daytime=False, seed=1, imperfections=DRAWN)
"""The paper's simulator: it has the model's own mirror and sees all of the turbulence by night."""


def in_simulator(
    budget: Budget,
    inverse: Inverse,
    fit: FitRun,
    step: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> LoopRun:
    """Return a loop by night of the paper's simulator.

    The simulator has the model's own mirror, stands where Table 1's procedure finds the telescope,
    or a step away from there, and sees all of the turbulence.
    """
    return LoopRun(
        occasion=SIMULATOR,
        alpha=Found(fit=fit, step=step),
        reconstructor=inverse,
        gain=NIGHT_GAIN,
        n_frames=budget.influence_frames,
        settling_frames=budget.settling_frames,
    )


def simulator_pair(budget: Budget, seed: int) -> tuple[LoopRun, LoopRun]:
    """Return the simulator's loops with the synthetic and the measured reconstructor."""
    fit = paper_fit(budget, seed)
    synthetic = FittedReconstructor(fit=fit, n_modes=N_MEASURED, tuned=False)
    measured = reconstructor(budget, seed, Variant.MEASURED)
    return in_simulator(budget, synthetic, fit), in_simulator(budget, measured, fit)


AROUND_STEPS = (-8, -4, -2, -1, 0, 1, 2, 4, 8)
"""Places of a sweep about the optimum, in units of its finest step."""


def around(sweep: Sweep, step: float) -> Sweep:
    """Return a sweep to both sides of the registration that was found, by its finest step."""
    values = sorted((step * n for n in AROUND_STEPS), key=abs)
    return replace(sweep, values=tuple(values), marked=(-8 * step, 8 * step))


AROUND = (
    around(ROTATION, 0.25),
    around(SHIFT, 5.0),
    around(replace(SHIFT, name="shift_y_subap", symbol="α_y"), 5.0),
    around(MAGNIFICATION, 0.5),
)
"""Sweeps to both sides of the registration that was found."""


def around_run(budget: Budget, sweep: Sweep, value: float) -> LoopRun:
    """Return the simulator so far from the optimum, with the measured reconstructor."""
    seed = budget.seeds[0]
    measured = reconstructor(budget, seed, Variant.MEASURED)
    return in_simulator(budget, measured, paper_fit(budget, seed), sweep.step(value))


REGISTERED = {AROUND[1]: (-20.0, 0.0, 20.0), AROUND[3]: (-4.0, -2.0, 0.0, 2.0, 4.0)}
"""Shifts along x and magnifications, %, at which the simulator runs with the reconstructor of that
place."""


def registered_run(budget: Budget, sweep: Sweep, value: float) -> LoopRun:
    """Return the simulator a step away, with the reconstructor of that place.

    Nothing is misregistered: only the place of the light on the sensor's mask changes, and how far
    it reaches beyond the actuators.
    """
    fit, step = paper_fit(budget, budget.seeds[0]), sweep.step(value)
    registered = ModelReconstructor(
        occasion=SIMULATOR, alpha=Found(fit=fit, step=step), n_modes=N_MEASURED
    )
    return in_simulator(budget, registered, fit, step)


def single_changes(budget: Budget) -> dict[str, Change]:
    """Return the features of figure 10 one by one, and pupil images off their places."""
    every = {
        "75 % of the signal missing bottom left": Change(feature=Feature.BOTTOM_LEFT, depth=0.75),
        "about the obscuration": Change(feature=Feature.OBSCURATION, depth=0.75),
        "behind four spiders": Change(feature=Feature.SPIDERS, depth=0.75),
        "pupil images displaced by 25 % of a subaperture": Change(displaced_images=0.25),
        "images 25 %, 50 % missing in all features, noise 25 %": Change(
            feature=Feature.ALL, depth=0.5, noise=0.25, displaced_images=0.25
        ),
    }
    return every if budget.name == "full" else {}


def combinations(budget: Budget) -> dict[tuple[float, float], Change]:
    """Return all features together with noise, by missing share of the signal and by noise."""
    full = budget.name == "full"
    depths = (0.0, 0.5, 0.75) if full else (0.0, 0.75)
    noises = (0.0, 0.25, 0.5, 0.75) if full else (0.0, 0.5)
    return {
        (depth, noise): Change(
            feature=Feature.ALL if depth else Feature.NONE, depth=depth, noise=noise
        )
        for depth in depths
        for noise in noises
        if depth or noise
    }


def change_run(budget: Budget, change: Change) -> LoopRun:
    """Return the simulator's loop with such a reconstructor."""
    fit = paper_fit(budget, budget.seeds[0])
    return in_simulator(
        budget, ChangedReconstructor(fit=fit, n_modes=N_MEASURED, change=change), fit
    )


UNEVENNESS = 0.6
"""Largest departure of the light from its mean, of a telescope measured without noise."""


def measured_runs(budget: Budget) -> dict[str, LoopRun]:
    """Return the simulator's loops with other measured matrices of the first telescope."""
    sources: dict[str, Measurement | Answer] = {
        "telescope 1, each mode pushed and pulled once": measured_once(budget)
    }
    if budget.name == "full":
        uneven = answer(budget.seeds[0], TRUTH, f"{DRAWN}-uneven-{UNEVENNESS:g}")
        sources[f"noise-free matrix in light uneven by {UNEVENNESS:.0%}"] = uneven
    fit = paper_fit(budget, budget.seeds[0])
    return {
        name: in_simulator(budget, MeasuredReconstructor(measurement=source), fit)
        for name, source in sources.items()
    }


def simulator_tasks(budget: Budget) -> list[Task]:
    """Return the loops of the simulator."""
    tasks: list[Task] = []
    for seed in budget.seeds:
        tasks += simulator_pair(budget, seed)
    tasks += measured_runs(budget).values()
    changes = [*single_changes(budget).values(), *combinations(budget).values()]
    tasks += [change_run(budget, change) for change in changes]
    for sweep in AROUND:
        tasks += [around_run(budget, sweep, value) for value in sweep.at(budget)]
    for sweep, values in REGISTERED.items():
        tasks += [registered_run(budget, sweep, value) for value in values]
    return tasks


# --- calibration patterns: section 2.1, equations 2 to 5


N_CALIBRATED = 100
"""Modes that are calibrated with each pattern."""


def pattern_run(budget: Budget, pattern: Pattern) -> PatternRun:
    """Return a calibration of some modes of the first telescope with one kind of pattern."""
    seed = budget.seeds[0]
    return PatternRun(
        occasion=Occasion(daytime=True, seed=seed, vibrations=True),
        alpha=TRUTH,
        pattern=pattern,
        n_modes=min(N_CALIBRATED, N_MEASURED // budget.modes_every),
        truth=answer(seed),
    )


def patterns(budget: Budget) -> tuple[Pattern, ...]:
    """Return the patterns that this budget affords."""
    return tuple(Pattern) if budget.name == "full" else (Pattern.MODAL, Pattern.HADAMARD)


def pattern_tasks(budget: Budget) -> list[Task]:
    """Return the calibrations."""
    return [pattern_run(budget, pattern) for pattern in patterns(budget)]


def capture_tasks(budget: Budget) -> list[Task]:
    """Return the fits that measure the capture range."""
    tasks: list[Task] = []
    for method in (Method.PAPER, Method.JOINT):
        for fits in capture_fits(budget, method).values():
            tasks += fits
    return tasks


def every_task(budget: Budget) -> tuple[Task, ...]:
    """Return all that the page needs, the longest chains first."""
    tasks = [*registration_tasks(budget), *closed_tasks(budget), *simulator_tasks(budget)]
    for alpha in (TRUTH, WITHOUT_BORDER):
        tasks += answers(budget, alpha).values()
    tasks += [*influence_tasks(budget), *pattern_tasks(budget), *capture_tasks(budget)]
    return tuple(tasks)
