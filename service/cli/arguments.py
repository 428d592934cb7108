"""The arguments of ``run`` and ``key``; quick to import.

What the program calls modes and scopes stands here as text; a test compares it.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from typing_extensions import override

from service.errors import ConfigurationError

_Read = TypeVar("_Read")

_ENDPOINT = re.compile(r"[\w-]+/\S+")
"""Of zenoh: a protocol and an address."""


def declare(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    """Add these commands to a command line."""
    _describe_run(commands.add_parser("run", help="the service"))
    _describe_key(commands.add_parser("key", help="make, list, revoke API keys"))


def _describe_run(run: argparse.ArgumentParser) -> None:
    run.set_defaults(module="service.cli.run")
    run.description = (
        "Run the service. Precedence: command line > environment (PYRCAL_<SECTION>__<KEY>) > "
        "TOML file > defaults."
    )
    formats = "default: text on a terminal, else a JSON object a line"
    modes, logs = ["auto", "propose", "hold"], ["auto", "text", "json"]
    router = "an observatory's own zenoh router"
    run.add_argument("--config", metavar="FILE", help="settings, TOML", type=Path)
    run.add_argument("--instrument", metavar="NAME|FILE", help="packaged name or TOML file")
    run.add_argument("--mode", help="default: propose", choices=modes)
    run.add_argument("--data-dir", metavar="DIR", help="products, index, audit trail; default var")
    usual = "zenoh, default tcp/127.0.0.1:7447"
    run.add_argument("--listen", metavar="ENDPOINT", help=usual, type=endpoint)
    run.add_argument("--connect", metavar="ENDPOINT", help=router, type=endpoint)
    run.add_argument("--host", metavar="HOST", help="address of the REST API, default 127.0.0.1")
    run.add_argument("--port", metavar="PORT", help="port of the REST API, default 8080", type=port)
    run.add_argument("--log-format", help=formats, choices=logs)


def _describe_key(key: argparse.ArgumentParser) -> None:
    key.set_defaults(module="service.cli.key")
    key.description = (
        "Make, list and revoke the keys of those who may ask a service, in its data_dir. A running "
        "service goes by them at once. docs/operate/operating.md says how a key is shown."
    )
    key.epilog = "Exit status: 0 done, 2 it cannot be done."
    settings = "the service's settings, TOML"
    where = "the service's data_dir, default that of the one that runs, else var"
    scopes = "read: read everything; operate: give orders, too; admin: also list and revoke keys"
    actions = key.add_subparsers(dest="action", required=True)
    for action, purpose in (
        ("add", "make a key and print it, this once"),
        ("revoke", "revoke a key"),
        ("list", "list the keys and their scopes"),
    ):
        parser = actions.add_parser(action, help=purpose)
        parser.add_argument("--config", metavar="FILE", help=settings, type=Path)
        parser.add_argument("--data-dir", metavar="DIR", help=where)
        if action != "list":
            parser.add_argument("name", metavar="NAME", help="name of the person, program or place")
        if action == "add":
            choices = ("read", "operate", "admin")
            parser.add_argument("--scope", help=scopes, choices=choices, required=True)


def check_settings(options: argparse.Namespace) -> None:
    """Refuse an unknown instrument, and missing settings.

    Raises
    ------
    PyrcalError
        One line that names the file.
    """
    if getattr(options, "instrument", None) is not None:
        from service.config import instrument_path

        instrument_path(options.instrument)  # a wrong name is told without the schema
    config = getattr(options, "config", None)
    if config is not None and not config.exists():
        raise ConfigurationError(f"{config}: cannot be read: no such file")


def such(
    read: Callable[[str], _Read], holds: Callable[[_Read], object], expected: str
) -> Callable[[str], _Read]:
    """Return a function that reads a text and refuses what is no number, or not as expected."""

    def reading(text: str) -> _Read:
        with suppress(ValueError):
            if holds(found := read(text)):
                return found
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}")

    return reading


def whole(text: str) -> int:
    """Return the whole number that a text is; -1: none."""
    return int(text) if text.isdecimal() else -1


port = such(whole, lambda n: 0 <= n <= 65535, "a port, 0 to 65535")
endpoint = such(str, _ENDPOINT.fullmatch, "an endpoint like tcp/127.0.0.1:7447")


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage that would push it off the screen."""

    @override
    def error(self, message: str) -> NoReturn:
        """End the program with status 2."""
        self.exit(2, f"{self.prog}: {message}; {self.prog} --help\n")
