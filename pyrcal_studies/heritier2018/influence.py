"""What a wrong registration costs, and the rule of the border."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import page, paper
from pyrcal_studies.heritier2018.curves import COSTLY_NM, Curve, border_tolerances, curves
from pyrcal_studies.heritier2018.influence_figures import (
    border_figure,
    curves_figure,
    spectra_figure,
)
from pyrcal_studies.heritier2018.loops import LoopRun
from pyrcal_studies.heritier2018.plan import (
    INFLUENCE_GAIN,
    INFLUENCE_MODES,
    SWEEPS,
    Budget,
    influence_run,
)
from pyrcal_studies.heritier2018.reconstructors import Kind
from pyrcal_studies.heritier2018.store import Record, Store

Array = NDArray[np.float64]


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
        "with the turbulence's modal variances and the slope noise as priors. Some tenths of a "
        "second show what a registration costs at once; an edge of 594 modes that slips only after "
        "seconds is the subject of pyrcal_studies.edge_slip."
    )
    body += page.picture(
        curves_figure(found),
        f"Wavefront error against each parameter. {n_frames} frames a point after "
        f"{night.n_frames_run - n_frames} of settling, the same turbulence for all.",
    )
    body += _tolerance_table(found)
    body += page.picture(
        border_figure(found),
        "The same errors against how far the border of the pupil moves. A rotation moves it by "
        "15 sin α_rot subapertures, a magnification by 15 (α_magn - 1).",
    )
    body += _border_remark(found)
    body += page.picture(
        spectra_figure(_marked_records(budget, store)),
        "Residual by mode, truncated SVD, registered and at the paper's two marked values: "
        f"{paper.MARKED_ROTATION.text} and {paper.MARKED_SHIFT.text}. {n_frames} frames each; "
        "a running mean over 9 modes.",
    )
    body += _spectra_remark(budget, store)
    return page.Section(anchor="influence", title="Influence of misregistrations", body=body)


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


def _marked_records(budget: Budget, store: Store) -> dict[int, list[tuple[str, Record]]]:
    return {
        n_modes: [(name, store.read(run)) for name, run in _marked(budget, n_modes)]
        for n_modes in INFLUENCE_MODES
    }


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
