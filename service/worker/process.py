"""Processes of their own for what takes long: nice'd, and ended at any moment.

Whoever waits for one waits in a thread, on a pipe: a process that is killed, even one that is
stopped, closes the pipe, and the wait is over. An executor of the standard library waits for its
process to finish instead, and the service with it.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Concatenate, Generic, ParamSpec, TypeVar, cast

from threadpoolctl import threadpool_limits

from service.errors import PyrcalError, WorkerError
from service.model.instrument import Instrument
from service.worker.optics_worker import OpticsWorker
from service.worker.records import Compute

_open_worker: Callable[[], OpticsWorker] | None = None
"""Of the worker process: it outlives a job."""

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Done(Generic[R]):
    """What came of a job, and what it cost."""

    result: R
    cpu_s: float
    """Processor time of the whole worker process, all its threads, seconds. The first job's holds
    the making of the models."""


class Apart:
    """A process that does one piece of work after another; nothing runs before the first."""

    def __init__(self, *, nice: int) -> None:
        self._nice = nice
        self._busy = threading.Lock()
        self._process: BaseProcess | None = None
        self._line: Connection | None = None
        self._ended = threading.Event()

    @property
    def pid(self) -> int | None:
        """Process id; None: nothing has been asked of it yet."""
        return None if self._process is None else self._process.pid

    def cpu_s(self) -> float:
        """Return the processor time it has taken, as the kernel counts it; the clock elsewhere.

        Where there is no such file a process cannot be told to stand still: it never seems to.
        """
        if self.pid is None:
            return 0.0
        try:
            words = Path(f"/proc/{self.pid}/stat").read_text("ascii").rpartition(")")[2].split()
        except (OSError, UnicodeDecodeError):
            return time.monotonic()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    def do(self, work: Callable[[], R]) -> R:
        """Have it done and return the result; ``work`` must be picklable, like what it returns.

        Blocks until it is done or the process has ended, so call off the event loop.

        Raises
        ------
        PyrcalError
            What ``work`` has raised of this kind; WorkerError for anything else it raised.
        EOFError
            If the process died, or was killed meanwhile.
        """
        with self._busy:
            try:
                line = self._started()
                line.send(work)
                answer = line.recv()
            except OSError as error:  # no process to be had, or a line that is cut
                raise EOFError from error
        if isinstance(answer, PyrcalError):
            raise answer
        return cast(R, answer)

    def begin(self) -> None:
        """Begin the process before there is work for it.

        Raises
        ------
        EOFError, OSError
            If there is no process to be had.
        """
        with self._busy:
            self._started()

    def kill(self) -> None:
        """End the process at once, whatever it is at; whoever waits for it waits no longer."""
        self._ended.set()
        process = self._process
        if process is not None:
            process.kill()
            process.join()
        with self._busy:
            if self._line is not None:
                self._line.close()

    def _started(self) -> Connection:
        if self._ended.is_set():
            raise EOFError
        if self._line is None:
            context = multiprocessing.get_context("spawn")
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, self._nice), daemon=True)
            with _deaf_to_the_keyboard():
                process.start()
            self._process, self._line = process, ours
            theirs.close()  # else nobody would notice that the other end is gone
            if self._ended.is_set():  # killed while it was being born
                process.kill()
        return self._line


class Worker(Apart):
    """A process that keeps the optical models between jobs."""

    def __init__(self) -> None:
        super().__init__(nice=0)  # until it knows how nice it is to be
        self._entered = False
        self._enter: Callable[[], None] | None = None

    def told(self, instrument: Instrument, compute: Compute) -> Worker:
        """Tell it what to work with, and return it."""
        self._enter = functools.partial(_enter, instrument, compute)
        return self

    def run(self, job: Callable[[], Done[R]]) -> Done[R]:
        """Do a job on the optical models; see :meth:`Apart.do`."""
        if not self._entered and self._enter is not None:
            self.do(self._enter)
            self._entered = True
        return self.do(job)


_early: list[Worker] = []
"""At most one that waits to be told."""


def begin_early() -> None:
    """Begin the process of the first worker: it imports what it needs while its parent does."""
    worker = Worker()
    with contextlib.suppress(EOFError, OSError):  # then the first job begins it, or says why not
        worker.begin()
    _early[:] = [worker]


def start_worker(instrument: Instrument, compute: Compute) -> Worker:
    """Return a nice'd worker process; nothing runs before the first job but what is early."""
    worker = _early.pop() if _early else Worker()
    return worker.told(instrument, compute)


def run_job(
    job: Callable[Concatenate[OpticsWorker, P], R], *args: P.args, **kwargs: P.kwargs
) -> Done[R]:
    """Run a method of the optics worker in its process."""
    if _open_worker is None:
        raise RuntimeError("not in a worker process")
    before_s, optics = time.process_time(), _open_worker()
    try:
        result = job(optics, *args, **kwargs)
    finally:
        optics.tidy()
        _return_memory()
    return Done(result=result, cpu_s=time.process_time() - before_s)


def _return_memory() -> None:
    """Return what is free to the system: a linearisation leaves hundreds of megabytes behind."""
    with contextlib.suppress(OSError, AttributeError):  # only the GNU C library has it
        ctypes.CDLL(None).malloc_trim(0)


def _enter(instrument: Instrument, compute: Compute) -> None:
    """Prepare the worker process."""
    global _open_worker
    os.nice(compute.nice)
    # made by the first job, so that an impossible instrument fails that job and says why
    _open_worker = functools.cache(lambda: OpticsWorker(instrument, compute))


def _work(line: Connection, nice: int) -> None:
    """Be the process: do what comes and send what came of it, until the line is cut."""
    be_polite(nice)
    with contextlib.suppress(EOFError, OSError):
        while True:
            line.send(_answer(line.recv_bytes()))


def _answer(work: bytes) -> object:
    try:
        return pickle.loads(work)()  # of this very program
    except PyrcalError as error:
        return error
    except Exception as error:  # noqa: BLE001 - sent home, where it is a failed job
        return WorkerError(f"failed unforeseen: {error!r}")


def be_polite(nice: int) -> None:
    """Make this process nice, one BLAS thread wide, and gone when its parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(nice)
    threading.Thread(target=_follow_parent, daemon=True).start()
    threadpool_limits(1)


@contextlib.contextmanager
def _deaf_to_the_keyboard() -> Iterator[None]:
    """Start what is started here with SIGINT held back: it cannot ignore it before it has begun.

    Ctrl-C in a terminal reaches every process there, also one that still imports.
    """
    resource_tracker.ensure_running()  # else the first process starts it, and it lets SIGINT in
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _follow_parent() -> None:
    """End with the service, even when it was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        with contextlib.suppress(OSError):
            parent.join()
        os._exit(1)
