"""Figures of the pages of results that are drawn from the pages' own tables.

Run: ``python -m pyrcal_studies.result_figures``, which writes ``faults.png``, ``elt.png``,
``shack_hartmann.png`` and ``references.png`` into docs/results.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pyrcal_studies.shared import RESULTS, save_picture

NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")
BLUE = "#4477aa"


def read_table(page: str, heading: str) -> list[list[str]]:
    """Return the cells of the first table after a heading of a page, without its head."""
    text = (RESULTS / page).read_text(encoding="utf-8").partition(f"\n## {heading}\n")[2]
    found = re.search(r"(?:^\|.*\n)+", text, re.M)
    if found is None:
        raise ValueError(f"{page}: no table under {heading!r}")
    lines = found[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def draw_faults(axes: Axes) -> None:
    """Draw when each fault is named after its beginning."""
    rows = read_table("reliability.md", "Faults on real processes")
    at = np.arange(len(rows))[::-1]
    worst = [max((float(s) for s in _seconds(row[1])), default=0.0) for row in rows]
    axes.barh(at, worst, height=0.6, color=BLUE)
    axes.set_yticks(at, [row[0] for row in rows], fontsize=7)
    axes.set_xlabel("named after, seconds (the longest of each row; none: harmless or on return)")
    axes.grid(axis="x", alpha=0.4)


def draw_elt(axes: Axes) -> None:
    """Draw processor times of a telescope of 39 m with their targets."""
    rows = read_table("scale.md", "A telescope of 39 m")
    shown = [row for row in rows if NUMBER.match(row[1]) and "core" not in row[1]]
    at = np.arange(len(shown))[::-1]
    axes.barh(at, [float(NUMBER.findall(row[1])[0]) for row in shown], color=BLUE, height=0.6)
    for y, row in zip(at, shown, strict=True):
        target = re.match(r"(\d+) s", row[3])
        if target:
            axes.plot([float(target[1])] * 2, [y - 0.4, y + 0.4], color="black", linewidth=1.5)
    axes.set_yticks(at, [re.split(r"[;:(,]", row[0])[0].strip() for row in shown], fontsize=8)
    axes.set_xlabel("processor time, s (line: target)")
    axes.grid(axis="x", alpha=0.4)


def draw_lenslets(axes: Axes) -> None:
    """Draw errors over the targets of fits of Shack-Hartmann matrices, with 1 σ."""
    rows = read_table("shack_hartmann.md", "Matrices of OOPAO and SPECULA")
    targets = (0.002, 0.002, 0.005, 2e-4)
    at = np.arange(len(rows))[::-1]
    for k, label in enumerate(("shift x", "shift y", "rotation", "magnification")):
        pairs = [[float(n) for n in NUMBER.findall(row[1 + k])] for row in rows]
        error, sigma = np.array(pairs).T / targets[k]
        axes.errorbar(error, at + 0.24 - 0.16 * k, xerr=sigma, fmt="o", markersize=3, label=label)
    axes.set_yticks(at, [row[0] for row in rows], fontsize=8)
    axes.axvline(0.0, color="black", linewidth=0.6)
    axes.set_xlim(-1.4, 1.4)
    axes.set_xlabel("error over target, with 1 σ (targets 0.002 subaperture, 0.005 deg, 2e-4)")
    axes.legend(fontsize=8)
    axes.grid(axis="x", alpha=0.4)


def draw_references(axes: Axes) -> None:
    """Draw the error of the shape held, by kind of references and seeing."""
    rows = read_table("references.md", "Shapes held")[:4]
    for k, seeing in enumerate(("0.6", "0.9", "1.2")):
        found = [NUMBER.match(row[1 + k]) for row in rows]
        height = [200.0 if number is None else float(number[0]) for number in found]
        axes.bar(np.arange(len(rows)) + 0.27 * (k - 1), height, 0.25, label=f"{seeing} arcsec")
    axes.set_xticks(np.arange(len(rows)), [row[0].replace(", ", ",\n") for row in rows], fontsize=7)
    axes.set(yscale="log", ylim=(1.0, 200.0), ylabel="error, nm (to the top: lost)")
    axes.legend(fontsize=8)
    axes.grid(axis="y", alpha=0.4)


def _seconds(cell: str) -> list[str]:
    """Return the numbers of a cell that are seconds: not those of a name or a kind of answer."""
    return NUMBER.findall(re.sub(r"`[^`]*`", "", cell))


def write_figures(folder: Path) -> None:
    """Draw each figure into a folder."""
    for name, draw, height in (
        ("faults", draw_faults, 5.5),
        ("elt", draw_elt, 3.2),
        ("shack_hartmann", draw_lenslets, 3.6),
        ("references", draw_references, 3.2),
    ):
        figure = Figure(figsize=(8.0, height), layout="constrained")
        draw(figure.subplots())
        save_picture(figure, folder / f"{name}.png")


def main() -> int:
    """Write the figures of docs/results."""
    write_figures(RESULTS)
    return 0


if __name__ == "__main__":
    sys.exit(main())
