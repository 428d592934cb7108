"""The command line. What the commands need is imported when they are known: it takes seconds."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Callable, Sequence

from service import __version__
from service.errors import PyrcalError, shown

_OTHER_PROGRAMS = {"sim": "sim_rtc", "campaign": "studies.campaign"}
"""Run in this one's place: the service does not know the simulator."""


_COMMANDS = {
    "run": ("service.commands.run", "add_run_arguments", "run_service"),
    "fit": ("service.commands.fit", "add_fit_arguments", "run_fit"),
    "reconstruct": (
        "service.commands.reconstruct",
        "add_reconstruct_arguments",
        "run_reconstruct",
    ),
    "demo": ("service.demo", "add_demo_arguments", "run_demo"),
}
"""Module of each command, what declares its arguments, what runs it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0 done, 1 failed, 2 refused at the start."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in _OTHER_PROGRAMS:
        program = _OTHER_PROGRAMS[words[0]]
        os.execv(sys.executable, [sys.executable, "-m", program, *words[1:]])
    if arguments is None:
        _leave_when_asked(words)
    if arguments is None and words[:1] == ["run"]:
        from service.worker import begin_early

        begin_early()
    try:
        run, options = _understood(words)
        if arguments is None and options.command != "run":
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        return run(options)
    except PyrcalError as error:
        sys.stderr.write(f"pyrcal: {shown(str(error))}\n")
        return 2
    except KeyboardInterrupt:
        return 130


def _leave_when_asked(words: Sequence[str]) -> None:
    """End at once on SIGINT and SIGTERM: nothing has begun, and imports must not be cut in two.

    Holds for ``run`` until the service hears them itself.
    """
    status = 0 if words[:1] == ["run"] else 130
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: _leave(status))


def _leave(status: int) -> None:
    """End at once, and with it a worker that was started ahead: a stopped one would not notice."""
    processes = sys.modules.get("multiprocessing")
    if processes is not None:
        for child in processes.active_children():
            child.kill()
    os._exit(status)


def _understood(
    words: Sequence[str],
) -> tuple[Callable[[argparse.Namespace], int], argparse.Namespace]:
    """Return the command that is meant, and its options; the other commands are not imported."""
    from service.commands.terminal import OneLineParser, with_negative_numbers

    parser: argparse.ArgumentParser = OneLineParser(
        prog="pyrcal", description="Calibration service of an adaptive telescope."
    )
    parser.add_argument("--version", action="version", version=f"pyrcal {__version__}")
    commands = parser.add_subparsers(dest="command", required=True)
    meant = words[0] if words and words[0] in _COMMANDS else None
    for name, (module, add, _) in _COMMANDS.items():
        if meant in {None, name}:
            getattr(importlib.import_module(module), add)(commands)
        else:
            commands.add_parser(name, add_help=False)
    commands.add_parser("sim", help="the simulated RTC: pyrcal sim --help", add_help=False)
    commands.add_parser(
        "campaign", help="many simulated nights: pyrcal campaign --help", add_help=False
    )
    options = parser.parse_args(with_negative_numbers(words))
    module, _, run = _COMMANDS[options.command]
    return getattr(importlib.import_module(module), run), options


if __name__ == "__main__":
    sys.exit(main())
