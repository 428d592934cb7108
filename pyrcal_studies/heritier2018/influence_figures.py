"""Figures of what a wrong registration costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from pyrcal_studies.heritier2018 import page, paper
from pyrcal_studies.heritier2018.curves import Curve
from pyrcal_studies.heritier2018.plan import INFLUENCE_MODES, SWEEPS
from pyrcal_studies.heritier2018.reconstructors import Kind
from pyrcal_studies.heritier2018.spectra import smoothed
from pyrcal_studies.heritier2018.store import Record

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {400: "#0757ae", 594: "#b3261e"}
_DASH = {Kind.TRUNCATED: "-", Kind.MAP: "--"}


def curves_figure(found: tuple[Curve, ...]) -> Figure:
    """Draw the error against each parameter."""
    figure = page.canvas(10.5, 3.6)
    panels = figure.subplots(1, 3, sharey=True)
    for axes, sweep in zip(panels, SWEEPS, strict=True):
        for curve in (curve for curve in found if curve.sweep is sweep):
            axes.plot(
                curve.values,
                curve.errors_nm,
                _DASH[curve.kind],
                marker=".",
                color=_COLOURS[curve.n_modes],
                label=curve.name,
            )
        axes.set_xlabel(f"{sweep.symbol} [{sweep.unit}]")
        _log_error_axis(axes)
    panels[0].set_ylabel("wavefront error [nm RMS]")
    panels[0].legend(fontsize="small")
    return figure


def border_figure(found: tuple[Curve, ...]) -> Figure:
    """Draw the error against the movement of the border."""
    figure = page.canvas(10.5, 3.6)
    panels = figure.subplots(1, 2, sharey=True)
    markers = dict(zip((sweep.symbol for sweep in SWEEPS), "os^", strict=True))
    for axes, n_modes in zip(panels, INFLUENCE_MODES, strict=True):
        for curve in found:
            if curve.n_modes == n_modes and curve.kind is Kind.TRUNCATED:
                moved = [curve.sweep.border_subap(value) for value in curve.values]
                symbol = curve.sweep.symbol
                axes.plot(moved, curve.errors_nm, marker=markers[symbol], label=symbol)
        axes.axvline(paper.BORDER_RULE.values[0] / 100.0, color="0.6", linewidth=0.8)
        axes.set_title(f"{n_modes} modes, truncated SVD", fontsize="medium")
        axes.set_xlabel("movement of the border [subapertures]")
        _log_error_axis(axes)
    panels[0].set_ylabel("wavefront error [nm RMS]")
    panels[0].legend()
    return figure


def _log_error_axis(axes: Axes) -> None:
    axes.set_yscale("log")
    ticks = [80, 100, 150, 200, 300, 500, 1000, 2000]
    axes.set_yticks(ticks, [str(tick) for tick in ticks])
    axes.set_yticks([], minor=True)
    axes.set_ylim(80, 2500)
    axes.grid(alpha=0.3)


def spectra_figure(shown: Mapping[int, Sequence[tuple[str, Record]]]) -> Figure:
    """Draw residuals by mode: by number of modes controlled, the registered loop first."""
    figure = page.canvas(10.5, 3.8)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, n_modes in zip(panels, INFLUENCE_MODES, strict=True):
        incoming = shown[n_modes][0][1]["incoming_nm2"]
        axes.loglog(*smoothed(incoming), color="0.6", label="no correction")
        for name, record in shown[n_modes]:
            axes.loglog(*smoothed(record["modal_nm2"]), label=name)
        axes.axvline(n_modes, color="0.8", linewidth=0.8)
        axes.set(xlabel="mode", title=f"{n_modes} modes controlled")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("variance of the mode [nm²]")
    panels[0].legend(fontsize="small")
    return figure
