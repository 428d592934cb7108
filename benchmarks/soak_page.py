"""The section ``soak`` of docs/results/link.md, written by ``benchmarks.soak``, and its plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks.standing import Sample

WARM_UP_S = 300.0
"""Caches, the last telemetry and a first night's records are there; of a short run a quarter."""

GROWTH_MB = 1.0
"""In ten minutes, at most."""

ARCHIVE_MB = 20.0
"""In an hour, at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A figure beside what is asked."""

    what: str
    found: str
    asked: str
    reached: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Growth:
    """Slope of a quantity over time: the median of all pairs, and its interval of 95 %."""

    slope: float
    low: float
    high: float

    def per(self, seconds: float) -> str:
        """Return it in words."""
        ends = f"{seconds * self.low:+.2f} to {seconds * self.high:+.2f}"
        return f"{seconds * self.slope:+.2f} MB ({ends})"


def warm(samples: Sequence[Sample]) -> list[Sample]:
    """Return the samples after the warm-up."""
    after_s = min(WARM_UP_S, samples[-1].t_s / 4.0)
    return [sample for sample in samples if sample.t_s >= after_s]


def growth(samples: Sequence[Sample], name: str) -> Growth:
    """Return how a field grows in a second: Theil and Sen's slope, which few outliers move."""
    t_s, values = (np.array([getattr(one, key) for one in samples]) for key in ("t_s", name))
    slope, _, low, high = stats.theilslopes(values, t_s)
    return Growth(slope=float(slope), low=float(low), high=float(high))


def judge(samples: Sequence[Sample]) -> list[Row]:
    """Return what was found beside what is asked."""
    first, last, kept = samples[0], samples[-1], warm(samples)
    lost = last.frames_lost - first.frames_lost
    overwritten = last.frames_overwritten - first.frames_overwritten
    memory, written_mb = growth(kept, "service_mb"), last.archive_mb - first.archive_mb
    hour_mb = kept[0].archive_mb - first.archive_mb
    warm_s = max(last.t_s - kept[0].t_s, 1.0)
    hour_mb += (last.archive_mb - kept[0].archive_mb) * (3600.0 - kept[0].t_s) / warm_s
    return [
        Row(
            what="frames lost, overwritten",
            found=f"{lost}, {overwritten} of {last.frames_received - first.frames_received}",
            asked="0, 0",
            reached=lost == overwritten == 0,
        ),
        Row(
            what="memory of the service, growth in 10 minutes after the warm-up",
            found=memory.per(600.0),
            asked=f"< {GROWTH_MB:g} MB",
            reached=600.0 * memory.slope < GROWTH_MB,
        ),
        Row(
            what="archive, first hour",
            found=f"{hour_mb:.1f} MB, from the {written_mb:.1f} MB written",
            asked=f"<= {ARCHIVE_MB:g} MB",
            reached=hour_mb <= ARCHIVE_MB,
        ),
    ]


def section(
    samples: Sequence[Sample], rows: Sequence[Row], counts: Mapping[str, int], cores: int
) -> str:
    """Return the section in Markdown."""
    first, last, kept = samples[0], samples[-1], warm(samples)
    elapsed_s = last.t_s - first.t_s
    load = np.array([sample.load for sample in samples])
    alarms = sorted({name for sample in samples for name in sample.alarms})
    lines = [f"| {row.what} | {row.found} | {row.asked} |" for row in rows]
    facts = [
        f"{cores} cores, load {load.min():.1f} to {load.max():.1f}, mean {load.mean():.1f}",
        f"{last.windows - first.windows} windows used, "
        f"{last.reconstructors} reconstructors in the archive at the end",
        f"service {_core(first, last, 'service_cpu_s')} of a core, its worker "
        f"{_core(first, last, 'worker_cpu_s')}",
        f"memory of the service {kept[0].service_mb:.0f} MB after {kept[0].t_s / 60.0:.0f} "
        f"minutes, {last.service_mb:.0f} MB at the end; of its worker and of fits of uploads at "
        f"most {max(sample.others_mb for sample in samples):.0f} MB, growth of the worker "
        f"{growth(kept, 'others_mb').per(600.0)} in 10 minutes",
        f"threads {_range(kept, 'threads')}, descriptors {_range(kept, 'files')}",
        "requests: " + ", ".join(f"{count} {what}" for what, count in sorted(counts.items())),
        "alarms seen: " + (", ".join(alarms) or "none"),
    ]
    head = f"| {elapsed_s / 60.0:.0f} minutes | Measured | Target |\n| --- | --- | --- |"
    return "\n".join([head, *lines, "", *(f"- {fact}" for fact in facts)])


def plot(path: Path, samples: Sequence[Sample]) -> None:
    """Draw memory, archive, processor time and load over time."""
    from matplotlib.figure import Figure

    minutes = np.array([sample.t_s for sample in samples]) / 60.0
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    memory, archive, machine = figure.subplots(3, 1, sharex=True)
    for name, label in (("service_mb", "service"), ("others_mb", "worker, and fits of uploads")):
        memory.plot(minutes, [getattr(sample, name) for sample in samples], label=label)
    memory.axvspan(0.0, warm(samples)[0].t_s / 60.0, color="#dddddd", label="warm-up")
    memory.set_ylabel("memory, MB")
    memory.set_ylim(bottom=0.0)
    memory.legend(fontsize=8)
    archive.plot(minutes, [sample.archive_mb for sample in samples])
    archive.set_ylabel("archive, MB")
    machine.plot(minutes, [sample.load for sample in samples], color="#aa3377", label="load")
    cores = np.diff([sample.service_cpu_s for sample in samples]) / np.diff(60.0 * minutes)
    machine.plot(minutes[1:], 10.0 * cores, color="#4477aa", label="service, tenths of a core")
    machine.set_xlabel("minutes")
    machine.legend(fontsize=8)
    for axes in (memory, archive, machine):
        axes.grid(alpha=0.4)
    figure.savefig(path, dpi=80)


def _core(first: Sample, last: Sample, name: str) -> str:
    return f"{(getattr(last, name) - getattr(first, name)) / (last.t_s - first.t_s):.3f}"


def _range(samples: Sequence[Sample], name: str) -> str:
    values = [getattr(sample, name) for sample in samples]
    return f"{min(values)} to {max(values)}"
