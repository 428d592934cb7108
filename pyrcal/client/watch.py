"""``pyrcal watch``: state and log in a terminal, live."""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPResponse
from itertools import chain
from typing import TYPE_CHECKING, Any

from pyrcal.client.reading import understood
from pyrcal.client.remote import DONE, Request
from pyrcal.client.rest import Document, RefusedError, Service, UnreachableError
from pyrcal.client.status import mark_urgent
from pyrcal.terminal import clock, print_document, print_lines, span
from service.errors import say, shown

if TYPE_CHECKING:
    from rich.console import Group

MAX_SILENCE_S = 15.0
"""Silence after which the stream counts as cut, seconds. The service sends a sign of life every
10 s."""

RECONNECT_S = 1.0
"""Time between two attempts to connect, seconds."""

DRAWN_S = 0.25
_LOG_LENGTH = 200
_MAX_LINE_BYTES = 10_000_000
"""Longest line of the stream; a state has a thousandth of that."""

Event = tuple[str, Document]
"""Its name and its data."""

_GROWS = {"age_s", "window_age_s", "frame_age_s", "telemetry_age_s", "uptime_s"}


@dataclass
class Latest:
    """The last state and log from the stream, and when they came."""

    state: Document | None = None
    at_s: float = 0.0
    """Time at which the state came, monotonic seconds."""

    log: tuple[Document, ...] = ()
    last: str = ""
    """Id of the last line of the log."""

    lost: str = "not connected yet"
    """Reason for a missing stream; empty if it is open."""


def run_command(service: Service, request: Request, options: argparse.Namespace) -> int:
    """Show state and log until Ctrl-C; return the exit status.

    Raises
    ------
    RefusedError, UnreachableError
        If there is no stream at the first attempt; later ones go on for ever.
    """
    latest = Latest()
    coming = events(service, request.path, latest)
    # The first event is fetched before anything is drawn, so that an error is an exit status.
    coming = chain([next(coming)], coming)
    try:
        if options.json:
            _print_events(coming)
        elif not sys.stdout.isatty():
            _print_log(coming)
        else:
            _draw(coming, latest)
    except KeyboardInterrupt:
        return DONE
    return DONE


def events(service: Service, path: str, latest: Latest) -> Iterator[Event]:
    """Yield the name and the data of each event; ``lost`` with the reason where the stream ends."""
    ever = False
    while True:
        # The service continues after this line, or says with a reset that it cannot.
        headers = {"Last-Event-ID": latest.last} if latest.last else {}
        try:
            with service.open_response(
                "GET", path, headers=headers, silent_s=MAX_SILENCE_S
            ) as response:
                for name, data in _read(service, response, latest):
                    ever = True
                    if name == "reset":
                        data = service.get("/v1/events", limit=_LOG_LENGTH).document
                        with understood(service):
                            latest.log = tuple(map(dict, data["log"]))
                    elif name == "log":
                        latest.log = (*latest.log, data)[-_LOG_LENGTH:]
                    else:
                        latest.state, latest.at_s, latest.lost = data, time.monotonic(), ""
                    yield name, data
            latest.lost = "the service has ended the stream"
        except (RefusedError, UnreachableError) as error:
            # A service that has never answered is an error; one that restarts is waited for.
            if not ever:
                raise
            latest.lost = str(error)
        yield "lost", {"text": latest.lost}
        time.sleep(RECONNECT_S)


def _read(service: Service, response: HTTPResponse, latest: Latest) -> Iterator[Event]:
    """Yield the events of a stream; remember the ids of the log's lines.

    Raises
    ------
    UnreachableError
        If it is no stream of pyrcal's.
    """
    if not response.headers.get("Content-Type", "").startswith("text/event-stream"):
        raise service.foreign_answer_error("no stream of events")
    fields: dict[str, str] = {}
    while raw := response.readline(_MAX_LINE_BYTES):
        name, _, value = raw.decode(errors="replace").rstrip("\r\n").partition(":")
        # An empty line ends an event.
        if name or value:
            fields[name] = value.removeprefix(" ")
            continue
        if "data" in fields:
            with understood(service):
                data = dict(json.loads(fields["data"]))
            # An event without an id leaves the place in the log as it was.
            latest.last = fields.get("id", latest.last)
            yield fields.get("event", ""), data
        fields = {}


def _print_events(coming: Iterator[Event]) -> None:
    for name, data in coming:
        print_document({"event": name, "data": data}, indent=None)


def _print_log(coming: Iterator[Event]) -> None:
    """Print the log without a screen to draw on."""
    for name, data in coming:
        if name == "lost":
            say(f"DISCONNECTED: {data['text']}; trying again")
        for line in data["log"] if name == "reset" else [data] if name == "log" else ():
            print_lines([_format_log_line(line)])


def _format_log_line(line: Document) -> str:
    times = f" ({line['n_times']} times)" if line["n_times"] > 1 else ""
    return f"{clock(line['t_utc'])}  {line['level']:7}  {line['text']}{times}"


def _draw(coming: Iterator[Event], latest: Latest) -> None:
    """Draw the latest state and its age, while a thread reads the stream."""
    from rich.console import Console
    from rich.live import Live

    # A thread, because the age on the screen must grow while the stream is silent.
    listener = threading.Thread(target=lambda: any(False for _ in coming), daemon=True)
    listener.start()
    with Live(console=Console(), screen=True, auto_refresh=False) as live:
        while listener.is_alive():
            live.update(screen(latest, time.monotonic()), refresh=True)
            time.sleep(DRAWN_S)


def screen(latest: Latest, now_s: float) -> Group:
    """Return the screen at a time, the newest lines of the log first."""
    from rich.console import Group
    from rich.text import Text

    age_s, lost = now_s - latest.at_s, latest.lost
    head = Text(f"connected, the state came {span(age_s)} ago; Ctrl-C ends this", style="green")
    if lost:
        old = f"; what is below is {span(age_s)} old" if latest.state else ""
        head = Text(shown(f"DISCONNECTED: {lost}; trying again{old}"), style="bold white on red")
    try:
        status = [] if latest.state is None else mark_urgent(_add_age(latest.state, age_s))
        log = [
            (_format_log_line(line)[11:], _LEVELS.get(line["level"], ""))
            for line in reversed(latest.log)
        ]
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        # A state with other fields comes from another version of the service.
        status, log = [(f"NOT this version of pyrcal: {error!r}", True)], []
    return Group(
        head,
        Text(),
        *(
            Text(shown(line), style="dim" if lost else "bold red" if urgent else "")
            for line, urgent in status
        ),
        Text(),
        *(
            Text(shown(line), style="dim" if lost else style, no_wrap=True, overflow="ellipsis")
            for line, style in log
        ),
    )


_LEVELS = {"warning": "yellow", "alarm": "bold red"}


def _add_age(value: Any, by_s: float) -> Any:  # noqa: ANN401 - as JSON has it
    """Return a state in which all ages have grown since it came."""
    if not isinstance(value, dict):
        return value
    return {
        name: one + by_s if name in _GROWS and one is not None else _add_age(one, by_s)
        for name, one in value.items()
    }
