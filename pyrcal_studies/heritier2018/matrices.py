"""The measured matrix beside the synthetic one, and the maps of both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import page, paper, telescope
from pyrcal_studies.heritier2018.matrix_figures import (
    gains_figure,
    maps_figure,
    spectra_figure,
    variance_figure,
)
from pyrcal_studies.heritier2018.plan import (
    ROUGH,
    TRUTH,
    WITHOUT_BORDER,
    Budget,
    Variant,
    answers,
    closed_run,
    joint_fit,
)
from pyrcal_studies.heritier2018.reconstructors import synthetic_matrix
from pyrcal_studies.heritier2018.registration import FitRun, fitted_alpha
from pyrcal_studies.heritier2018.store import Record, Store, Task
from service.model.misregistration import Misregistration

Array = NDArray[np.float64]

_NOISY_DRAWS = 3

_AS_IN_THE_PAPER = 0.05
"""Relative difference of condition numbers that needs no reason: peers differ by 2 %."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Both matrices of one telescope, as far as numbers can tell."""

    fit: FitRun

    @property
    def label(self) -> str:
        """What the progress bar shows."""
        return "measured against synthetic matrix"

    @property
    def cost_s(self) -> float:
        """Rough time on one idle core, seconds."""
        return 8.0

    @property
    def needs(self) -> tuple[Task, ...]:
        """The fit."""
        return (self.fit,)

    def compute(self, store: Store) -> Record:
        """Return singular values, slopes per mode and gains, per metre of wavefront, one pass."""
        fit = store.read(self.fit)
        measured = fit["measured"].astype(np.float64)
        synthetic = fit["synthetic"].astype(np.float64)
        before = synthetic_matrix(ROUGH)[:, : measured.shape[1]]
        left = measured - synthetic * fit["gains"]
        noise = np.sqrt(np.mean(left**2, axis=0))
        return {
            "singular_measured": singular_values(measured),
            "singular_synthetic": singular_values(synthetic),
            "singular_tuned": singular_values(synthetic * fit["gains"]),
            "singular_noisy": noisy_singular_values(synthetic * fit["gains"], noise),
            "singular_registered": singular_values(
                synthetic_matrix(Misregistration())[:, : measured.shape[1]]
            ),
            **{
                f"singular_without_{name}": singular_values(
                    synthetic_matrix(alpha)[:, : measured.shape[1]]
                )
                for name, alpha in _without_one(fitted_alpha(fit)).items()
            },
            "rms_measured": np.sqrt(np.mean(measured**2, axis=0)),
            "rms_synthetic": np.sqrt(np.mean(synthetic**2, axis=0)),
            "rms_left": noise,
            "gains_before": column_gains(measured, before),
            "gains_after": column_gains(measured, synthetic),
            "correlation_before": correlations(measured, before),
            "correlation_after": correlations(measured, synthetic),
        }


def _without_one(alpha: Misregistration) -> dict[str, Misregistration]:
    """Return the registration with its shift, its rotation, its magnification taken away."""
    return {
        "shift": replace(alpha, shift_x_subap=0.0, shift_y_subap=0.0),
        "rotation": replace(alpha, rotation_rad=0.0),
        "magnification": replace(alpha, magnification=1.0),
    }


def comparison(budget: Budget) -> Comparison:
    """Return the comparison on the first telescope."""
    return Comparison(fit=joint_fit(budget, budget.seeds[0]))


def singular_values(matrix: Array) -> Array:
    """Return the singular values, largest first."""
    return np.asarray(np.linalg.svd(matrix, compute_uv=False))


def noisy_singular_values(matrix: Array, noise: Array) -> Array:
    """Return those of the matrix with white noise of this RMS in each column, draws averaged."""
    rng = np.random.default_rng(0)
    draws = [
        singular_values(matrix + noise * rng.standard_normal(matrix.shape))
        for _ in range(_NOISY_DRAWS)
    ]
    return np.asarray(np.mean(draws, axis=0))


def column_gains(measured: Array, synthetic: Array) -> Array:
    """Return the gain of each column that explains the measured one best, ``(n_modes,)``."""
    return np.asarray((measured * synthetic).sum(axis=0) / (synthetic**2).sum(axis=0))


def correlations(measured: Array, synthetic: Array) -> Array:
    """Return the cosine between the columns of both, ``(n_modes,)``."""
    norms = np.linalg.norm(measured, axis=0) * np.linalg.norm(synthetic, axis=0)
    return np.asarray((measured * synthetic).sum(axis=0) / norms)


def condition(singular: Array) -> float:
    """Return the largest over the smallest of singular values."""
    return float(singular.max() / singular.min())


def section(budget: Budget, store: Store) -> page.Section:
    """Return the section on the matrices."""
    task = comparison(budget)
    record, fit = store.read(task), store.read(task.fit)
    n_frames = task.fit.measurement.n_frames
    body = page.paragraph(
        f"The measured matrix: {task.fit.measurement.n_modes} modes pushed and pulled "
        f"{budget.n_average} times each with 20 nm RMS on the mirror, seen twice, by the light of "
        f"a fibre of magnitude 7 in a shaking dome: {n_frames} frames. The synthetic one is the "
        "model at the registration that the joint fit finds in it."
    )
    body += page.picture(
        spectra_figure(record),
        f"Singular values and RMS of the slopes by mode. {n_frames} frames of measurement.",
    )
    body += _condition_table(budget, store) + condition_remark(record)
    body += page.heading("What the border does to the condition number")
    body += _border_table(budget, store) + _border_remark(budget, store)
    body += page.picture(
        gains_figure(record),
        "Modal gains, measured over synthetic, before tuning (model at the start of the scans, "
        "64.5 deg and nothing else) and after (at the registration found).",
    )
    body += _gains_remark(record)
    body += page.picture(
        maps_figure(fit),
        "Slopes along x of nine modes: synthetic with its gain, measured, and their difference, "
        "all three on the scale of the measured map.",
    )
    body += page.picture(
        variance_figure(fit),
        f"Variance of the slopes over the {len(fit['gains'])} modes, each mode scaled to RMS 1: "
        "synthetic, measured, and the difference of the matrices.",
    )
    return page.Section(anchor="matrices", title="Measured and synthetic matrix", body=body)


def condition_remark(record: Record) -> str:
    """Return how the condition numbers compare with the paper's, and why they differ."""
    measured = condition(record["singular_measured"])
    synthetic = condition(record["singular_synthetic"])
    tuned, noisy = condition(record["singular_tuned"]), condition(record["singular_noisy"])
    excess, quoted = measured / synthetic, _quoted_excess()
    text = (
        f"Measured over synthetic: {excess:.3f} here, {quoted:.3f} in the paper. "
        f"Giving the synthetic columns the measured gains makes {synthetic:.2f} into {tuned:.2f}; "
        f"adding white noise of the size of the residuals makes that {noisy:.2f}. "
    )
    explained = abs(noisy - measured) < 0.5 * abs(synthetic - measured) + 0.02 * measured
    text += (
        "Gains and noise together account for most of the difference. "
        if explained
        else "That does not account for all of it: the rest of the difference is in the structure "
        "of the residuals (uneven light, displaced actuators, other influence functions). "
    )
    away = abs(synthetic / paper.CONDITION_SYNTHETIC.values[0] - 1.0)
    text += f"The synthetic one is {away:.0%} from the paper's {paper.CONDITION_SYNTHETIC.text}. "
    if away > _AS_IN_THE_PAPER:
        text += _why_another_condition(record)
    return page.remark(text, agrees=away <= _AS_IN_THE_PAPER and explained)


def _why_another_condition(record: Record) -> str:
    """Return what of the registration has to do with it, by the model without one part of it."""
    synthetic = condition(record["singular_synthetic"])
    registered = condition(record["singular_registered"])
    without = {
        name: condition(record[f"singular_without_{name}"])
        for name in ("shift", "rotation", "magnification")
    }
    listed = ", ".join(f"{value:.2f} without the {name}" for name, value in without.items())
    text = f"The same model has {registered:.2f} when registered perfectly, {listed}. "
    name = min(without, key=lambda part: without[part])
    quoted = paper.CONDITION_SYNTHETIC.values[0]
    if abs(without[name] - quoted) < 0.5 * abs(synthetic - quoted):
        return text + f"So it is the {name} that makes it larger than the paper's. {_effect(name)}"
    return text + (
        "No single part of the registration makes it; the model's KL modes are those of a "
        "thin-plate mirror with unit RMS, not those of the real shell."
    )


def _effect(name: str) -> str:
    """Return what this part of a registration does to the modes that are seen worst."""
    match name:
        case "shift":
            return (
                "The mask of valid subapertures is that of the unshifted pupil here, so part of "
                "the border is dark; at the telescope it is drawn where the light is."
            )
        case "rotation":
            return "The mirror's rings then lie otherwise on the square subapertures."
        case _:
            found, nominal = (
                telescope.beyond_actuators_subap(m) for m in (TRUTH.magnification, 1.0)
            )
            return (
                "The outline keeps its size while the mirror's image shrinks: the pupil reaches "
                f"{found:.2f} subaperture beyond the outermost actuators ({nominal:.2f} nominally),"
                " and the surface there is an extrapolation, in the paper's model another one."
            )


def _quoted_excess() -> float:
    return paper.CONDITION_MEASURED.values[0] / paper.CONDITION_SYNTHETIC.values[0]


def _condition_table(budget: Budget, store: Store) -> str:
    rows = []
    for variant, quoted in (
        (Variant.SYNTHETIC, paper.CONDITION_SYNTHETIC),
        (Variant.MEASURED, paper.CONDITION_MEASURED),
    ):
        runs = (closed_run(budget, seed, variant, vibrations=False) for seed in budget.seeds)
        found = [float(store.read(run.reconstructor)["condition_number"]) for run in runs]
        rows.append([str(variant), " / ".join(f"{value:.2f}" for value in found), quoted.text])
    return page.table(["condition number, 400 modes", "here, by telescope", "paper"], rows)


def _border_conditions(budget: Budget, store: Store) -> dict[str, tuple[float, float]]:
    """Return condition numbers at the found magnification and at 100 %, free of noise."""
    there, without = (answers(budget, alpha) for alpha in (TRUTH, WITHOUT_BORDER))
    found = {
        name: (
            condition(store.read(there[name])["singular"]),
            condition(store.read(other)["singular"]),
        )
        for name, other in without.items()
    }
    record = store.read(comparison(budget))
    model = tuple(
        condition(record[f"singular_{name}"]) for name in ("synthetic", "without_magnification")
    )
    return {"the model": (model[0], model[1]), **found}


def _border_table(budget: Budget, store: Store) -> str:
    found, nominal = (telescope.beyond_actuators_subap(m) for m in (TRUTH.magnification, 1.0))
    head = ["what is not as it is drawn", f"98 %: {found:.2f} subap. beyond the actuators"]
    head += [f"100 %: {nominal:.2f} subap."]
    rows = [
        [name, *(f"{value:.2f}" for value in values)]
        for name, values in _border_conditions(budget, store).items()
    ]
    return page.paragraph(
        "Telescopes pushed by 1 nm, without noise, where the paper's lay and with the pupil ending "
        "where the actuators do. Drawn: the mirror has the model's influence functions; its own: a "
        "plate under tension, which goes on otherwise beyond the outermost actuators."
    ) + page.table(head, rows)


def _border_remark(budget: Budget, store: Store) -> str:
    """Return what decides whether the synthetic or the measured condition number is larger."""
    found = _border_conditions(budget, store)
    model = np.array(found["the model"])
    drawn, own = (
        np.array([values for name, values in found.items() if name.startswith(word)])
        for word in ("light", "all")
    )
    text, excess = "", _quoted_excess() - 1.0
    for k, where in enumerate(("at 98 %", "at 100 %")):
        text += (
            f"{where.capitalize()} the model has {model[k]:.2f}, telescopes with its influence "
            f"functions {drawn[:, k].mean():.2f} on average ({int(np.sum(drawn[:, k] > model[k]))} "
            f"of {len(drawn)} larger, as in the paper), with their own {own[:, k].mean():.2f} "
            f"({int(np.sum(own[:, k] > model[k]))} of {len(own)}). "
        )
    border = abs((drawn - own).mean(axis=0))
    systematic = bool(border[0] > 2.0 * abs(drawn[:, 0].mean() - model[0]))
    text += (
        "So the order is reversed here by how the mirror goes on beyond its actuators, where model "
        f"and telescope differ by {border[0]:.1f} at 98 % and by {border[1]:.1f} at 100 %. "
        if systematic
        else "So it is not the mirror beyond its actuators alone that reverses the order here. "
    )
    if len(drawn) > 1:
        scatter = float(drawn[:, 0].std(ddof=1) / drawn[:, 0].mean())
        text += (
            f"Light and actuators alone scatter it by {scatter:.0%} between telescopes; the "
            f"paper's two differ by {excess:.0%}."
        )
    return page.remark(text, agrees=systematic)


def _gains_remark(record: Record) -> str:
    before, after = record["gains_before"], record["gains_after"]
    return page.paragraph(
        f"Before tuning the gains are {before.mean():.2f} ± {before.std():.2f} (mean and scatter "
        f"over modes), correlation of a column with the measured one "
        f"{record['correlation_before'].mean():.2f} on average; after it {after.mean():.3f} ± "
        f"{after.std():.3f}, correlation {record['correlation_after'].mean():.4f}. What is left of "
        "1 is the pyramid's response to finite strokes, the other shape of the influence functions "
        "(it grows with the mode) and noise. The factor of two of the double pass is taken out "
        "beforehand and is not a gain."
    )
