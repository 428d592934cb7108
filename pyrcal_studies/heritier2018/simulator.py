"""A telescope's measured matrix in the loop of the paper's simulator, and around its optimum."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import page, paper
from pyrcal_studies.heritier2018.loops import Over, wavefront_error_nm
from pyrcal_studies.heritier2018.plan import (
    AROUND,
    IDEAL,
    INFLUENCE_GAIN,
    REALISTIC,
    USUAL,
    Budget,
    Sweep,
    Variant,
    around_runs,
    hasty,
    in_simulator,
)
from pyrcal_studies.heritier2018.store import Store

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_COARSE = 0.25
"""Of the half-width of a sweep: an optimum so near to what the fit found is the fit's."""

_CLOSE_NM = 5.0
"""From the paper's value: the scatter of seconds of turbulence."""


def section(budget: Budget, store: Store) -> page.Section:
    """Return the section on the simulator."""
    body = page.paragraph(
        "The paper has an error of its simulation for either matrix. Here: by night, star of "
        f"magnitude 7, all of a turbulence of 1 arcsec, gain {INFLUENCE_GAIN:g}, 400 modes. The "
        "simulated mirror has the model's own influence functions, so that to the synthetic matrix "
        "it is what the paper's simulator is to its own, and lies where the joint fit to that "
        "telescope's measured matrix says. The errors are of all of the wavefront. "
        f"{budget.influence_frames} frames a loop."
    )
    body += _table(budget, store) + _order_remark(budget, store)
    body += page.heading("Around the optimum, with the measured matrix")
    body += page.paragraph(
        "The simulator is moved away from what the fit found, one parameter at a time; the matrix "
        "stays. If the fit is right, the loop is best near 0. Where the light falls on the sensor "
        "changes with the shift as well, and a border that the sensor does not see may slip by a "
        "wave, whatever the matrix: the loop of a model that knows where it lies shows that part. "
        "What the slopes show has none of it."
    )
    body += page.picture(
        _figure(budget, store),
        "Wavefront error around the registration found: with the first telescope's measured "
        f"matrix, and with a model that knows. {budget.influence_frames} frames a point.",
    )
    body += _optimum_table(budget, store)
    return page.Section(anchor="simulator", title="Both matrices in the simulator", body=body)


def _cases(budget: Budget) -> dict[str, tuple[Budget, int, str]]:
    """Return where a measured matrix comes from: budget, telescope, imperfections."""
    first = budget.seeds[0]
    cases = {f"usual telescope {seed}": (budget, seed, USUAL) for seed in budget.seeds}
    cases["ideal telescope"] = (budget, first, IDEAL)
    cases["realistic telescope"] = (budget, first, REALISTIC)
    cases[f"usual telescope {first}, each mode once"] = (hasty(budget), first, USUAL)
    return cases


def errors_nm(budget: Budget, store: Store, over: Over = Over.PUPIL) -> dict[str, Array]:
    """Return synthetic and measured ``(2,)`` of each telescope's matrix, nm."""
    return {
        name: np.array(
            [
                wavefront_error_nm(
                    store.read(in_simulator(measured, seed, variant, imperfections=imperfections)),
                    over=over,
                )
                for variant in (Variant.SYNTHETIC, Variant.MEASURED)
            ]
        )
        for name, (measured, seed, imperfections) in _cases(budget).items()
    }


def _table(budget: Budget, store: Store) -> str:
    rows = [
        [
            "paper",
            paper.SIMULATED_SYNTHETIC.text,
            paper.SIMULATED_MEASURED.text,
            f"{_paper_difference():+.1f}",
        ]
    ]
    for name, (synthetic, measured) in errors_nm(budget, store).items():
        rows.append(
            [name, f"{synthetic:.1f} nm", f"{measured:.1f} nm", f"{measured - synthetic:+.1f}"]
        )
    return page.table(["matrix of", "synthetic", "measured", "measured less synthetic"], rows)


def _paper_difference() -> float:
    return paper.SIMULATED_MEASURED.values[0] - paper.SIMULATED_SYNTHETIC.values[0]


def _order_remark(budget: Budget, store: Store) -> str:
    """Return whether level and order are the paper's, and what decides the order."""
    found = errors_nm(budget, store)
    level = float(np.mean([synthetic for synthetic, _ in found.values()]))
    away = paper.SIMULATED_SYNTHETIC.distance(level)
    worse = {name: measured - synthetic for name, (synthetic, measured) in found.items()}
    largest = max(worse, key=lambda name: worse[name])
    same = [name for name, value in worse.items() if value > 0.0]
    text = (
        f"Synthetic: {level:.0f} nm on average, {away:.0f} nm from the paper's "
        f"{paper.SIMULATED_SYNTHETIC.text}. Measured is worse than synthetic, as in the paper, for "
        f"{len(same)} of {len(found)} matrices, most for the {largest} ({worse[largest]:+.1f} nm; "
        f"the paper {_paper_difference():+.0f} nm). A matrix that was measured well differs from "
        "the simulator's by the telescope's imperfections alone; how far the real telescope was "
        "from its simulator, and how noisy its matrix, decide the paper's difference, and neither "
        "is in the numbers quoted."
    )
    return page.remark(text, agrees=away < _CLOSE_NM and len(same) == len(found))


def around_nm(budget: Budget, store: Store, sweep: Sweep) -> Mapping[float, Array]:
    """Return three errors by value of a sweep.

    That of the measured matrix, of a model that knows, and what the slopes show of the first.
    """
    found = {}
    for value in sorted(sweep.at(budget)):
        away, known = (store.read(run) for run in around_runs(budget, sweep, value))
        errors = [wavefront_error_nm(record) for record in (away, known)]
        found[value] = np.array([*errors, wavefront_error_nm(away, over=Over.SLOPES)])
    return found


def optimum(values: Array, cost: Array) -> float | None:
    """Return the minimum of the parabola through all of a sweep; None: it has no minimum."""
    curvature, slope, _ = np.polyfit(values, cost, 2)
    return None if curvature <= 0.0 else float(-slope / (2.0 * curvature))


def _optimum_table(budget: Budget, store: Store) -> str:
    head = ["parameter", "best by wavefront error", "best by the slopes", "half-width of the sweep"]
    rows, good = [], True
    for sweep in AROUND:
        found = around_nm(budget, store, sweep)
        values = np.array(list(found))
        away, _, shown = np.array(list(found.values())).T ** 2
        best = optimum(values, shown)
        good &= best is not None and abs(best) < _COARSE * values.max()
        name = f"{sweep.symbol} [{sweep.unit}]"
        rows.append([name, _shown(optimum(values, away)), _shown(best), f"{values.max():g}"])
    text = (
        "By the slopes every parameter is best where the fit found it, within a quarter of the "
        "sweep's half-width: a parabola through all of its points has its minimum there."
        if good
        else "By the slopes only some parameters are best where the fit found them."
    )
    return page.table(head, rows) + page.remark(text, agrees=good)


def _shown(value: float | None) -> str:
    return "no minimum" if value is None else f"{value:+.2f}"


def _figure(budget: Budget, store: Store) -> Figure:
    figure = page.canvas(10.5, 3.2)
    panels = figure.subplots(1, len(AROUND), sharey=True)
    for axes, sweep in zip(panels, AROUND, strict=True):
        found = around_nm(budget, store, sweep)
        away, known, shown = np.array(list(found.values())).T
        axes.plot(list(found), away, "o-", color="#b3261e", label="measured matrix")
        axes.plot(list(found), known, ".--", color="0.5", label="a model that knows")
        axes.plot(list(found), shown, "s:", color="#0757ae", label="measured, by its slopes")
        axes.axvline(0.0, color="0.8", linewidth=0.8)
        axes.set_xlabel(f"{sweep.symbol} less found [{sweep.unit}]")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("wavefront error [nm RMS]")
    panels[0].legend(fontsize="small")
    return figure
