"""A service and a simulated RTC of full size, what is asked of them, and what they take.

``benchmarks.soak`` and ``benchmarks.load`` stand on it: FLAO at 1 kHz, in auto, on ports of their
own, without keys.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from pyrcal.demo.children import Child, interrupt_on_end, run_children
from pyrcal_studies.shared import free_port

START_TIMEOUT_S = 240.0
"""For the optics of a first start, and a first matrix, on a machine that has other work."""

ANSWER_TIMEOUT_S = 60.0

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
"""What clients ask for, one after the other."""

_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """What was seen at one moment."""

    t_s: float
    """Since tracking had begun."""

    service_mb: float
    """Resident memory of the service."""

    others_mb: float
    """Of all that the service has started: its worker, a fit."""

    service_cpu_s: float
    """Processor time of the service since its start."""

    worker_cpu_s: float
    """Of the processes that it has started and that still run."""

    archive_mb: float
    """All files of ``data_dir``, as blocks on the disk."""

    load: float
    """Processes that want a processor, the machine's mean of a minute."""

    threads: int
    files: int
    """Descriptors that the service holds."""

    frames_received: int
    frames_lost: int
    frames_overwritten: int
    windows: int
    """Dithered windows that were taken in."""

    reconstructors: int
    alarms: tuple[str, ...]


class Standing:
    """Service and RTC while they run."""

    def __init__(self, url: str, data: Path, service: Child, rtc: Child) -> None:
        self.url, self.data = url, data
        self._service, self._rtc = service, rtc
        self._client = httpx.Client(base_url=url, timeout=30.0)
        self._begun_s = time.monotonic()

    def ask(self, path: str) -> httpx.Response:
        """Return an answer of the service; who is turned out for others asks again.

        Raises
        ------
        SystemExit
            If service or RTC have ended, or no answer comes.
        """
        deadline = time.monotonic() + ANSWER_TIMEOUT_S
        while time.monotonic() < deadline:
            if ended := self._service.ended or self._rtc.ended:
                raise SystemExit(ended)
            try:
                return self._client.get(path).raise_for_status()
            except httpx.TransportError:
                time.sleep(0.1)
        raise SystemExit(f"GET {path}: found no answer within {ANSWER_TIMEOUT_S:.0f} s")

    def get(self, path: str) -> Any:  # noqa: ANN401 - JSON
        """Return the JSON of an answer."""
        return self.ask(path).json()

    def wait_until_tracking(self) -> None:
        """Wait for a registration, and a matrix of the service's own on the mirror."""
        deadline = time.monotonic() + START_TIMEOUT_S
        while True:
            state = self.get("/v1/state")
            if state["registration"] is not None and str(state["in_use"]).startswith("cm-"):
                self._begun_s = time.monotonic()
                return
            if time.monotonic() > deadline:
                raise SystemExit(f"found no matrix in use within {START_TIMEOUT_S:.0f} s")
            time.sleep(0.5)

    def sample(self) -> Sample:
        """Return what is to be seen now."""
        state, pid = self.get("/v1/state"), self._service.process.pid
        others = list(_descendants(pid))
        link, status = state["link"], _status(pid)
        return Sample(
            t_s=time.monotonic() - self._begun_s,
            service_mb=status["VmRSS"] * 1024e-6,
            others_mb=sum(_status(other).get("VmRSS", 0) for other in others) * 1024e-6,
            service_cpu_s=_processor_s(pid),
            worker_cpu_s=sum(_processor_s(other) for other in others),
            archive_mb=size_mb(self.data),
            load=os.getloadavg()[0],
            threads=status["Threads"],
            files=len(os.listdir(f"/proc/{pid}/fd")),
            frames_received=link["frames_received"],
            frames_lost=link["frames_lost"],
            frames_overwritten=link["frames_overwritten"],
            windows=state["windows_accepted"],
            reconstructors=len(self.get("/v1/reconstructors")["reconstructors"]),
            alarms=tuple(alarm["name"] for alarm in state["alarms"]),
        )


@contextmanager
def standing(folder: Path, *simulator: str) -> Iterator[Standing]:
    """Run service and RTC while the ``with`` block lasts; ``folder`` is emptied first."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    port, endpoint = free_port(), f"tcp/127.0.0.1:{free_port()}"
    data = folder / "data"
    run = ["-m", "pyrcal", "run", "--mode", "auto", "--listen", endpoint, "--port", str(port)]
    sim = ["-m", "pyrcal", "sim", "--connect", endpoint, "--quiet", "--seed", "5", *simulator]
    commands = {"service": [*run, "--data-dir", str(data)], "simulator": sim}
    with interrupt_on_end(), run_children(folder, commands) as (service, rtc):
        found = Standing(f"http://127.0.0.1:{port}", data, service, rtc)
        found.wait_until_tracking()
        yield found


def size_mb(folder: Path) -> float:
    """Return what a folder takes of the disk."""
    blocks = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            blocks += path.stat().st_blocks
    return blocks * 512e-6


def _status(pid: int) -> dict[str, int]:
    """Return the numbers of a process's status; none: it has ended."""
    found = {}
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
            name, _, value = line.partition(":")
            if name in {"VmRSS", "Threads"}:
                found[name] = int(value.split()[0])
    return found


def _processor_s(pid: int) -> float:
    with contextlib.suppress(OSError):
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(stat[11]) + int(stat[12])) / _TICKS
    return 0.0


def _descendants(pid: int) -> Iterator[int]:
    """Yield all that a process has started, and what that has started."""
    for thread in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in map(int, thread.read_text(encoding="ascii").split()):
                yield child
                yield from _descendants(child)
