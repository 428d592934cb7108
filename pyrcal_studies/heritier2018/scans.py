"""Table 1 of the paper, its scans from anywhere, and the joint fit beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.methods import N_LEFT_OUT
from pyrcal_studies.heritier2018 import page, paper, telescope
from pyrcal_studies.heritier2018.plan import (
    IDEAL,
    N_MEASURED,
    REALISTIC,
    ROUGH,
    TRUTH,
    Budget,
    fits_from_random_starts,
    joint_fit,
    paper_fit,
)
from pyrcal_studies.heritier2018.registration import FitRun, errors, is_right
from pyrcal_studies.heritier2018.scan_figures import (
    SHOWN,
    SYMBOLS,
    UNITS,
    parabolas_figure,
    registration_figure,
    starts_figure,
)
from pyrcal_studies.heritier2018.store import Record, Store
from service.model.kinds import Method
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS

Array = NDArray[np.float64]

_OTHERS = (IDEAL, REALISTIC)
"""Telescopes nearer to the drawing and farther from it; the others are the usual one."""

_MOST_SIGMAS = 3.0
"""The largest of a dozen errors that σ should allow: one in thirty runs has a larger one."""


def section(budget: Budget, store: Store) -> page.Section:
    """Return the section on finding the registration."""
    seed = budget.seeds[0]
    scans, joint = store.read(paper_fit(budget, seed)), store.read(joint_fit(budget, seed))
    body = page.paragraph(
        f"One parameter at a time is scanned about the last minimum, beginning at rotation "
        f"{ROUGH.to_boundary()['rotation_deg']:g} deg, no shift, magnification 100 %, as tip and "
        "tilt alone tell it. χ² sums the squared difference of measured and synthetic slopes over "
        f"modes {N_LEFT_OUT + 1} to {N_MEASURED}, each with a gain of its own; what vibrates is "
        "left out. These are the scans of pyrcal fit --method paper: order and parabolas are the "
        "paper's, the step sizes are pyrcal's, a scan whose lowest sample is its last is carried "
        "on. Matrix of the first telescope, "
        f"{joint_fit(budget, seed).measurement.n_frames} frames."
    )
    body += page.heading("Table 1, step by step")
    body += _steps_table(scans)
    if len(scans["steps"]):
        body += page.picture(
            parabolas_figure(scans),
            "χ² at every step of the scans over the largest in it, the parabola through the lowest "
            "three, and its minimum.",
        )
    body += page.heading("What was found")
    body += _found_table(budget, store) + _found_remark(budget, store)
    body += page.picture(
        registration_figure(joint),
        "Registration found by the joint fit: actuators of the mirror (dots) over the valid "
        "subapertures of the sensor (squares); the arrow is the mirror's x axis.",
    )
    body += page.heading(f"From {budget.n_starts} random starts")
    body += page.paragraph(
        "Starts uniform within ±1.5 subapertures, ±6 deg and ±5 % of the truth. A fit is right "
        "within 5 % of a subaperture, 0.3 deg and 0.5 %; seconds are of one core."
    )
    body += _starts_table(budget, store) + _starts_remark(budget, store)
    body += page.picture(
        starts_figure(_by_method(budget, store)),
        "Error of the fits from the random starts against the distance of the start; 1 on either "
        "axis is 5 % of a subaperture, 0.3 deg or 0.5 %, whichever is worst.",
    )
    return page.Section(anchor="registration", title="Finding the registration", body=body)


def _steps_table(scans: Record) -> str:
    head = [
        "step",
        "parameter",
        "step size",
        "samples",
        "minimum",
        "truth",
        "χ over that at the start",
    ]
    at_start = float(scans["chi_0"][len(scans["chi_0"]) // 2]) if len(scans["steps"]) else 1.0
    truth = TRUTH.vector * BOUNDARY_SCALE * SHOWN
    rows = []
    for k, name in enumerate(str(step) for step in scans["steps"]):
        j = PARAMETERS.index(name)
        chi = scans[f"chi_{k}"]
        rows.append(
            [
                str(k + 1),
                SYMBOLS[name],
                f"{scans['step_sizes'][k] * SHOWN[j]:g} {UNITS[name]}",
                str(len(chi)),
                f"{scans['minima'][k] * SHOWN[j]:.2f} {UNITS[name]}",
                f"{truth[j]:.2f} {UNITS[name]}",
                f"{np.sqrt(chi.min() / at_start):.4f}",
            ]
        )
    return page.table(head, rows, words=(1,))


def _found_table(budget: Budget, store: Store) -> str:
    head = ["", *(f"{SYMBOLS[name]} [{UNITS[name]}]" for name in PARAMETERS), "evaluations", "s"]
    rows = [
        ["the paper, at the telescope", *(paper.REGISTRATION[n].text for n in PARAMETERS), "", ""],
        ["hidden truth here", *_numbers(TRUTH.vector * BOUNDARY_SCALE * SHOWN), "", ""],
    ]
    for name, run in _fits(budget):
        record = store.read(run)
        rows.append(
            [
                f"{name}: error",
                *_numbers(errors(record, TRUTH), signed=True),
                str(int(record["n_evaluations"])),
                f"{float(record['seconds']):.1f}",
            ]
        )
        rows.append(["its 1 σ", *_numbers(record["sigma"] * SHOWN), "", ""])
    return page.table(head, rows)


def _fits(budget: Budget) -> list[tuple[str, FitRun]]:
    fits = []
    for seed in budget.seeds:
        fits.append((f"joint, telescope {seed}", joint_fit(budget, seed)))
        fits.append((f"scans, telescope {seed}", paper_fit(budget, seed)))
    first = budget.seeds[0]
    others = [(f"joint, {name} telescope", joint_fit(budget, first, name)) for name in _OTHERS]
    return fits + others


def _numbers(values: Array, *, signed: bool = False) -> list[str]:
    sign = "+" if signed else ""
    return [f"{value:{sign}.{n}f}" for value, n in zip(values, (3, 3, 4, 3), strict=True)]


def _found_remark(budget: Budget, store: Store) -> str:
    """Return what the fits say of themselves, and how the scans' error compares."""
    records = [store.read(joint_fit(budget, seed)) for seed in budget.seeds]
    worst = np.max([np.abs(errors(record, TRUTH)) for record in records], axis=0)
    text = (
        f"Joint fit: within {max(worst[:2]):.2f} % of a subaperture, {worst[2]:.4f} deg and "
        f"{worst[3]:.3f} % of magnification. "
    )
    ideal, realistic = (store.read(joint_fit(budget, budget.seeds[0], o)) for o in _OTHERS)
    largest = max(_largest_pull(record) for record in (*records, ideal, realistic))
    text += f"The largest error of all these telescopes is {largest:.1f} of its own σ"
    if largest < _MOST_SIGMAS:
        text += ", as it should be of so few. "
    else:
        text += ": more than it says of itself. " + pull_reason(_largest_pull(ideal))
    for seed, record in zip(budget.seeds, records, strict=True):
        text += f"Telescope {seed}: {record['verdict']}. "
    good = all(bool(record["accepted"]) for record in records) and largest < _MOST_SIGMAS
    return page.remark(text, agrees=good)


def _largest_pull(record: Record) -> float:
    return float(np.max(np.abs(errors(record, TRUTH) / (record["sigma"] * SHOWN))))


def pull_reason(ideal: float) -> str:
    """Return why errors exceed their σ, by the largest pull of a telescope as it is drawn."""
    if ideal < _MOST_SIGMAS:
        return (
            f"On the ideal telescope it is {ideal:.1f}: it is the uneven light and the displaced "
            "actuators of the others, which shift every set of modes alike, that σ does not know. "
        )
    return (
        f"On the ideal telescope it is {ideal:.1f}: what σ does not know is in the model rather "
        "than in the telescope's imperfections. At this magnification the pupil reaches "
        f"{telescope.beyond_actuators_subap(TRUTH.magnification):.2f} subaperture beyond the "
        "outermost actuators, where simulator and model extrapolate the mirror differently. "
    )


def _starts_table(budget: Budget, store: Store) -> str:
    head = ["method", "right", "refused", "accepted but wrong", "evaluations", "seconds"]
    head.append("median error x, y [%], rot [deg], magn [%]")
    rows = []
    for method in (Method.JOINT, Method.PAPER):
        records = [store.read(run) for run in fits_from_random_starts(budget, method)]
        right = [record for record in records if is_right(record, TRUTH)]
        accepted = [bool(record["accepted"]) for record in records]
        wrong = sum(a and not is_right(r, TRUTH) for a, r in zip(accepted, records, strict=True))
        typical = "none right"
        if right:
            median = np.median([np.abs(errors(record, TRUTH)) for record in right], axis=0)
            typical = " / ".join(_numbers(median))
        rows.append(
            [
                str(method),
                f"{len(right)} of {len(records)}",
                str(len(records) - sum(accepted)),
                str(wrong),
                f"{np.median([int(r['n_evaluations']) for r in records]):.0f}",
                f"{np.median([float(r['seconds']) for r in records]):.1f}",
                typical,
            ]
        )
    return page.table(head, rows)


def _by_method(budget: Budget, store: Store) -> dict[str, list[tuple[FitRun, Record]]]:
    return {
        str(method): [(run, store.read(run)) for run in fits_from_random_starts(budget, method)]
        for method in (Method.JOINT, Method.PAPER)
    }


def _starts_remark(budget: Budget, store: Store) -> str:
    joint, scans = (
        [store.read(run) for run in fits_from_random_starts(budget, method)]
        for method in (Method.JOINT, Method.PAPER)
    )
    n_joint, n_scans = (sum(is_right(r, TRUTH) for r in found) for found in (joint, scans))
    cost = [np.median([int(r["n_evaluations"]) for r in found]) for found in (joint, scans)]
    text = f"The joint fit is right from {n_joint} of {len(joint)} starts, the scans from {n_scans}"
    if cost[0] > 0:
        text += f", with {cost[1] / cost[0]:.1f} times as many model evaluations"
    text += ". "
    if n_scans < len(scans):
        text += (
            "One parameter at a time, a scan takes the minimum along its own line; far from the "
            "truth that is not the way to the common minimum. The paper began 0.6 deg away and "
            "had no need of more."
        )
    else:
        text += "From anywhere in this range the scans, too, arrive."
    return page.paragraph(text)
