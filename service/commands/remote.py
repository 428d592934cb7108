"""The commands that ask a running service: each declared once, here. Nothing heavy is imported.

What the service answers to an order is printed as it says it; what it refuses, too.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from service.commands.terminal import say
from service.errors import ConfigurationError

DONE, NOT_DONE, UNREACHABLE = 0, 1, 3
"""Exit statuses; 2 is that of a command line that makes no sense."""

USUAL_URL = "http://127.0.0.1:8080"
URL, KEY = "PYRCAL_URL", "PYRCAL_API_KEY"
"""Variables of the environment."""

_EPILOG = """
Exit status: 0 done, 1 refused by the service or not done (of status: not all is well), 2 a command
line that makes no sense, 3 the service is not reached. PYRCAL_URL and PYRCAL_API_KEY stand for
--url and the key's file.
"""


class Words(NamedTuple):
    """An option or an operand, as argparse adds it."""

    names: tuple[str, ...]
    how: dict[str, Any]


class Request(NamedTuple):
    """A command that asks a running service."""

    name: str
    purpose: str
    module: str
    """Of this package; its ``carry_out`` does the work."""

    method: str
    path: str
    """Of REST; words in braces are options."""

    words: tuple[Words, ...] = ()
    body: tuple[str, ...] = ()
    """Options that the body of an order says; ``reason`` and ``by`` are of every one."""

    always: tuple[tuple[str, str], ...] = ()
    """What the body says besides."""

    decides_on: str = ""
    """Path of what is shown before, and named in ``If-Match``; empty: nothing."""

    asks: str = ""
    """What somebody at a terminal has to agree to before; empty: nothing."""

    needs_why: bool = False
    then: str = ""
    """What to do afterwards."""

    follows: str = ""
    """Path of what is looked at until the work is done; empty: the answer is the end."""


def _word(*names: str, **how: Any) -> Words:  # noqa: ANN401 - argparse's own
    return Words(names, how)


def _numbers(kind: type[int] | type[float]) -> Any:  # noqa: ANN401 - argparse's own
    """Return what reads ``3,5,9``, or one of the words that the service knows."""

    def read(text: str) -> object:
        try:
            return [kind(part) for part in text.split(",")]
        except ValueError:
            if kind is int and text in {"controlled", "all"}:
                return text
        raise argparse.ArgumentTypeError(f"found {text!r}, expected numbers with commas")

    return read


_ID = _word("id", metavar="ID", help="a reconstructor, or in-use, previous, candidate")
_ALARM = _word("id", metavar="ALARM", help="its name: pyrcal alarms")
_CANDIDATE = _word(
    "id", metavar="ID", nargs="?", default="candidate", help="default: the one proposed last"
)
_MODES = _word("--modes", type=_numbers(int), metavar="N,...|controlled|all", help="of the basis")
_LASTS = _word("--duration-s", type=float, metavar="S", help="how long")
_EACH = _word("--amplitude-m", type=float, metavar="M", help="RMS of each mode, metres OPD")
_LINES = _word("--frequency-hz", type=_numbers(float), metavar="HZ,...", help="a line for each")
_TOTAL = _word("--total-amplitude-m", type=float, metavar="M", help="RMS of all random signs")
_OVER = _word("--over-budget", action="store_true", default=None, help="more than it is meant")
_NO_WAIT = _word("--no-wait", action="store_true", help="do not wait for its end")
_SINCE = _word("--since", metavar="TIME", help="RFC 3339, like 2026-03-01T20:00:00Z")
_UNTIL = _word("--until", metavar="TIME", help="up to this time")

_ONE = "/v1/reconstructors/{id}"
_RESUMES = "pyrcal mode propose, or auto, ends it"

REQUESTS = (
    Request("status", "what the service does, on one screen", "reading", "GET", "/v1/state"),
    Request("alpha", "where the mirror is, and how sure that is", "reading", "GET", "/v1/alpha"),
    Request(
        "reconstructors",
        "the reconstructors, or all about one",
        "reading",
        "GET",
        "/v1/reconstructors",
        (_word("id", nargs="?", metavar="ID", help="one, or in-use, previous, candidate"),),
    ),
    Request("alarms", "the alarms that last, and what to do", "reading", "GET", "/v1/state"),
    Request(
        "audit",
        "who ordered what, why, and what came of it",
        "reading",
        "GET",
        "/v1/audit",
        (_SINCE, _UNTIL, _word("--limit", type=int, metavar="N", help="newest entries; 200")),
    ),
    Request("watch", "what it does, live, until Ctrl-C", "watch", "GET", "/v1/stream"),
    Request(
        "export",
        "the history of alpha, the audit trail or a matrix, to a file",
        "export",
        "GET",
        "",
        (
            _word(
                "what",
                choices=("alpha", "audit", "reconstructor", "measurement", "noisy-matrix"),
                help="alpha: what the service remembers of it; the others: from its archive",
            ),
            _word("id", nargs="?", metavar="ID", help="of a matrix; or in-use, previous"),
            _word("--format", metavar="F", help="alpha, audit: csv, jsonl; matrices: npy, hdf5..."),
            _word("--output", type=Path, metavar="FILE", help="default: a name of its own, here"),
            _SINCE,
            _UNTIL,
        ),
    ),
    Request(
        "approve",
        "send the reconstructor that is proposed",
        "orders",
        "POST",
        f"{_ONE}/approve",
        (_CANDIDATE, _NO_WAIT),
        decides_on=_ONE,
        asks="send it to the RTC",
        follows=_ONE,
    ),
    Request(
        "reject",
        "discard the reconstructor that is proposed",
        "orders",
        "POST",
        f"{_ONE}/reject",
        (_CANDIDATE,),
        decides_on=_ONE,
        needs_why=True,
    ),
    Request(
        "publish",
        "send a known reconstructor again",
        "orders",
        "POST",
        f"{_ONE}/publish",
        (_ID,),
        decides_on=_ONE,
        asks="send it to the RTC again",
    ),
    Request(
        "rollback",
        "go back to the reconstructor before; mode becomes hold",
        "orders",
        "POST",
        "/v1/rollback",
        decides_on="/v1/reconstructors",
        asks="go back to the one before; mode becomes hold",
        needs_why=True,
        then=_RESUMES,
    ),
    Request(
        "hold",
        "only measure: make and send nothing by itself",
        "orders",
        "PUT",
        "/v1/mode",
        always=(("mode", "hold"),),
        then=_RESUMES,
    ),
    Request(
        "mode",
        "how much it may do by itself",
        "orders",
        "PUT",
        "/v1/mode",
        (_word("mode", choices=("auto", "propose", "hold")),),
        body=("mode",),
    ),
    Request(
        "stop",
        "stop everything: dither off, nothing made or sent",
        "orders",
        "POST",
        "/v1/stop",
        then="pyrcal resume releases it",
    ),
    Request(
        "resume",
        "release what pyrcal stop has stopped (hold is ended by pyrcal mode)",
        "orders",
        "POST",
        "/v1/resume",
    ),
    Request(
        "acknowledge",
        "say that an alarm is known of; it stays for as long as it lasts",
        "orders",
        "POST",
        "/v1/alarms/{id}/acknowledge",
        (_ALARM,),
    ),
    Request(
        "mute",
        "show an alarm no more for a time; it is counted",
        "orders",
        "POST",
        "/v1/alarms/{id}/mute",
        (_ALARM, _word("for_s", type=float, metavar="SECONDS", help="twelve hours at most")),
        body=("for_s",),
    ),
    Request(
        "unmute",
        "show an alarm again",
        "orders",
        "POST",
        "/v1/alarms/{id}/unmute",
        (_ALARM,),
    ),
    Request(
        "dither",
        "start or stop the dither",
        "orders",
        "POST",
        "/v1/dither",
        (
            _word("action", choices=("start", "stop")),
            _word("--kind", choices=("sine", "binary"), help="binary: random signs"),
            *(_MODES, _EACH, _LINES, _TOTAL, _LASTS, _OVER),
        ),
        body=(
            *("action", "kind", "modes", "amplitude_m", "frequency_hz", "total_amplitude_m"),
            *("duration_s", "over_budget"),
        ),
    ),
    Request(
        "refit",
        "compute a reconstructor for the alpha of now",
        "orders",
        "POST",
        "/v1/refit",
        (_word("--n-modes", type=int, metavar="N", help="to control; default: as many as now"),),
        body=("n_modes",),
    ),
    Request(
        "abort",
        "end an acquisition under way",
        "orders",
        "POST",
        "/v1/acquisition",
        always=(("action", "abort"),),
    ),
    Request(
        "acquire",
        "find alpha from nothing: open the loop, look, close it step by step",
        "orders",
        "POST",
        "/v1/acquisition",
        (_NO_WAIT,),
        always=(("action", "start"),),
        asks="open the loop and dither strongly; the image is lost for tens of seconds",
        needs_why=True,
        follows="/v1/state",
    ),
    Request(
        "measure",
        "have the RTC measure an interaction matrix; all but a sine open the loop",
        "orders",
        "POST",
        "/v1/measurements",
        (
            _word("--pattern", metavar="NAME", help="push-pull-modal, hadamard, sine, ..."),
            _word("--n-average", type=int, metavar="N", help="pushes, and pulls, of each"),
            *(_MODES, _EACH, _LINES, _LASTS, _NO_WAIT),
        ),
        body=("pattern", "n_average", "modes", "amplitude_m", "frequency_hz", "duration_s"),
        asks="have the RTC measure; all patterns but sine open the loop",
        follows="/v1/measurements/{id}",
    ),
    Request(
        "measure-noisy",
        "measure a noisy interaction matrix on sky, by random signs",
        "orders",
        "POST",
        "/v1/noisy-matrix",
        (_MODES, _TOTAL, _LASTS, _OVER, _NO_WAIT),
        body=("modes", "total_amplitude_m", "duration_s", "over_budget"),
        follows="/v1/noisy-matrix/{id}",
    ),
    Request(
        "give-up",
        "wait no longer for a matrix that is measured",
        "orders",
        "DELETE",
        "/v1/measurements/{id}",
        (_word("id", metavar="ID", help="of the measurement"),),
    ),
)
"""What there is, in the order of ``pyrcal --help``."""


def declare(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    """Add these commands to a command line."""
    for request in REQUESTS:
        parser = commands.add_parser(
            request.name, help=request.purpose, description=request.purpose, epilog=_EPILOG
        )
        parser.set_defaults(request=request, module="remote")
        for word in request.words:
            parser.add_argument(*word.names, **word.how)
        if request.module == "orders":
            parser.add_argument("--why", default="", help="kept in the audit trail")
            parser.add_argument("--who", help="your name; default: the login name")
        if request.asks:
            parser.add_argument("--yes", action="store_true", help="do it without asking")
        parser.add_argument("--json", action="store_true", help="print what REST answers")
        parser.add_argument(
            "--url", metavar="URL", help=f"of the service, default {URL}, else {USUAL_URL}"
        )
        parser.add_argument("--key-file", type=Path, metavar="FILE", help=f"default {KEY}")


def main(options: argparse.Namespace) -> int:
    """Ask, print, and return the exit status.

    Raises
    ------
    ConfigurationError
        If the address or the key is none.
    """
    # HTTP takes longer to import than all the commands are told with
    from service.commands.rest import RefusedError, Service, UnreachableError

    request: Request = options.request
    service = Service(options.url or os.environ.get(URL) or USUAL_URL, _key(options.key_file))
    try:
        status: int = import_module(f"service.commands.{request.module}").carry_out(
            service, request, options
        )
        sys.stdout.flush()
    except RefusedError as error:
        say(f"pyrcal: {request.name}: {error}")
        return NOT_DONE
    except UnreachableError as error:
        say(f"pyrcal: {error}")
        return UNREACHABLE
    except BrokenPipeError:  # whoever reads has seen enough, and Python would complain at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    return status


def _key(file: Path | None) -> str:
    """Return the API key; empty: there is none."""
    if file is None:
        return os.environ.get(KEY, "").strip()
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"--key-file {file}: {error}") from error


def named(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Return those of these options that were given."""
    given = {name: getattr(options, name, None) for name in names}
    return {name: value for name, value in given.items() if value is not None}
