"""End, logging and description of a program of ``pyrcal``; arguments of ``run`` and ``key``.

Quick to import. Names of modes and scopes are repeated here as text; a test compares them.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import re
import resource
import signal
import stat
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, NoReturn, TypeVar

from service.errors import ConfigurationError, PyrcalError, StorageError, say
from service.files.durable import lock_file
from service.parser import words

INTERRUPTED = 130


def status_of(task: Callable[[], int], name: str = "pyrcal") -> int:
    """Return the exit status of a task: its own, 2 after an error, 130 after an interrupt.

    The error is printed in one line, without control characters.
    """
    try:
        return task()
    except PyrcalError as error:
        say(f"{name}: {error}")
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED
    except (MemoryError, ImportError, OSError, RuntimeError) as error:
        limit_mb = _memory_limit_mb()
        if limit_mb is None:
            raise
        # a library that finds no room says so in its own way: no thread, no mapping, no memory
        lines = str(error).splitlines()[-1:] or [type(error).__name__]
        expected = "expected a gigabyte at least, or none (ulimit -v unlimited)"
        say(f"{name}: found a limit of {limit_mb:.0f} MB of memory, {expected}: {lines[0]}")
        return 2


ENOUGH_MB = 1000.0
"""Address space in megabytes above which a failed allocation has another reason than a limit."""


def _memory_limit_mb() -> float | None:
    """Return how little memory this process may have; None: enough to run."""
    limit_bytes, _ = resource.getrlimit(resource.RLIMIT_AS)
    is_small = 0 <= limit_bytes < ENOUGH_MB * 1e6  # RLIM_INFINITY is negative
    return limit_bytes / 1e6 if is_small else None


def run_command(
    read: Callable[[], argparse.Namespace],
    check: Callable[[argparse.Namespace], None],
    load: Callable[[argparse.Namespace], Callable[[argparse.Namespace], int]],
    *,
    own_process: bool,
    serves: bool,
) -> int:
    """Return the exit status of a command.

    Parameters
    ----------
    read
        Reads the command line.
    check
        Refuses files of the wrong type before large modules are imported.
    load
        Imports the command's modules and returns what performs it.
    own_process
        True if this program may install signal handlers.
    serves
        True if the command runs until it is stopped, and handles signals itself.
    """
    if own_process:
        leave_when_asked(0 if serves else INTERRUPTED)

    def perform(options: argparse.Namespace) -> int:
        check(options)
        command = load(options)
        if own_process and not serves:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        return command(options)

    try:
        try:
            options = read()
            options.own_process = own_process
            status = status_of(lambda: perform(options))
            if own_process and serves:
                leave(status)
            return status
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # whoever reads has seen enough, and Python would complain at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def leave_when_asked(status: int) -> None:
    """End at once with this status on SIGINT and SIGTERM, which must not interrupt an import.

    It applies until the program handles the signals itself.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: leave(status))


def import_and_run(
    load: Callable[[], Callable[[], int]],
    *,
    own_process: bool,
    received: tuple[signal.Signals, ...] = (signal.SIGINT,),
) -> int:
    """Return the exit status of a task that takes long to import.

    Parameters
    ----------
    load
        Imports the task. An interrupt meanwhile ends the process at once: nothing has begun that
        it could interrupt.
    own_process
        True if this program may install signal handlers.
    received
        Signals that the task receives as ``KeyboardInterrupt``.
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
    """End this process at once, when everything it opened is closed or must be left behind.

    Threads of zenoh release callbacks after their session is closed. A thread that needs the
    interpreter while it is being finalised aborts the process (before Python 3.14). Child processes
    are ended as well: a suspended one would not notice.
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


# --- which services run on this machine: each leaves a note for as long as it does, locked: what is
#     locked by nobody is of one that has ended, however it did


class RunningService(NamedTuple):
    """A running service, by its note."""

    data_dir: Path
    url: str


def notes_folder() -> Path:
    """Return where the services of this user leave their notes."""
    own = os.environ.get("XDG_RUNTIME_DIR")
    return Path(own) / "pyrcal" if own else Path(tempfile.gettempdir()) / f"pyrcal-{os.getuid()}"


@contextmanager
def announce(data_dir: Path, url: str) -> Iterator[None]:
    """Leave a note while the block lasts; log if the machine takes none."""
    import structlog

    folder = notes_folder()
    path = folder / f"{os.getpid()}.json"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_own(folder):
            raise PermissionError(f"{folder}: others may write there")
        note = path.with_suffix(".part").open("w", encoding="utf-8")
    except OSError as error:
        structlog.get_logger().info("service.not-announced", text=str(error))
        yield
        return
    with note:
        try:
            lock_file(note, path, wait=True)
            json.dump({"data_dir": str(data_dir.absolute()), "url": url}, note)
            note.flush()
            Path(note.name).rename(path)  # whoever finds it finds it locked
        except (OSError, StorageError) as error:
            structlog.get_logger().info("service.not-announced", text=str(error))
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def find_running_services() -> tuple[RunningService, ...]:
    """Return the services of this user that run now, and remove what others have left behind."""
    folder, found = notes_folder(), []
    if not _is_own(folder):
        return ()
    for path in sorted(folder.glob("*.json")):
        with suppress(OSError, StorageError, ValueError, KeyError), path.open() as note:
            try:
                lock_file(note, path, shared=True)
            except BlockingIOError:
                content = json.load(note)
                found.append(RunningService(Path(content["data_dir"]), content["url"]))
            else:
                path.unlink(missing_ok=True)
    return tuple(found)


def data_dir_of_the_one() -> Path | None:
    """Return the folder of the only service that runs; None: none does.

    Raises
    ------
    ConfigurationError
        If there are several: somebody has to say which is meant.
    """
    every = find_running_services()
    if len({one.data_dir for one in every}) > 1:
        which = "; ".join(f"{one.data_dir} ({one.url})" for one in every)
        raise ConfigurationError(
            f"found {len(every)} services that run here, expected --data-dir to say which: {which}"
        )
    return every[0].data_dir if every else None


def _is_own(folder: Path) -> bool:
    """Return whether a folder exists that only this user can write into."""
    try:
        known = folder.stat()
    except OSError:
        return False
    return known.st_uid == os.getuid() and not known.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


# --- what run and key understand


_Read = TypeVar("_Read")

_ENDPOINT = re.compile(r"[\w-]+/\S+")
"""Endpoint of zenoh: a protocol and an address."""


def declare(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    """Add these commands to a command line."""
    _describe_run(commands)
    _describe_key(commands)


_CONFIG = words("--config FILE", "settings of the service, TOML", type=Path)


def _describe_run(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    formats = "auto (default): text on a terminal, else one JSON object a line"
    usual = "zenoh endpoint to listen on, default tcp/127.0.0.1:7447"
    router = "zenoh router of the observatory to connect to"
    dask = "tcp://HOST:PORT of a Dask scheduler, whose workers compute large matrices"
    modes, logs = ["auto", "propose", "hold"], ["auto", "text", "json"]
    commands.add_parser(
        "run",
        help="run the service",
        module="service.cli.commands",
        description="Run the service. Precedence: command line > environment "
        "(PYRCAL_<SECTION>__<KEY>) > TOML file > defaults.",
        examples=("--instrument flao-lbt", "--config /etc/pyrcal/pyrcal.toml --mode hold"),
        options=(
            words("--config FILE", "settings, TOML", type=Path),
            words("--instrument NAME|FILE", "packaged name or TOML file"),
            words("--mode", "mode at the start, default propose", choices=modes),
            words("--data-dir DIR", "folder of archive and audit trail, default var"),
            words("--listen ENDPOINT", usual, type=endpoint),
            words("--connect ENDPOINT", router, type=endpoint),
            words("--host HOST", "address of the REST API, default 127.0.0.1"),
            words("--port PORT", "port of the REST API, default 8080", type=port),
            words("--cluster ADDRESS", dask),
            words("--log-format", formats, choices=logs),
        ),
    )


def _describe_key(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    where = "default: data_dir of the running service, else var"
    scopes = "read: read everything; operate: also give orders; admin: also list and revoke keys"
    choices = ("read", "operate", "admin")
    of_service = (_CONFIG, words("--data-dir DIR", where))
    name = words("name NAME", "name of the person or program that uses it")
    scope = words("--scope", scopes, choices=choices, required=True)
    key = commands.add_parser(
        "key",
        help="make, list or revoke API keys",
        module="service.cli.commands",
        description="Make, list and revoke API keys, in the data_dir of the service. A running "
        "service uses the changed keys at once. docs/operate/operating.md says how a client sends "
        "its key.",
        epilog="Exit status: 0 done; 2 it cannot be done.",
    )
    key.add_commands(
        "action",
        (
            "add",
            "make a key and print it; it cannot be shown again",
            "ada --scope operate",
            (*of_service, name, scope),
        ),
        ("revoke", "revoke a key", "ada", (*of_service, name)),
        ("list", "list the keys and their scopes", "", of_service),
    )


def check_settings(options: argparse.Namespace) -> None:
    """Refuse an unknown instrument, and missing settings.

    Raises
    ------
    PyrcalError
        One line that names the file.
    """
    if getattr(options, "instrument", None) is not None:
        from service.instrument import instrument_path

        instrument_path(options.instrument)  # a wrong name is refused without the schema
    config = getattr(options, "config", None)
    if config is not None and not config.exists():
        raise ConfigurationError(f"{config}: cannot be read: no such file")


def such(
    read: Callable[[str], _Read], holds: Callable[[_Read], object], expected: str
) -> Callable[[str], _Read]:
    """Return a function that reads a text and refuses what is no number, or not as expected."""

    def read_checked(text: str) -> _Read:
        with suppress(ValueError):
            if holds(found := read(text)):
                return found
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}")

    return read_checked


def whole(text: str) -> int:
    """Return the whole number that a text is; -1: none."""
    return int(text) if text.isdecimal() else -1


port = such(whole, lambda n: 0 <= n <= 65535, "a port, 0 to 65535")
endpoint = such(str, _ENDPOINT.fullmatch, "an endpoint like tcp/127.0.0.1:7447")
