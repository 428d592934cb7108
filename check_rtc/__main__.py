"""The arguments of ``pyrcal check-rtc``; quick to import."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Callable, Sequence
from pathlib import Path

from pyrcal.offline.arguments import seconds
from pyrcal.options import add, words
from service.cli.program import OneLineParser, imported_and_run, leave

_EPILOG = """
One line for each requirement of docs/rtc.md: the finding, the requirement, its place. WRONG breaks
the contract, seen is allowed and worth a look, skipped says why. Checks that move anything ask
first; without a terminal they are skipped unless --yes. Exit status: 0 nothing is wrong, 1
something is, 2 nothing could be checked.
"""


def check_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    check = OneLineParser(prog="pyrcal check-rtc")
    check.description = (
        "Listen to an RTC in the service's place, ask it things, and say whether it keeps the "
        "contract of docs/rtc.md. End the service first, or --connect to its router with --passive."
    )
    check.epilog = _EPILOG
    add(
        check,
        words(
            "--instrument NAME|FILE",
            "what slopes and commands are held against; default flao-lbt, and with --connect the "
            "packaged one of the system's name",
        ),
        words(
            "--system NAME",
            "of the keys; default the instrument's name, and with --connect that of the RTC found",
        ),
    )
    add(
        check.add_mutually_exclusive_group(),
        words("--listen ENDPOINT", "default tcp/127.0.0.1:7447"),
        words("--connect ENDPOINT", "a router that is there already"),
    )
    secured = "settings, TOML: [zenoh] says how to connect to a secured link, as the service's do"
    add(
        check,
        words("--config FILE", secured, type=Path),
        words("--seconds S", "to listen, default %(default)g", type=seconds, default=8.0),
        words("--wait S", "for the RTC, default %(default)g", type=seconds, default=30.0),
        words("--only CHECK,...", "these checks and no others", type=_names, default=()),
        words("--passive", "only listen: ask and move nothing"),
        words("--open-loop", "also what opens the loop: loop, measure"),
        words("--move-image", "also what moves the mirror's image on the sensor: offload"),
        words("--yes", "move without asking"),
        words("--json", "print one JSON object at the end"),
    )
    return check


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def main(arguments: Sequence[str] | None = None) -> int:
    """Check; return the exit status: 0 nothing is wrong, 1 something is, 2 nothing was checked."""
    options = check_parser().parse_args(arguments)

    def load() -> Callable[[], int]:
        from check_rtc.check import check

        return lambda: check(options)

    # told to end, it first stops its dither and closes the loop again
    signals = (signal.SIGINT, signal.SIGTERM)
    return imported_and_run(load, own_process=arguments is None, received=signals)


if __name__ == "__main__":
    leave(main())
