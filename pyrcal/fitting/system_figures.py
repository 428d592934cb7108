"""Figures of a system: footprints of the stars on the mirrors, and offsets from nominal."""

from __future__ import annotations

from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pyrcal.fitting.figures import new_figure, save_figure
from pyrcal.fitting.system_report import SystemReport
from service.model.instrument import Mirror
from service.model.misregistration import PARAMETERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ACROSS = 3
_SIDE = 5.0
"""Number of panels in a row, and size of one, inches."""


def write_system_sheet(report: SystemReport, path: Path) -> None:
    """Write the figures as an image in the format of the file's suffix.

    Raises
    ------
    ConfigurationError
        If the file cannot be written.
    """
    n_panels = len(report.system.mirrors) + (2 if report.found is not None else 0)
    n_rows = ceil(n_panels / _ACROSS)
    figure = new_figure(_ACROSS * _SIDE, n_rows * _SIDE + 0.8)
    figure.suptitle(f"{report.system.name}: {report.verdict}", fontsize="medium", wrap=True)
    panels = figure.subplots(n_rows, _ACROSS, squeeze=False).ravel()
    for number in range(len(report.system.mirrors)):
        footprints(panels[number], report, number)
    if report.found is not None:
        moved(panels[n_panels - 2], report)
        pulls(panels[n_panels - 1], report)
    for empty in panels[n_panels:]:
        empty.set_axis_off()
    save_figure(figure, path)


def footprints(axes: Axes, report: SystemReport, number: int) -> None:
    """Plot a mirror's actuators, and the footprint of each star's light on it, metres."""
    system = report.system
    placed = system.mirrors[number]
    mirror = placed.instrument.mirror
    if isinstance(mirror, Mirror):
        points = placed.place.points(mirror.positions_m * [1.0, mirror.y_sign])
        axes.plot(points[:, 0], points[:, 1], "+", color="0.7", markersize=3.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    for sensor in system.sensors:
        radius_m = sensor.instrument.diameter_m / 2
        edge = radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
        met = sensor.star.project_plane(placed.altitude_m).inverse.points(edge)
        axes.plot(met[:, 0], met[:, 1], linewidth=1.0, label=sensor.name)
    axes.set(title=f"{placed.name}, {placed.altitude_m:g} m", aspect="equal", xlabel="x, m")
    axes.set_ylabel("y, m")
    axes.legend(fontsize="x-small", loc="upper right")


def moved(axes: Axes, report: SystemReport) -> None:
    """Plot each parameter's offset from nominal, 1 σ, in subapertures at the pupil's edge."""
    found, system = report.found, report.system
    if found is None:
        return
    free = [k for k, parameter in enumerate(system.parameters) if parameter.free]
    unit = np.array([system.parameters[k].subap for k in free])
    step, sigma = (found.values[free] - system.nominal[free]) / unit, found.sigma[free] / unit
    place = np.arange(len(free))
    axes.errorbar(step, place, xerr=sigma, fmt=".", color="tab:red", ecolor="0.5")
    axes.axvline(0.0, color="0.7", linewidth=0.8)
    labels = [f"{system.parameters[k].owner} {system.parameters[k].name}" for k in free]
    axes.set_yticks(place, labels, fontsize="xx-small")
    axes.invert_yaxis()
    axes.set(title="from nominal, subapertures at the edge")


def pulls(axes: Axes, report: SystemReport) -> None:
    """Plot the misfit of α of each pair over its 1 σ."""
    found, system = report.found, report.system
    if found is None:
        return
    image = axes.imshow(found.pulls, cmap="RdBu_r", vmin=-4.0, vmax=4.0, aspect="auto")
    axes.set_xticks(range(4), PARAMETERS, fontsize="x-small", rotation=20)
    labels = [" x ".join(system.names(pair)) for pair in system.pairs]
    axes.set_yticks(range(len(labels)), labels, fontsize="xx-small")
    axes.set(title="pairs: what is left, over 1 sigma")
    axes.figure.colorbar(image, ax=axes, shrink=0.7)
