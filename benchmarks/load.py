"""REST under load: 50 clients beside 1 kHz of telemetry.

``python -m benchmarks.load [--seconds 60] [--page docs/results/link.md]``

FLAO at 1 kHz in auto, without keys. 50 clients, each with a connection of its own, request one page
after the other, and another client orders a stop every two seconds.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import httpx

from benchmarks import load_page
from benchmarks.rest import PAGES
from benchmarks.standing import Sample, Standing, standing
from pyrcal_studies.sections import write_section

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
    parser = argparse.ArgumentParser(prog="make load")
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of the run")
    parser.add_argument("--folder", type=Path, default=Path("var/load"), help="is emptied first")
    parser.add_argument("--page", type=Path, help="page with a section 'load'")
    options = parser.parse_args(arguments)
    with standing(options.folder) as found:
        for page in PAGES:  # of its life the service has only one first answer of each kind
            found.ask(page)
        run = phase(found, options.seconds)
    rows = load_page.judge(run)
    text = load_page.section(run, rows, os.cpu_count() or 1)
    (options.folder / "load.md").write_text(text, encoding="utf-8")
    load_page.plot(options.folder / "load.png", run)
    if options.page:
        write_section(options.page, "load", text)
        load_page.plot(options.page.with_name("load.png"), run)
    sys.stdout.write(text)
    return int(not all(row.reached for row in rows))


if __name__ == "__main__":
    sys.exit(main())
