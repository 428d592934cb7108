"""Wire the parts of the running service together."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import resource
import signal
import socket
import stat
import sys
import threading
import time
from importlib import import_module
from pathlib import Path
from typing import Literal, TextIO, cast

import structlog
from structlog.typing import EventDict
from threadpoolctl import threadpool_limits
from typing_extensions import override

from service.archive import Archive
from service.archive.retention import retention_policy
from service.cli.notify import keep_informed, notify
from service.config import Settings
from service.config.link_tables import link_security
from service.config.settings import ApiTable
from service.errors import ConfigurationError, PyrcalError, shown
from service.files.fit_folder import FitRequest
from service.files.last_telemetry import LastTelemetry
from service.model.instrument import Instrument, instrument_sha256
from service.program import announce, leave
from service.records.state import (
    LoopState,
    MatrixStates,
    Mode,
    Operations,
    OperatorState,
    ReferenceStates,
    TrackerState,
)
from service.rtc_bridge import Bridge, Endpoint
from service.runtime.actions import Actions, Publishing
from service.runtime.archiving import restore_tracking
from service.runtime.clock import ServiceClock
from service.runtime.policy import policy_of
from service.runtime.processes import set_allocator
from service.runtime.supervisor import Supervisor
from service.runtime.uploads import FitLimits, FitQueue
from service.runtime.workers import WorkerPool
from service.tracking.operations.measurement import MEASUREMENTS_KEPT
from service.tracking.resume import restored, restored_references
from service.web.keys import KeyFile

LARGE_BYTES = 2_500_000
"""Size from which an allocation is a memory map of its own, which is returned at once: frames of
seconds, matrices."""

UNUSED_BYTES = 8_000_000
"""Unused memory at the end of the heap above which it is returned to the system."""

OPEN_FILES = 8192
"""Files that the service may have open, as in ``deploy/pyrcal.service``: thousands of connections
of strangers, to REST and the link, must not use up what the archive needs."""

REST_RETRY_INTERVAL_S = 1.0
"""Interval of attempts to listen for REST, seconds."""

END_WITHIN_S = 4.5
"""Time after which the parts that delay the end are named and abandoned: operators and process
managers wait for five seconds."""


def run(settings: Settings, instrument: Instrument, workers: WorkerPool) -> int:
    """Run the service until it is asked to stop or fails; return the exit status."""
    # the event loop's own products are small; a second BLAS thread would only fight the RTC link
    threadpool_limits(1)
    share_memory()
    allow_files()
    log_to_the_terminal(settings.service.log_format)
    for remark in instrument.remarks:
        structlog.get_logger().warning("instrument.remark", text=remark)
    return asyncio.run(_serve(settings, instrument, workers))


def share_memory() -> None:
    """Let threads take memory from two pools; each would have its own, and keep what was freed.

    Fifty clients of REST left 250 MB behind in the pools of the threads that had answered them. By
    itself the C library would soon take what is large from there, too: 30 MB more lay unused
    between what stays, and 45 MB more at the most, for 0.006 of a core.
    """
    set_allocator(map_bytes=LARGE_BYTES, keep_bytes=UNUSED_BYTES, n_pools=2)


def allow_files() -> None:
    """Let this process open more files: at its limit REST takes no connection for a second."""
    usual, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError):  # the system's own limit is lower
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(usual, OPEN_FILES), most))


async def _serve(settings: Settings, instrument: Instrument, workers: WorkerPool) -> int:
    """Open everything, run until asked to stop or the service fails, close everything."""
    system = settings.service.system or instrument.name
    archive = Archive(settings.service.data_dir, settings.archive.noon_utc_h)
    endpoint = Endpoint(
        system=system,
        listen=settings.zenoh.listen,
        connect=settings.zenoh.connect,
        security=link_security(settings.zenoh, system),
    )
    archive.open()
    warn_of_readers(archive.directory)
    last = LastTelemetry(
        settings.archive.last_telemetry_s, settings.archive.last_telemetry_mb * 1_000_000
    )
    bridge = Bridge(endpoint, last)
    # The supervisor opens the link, as soon as its network is there.
    with archive, contextlib.closing(bridge):
        modes = [mode.config_id for mode in instrument.sensor_modes]
        bridge.expect(instrument.basis_id, instrument.config_id, modes)
        supervisor = _supervisor(settings, instrument, system, bridge, workers, archive)
        desk = _desk(settings, instrument)
        keys = KeyFile(settings.service.data_dir)
        try:
            return await _until_stopped(supervisor, desk, settings.api, keys)
        finally:
            workers.close()


def warn_of_readers(folder: Path) -> None:
    """Log that other users of this machine can read a data folder, as older versions permitted."""
    mode = stat.S_IMODE(folder.stat().st_mode)
    if mode & stat.S_IRWXO:
        text = f"{folder}: everybody on this machine can read it ({mode:o}): chmod 700 {folder}"
        structlog.get_logger().warning("service.data-dir", text=text)


async def _until_stopped(
    supervisor: Supervisor,
    desk: FitQueue,
    settings: ApiTable,
    keys: KeyFile,
) -> int:
    desk.open()
    ending = _Ending()

    async def answer() -> None:
        # takes a second, in which telemetry is taken in already
        await asyncio.to_thread(import_module, "service.api")
        from service import api

        listener = await _listener(settings, supervisor, ending.asked)
        if listener is None:
            return
        where = "http://{}:{}".format(*listener.getsockname()[:2])
        with listener, announce(supervisor.archive.directory, where):
            await api.answer(supervisor, desk, listener, settings, keys, ending.asked)

    work = asyncio.create_task(supervisor.run())
    web = asyncio.create_task(answer())
    asked = asyncio.create_task(ending.asked.wait())
    informer = asyncio.create_task(
        keep_informed(
            lambda: supervisor.snapshot().stalled, lambda: supervisor.snapshot().ready_reason
        )
    )
    await asyncio.wait({work, web, asked}, return_when=asyncio.FIRST_COMPLETED)
    failed = work.done() or web.done()
    notify("STOPPING=1")
    ending.failures = [e for task in (work, web) if task.done() and (e := task.exception())]
    ending.begin()
    for task in (work, asked, informer):
        task.cancel()
    outcomes = await asyncio.gather(work, web, informer, return_exceptions=True)
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
    outcome = outcome and _first_of(outcome)
    if isinstance(outcome, PyrcalError):
        raise outcome
    if isinstance(outcome, Exception):
        structlog.get_logger().error("service.failed", exc_info=outcome)


def _first_of(failure: BaseException) -> BaseException:
    """Return the exception itself: task groups wrap even a single one."""
    while isinstance(failure, BaseExceptionGroup):
        failure = failure.exceptions[0]
    return failure


class _Ending:
    """Takes SIGINT and SIGTERM once, and makes sure that the service ends."""

    def __init__(self) -> None:
        self.asked = asyncio.Event()
        self.failures: list[BaseException] = []
        """Failures that end the service; a forced end must name them as well."""

        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: loop.call_soon_threadsafe(self.begin))

    def begin(self) -> None:
        """Begin the end: it is not begun twice, and cannot be put off."""
        if self.asked.is_set():
            return
        self.asked.set()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        # A thread of its own can end the process even if the event loop hangs.
        guard = threading.Timer(END_WITHIN_S, self._leave_behind)
        # A daemon, so that it does not itself keep an orderly end waiting.
        guard.daemon = True
        guard.start()

    def _leave_behind(self) -> None:
        """End the process with what still holds it up; what is on the disk is always whole."""
        for failure in self.failures:
            structlog.get_logger().error("service.failed", text=str(_first_of(failure)))
        held = [thread.name for thread in threading.enumerate() if not thread.daemon]
        structlog.get_logger().error("service.ended-late", threads=held)
        leave(1)


async def _listener(
    settings: ApiTable, supervisor: Supervisor, over: asyncio.Event
) -> socket.socket | None:
    """Return the socket of REST once its address exists and its port is free; None at the end.

    Raises
    ------
    ConfigurationError
        If this user may not listen there.
    """
    host, port = settings.host, settings.port
    while not over.is_set():
        try:
            # In a thread, because a name may be looked up for seconds.
            listener = await asyncio.to_thread(socket.create_server, (host, port))
        except OSError as error:
            text = f"api.port: cannot listen on {host}:{port}: {error.strerror or error}"
            remedy = "choose another with --port"
            if isinstance(error, PermissionError):
                raise ConfigurationError(f"{text}; {remedy}") from error
            supervisor.await_rest(
                f"{text}; tried again every {REST_RETRY_INTERVAL_S:g} s. Start the network, stop "
                f"the program that has the port (another pyrcal?), or {remedy}"
            )
            await asyncio.sleep(REST_RETRY_INTERVAL_S)
        else:
            supervisor.await_rest("")
            return listener
    return None


def _supervisor(
    settings: Settings,
    instrument: Instrument,
    system: str,
    bridge: Bridge,
    workers: WorkerPool,
    archive: Archive,
) -> Supervisor:
    clock = ServiceClock()
    actions = Actions(
        bridge=bridge,
        workers=workers,
        archive=archive,
        instrument=instrument,
        publishing=Publishing(
            system=system,
            chunk_bytes=settings.zenoh.chunk_bytes,
            pole_radius_bound=settings.control.pole_radius_bound,
        ),
        clock_ns=clock.now_ns,
    )
    policy = policy_of(settings, instrument)
    state = TrackerState(
        system=system,
        operator=OperatorState(mode=Mode(settings.service.mode)),
        matrices=MatrixStates(reconstructors=restored(archive.reconstructors.records())),
        references=ReferenceStates(records=restored_references(archive.references.records())),
        operations=Operations(measurements=archive.measurements()[-MEASUREMENTS_KEPT:]),
        loop=LoopState(basis_id=instrument.basis_id, config_id=instrument.config_id),
    )
    return Supervisor(
        state=restore_tracking(archive, state, policy, clock.now_ns()),
        policy=policy,
        bridge=bridge,
        workers=workers,
        archive=archive,
        actions=actions,
        retention=retention_policy(settings),
        clock=clock,
    )


FIT_PROGRAM = (sys.executable, "-m", "pyrcal.fitting.uploaded")
"""Command of ``pyrcal fit`` for an upload; that process imports only the parts of the service that
the library uses."""


def _desk(settings: Settings, instrument: Instrument) -> FitQueue:
    """Return the desk for fits of uploads; an uploaded instrument is read like any other."""
    most_bytes = settings.fits.upload_limit_mb * 1_000_000
    return FitQueue(
        folder=settings.service.data_dir / "uploads",
        program=FIT_PROGRAM,
        request=FitRequest(
            asked={},
            own_instrument=str(settings.service.instrument),
            own_sha256=instrument_sha256(instrument),
            max_bytes=most_bytes,
            threads=settings.compute.threads,
            nice=settings.compute.nice,
            memory_mb=settings.fits.memory_limit_mb,
        ),
        limits=FitLimits(
            max_bytes=most_bytes,
            waiting=settings.fits.waiting,
            seconds=settings.fits.time_limit_s,
        ),
        clock_ns=time.time_ns,
    )


def log_to_the_terminal(log_format: Literal["auto", "text", "json"] = "auto") -> None:
    """Have everything that is logged, by libraries too, written to standard error."""
    is_json = log_format == "json" or (log_format == "auto" and not sys.stderr.isatty())
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,  # of the request that has led to it
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            _harmless,
            structlog.processors.JSONRenderer(ensure_ascii=False)
            if is_json
            else structlog.dev.ConsoleRenderer(
                colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback
            ),
        ],
        logger_factory=structlog.PrintLoggerFactory(cast(TextIO, _Forgiving(sys.stderr))),
    )
    logging.getLogger().handlers = [_IntoStructlog()]


class _Forgiving:
    """A file for the log: a disk that refuses it must not end what is logged."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> None:
        """Write it if that can be."""
        with contextlib.suppress(OSError):
            self._file.write(text)

    def flush(self) -> None:
        """Have it on the disk if that can be."""
        with contextlib.suppress(OSError):
            self._file.flush()


def _harmless(_logger: object, _method: str, event: EventDict) -> EventDict:
    """Write out the control characters in text from the RTC, files and clients."""
    return {
        key: shown(value, keep="\n" if key == "exception" else "")
        if isinstance(value, str)
        else value
        for key, value in event.items()
    }


class _IntoStructlog(logging.Handler):
    """Takes what libraries log."""

    @override
    def emit(self, record: logging.LogRecord) -> None:
        log = structlog.get_logger()
        log.log(record.levelno, record.getMessage(), exc_info=record.exc_info or None)
