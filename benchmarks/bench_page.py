"""The page of results of ``benchmarks.bench``, and its plot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One piece of work, by pyrcal and by a peer."""

    what: str
    peer: str
    own_s: tuple[float, ...]
    """Of pyrcal, round by round."""

    peer_s: tuple[float, ...]
    """Of the peer, in the same rounds."""

    remark: str
    """How far the two differ."""

    @property
    def spread(self) -> tuple[float, float, float]:
        """Time of the peer over ours: median over the rounds, least and most."""
        ratios = np.array(self.peer_s) / np.array(self.own_s)
        return float(np.median(ratios)), float(ratios.min()), float(ratios.max())


@dataclass(frozen=True, slots=True, kw_only=True)
class Alone:
    """One figure of pyrcal's that no peer has."""

    what: str
    found: str
    asked: str


def page(rows: Sequence[Row], alone: Sequence[Alone], facts: Sequence[str]) -> str:
    """Return the page in Markdown."""
    head = (
        "# pyrcal beside other codes\n\n"
        "`make bench` writes this page: the same work, alternating, in one run; processor time of "
        "one thread, seconds; the ratio is the median over the rounds, with its range. Peers push "
        "and pull a few modes in each round, scaled to all; derivatives are two matrices each. "
        "*Differ*: what the model does not explain of the peer's columns, 4 points a subaperture, "
        "28 points of modulation, at a registration of .31, -.17 subapertures, .6 deg, 1.004. "
        "α: SPRINT (6 iterations) reads matrices of its own model, `pyrcal fit` the same matrices, "
        "of another code, beginning with their axes.\n"
    )
    lines = ["| what | pyrcal | peer | | times | |", "| --- | --- | --- | --- | --- | --- |"]
    for row in rows:
        middle, low, high = row.spread
        spread = f" ({_figure(low)} to {_figure(high)})" if len(row.own_s) > 1 else ""
        own, peer = (_figure(float(np.median(times))) for times in (row.own_s, row.peer_s))
        lines.append(
            f"| {row.what} | {own} | {row.peer} | {peer} | **{_figure(middle)}**{spread} "
            f"| {row.remark} |"
        )
    lines += ["", "| pyrcal alone | found | asked |", "| --- | --- | --- |"]
    lines += [f"| {one.what} | {one.found} | {one.asked} |" for one in alone]
    told = "\n".join(f"- {fact}" for fact in facts)
    return f"{head}\n![ratios](bench.png)\n\n" + "\n".join(lines) + f"\n\n{told}\n"


def plot(path: Path, rows: Sequence[Row]) -> None:
    """Draw how many times faster pyrcal is, row by row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 0.36 * len(rows) + 1.0), layout="constrained")
    axes = figure.subplots()
    at = np.arange(len(rows))[::-1]
    middle, low, high = np.array([row.spread for row in rows]).T
    axes.barh(
        at,
        middle,
        xerr=(middle - low, high - middle),
        color="#4477aa",
        ecolor="#222222",
        height=0.7,
    )
    axes.set_yticks(at, [f"{row.what}: {row.peer.split(',')[0]}" for row in rows], fontsize=8)
    axes.set_xscale("log")
    axes.axvline(1.0, color="#222222", linewidth=0.8)
    axes.set_xlabel("processor time of the peer over pyrcal's")
    axes.grid(axis="x", alpha=0.4)
    figure.savefig(path, dpi=90)


def _figure(value: float) -> str:
    """Return a figure with as many digits as it is worth."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
