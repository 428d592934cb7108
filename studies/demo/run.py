"""One demo from its checks to its verdict: what the two processes are told, and when it is over."""

from __future__ import annotations

import argparse
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import httpx

from service.errors import ConfigurationError, shown
from studies.demo.arguments import FORWARDED, REPEATED
from studies.demo.children import children, interrupted_by_any_end
from studies.demo.report import table
from studies.demo.truth import TruthFile
from studies.demo.watch import ANSWER_WITHIN_S, Promise, Watch

LOG = "service.log"
CHECK_WITHIN_S = 60.0


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
    for name in FORWARDED:
        value = getattr(options, name)
        if value is not None:
            simulator.append(f"--{name}={value}")
    for name in REPEATED:
        simulator += [f"--{name}={value}" for value in getattr(options, name) or ()]
    return service, simulator


def _say(text: str) -> None:
    sys.stdout.write(shown(text, keep="\n") + "\n")
    sys.stdout.flush()
