"""The paper's method as it shows it: a parabola for each step of its Table 1."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from service.fit.options import ScanStep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

ACROSS = 5


def n_rows(steps: tuple[ScanStep, ...]) -> int:
    """Return how many rows of scans there are to draw."""
    return math.ceil(len(steps) / ACROSS)


def scans(figure: SubFigure, steps: tuple[ScanStep, ...]) -> None:
    """Draw χ² over the samples of every step, with the parabola through them."""
    grid = figure.subplots(n_rows(steps), ACROSS, squeeze=False).ravel()
    for number, (axes, scan) in enumerate(zip(grid, steps, strict=False), start=1):
        _scan(axes, scan, number)
    for axes in grid[len(steps) :]:
        axes.set_axis_off()


def _scan(axes: Axes, scan: ScanStep, number: int) -> None:
    axes.plot(scan.samples, scan.chi, "o", color="tab:red", markersize=3.0)
    if len(scan.samples) >= 3:
        middle = scan.samples.mean()
        parabola = np.polynomial.Polynomial.fit(scan.samples - middle, scan.chi, 2)
        fine = np.linspace(scan.samples.min(), scan.samples.max(), 50)
        axes.plot(fine, parabola(fine - middle), color="tab:blue", linewidth=1.0)
    axes.axvline(scan.minimum, color="0.5", linewidth=0.8)
    axes.set_title(
        f"{number}: {scan.parameter} by {scan.step:g}, {scan.minimum:.4f}", fontsize="small"
    )
    axes.tick_params(labelsize="x-small")
