"""The report: a summary beside the paper's values, then the sections, then what it took."""

from __future__ import annotations

import platform
from pathlib import Path

import numpy as np

import service
from pyrcal_studies.heritier2018 import (
    closed,
    curves,
    influence,
    loops,
    matrices,
    page,
    paper,
    scans,
    simulator,
    table2,
)
from pyrcal_studies.heritier2018.calibration import MeasuredPart
from pyrcal_studies.heritier2018.loops import LoopRun
from pyrcal_studies.heritier2018.plan import (
    INFLUENCE_MODES,
    SWEEPS,
    TRUTH,
    Budget,
    Variant,
    every_task,
    fits_from_random_starts,
    joint_fit,
)
from pyrcal_studies.heritier2018.psf import strehl
from pyrcal_studies.heritier2018.registration import errors, is_right
from pyrcal_studies.heritier2018.store import Store, in_order
from service.model.kinds import Method
from service.model.misregistration import PARAMETERS

TITLE = "Heritier et al. 2018 on the simulated telescope"


def write(budget: Budget, store: Store, path: Path, *, seconds: float) -> None:
    """Write the report of a run whose tasks are all done; ``seconds`` is what it took just now."""
    sections = (
        influence.section(budget, store),
        scans.section(budget, store),
        matrices.section(budget, store),
        simulator.section(budget, store),
        closed.section(budget, store),
        _conditions(budget, seconds),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page.page(TITLE, _opening(budget, store), sections), encoding="utf-8")


def _opening(budget: Budget, store: Store) -> str:
    text = (
        "A new calibration strategy for adaptive telescopes with pyramid WFS (MNRAS 481, 2829), "
        "replayed: a diffractive simulation of FLAO at the LBT has a registration that the "
        "calibration does not know, an interaction matrix is measured on it as by day, the "
        "registration is found in that matrix, and the loop is closed with the measured and with "
        "the synthetic matrix. Every number under 'here' comes from the run."
    )
    opening = page.paragraph(text)
    if budget.name != "full":
        opening += page.remark(
            f"This is the rehearsal '{budget.name}': few frames, one telescope. Its numbers show "
            "that everything works, not how well.",
            agrees=False,
        )
    return opening + page.table(["", "here", "the paper"], summary(budget, store), words=(1, 2))


def summary(budget: Budget, store: Store) -> list[list[str]]:
    """Return the rows of the summary: what, here, in the paper."""
    return [
        *_registration_rows(budget, store),
        *_influence_rows(budget, store),
        *_matrix_rows(budget, store),
        *_simulator_rows(budget, store),
        *_loop_rows(budget, store),
    ]


def _registration_rows(budget: Budget, store: Store) -> list[list[str]]:
    seed = budget.seeds[0]
    off = errors(store.read(joint_fit(budget, seed)), TRUTH)
    quoted = " / ".join(paper.REGISTRATION[name].text for name in PARAMETERS)
    rows = [
        ["registration (α_x, α_y, α_rot, α_magn)", "hidden truth: the paper's", quoted],
        [
            "error of the joint fit",
            f"{off[0]:+.2f} % / {off[1]:+.2f} % / {off[2]:+.4f} deg / {off[3]:+.3f} %",
            "truth not known",
        ],
    ]
    counts = []
    for method in (Method.JOINT, Method.PAPER):
        found = [store.read(run) for run in fits_from_random_starts(budget, method)]
        counts.append(f"{sum(is_right(r, TRUTH) for r in found)} of {len(found)} ({method})")
    return [*rows, ["right from random starts", ", ".join(counts), "one start"]]


def _influence_rows(budget: Budget, store: Store) -> list[list[str]]:
    found = curves.curves(budget, store)
    rule = 100.0 * SWEEPS[0].border_subap(1.0)
    rows = [
        [
            "1 deg at the border",
            f"{rule:.1f} % of a subaperture",
            f"{paper.BORDER_RULE.values[0]:g} %",
        ]
    ]
    for n_modes in INFLUENCE_MODES:
        tolerances = curves.border_tolerances(found, n_modes)
        listed = ", ".join(f"{100 * v:.0f} % ({symbol})" for symbol, v in tolerances.items())
        rows.append(
            [
                f"movement of the border that costs {curves.COSTLY_NM:g} nm, {n_modes} modes",
                listed or "not reached",
                "figure only",
            ]
        )
    return rows


def _matrix_rows(budget: Budget, store: Store) -> list[list[str]]:
    record = store.read(matrices.comparison(budget))
    numbers = [
        f"{matrices.condition(record[f'singular_{name}']):.2f}"
        for name in ("synthetic", "measured")
    ]
    quoted = f"{paper.CONDITION_SYNTHETIC.text} / {paper.CONDITION_MEASURED.text}"
    return [["condition number, synthetic / measured", " / ".join(numbers), quoted]]


def _simulator_rows(budget: Budget, store: Store) -> list[list[str]]:
    synthetic, measured = np.array(list(simulator.errors_nm(budget, store).values())).T
    rows = []
    for word, found, quoted in (
        ("synthetic", synthetic, paper.SIMULATED_SYNTHETIC),
        ("measured", measured, paper.SIMULATED_MEASURED),
    ):
        name = f"loop of the simulator, {word} matrix, {len(found)} matrices"
        rows.append([name, f"{found.min():.1f} to {found.max():.1f} nm", quoted.text])
    return rows


def _loop_rows(budget: Budget, store: Store) -> list[list[str]]:
    rows = []
    for key, variant in table2.ROWS.items():
        quoted = paper.TABLE_2[key]
        theirs = " / ".join(f"{value:g}" for value in quoted.errors_nm) + " nm"
        for over in loops.Over:
            found = table2.ours_nm(budget, store, variant, over).mean(axis=0)
            ours = " / ".join(f"{value:.1f}" for value in found) + " nm"
            name = f"Table 2, {quoted.name}: {', '.join(table2.COLUMNS)}, over {over}"
            rows.append([name, ours, theirs])
    images = [
        np.mean([strehl(r["image"]) for r in closed.records(budget, store, v, vibrations=True)])
        for v in (Variant.MEASURED, Variant.TUNED, Variant.MORE)
    ]
    strehls = " / ".join(f"{value:.3f}" for value in images)
    return [*rows, ["Strehl in H with vibrations", strehls, "figure only"]]


def _conditions(budget: Budget, seconds: float) -> page.Section:
    tasks = in_order((*every_task(budget), matrices.comparison(budget)))
    loops = [task for task in tasks if isinstance(task, LoopRun)]
    night = [task for task in loops if not task.occasion.daytime]
    day = [task for task in loops if task.occasion.daytime]
    parts = [task for task in tasks if isinstance(task, MeasuredPart)]
    measured = {(part.occasion, part.n_average) for part in parts}
    rows = [
        ["loops by night", str(len(night)), f"{_frames(night):,}"],
        ["closed loops by day", str(len(day)), f"{_frames(day):,}"],
        ["measured matrices", str(len(measured)), f"{sum(part.n_frames for part in parts):,}"],
    ]
    body = page.table(["diffractive frames", "runs", "frames"], rows)
    cost = sum(task.cost_s for task in tasks)
    body += page.paragraph(
        f"{len(tasks)} steps, estimated at {cost / 120:.0f} minutes on two idle cores; this call "
        f"worked for {seconds / 60:.1f} minutes on those that were not done yet. pyrcal "
        f"{service.__version__}, numpy {np.__version__}, Python {platform.python_version()}, "
        f"budget '{budget.name}'."
    )
    return page.Section(anchor="conditions", title="What it took", body=body)


def _frames(runs: list[LoopRun]) -> int:
    return sum(run.n_frames_run for run in runs)
