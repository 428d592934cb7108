"""Numbers of the page, computed from the steps that were run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import plan
from pyrcal_studies.heritier2018.calibration import Answer, Measurement
from pyrcal_studies.heritier2018.loops import Over, limit_of_stability, strehl, wavefront_error_nm
from pyrcal_studies.heritier2018.plan import Budget, Sweep, Variant
from pyrcal_studies.heritier2018.reconstructors import synthetic_matrix
from pyrcal_studies.heritier2018.registration import (
    CriterionMinimum,
    FitRun,
    errors,
    fitted_alpha,
    is_right,
)
from pyrcal_studies.heritier2018.store import Record, Store
from pyrcal_studies.heritier2018.telescope import DRAWN
from service.model.kinds import Method
from service.model.misregistration import PARAMETERS, Misregistration

Array = NDArray[np.float64]

SYMBOLS = dict(zip(PARAMETERS, ("α_x", "α_y", "α_rot", "α_magn"), strict=True))
UNITS = dict(zip(PARAMETERS, ("%", "%", "°", "%"), strict=True))
SHOWN = np.array([100.0, 100.0, 1.0, 100.0])
"""From boundary units to the paper's: % of a subaperture, degrees, % of the diameter."""

COSTLY_NM = 50.0
"""Wavefront error, added in quadrature to that of the registered loop, that is called a drop."""

LEFT_OUT = (0, 2, 50)
"""First modes left out in each column of Table 2."""

SHOWN_MODES = (1, 5, 10, 50, 100, 200, 300, 350, 400)
"""Modes of figure 9, counted from 1."""


# --- registration


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanLine:
    """A line of our Table 1, in the paper's units."""

    symbol: str
    step: float
    n_samples: int
    value: float
    unit: str


def scan_lines(record: Record) -> list[ScanLine]:
    """Return our Table 1."""
    lines = []
    for k, name in enumerate(str(step) for step in record["steps"]):
        scale = float(SHOWN[PARAMETERS.index(name)])
        lines.append(
            ScanLine(
                symbol=SYMBOLS[name],
                step=float(record["step_sizes"][k]) * scale,
                n_samples=len(record[f"samples_{k}"]),
                value=float(record["minima"][k]) * scale,
                unit=UNITS[name],
            )
        )
    return lines


def departure_from_parabola(record: Record) -> float:
    """Return how far χ departs from a parabola in steps 7 to 10, as a share of its range."""
    departures = []
    for k in range(6, len(record["steps"])):
        samples = (record[f"samples_{k}"] - record["minima"][k]) / record["step_sizes"][k]
        near = np.abs(samples) < 2.6
        chi = record[f"chi_{k}"]
        fitted = np.polyval(record[f"coefficients_{k}"], samples[near])
        departures.append(float(np.abs(chi[near] - fitted).max() / np.ptp(chi[near])))
    return max(departures)


def fit_errors(budget: Budget, store: Store, *, near: bool = False) -> dict[str, Array]:
    """Return the errors of Table 1's procedure by matrix, the paper's units."""
    sources: Mapping[str, Measurement | Answer] = (
        plan.near_zero_sources(budget) if near else plan.registration_sources(budget)
    )
    truth, start = (plan.NEAR_ZERO, Misregistration()) if near else (plan.TRUTH, plan.ROUGH)
    return {
        name: errors(store.read(plan.fit_of(budget, source, start=start)), truth)
        for name, source in sources.items()
    }


def joint_errors(budget: Budget, store: Store) -> dict[str, Array]:
    """Return the errors of the joint fit by matrix, the paper's units."""
    return {
        name: errors(store.read(plan.fit_of(budget, source, Method.JOINT)), plan.TRUTH)
        for name, source in plan.telescope_sources(budget).items()
    }


def worst(found: Mapping[str, Array]) -> tuple[float, float, float]:
    """Return the largest error in shift, rotation and magnification."""
    largest = np.max(np.abs(list(found.values())), axis=0)
    return float(max(largest[:2])), float(largest[2]), float(largest[3])


def third_estimation(budget: Budget, store: Store) -> Array:
    """Return by how much steps 7 to 9 change what steps 4 to 6 found: x, y and rotation.

    The largest of the telescopes, in the paper's units.
    """
    changes = []
    for seed in budget.seeds:
        values = [line.value for line in scan_lines(fit_record(budget, store, seed)[1])]
        turned, x, y = np.abs(np.array(values[6:9]) - values[3:6])
        changes.append((x, y, turned))
    return np.asarray(np.max(changes, axis=0))


def minimum_errors(budget: Budget, store: Store, name: str = "alpha") -> dict[str, Array]:
    """Return the errors of the criterion's minimum by matrix, the paper's units.

    ``name`` is ``alpha``, or ``alpha_gains`` for a free gain per mode.
    """
    found = {}
    for matrix, source in plan.registration_sources(budget).items():
        record = store.read(CriterionMinimum(source=source))
        found[matrix] = errors({"alpha": record[name]}, plan.TRUTH)
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Causes:
    """Parts of the error of Table 1's procedure on a measured matrix; their sum is the error."""

    order: Array
    """One parameter after the other, the magnification last."""

    grid: Array
    """The model's optics: the same mirror, no noise."""

    imperfections: Array
    """Uneven light, displaced actuators and another mirror."""

    noise: Array
    """Noise, vibrations, and pokes of 20 nm instead of 1 nm."""

    @property
    def largest(self) -> str:
        """Name of the part with the largest shift error."""
        names = ("order", "grid", "imperfections", "noise")
        return max(names, key=lambda name: float(np.abs(getattr(self, name)[:2]).max()))


def causes(budget: Budget, store: Store) -> dict[int, Causes]:
    """Return the parts of the error by telescope."""
    at_minimum, scanned = minimum_errors(budget, store), fit_errors(budget, store)
    drawn = at_minimum["clean, the model's mirror"]
    found = {}
    for seed in budget.seeds:
        clean, noisy = (at_minimum[f"{word}, telescope {seed}"] for word in ("clean", "noisy"))
        found[seed] = Causes(
            order=scanned[f"noisy, telescope {seed}"] - noisy,
            grid=drawn,
            imperfections=clean - drawn,
            noise=noisy - clean,
        )
    return found


def captured(budget: Budget, store: Store, method: Method) -> dict[float, int]:
    """Return by distance of the starts how many fits are right."""
    return {
        distance: sum(is_right(store.read(fit), plan.TRUTH) for fit in fits)
        for distance, fits in plan.capture_fits(budget, method).items()
    }


def right_from_rough(budget: Budget, store: Store, method: Method) -> int:
    """Return how many fits of all matrices are right from the start of equation 9."""
    sources = plan.telescope_sources(budget).values()
    records = [store.read(plan.fit_of(budget, source, method)) for source in sources]
    return sum(is_right(record, plan.TRUTH) for record in records)


def evaluations(budget: Budget, store: Store) -> tuple[float, float]:
    """Return the mean number of model matrices of Table 1's procedure and of the joint fit."""
    scans, joint = (
        np.mean(
            [
                int(store.read(plan.fit_of(budget, source, method))["n_evaluations"])
                for source in plan.telescope_sources(budget).values()
            ]
        )
        for method in (Method.PAPER, Method.JOINT)
    )
    return float(scans), float(joint)


# --- sensitivity


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Wavefront error along a sweep."""

    sweep: Sweep
    n_modes: int
    values: tuple[float, ...]
    errors_nm: tuple[float, ...]

    def drop(self) -> float | None:
        """Return the value at which ``COSTLY_NM`` are lost; None if the sweep does not reach it."""
        limit = np.hypot(self.errors_nm[0], COSTLY_NM)
        above = np.flatnonzero(np.array(self.errors_nm) > limit)
        if not len(above):
            return None
        k = int(above[0])
        # the error grows like a power: its logarithm is the straighter line
        low, high = np.log(self.errors_nm[k - 1]), np.log(self.errors_nm[k])
        share = (np.log(limit) - low) / (high - low)
        return float(self.values[k - 1] + share * (self.values[k] - self.values[k - 1]))

    def first_after(self) -> float | None:
        """Return the first value of the sweep after the drop, as the paper reads its figure."""
        drop = self.drop()
        return None if drop is None else next(value for value in self.values if value >= drop)


def curve(budget: Budget, store: Store, sweep: Sweep, n_modes: int) -> Curve:
    """Return a curve of figure 5."""
    values = plan.influence_values(budget, sweep, n_modes)
    runs = [plan.influence_run(budget, sweep.alpha(value), n_modes) for value in values]
    return Curve(
        sweep=sweep,
        n_modes=n_modes,
        values=values,
        errors_nm=tuple(wavefront_error_nm(store.read(run)) for run in runs),
    )


def rule_costs_nm(budget: Budget, store: Store) -> dict[tuple[str, int], float]:
    """Return what 0.1 deg and 10 % add in quadrature to the wavefront error, nm, by sweep."""
    costs = {}
    for sweep, value in plan.RULES:
        for n_modes in plan.INFLUENCE_MODES:
            off, at_rest = (
                wavefront_error_nm(store.read(plan.influence_run(budget, alpha, n_modes)))
                for alpha in (sweep.alpha(value), Misregistration())
            )
            costs[sweep.symbol, n_modes] = added_nm(off, at_rest)
    return costs


def stability_limits(budget: Budget, store: Store, sweep: Sweep) -> dict[float, float | None]:
    """Return by gain where the loop of 594 modes becomes unstable, by the model's poles."""
    task = plan.pole_sweep(budget, sweep, plan.N_BASIS)
    record = store.read(task)
    return {gain: limit_of_stability(record, task.values, gain) for gain in plan.POLE_GAINS}


def shown_values(budget: Budget, store: Store, sweep: Sweep) -> dict[float, str]:
    """Return the values of figure 6: the paper's, and our first one after the drop."""
    own = curve(budget, store, sweep, plan.N_BASIS).first_after()
    theirs = sweep.marked[0]
    if own is None or own == theirs:
        return {theirs: "the paper's value"}
    return {theirs: "the paper's value", own: "our first after the drop"}


def amplified(budget: Budget, store: Store, sweep: Sweep, value: float) -> tuple[float, int]:
    """Return for a value how many times the turbulence the worst modes have, and which.

    The running mean over nine modes is compared, 594 modes controlled.
    """
    run = plan.influence_run(budget, sweep.alpha(value), plan.N_BASIS)
    record = store.read(run)
    mean = np.full(9, 1 / 9)
    left, came = (np.convolve(record[k], mean, "valid") for k in ("modal_nm2", "incoming_nm2"))
    ratio = left / came
    return float(ratio.max()), int(np.argmax(ratio)) + 5


# --- matrices


def singular_values(matrix: Array) -> Array:
    """Return the singular values, largest first."""
    return np.asarray(np.linalg.svd(np.asarray(matrix, dtype=np.float64), compute_uv=False))


def condition(singular: Array) -> float:
    """Return the largest over the smallest of singular values."""
    return float(singular.max() / singular.min())


def knee(singular: Array) -> int:
    """Return the number of the value farthest above the straight line from first to last.

    The logarithm is compared, as the figure shows it.
    """
    logarithm = np.log(singular)
    straight = np.linspace(logarithm[0], logarithm[-1], len(logarithm))
    return int(np.argmax(logarithm - straight)) + 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Spectra:
    """Singular values at the registration found and with 100 % of magnification."""

    synthetic: Array
    measured: tuple[Array, ...]
    """By telescope."""

    model: tuple[Array, Array]
    """The model at 98 and at 100 %."""

    clean: tuple[Array, Array]
    """The first telescope without noise at 98 and at 100 %."""

    drawn: tuple[Array, Array]
    """The noise-free telescope with the model's own mirror."""


def spectra(budget: Budget, store: Store) -> Spectra:
    """Return the singular values of figure 3."""
    fits = [store.read(plan.paper_fit(budget, seed)) for seed in budget.seeds]
    n_modes = plan.N_MEASURED
    measured = [plan.measurement(budget, seed).matrix(store) / 2 for seed in budget.seeds]

    def clean(seed: int, imperfections: str) -> tuple[Array, Array]:
        there, without = (
            store.read(plan.answer(seed, alpha, imperfections))["singular"]
            for alpha in (plan.TRUTH, plan.WITHOUT_BORDER)
        )
        return there, without

    model = [
        singular_values(synthetic_matrix(alpha)[:, :n_modes])
        for alpha in (plan.TRUTH, plan.WITHOUT_BORDER)
    ]
    alpha = fitted_alpha(fits[0])
    return Spectra(
        synthetic=singular_values(synthetic_matrix(alpha)[:, :n_modes]),
        measured=tuple(singular_values(matrix) for matrix in measured),
        model=(model[0], model[1]),
        clean=clean(budget.seeds[0], plan.USUAL),
        drawn=clean(budget.seeds[0], DRAWN),
    )


def rms(matrix: NDArray[np.floating]) -> Array:
    """Return the RMS of the slopes of each mode."""
    return np.asarray(np.sqrt(np.mean(np.asarray(matrix, dtype=np.float64) ** 2, axis=0)))


def normalised_variance(matrix: NDArray[np.floating]) -> Array:
    """Return the variance of each slope over the modes, every mode scaled to RMS 1."""
    scaled = np.asarray(matrix, dtype=np.float64) / rms(matrix)
    return np.asarray(np.mean(scaled**2, axis=1))


# --- loops


def simulator_nm(store: Store, budget: Budget, seed: int) -> tuple[float, float]:
    """Return the simulator's error with the synthetic and the measured reconstructor, nm."""
    synthetic, measured = (
        wavefront_error_nm(store.read(run)) for run in plan.simulator_pair(budget, seed)
    )
    return synthetic, measured


def around_nm(budget: Budget, store: Store, sweep: Sweep) -> dict[float, float]:
    """Return the simulator's error about the optimum, by value, ascending."""
    return {
        value: wavefront_error_nm(store.read(plan.around_run(budget, sweep, value)))
        for value in sorted(sweep.at(budget))
    }


def optimum(errors_nm: Mapping[float, float]) -> float | None:
    """Return the minimum of the parabola through the variances; None if it has none."""
    values, cost = np.array(list(errors_nm)), np.array(list(errors_nm.values())) ** 2
    bend, slope, _ = np.polyfit(values, cost, 2)
    return None if bend <= 0.0 else float(-slope / (2.0 * bend))


FLAT_NM = 1.5
"""Difference of two errors below which a sweep about the optimum is called flat."""


def best_at_zero(budget: Budget, store: Store) -> list[str]:
    """Return the parameters whose error at the registration found is the smallest or flat."""
    found = {sweep.symbol: around_nm(budget, store, sweep) for sweep in plan.AROUND}
    return [symbol for symbol, one in found.items() if one[0.0] - min(one.values()) <= FLAT_NM]


def columns_nm(record: Record, over: Over, n_modes: int | None = None) -> Array:
    """Return the three columns of Table 2, nm, over the controlled modes or the first few."""
    return np.array(
        [wavefront_error_nm(record, without_first=n, over=over, n_modes=n_modes) for n in LEFT_OUT]
    )


def more_modes_nm(budget: Budget, store: Store) -> dict[str, Array]:
    """Return what 500 modes leave less what 400 leave, true, without 50 KL, nm by telescope.

    By gains: those of the ramp, and one low gain; over the controlled modes of each loop, and over
    the first 400 of both.
    """
    runs = {"ramp": plan.variant_run, "low": plan.low_gain_run}
    found = {}
    for name, run in runs.items():
        for n_modes in (None, plan.N_MEASURED):
            few, many = (
                [
                    columns_nm(store.read(run(budget, seed, variant)), Over.CONTROLLED, n_modes)[2]
                    for seed in budget.seeds
                ]
                for variant in (Variant.SYNTHETIC, Variant.MORE)
            )
            found[f"{name}, {'same' if n_modes else 'own'}"] = np.array(many) - np.array(few)
    return found


def table_2_nm(budget: Budget, store: Store, variant: Variant, over: Over) -> Array:
    """Return the columns of a variant ``(n_telescopes, 3)``, nm."""
    runs = (plan.variant_run(budget, seed, variant) for seed in budget.seeds)
    return np.array([columns_nm(store.read(run), over) for run in runs])


def strehls(budget: Budget, store: Store, variant: Variant) -> Array:
    """Return the Strehl ratios in H, from the images, by telescope."""
    runs = (plan.variant_run(budget, seed, variant) for seed in budget.seeds)
    return np.array([strehl(store.read(run)["image"]) for run in runs])


def gains(budget: Budget, store: Store) -> list[list[float]]:
    """Return by telescope the gains of the three groups that the ramp has chosen."""
    return [
        store.read(plan.gain_tuning(budget, seed))["by_group"].tolist() for seed in budget.seeds
    ]


def is_stable(record: Record) -> bool:
    """Return whether a loop has held: nothing was clipped and its last part is like its first."""
    parts = record["total_by_part_nm2"]
    return bool(int(record["n_clipped"]) == 0 and parts[-1] < 2.0 * parts[0])


def needed_for(measured: Mapping[float, float], base_nm: float, target_nm: float) -> float | None:
    """Return the strength of a change at which the error reaches a target, interpolated.

    ``measured`` has the error by strength, ``base_nm`` the error without the change.
    """
    strengths = np.array([0.0, *measured])
    errors_nm = np.array([base_nm, *measured.values()])
    above = np.flatnonzero(errors_nm >= target_nm)
    if not len(above) or above[0] == 0:
        return None
    k = int(above[0])
    share = (target_nm - errors_nm[k - 1]) / (errors_nm[k] - errors_nm[k - 1])
    return float(strengths[k - 1] + share * (strengths[k] - strengths[k - 1]))


def fit_record(budget: Budget, store: Store, seed: int) -> tuple[FitRun, Record]:
    """Return Table 1's procedure on a telescope's measured matrix, and its result."""
    fit = plan.paper_fit(budget, seed)
    return fit, store.read(fit)


def captured_errors(budget: Budget, store: Store) -> float:
    """Return the largest shift error of joint fits that use few modes, % of a subaperture.

    Only fits that are right count.
    """
    every = plan.capture_fits(budget, Method.JOINT).values()
    records = [store.read(fit) for fits in every for fit in fits]
    found = [errors(record, plan.TRUTH) for record in records if is_right(record, plan.TRUTH)]
    return float(np.max(np.abs(found)[:, :2])) if found else float("nan")


def combined_nm(budget: Budget, store: Store) -> dict[tuple[float, float], float]:
    """Return the simulator's error by missing share of the signal and by noise, nm."""
    found = {(0.0, 0.0): simulator_nm(store, budget, budget.seeds[0])[0]}
    for strength, change in plan.combinations(budget).items():
        found[strength] = wavefront_error_nm(store.read(plan.change_run(budget, change)))
    return found


def noise_share(budget: Budget, store: Store, measurement: Measurement) -> float:
    """Return the noise of a measured matrix of the first telescope over its signal, RMS."""
    exact = plan.answer(budget.seeds[0]).matrix(store).astype(np.float64)
    error = measurement.matrix(store) - exact
    return float(np.linalg.norm(error) / np.linalg.norm(exact))


def sensitivity_ratios(budget: Budget, store: Store) -> dict[str, tuple[float, float]]:
    """Return what a misregistration adds in figure 5 and in figure 12, nm in quadrature.

    By sweep and value, where both have it; of figure 12 the mean of both signs. 400 modes.
    """
    found = {}
    for sweep, other in zip(
        plan.SWEEPS, (plan.AROUND[0], plan.AROUND[1], plan.AROUND[3]), strict=True
    ):
        own = curve(budget, store, sweep, plan.INFLUENCE_MODES[0])
        about = around_nm(budget, store, other)
        for value, error in zip(own.values, own.errors_nm, strict=True):
            if value and value in about and -value in about:
                rest = (own.errors_nm[0], about[0.0])
                pair = (error, float(np.sqrt((about[value] ** 2 + about[-value] ** 2) / 2)))
                added = [added_nm(one, base) for one, base in zip(pair, rest, strict=True)]
                found[f"{sweep.symbol} {value:g} {sweep.unit}"] = (added[0], added[1])
    return found


def added_nm(error_nm: float, base_nm: float) -> float:
    """Return what is added in quadrature, negative where the error is smaller."""
    square = error_nm**2 - base_nm**2
    return float(np.sign(square) * np.sqrt(abs(square)))
