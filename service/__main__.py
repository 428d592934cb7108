"""The command line, and the only place that wires the service's parts together."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import structlog
import uvicorn
from threadpoolctl import threadpool_limits
from typing_extensions import override

from service import __version__
from service.api import create_app
from service.archive import Archive
from service.commands.fit import add_fit_arguments, run_fit
from service.commands.reconstruct import add_reconstruct_arguments, run_reconstruct
from service.commands.terminal import with_negative_numbers
from service.config import Settings, load_instrument, load_settings
from service.config.policy import policy_of
from service.demo import add_demo_arguments, run_demo
from service.errors import ConfigurationError, PyrcalError
from service.fits.upload import UploadFitter
from service.model.instrument import Instrument
from service.reactions.measurements import MEASUREMENTS_KEPT
from service.reactions.noisy import NOISY_KEPT
from service.reactions.shelf import restored
from service.rtc_bridge import Bridge, Endpoint
from service.runtime.crew import Crew
from service.runtime.deeds import Deeds, Publishing
from service.runtime.fitting import FitDesk, FitLimits
from service.runtime.resuming import taken_up
from service.runtime.supervisor import Supervisor
from service.state import TrackerState
from service.worker import Compute, start_worker

_OPTIONS = {
    "instrument": "service.instrument",
    "mode": "service.mode",
    "data_dir": "service.data_dir",
    "listen": "zenoh.listen",
    "connect": "zenoh.connect",
    "host": "api.host",
    "port": "api.port",
}
"""Command-line options that stand for a settings key."""

_OTHER_PROGRAMS = {"sim": "sim_rtc", "campaign": "studies.campaign"}
"""Run in this one's place: the service does not know the simulator."""

STOP_WITHIN_S = 3
"""Requests under way when the service is asked to stop may take this long: an upload would take
longer."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0 done, 1 failed, 2 refused at the start."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in _OTHER_PROGRAMS:
        program = _OTHER_PROGRAMS[words[0]]
        os.execv(sys.executable, [sys.executable, "-m", program, *words[1:]])
    options = _parser().parse_args(with_negative_numbers(words))
    try:
        return _COMMANDS[options.command](options)
    except PyrcalError as error:
        sys.stderr.write(f"pyrcal: {error}\n")
        return 2
    except KeyboardInterrupt:
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pyrcal", description="Calibration service of an adaptive telescope."
    )
    parser.add_argument("--version", action="version", version=f"pyrcal {__version__}")
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser(
        "run",
        help="the service",
        description="Run the service. Precedence: command line > environment "
        "(PYRCAL_<SECTION>__<KEY>) > TOML file > defaults.",
    )
    run.add_argument("--config", type=Path, metavar="FILE", help="settings, TOML")
    run.add_argument("--instrument", metavar="NAME|FILE", help="packaged name or TOML file")
    run.add_argument("--mode", choices=["auto", "propose", "hold"], help="default: propose")
    run.add_argument("--data-dir", metavar="DIR", help="products, index, audit trail; default var")
    run.add_argument("--listen", metavar="ENDPOINT", help="zenoh, default tcp/127.0.0.1:7447")
    run.add_argument("--connect", metavar="ENDPOINT", help="an observatory's own zenoh router")
    run.add_argument("--host", help="of the REST API, default 127.0.0.1")
    run.add_argument("--port", type=int, help="of the REST API, default 8080")
    add_fit_arguments(commands)
    add_reconstruct_arguments(commands)
    add_demo_arguments(commands)
    commands.add_parser("sim", help="the simulated RTC: pyrcal sim --help", add_help=False)
    commands.add_parser(
        "campaign", help="many simulated nights: pyrcal campaign --help", add_help=False
    )
    return parser


def _run(options: argparse.Namespace) -> int:
    given = {
        key: getattr(options, option)
        for option, key in _OPTIONS.items()
        if getattr(options, option) is not None
    }
    for key in ("zenoh.listen", "zenoh.connect"):
        if key in given:
            given[key] = [given[key]]
    settings = load_settings(options.config, os.environ, given)
    instrument = load_instrument(settings.service.instrument)
    # the event loop's own products are small; a second BLAS thread would only fight the RTC link
    threadpool_limits(1)
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()),
        ],
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )
    for remark in instrument.remarks:
        structlog.get_logger().warning("instrument.remark", text=remark)
    return asyncio.run(_serve(settings, instrument))


_COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "run": _run,
    "fit": run_fit,
    "reconstruct": run_reconstruct,
    "demo": run_demo,
}


async def _serve(settings: Settings, instrument: Instrument) -> int:
    """Open everything, run until asked to stop or the service fails, close everything."""
    listener = _listener(settings.api.host, settings.api.port)
    archive = Archive(settings.service.data_dir)
    damaged = archive.open()
    log = structlog.get_logger()
    for line in damaged:
        log.warning("archive.damaged", text=line)
    system = settings.service.system or instrument.name
    crew = Crew(lambda: start_worker(instrument, _compute(settings)))
    try:
        with archive, Bridge(_endpoint(settings, system)) as bridge:
            bridge.expect(instrument.basis_id, instrument.config_id)
            supervisor = _supervisor(settings, instrument, system, bridge, crew, archive)
            desk = _desk(settings, instrument)
            return await _until_stopped(supervisor, desk, listener)
    finally:
        crew.dismiss()


async def _until_stopped(supervisor: Supervisor, desk: FitDesk, listener: socket.socket) -> int:
    desk.open()
    config = uvicorn.Config(
        create_app(supervisor, desk),
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=STOP_WITHIN_S,
    )
    server = _Server(config)
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, server.stop)
    host, port = listener.getsockname()[:2]
    structlog.get_logger().info("api.listening", url=f"http://{host}:{port}")
    work = asyncio.create_task(supervisor.run())
    web = asyncio.create_task(server.serve(sockets=[listener]))
    await asyncio.wait({work, web}, return_when=asyncio.FIRST_COMPLETED)
    failed = work.done()
    server.should_exit = True
    work.cancel()
    outcomes = await asyncio.gather(work, web, return_exceptions=True)
    await desk.close()
    for outcome in outcomes:
        _explain(outcome)
    return 1 if failed else 0


def _explain(outcome: BaseException | None) -> None:
    """Log why the service failed; what it refused on purpose ends as one line.

    Raises
    ------
    PyrcalError
        The refusal itself.
    """
    while isinstance(outcome, BaseExceptionGroup):
        outcome = outcome.exceptions[0]
    if isinstance(outcome, PyrcalError):
        raise outcome
    if isinstance(outcome, Exception):
        structlog.get_logger().error("service.failed", exc_info=outcome)


class _Server(uvicorn.Server):
    """A uvicorn that leaves signals alone: it would raise them again before all is closed."""

    @override
    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def stop(self) -> None:
        """End the service in good order."""
        self.should_exit = True


def _listener(host: str, port: int) -> socket.socket:
    """Bind the REST port first: a busy one must be said in one line before anything starts."""
    try:
        listener = socket.create_server((host, port))
    except OSError as error:
        raise ConfigurationError(
            f"api.port: cannot listen on {host}:{port}: {error.strerror or error}; "
            "choose another with --port"
        ) from error
    return listener


def _supervisor(
    settings: Settings,
    instrument: Instrument,
    system: str,
    bridge: Bridge,
    crew: Crew,
    archive: Archive,
) -> Supervisor:
    deeds = Deeds(
        bridge=bridge,
        crew=crew,
        archive=archive,
        instrument=instrument,
        publishing=Publishing(
            system=system,
            chunk_bytes=settings.zenoh.chunk_bytes,
            pole_radius_bound=settings.control.pole_radius_bound,
        ),
        clock_ns=time.time_ns,
    )
    policy = policy_of(settings)
    state = TrackerState(
        system=system,
        mode=settings.service.mode,
        reconstructors=restored(archive.records()),
        measurements=archive.measured.records()[-MEASUREMENTS_KEPT:],
        noisy=archive.noisy.records()[-NOISY_KEPT:],
        basis_id=instrument.basis_id,
        config_id=instrument.config_id,
    )
    return Supervisor(
        state=taken_up(archive, state, policy, time.time_ns()),
        policy=policy,
        bridge=bridge,
        crew=crew,
        archive=archive,
        deeds=deeds,
    )


def _desk(settings: Settings, instrument: Instrument) -> FitDesk:
    """Return the desk for fits of uploads; an uploaded instrument is read like any other."""
    most_bytes = settings.fits.upload_limit_mb * 1_000_000
    return FitDesk(
        folder=settings.service.data_dir / "uploads",
        fit=UploadFitter(
            own=instrument,
            load_instrument=load_instrument,
            most_bytes=most_bytes,
            threads=settings.compute.threads,
        ),
        limits=FitLimits(
            most_bytes=most_bytes,
            waiting=settings.fits.waiting,
            seconds=settings.fits.time_limit_s,
            nice=settings.compute.nice,
        ),
        clock_ns=time.time_ns,
    )


def _endpoint(settings: Settings, system: str) -> Endpoint:
    return Endpoint(
        system=system,
        listen=settings.zenoh.listen,
        connect=settings.zenoh.connect,
        chunk_bytes=settings.zenoh.chunk_bytes,
    )


def _compute(settings: Settings) -> Compute:
    table = settings.compute
    return Compute(
        threads=table.threads,
        nice=table.nice,
        pupil_sampling=table.pupil_sampling,
        detector_nodes=table.detector_nodes,
        working_point_modes=table.working_point_modes,
        method=settings.control.method,
        max_condition=settings.control.max_condition,
        slope_noise=settings.control.slope_noise,
        wind_m_s=settings.control.wind_m_s,
    )


if __name__ == "__main__":
    sys.exit(main())
