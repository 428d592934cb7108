"""The commands that query a running service; quick to import.

The service's own table, ``service/commands.toml``, defines where REST accepts an order, what is
shown before it, and where its progress is reported. Answers and refusals of the service are printed
verbatim.
"""

from __future__ import annotations

import argparse
import os
import re
import tomllib
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

from pyrcal.options import Words, add, words
from service import errors
from service.errors import ConfigurationError, say

DONE, NOT_DONE, UNREACHABLE = 0, 1, 3
"""Exit statuses; 2 is that of a wrong command line."""

USUAL_URL = "http://127.0.0.1:8080"
ORDERS: Final = tomllib.loads(
    Path(errors.__file__).with_name("commands.toml").read_text(encoding="utf-8")
)
"""Orders by the name of their operation, from the service's table."""

URL, KEY = "PYRCAL_URL", "PYRCAL_API_KEY"
"""Environment variables."""

_EPILOG = """
Exit status: 0 done, 1 refused by the service or not done (of status: not all is well), 2 a wrong
command line, 3 the service is not reached. PYRCAL_URL and PYRCAL_API_KEY replace --url and the
key's file.
"""


class Request(NamedTuple):
    """A command that asks a running service."""

    name: str
    purpose: str
    module: str
    """Module of this package whose ``run_command`` does the work."""

    call: str
    """Method and path of REST; words in braces are options."""

    words: tuple[Words, ...] = ()
    always: Mapping[str, str] = {}
    """Fixed content of the request body."""

    decides_on: str = ""
    """Path of the subject that is shown before, and named in ``If-Match``; empty if there is none.
    """

    asks: str = ""
    """Question that must be confirmed at a terminal; empty if there is none."""

    needs_why: bool = False
    permitted: str = ""
    """Name of the order in the state's ``permitted``; empty if it is always allowed."""

    then: str = ""
    """Action after the answer."""

    follows: str = ""
    """Path that is polled until the work is done; for all reconstructors, that of the copy which is
    sent. Empty if the answer is final."""

    @property
    def method(self) -> str:
        """HTTP method."""
        return self.call.partition(" ")[0]

    @property
    def path(self) -> str:
        """Path of REST; words in braces are options."""
        return self.call.partition(" ")[2]

    @property
    def body(self) -> list[str]:
        """Options that the body of an order says; ``reason`` and ``by`` are of every one."""
        forms = (one.form.partition(" ")[0].lstrip("-").replace("-", "_") for one in self.words)
        return [name for name in forms if name not in {"id", "no_wait"}]


def _reads(name: str, purpose: str, path: str, *every: Words, by: str = "reading") -> Request:
    return Request(name, purpose, by, f"GET {path}", every)


def _orders(name: str, purpose: str, *every: Words, operation: str = "", **more: Any) -> Request:  # noqa: ANN401
    """Return the command that gives an order of the service's table, mostly the one of its name."""
    order = ORDERS[operation or name.replace("-", "_")]
    kind = order["command"]
    if not isinstance(kind, str):
        kind = kind[more.get("always", {}).get("action", "start")]
    followed = next(iter(order.get("follows", {"state": "/v1/state"}).values()))
    return Request(
        name,
        purpose,
        "orders",
        order["call"],
        every,
        decides_on=order.get("decides_on", [""])[-1],
        permitted=re.sub(r"(?<!^)(?=[A-Z])", "_", kind).lower(),
        follows=followed if _NO_WAIT in every else "",
        **more,
    )


def _records(name: str, purpose: str, call: str, *every: Words, **more: Any) -> Request:  # noqa: ANN401
    return Request(name, purpose, "orders", call, every, **more)


def _numbers(kind: type[int] | type[float]) -> Any:  # noqa: ANN401 - argparse's own
    """Return a reader of ``3,5,9``, or of a word that the service knows."""

    def read(text: str) -> object:
        try:
            return [kind(part) for part in text.split(",")]
        except ValueError:
            if kind is int and text in {"controlled", "all"}:
                return text
        raise argparse.ArgumentTypeError(f"found {text!r}, expected numbers with commas")

    return read


_ID = words("id ID", "id of a reconstructor, or in-use, previous, candidate")
_ALARM = words("id ALARM", "name of an alarm, as in pyrcal alarms")
_CANDIDATE = words("id ID", "default: the one proposed last", nargs="?", default="candidate")
_MODES = words("--modes N,...|controlled|all", "modes of the basis", type=_numbers(int))
_RECORDING = words("id ID", "id of a recording, as in pyrcal archive list")
_LASTS = words("--duration-s S", "duration, seconds", type=float)
_EACH = words("--amplitude-m M", "RMS of each mode, metres OPD", type=float)
_LINES = words("--frequency-hz HZ,...", "line of each mode", type=_numbers(float))
_TOTAL = words("--total-amplitude-m M", "RMS of all random signs", type=float)
_OVER = words("--over-budget", "allow more than the budget", default=None)
_NO_WAIT = words("--no-wait", "do not wait for the end")
_SINCE = words("--since TIME", "RFC 3339, like 2026-03-01T20:00:00Z")
_UNTIL = words("--until TIME", "up to this time")

RECONSTRUCTORS = "/v1/reconstructors"
_RESUMES = "pyrcal mode propose, or auto, ends it"

REQUESTS = (
    _reads("status", "show what the service does, on one screen", "/v1/state"),
    _reads("alpha", "show the mirror's registration, with 1 sigma", "/v1/alpha"),
    _reads(
        "reconstructors",
        "list the reconstructors, or show one",
        "/v1/reconstructors",
        words("id ID", "id of one; or in-use, previous, candidate", nargs="?"),
    ),
    _reads("alarms", "list the alarms, with what to do", "/v1/state"),
    _reads(
        "audit",
        "list who ordered what, why, and the outcome",
        "/v1/audit",
        *(_SINCE, _UNTIL, words("--limit N", "number of newest entries; default 200", type=int)),
    ),
    _reads("watch", "show state and log live, until Ctrl-C", "/v1/stream", by="watch"),
    _reads(
        "export",
        "write the history of alpha, the audit trail or a matrix to a file",
        "",
        words(
            "what",
            "alpha: its history; the others: from the archive",
            choices=("alpha", "audit", "reconstructor", "measurement", "noisy-matrix", "recording"),
        ),
        words("id ID", "id of a matrix; or in-use, previous", nargs="?"),
        words("--format F", "alpha, audit: csv, jsonl; matrices: npy, hdf5..."),
        words("--output FILE", "default: a new name in this folder", type=Path),
        *(_SINCE, _UNTIL),
        by="export",
    ),
    _orders(
        "approve",
        "send the proposed reconstructor",
        *(_CANDIDATE, _NO_WAIT),
        asks="send it to the RTC",
    ),
    _orders(
        "reject",
        "discard the proposed reconstructor",
        _CANDIDATE,
        needs_why=True,
    ),
    _orders(
        "publish",
        "send a known reconstructor again",
        *(_ID, _NO_WAIT),
        asks="send it to the RTC again",
    ),
    _orders(
        "rollback",
        "send the previous reconstructor again; mode becomes hold",
        words("--anyway", "even if the gate refuses it: alpha may be what is wrong", default=None),
        _NO_WAIT,
        asks="go back to the one before; mode becomes hold",
        needs_why=True,
        then=_RESUMES,
    ),
    _orders(
        "hold",
        "set mode hold: measure, make and send nothing",
        operation="mode",
        always={"mode": "hold"},
        then=_RESUMES,
    ),
    _orders(
        "mode",
        "set how much the service may do by itself",
        words("mode", choices=("auto", "propose", "hold")),
    ),
    _orders(
        "stop",
        "stop everything: dither off, nothing made or sent",
        then="pyrcal resume releases it",
    ),
    _orders(
        "resume",
        "end pyrcal stop (pyrcal mode ends hold)",
    ),
    _orders(
        "acknowledge",
        "acknowledge an alarm; it stays until it is over",
        _ALARM,
    ),
    _orders(
        "mute",
        "hide an alarm for a time; it is still counted",
        *(_ALARM, words("for_s SECONDS", "twelve hours at most", type=float)),
    ),
    _orders("unmute", "show an alarm again", _ALARM),
    _orders(
        "dither",
        "start or stop the dither",
        words("action", choices=("start", "stop")),
        words("--kind", "binary: random signs", choices=("sine", "binary")),
        *(_MODES, _EACH, _LINES, _TOTAL, _LASTS, _OVER),
    ),
    _orders(
        "refit",
        "compute a reconstructor for the present alpha",
        *(words("--n-modes N", "to control; default: as many as now", type=int), _NO_WAIT),
    ),
    _orders("abort", "end the acquisition", operation="acquisition", always={"action": "abort"}),
    _orders(
        "acquire",
        "find alpha from nothing: open the loop, dither, close it step by step",
        _NO_WAIT,
        operation="acquisition",
        always={"action": "start"},
        asks="open the loop and dither strongly; the image is lost for tens of seconds",
        needs_why=True,
    ),
    _orders(
        "measure",
        "have the RTC measure an interaction matrix; all patterns but sine open the loop",
        words("--pattern NAME", "push-pull-modal, hadamard, sine, ..."),
        words("--n-average N", "pushes and pulls of each", type=int),
        *(_MODES, _EACH, _LINES, _LASTS, _NO_WAIT),
        asks="have the RTC measure; all patterns but sine open the loop",
    ),
    _orders(
        "measure-noisy",
        "measure a noisy interaction matrix on sky, by random signs",
        *(_MODES, _TOTAL, _LASTS, _OVER, _NO_WAIT),
    ),
    _records(
        "record",
        "record telemetry from now on, byte for byte; default one minute",
        "POST /v1/recordings",
        *(
            _LASTS,
            words("--before-s S", "include the last S seconds, 60 at most", type=float),
            _NO_WAIT,
        ),
        follows="/v1/recordings/{id}",
    ),
    _records(
        "end-recording",
        "end a recording; its file stays",
        "POST /v1/recordings/{id}/end",
        _RECORDING,
    ),
    _records(
        "remove-recording",
        "remove a recording for good",
        "DELETE /v1/recordings/{id}",
        _RECORDING,
        asks="remove it for good",
    ),
    _orders(
        "give-up",
        "stop waiting for a measured matrix",
        words("id ID", "id of the measurement"),
    ),
)
"""Commands, in the order of ``pyrcal --help``."""


def declare(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    """Add these commands to a command line."""
    for request in REQUESTS:
        parser = commands.add_parser(
            request.name, help=request.purpose, description=request.purpose, epilog=_EPILOG
        )
        parser.set_defaults(request=request, module=__name__)
        add(parser, *request.words)
        if request.module == "orders":
            add(parser, words("--why WHY", "reason, kept in the audit trail", default=""))
            add(parser, words("--who WHO", "your name; default: the login name"))
        if request.asks:
            add(parser, words("--yes", "do it without asking"))
        add(
            parser,
            words("--json", "print what REST answers"),
            words("--url URL", f"address of the service; default {URL}, else {USUAL_URL}"),
            words(
                "--key-file FILE", f"file with the API key; default: the key in {KEY}", type=Path
            ),
        )


def main(options: argparse.Namespace) -> int:
    """Ask, print, and return the exit status.

    Raises
    ------
    ConfigurationError
        If the address or the key is none.
    """
    # importing the HTTP client takes longer than printing help, so it is imported here
    from pyrcal.client.rest import RefusedError, Service, UnreachableError

    request: Request = options.request
    service = Service(options.url or os.environ.get(URL) or USUAL_URL, _key(options.key_file))
    try:
        status: int = import_module(f"{__package__}.{request.module}").run_command(
            service, request, options
        )
    except RefusedError as error:
        say(f"pyrcal: {request.name}: {error}")
        return NOT_DONE
    except UnreachableError as error:
        say(f"pyrcal: {error}")
        return UNREACHABLE
    return status


def _key(file: Path | None) -> str:
    """Return the API key; empty if there is none."""
    if file is None:
        return os.environ.get(KEY, "").strip()
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"--key-file {file}: {error}") from error
