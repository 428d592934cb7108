"""The demo's command line, and the two processes it starts."""

from __future__ import annotations

import argparse
import math
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import httpx

from service.demo.children import children, interrupted_by_any_end
from service.demo.screen import table
from service.demo.truth import TruthFile
from service.demo.watch import ANSWER_WITHIN_S, Promise, Watch
from service.errors import ConfigurationError, shown

LOG = "service.log"
CHECK_WITHIN_S = 60.0

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
        "fell; 1: not so, and why is printed; 2: an argument makes no sense.",
    )
    demo.add_argument(
        "--seconds",
        type=_seconds,
        metavar="N",
        help="end when all has come out right and held for 5 s, at the latest N s of telemetry "
        "after model and simulator are ready (with --jump, --drift or --fault: N s in any case); "
        "default: run until Ctrl-C",
    )
    for name, (metavar, text) in _FORWARDED.items():
        demo.add_argument(f"--{name}", metavar=metavar, help=text)
    for name, (metavar, text) in _REPEATED.items():
        demo.add_argument(f"--{name}", action="append", metavar=metavar, help=text)
    demo.add_argument("--seed", type=_seed, default=1, metavar="S", help="of everything random")
    demo.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    demo.add_argument("--port", type=_port, default=8080, help="of the REST API")
    demo.add_argument("--zenoh-port", type=_port, default=7447, help="of the link to the RTC")
    demo.add_argument(
        "--dir", type=Path, default=Path("var/demo"), help="logs, truth, archive; emptied first"
    )


def run_demo(options: argparse.Namespace) -> int:
    """Run the demo; return 0 if the main job was done, else 1.

    Raises
    ------
    ConfigurationError
        If an argument makes no sense; nothing has been started then.
    """
    service_words, sim_words = _commands(options)
    _check(options, sim_words)
    _emptied(options.dir)
    url = f"http://127.0.0.1:{options.port}"
    _say(f"service    pyrcal {' '.join(service_words)}")
    _say(f"simulator  pyrcal sim {' '.join(sim_words)}")
    _say(f"REST       {url}/v1/state   logs and truth: {options.dir}\n")
    commands = {
        "service": ["-m", "service", *service_words],
        "simulator": ["-m", "sim_rtc", *sim_words],
    }
    with (
        httpx.Client(base_url=url, timeout=ANSWER_WITHIN_S) as client,
        interrupted_by_any_end(),
        children(options.dir, commands) as started,
    ):
        truth = TruthFile(options.dir / "truth.jsonl")
        watch = Watch(client, truth, started, _promise(options), _say)
        try:
            watch.run()
        except KeyboardInterrupt:
            _say("\nstopping")
        report = watch.closing_report()
    _say(table(report))
    if options.json is not None:
        options.json.write_text(report.to_json() + "\n", encoding="utf-8")
    return 0 if report.good else 1


def _promise(options: argparse.Namespace) -> Promise:
    return Promise(
        seconds=options.seconds,
        whole=any(getattr(options, name) for name in ("jump", "drift", "fault")),
        real_time=options.plant != "diffractive",
    )


def _check(options: argparse.Namespace, sim_words: list[str]) -> None:
    """Refuse what cannot be run before anything is started or emptied.

    Raises
    ------
    ConfigurationError
        With one line that says what was found and what was expected.
    """
    if options.json is not None and (
        options.json.is_dir() or not options.json.absolute().parent.is_dir()
    ):
        raise ConfigurationError(f"--json {options.json}: expected a file in a folder that exists")
    if options.port == options.zenoh_port:
        raise ConfigurationError(f"--port and --zenoh-port: both {options.port}, expected two")
    for name, port in (("--port", options.port), ("--zenoh-port", options.zenoh_port)):
        try:
            socket.create_server(("127.0.0.1", port)).close()
        except OSError as error:
            raise ConfigurationError(
                f"{name} {port}: cannot listen on 127.0.0.1:{port}: {error.strerror or error}; "
                "choose another, the service would not start"
            ) from error
    # the simulator alone knows what it understands, and the service does not know the simulator
    checked = subprocess.run(
        [sys.executable, "-m", "sim_rtc.options", *sim_words],
        capture_output=True,
        text=True,
        timeout=CHECK_WITHIN_S,
        check=False,
    )
    if checked.returncode != 0:
        raise ConfigurationError(checked.stderr.strip().removeprefix("sim_rtc: "))


def _emptied(directory: Path) -> None:
    """Begin with an empty directory; one that no earlier demo has filled is left alone.

    Raises
    ------
    ConfigurationError
        If it holds something else, or is no directory.
    """
    try:
        if directory.exists() and any(directory.iterdir()) and not (directory / LOG).exists():
            raise ConfigurationError(f"--dir {directory}: holds other files; name a new directory")
        shutil.rmtree(directory, ignore_errors=True)
        directory.mkdir(parents=True)
    except OSError as error:
        raise ConfigurationError(f"--dir {directory}: {error.strerror or error}") from error


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


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number of seconds > 0")
    return value


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdecimal()):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number from 0")
    return int(text)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a port from 1 to 65535")
    return int(text)


def _say(text: str) -> None:
    sys.stdout.write(shown(text, keep="\n") + "\n")
    sys.stdout.flush()
