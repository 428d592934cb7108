"""REST under load: 50 clients beside 1 kHz of telemetry.

``python -m benchmarks.load [--seconds 60] [--page docs/results/link.md]``

FLAO at 1 kHz in auto, without keys. 50 clients, each with a connection of its own, request one page
after the other, and another client orders a stop every two seconds.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np

from benchmarks.soak import Row
from benchmarks.standing import PAGES, Sample, Standing, standing
from pyrcal_studies.shared import study_parser, write_section

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


CLIENTS = 50
PAUSE_S = 0.5
ORDER_S = 2.0
"""Between a stop and the next."""


@dataclass(slots=True, kw_only=True)
class Seen:
    """What clients and operator have met."""

    answers_s: list[float] = field(default_factory=list)
    """From the first try to the answer."""

    stops_s: list[float] = field(default_factory=list)
    """From the order to its answer."""

    turned_out: int = 0
    """Connections that ended before the answer: the client asked again."""

    refused: list[str] = field(default_factory=list)
    """Answers other than 2xx."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Phase:
    """What was measured before, during and after the run."""

    seen: Seen
    before: Sample
    after: Sample
    own_cores: float
    """What the clients themselves took of a processor."""


# --- the clients


async def _answered(client: httpx.AsyncClient, method: str, path: str, seen: Seen) -> float:
    """Ask until there is an answer; return the seconds it took."""
    begun_s = time.perf_counter()
    while True:
        try:
            answer = await client.request(method, path)
        except httpx.TransportError:
            seen.turned_out += 1
            continue
        if not answer.is_success:
            seen.refused.append(f"{method} {path}: {answer.status_code}")
        return time.perf_counter() - begun_s


async def _ask(url: str, k: int, until_s: float, seen: Seen) -> None:
    # without certificates, which take each client 20 ms of a processor to read
    async with httpx.AsyncClient(base_url=url, timeout=30.0, verify=False) as client:
        await asyncio.sleep(PAUSE_S * k / CLIENTS)
        for page in itertools.islice(itertools.cycle(PAGES), k, None):
            if time.monotonic() > until_s:
                return
            seen.answers_s.append(await _answered(client, "GET", page, seen))
            await asyncio.sleep(PAUSE_S)


async def _order(url: str, until_s: float, seen: Seen) -> None:
    """Order a stop and its end again and again, on a new connection each time."""
    while time.monotonic() < until_s:
        async with httpx.AsyncClient(base_url=url, timeout=30.0, verify=False) as client:
            seen.stops_s.append(await _answered(client, "POST", "/v1/stop", seen))
            await _answered(client, "POST", "/v1/resume", seen)
        await asyncio.sleep(ORDER_S)


async def _everybody(url: str, seconds: float, seen: Seen) -> None:
    until_s = time.monotonic() + seconds
    asking = [_ask(url, k, until_s, seen) for k in range(CLIENTS)]
    await asyncio.gather(*asking, _order(url, until_s, seen))


def phase(found: Standing, seconds: float) -> Phase:
    """Return what clients meet."""
    seen, before, own_s = Seen(), found.sample(), time.process_time()
    asyncio.run(_everybody(found.url, seconds, seen))
    own_cores = (time.process_time() - own_s) / seconds
    return Phase(seen=seen, before=before, after=found.sample(), own_cores=own_cores)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, write section and plot; return 1 where a figure is not reached."""
    parser = study_parser("benchmarks.load", __doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of the run")
    parser.add_argument("--folder", type=Path, default=Path("var/load"), help="is emptied first")
    parser.add_argument("--page", type=Path, help="page with a section 'load'")
    options = parser.parse_args(arguments)
    with standing(options.folder) as found:
        for page in PAGES:  # of its life the service has only one first answer of each kind
            found.ask(page)
        run = phase(found, options.seconds)
    rows = judge(run)
    text = section(run, rows, os.cpu_count() or 1)
    (options.folder / "load.md").write_text(text, encoding="utf-8")
    plot(options.folder / "load.png", run)
    if options.page:
        write_section(options.page, "load", text)
        plot(options.page.with_name("load.png"), run)
    sys.stdout.write(text)
    return int(not all(row.reached for row in rows))


if __name__ == "__main__":
    sys.exit(main())
