"""The page docs/results/heritier2018.md: the paper beside ours, row by row and figure by figure."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import captions, paper, plan, results, rows, tables
from pyrcal_studies.heritier2018.figures import DRAWN, file_name
from pyrcal_studies.heritier2018.plan import Budget
from pyrcal_studies.heritier2018.store import Store

Array = NDArray[np.float64]

PICTURES = "heritier2018"
"""Folder of the pictures, beside the page."""


def write(budget: Budget, store: Store, minutes: float) -> str:
    """Return the page as Markdown."""
    parts = [
        "# Heritier et al. 2018 beside pyrcal",
        _opening(budget, store, minutes),
        "## Targets",
        tables.targets(budget, store),
        "## Every equation, table, figure and claim",
        "Places are those of the published numbering: LaTeX counts ten equations, D = M_WFS M_DM "
        "is "
        "the first and α_f the last. Quotations are the paper's words.",
        rows.markdown(budget, store),
        "## Table 1: the procedure, step by step",
        tables.table_1(budget, store),
        "## The registration found",
        tables.registration(budget, store),
        "## Table 2: the closed loop by day",
        tables.table_2(budget, store),
        "## Why 147 nm are not reached",
        tables.illumination(budget, store),
        "## Calibration patterns (section 2.1)",
        tables.patterns(budget, store),
        "## Figures",
        *_figures(budget, store),
        "## What the paper leaves open",
        tables.open_questions(budget, store),
    ]
    return "\n\n".join(parts) + "\n"


def _opening(budget: Budget, store: Store, minutes: float) -> str:
    n_average = budget.n_average
    frames = plan.measurement(budget, budget.seeds[0]).n_frames
    rehearsal = (
        ""
        if budget.name == "full"
        else "**This is a rehearsal with few frames and one telescope: its numbers show that "
        "everything works, not how well.**\n\n"
    )
    return (
        f"{rehearsal}The paper (MNRAS 481, 2829) calibrates an adaptive telescope with a synthetic "
        "interaction matrix whose misregistration is fitted to a measured matrix. This page does "
        "the same on a simulated telescope and puts each result beside the paper's.\n\n"
        "- **Command**: `make paper` makes this page and its pictures "
        f"(`python -m pyrcal_studies.heritier2018`). Last made on "
        f"{datetime.now(UTC).date().isoformat()}; all steps together take about {minutes:.0f} "
        "minutes of one idle core.\n"
        "- **Telescope**: a diffractive simulation of FLAO at the LBT "
        "(`service/instrument/packaged/flao-lbt.toml`) with another pupil grid and other influence "
        "functions than the model, uneven light (10 %) and displaced actuators. Its registration "
        f"is that of equation 10. {len(budget.seeds)} telescopes differ in their imperfections, "
        "noise and turbulence.\n"
        "- **Measured matrix**: by day in double pass, fibre of magnitude 7, 400 KL modes of 20 "
        "nm "
        f"RMS on the mirror, each pushed and pulled {n_average} times in a shaking dome: "
        f"{frames} frames.\n"
        f"- **Loops**: 1 kHz, two frames of delay; by night gain {plan.NIGHT_GAIN:g} and "
        f"{budget.influence_frames} frames after 200 of settling, by day the gains of the ramp and "
        f"{budget.closed_frames} frames. The paper prints neither wind, nor frame rate, nor gain, "
        "nor flux by night, so levels agree only as far as these choices are alike.\n"
        "- **Not shown here**: a real telescope. The paper's figures 13 and 14 and its Table 2 "
        "were "
        "measured at the LBT; ours are simulated."
    )


def _figures(budget: Budget, store: Store) -> Iterable[str]:
    yield (
        "Figures 1 and 2 of the paper are diagrams of the method and of the model: see "
        "[method](../understand/method.md). Figures 3 to 14 follow."
    )
    for number in DRAWN:
        title, text = captions.CAPTIONS[number](budget, store)
        yield f"### Figure {number}: {title}"
        yield f"![Figure {number}: {title}]({PICTURES}/{file_name(number)})"
        yield text


__all__ = ["PICTURES", "paper", "results", "write"]
