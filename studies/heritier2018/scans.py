"""Table 1 of the paper, its scans from anywhere, and the joint fit beside them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.registration.options import Method
from service.registration.paper import N_LEFT_OUT
from studies.heritier2018 import page, paper, telescope
from studies.heritier2018.plan import (
    N_MEASURED,
    ROUGH,
    TRUTH,
    Budget,
    fits_from_random_starts,
    joint_fit,
    paper_fit,
)
from studies.heritier2018.registration import TOLERANCE, errors, fitted_alpha, is_right
from studies.heritier2018.store import Record, Store

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_SYMBOLS = dict(zip(PARAMETERS, ("α_x", "α_y", "α_rot", "α_magn"), strict=True))
_UNITS = dict(zip(PARAMETERS, ("%", "%", "deg", "%"), strict=True))
_SHOWN = np.array([100.0, 100.0, 1.0, 100.0])
"""From boundary units to those the paper shows."""

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
            _parabolas_figure(scans),
            "χ² at every step of the scans over the largest in it, the parabola through the lowest "
            "three, and its minimum.",
        )
    body += page.heading("What was found")
    body += _found_table(budget, store) + _found_remark(budget, store)
    body += page.picture(
        _registration_figure(joint),
        "Registration found by the joint fit: actuators of the mirror (dots) over the valid "
        "subapertures of the sensor (squares).",
    )
    body += page.heading(f"From {budget.n_starts} random starts")
    body += page.paragraph(
        "Starts uniform within ±1.5 subapertures, ±6 deg and ±5 % of the truth. A fit is right "
        "within 5 % of a subaperture, 0.3 deg and 0.5 %; seconds are of one core."
    )
    body += _starts_table(budget, store) + _starts_remark(budget, store)
    body += page.picture(
        _starts_figure(budget, store),
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
    truth = TRUTH.vector * BOUNDARY_SCALE * _SHOWN
    rows = []
    for k, name in enumerate(str(step) for step in scans["steps"]):
        j = PARAMETERS.index(name)
        chi = scans[f"chi_{k}"]
        rows.append(
            [
                str(k + 1),
                _SYMBOLS[name],
                f"{scans['step_sizes'][k] * _SHOWN[j]:g} {_UNITS[name]}",
                str(len(chi)),
                f"{scans['minima'][k] * _SHOWN[j]:.2f} {_UNITS[name]}",
                f"{truth[j]:.2f} {_UNITS[name]}",
                f"{np.sqrt(chi.min() / at_start):.4f}",
            ]
        )
    return page.table(head, rows, words=(1,))


def _parabolas_figure(scans: Record) -> Figure:
    n_steps = len(scans["steps"])
    columns = 4
    n_rows = int(np.ceil(n_steps / columns))
    figure = page.canvas(10.5, 2.3 * n_rows)
    panels = figure.subplots(n_rows, columns, squeeze=False).reshape(-1)
    for k, axes in enumerate(panels):
        if k < n_steps:
            _parabola(axes, scans, k)
        else:
            axes.set_axis_off()
    return figure


def _parabola(axes: Axes, scans: Record, k: int) -> None:
    name = str(scans["steps"][k])
    scale = _SHOWN[PARAMETERS.index(name)]
    samples, chi = scans[f"samples_{k}"] * scale, scans[f"chi_{k}"]
    largest = float(chi.max())
    axes.plot(samples, chi / largest, "o", markersize=3.5)
    best = int(np.clip(np.argmin(chi), 1, len(chi) - 2))
    near = slice(best - 1, best + 2)
    parabola = np.polyfit(samples[near], chi[near] / largest, 2)
    fine = np.linspace(samples.min(), samples.max(), 100)
    axes.plot(fine, np.polyval(parabola, fine), linewidth=0.8, color="0.5")
    minimum = float(scans["minima"][k]) * scale
    axes.plot(minimum, np.polyval(parabola, minimum), "x", color="#b3261e")
    axes.set_ylim(-0.05, 1.1)
    axes.set_title(f"step {k + 1}: {_SYMBOLS[name]} [{_UNITS[name]}]", fontsize="small")
    axes.tick_params(labelsize="small")
    axes.grid(alpha=0.3)


def _found_table(budget: Budget, store: Store) -> str:
    head = ["", *(f"{_SYMBOLS[name]} [{_UNITS[name]}]" for name in PARAMETERS), "evaluations", "s"]
    rows = [
        ["the paper, at the telescope", *(paper.REGISTRATION[n].text for n in PARAMETERS), "", ""],
        ["hidden truth here", *_numbers(TRUTH.vector * BOUNDARY_SCALE * _SHOWN, 2), "", ""],
    ]
    for seed in budget.seeds:
        for name, run in (("joint", joint_fit(budget, seed)), ("scans", paper_fit(budget, seed))):
            record = store.read(run)
            rows.append(
                [
                    f"{name}, telescope {seed}: error",
                    *_numbers(errors(record, TRUTH), 3, signed=True),
                    str(int(record["n_evaluations"])),
                    f"{float(record['seconds']):.1f}",
                ]
            )
            rows.append(["its 1 σ", *_numbers(record["sigma"] * _SHOWN, 3), "", ""])
    return page.table(head, rows)


def _numbers(values: Array, digits: int, *, signed: bool = False) -> list[str]:
    sign = "+" if signed else ""
    return [f"{value:{sign}.{digits}f}" for value in values]


def _found_remark(budget: Budget, store: Store) -> str:
    """Return what the fits say of themselves, and how the scans' error compares."""
    records = [store.read(joint_fit(budget, seed)) for seed in budget.seeds]
    worst = np.max([np.abs(errors(record, TRUTH)) for record in records], axis=0)
    text = (
        f"Joint fit: within {max(worst[:2]):.2f} % of a subaperture, {worst[2]:.4f} deg and "
        f"{worst[3]:.3f} % of magnification. "
    )
    pulls = [errors(record, TRUTH) / (record["sigma"] * _SHOWN) for record in records]
    largest = float(np.max(np.abs(pulls)))
    text += f"The largest error is {largest:.1f} of its own σ"
    text += (
        ", as it should be of so few. "
        if largest < _MOST_SIGMAS
        else ": more than it says of itself. σ covers noise and the disagreement of sets of modes; "
        "light uneven by 10 % and displaced actuators shift all sets alike. "
    )
    for seed, record in zip(budget.seeds, records, strict=True):
        text += f"Telescope {seed}: {record['verdict']}. "
    good = all(bool(record["accepted"]) for record in records) and largest < _MOST_SIGMAS
    return page.remark(text, agrees=good)


def _registration_figure(joint: Record) -> Figure:
    alpha = fitted_alpha(joint)
    points = telescope.actuators_subap()
    angle = alpha.rotation_rad
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    placed = alpha.magnification * points @ turn.T + alpha.vector[:2]
    valid = joint["valid"]
    row, column = np.nonzero(valid)
    centre = (len(valid) - 1) / 2
    figure = page.canvas(5.6, 5.6)
    axes = figure.subplots()
    axes.plot(column - centre, row - centre, "s", markersize=7, color="#d7e3f4")
    axes.plot(*placed.T, ".", markersize=4, color="#b3261e")
    x_axis = alpha.magnification * turn @ np.array([15.0, 0.0])
    axes.annotate(
        "",
        xy=tuple(alpha.vector[:2] + x_axis),
        xytext=tuple(alpha.vector[:2]),
        arrowprops={"arrowstyle": "->", "color": "#b3261e"},
    )
    axes.set(xlabel="x [subapertures]", ylabel="y [subapertures]", aspect="equal")
    return figure


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
            typical = " / ".join(_numbers(median, 3))
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


def _starts_figure(budget: Budget, store: Store) -> Figure:
    figure = page.canvas(7.5, 3.8)
    axes = figure.subplots()
    for method, mark in ((Method.JOINT, "o"), (Method.PAPER, "x")):
        runs = fits_from_random_starts(budget, method)
        away = [
            _distance(errors({"alpha": run.start.vector * BOUNDARY_SCALE}, TRUTH)) for run in runs
        ]
        left = [_distance(errors(store.read(run), TRUTH)) for run in runs]
        axes.loglog(away, left, mark, label=str(method), fillstyle="none")
    axes.axhline(1.0, color="0.6", linewidth=0.8)
    axes.set(xlabel="distance of the start", ylabel="error of the fit")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def _distance(error: Array) -> float:
    return float(np.max(np.abs(error) / TOLERANCE))
