"""How a program that ``pyrcal`` starts ends, logs and tells of errors; quickly imported."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import NoReturn

from service.commands.terminal import say
from service.errors import PyrcalError

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


def imported_and_run(
    load: Callable[[], Callable[[], int]],
    *,
    own_process: bool,
    heard: tuple[signal.Signals, ...] = (signal.SIGINT,),
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
    for number in heard if own_process else ():
        signal.signal(number, signal.default_int_handler)
    return status_of(task)


def told_to_stop() -> threading.Event:
    """Return what is set from now on when somebody asks this process to end."""
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
