"""The command line. What a command needs is imported when it is known which is meant."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module

from service.commands.arguments import (
    OTHER_PROGRAMS,
    check_files,
    command_line,
    with_negative_numbers,
)
from service.commands.program import INTERRUPTED, leave, status_of


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status.

    0 done, 1 failed, 2 refused at the start, 3 a service that was to be asked is not reached.
    """
    try:
        try:
            return _carry_out(arguments)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # whoever reads has seen enough, and Python would complain at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _carry_out(arguments: Sequence[str] | None) -> int:
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in OTHER_PROGRAMS:
        program, _ = OTHER_PROGRAMS[words[0]]
        os.execv(sys.executable, [sys.executable, "-m", program, *words[1:]])
    if arguments is None:
        _leave_when_asked(0 if words[:1] == ["run"] else INTERRUPTED)
    options = command_line().parse_args(with_negative_numbers(words))
    options.own_process = arguments is None

    def carry_out() -> int:
        check_files(options)
        module = getattr(options, "module", options.command.replace("-", "_"))
        command = import_module(f"service.commands.{module}")
        if arguments is None and options.command != "run":
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        status: int = command.main(options)
        return status

    status = status_of(carry_out)
    if arguments is None and options.command == "run":
        leave(status)
    return status


def _leave_when_asked(status: int) -> None:
    """End at once on SIGINT and SIGTERM: nothing has begun, and imports must not be cut in two.

    Holds for ``run`` until the service hears them itself.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: leave(status))


if __name__ == "__main__":
    sys.exit(main())
