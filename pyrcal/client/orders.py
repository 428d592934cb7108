"""Orders over REST: show the subject, confirm, send, and follow the work to the end."""

from __future__ import annotations

import argparse
import re
import sys
import time
import uuid
from typing import NamedTuple
from urllib.parse import quote

from pyrcal.client.reading import reconstructor_lines, reference_lines, understood
from pyrcal.client.remote import DONE, NOT_DONE, RECONSTRUCTORS, Request, collect_arguments
from pyrcal.client.rest import Document, RefusedError, Service
from pyrcal.terminal import login, print_document, print_lines
from service.errors import ConfigurationError, say, shown

POLL_S = 0.5
"""Time between two requests for the state of work under way, seconds."""

MAX_SWAP_WAIT_S = 30.0
"""Longest time to wait for a matrix to be applied, seconds; it is then left to the service."""

_PENDING_STATES = {"proposed", "published", "staged"}
_UNFINISHED_STATES = _PENDING_STATES | {"waiting", "asked", "running", "finishing"}
_SUCCESS_STATES = {"applied", "superseded", "stored", "made"}


class Step(NamedTuple):
    """Progress of an order's work."""

    text: str
    under_way: bool
    well: bool
    """True if it succeeded."""

    lasts_s: float | None = None
    """Expected duration, seconds; None if it is unknown."""


def run_command(service: Service, request: Request, options: argparse.Namespace) -> int:
    """Show the subject of the order, send it, print the outcome; return the exit status.

    Raises
    ------
    ConfigurationError
        If a reason or a confirmation is missing and there is no terminal to request it.
    RefusedError, UnreachableError
        Errors of the service.
    """
    headers = {}
    # Only if the user will be asked: a script learns the refusal from the order itself.
    if (request.needs_why and not options.why) or (request.asks and not options.yes):
        _refuse_early(service, request)
    if request.decides_on:
        # The order holds for what was shown here, and is refused if that has changed meanwhile.
        headers["If-Match"] = _show(service, request, options)
    why = options.why or (_prompt_user(request, "why", "--why") if request.needs_why else "")
    agreed = (
        not request.asks
        or options.yes
        or _prompt_user(request, f"{request.asks}? [y/N]", "--yes").lower() in {"y", "yes"}
    )
    if not agreed or (request.needs_why and not why):
        say(f"pyrcal {request.name}: nothing was ordered")
        return NOT_DONE
    if request.method == "POST":
        # Lets the order be sent again if its answer is lost.
        headers["Idempotency-Key"] = str(uuid.uuid4())
    # An empty name is a name, too: who orders may choose to give none.
    who = login() if options.who is None else options.who
    # What a file says was read before: this package imports nothing that could.
    given = getattr(options, "content", None) or collect_arguments(options, request.body)
    body = {**given, **request.always, "reason": why, "by": who}
    answer = service.order(request.method, path_of(request.path, options), body, headers).document
    with understood(service):
        text = str(answer["text"])
        # What is followed is what the order has begun, and not its subject.
        options.id = answer.get("id", getattr(options, "id", None))
    follows = request.follows and not options.no_wait
    if not options.json:
        print_lines([text])
    elif not follows:
        print_document(answer)
    if request.then:
        say(request.then)
    return _follow(service, request, options) if follows else DONE


def _refuse_early(service: Service, request: Request) -> None:
    """Refuse what the service would refuse, before asking for a reason."""
    if not request.permitted:
        return
    state = service.get("/v1/state").document
    with understood(service):
        permission = state["permitted"][request.permitted]
        reason = "" if permission["allowed"] else str(permission["reason"])
    if reason:
        raise RefusedError(reason)


def path_of(path: str, options: argparse.Namespace) -> str:
    """Return a path with the id filled in."""
    return re.sub(r"{\w+}", quote(str(getattr(options, "id", "")), safe=""), path)


def _show(service: Service, request: Request, options: argparse.Namespace) -> str:
    """Print the subject of an order, and return its ETag; ``options.id`` becomes its own."""
    document, tag = service.get(path_of(request.decides_on, options))
    options.known = _reconstructors(service) if request.follows == RECONSTRUCTORS else {}
    with understood(service):
        describe = reference_lines if "shape" in document else reconstructor_lines
        lines = list(describe(document))
        options.source = str(document["id"])
        if "id" in options:
            options.id = str(document["id"])
    for line in lines:
        say(line)
    return tag


def _reconstructors(service: Service) -> dict[str, Document]:
    """Return each reconstructor's document by id, oldest first."""
    document = service.get(RECONSTRUCTORS).document
    with understood(service):
        return {one["id"]: one for one in document["reconstructors"]}


def _progress(service: Service, request: Request, options: argparse.Namespace) -> Document:
    """Return the progress; a reconstructor that goes out again does so as a copy."""
    if request.follows != RECONSTRUCTORS:
        return service.get(path_of(request.follows, options)).document
    every = _reconstructors(service).items()
    # The source keeps its state; what goes out is a copy with an id that is not known before.
    copies = [
        one for name, one in every if name not in options.known and one["parent"] == options.source
    ]
    judged = {"id": options.source, "state": "proposed", "reason": "judged again before it is sent"}
    return copies[-1] if copies else judged


def _prompt_user(request: Request, question: str, option: str) -> str:
    """Ask at the terminal and return the answer."""
    # A script must not wait for an answer that never comes.
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ConfigurationError(
            f"{request.name}: found no {option} and no terminal to ask at; expected {option}"
        )
    sys.stderr.write(f"{question} ")
    sys.stderr.flush()
    return sys.stdin.readline().strip()


def _follow(service: Service, request: Request, options: argparse.Namespace) -> int:
    """Show the progress until the work has ended; return the exit status."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console, n_looks = Console(stderr=True), 0
    columns = (
        SpinnerColumn(),
        TimeElapsedColumn(),
        BarColumn(bar_width=20),
        TextColumn("{task.description}", markup=False),
    )
    began_s, shown_text = time.monotonic(), ""
    try:
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("", total=None)
            while True:
                document, n_looks = _progress(service, request, options), n_looks + 1
                lasted_s = time.monotonic() - began_s
                with understood(service):
                    step = _step(document, lasted_s)
                bar.update(
                    task, description=shown(step.text), completed=lasted_s, total=step.lasts_s
                )
                if not step.under_way:
                    break
                if step.text != shown_text and not console.is_terminal:
                    say(step.text)
                shown_text = step.text
                time.sleep(POLL_S)
    except KeyboardInterrupt:
        say("the work goes on; pyrcal watch shows it")
        raise
    if options.json:
        print_document(document)
    elif n_looks > 1 or not step.well:  # otherwise the answer already reported it
        print_lines([step.text])
    return DONE if step.well else NOT_DONE


def _step(document: Document, lasted_s: float) -> Step:
    """Return the progress that a document shows."""
    if "acquisition" in document:
        work = document["acquisition"]
        text = f"acquisition, {work['stage']}: {work['text']}"
        return Step(text, work["under_way"], work["stage"] == "tracking")
    state = document["state"]
    why = f": {document['reason']}" if document["reason"] else ""
    # A matrix may wait for the RTC longer than a person waits at a terminal.
    too_long = state in _PENDING_STATES and lasted_s > MAX_SWAP_WAIT_S
    text = f"{document['id']} is {state}{why}"
    return Step(
        f"{text}, still; pyrcal watch shows the rest" if too_long else text,
        state in _UNFINISHED_STATES and not too_long,
        state in _SUCCESS_STATES,
        document.get("duration_s"),
    )
