"""Plot the wavefront error of the demo over time, and before and after."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from pyrcal.demo.report import Report, strehl_ratio
from pyrcal.demo.truth import TruthFile

BEFORE, BETWEEN, AFTER = "#c0392b", "#7f8c8d", "#1f6fb2"
"""Colours of the RTC's own matrix, of the service's first, and of that with more modes."""


def draw(report: Report, truth: TruthFile, path: Path) -> None:
    """Write the figure; nothing is plotted if one of the two stages is missing."""
    figure, (over_time, bars) = plt.subplots(
        1, 2, figsize=(8.4, 3.1), width_ratios=(2.6, 1.0), layout="constrained"
    )
    _over_time(over_time, report, truth)
    _bars(bars, report)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _over_time(axes: Axes, report: Report, truth: TruthFile) -> None:
    lines = [line for line in truth.lines if line["kind"] == "truth"]
    start_ns = lines[0]["t_ns_utc"] if lines else 0
    # The loop has just been closed in the first line.
    later = lines[1:]
    ids = list(dict.fromkeys(line["cm_id"] for line in later))
    top_nm = 1.25 * max((line["wavefront_error_nm"] for line in later), default=1.0)
    for cm_id in ids:
        mine = [line for line in later if line["cm_id"] == cm_id]
        seconds = [(line["t_ns_utc"] - start_ns) * 1e-9 for line in mine]
        colour = BEFORE if cm_id == report.start.id else BETWEEN
        colour = AFTER if mine[0]["n_controlled"] > (report.start.n_modes or 0) else colour
        axes.plot(seconds, [line["wavefront_error_nm"] for line in mine], color=colour, lw=1.8)
        whose = "the RTC's own matrix" if cm_id == report.start.id else "pyrcal's"
        axes.axvline(seconds[0], color=colour, lw=0.8, ls=":")
        text = f"{whose}\n{mine[0]['n_controlled']} modes"
        axes.text(seconds[0] + 0.2, top_nm, text, color=colour, fontsize=8, va="top")
    axes.set(xlabel="s of telemetry", ylabel="wavefront error, nm RMS", ylim=(0.0, top_nm * 1.02))
    axes.spines[["top", "right"]].set_visible(False)


def _bars(axes: Axes, report: Report) -> None:
    for place, (name, stage, colour) in enumerate(
        (("before", report.start, BEFORE), ("after", report.target_modes, AFTER))
    ):
        if stage.wavefront_error_nm is None:
            continue
        axes.bar(place, stage.wavefront_error_nm, width=0.7, color=colour)
        strehl = strehl_ratio(stage.wavefront_error_nm)
        axes.text(
            place,
            stage.wavefront_error_nm,
            f"{stage.wavefront_error_nm:.0f} nm\nStrehl {strehl:.2f}\nat 1.65 µm",
            ha="center",
            va="bottom",
            fontsize=8,
        )
        axes.text(place, 6.0, f"{name}\n{stage.n_modes} modes", ha="center", color="w", fontsize=8)
    axes.set(xticks=[], yticks=[], xlim=(-0.6, 1.6))
    axes.set_ylim(0.0, 1.35 * (report.start.wavefront_error_nm or 1.0))
    axes.spines[["top", "right", "left"]].set_visible(False)
