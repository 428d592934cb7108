"""The arguments of ``pyrcal``; quick to import."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from typing import NoReturn

from typing_extensions import override

from pyrcal.client import remote
from pyrcal.fitting import arguments as offline_arguments
from pyrcal.playback import arguments as playback_arguments
from service import __version__, program
from service.program import OneLineParser

OTHER_PROGRAMS = {
    "demo": ("pyrcal.demo", "service and simulated telescope, end to end"),
    "sim": ("sim_rtc", "the simulated RTC"),
    "check-rtc": ("check_rtc", "check whether an RTC keeps the contract"),
    "cacao": ("cacao_bridge", "the bridge to a loop of cacao's"),
}
"""Modules and purposes of programs that run in place of this one, with options of their own."""


HEADINGS = {
    "run": "the service",
    "status": "ask the service",
    "approve": "give the service orders",
    "archive": "what the service has kept, without it",
    "fit": "files in, answers out, without a service",
    "demo": "try it, or an RTC of yours",
}
"""Text before the first command of a group."""


def command_line() -> argparse.ArgumentParser:
    """Return the parser of ``pyrcal``'s command line; ``command`` names the command."""
    parser = OneLineParser(
        prog="pyrcal",
        description="Calibration service of an adaptive telescope.",
        formatter_class=_Grouped,
    )
    parser.add_argument("--version", action="version", version=f"pyrcal {__version__}")
    parser.add_argument(
        "--completion",
        action=_Completion,
        choices=("bash", "zsh", "fish", "tcsh"),
        help="print what teaches a shell these words: source <(pyrcal --completion bash)",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    program.declare(commands)
    remote.declare(commands)
    offline_arguments.declare(commands)
    playback_arguments.declare(commands)
    for name, (_, purpose) in OTHER_PROGRAMS.items():
        commands.add_parser(name, help=f"{purpose}: pyrcal {name} --help", add_help=False)
    return parser


class _Grouped(argparse.HelpFormatter):
    """Help formatter that prints commands under headings."""

    @override
    def _format_action(self, action: argparse.Action) -> str:
        text = super()._format_action(action)
        heading = HEADINGS.get(str(action.metavar))
        return text if heading is None else f"\n  {heading}:\n{text}"


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
