"""The command line; each command imports only what it needs."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from service.program import INTERRUPTED, leave_when_asked, run_command

SERVING = frozenset({"run", "sim"})
"""Commands that run until they are interrupted, which is then no failure."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status.

    0 done, 1 failed, 2 refused at the start, 3 a service that was to be asked is not reached.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        leave_when_asked(0 if SERVING.intersection(words[:1]) else INTERRUPTED)
    from pyrcal.arguments import OTHER_PROGRAMS, command_line
    from pyrcal.fitting.arguments import check_files

    if words and words[0] in OTHER_PROGRAMS:
        program, _ = OTHER_PROGRAMS[words[0]]
        os.execv(sys.executable, [sys.executable, "-m", program, *words[1:]])
    return run_command(
        lambda: command_line().parse_args(words),
        check_files,
        lambda options: import_module(options.module).main,
        own_process=arguments is None,
        serves=words[:1] == ["run"],
    )


if __name__ == "__main__":
    sys.exit(main())
