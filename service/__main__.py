"""``python -m service``: the commands ``run`` and ``key``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from service.parser import OneLineParser
from service.program import check_settings, declare, run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0 done, 1 failed, 2 refused at the start."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = OneLineParser(prog="service", description="Calibration service of a telescope.")
    declare(parser.add_subparsers(dest="command", required=True, metavar="COMMAND"))
    return run_command(
        lambda: parser.parse_args(words),
        check_settings,
        lambda _: import_module("service.cli.commands").main,
        own_process=arguments is None,
        serves=words[:1] == ["run"],
    )


if __name__ == "__main__":
    sys.exit(main())
