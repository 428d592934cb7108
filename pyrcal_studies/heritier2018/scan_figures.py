"""Figures of finding the registration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import page, telescope
from pyrcal_studies.heritier2018.plan import TRUTH
from pyrcal_studies.heritier2018.registration import TOLERANCE, FitRun, errors, fitted_alpha
from pyrcal_studies.heritier2018.store import Record
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

SYMBOLS = dict(zip(PARAMETERS, ("α_x", "α_y", "α_rot", "α_magn"), strict=True))
UNITS = dict(zip(PARAMETERS, ("%", "%", "deg", "%"), strict=True))
SHOWN = np.array([100.0, 100.0, 1.0, 100.0])
"""From boundary units to those the paper shows."""


def parabolas_figure(scans: Record) -> Figure:
    """Draw χ² of every step and its parabola."""
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
    scale = SHOWN[PARAMETERS.index(name)]
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
    axes.set_title(f"step {k + 1}: {SYMBOLS[name]} [{UNITS[name]}]", fontsize="small")
    axes.tick_params(labelsize="small")
    axes.grid(alpha=0.3)


def registration_figure(joint: Record) -> Figure:
    """Draw the actuators over the subapertures."""
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


def starts_figure(found: Mapping[str, Sequence[tuple[FitRun, Record]]]) -> Figure:
    """Draw the error of fits against the distance of their starts, by method."""
    figure = page.canvas(7.5, 3.8)
    axes = figure.subplots()
    for (method, pairs), mark in zip(found.items(), "ox", strict=True):
        away = [
            _distance(errors({"alpha": run.start.vector * BOUNDARY_SCALE}, TRUTH))
            for run, _ in pairs
        ]
        left = [_distance(errors(record, TRUTH)) for _, record in pairs]
        axes.semilogy(away, left, mark, label=method, fillstyle="none")
    axes.axhline(1.0, color="0.6", linewidth=0.8)
    axes.set(xlabel="distance of the start", ylabel="error of the fit")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def _distance(error: Array) -> float:
    return float(np.max(np.abs(error) / TOLERANCE))
