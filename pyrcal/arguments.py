"""The arguments of ``pyrcal``; quick to import."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from typing_extensions import override

from pyrcal.client import remote
from pyrcal.fitting import arguments as file_arguments
from pyrcal.playback import arguments as playback_arguments
from service import program
from service.parser import HelpFormatter, OneLineParser, closest

OTHER_PROGRAMS = {
    "demo": ("pyrcal.demo", "run service and simulated telescope together, and judge the outcome"),
    "sim": ("sim_rtc", "run the simulated RTC and telescope"),
    "check-rtc": ("check_rtc", "check whether an RTC keeps the contract"),
    "cacao": ("cacao_bridge", "run the bridge to a cacao loop"),
}
"""Modules and purposes of programs that run in place of this one, with options of their own."""

HEADINGS = {
    "run": "run the service",
    "status": "ask a running service",
    "mode": "operate a running service",
    "archive": "work with the files of a service",
    "fit": "work with files, without a service",
    "demo": "try it, or connect an RTC",
}
"""Heading before the first command of a group."""

DEFAULTS = {"alarms": "list", "reconstructors": "list", "recordings": "list"}
"""Command of a group that is meant if none is given."""


def command_line() -> OneLineParser:
    """Return the parser of ``pyrcal``'s command line; ``command`` names the command."""
    parser = CommandLine(
        prog="pyrcal",
        description="Calibration service of an adaptive telescope. pyrcal COMMAND --help explains "
        "each command.",
        formatter_class=_Grouped,
        examples=(
            "demo",
            "run --instrument flao-lbt",
            "status",
            "fit flao-lbt matrix.h5 --output fit.h5",
        ),
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and commit")
    parser.add_argument(
        "--completion",
        action=_Completion,
        choices=("bash", "zsh", "fish", "tcsh"),
        help="print the completion script of a shell: source <(pyrcal --completion bash)",
    )
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", parser_class=OneLineParser
    )
    program.declare(commands)
    remote.declare(commands)
    file_arguments.declare(commands)
    playback_arguments.declare(commands)
    for name, (_, purpose) in OTHER_PROGRAMS.items():
        commands.add_parser(name, help=purpose, add_help=False)
    return parser


class CommandLine(OneLineParser):
    """Parser that completes a group without a command, and suggests commands of all groups."""

    @override
    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        words = with_default(sys.argv[1:] if args is None else args)
        return super().parse_args(with_negative_numbers(words), namespace)

    @override
    def explain_choice(self, action: argparse.Action, value: str) -> str:
        if action.dest != "command":
            return super().explain_choice(action, value)
        known = {name: name for name in action.choices or ()}
        # A word of a group alone, such as "ack", is answered with the whole command.
        known |= {request.name.split()[-1]: request.name for request in remote.REQUESTS[::-1]}
        near = closest(value, known)
        return f"found {value!r}, which is no command" + near.replace(
            word := near.rpartition(" ")[2], known.get(word, word)
        )


def with_default(given: Sequence[str]) -> list[str]:
    """Return the words of a command line with the default command of a group that has none."""
    if given and given[0] in DEFAULTS:
        following = given[1] if len(given) > 1 else ""
        if not following or (following.startswith("-") and following not in {"-h", "--help"}):
            return [given[0], DEFAULTS[given[0]], *given[1:]]
    return list(given)


class _Grouped(HelpFormatter):
    """Help formatter that prints commands under headings."""

    @override
    def _format_action(self, action: argparse.Action) -> str:
        text = super()._format_action(action)
        heading = HEADINGS.get(str(action.metavar))
        return text if heading is None else f"\n  {heading}:\n{text}"


class _Version(argparse.Action):
    """Action that prints version and commit and exits; it runs git only when it is used."""

    @override
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from service.version import software_version

        print(f"pyrcal {software_version()}")
        parser.exit()


class _Completion(argparse.Action):
    """Action that prints the shell completion of this command line and exits."""

    @override
    def __call__(
        self, parser: argparse.ArgumentParser, _options: object, shell: object, *_: object
    ) -> NoReturn:
        import shtab

        print(shtab.complete(parser, str(shell)))
        parser.exit()


_NEGATIVE = re.compile(r"-[\d.][-+\d.eE]*,.*")


def with_negative_numbers(given: Sequence[str]) -> list[str]:
    """Return command-line words so that argparse accepts ``-0.3,0.1,65,1`` as a value.

    argparse takes it for an option, except if the word contains a blank.
    """
    return [f" {word}" if _NEGATIVE.fullmatch(word) else word for word in given]
