"""The page docs/results/heritier2018.md: the paper and pyrcal, row by row and figure by figure."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime

from pyrcal_studies.heritier2018 import captions, plan, rows, tables
from pyrcal_studies.heritier2018.figures import DRAWN, file_name
from pyrcal_studies.heritier2018.plan import Budget
from pyrcal_studies.heritier2018.store import Store

PICTURES = "heritier2018"
"""Folder of the pictures, beside the page."""


def write(budget: Budget, store: Store, minutes: float) -> str:
    """Return the page as Markdown."""
    parts = [
        "# Heritier et al. 2018 and pyrcal",
        _opening(budget),
        "## Figures of the paper",
        rows.figures_index(budget, store),
        "## Targets",
        tables.targets(budget, store),
        "## Conditions",
        _conditions(budget, minutes),
        "## Equations, tables and claims",
        "Quotation marks hold the paper's words. Where nothing else is said, pyrcal does the same.",
        rows.markdown(budget, store),
        "## Table 1: step by step",
        tables.table_1(budget, store),
        "## The registration found",
        tables.registration(budget, store),
        "## Table 2: the closed loop by day",
        tables.table_2(budget, store),
        "## Why 147 nm are not reached",
        tables.illumination(budget, store),
        "## Calibration patterns",
        tables.patterns(budget, store),
        *_figures(budget, store),
        "## What the paper leaves open",
        tables.open_questions(budget, store),
    ]
    return "\n\n".join(parts) + "\n"


def _opening(budget: Budget) -> str:
    rehearsal = (
        ""
        if budget.name == "full"
        else "**This is a rehearsal with few frames and one telescope: its numbers show that "
        "everything works, not how well.**\n\n"
    )
    return (
        f"{rehearsal}The paper (MNRAS 481, 2829) calibrates an adaptive telescope with a synthetic "
        "interaction matrix whose misregistration is fitted to a measured one. This page does the "
        "same on a simulated telescope: the paper's figures 13 and 14 and its Table 2 were "
        "measured at the LBT, ours are simulated."
    )


def _conditions(budget: Budget, minutes: float) -> str:
    frames = plan.measurement(budget, budget.seeds[0]).n_frames
    return (
        "- **Command**: `make paper`, which writes this page; "
        f"{datetime.now(UTC).date().isoformat()}, {minutes:.0f} minutes of processor time on two "
        "shared cores.\n"
        "- **Telescope**: a diffractive simulation of FLAO at the LBT "
        "(`service/instrument/packaged/flao-lbt.toml`) with another pupil grid and mirror than the "
        "model, light uneven by 10 % and displaced actuators, at the registration of equation 10. "
        f"{len(budget.seeds)} telescopes differ in imperfections, noise and turbulence; single "
        f"numbers are of telescope {budget.seeds[0]}.\n"
        "- **Measured matrix**: by day in double pass, fibre of magnitude 7, 400 KL modes of 20 nm "
        f"RMS, each pushed and pulled {budget.n_average} times in a shaking dome: {frames} "
        "frames.\n"
        f"- **Loops**: 1 kHz, two frames of delay; by night gain {plan.NIGHT_GAIN:g} and "
        f"{budget.influence_frames} frames, by day the gains of the ramp and "
        f"{budget.closed_frames} frames. The paper prints neither wind, frame rate, gain nor flux "
        "by night: levels agree only as far as these choices do."
    )


def _figures(budget: Budget, store: Store) -> Iterable[str]:
    for number in DRAWN:
        heading = f"Figure {number}: {captions.TITLES[number]}"
        yield f"## {heading}"
        yield f"![{heading}]({PICTURES}/{file_name(number)})"
        yield captions.CAPTIONS[number](budget, store)
