"""``pyrcal export``: write what a service has archived to a file."""

from __future__ import annotations

import argparse
import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote, urlencode

from pyrcal.client.reading import understood
from pyrcal.client.remote import DONE, Request, collect_arguments
from pyrcal.client.rest import Document, Service, chunks
from pyrcal.terminal import print_document, print_lines
from service.errors import ConfigurationError

_MATRIX = ("npy", "raw", "hdf5", "fits")
_SOURCES = {
    "alpha": ("/v1/alpha/history", ("csv", "jsonl")),
    "audit": ("/v1/audit", ("csv", "jsonl")),
    "gains": ("/v1/gains", ("csv", "jsonl")),
    "gains-history": ("/v1/gains/history", ("jsonl",)),
    "reconstructor-gains": ("/v1/reconstructors/{id}/gains", ("csv", "jsonl")),
    "reconstructor": ("/v1/reconstructors/{id}/matrix", _MATRIX),
    "references": ("/v1/references/{id}/slopes", _MATRIX),
    "measurement": ("/v1/measurements/{id}/matrix", _MATRIX),
    "noisy-matrix": ("/v1/noisy-matrix/{id}/file", ("hdf5",)),
    "recording": ("/v1/recordings/{id}/file", ("hdf5",)),
}
"""Path of REST, and formats, the usual one first."""

_ENDINGS = {"hdf5": "h5", "raw": "f4"}

_PAGE_ENTRIES = {"/v1/alpha/history": 1000, "/v1/gains/history": 100}

MATRIX_TIMEOUT_S = 60.0
"""Timeout of a matrix, seconds: the service reads it from its disk before it sends a byte."""


def run_command(service: Service, _request: Request, options: argparse.Namespace) -> int:
    """Write the file; return the exit status.

    Raises
    ------
    ConfigurationError
        If id or format make no sense, or the file is there already, or cannot be written.
    RefusedError, UnreachableError
        As of the service.
    """
    path, formats = _SOURCES[options.what]
    form = options.format or formats[0]
    if form not in formats:
        known = ", ".join(formats)
        raise ConfigurationError(f"--format: found {form!r}, expected for {options.what} {known}")
    if ("{id}" in path) != (options.id is not None):
        what = "an id" if "{id}" in path else "no id"
        raise ConfigurationError(f"export {options.what}: expected {what}")
    words = [options.what, *([options.id] if options.id else [])]
    # An id comes from the service: it must not lead into another folder.
    plain = "".join(c if c.isalnum() or c in "-._" else "_" for c in "-".join(words))
    target = options.output or Path(f"{plain}.{_ENDINGS.get(form, form)}")
    part = target.with_name(f"{target.name}.part")
    path = path.replace("{id}", quote(options.id or "", safe=""))
    query = collect_arguments(options, ("since", "until"))
    # Nothing is overwritten: a matrix under an old name would be taken for another one.
    if target.exists():
        raise ConfigurationError(f"{target}: found a file, expected a new name (--output)")
    if not target.absolute().parent.is_dir():
        raise ConfigurationError(f"{target}: found no folder {target.parent}, expected it to exist")
    write = _WRITERS.get(options.what, _stream_export)
    try:
        with part.open("wb") as file:
            for each in write(service, path, form, query):
                _write(file, each, target)
        # A transfer that breaks off leaves no file under the name.
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    size = target.stat().st_size
    if options.json:
        print_document({"file": str(target), "n_bytes": size})
    else:
        print_lines([f"{target}: {size} bytes"])
    return DONE


def _write(file: BinaryIO, content: bytes, target: Path) -> None:
    """Write to the disk; its errors are not the connection's."""
    try:
        file.write(content)
    except OSError as error:
        raise ConfigurationError(f"{target}: cannot be written: {error.strerror}") from error


def _stream_export(
    service: Service, path: str, form: str, query: dict[str, str]
) -> Iterator[bytes]:
    """Yield the bytes that the service sends."""
    query_path = f"{path}?{urlencode({'format': form, **query})}"
    with service.open_response(
        "GET", query_path, within_s=None, silent_s=MATRIX_TIMEOUT_S
    ) as response:
        yield from chunks(response)


def _history(service: Service, path: str, form: str, query: dict[str, str]) -> Iterator[bytes]:
    """Yield a history, page by page, as lines or as a table with a head."""
    after, head = 0, True
    while True:
        document = service.get(path, **query, after=after, limit=_PAGE_ENTRIES[path]).document
        with understood(service):
            entries = [dict(entry) for entry in document["entries"]]
            lines = _format_entries(entries, form, head=head)
            now = int(entries[-1]["t_ns_utc"]) if entries else 0
        # Also if the last page repeats: a service that ignores "after" must not be asked for ever.
        if now <= after:
            return
        yield lines
        after, head = now, False


def _gains(service: Service, path: str, form: str, query: dict[str, str]) -> Iterator[bytes]:
    """Return the optical gain of each mode, as lines or as a table with a head."""
    table = service.get(path, **query).document
    with understood(service):
        when = {one["mode"]: one["t_utc"] for one in table["measured"]}
        facts = {key: table[key] for key in ("t_utc", "reference_id", "magnitude", "frame_rate_hz")}
        columns = zip(table["optical_gain"], table["sigma"], table["factor"], strict=True)
        entries = [
            {
                "mode": mode,
                **{"optical_gain": gain, "sigma": sigma, "loop_gain_factor": factor},
                "measured_utc": when.get(mode),
                **facts,
            }
            for mode, (gain, sigma, factor) in enumerate(columns)
        ]
    yield _format_entries(entries, form, head=True)


def _format_entries(entries: list[Document], form: str, *, head: bool) -> bytes:
    if form == "jsonl":
        return "".join(json.dumps(entry) + "\n" for entry in entries).encode()
    rows = [_flat(entry) for entry in entries]
    buffer = io.StringIO()
    # A later page may have optional keys that the heading of the first does not have.
    table = csv.DictWriter(buffer, list(rows[0]) if rows else [], extrasaction="ignore")
    if head:
        table.writeheader()
    table.writerows(rows)
    return buffer.getvalue().encode()


def _flat(entry: Document, before: str = "") -> Document:
    """Return a document as flat keys: a nested field is named after both."""
    found: Document = {}
    for name, value in entry.items():
        # A table has no nested fields.
        inside = isinstance(value, dict)
        found |= _flat(value, f"{before}{name}.") if inside else {f"{before}{name}": value}
    return found


_WRITERS = {
    "alpha": _history,
    "gains": _gains,
    "gains-history": _history,
    "reconstructor-gains": _gains,
}
"""Functions for what the service does not send as a file."""
