"""Print the state and the records of a running service."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import quote

from pyrcal.client.remote import DONE, NOT_DONE, Request, collect_arguments
from pyrcal.client.rest import Document, Service
from pyrcal.client.status import alarm_line, registration_lines, status_lines, verdict, worst_first
from pyrcal.terminal import clock, print_document, print_lines, span, table


def run_command(service: Service, request: Request, options: argparse.Namespace) -> int:
    """Ask, print, and return the exit status.

    Raises
    ------
    RefusedError, UnreachableError
        As of the service.
    """
    one = getattr(options, "id", None)
    path = request.path if one is None else f"{request.path}/{quote(one, safe='')}"
    document = service.get(path, **collect_arguments(options, ("since", "until", "limit"))).document
    lines = SCREENS[request.name]
    with understood(service):
        text_lines = [] if options.json else list(lines(document))
        # Only status is a question whose answer can be bad.
        well = request.name != "status" or (document["ready"] and not document["alarms"])
    # Read before it is printed: what is not understood must not be printed in part.
    if options.json:
        print_document(document)
    print_lines(text_lines)
    return DONE if well else NOT_DONE


@contextmanager
def understood(service: Service) -> Iterator[None]:
    """Report an answer that this version of pyrcal does not understand.

    Raises
    ------
    UnreachableError
        Instead of what goes wrong with it.
    """
    try:
        yield
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise service.foreign_answer_error(f"{error!r}; --json shows it") from error


def reconstructor_lines(one: Document) -> Iterator[str]:
    """Yield all that an operator needs to decide about a reconstructor."""
    created = clock(one["created_utc"])
    yield f"{one['id']}: {one['state']}, {one['n_modes']} modes, computed {created}"
    if one["reason"]:
        yield f"reason       {one['reason']}"
    yield f"stability    {verdict(one['gate'])}"
    if one["alpha"] is not None:
        yield "computed for"
        yield from (f"  {line}" for line in registration_lines(one))


def _reconstructors(document: Document) -> Iterator[str]:
    rows = [
        (
            "*" if one["id"] == document["in_use"] else "",
            one["id"],
            one["state"],
            f"{one['n_modes']} modes",
            clock(one["created_utc"]),
            one["reason"] or verdict(one["gate"]),
        )
        for one in document["reconstructors"]
    ]
    yield from table(rows)
    yield "* in use" if any(row[0] for row in rows) else "it is not known which one is in use"


def reference_lines(one: Document) -> Iterator[str]:
    """Yield all that an operator needs to decide about references."""
    held = f"{1e9 * one['rms_m']:.3g} nm RMS" if one["shape"] else "the RTC's own references"
    gain = f", scaled with {one['gain']:.2f}" if one["gain"] else ""
    yield f"{one['id']}: {one['state']}, {held}{gain}, made {clock(one['created_utc'])}"
    if one["unexplained_ratio"]:
        yield f"unexplained  {one['unexplained_ratio']:.0%} of the shape"
    if one["reason"]:
        yield f"reason       {one['reason']}"


def _references(document: Document) -> Iterator[str]:
    shape = document["shape"]
    yield f"shape: {shape['id']} from {shape['source'] or shape['kind']}" if shape else "no shape"
    for one in document["records"]:
        first, *more = reference_lines(one)
        yield f"{'*' if one['id'] == document['used_id'] else ' '} {first}"
        yield from (f"    {line}" for line in more)


def _alpha(document: Document) -> Iterator[str]:
    why = f": {document['validity_reason']}" if document["validity_reason"] else ""
    yield f"{document['validity']}{why}"
    yield from registration_lines(document)
    yield f"from {document['n_windows']} windows, the last telemetry {span(document['age_s'])} ago"
    if document["valid_until_utc"]:
        yield f"valid until {clock(document['valid_until_utc'])}"


def _alarms(state: Document) -> Iterator[str]:
    lasting, gone, muted = worst_first(state), state["stale_alarms"], state["muted_alarms"]
    for alarm in lasting:
        yield alarm_line(alarm, state)
        yield f"    To do: {alarm['do']}"
    for alarm in gone:
        yield f"{alarm['worst_severity']} {alarm['name']} is over, but was not acknowledged:"
        yield f"    {alarm['text']}"
    for note in muted:
        who, until = note["muted"]["by"] or "an unnamed operator", clock(note["muted"]["until_utc"])
        yield f"{note['name']} is muted until {until} by {who}"
    counts = ((lasting, "active"), (gone, "over, not acknowledged"), (muted, "muted"))
    yield ", ".join(f"{len(some)} {word}" for some, word in counts if some) or "no alarm"


def _audit(document: Document) -> Iterator[str]:
    for one in document["entries"]:
        why = f" (because: {one['why']})" if one["why"] else ""
        channel = f", {one['channel']}" if one["channel"] else ""
        yield (
            f"{clock(one['t_utc'])}  {one['who']}{channel}: {one['name']}: "
            f"{one['answer'] or one['text']}{why}"
        )


def _recordings(document: Document) -> Iterator[str]:
    rows = [
        (
            one["id"],
            one["state"],
            clock(one["created_utc"]),
            f"{one['duration_s']:g} s",
            f"{one['n_bytes'] / 1e6:.1f} MB",
            one["why"],
        )
        for one in document["recordings"]
    ]
    yield from table(rows) if rows else ["no recordings"]


SCREENS = {
    "status": status_lines,
    "alpha": _alpha,
    "reconstructors list": _reconstructors,
    "reconstructors show": reconstructor_lines,
    "references list": _references,
    "alarms list": _alarms,
    "recordings list": _recordings,
    "audit": _audit,
}
"""Function that returns the lines of an answer, by command."""
