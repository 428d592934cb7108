"""Service and RTC for a long time: what grows, what is lost, what is written.

``python -m benchmarks.soak [--minutes 60] [--folder var/soak] [--page docs/results/link.md]``

FLAO at 1 kHz in auto, dithered without pause, its registration drifting slowly;
a stream as the page has it, ten clients that ask one page after the other, and a matrix that is
uploaded to be fitted every five minutes. Every ten seconds a line of ``samples.jsonl`` says what
there is to see.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import httpx
import numpy as np
from scipy import stats

from benchmarks.standing import PAGES, Sample, Standing, standing
from pyrcal_studies.campaign.rows import RowFile
from pyrcal_studies.shared import study_parser, write_section
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis

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


CLIENTS = 10
PAUSE_S = 1.0
"""Of each client between two questions."""

UPLOAD_S = 300.0
SAMPLE_S = 10.0
DRIFTING = "--drift=0.002,0,0.002,0"
"""Of the registration: .12 subapertures and .12 deg in an hour."""

FOLLOWED = "--drift=0.1,0,0.002,0"
"""With a shape: its references are made again each minute."""


class Company:
    """Those who ask while the service runs: one listener of the stream, clients, an uploader."""

    def __init__(self, url: str, matrix: bytes) -> None:
        self.counts: Counter[str] = Counter()
        self.over = threading.Event()
        self._url, self._matrix = url, matrix

    def start(self, pool: ThreadPoolExecutor) -> None:
        """Begin to ask; :attr:`over` ends it."""
        for k in range(CLIENTS):
            pool.submit(self._counted, self._ask, k)
        pool.submit(self._counted, self._listen)
        pool.submit(self._counted, self._upload)

    def _counted(self, act: Callable[..., None], *words: object) -> None:
        """Do something again and again; an error is counted, and ends nothing."""
        while not self.over.is_set():
            try:
                with httpx.Client(base_url=self._url, timeout=30.0) as client:
                    act(client, *words)
            except httpx.HTTPError as error:
                self.counts[f"{act.__name__.strip('_')}: {type(error).__name__}"] += 1
                self.over.wait(PAUSE_S)

    def _ask(self, client: httpx.Client, k: int) -> None:
        while not self.over.wait(PAUSE_S):
            client.get(PAGES[(k + self.counts["answers"]) % len(PAGES)]).raise_for_status()
            self.counts["answers"] += 1

    def _listen(self, client: httpx.Client) -> None:
        with client.stream("GET", "/v1/stream") as stream:
            for line in stream.iter_lines():
                self.counts["states streamed"] += line == "event: state"
                if self.over.is_set():
                    return

    def _upload(self, client: httpx.Client) -> None:
        while True:
            accepted = client.post("/v1/fits", content=self._matrix).raise_for_status().json()
            while client.get(accepted["links"]["fit"]).status_code == httpx.codes.ACCEPTED:
                if self.over.wait(PAUSE_S):
                    return
            found = client.get(accepted["links"]["fit"]).raise_for_status().json()
            self.counts["uploads not fitted" if "reason" in found else "uploads fitted"] += 1
            if self.over.wait(UPLOAD_S):
                return


def a_matrix() -> bytes:
    """Return an interaction matrix of FLAO as a file for an upload."""
    instrument = load_instrument("flao-lbt")
    model = InteractionModel(instrument, modal_basis(instrument))
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file["interaction_matrix"] = model.interaction_matrix(Misregistration(shift_x_subap=0.1))
    return buffer.getvalue()


def soak(minutes: float, folder: Path, shape_nm: float = 0.0) -> tuple[list[Sample], Counter[str]]:
    """Run all of it; return what was seen."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        matrix = pool.submit(a_matrix).result()
    drift = FOLLOWED if shape_nm else DRIFTING
    with standing(folder, drift) as found, ThreadPoolExecutor(CLIENTS + 2) as pool:
        company = Company(found.url, matrix)
        if shape_nm:
            shape = {"kind": "modes", "frame": "mirror", "unit": "nm", "values": [0, 0, shape_nm]}
            httpx.post(f"{found.url}/v1/references", json=shape).raise_for_status()
        try:
            company.start(pool)
            samples = list(_watch(found, minutes, folder / "samples.jsonl"))
            sets = found.get("/v1/references")["records"] if shape_nm else []
            company.counts["sets of references used"] += sum(
                one["applied_ns_utc"] is not None for one in sets
            )
            return samples, company.counts
        finally:
            company.over.set()


def _watch(found: Standing, minutes: float, path: Path) -> Iterator[Sample]:
    file, begun_s = RowFile(path), time.monotonic()
    while time.monotonic() - begun_s < 60.0 * minutes:
        sample = found.sample()
        file.add(asdict(sample))
        yield sample
        time.sleep(SAMPLE_S)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, write section and plot; return 1 where a figure is not reached."""
    parser = study_parser("benchmarks.soak", __doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--folder", type=Path, default=Path("var/soak"), help="is emptied first")
    parser.add_argument("--shape-nm", type=float, default=0.0, help="mode 2, held and followed")
    parser.add_argument("--page", type=Path, help="page with a section 'soak'")
    options = parser.parse_args(arguments)
    samples, counts = soak(options.minutes, options.folder, options.shape_nm)
    rows = judge(samples)
    text = section(samples, rows, counts, os.cpu_count() or 1)
    (options.folder / "soak.md").write_text(text, encoding="utf-8")
    plot(options.folder / "soak.png", samples)
    if options.page:
        write_section(options.page, "soak", text)
        plot(options.page.with_name("soak.png"), samples)
    sys.stdout.write(text)
    return int(not all(row.reached for row in rows))


if __name__ == "__main__":
    sys.exit(main())
