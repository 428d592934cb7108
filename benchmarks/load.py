"""REST under load beside 1 kHz of telemetry: clients alone, then beside a crowd that only waits.

``python -m benchmarks.load [--seconds 60] [--page docs/results/load.md]``

FLAO at 1 kHz in auto, without keys. First 50 clients, each with a connection of its own, ask one
page after the other; then they do so beside connections that say nothing, heads and bodies that
come a byte a second, and somebody who orders a stop every two seconds. The crowd comes back
whenever it is turned out. It runs in a process of its own.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from pathlib import Path

import httpx

from benchmarks import load_page
from benchmarks.rest import PAGES
from benchmarks.standing import Sample, Standing, standing

CLIENTS = 50
PAUSE_S = 0.5
ORDER_S = 2.0
"""Between a stop and the next."""

BYTE_S = 1.0
"""Between two bytes of a slow head or body."""

AGAIN_S = 0.5
"""Of somebody turned out, before he comes back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Crowd:
    """So many connections that only take places."""

    idle: int
    heads: int
    bodies: int


NOBODY = Crowd(idle=0, heads=0, bodies=0)
EVERYBODY = Crowd(idle=1000, heads=200, bodies=200)


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
    """One part of the run."""

    crowd: Crowd
    seen: Seen
    before: Sample
    after: Sample
    own_cores: float
    """What the clients themselves took of a processor."""


# --- the crowd, a process of its own


def stand_about(port: int, crowd: Crowd, over: Event) -> None:
    """Hold connections until it is over."""
    asyncio.run(_stand_about(port, crowd, over))


async def _stand_about(port: int, crowd: Crowd, over: Event) -> None:
    orders = itertools.cycle(("/v1/stop", "/v1/fits", "/v1/refit"))
    begin = [b""] * crowd.idle + [b"GET /v1/state HTTP/1.1\r\nHost: 127.0.0.1\r\nX-"] * crowd.heads
    begin += [_body_to(next(orders)) for _ in range(crowd.bodies)]
    tasks = [asyncio.create_task(_one(port, text)) for text in begin]
    await asyncio.to_thread(over.wait)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def _body_to(path: str) -> bytes:
    head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 100000\r\n"
    return head.encode() + b"Content-Type: application/json\r\n\r\n{"


async def _one(port: int, begin: bytes) -> None:
    """Connect, say ``begin`` and then a byte at a time; come back when turned out."""
    while True:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
        except OSError:
            await asyncio.sleep(AGAIN_S)
            continue
        drip = asyncio.create_task(_drip(writer, begin))
        try:
            while await reader.read(4096):
                pass
        except OSError:
            pass
        finally:
            drip.cancel()
            writer.close()
        await asyncio.sleep(AGAIN_S)


async def _drip(writer: asyncio.StreamWriter, begin: bytes) -> None:
    writer.write(begin)
    while begin:
        await asyncio.sleep(BYTE_S)
        writer.write(b"x")


# --- those who want something


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


def phase(found: Standing, crowd: Crowd, seconds: float) -> Phase:
    """Return what clients meet beside a crowd."""
    spawn = multiprocessing.get_context("spawn")
    over, seen = spawn.Event(), Seen()
    port = int(found.url.rpartition(":")[2])
    bystanders = spawn.Process(target=stand_about, args=(port, crowd, over), daemon=True)
    bystanders.start()
    time.sleep(5.0)  # until all of them have come
    before, own_s = found.sample(), time.process_time()
    asyncio.run(_everybody(found.url, seconds, seen))
    own_cores = (time.process_time() - own_s) / seconds
    after = found.sample()
    over.set()
    bystanders.join(10.0)
    return Phase(crowd=crowd, seen=seen, before=before, after=after, own_cores=own_cores)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, write page and plot; return 1 where a figure is not reached."""
    parser = argparse.ArgumentParser(prog="make load")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each of the two parts")
    parser.add_argument("--folder", type=Path, default=Path("var/load"), help="is emptied first")
    parser.add_argument("--page", type=Path, help="of results, Markdown; the plot beside it")
    options = parser.parse_args(arguments)
    with standing(options.folder) as found:
        for page in PAGES:  # of its life the service has only one first answer of each kind
            found.ask(page)
        phases = [phase(found, crowd, options.seconds) for crowd in (NOBODY, EVERYBODY)]
    rows = load_page.judge(phases)
    text = load_page.page(phases, rows, os.cpu_count() or 1)
    path = options.page or options.folder / "load.md"
    path.write_text(text, encoding="utf-8")
    load_page.plot(path.with_suffix(".png"), phases)
    sys.stdout.write(text)
    return int(not all(row.reached for row in rows))


if __name__ == "__main__":
    sys.exit(main())
