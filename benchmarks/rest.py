"""REST under many clients while the service ingests: how long answers take, and what is lost.

``python -m benchmarks.rest [--url URL] [--clients 50] [--every 0.5] [--seconds 30]``, beside a
running service with an RTC, such as ``make demo``, over plain HTTP. Each client has a connection of
its own, asks for one page after the other, and pauses between; all of them are in this one process,
whose own processor time is told, for on two cores it is part of what is measured.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from typing import Any

import httpx
import numpy as np

PAGES = (
    "/v1/state",
    "/v1/alpha",
    "/v1/reconstructors",
    "/v1/alpha/history?limit=200",
    "/v1/events?limit=200",
    "/v1/alarms",
    "/v1/audit?limit=50",
    "/metrics",
)

REACH_S = 0.05
"""Of the 99th percentile."""


async def client(url: str, k: int, every_s: float, until_s: float) -> list[tuple[str, float]]:
    """Ask until it is time; return page and seconds of each answer.

    Raises
    ------
    httpx.HTTPError
        If one is refused, or none comes.
    """
    took: list[tuple[str, float]] = []
    # without certificates, which take each client 20 ms of a processor to read
    async with httpx.AsyncClient(base_url=url, timeout=10.0, verify=False) as asking:
        await asyncio.sleep(every_s * (k % 50) / 50.0)
        while time.monotonic() < until_s:
            page = PAGES[(k + len(took)) % len(PAGES)]
            begun_s = time.perf_counter()
            (await asking.get(page)).raise_for_status()
            took.append((page, time.perf_counter() - begun_s))
            await asyncio.sleep(every_s)
    return took


async def measure(options: argparse.Namespace) -> tuple[list[tuple[str, float]], Any, Any]:
    """Return what all clients have seen, and the link before and after."""
    async with httpx.AsyncClient(base_url=options.url, timeout=10.0) as asking:
        for page in PAGES:  # of its life the service has only one first answer of each kind
            (await asking.get(page)).raise_for_status()
        before = (await asking.get("/v1/state")).json()["link"]
        until_s = time.monotonic() + options.seconds
        clients = [client(options.url, k, options.every, until_s) for k in range(options.clients)]
        took = [answer for one in await asyncio.gather(*clients) for answer in one]
        return took, before, (await asking.get("/v1/state")).json()["link"]


def main() -> int:
    """Measure, print, and return 1 where answers were late or a frame was lost."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rest")
    parser.add_argument("--url", default="http://127.0.0.1:8080")
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--every", type=float, default=0.5, help="pause of each, seconds")
    parser.add_argument("--seconds", type=float, default=30.0)
    options = parser.parse_args()
    took, before, after = asyncio.run(measure(options))
    own = time.process_time() / options.seconds
    for page in ("", *PAGES):
        ms = 1e3 * np.array([seconds for one, seconds in took if page in {"", one}])
        p50, p99 = np.percentile(ms, [50, 99])
        sys.stdout.write(
            f"{page or 'all':28} {len(ms):6} answers  p50 {p50:6.1f}  p99 {p99:6.1f}  "
            f"max {ms.max():6.1f} ms\n"
        )
    frames, lost, overwritten = (
        after[name] - before[name]
        for name in ("frames_received", "frames_lost", "frames_overwritten")
    )
    sys.stdout.write(
        f"{len(took) / options.seconds:.0f} answers a second; {frames} frames came, {lost} lost, "
        f"{overwritten} overwritten; the clients took {own:.2f} of a core\n"
    )
    p99_s = float(np.percentile([seconds for _, seconds in took], 99))
    return int(p99_s > REACH_S or lost > 0 or overwritten > 0)


if __name__ == "__main__":
    sys.exit(main())
