"""Starting, watching and stopping the two processes of the demo."""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import httpx

from service.demo.report import Report, make_report
from service.demo.screen import HEADING, live_line, table
from service.demo.truth import TruthFile
from service.errors import ConfigurationError, LinkError

POLL_S = 0.5
LINE_S = 2.0
HEADING_EVERY = 20
STOP_WITHIN_S = 15.0
LOG = "service.log"

_FORWARDED = {
    "alpha": ("X,Y,ROT_DEG,MAG", "true registration; default random"),
    "mag": ("M", "magnitude of the star, default 8"),
    "gain": ("G", "integrator gain, default 0.4"),
    "plant": ("NAME", "simulated telescope: linear (default) or diffractive"),
    "scene": ("NAME", "onsky (default) or daytime"),
    "seeing": ("ARCSEC", "default 1"),
    "profile": ("NAME", "layers of turbulence, default single"),
    "imperfections": ("NAME", "ideal, usual (default) or realistic"),
}
_REPEATED = {
    "jump": ("T:DX,DY,DROT_DEG,DMAG", "sudden change of the registration; repeatable"),
    "drift": ("DX,DY,DROT_DEG,DMAG", "steady change, per minute"),
    "wind": ("SPEED,DIR_DEG[,SHARE]", "a layer instead of a profile; repeatable"),
    "fault": ("KIND@T[:ARGS]", "something goes wrong; repeatable, see pyrcal sim --help"),
}
"""Options of the simulator that the demo passes on."""


def add_demo_arguments(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare ``pyrcal demo``; ``commands`` is argparse's collection of sub-commands."""
    demo = commands.add_parser(
        "demo",
        help="the main job, end to end, on a simulated telescope",
        description="Start the service and a simulated RTC, show what happens, judge the outcome. "
        "Exit status 0: the registration was found, the margin recovered, the wavefront error "
        "fell; 1: not so, and why is printed.",
    )
    demo.add_argument("--seconds", type=float, metavar="N", help="stop by itself after N seconds")
    for name, (metavar, text) in _FORWARDED.items():
        demo.add_argument(f"--{name}", metavar=metavar, help=text)
    for name, (metavar, text) in _REPEATED.items():
        demo.add_argument(f"--{name}", action="append", metavar=metavar, help=text)
    demo.add_argument("--seed", type=int, default=1, metavar="S", help="of everything random")
    demo.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    demo.add_argument("--port", type=int, default=8080, help="of the REST API")
    demo.add_argument("--zenoh-port", type=int, default=7447, help="of the link to the RTC")
    demo.add_argument(
        "--dir", type=Path, default=Path("var/demo"), help="logs, truth, archive; emptied first"
    )


def run_demo(options: argparse.Namespace) -> int:
    """Run the demo; return 0 if the main job was done, else 1."""
    _emptied(options.dir)
    service_words, sim_words = _commands(options)
    url = f"http://127.0.0.1:{options.port}"
    _say(f"service    pyrcal {' '.join(service_words)}")
    _say(f"simulator  pyrcal sim {' '.join(sim_words)}")
    _say(f"REST       {url}/v1/state   logs and truth: {options.dir}\n")
    truth = TruthFile(options.dir / "truth.jsonl")
    started_s = time.monotonic()
    with (
        _process("service", ["-m", "service", *service_words], options.dir) as service,
        _process("simulator", ["-m", "sim_rtc", *sim_words], options.dir) as simulator,
        httpx.Client(base_url=url, timeout=2.0) as client,
    ):
        watch = _Watch(client, truth, service, simulator, started_s)
        try:
            watch.until(options.seconds)
        except KeyboardInterrupt:
            _say("\nstopping")
        report = watch.report()
    _say(table(report))
    if options.json is not None:
        options.json.write_text(report.to_json() + "\n", encoding="utf-8")
    return 0 if report.good else 1


def _emptied(directory: Path) -> None:
    """Begin with an empty directory; one that no earlier demo has filled is left alone.

    Raises
    ------
    ConfigurationError
        If it holds something else.
    """
    if directory.exists() and any(directory.iterdir()) and not (directory / LOG).exists():
        raise ConfigurationError(f"--dir {directory}: holds other files; name a new directory")
    shutil.rmtree(directory, ignore_errors=True)
    directory.mkdir(parents=True)


def _commands(options: argparse.Namespace) -> tuple[list[str], list[str]]:
    endpoint = f"tcp/127.0.0.1:{options.zenoh_port}"
    service = ["run", "--mode", "auto", "--listen", endpoint, "--port", str(options.port)]
    service += ["--data-dir", str(options.dir / "data")]
    simulator = ["--connect", endpoint, "--seed", str(options.seed)]
    simulator += ["--truth", str(options.dir / "truth.jsonl"), "--quiet"]
    for name in _FORWARDED:
        value = getattr(options, name)
        if value is not None:
            simulator.append(f"--{name}={value}")
    for name in _REPEATED:
        simulator += [f"--{name}={value}" for value in getattr(options, name) or ()]
    return service, simulator


class _Watch:
    """Looks at REST and the truth file, and prints."""

    def __init__(
        self,
        client: httpx.Client,
        truth: TruthFile,
        service: subprocess.Popen[bytes],
        simulator: subprocess.Popen[bytes],
        started_s: float,
    ) -> None:
        self._client = client
        self._truth = truth
        self._service = service
        self._simulator = simulator
        self._started_s = started_s
        self._state: dict[str, Any] | None = None
        self._reconstructors: list[dict[str, Any]] = []
        self._first_applied_s: float | None = None
        self._simulator_mourned = False

    def until(self, seconds: float | None) -> None:
        """Watch and print for ``seconds``, or until interrupted."""
        n_lines, next_line_s = 0, 0.0
        while seconds is None or self._elapsed_s() < seconds:
            self._look()
            self._check_processes()
            if self._elapsed_s() >= next_line_s:
                if n_lines % HEADING_EVERY == 0:
                    _say(HEADING)
                _say(live_line(self._elapsed_s(), self._state, self._truth.last))
                n_lines, next_line_s = n_lines + 1, self._elapsed_s() + LINE_S
            time.sleep(POLL_S)

    def report(self) -> Report:
        """Return the figures as they stand now."""
        self._look()
        return make_report(self._state, self._reconstructors, self._truth, self._first_applied_s)

    def _elapsed_s(self) -> float:
        return time.monotonic() - self._started_s

    def _look(self) -> None:
        self._truth.read()
        try:
            state = self._client.get("/v1/state")
            shelf = self._client.get("/v1/reconstructors")
        except httpx.TransportError:
            return
        if state.status_code == shelf.status_code == httpx.codes.OK:
            self._state = state.json()
            self._reconstructors = shelf.json()["reconstructors"]
        applied = any(r["applied_frame_seq"] is not None for r in self._reconstructors)
        if applied and self._first_applied_s is None:
            self._first_applied_s = self._elapsed_s()

    def _check_processes(self) -> None:
        if self._service.poll() is not None:
            raise LinkError(
                f"the service ended with status {self._service.returncode}: see service.log"
            )
        if self._simulator.poll() is not None and not self._simulator_mourned:
            self._simulator_mourned = True
            _say("        the simulator has ended; start it again with the command above")


@contextmanager
def _process(name: str, words: list[str], directory: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process of this Python while the ``with`` block lasts; its output goes to a file."""
    log: IO[bytes]
    with (directory / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, *words], stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                process.wait(STOP_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
