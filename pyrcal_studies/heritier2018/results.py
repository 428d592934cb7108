"""Numbers of the page, computed from the steps that were run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import plan
from pyrcal_studies.heritier2018.calibration import Answer, Measurement
from pyrcal_studies.heritier2018.loops import Over, wavefront_error_nm
from pyrcal_studies.heritier2018.plan import Budget, Sweep, Variant
from pyrcal_studies.heritier2018.poles import limit_of_stability
from pyrcal_studies.heritier2018.psf import strehl
from pyrcal_studies.heritier2018.reconstructors import synthetic_matrix
from pyrcal_studies.heritier2018.registration import FitRun, Repeat, errors, fitted_alpha, is_right
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
    """Return the errors of the joint fit to the measured matrices."""
    return {
        f"noisy, telescope {seed}": errors(store.read(plan.joint_fit(budget, seed)), plan.TRUTH)
        for seed in budget.seeds
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


def repeated(budget: Budget, store: Store) -> tuple[Array, Array]:
    """Return by how much steps 7 to 10 once more change α, and the errors after them."""
    fit, record = fit_record(budget, store, budget.seeds[0])
    again = store.read(Repeat(fit=fit))["alpha"]
    change = np.abs(again - record["alpha"]) * SHOWN
    return np.asarray(change), errors({"alpha": again}, plan.TRUTH)


def captured(budget: Budget, store: Store, method: Method) -> dict[float, tuple[int, int]]:
    """Return by distance of the starts how many fits were right, and how many there were."""
    return {
        distance: (sum(is_right(store.read(fit), plan.TRUTH) for fit in fits), len(fits))
        for distance, fits in plan.capture_fits(budget, method).items()
    }


def evaluations(budget: Budget, store: Store) -> tuple[float, float]:
    """Return the mean number of model matrices of Table 1's procedure and of the joint fit."""
    scans, joint = (
        np.mean([int(store.read(fit(budget, seed))["n_evaluations"]) for seed in budget.seeds])
        for fit in (plan.paper_fit, plan.joint_fit)
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
    """Return what 0.1 deg and 10 % add to the wavefront error, nm, by sweep and modes."""
    costs = {}
    for sweep, value in plan.RULES:
        for n_modes in plan.INFLUENCE_MODES:
            off, at_rest = (
                wavefront_error_nm(store.read(plan.influence_run(budget, alpha, n_modes)))
                for alpha in (sweep.alpha(value), Misregistration())
            )
            costs[sweep.symbol, n_modes] = off - at_rest
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


def share_of_last_third(budget: Budget, store: Store, sweep: Sweep, value: float) -> float:
    """Return the share of the added variance that the last third of 594 modes has."""
    rest, off = (
        store.read(plan.influence_run(budget, alpha, plan.N_BASIS))["modal_nm2"]
        for alpha in (Misregistration(), sweep.alpha(value))
    )
    extra = off - rest
    return float(extra[2 * len(extra) // 3 :].sum() / extra.sum())


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


def slope_maps(slopes: NDArray[np.floating], valid: NDArray[np.bool_]) -> Array:
    """Return the map of x slopes beside that of y slopes ``(n, 2 n)``, NaN outside the mask."""
    maps = np.full((2, *valid.shape), np.nan)
    maps[:, valid] = slopes.reshape(2, -1)
    return np.hstack(list(maps))


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


def columns_nm(record: Record, over: Over) -> Array:
    """Return the three columns of Table 2, nm."""
    return np.array([wavefront_error_nm(record, without_first=n, over=over) for n in LEFT_OUT])


def table_2_nm(budget: Budget, store: Store, variant: Variant, over: Over) -> Array:
    """Return the columns of a variant ``(n_telescopes, 3)``, nm."""
    runs = (plan.closed_run(budget, seed, variant) for seed in budget.seeds)
    return np.array([columns_nm(store.read(run), over) for run in runs])


def trial_nm(budget: Budget, store: Store, name: str, over: Over) -> Array:
    """Return the columns of one of the trials, nm."""
    return columns_nm(store.read(plan.trials(budget)[name]), over)


def strehls(budget: Budget, store: Store, variant: Variant) -> Array:
    """Return the Strehl ratios in H, from the images, by telescope."""
    runs = (plan.closed_run(budget, seed, variant) for seed in budget.seeds)
    return np.array([strehl(store.read(run)["image"]) for run in runs])


def gains(budget: Budget, store: Store) -> list[list[float]]:
    """Return by telescope the gains of the three groups that the ramp has chosen."""
    return [
        store.read(plan.gain_tuning(budget, seed))["by_group"].tolist() for seed in budget.seeds
    ]


def tuned_errors(budget: Budget, store: Store) -> Array:
    """Return errors after steps 7 to 10 with the measured columns divided by their gains."""
    fit, _ = fit_record(budget, store, budget.seeds[0])
    return errors({"alpha": store.read(Repeat(fit=fit))["alpha_tuned"]}, plan.TRUTH)


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
    fits = [fit for some in plan.capture_fits(budget, Method.JOINT).values() for fit in some]
    records = [store.read(fit) for fit in fits]
    found = [errors(record, plan.TRUTH) for record in records if is_right(record, plan.TRUTH)]
    return float(np.max(np.abs(found)[:, :2])) if found else float("nan")


def uneven_errors(budget: Budget, store: Store) -> str:
    """Return what uneven light alone does to Table 1's procedure, in words."""
    if budget.name != "full":
        return ""
    texts = []
    for unevenness in plan.UNEVEN:
        fit = plan.fit_of(budget, plan.uneven_source(budget, unevenness))
        off = np.abs(errors(store.read(fit), plan.TRUTH))
        texts.append(f"{max(off[:2]):.2f} % for {unevenness:.0%}")
    return (
        "Table 1's procedure, whose model is lit evenly, is off in uneven light without noise by "
        + " and ".join(texts)
        + "."
    )


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
