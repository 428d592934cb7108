"""All figures of a fit on one sheet."""

from __future__ import annotations

import textwrap
from pathlib import Path

from service.errors import ConfigurationError
from service.files.figures import maps, panels, scans
from service.files.report import FitReport, verdict_line
from service.model.instrument import Instrument

_WIDTH = 15.0
_ROW = 4.2
_MAP_ROW = 1.6
_SCAN_ROW = 2.6
"""Inches."""


def check_plots(what: str = "--plot") -> None:
    """Refuse to begin where figures cannot be drawn; ``what`` is what asks for one.

    Raises
    ------
    ConfigurationError
        If matplotlib is not installed.
    """
    try:
        import matplotlib.figure  # noqa: F401 - an extra, and slow to import
    except ImportError as error:
        raise ConfigurationError(
            f"{what}: needs matplotlib; expected pyrcal installed with its extra 'plots'"
        ) from error


def write_sheet(report: FitReport, instrument: Instrument, path: Path) -> None:
    """Write the figures as an image of the kind the file's name says.

    Raises
    ------
    ConfigurationError
        If matplotlib is not installed, or the file cannot be written.
    """
    check_plots()
    from matplotlib.figure import Figure

    fit = report.fit
    steps = fit.paper_table or ()
    heights = [2 * _ROW, _MAP_ROW * maps.n_rows(fit) + 0.4]
    if steps:
        heights.append(_SCAN_ROW * scans.n_rows(steps))
    figure = Figure(figsize=(_WIDTH, sum(heights) + 0.8), layout="constrained")
    heading = [f"{report.instrument}: {report.reference}", *textwrap.wrap(verdict_line(fit), 150)]
    figure.suptitle("\n".join(heading), fontsize="medium")
    parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False).ravel()
    grid = parts[0].subplots(2, 3)
    panels.singular_values(grid[0, 0], fit)
    panels.gains(grid[0, 1], fit)
    panels.slopes_rms(grid[0, 2], fit)
    panels.registration(grid[1, 0], fit, instrument)
    panels.residual(grid[1, 1], fit)
    panels.residual_by_mode(grid[1, 2], fit)
    maps.slope_maps(parts[1], fit)
    if steps:
        scans.scans(parts[2], steps)
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"--plot: cannot write {path}: {error}") from error
