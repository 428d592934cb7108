"""The figures of Heritier et al. 2018 for any fit, as plots or as numbers for a browser.

Only plotting needs the extra ``plots``.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sized
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal.fitting.fitted_matrix import FittedMatrix
from pyrcal.fitting.methods import FITTED_HALF_WIDTH, ScanStep
from service.errors import ConfigurationError
from service.files.documents import plain
from service.model.instrument import Instrument, TabulatedModes
from service.model.kinds import SignalKind
from service.model.misregistration import Misregistration
from service.model.slopes import as_maps, side_by_side

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


_WIDTH = 15.0
_ROW = 4.2
_MAP_ROW = 1.6
_SCAN_ROW = 2.6
"""Inches."""

_MODES_ACROSS, _SCANS_ACROSS = 2, 5
"""Side by side."""


def check_plots(what: str = "--plot") -> None:
    """Raise if figures cannot be plotted; ``what`` names the figure.

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


def new_figure(width_in: float, height_in: float, what: str = "plot") -> Figure:
    """Return an empty figure of a size in inches; ``what`` names it.

    Raises
    ------
    ConfigurationError
        If matplotlib is not installed.
    """
    check_plots(what)
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def write_sheet(fit: FittedMatrix, heading: str, instrument: Instrument, path: Path) -> None:
    """Write the figures as an image of the kind the file's name says.

    Raises
    ------
    ConfigurationError
        If matplotlib is not installed, or the file cannot be written.
    """
    save_figure(draw_sheet(fit, heading, instrument), path)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as an image of the kind the file's name says.

    Raises
    ------
    ConfigurationError
        If the file cannot be written, or its kind is not known.
    """
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"--plot: cannot write {path}: {error}") from error


def draw_sheet(fit: FittedMatrix, heading: str, instrument: Instrument | None = None) -> Figure:
    """Return all figures of a fit; the mirror over the subapertures needs the instrument.

    Raises
    ------
    ConfigurationError
        If matplotlib is not installed.
    """
    steps = fit.paper_table or ()
    heights = [2 * _ROW, _MAP_ROW * _rows(shown_modes(fit), _MODES_ACROSS) + 0.4]
    if steps:
        heights.append(_SCAN_ROW * _rows(steps, _SCANS_ACROSS))
    figure = new_figure(_WIDTH, sum(heights) + 0.8)
    advice = textwrap.wrap(fit.recommendation, 150) + textwrap.wrap(fit.verdict_line, 150)
    figure.suptitle("\n".join([heading, *advice]), fontsize="medium")
    parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False).ravel()
    grid = parts[0].subplots(2, 3)
    singular_values(grid[0, 0], fit)
    gains(grid[0, 1], fit)
    slopes_rms(grid[0, 2], fit)
    if instrument is None:
        grid[1, 0].set_axis_off()
    else:
        registration(grid[1, 0], fit, instrument)
    residual(grid[1, 1], fit)
    residual_by_mode(grid[1, 2], fit)
    slope_maps(parts[1], fit)
    if steps:
        scans(parts[2], steps)
    return figure


Array = NDArray[np.float64]

MEASURED = "tab:red"
SYNTHETIC = "tab:blue"


def singular_values(axes: Axes, fit: FittedMatrix) -> None:
    """Draw the singular values of both matrices, each over its largest, and their conditions."""
    for name, values in singular_values_of(fit).items():
        colour, style = {"synthetic": (SYNTHETIC, "-"), "measured": (MEASURED, "--")}[name]
        label = f"{name}, condition {1.0 / values[-1]:.2f}"
        axes.semilogy(values, style, color=colour, label=label)
    axes.set(title="singular values", xlabel="number", ylabel="over the largest")
    axes.legend(fontsize="small")


def gains(axes: Axes, fit: FittedMatrix) -> None:
    """Draw the gain of every mode, measured over synthetic."""
    axes.plot(fit.modes, fit.gains, ".", color=MEASURED, markersize=3.0)
    axes.axhline(float(np.median(fit.gains)), color="0.5", linewidth=0.8)
    axes.set(title="gain of each mode", xlabel="mode", ylabel="measured / synthetic")


def slopes_rms(axes: Axes, fit: FittedMatrix) -> None:
    """Draw the RMS of every column: measured, synthetic, residual."""
    measured = np.sqrt(np.mean(np.square(fit.measured, dtype=np.float64), axis=0)) * 1e-9
    synthetic = np.sqrt(np.mean(np.square(fit.synthetic, dtype=np.float64), axis=0)) * 1e-9
    axes.semilogy(fit.modes, synthetic, color=SYNTHETIC, label="synthetic, gains not applied")
    axes.semilogy(fit.modes, measured, ".", color=MEASURED, markersize=3.0, label="measured")
    left = fit.residual_by_mode * measured
    axes.semilogy(fit.modes, left, ".", color="0.6", markersize=2.0, label="left over")
    axes.set(title="slopes RMS", xlabel="mode", ylabel="per nm OPD RMS")
    axes.legend(fontsize="small")


def registration(axes: Axes, fit: FittedMatrix, instrument: Instrument) -> None:
    """Draw the actuators, or the edge of a table of modes, over the valid subapertures."""
    n = len(fit.valid)
    edge = n / 2
    axes.imshow(
        np.where(fit.valid, 0.85, 1.0),
        origin="lower",
        extent=(-edge, edge, -edge, edge),
        cmap="gray",
        vmin=0.0,
        vmax=1.0,
    )
    points, style = mirror_outline(instrument)
    here = map_to_sensor(points, fit.alpha)
    axes.plot(here[:, 0], here[:, 1], style, color=MEASURED, markersize=3.0, linewidth=1.0)
    centre = map_to_sensor(np.zeros((1, 2)), fit.alpha)[0]
    arm = map_to_sensor(np.array([[edge / 2, 0.0]]), fit.alpha)[0]
    axes.annotate("", xy=arm, xytext=centre, arrowprops={"arrowstyle": "->", "color": "black"})
    axes.set(
        title="mirror over subapertures; its x axis as arrow",
        xlabel="x, subapertures",
        ylabel="y, subapertures",
    )
    reach = 1.05 * max(edge, float(np.abs(here).max()))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")


def map_to_sensor(points: Array, alpha: Misregistration) -> Array:
    """Return where points of the mirror ``(n, 2)`` fall on the sensor, in subapertures."""
    return np.asarray(points @ alpha.image.T + alpha.vector[:2])


def _panel_title(fit: FittedMatrix) -> str:
    return "Sx | Sy" if fit.order.kind is SignalKind.XY else "four images"


def residual(axes: Axes, fit: FittedMatrix) -> None:
    """Draw the residual of every subaperture."""
    image = axes.imshow(
        100.0 * side_by_side(fit.residual_map), origin="lower", cmap="viridis", vmin=0.0
    )
    for y, x, _ in () if fit.left_over is None else fit.left_over.subapertures:
        n, planes = len(fit.valid), np.arange(len(fit.residual_map))
        places = x + n * (planes % 2), y + n * (planes // 2)
        axes.plot(*places, "o", color="tab:red", fillstyle="none", markersize=9.0)
    _draw_arms(axes, fit)
    axes.set(title=f"left over: {_panel_title(fit)}, % of the measured RMS", xticks=[], yticks=[])
    axes.figure.colorbar(image, ax=axes, shrink=0.7)


def _draw_arms(axes: Axes, fit: FittedMatrix) -> None:
    """Plot the lines with an increased residual, in the first plane."""
    if fit.left_over is None:
        return
    middle, half = (len(fit.valid) - 1) / 2, len(fit.valid) / 2
    for arm in fit.left_over.arms:
        angle = np.deg2rad(arm.angle_deg)
        along = np.array([np.cos(angle), np.sin(angle)])
        foot = middle + arm.offset_subap * np.array([-along[1], along[0]])
        ends = foot + np.outer([0.35 * half, 0.95 * half], along)
        axes.plot(ends[:, 0], ends[:, 1], "-", color="white", linewidth=1.0)


def residual_by_mode(axes: Axes, fit: FittedMatrix) -> None:
    """Draw the residual of every mode."""
    axes.semilogy(fit.modes, 100.0 * fit.residual_by_mode, ".", color="0.4", markersize=3.0)
    axes.axhline(100.0 * fit.residual_fraction, color=MEASURED, linewidth=0.8)
    axes.set(title="left over by mode", xlabel="mode", ylabel="% of the mode's own RMS")


def mirror_outline(instrument: Instrument) -> tuple[Array, str]:
    """Return the mirror's outline or actuators, in subapertures, and how to draw them."""
    mirror = instrument.mirror
    parity = np.array([1.0, mirror.y_sign])
    if isinstance(mirror, TabulatedModes):
        half = (np.array(mirror.known.shape[::-1]) - 1) / 2 * mirror.pitch_m
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half
        return corners / instrument.subaperture_m * parity, "-"
    return mirror.positions_m / instrument.subaperture_m * parity, "+"


_COLUMNS = ("synthetic", "measured", "difference")


def slope_maps(figure: SubFigure, fit: FittedMatrix) -> None:
    """Draw the signals of a few modes; all three maps of a mode have one scale."""
    columns = shown_modes(fit)
    n_rows = _rows(columns, _MODES_ACROSS)
    places = figure.subplots(n_rows, _MODES_ACROSS * len(_COLUMNS), squeeze=False)
    triples = places.reshape(-1, len(_COLUMNS))
    for triple, column in zip(triples, columns, strict=False):
        _mode(triple, fit, int(column))
    for axes in triples[len(columns) :].ravel():
        axes.set_axis_off()
    for axes, name in zip(places[0], _COLUMNS * _MODES_ACROSS, strict=True):
        axes.set_title(f"{name}: {_panel_title(fit)}", fontsize="small")


def _rows(shown: Sized, across: int) -> int:
    """Return the number of rows of figures."""
    return math.ceil(len(shown) / across)


def _mode(triple: NDArray[Any], fit: FittedMatrix, column: int) -> None:
    """Draw one mode into three axes."""
    measured, synthetic, limit = _of_mode(fit, column)
    for axes, values in zip(triple, (synthetic, measured, measured - synthetic), strict=True):
        axes.imshow(values, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit)
        axes.set(xticks=[], yticks=[])
    triple[0].set_ylabel(f"mode {fit.modes[column]}", fontsize="small")
    left = 100.0 * fit.residual_by_mode[column]
    triple[2].set_xlabel(f"{left:.1f} % left", fontsize="small")


def scans(figure: SubFigure, steps: tuple[ScanStep, ...]) -> None:
    """Draw the criterion χ_N over the samples of every step, with the fitted polynomial."""
    grid = figure.subplots(_rows(steps, _SCANS_ACROSS), _SCANS_ACROSS, squeeze=False).ravel()
    for number, (axes, scan) in enumerate(zip(grid, steps, strict=False), start=1):
        _scan(axes, scan, number)
    for axes in grid[len(steps) :]:
        axes.set_axis_off()


def _scan(axes: Axes, scan: ScanStep, number: int) -> None:
    axes.plot(scan.samples, scan.chi, "o", color="tab:red", markersize=3.0)
    fine = np.linspace(-FITTED_HALF_WIDTH, FITTED_HALF_WIDTH, 50)
    polynomial = np.polyval(scan.coefficients, fine)
    axes.plot(scan.minimum + scan.step * fine, polynomial, color="tab:blue", linewidth=1.0)
    axes.axvline(scan.minimum, color="0.5", linewidth=0.8)
    axes.set_title(
        f"{number}: {scan.parameter} by {scan.step:g}, {scan.minimum:.4f}", fontsize="small"
    )
    axes.tick_params(labelsize="x-small")


# --- as numbers: what the figures are drawn from, few enough for a browser


PAPER_MODES = (1, 5, 10, 50, 100, 200, 300, 350, 400)
"""Modes the paper shows, counted from 1 as it does."""

N_MAPS = 4
"""Number of modes whose slope maps are sent to a browser."""


def numbers(fit: FittedMatrix) -> dict[str, Any]:
    """Return the figures of a fit as JSON; null for unknown values.

    Maps are lists of rows from the lowest y upwards, Sx next to Sy, or the four images as on the
    detector. Values are whole percent: of the measured RMS for ``residual_map``; for ``maps``, of
    three times the mode's own RMS, clipped there.
    """
    shown = shown_modes(fit)
    picked = shown[np.unique(np.linspace(0, len(shown) - 1, N_MAPS).round().astype(int))]
    found: dict[str, Any] = {
        "modes": fit.modes,
        "residual_by_mode": np.round(fit.residual_by_mode, 4),
        "singular_values": {
            name: np.round(values, 5) for name, values in singular_values_of(fit).items()
        },
        "residual_map": _percent(side_by_side(fit.residual_map)),
        "maps": [_columns(fit, int(column)) for column in picked],
    }
    document: dict[str, Any] = plain(found)
    return document


def singular_values_of(fit: FittedMatrix) -> dict[str, Array]:
    """Return the normalised singular values of both matrices, by the matrix's name."""
    found = {}
    for name, matrix in (("synthetic", fit.synthetic * fit.gains), ("measured", fit.measured)):
        values = scipy.linalg.svdvals(np.asarray(matrix, dtype=np.float64))
        found[name] = values / values[0]
    return found


def shown_modes(fit: FittedMatrix) -> NDArray[np.intp]:
    """Return the columns of the fit that are shown: the paper's modes, if they were used."""
    found = np.flatnonzero(np.isin(fit.modes + 1, PAPER_MODES))
    return found if len(found) else np.arange(min(len(fit.modes), N_MAPS))


def _of_mode(fit: FittedMatrix, column: int) -> tuple[Array, Array, float]:
    """Return one mode's slopes as maps, measured and synthetic, and the scale of both."""
    measured = as_maps(fit.measured[:, column], fit.valid)
    synthetic = as_maps(fit.synthetic[:, column] * fit.gains[column], fit.valid)
    return measured, synthetic, 3.0 * float(np.nanstd(measured)) or 1.0


def _columns(fit: FittedMatrix, column: int) -> dict[str, Any]:
    """Return one mode's slopes in per cent of their scale."""
    measured, synthetic, limit = _of_mode(fit, column)
    return {
        "mode": int(fit.modes[column]),
        "measured": _percent(np.clip(measured / limit, -1.0, 1.0)),
        "synthetic": _percent(np.clip(synthetic / limit, -1.0, 1.0)),
    }


def _percent(shares: Array) -> Any:  # noqa: ANN401 - as nested as the array
    return np.ma.fix_invalid(np.round(100.0 * shares), fill_value=0.0).astype(int).tolist()
