"""The section ``load`` of docs/results/link.md, written by ``benchmarks.load``, and its plot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.soak_page import Row

if TYPE_CHECKING:
    from benchmarks.load import Phase, Seen

ANSWER_MS = 50.0
"""Of the 99th percentile."""

STOP_S = 1.0
"""Of the slowest."""


def judge(phase: Phase) -> list[Row]:
    """Return what was measured beside what is asked."""
    seen, first, last = phase.seen, phase.before, phase.after
    p50, p99 = 1e3 * np.percentile(seen.answers_s, [50, 99])
    lost = last.frames_lost - first.frames_lost
    overwritten = last.frames_overwritten - first.frames_overwritten
    return [
        Row(
            what="answers, 99th percentile",
            found=f"{p99:.0f} ms (median {p50:.0f}, slowest {1e3 * max(seen.answers_s):.0f}, "
            f"{len(seen.answers_s)} answers)",
            asked=f"<= {ANSWER_MS:g} ms",
            reached=bool(p99 <= ANSWER_MS),
        ),
        Row(
            what="order to stop, the slowest",
            found=f"{max(seen.stops_s):.2f} s (median {np.median(seen.stops_s):.2f}, "
            f"{len(seen.stops_s)} orders)",
            asked=f"<= {STOP_S:g} s",
            reached=max(seen.stops_s) <= STOP_S,
        ),
        Row(
            what="frames lost, overwritten",
            found=f"{lost}, {overwritten} of {last.frames_received - first.frames_received}",
            asked="0, 0",
            reached=lost == overwritten == 0,
        ),
    ]


def section(phase: Phase, rows: Sequence[Row], cores: int) -> str:
    """Return the section in Markdown."""
    head = f"| {phase.after.t_s - phase.before.t_s:.0f} s | Measured | Target |"
    lines = [f"| {row.what} | {row.found} | {row.asked} |" for row in rows]
    return "\n".join([head, "| --- | --- | --- |", *lines, "", f"{_facts(phase)}; {cores} cores"])


def _facts(phase: Phase) -> str:
    first, last = phase.before, phase.after
    cores = (last.service_cpu_s - first.service_cpu_s) / (last.t_s - first.t_s)
    return (
        f"Load {first.load:.1f} to {last.load:.1f}; the service took {cores:.2f} of "
        f"a core, the clients {phase.own_cores:.2f}; memory {first.service_mb:.0f} to "
        f"{last.service_mb:.0f} MB; {_trouble(phase.seen)}"
    )


def _trouble(seen: Seen) -> str:
    refused = ", ".join(f"{n} times {what}" for what, n in Counter(seen.refused).most_common())
    return f"{seen.turned_out} connections ended before their answer; refused: {refused or 'none'}"


def plot(path: Path, phase: Phase) -> None:
    """Draw which share of the answers took longer."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for kind, answers, style in (
        ("answers", phase.seen.answers_s, "-"),
        ("orders to stop", phase.seen.stops_s, ":"),
    ):
        ms = np.sort(1e3 * np.array(answers))
        share = 1.0 - np.arange(len(ms)) / len(ms)
        axes.plot(ms, share, style, label=kind)
    axes.axvline(ANSWER_MS, color="#222222", linewidth=0.8)
    axes.axhline(0.01, color="#222222", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("milliseconds")
    axes.set_ylabel("share that took longer")
    axes.grid(alpha=0.4)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=80)
