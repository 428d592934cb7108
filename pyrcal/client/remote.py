"""The commands that query a running service; quick to import.

The service's own table, ``service/commands.toml``, defines where REST accepts an order, what is
shown before it, and where its progress is reported. Answers and refusals of the service are printed
verbatim.
"""

from __future__ import annotations

import argparse
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from service import errors
from service.parser import Words, in_group, words

DONE, NOT_DONE, UNREACHABLE = 0, 1, 3
"""Exit statuses; 2 is that of a wrong command line."""

USUAL_URL = "http://127.0.0.1:8080"
ORDERS: Final = tomllib.loads(
    Path(errors.__file__).with_name("commands.toml").read_text(encoding="utf-8")
)
"""Orders by the name of their operation, from the service's table."""

URL, KEY = "PYRCAL_URL", "PYRCAL_API_KEY"
"""Environment variables."""

FAILURES = {
    "orders": "the service refused the order or did not carry it out",
    "status": "an alarm is active, the service is not ready, or it refused the request",
}
"""Meaning of exit status 1, by module or name of the command. Otherwise the request was refused."""


class Request(NamedTuple):
    """A command that asks a running service."""

    name: str
    purpose: str
    module: str
    """Module of this package that does the work, as ``ask`` lists it."""

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

    example: str = ""
    """Words after the name that make an example for the help."""

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
        return [name for name in forms if name not in {"id", "no_wait", "file"}]


def _reads(
    name: str, purpose: str, path: str, *every: Words, by: str = "reading", example: str = ""
) -> Request:
    return Request(name, purpose, by, f"GET {path}", every, example=example)


def _orders(name: str, purpose: str, *every: Words, operation: str = "", **more: Any) -> Request:  # noqa: ANN401
    """Return the command of an order in the service's table.

    By default that is the order of its last word, or of its first one, which is the group's.
    """
    order = ORDERS[operation or next(word for word in reversed(name.split()) if word in ORDERS)]
    kind = order["command"]
    if not isinstance(kind, str):
        kind = kind[more.get("always", {}).get("action", "start")]
    more.setdefault("permitted", re.sub(r"(?<!^)(?=[A-Z])", "_", kind).lower())
    followed = next(iter(order.get("follows", {"state": "/v1/state"}).values()))
    return Request(
        name,
        purpose,
        "orders",
        order["call"],
        every,
        decides_on=order.get("decides_on", [""])[-1],
        follows=followed if _NO_WAIT in every else "",
        **more,
    )


def _records(name: str, purpose: str, call: str, *every: Words, **more: Any) -> Request:  # noqa: ANN401
    return Request(name, purpose, "orders", call, every, **more)


def _numbers(kind: type[int] | type[float], *names: str) -> Any:  # noqa: ANN401 - argparse's own
    """Return a reader of ``3,5,9``, or of one of these names."""

    def read(text: str) -> object:
        try:
            return [kind(part) for part in text.split(",")]
        except ValueError:
            if text in names:
                return text
        raise argparse.ArgumentTypeError(f"found {text!r}, expected numbers with commas")

    return read


_ID = words("id ID", "id of a reconstructor, or in-use, previous, candidate")
_ALARM = words("id ALARM", "name of an alarm")
_CANDIDATE = words("id ID", "default: the one proposed last", nargs="?", default="candidate")
_OFFERED = words(
    "id ID", "id of references; default: those proposed", nargs="?", default="candidate"
)
_NUMBERED = words(
    "--modes N,...", "modes by number, from 0; default: those in the loop", type=_numbers(int)
)
_NAMED = words(
    "--modes N,...|controlled|all",
    "modes by number, from 0; with random signs also controlled (those in the loop) or all (the "
    "whole basis)",
    type=_numbers(int, "controlled", "all"),
)
_RECORDING = words("id ID", "id of a recording")
_LASTS = words("--duration-s S", "duration in seconds", type=float)
_EACH = words("--amplitude-m M", "RMS of each mode in metres of OPD", type=float)
_LINES = words("--frequency-hz HZ,...", "frequency of each mode", type=_numbers(float))
_TOTAL = words("--total-amplitude-m M", "RMS of all modes together in metres", type=float)
_OVER = words(
    "--over-budget", "allow a total amplitude above [dither] budget_m of the settings", default=None
)
_NO_WAIT = words("--no-wait", "return once the order is accepted")
_SINCE = words("--since TIME", "from this time on, RFC 3339, like 2026-03-01T20:00:00Z")
_UNTIL = words("--until TIME", "up to this time")

RECONSTRUCTORS = "/v1/reconstructors"

GROUPS = {
    "alarms": "list, acknowledge or mute alarms",
    "reconstructors": "list, compute, approve, send or roll back reconstructors",
    "references": "load a shape that the loop holds; list, approve or roll back references",
    "loop": "open or close the loop; acquire the registration from nothing",
    "dither": "start or stop the dither, from which alpha is measured; the service usually runs it "
    "by itself",
    "measure": "measure an interaction matrix",
    "recordings": "record telemetry; list, end or remove recordings",
}
"""Purposes of the commands that are groups of others."""

REQUESTS = (
    _reads("status", "show the state of the service on one screen", "/v1/state"),
    _reads("watch", "show state and log live, until Ctrl-C", "/v1/stream", by="watch"),
    _reads("alpha", "show the registration with 1 sigma", "/v1/alpha", example="--json"),
    _reads("alarms list", "list the alarms, and what to do about each", "/v1/state"),
    _orders(
        "alarms ack",
        "acknowledge an alarm; it stays until its cause is gone",
        _ALARM,
        operation="acknowledge",
        example="margin --why 'seen, waiting for the next window'",
    ),
    _orders(
        "alarms mute",
        "hide an alarm for a time; what it forbids stays forbidden",
        *(_ALARM, words("for_s SECONDS", "up to 43200 (twelve hours)", type=float)),
        example="margin 3600 --why 'seen, lowering the gain'",
    ),
    _orders("alarms unmute", "show a muted alarm again", _ALARM, example="margin"),
    _reads(
        "audit",
        "list who ordered what, why, and the outcome",
        "/v1/audit",
        *(_SINCE, _UNTIL, words("--limit N", "number of newest entries; default 200", type=int)),
        example="--since 2026-03-01T20:00:00Z",
    ),
    _reads(
        "export",
        "write the history of alpha, the audit trail, optical gains, a matrix or a recording to a "
        "file",
        "",
        words(
            "what",
            "what to write",
            choices=(
                *("alpha", "audit", "gains", "gains-history", "reconstructor-gains"),
                *("reconstructor", "references", "measurement", "noisy-matrix", "recording"),
            ),
        ),
        words("id ID", "id of the matrix or recording; or in-use, previous", nargs="?"),
        words(
            "--format F",
            "of alpha, audit, gains: csv, jsonl; of gains-history: jsonl; of matrices: npy, raw, "
            "hdf5, fits",
        ),
        words("--output FILE", "default: a new name in the current folder", type=Path),
        *(_SINCE, _UNTIL),
        by="export",
        example="reconstructor in-use --format hdf5 --output cm.h5",
    ),
    _orders(
        "mode",
        "set what the service may do by itself",
        words(
            "mode",
            "auto: make and send reconstructors; propose: make them, send after approval; hold: "
            "measure only",
            choices=("auto", "propose", "hold"),
        ),
        example="hold --why 'wind above 15 m/s'",
    ),
    _orders(
        "stop",
        "stop everything: end the dither, make and send nothing",
        then="pyrcal resume ends the stop",
        example="--why 'dome closing'",
    ),
    _orders("resume", "end the stop; mode and dither are then as before"),
    _reads(
        "reconstructors list", "list the reconstructors; * marks the one in use", RECONSTRUCTORS
    ),
    _reads(
        "reconstructors show",
        "show one reconstructor, with its registration and stability",
        RECONSTRUCTORS,
        _ID,
        example="in-use",
    ),
    _orders(
        "reconstructors compute",
        "compute a reconstructor for the present registration",
        *(words("--n-modes N", "modes to control; default: as many as now", type=int), _NO_WAIT),
        operation="refit",
        example="--n-modes 300",
    ),
    _orders(
        "reconstructors approve",
        "send the proposed reconstructor to the RTC",
        *(_CANDIDATE, _NO_WAIT),
        asks="send it to the RTC",
        example="--why 'margin restored'",
    ),
    _orders(
        "reconstructors reject",
        "discard the proposed reconstructor",
        _CANDIDATE,
        needs_why=True,
        example="--why 'alpha is not plausible'",
    ),
    _orders(
        "reconstructors publish",
        "send a reconstructor again that was in use or proposed before",
        *(_ID, _NO_WAIT),
        asks="send it to the RTC again",
        example="previous",
    ),
    _orders(
        "reconstructors rollback",
        "send the previous reconstructor again; the mode becomes hold",
        words("--anyway", "even if the stability check refuses it", default=None),
        _NO_WAIT,
        asks="go back to the previous reconstructor; the mode becomes hold",
        needs_why=True,
        then="pyrcal mode propose, or auto, ends mode hold",
        example="--why 'image is elongated'",
    ),
    _orders(
        "references load",
        "load a shape that the loop is to hold, from a JSON, FITS, HDF5 or NumPy file",
        words("file FILE", "its numbers, with kind, frame and unit where it has them", type=Path),
        words(
            "--kind",
            "modes of the basis, Zernike coefficients (Noll), a map on the pupil, or slopes",
            choices=("modes", "zernike", "map", "slopes"),
        ),
        words(
            "--frame",
            "mirror: of modes, which move with the mirror; instrument: all others",
            choices=("mirror", "instrument"),
        ),
        words("--unit", "unit of the numbers, RMS of OPD", choices=("m", "um", "nm")),
        operation="load_shape",
        example="ncpa.fits --kind zernike --frame instrument --unit nm",
    ),
    _reads("references list", "list the references; * marks those in use", "/v1/references"),
    _orders(
        "references approve",
        "send the proposed references to the RTC",
        *(_OFFERED, _NO_WAIT),
        operation="approve_references",
        asks="send them to the RTC",
        example="--why 'shape checked'",
    ),
    _orders(
        "references reject",
        "discard the proposed references",
        _OFFERED,
        operation="reject_references",
        needs_why=True,
        example="--why 'sign is not sure'",
    ),
    _orders(
        "references rollback",
        "send the references in use before; no others are made until a shape is loaded",
        operation="roll_back_references",
        asks="go back to the references in use before",
        needs_why=True,
        example="--why 'image got worse'",
    ),
    _orders(
        "references clear",
        "hold no shape any more; the RTC returns to its own references",
        operation="clear_shape",
        asks="return to the RTC's own references",
        example="--why 'end of the night'",
    ),
    _orders(
        "loop open",
        "have the RTC open the loop",
        always={"loop": "open"},
        permitted="open_loop",
        asks="open the loop; the image is lost",
        example="--why 'diverging'",
    ),
    _orders(
        "loop close",
        "have the RTC close the loop",
        always={"loop": "closed"},
        asks="close the loop",
    ),
    _orders(
        "loop acquire",
        "acquire the registration from nothing: open the loop, dither, close it step by step",
        _NO_WAIT,
        operation="acquisition",
        always={"action": "start"},
        asks="open the loop and dither strongly; the image is lost for tens of seconds",
        needs_why=True,
        example="--why 'mirror was exchanged'",
    ),
    _orders(
        "loop abort", "end the acquisition", operation="acquisition", always={"action": "abort"}
    ),
    _orders(
        "dither start",
        "start a dither; the service chooses what is not given",
        words(
            "--kind",
            "sine: one frequency for each mode; binary: random signs",
            choices=("sine", "binary"),
        ),
        *(_NAMED, _EACH, _LINES, _TOTAL, _LASTS, _OVER),
        always={"action": "start"},
        example="--modes 3,5 --frequency-hz 90,110 --amplitude-m 5e-9",
    ),
    # Named, because "stop" is an order of its own.
    _orders(
        "dither stop",
        "stop the dither; the service starts no other until ordered to",
        operation="dither",
        always={"action": "stop"},
    ),
    _orders(
        "measure matrix",
        "have the RTC measure an interaction matrix; all patterns but sine open the loop",
        words("--pattern NAME", "push-pull-modal, hadamard, sine, ..."),
        words("--n-average N", "pushes and pulls of each mode", type=int),
        *(_NUMBERED, _EACH, _LINES, _LASTS, _NO_WAIT),
        asks="have the RTC measure; all patterns but sine open the loop",
        example="--pattern sine --modes 3,5",
    ),
    _orders(
        "measure noisy",
        "measure a noisy interaction matrix on sky, by a dither of random signs",
        *(_NAMED, _TOTAL, _LASTS, _OVER, _NO_WAIT),
        operation="measure_noisy",
        example="--duration-s 60",
    ),
    _orders(
        "measure cancel",
        "stop waiting for a measured matrix",
        words("id ID", "id of the measurement"),
        operation="give_up",
        example="im-1",
    ),
    _reads("recordings list", "list the recordings, oldest first", "/v1/recordings"),
    _records(
        "recordings start",
        "record telemetry from now on, byte for byte; default one minute",
        "POST /v1/recordings",
        *(
            _LASTS,
            words("--before-s S", "include the last S seconds, up to 60", type=float),
            _NO_WAIT,
        ),
        follows="/v1/recordings/{id}",
        example="--duration-s 30 --before-s 10 --why 'vibration at 40 Hz'",
    ),
    _records(
        "recordings end",
        "end a recording; its file stays",
        "POST /v1/recordings/{id}/end",
        _RECORDING,
        example="tm-1",
    ),
    _records(
        "recordings remove",
        "remove a recording for good",
        "DELETE /v1/recordings/{id}",
        _RECORDING,
        asks="remove it for good",
        example="tm-1",
    ),
)
"""Commands, in the order of ``pyrcal --help``."""

CONNECTION, ORDER = "connection options", "order options"
"""Titles of options that many commands share."""


_CONNECTION = in_group(
    CONNECTION,
    words("--json", "print the answer of the REST interface"),
    words("--url URL", f"address of the service; default {URL}, else {USUAL_URL}"),
    words("--key-file FILE", f"file with the API key; default: the key in {KEY}", type=Path),
)


def declare(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    """Add these commands to a command line."""
    groups: dict[str, Any] = {}
    for request in REQUESTS:
        name, _, word = request.name.partition(" ")
        if word and name not in groups:
            below = [one for one in REQUESTS if one.name.startswith(f"{name} ")]
            group = commands.add_parser(
                name,
                help=GROUPS[name],
                description=_sentence(GROUPS[name]),
                examples=[f"{one.name.partition(' ')[2]} {one.example}".rstrip() for one in below],
            )
            groups[name] = group.add_subparsers(dest="word", required=True, metavar="COMMAND")
        forms = {one.form.partition(" ")[0] for one in request.words}
        parser = (groups[name] if word else commands).add_parser(
            word or name,
            help=request.purpose,
            description=_sentence(request.purpose),
            epilog=_epilog(request),
            examples=[request.example],
            options=(*request.words, *_order_options(request), *_CONNECTION),
            module="pyrcal.shapes" if "file" in forms else f"{__package__}.ask",
        )
        parser.set_defaults(request=request)


def _order_options(request: Request) -> tuple[Words, ...]:
    """Return the options that every order has."""
    if request.module != "orders":
        return ()
    required = " (prompted for at a terminal)" if request.needs_why else ""
    return in_group(
        ORDER,
        words("--why WHY", f"reason, kept in the audit trail{required}", default=""),
        words("--who WHO", "your name; default: the login name"),
        *([words("--yes", "do it without confirmation")] if request.asks else []),
    )


def _epilog(request: Request) -> str:
    """Return the end of the help of a command."""
    usual = FAILURES.get(request.module, "the service refused the request")
    failure = FAILURES.get(request.name, usual)
    if request.asks or request.needs_why:
        failure += ", or it was not confirmed"
    return (
        f"Exit status: 0 done; 1 {failure}; 2 wrong command line; 3 the "
        f"service cannot be reached. Without --url, {URL} is used; without --key-file, {KEY}."
    )


def _sentence(purpose: str) -> str:
    return f"{purpose[:1].upper()}{purpose[1:]}."


def collect_arguments(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Return those of the named options that were given."""
    given = {name: getattr(options, name, None) for name in names}
    return {name: value for name, value in given.items() if value is not None}
