"""What a wrong registration costs, and the rule of the border."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from studies.heritier2018 import page, paper
from studies.heritier2018.loops import LoopRun, wavefront_error_nm
from studies.heritier2018.plan import (
    INFLUENCE_GAIN,
    INFLUENCE_MODES,
    SWEEPS,
    Budget,
    Sweep,
    influence_run,
)
from studies.heritier2018.reconstructors import Kind
from studies.heritier2018.spectra import smoothed
from studies.heritier2018.store import Record, Store

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

COSTLY_NM = 50.0
"""Added in quadrature to the registered loop's error: what a registration may not cost."""

_LOOK = {400: "#0757ae", 594: "#b3261e"}
_DASH = {Kind.TRUNCATED: "-", Kind.MAP: "--"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Wavefront error along a sweep, with one reconstructor."""

    sweep: Sweep
    n_modes: int
    kind: Kind
    values: tuple[float, ...]
    errors_nm: tuple[float, ...]

    @property
    def name(self) -> str:
        """What a legend calls it."""
        return f"{self.n_modes} modes, {self.kind}"

    def tolerance(self) -> float | None:
        """Return the value at which the registration costs ``COSTLY_NM``; None: not reached."""
        limit = np.hypot(self.errors_nm[0], COSTLY_NM)
        errors = np.array(self.errors_nm)
        above = np.flatnonzero(errors > limit)
        if not len(above):
            return None
        k = int(above[0])
        # the error grows like a power: between two points its logarithm is the straighter line
        low, high = np.log(errors[k - 1]), np.log(errors[k])
        share = (np.log(limit) - low) / (high - low)
        return float(self.values[k - 1] + share * (self.values[k] - self.values[k - 1]))


def curves(budget: Budget, store: Store) -> tuple[Curve, ...]:
    """Return every curve of the three sweeps."""
    return tuple(
        Curve(
            sweep=sweep,
            n_modes=n_modes,
            kind=kind,
            values=sweep.at(budget),
            errors_nm=tuple(
                wavefront_error_nm(store.read(run))
                for run in (
                    influence_run(budget, sweep.alpha(value), n_modes, kind)
                    for value in sweep.at(budget)
                )
            ),
        )
        for sweep in SWEEPS
        for n_modes in INFLUENCE_MODES
        for kind in Kind
    )


def border_tolerances(found: tuple[Curve, ...], n_modes: int) -> dict[str, float]:
    """Return by symbol how far the border may move, in subapertures, with the truncated SVD."""
    tolerances = {}
    for curve in found:
        value = curve.tolerance()
        if curve.n_modes == n_modes and curve.kind is Kind.TRUNCATED and value is not None:
            tolerances[curve.sweep.symbol] = curve.sweep.border_subap(value)
    return tolerances


def section(budget: Budget, store: Store) -> page.Section:
    """Return the section on the influence of a misregistration."""
    found = curves(budget, store)
    n_frames = budget.influence_frames
    night = influence_run(budget, SWEEPS[0].alpha(0.0), 400, Kind.TRUNCATED)
    body = page.paragraph(
        "The loop of the diffractive telescope is closed on a star of magnitude 7 in 1 arcsec "
        f"seeing, gain {INFLUENCE_GAIN:g} of every mode, while the model behind its reconstructor "
        "stays at α = 0. The telescope is free of other imperfections; its influence functions "
        "still differ from the model's by 2 % at mode 400. Reconstructors: truncated SVD, and MAP "
        "with the turbulence's modal variances and the slope noise as priors."
    )
    body += page.picture(
        _curves_figure(found),
        f"Wavefront error against each parameter. {n_frames} frames a point after "
        f"{night.n_frames_run - n_frames} of settling, the same turbulence for all.",
    )
    body += _tolerance_table(found)
    body += page.picture(
        _border_figure(found),
        "The same errors against how far the border of the pupil moves. A rotation moves it by "
        "15 sin α_rot subapertures, a magnification by 15 (α_magn - 1).",
    )
    body += _border_remark(found)
    body += page.picture(
        _spectra_figure(budget, store),
        "Residual by mode, truncated SVD, registered and at the paper's two marked values: "
        f"{paper.MARKED_ROTATION.text} and {paper.MARKED_SHIFT.text}. {n_frames} frames each; "
        "a running mean over 9 modes.",
    )
    body += _spectra_remark(budget, store)
    return page.Section(anchor="influence", title="Influence of misregistrations", body=body)


def _curves_figure(found: tuple[Curve, ...]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 3.6), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for axes, sweep in zip(panels, SWEEPS, strict=True):
        for curve in (curve for curve in found if curve.sweep is sweep):
            _draw(axes, curve, curve.values)
        axes.set_xlabel(f"{sweep.symbol} [{sweep.unit}]")
        _log_error_axis(axes)
    panels[0].set_ylabel("wavefront error [nm RMS]")
    panels[0].legend(fontsize="small")
    return figure


def _border_figure(found: tuple[Curve, ...]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 3.6), layout="constrained")
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


def _draw(axes: Axes, curve: Curve, x: tuple[float, ...]) -> None:
    axes.plot(
        x,
        curve.errors_nm,
        _DASH[curve.kind],
        marker=".",
        color=_LOOK[curve.n_modes],
        label=curve.name,
    )


def _log_error_axis(axes: Axes) -> None:
    axes.set_yscale("log")
    ticks = [80, 100, 150, 200, 300, 500, 1000, 2000]
    axes.set_yticks(ticks, [str(tick) for tick in ticks])
    axes.set_yticks([], minor=True)
    axes.set_ylim(80, 2500)
    axes.grid(alpha=0.3)


def _tolerance_table(found: tuple[Curve, ...]) -> str:
    head = ["reconstructor", "registered [nm]"]
    head += [f"{s.symbol} costing {COSTLY_NM:g} nm [{s.unit}]" for s in SWEEPS]
    rows = []
    for n_modes in INFLUENCE_MODES:
        for kind in Kind:
            own = [c for c in found if c.n_modes == n_modes and c.kind is kind]
            values = [_beyond(curve) for curve in own]
            rows.append([own[0].name, f"{own[0].errors_nm[0]:.0f}", *values])
    return page.table(head, rows)


def _beyond(curve: Curve) -> str:
    value = curve.tolerance()
    return f"> {curve.values[-1]:g}" if value is None else f"{value:.2g}"


def _border_remark(found: tuple[Curve, ...]) -> str:
    rule = 100.0 * SWEEPS[0].border_subap(1.0)
    text = (
        f"Border rule: 1 deg moves the border by 15 x 0.01745 = {rule:.1f} % of a subaperture "
        f"(the paper: {paper.BORDER_RULE.values[0]:g} %, {paper.BORDER_RULE.where}). "
    )
    agrees = True
    for n_modes in INFLUENCE_MODES:
        tolerances = border_tolerances(found, n_modes)
        if len(tolerances) < 2:
            text += f"With {n_modes} modes too few sweeps reach {COSTLY_NM:g} nm to compare them. "
            continue
        listed = ", ".join(f"{100 * v:.0f} % by {symbol}" for symbol, v in tolerances.items())
        spread = max(tolerances.values()) / min(tolerances.values())
        alike = spread < 1.5
        agrees &= alike
        text += (
            f"With {n_modes} modes {COSTLY_NM:g} nm are lost when the border has moved by {listed}"
            + (
                ": about the same movement whatever the cause, as the rule says. "
                if alike
                else f": a factor {spread:.1f} apart, so the border is not all that counts (a "
                "shift moves every actuator, a rotation or magnification only the outer ones). "
            )
        )
    return page.remark(text, agrees=agrees)


def _spectra_figure(budget: Budget, store: Store) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 3.8), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, n_modes in zip(panels, INFLUENCE_MODES, strict=True):
        for name, run in _marked(budget, n_modes):
            record = store.read(run)
            if name == "registered":
                axes.loglog(*smoothed(record["incoming_nm2"]), color="0.6", label="no correction")
            axes.loglog(*smoothed(record["modal_nm2"]), label=name)
        axes.axvline(n_modes, color="0.8", linewidth=0.8)
        axes.set(xlabel="mode", title=f"{n_modes} modes controlled")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("variance of the mode [nm²]")
    panels[0].legend(fontsize="small")
    return figure


def _marked(budget: Budget, n_modes: int) -> list[tuple[str, LoopRun]]:
    runs = [(0.0, SWEEPS[0], "registered")]
    for sweep in SWEEPS:
        runs += [(v, sweep, f"{sweep.symbol} = {v:g} {sweep.unit}") for v in sweep.marked]
    return [
        (name, influence_run(budget, sweep.alpha(value), n_modes, Kind.TRUNCATED))
        for value, sweep, name in runs
    ]


def _spectra_remark(budget: Budget, store: Store) -> str:
    """Return which modes suffer, by the run's own numbers."""
    texts = []
    for n_modes in INFLUENCE_MODES:
        (_, registered), *others = _marked(budget, n_modes)
        at_rest = store.read(registered)
        for name, run in others:
            grown = store.read(run)
            extra = grown["modal_nm2"][:n_modes] - at_rest["modal_nm2"][:n_modes]
            total = float(extra.sum())
            added_nm = float(np.sqrt(max(total, 0.0)))
            if added_nm < 15.0:
                texts.append(f"{n_modes} modes at {name}: no more than {added_nm:.0f} nm added")
                continue
            texts.append(
                f"{n_modes} modes at {name}: {added_nm:.0f} nm added, "
                f"{_share_of_last(extra, total):.0%} of its variance in the last third of the modes"
            )
    return page.paragraph("; ".join(texts) + ".")


def _share_of_last(extra: Array, total: float) -> float:
    first = 2 * len(extra) // 3
    return float(extra[first:].sum()) / total


def record_of_registered(budget: Budget, store: Store, n_modes: int) -> Record:
    """Return the loop by night with everything registered."""
    return store.read(influence_run(budget, SWEEPS[0].alpha(0.0), n_modes, Kind.TRUNCATED))
