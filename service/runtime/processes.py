"""Run a job in a separate process that can be killed at any moment.

The caller waits in a thread, on a pipe. A process that is killed, even a suspended one, closes the
pipe, and the wait ends. An executor of the standard library would wait for its process to finish
instead.

This module is quick to import: a process can be started at once, and imports
:data:`WORKER_MODULE` while its parent does.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, TypeVar, cast

from threadpoolctl import threadpool_limits

from service.errors import PyrcalError, WorkerError

MAX_COPIED_BYTES = 1 << 16
"""An array that is larger is not copied to be sent: windows of many modes are 45 MB."""

R = TypeVar("R")


class Worker:
    """A process that does one job after another, and keeps the optical models between jobs.

    Nothing runs before the first job. Before that the process imports the module ``imports``, which
    need not be imported here.
    """

    def __init__(self, imports: str) -> None:
        self._imports = imports
        self._busy = threading.Lock()
        self._process: BaseProcess | None = None
        self._line: Connection | None = None
        self._ended = threading.Event()
        self._enter: Callable[[], None] | None = None
        self._enters = False

    @property
    def pid(self) -> int | None:
        """Process id; None: nothing has been asked of it yet."""
        return None if self._process is None else self._process.pid

    def cpu_s(self) -> float:
        """Return the processor time used, as the kernel counts it.

        On a system without such a file it is the wall clock: the process then never appears to be
        stopped.
        """
        if self.pid is None:
            return 0.0
        try:
            words = Path(f"/proc/{self.pid}/stat").read_text("ascii").rpartition(")")[2].split()
        except (OSError, UnicodeDecodeError):
            return time.monotonic()
        # Split after the last ")": the name of a program may contain spaces and brackets. 11 and 12
        # are utime and stime.
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    def do(self, work: Callable[[], R], *, sent: bool = False) -> R:
        """Have it done and return the result; ``work`` must be picklable, like what it returns.

        What has been ``sent`` is only waited for. Blocks until it is done or the process has
        ended, so call off the event loop.

        Raises
        ------
        PyrcalError
            What ``work`` has raised of this kind; WorkerError for anything else it raised.
        EOFError
            If the process died, or was killed meanwhile.
        """
        with self._busy:
            try:
                line = self._start()
                if not sent:
                    _send(line, work)
                answer = _load(*_receive(line))
            except OSError as error:  # no process to be had, or a line that is cut
                raise EOFError from error
        if isinstance(answer, PyrcalError):
            raise answer
        return cast(R, answer)

    def kill(self) -> None:
        """Kill the process at once; the caller's wait ends."""
        self._ended.set()
        process = self._process
        if process is not None:
            process.kill()
            # Reaped here, outside the lock: whoever holds it waits for the pipe, which the death
            # closes.
            process.join()
        with self._busy:
            if self._line is not None:
                self._line.close()

    def _start(self) -> Connection:
        if self._ended.is_set():
            raise EOFError
        if self._line is None:
            # Not fork: a child would inherit zenoh's and the event loop's locks in any state,
            # without their threads.
            context = multiprocessing.get_context("spawn")
            ours, theirs = context.Pipe()
            process = context.Process(
                # Daemon, so that the interpreter does not wait for a fit at exit.
                target=_work,
                args=(theirs, self._imports),
                daemon=True,
            )
            with _deaf_to_the_keyboard():
                process.start()
            self._process, self._line = process, ours
            theirs.close()  # else nobody would notice that the other end is gone
            if self._ended.is_set():  # killed while it was being born
                process.kill()
        return self._line

    def begin(self) -> Worker:
        """Begin the process before there is work for it, and return it."""
        with contextlib.suppress(EOFError, OSError):  # the first job begins it, or says why not
            self._start()
        return self

    def begun(self, enter: Callable[[], None]) -> Worker:
        """Give it its setup before the first job, and return it."""
        self._enter = enter
        if self._line is not None:
            with contextlib.suppress(OSError):  # the first job finds out
                _send(self._line, enter)
                self._enters = True
        return self

    def run(self, job: Callable[[], R]) -> R:
        """Do a job on the optical models; see :meth:`do`."""
        if self._enter is not None:
            self.do(self._enter, sent=self._enters)
            self._enter = None
        return self.do(job)


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
"""Parameters of mallopt(3)."""


def set_allocator(*, map_bytes: int, keep_bytes: int, n_pools: int | None = None) -> None:
    """Set how the GNU C library takes and returns this process's memory; others are left alone.

    Parameters
    ----------
    map_bytes
        Size from which an allocation is a memory map of its own, which is returned once it is free.
    keep_bytes
        Free memory at the end of the heap above which it is returned.
    n_pools
        Pools of memory that all threads share; None for one of each thread, up to a limit.
    """
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, map_bytes)
        library.mallopt(_M_TRIM_THRESHOLD, keep_bytes)
        if n_pools is not None:
            library.mallopt(_M_ARENA_MAX, n_pools)


def return_free_memory() -> None:
    """Return all free memory of this process to the system, where the C library is GNU's."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def _work(line: Connection, imports: str) -> None:
    """Be the process: do what comes and send what came of it, until the line is cut."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    import_module(imports)
    threadpool_limits(1)  # of BLAS, which has been imported now
    with contextlib.suppress(EOFError, OSError):
        while True:
            _send(line, _answer(*_receive(line)))


def _send(line: Connection, what: object) -> None:
    """Send an object: its arrays as raw memory, the rest pickled."""
    buffers: list[memoryview] = []

    def is_small(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes < MAX_COPIED_BYTES:
            return True
        buffers.append(raw)
        return False

    head = io.BytesIO()
    ForkingPickler(head, pickle.HIGHEST_PROTOCOL, True, is_small).dump(what)
    # The sizes go first, so that the receiver can read arrays into memory that is allocated once.
    line.send_bytes(pickle.dumps([buffer.nbytes for buffer in buffers]))
    line.send_bytes(head.getbuffer())
    for buffer in buffers:
        line.send_bytes(buffer)


def _receive(line: Connection) -> tuple[bytes, list[bytearray]]:
    """Return what was sent: pickled, and its arrays where they are to stay."""
    sizes = pickle.loads(line.recv_bytes())  # of this very program
    head, buffers = line.recv_bytes(), [bytearray(size) for size in sizes]
    for buffer in buffers:
        line.recv_bytes_into(buffer)
    return head, buffers


def _load(head: bytes, buffers: list[bytearray]) -> Any:  # noqa: ANN401 - whatever was sent
    return pickle.loads(head, buffers=buffers)  # of this very program


def _answer(head: bytes, buffers: list[bytearray]) -> object:
    try:
        return _load(head, buffers)()
    except PyrcalError as error:
        return error
    except Exception as error:  # noqa: BLE001 - sent home, where it is a failed job
        return WorkerError(f"failed unforeseen: {error!r}")


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
        # Not sys.exit: this is a thread, and the main one may be in a computation of minutes.
        os._exit(1)
