"""Service and RTC for a long time: what grows, what is lost, what is written.

``python -m benchmarks.soak [--minutes 60] [--folder var/soak] [--page docs/results/soak.md]``

FLAO at 1 kHz in auto, dithered without pause, its registration drifting slowly;
a stream as the page has it, ten clients that ask one page after the other, and a matrix that is
uploaded to be fitted every five minutes. Every ten seconds a line of ``samples.jsonl`` says what
there is to see.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import h5py
import httpx

from benchmarks import soak_page
from benchmarks.rest import PAGES
from benchmarks.standing import Sample, Standing, standing
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis

CLIENTS = 10
PAUSE_S = 1.0
"""Of each client between two questions."""

UPLOAD_S = 300.0
SAMPLE_S = 10.0
DRIFTING = "--drift=0.002,0,0.002,0"
"""Of the registration: .12 subapertures and .12 deg in an hour."""


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


def soak(minutes: float, folder: Path) -> tuple[list[Sample], Counter[str]]:
    """Run all of it; return what was seen."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        matrix = pool.submit(a_matrix).result()
    with standing(folder, DRIFTING) as found, ThreadPoolExecutor(CLIENTS + 2) as pool:
        company = Company(found.url, matrix)
        try:
            company.start(pool)
            return list(_watch(found, minutes, folder / "samples.jsonl")), company.counts
        finally:
            company.over.set()


def _watch(found: Standing, minutes: float, path: Path) -> Iterator[Sample]:
    begun_s = time.monotonic()
    with path.open("w", encoding="utf-8") as file:
        while time.monotonic() - begun_s < 60.0 * minutes:
            sample = found.sample()
            file.write(json.dumps(asdict(sample)) + "\n")
            file.flush()
            yield sample
            time.sleep(SAMPLE_S)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, write page and plot; return 1 where a figure is not reached."""
    parser = argparse.ArgumentParser(prog="make soak")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--folder", type=Path, default=Path("var/soak"), help="is emptied first")
    parser.add_argument("--page", type=Path, help="of results, Markdown; the plot beside it")
    options = parser.parse_args(arguments)
    samples, counts = soak(options.minutes, options.folder)
    rows = soak_page.judge(samples)
    text = soak_page.page(samples, rows, counts, os.cpu_count() or 1)
    page = options.page or options.folder / "soak.md"
    page.write_text(text, encoding="utf-8")
    soak_page.plot(page.with_suffix(".png"), samples)
    sys.stdout.write(text)
    return int(not all(row.reached for row in rows))


if __name__ == "__main__":
    sys.exit(main())
