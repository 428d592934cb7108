"""Run one demo: check the arguments, start both processes, watch them, print the verdict."""

from __future__ import annotations

import argparse
import math
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple, Self

from pyrcal.client.rest import Service
from pyrcal.demo.arguments import FORWARDED, REPEATED
from pyrcal.demo.children import interrupt_on_end, run_children
from pyrcal.demo.report import table
from pyrcal.demo.truth import TruthFile
from pyrcal.demo.watch import REQUEST_TIMEOUT_S, USUAL_RATE_HZ, Promise, TelemetryObserver
from pyrcal.fitting.figures import check_plots
from service.errors import ConfigurationError, shown
from service.instrument.schema import AboutTable, SlopesTable, read_instrument_file
from service.model.kinds import KarhunenLoeve, LoopFacts
from sim_rtc.rehearsal import write_live_instrument

LOG = "service.log"
LIVE_INSTRUMENT = "instrument.toml"
"""Instrument file of the service if the plant is a measured matrix, in the demo's folder."""

USUAL_MAGNITUDE, USUAL_DIAMETER_M = 8.0, 8.22
"""Magnitude of the simulator's star, and telescope diameter that it is meant for."""

DEFAULT_INSTRUMENT = "flao-lbt"
"""Instrument of the demo unless another one is given."""

FLAO_RATIO, OTHER_RATIO = 1.5, 1.25
"""Required ratio of the wavefront errors before and after, with a large initial misregistration:
for FLAO, and for other telescopes, whose modes correct less."""

FEW_MODES, FEW_RATIO = 170, 1.05
"""Number of modes below which ``FEW_RATIO`` is required. Such a demo begins with 70 % of the modes.
All modes leave 1.17 times less (variance by N^(-√3/2), Noll 1976); a third of that in decibels is
required."""

SMALL_DIAMETER_M = 2.0
"""Diameter below which the demo makes the star brighter and begins with a third of the modes.

PAPYRUS (1.6 m) at magnitude 8 has 1.5 electrons on a pixel and frame: 120 modes leave as much as
195. With the light of an 8 m telescope the delay of the loop leaves most of the error: 87 nm with
65 modes, 80 with 120, 79 with 195."""

MEASURED_RATIO = 1 / 1.1
"""Required ratio for a measured plant, which begins with the reconstructor of the measurement
itself: the service's may leave 10 % more."""

FAR_TEXT = """\
The mirror is misregistered by 0.4 subapertures and 0.65 deg from the RTC's matrix. {start} WFE is
the simulator's true wavefront error.
"""
FLAO_START = "With that matrix a\nloop of 400 modes diverges, so the RTC begins with 120."
OTHER_START = """The RTC begins
with 120 modes, with 70 % of all its modes if that is fewer, or with a third on a telescope below
2 m, whose star is brighter."""
TOO_LARGE_TEXT = """\
This telescope is too large for real time: {gflop_s:.0f} GFLOP/s at {rate_hz:g} Hz. Its loop runs as
fast as this machine can: at the highest sustained rate or, if a dither needs more, in slow motion.
The preparation takes minutes: modes (cached on disk), D and its derivatives, and the simulator's
own matrices. The simulator needs about 9 GB and the service 6 GB.
"""

HELD_GFLOP_S = 30.0
"""Assumed speed of matrix products with few frames on half of a dual-core processor, GFLOP/s."""

CHECK_WITHIN_S = 60.0


def run_demo(options: argparse.Namespace) -> int:
    """Run the demo; return 0 if the main job was done, else 1.

    Raises
    ------
    ConfigurationError
        If an argument makes no sense; nothing has been started then.
    """
    service_words, sim_words = _make_commands(options)
    _check(options, sim_words)
    # Only now, because the folder of an earlier demo is deleted.
    _prepare_directory(options.dir)
    if _is_measured(options):
        write_live_instrument(options.instrument, options.dir / LIVE_INSTRUMENT)
    # Only programs of this machine shall reach a demo, which has no keys.
    url = f"http://127.0.0.1:{options.port}"
    _say(f"service    pyrcal {' '.join(service_words)}")
    _say(f"simulator  pyrcal sim {' '.join(sim_words)}")
    _say(f"REST       {url}/v1/state   logs and truth: {options.dir}\n")
    telescope = _Telescope.read(options.instrument)
    if _is_large(options, telescope):
        _say(TOO_LARGE_TEXT.format(gflop_s=telescope.gflop_s, rate_hz=telescope.rate_hz))
    if _is_far(options):
        _say(_choose_introduction(options))
    commands = {
        "service": ["-m", "service", *service_words],
        "simulator": ["-m", "sim_rtc", *sim_words],
    }
    with (
        interrupt_on_end(),
        run_children(options.dir, commands) as started,
    ):
        truth = TruthFile(options.dir / "truth.jsonl")
        service = Service(url, timeout_s=REQUEST_TIMEOUT_S)
        watch = TelemetryObserver(service, truth, started, _make_promise(options), _say)
        try:
            watch.run()
        except KeyboardInterrupt:
            _say("\nstopping")
        report = watch.make_final_report()
    _say(table(report))
    # Imported late, because matplotlib is an extra.
    if options.plot is not None:
        from pyrcal.demo.figure import draw

        draw(report, truth, options.plot)
    if options.json is not None:
        options.json.write_text(report.to_json() + "\n", encoding="utf-8")
    return 0 if report.good else 1


def _is_measured(options: argparse.Namespace) -> bool:
    """Return True if the plant is a measured matrix, whose true registration is unknown."""
    return bool(options.plant == "measured")


def _is_far(options: argparse.Namespace) -> bool:
    """Return True if the demo begins with a large misregistration.

    This is the default; it does not apply with another telescope or sky.
    """
    is_customised = any(getattr(options, name) is not None for name in ("alpha", "plant", "scene"))
    return not (is_customised or options.near)


def _choose_introduction(options: argparse.Namespace) -> str:
    """Return the introduction of a demo with a large misregistration; only FLAO has 400 modes."""
    is_flao = options.instrument == DEFAULT_INSTRUMENT
    return FAR_TEXT.format(start=FLAO_START if is_flao else OTHER_START)


class _Telescope(NamedTuple):
    """Values of an instrument file that a demo depends on."""

    diameter_m: float
    across_subap: float
    """Subapertures across the pupil."""

    n_modes: int
    rate_hz: float
    """Frame rate; 0 if the file states none."""

    gflop_s: float
    """Speed that the simulator's products of slopes and modes need, GFLOP/s: each frame is
    multiplied by R and by D."""

    @classmethod
    def read(cls, name_or_path: str) -> Self:
        """Read an instrument file."""
        file = read_instrument_file(name_or_path)
        across_subap = float(file.section(file.kind.table).table.pupil_diameter)
        n_planes = file.section(SlopesTable).table.kind.n_planes
        n_modes = int(file.section(KarhunenLoeve).table.n_modes)
        rate_hz = file.section(LoopFacts).table.frame_rate_hz or 0.0
        return cls(
            diameter_m=float(file.section(AboutTable).table.diameter_m),
            across_subap=across_subap,
            n_modes=n_modes,
            rate_hz=rate_hz,
            gflop_s=4e-9 * rate_hz * n_planes * math.pi / 4 * across_subap**2 * n_modes,
        )


def _is_small(options: argparse.Namespace, telescope: _Telescope) -> bool:
    """Return True for a telescope with the light and the loop of a small one."""
    return telescope.diameter_m < SMALL_DIAMETER_M and not _is_measured(options)


def _is_large(options: argparse.Namespace, telescope: _Telescope) -> bool:
    """Return True if no ordinary machine simulates the linear plant in real time."""
    # The diffractive plant is slow on any machine: it has no load that could be held.
    return telescope.gflop_s > HELD_GFLOP_S and options.plant != "diffractive"


def _make_small_options(options: argparse.Namespace, telescope: _Telescope) -> list[str]:
    """Return the simulator's options for the star and the loop of a small telescope."""
    words = []
    if options.mag is None:
        brighter = 5 * math.log10(telescope.diameter_m / USUAL_DIAMETER_M)
        words.append(f"--mag={USUAL_MAGNITUDE + brighter:.2f}")
    if _is_far(options):
        words.append(f"--n-controlled={max(telescope.n_modes // 3, 2)}")
    return words


def _make_promise(options: argparse.Namespace) -> Promise:
    telescope = _Telescope.read(options.instrument)
    large = _is_large(options, telescope)
    return Promise(
        seconds=options.seconds,
        whole=any(getattr(options, name) for name in ("jump", "drift", "fault")),
        wanted_ratio=_choose_ratio(options, telescope),
        across_subap=telescope.across_subap,
        measured_plant=_is_measured(options),
        large=large,
        requested_rate_hz=telescope.rate_hz if large else USUAL_RATE_HZ,
    )


def _choose_ratio(options: argparse.Namespace, telescope: _Telescope) -> float:
    if _is_measured(options):
        return MEASURED_RATIO
    # Near the nominal registration there is little to win, and a telescope in slow motion has few
    # seconds: an end that is not worse is enough.
    if not _is_far(options) or _is_large(options, telescope):
        return 1.0
    if options.instrument == DEFAULT_INSTRUMENT:
        return FLAO_RATIO
    few = telescope.n_modes <= FEW_MODES or _is_small(options, telescope)
    return FEW_RATIO if few else OTHER_RATIO


def _check(options: argparse.Namespace, sim_words: list[str]) -> None:
    """Raise if the demo cannot run, before anything is started or deleted.

    Raises
    ------
    ConfigurationError
        With one line that says what was found and what was expected.
    """
    read_instrument_file(options.instrument)
    for name, file in (("--json", options.json), ("--plot", options.plot)):
        if file is not None and (file.is_dir() or not file.absolute().parent.is_dir()):
            raise ConfigurationError(f"{name} {file}: expected a file in a folder that exists")
    if options.plot is not None:
        check_plots()
    if options.port == options.zenoh_port:
        raise ConfigurationError(f"--port and --zenoh-port: both {options.port}, expected two")
    # Tried now, because the service would report an occupied port only after its start.
    for name, port in (("--port", options.port), ("--zenoh-port", options.zenoh_port)):
        try:
            socket.create_server(("127.0.0.1", port)).close()
        except OSError as error:
            raise ConfigurationError(
                f"{name} {port}: cannot listen on 127.0.0.1:{port}: {error.strerror or error}; "
                "choose another, the service would not start"
            ) from error
    # Only the simulator can check its own options, and they must not be wrong after the service
    # has been started.
    checked = subprocess.run(
        [sys.executable, "-m", "sim_rtc.options", *sim_words],
        capture_output=True,
        text=True,
        timeout=CHECK_WITHIN_S,
        check=False,
    )
    if checked.returncode != 0:
        raise ConfigurationError(checked.stderr.strip().removeprefix("sim_rtc: "))


def _prepare_directory(directory: Path) -> None:
    """Start with an empty directory; one that no earlier demo has filled is not deleted.

    Raises
    ------
    ConfigurationError
        If it holds something else, or is no directory.
    """
    try:
        # The log of an earlier demo shows that a folder is the demo's own.
        if directory.exists() and any(directory.iterdir()) and not (directory / LOG).exists():
            raise ConfigurationError(f"--dir {directory}: holds other files; name a new directory")
        shutil.rmtree(directory, ignore_errors=True)
        directory.mkdir(parents=True)
    except OSError as error:
        raise ConfigurationError(f"--dir {directory}: {error.strerror or error}") from error


def _make_commands(options: argparse.Namespace) -> tuple[list[str], list[str]]:
    endpoint = f"tcp/127.0.0.1:{options.zenoh_port}"
    service = ["run", "--mode", "auto", "--listen", endpoint, "--port", str(options.port)]
    live = str(options.dir / LIVE_INSTRUMENT) if _is_measured(options) else options.instrument
    service += ["--data-dir", str(options.dir / "data"), "--instrument", live]
    simulator = ["--connect", endpoint, "--seed", str(options.seed)]
    simulator += ["--instrument", options.instrument]
    simulator += ["--truth", str(options.dir / "truth.jsonl"), "--quiet"]
    # FLAO keeps real time on an ordinary machine; others run at the rate that this one sustains.
    if options.instrument != DEFAULT_INSTRUMENT:
        simulator.append("--held-rate")
    telescope = _Telescope.read(options.instrument)
    if _is_large(options, telescope):
        simulator.append(f"--rate={telescope.rate_hz:g}")
    if _is_far(options):
        simulator.append("--far")
    if _is_small(options, telescope):
        simulator += _make_small_options(options, telescope)
    for name in FORWARDED:
        value = getattr(options, name)
        if value is not None:
            # In one word, because a value may begin with a minus.
            simulator.append(f"--{name}={value}")
    for name in REPEATED:
        simulator += [f"--{name}={value}" for value in getattr(options, name) or ()]
    return service, simulator


def _say(text: str) -> None:
    sys.stdout.write(shown(text, keep="\n") + "\n")
    sys.stdout.flush()
