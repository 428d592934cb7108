"""Command line of ``pyrcal check-rtc``.

The checks themselves are imported after the arguments have been parsed, so that ``--help`` and
usage errors are instant.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from pathlib import Path

from pyrcal.fitting.arguments import seconds
from service.parser import OneLineParser, words
from service.program import import_and_run, leave

_EPILOG = """
Prints one line for each check: the finding, and the requirements of docs/rtc.md by number (R-n).
WRONG: the contract is broken. seen: allowed, but unusual. skipped: not checked, with the reason.
Checks that move anything ask for consent first; without a terminal they are skipped unless --yes
is given. Exit status: 0 nothing is wrong; 1 something is; 2 nothing could be checked.
"""


def check_parser() -> OneLineParser:
    """Return the parser of the command line."""
    return OneLineParser(
        prog="pyrcal check-rtc",
        description="Check whether an RTC keeps the contract of docs/rtc.md. The checker takes the "
        "place of the service: end the service first, or --connect to its router with --passive.",
        epilog=_EPILOG,
        examples=("--instrument flao-lbt", "--connect tcp/127.0.0.1:7447 --passive"),
        options=(
            words(
                "--instrument NAME|FILE",
                "expected instrument; default flao-lbt, with --connect the packaged one of the "
                "system's name",
            ),
            words(
                "--system NAME",
                "name of the system in the keys; default that of the instrument, with --connect "
                "that of the RTC",
            ),
            [
                words(
                    "--listen ENDPOINT", "zenoh endpoint to listen on, default tcp/127.0.0.1:7447"
                ),
                words("--connect ENDPOINT", "zenoh router to connect to"),
            ],
            words("--config FILE", "settings of the service, TOML, for a secured link", type=Path),
            words(
                "--seconds S",
                "duration of listening, default %(default)g",
                type=seconds,
                default=8.0,
            ),
            words(
                "--wait S", "timeout for the RTC, default %(default)g", type=seconds, default=30.0
            ),
            words("--only CHECK,...", "run these checks only", type=_split_names, default=()),
            words("--passive", "only listen; send no command"),
            words("--open-loop", "also run checks that open the loop: loop, measure"),
            words("--move-image", "also run the check that moves the mirror's image: offload"),
            words("--yes", "consent to all movements beforehand"),
            words("--json", "print JSON"),
        ),
    )


def _split_names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the checks; return 0 if nothing is wrong, 1 if something is, 2 if nothing was checked."""
    options = check_parser().parse_args(arguments)

    def load() -> Callable[[], int]:
        from check_rtc.check import check

        return lambda: check(options)

    # On both signals the checks are unwound, which stops the dither and closes the loop again.
    signals = (signal.SIGINT, signal.SIGTERM)
    return import_and_run(load, own_process=arguments is None, received=signals)


if __name__ == "__main__":
    leave(main())
