"""A noisy interaction matrix beside the synthetic one: why it is fitted, and never inverted."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.figures import PAPER_MODES, check_plots
from service.errors import MatrixError
from service.files.whole import open_hdf5
from service.model.instrument import Instrument
from service.model.pupil import rtc_valid_subapertures, valid_subapertures
from service.model.slopes import as_maps, to_conventions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

Array = NDArray[np.float64]

WHAT = "the picture of a noisy matrix"

_SHOWN = 4
"""Modes, one below the other."""

_TITLES = ("synthetic, times the gain", "measured", "1 σ of each element")
_WIDTH, _MAP_ROW, _ROW = 12.0, 1.75, 3.6
"""Inches."""

_DPI = 80
_POINTS = 20_000
"""Elements in the scatter: more would be one blot."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair:
    """Measured and synthetic matrix, in conventions' order of slopes."""

    measured: Array
    """``(n_slopes, n_modes)`` slope per metre OPD."""

    synthetic: Array
    """The same of the model, each column times its measured gain."""

    noise: Array
    """``(n_slopes, n_modes)`` 1 σ of each measured element."""

    snr: Array
    """``(n_modes,)`` RMS signal of a column's elements over their noise."""

    modes: NDArray[np.intp]
    valid: NDArray[np.bool_]
    """``(n, n)`` [y, x] subapertures that the rows list."""

    heading: str

    @classmethod
    def read(cls, path: Path, instrument: Instrument) -> Self:
        """Read an archived noisy matrix.

        Raises
        ------
        MatrixError
            If the file is not one, or of another instrument.
        """
        try:
            with open_hdf5(path) as file:
                names = ("interaction_matrix", "synthetic", "element_noise", "optical_gain", "snr")
                values = {name: np.asarray(file[name][()], float) for name in names}
                facts = dict(file.attrs)
        except (OSError, KeyError, TypeError) as error:
            raise MatrixError(f"{path}: no noisy interaction matrix: {error}") from error
        mask = rtc_valid_subapertures(instrument)
        if len(values["interaction_matrix"]) != 2 * mask.sum():
            raise MatrixError(
                f"{path}: found {len(values['interaction_matrix'])} slopes, expected "
                f"{2 * mask.sum()} of {instrument.name}"
            )
        # where no registration could be fitted nothing is known of the gains
        gain = np.nan_to_num(values["optical_gain"], nan=1.0)
        recipe = instrument.slopes

        def listed(matrix: Array) -> Array:
            return to_conventions(matrix, recipe, mask)

        return cls(
            measured=listed(values["interaction_matrix"]),
            synthetic=listed(values["synthetic"] * gain),
            noise=np.abs(listed(values["element_noise"])),
            snr=values["snr"],
            modes=np.asarray(facts["modes"]),
            valid=valid_subapertures(instrument),
            heading=_heading(facts),
        )


def draw(path: Path, instrument: Instrument) -> bytes:
    """Return a PNG of an archived noisy matrix beside the synthetic one.

    Raises
    ------
    MatrixError
        If the file is not one, or of another instrument.
    ConfigurationError
        If matplotlib is not installed.
    """
    check_plots(WHAT)
    from matplotlib.figure import Figure

    pair = Pair.read(path, instrument)
    columns = shown_columns(pair.modes)
    heights = [_MAP_ROW * len(columns), _ROW]
    figure = Figure(figsize=(_WIDTH, sum(heights) + 0.6), layout="constrained")
    figure.suptitle(pair.heading, fontsize="medium")
    above, below = figure.subfigures(2, 1, height_ratios=heights, squeeze=False).ravel()
    _maps(above, pair, columns)
    scatter, normal, signal = below.subplots(1, 3)
    _scatter(scatter, pair)
    _normalised(normal, pair)
    _signal(signal, pair)
    image = io.BytesIO()
    figure.savefig(image, dpi=_DPI, format="png")
    return image.getvalue()


def shown_columns(modes: NDArray[np.intp]) -> list[int]:
    """Return which columns are shown: of the paper's modes a few, else spread over all."""
    found = np.flatnonzero(np.isin(modes + 1, PAPER_MODES))
    if len(found) < _SHOWN:
        found = np.arange(len(modes))
    kept = np.linspace(0, len(found) - 1, min(_SHOWN, len(found))).round().astype(int)
    return [int(found[k]) for k in kept]


def _heading(facts: dict[str, Any]) -> str:
    lines = [
        f"{facts['instrument']}, {facts['id']}: {len(facts['modes'])} modes, "
        f"{1e9 * facts['total_m']:.3g} nm RMS in all, {facts['n_frames']} frames; signal / noise "
        f"of an element {facts['element_snr']:.2f}"
    ]
    if "rotation_deg" in facts:
        lines.append(
            f"α fitted to it: shift {facts['shift_x_subap']:+.4f}, {facts['shift_y_subap']:+.4f} "
            f"subapertures, rotation {facts['rotation_deg']:+.4f} deg, magnification "
            f"{facts['magnification']:.5f}"
        )
    return "\n".join(lines)


def _maps(figure: SubFigure, pair: Pair, columns: list[int]) -> None:
    """Draw Sx beside Sy for a few modes; the three maps of a mode have one scale."""
    rows = figure.subplots(len(columns), len(_TITLES), squeeze=False)
    for places, column in zip(rows, columns, strict=True):
        values = [m[:, column] for m in (pair.synthetic, pair.measured, pair.noise)]
        limit = 2.5 * float(np.std(values[1]))
        for axes, slopes in zip(places, values, strict=True):
            image = axes.imshow(
                as_maps(slopes, pair.valid),
                origin="lower",
                cmap="RdBu_r",
                vmin=-limit,
                vmax=limit,
                interpolation="nearest",
            )
            axes.set(xticks=[], yticks=[])
        places[0].set_ylabel(f"mode {pair.modes[column]}", fontsize="small")
        places[2].set_xlabel(f"signal / noise {pair.snr[column]:.2f}", fontsize="small")
        figure.colorbar(image, ax=places[2], shrink=0.8).ax.tick_params(labelsize="x-small")
    for axes, name in zip(rows[0], _TITLES, strict=True):
        axes.set_title(f"{name}: Sx | Sy, per metre", fontsize="small")


def _scatter(axes: Axes, pair: Pair) -> None:
    step = -(-pair.measured.size // _POINTS)
    x, y = pair.synthetic.ravel()[::step], pair.measured.ravel()[::step]
    axes.plot(x, y, ".", markersize=1.0, color="tab:blue", alpha=0.4, rasterized=True)
    ends = np.percentile(x, [0.1, 99.9])
    axes.plot(ends, ends, color="tab:red", linewidth=1.0)
    axes.set(xlabel="synthetic, times the gain, per metre", ylabel="measured, per metre")
    axes.set_title("element against element", fontsize="small")


def _normalised(axes: Axes, pair: Pair) -> None:
    """Show that what is left is noise of the size that is stated."""
    left = ((pair.measured - pair.synthetic) / pair.noise).ravel()
    bins = np.linspace(-5.0, 5.0, 81)
    axes.hist(left, bins=bins.tolist(), density=True, color="0.7")
    axes.plot(bins, np.exp(-(bins**2) / 2) / np.sqrt(2 * np.pi), color="tab:red", linewidth=1.0)
    axes.set(xlabel="(measured - synthetic) / σ", yticks=[])
    axes.set_title(f"what is left: RMS {np.sqrt(np.mean(left**2)):.3f} σ", fontsize="small")


def _signal(axes: Axes, pair: Pair) -> None:
    axes.plot(pair.modes, pair.snr, ".", markersize=2.0, color="tab:blue")
    axes.axhline(1.0, color="0.5", linewidth=0.8)
    axes.set(xlabel="mode", ylim=(0.0, None))
    axes.set_title("signal / noise of an element, RMS", fontsize="small")
