"""The section ``bench`` of docs/results/speed.md, written by ``benchmarks.bench``, and its plot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
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


def section(rows: Sequence[Row], alone: Sequence[Alone], facts: Sequence[str]) -> str:
    """Return the section of docs/results/speed.md in Markdown: one row for each piece of work."""
    lines = [
        "| Work | pyrcal, s | Other code, s | Ratio: median (range over rounds) |",
        "| --- | --- | --- | --- |",
    ]
    for what, group in groupby(rows, lambda row: row.what):
        compared = list(group)
        own = _figure(float(np.median(compared[0].own_s)))
        peers = "; ".join(f"{row.peer} {_figure(float(np.median(row.peer_s)))}" for row in compared)
        lines.append(f"| {what} | {own} | {peers} | {'; '.join(map(_ratio, compared))} |")
    remarks = list(dict.fromkeys(f"{row.peer}: {row.remark}" for row in rows))
    remarks += [f"{one.what}: {one.found}; target {one.asked}" for one in alone]
    return "\n".join([*lines, "", *(f"- {line}" for line in [*remarks, *facts])])


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


def _ratio(row: Row) -> str:
    middle, low, high = row.spread
    spread = f" ({_figure(low)} to {_figure(high)})" if len(row.own_s) > 1 else ""
    return f"{_figure(middle)}{spread}"


def _figure(value: float) -> str:
    """Return a figure with as many digits as it is worth."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
