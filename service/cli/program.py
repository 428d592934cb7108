"""How a program of ``pyrcal`` ends, logs and reports errors."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from types import FrameType
from typing import NoReturn

from service.errors import PyrcalError, say

INTERRUPTED = 130


def status_of(task: Callable[[], int], name: str = "pyrcal") -> int:
    """Return the exit status of a task: its own, 2 after an error, 130 after an interrupt.

    The error is told in one line, without a control character.
    """
    try:
        return task()
    except PyrcalError as error:
        say(f"{name}: {error}")
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED


def run_command(
    read: Callable[[], argparse.Namespace],
    check: Callable[[argparse.Namespace], None],
    *,
    own_process: bool,
    serves: bool,
) -> int:
    """Return the exit status of a command, each a module with a ``main`` of its own.

    Parameters
    ----------
    read
        Reads the command line; ``module`` of what it returns names the command's.
    check
        Refuses files that cannot be what they are given as, before anything large is imported.
    own_process
        Whether signals are this program's to hear.
    serves
        Whether the command runs until it is told to stop, and hears signals by itself.
    """
    try:
        try:
            return _commanded(read, check, own_process=own_process, serves=serves)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # whoever reads has seen enough, and Python would complain at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _commanded(
    read: Callable[[], argparse.Namespace],
    check: Callable[[argparse.Namespace], None],
    *,
    own_process: bool,
    serves: bool,
) -> int:
    if own_process:
        _leave_when_asked(0 if serves else INTERRUPTED)
    options = read()
    options.own_process = own_process

    def run_command() -> int:
        check(options)
        command = import_module(options.module)
        if own_process and not serves:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        status: int = command.main(options)
        return status

    status = status_of(run_command)
    if own_process and serves:
        leave(status)
    return status


def _leave_when_asked(status: int) -> None:
    """End at once on SIGINT and SIGTERM: nothing has begun, and imports must not be cut in two.

    Holds for ``run`` until the service hears them itself.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: leave(status))


def imported_and_run(
    load: Callable[[], Callable[[], int]],
    *,
    own_process: bool,
    received: tuple[signal.Signals, ...] = (signal.SIGINT,),
) -> int:
    """Return the exit status of a task that takes long to import.

    Parameters
    ----------
    load
        Imports it. An interrupt meanwhile ends the process at once: nothing has begun that it could
        cut in two.
    own_process
        Whether signals are this program's to hear.
    heard
        Those that the task sees as ``KeyboardInterrupt``.
    """
    if own_process:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    task = load()
    for number in received if own_process else ():
        signal.signal(number, signal.default_int_handler)
    return status_of(task)


def stop_signal() -> threading.Event:
    """Return an event that is set when this process is asked to end."""
    stopped = threading.Event()

    def stop(_signal: int, _frame: FrameType | None) -> None:
        stopped.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return stopped


def leave(status: int) -> NoReturn:
    """End this process at once, when all it has opened is closed or must be left behind.

    Threads of zenoh let go of callbacks after their session is closed. One that wants the
    interpreter while it is being taken down aborts the process (before Python 3.14). A process that
    was started and still runs ends with it: one that is stopped would not notice.
    """
    processes = sys.modules.get("multiprocessing")
    for child in () if processes is None else processes.active_children():
        child.kill()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, RuntimeError):  # nobody reads any more, or a signal met a write
            stream.flush()
    os._exit(status)


def log_to_terminal(*, quiet: bool = False) -> None:
    """Write the log to standard error, a line an entry; ``quiet``: warnings alone."""
    import structlog

    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.KeyValueRenderer(key_order=["timestamp", "level", "event"]),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(
            logging.WARNING if quiet else logging.INFO
        ),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )
