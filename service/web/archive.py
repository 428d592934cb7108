"""Routes of the archive: matrices, recordings, audit trail."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Awaitable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import islice
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, StreamingResponse
from pydantic import Field

from service.archive import Archive, AuditEntry, Pin, Range
from service.archive.nights import FOREVER_NS
from service.archive.products import RecordingRecord
from service.archive.retention import Item, items
from service.errors import PyrcalError
from service.records.commands import Instruction
from service.records.messages import compose
from service.runtime.archiving import needed
from service.runtime.telemetry_recorder import RecordingChoice
from service.web import views
from service.web.commands import AcceptedView, BodyDep, Client, ClientDep, body
from service.web.connections import not_modified, tag_of
from service.web.history import TimeParameters
from service.web.problems import COMMAND, INVALID, UNKNOWN

router = APIRouter(prefix="/v1", tags=["archive"], responses={**INVALID})

T = TypeVar("T")

ProductId = Annotated[str, Path(alias="id", description="Id of a matrix of any kind")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """Contents of the archive."""

    products: tuple[Item, ...]
    """Oldest first."""

    n_bytes: int
    """Total size of all of them, bytes."""

    n_bytes_free: int
    """On their disk."""


views.define_view("ArchiveItemView", Item)
KEPT = views.define_view("ArchiveView", Kept)


@router.get("/archive", responses={200: views.shows(KEPT)})
async def archive(service: views.ServiceDep) -> Response:
    """Return the archived matrices, and why some are never removed."""
    in_use = needed(service.snapshot().tracker)
    return views.answer(await run_in_threadpool(_kept, service.archive, in_use))


def _kept(kept: Archive, in_use: frozenset[str]) -> Kept:
    found = items(kept, in_use)
    n_free = shutil.disk_usage(kept.directory).free
    return Kept(products=found, n_bytes=sum(one.n_bytes for one in found), n_bytes_free=n_free)


@router.put("/archive/{id}/pin", status_code=202, responses=UNKNOWN)
async def pin(client: ClientDep, product_id: ProductId, command: BodyDep) -> AcceptedView:
    """Keep a matrix for ever."""
    entry = client.actor.entry("archive.pinned", product_id, by=command.by, why=command.reason)
    made = Pin(id=product_id, who=entry.who, why=entry.why)
    await run_in_threadpool(client.service.archive.pin, made)
    await client.service.audited(entry)
    return client.accepted(compose("archive.pinned", id=product_id), archive="/v1/archive")


@router.delete("/archive/{id}/pin", status_code=202, responses=UNKNOWN)
async def unpin(client: ClientDep, product_id: ProductId, command: BodyDep) -> AcceptedView:
    """Let a matrix go when it is old."""
    await run_in_threadpool(client.service.archive.unpin, product_id)
    await client.service.audited(
        client.actor.entry("archive.unpinned", product_id, by=command.by, why=command.reason)
    )
    return client.accepted(compose("archive.unpinned", id=product_id), archive="/v1/archive")


# --- the audit trail: who ordered what, when, why and from where, and what it was answered


EXPORT_PAGE_ENTRIES = 1000
"""Entries that an export reads from the disk at once."""


class AuditFormat(StrEnum):
    """Formats of the exported audit trail."""

    JSON = "json"
    JSONL = "jsonl"
    """One entry on a line, all of the range."""

    CSV = "csv"
    """The same as a table with a head."""


class AuditParameters(TimeParameters):
    """Query parameters that select a part of the audit trail and its format."""

    limit: Annotated[int, Field(ge=1, le=5000)] = 200
    """At most so many entries; an export has all of them."""

    after: Annotated[int, Field(ge=0, le=FOREVER_NS)] | None = None
    """``id`` of the last entry of the page before: those that follow; null: the newest ones."""

    format: AuditFormat = AuditFormat.JSON
    """"json", "jsonl" or "csv"."""

    @property
    def part(self) -> Range:
        """Return the requested part."""
        first_ns, last_ns = self.between
        return Range(since_ns=first_ns, until_ns=last_ns, after=self.after, limit=self.limit)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trail:
    """A part of the audit trail."""

    entries: tuple[AuditEntry, ...]
    """Oldest first."""


ENTRY = views.define_view("AuditEntryView", AuditEntry)
TRAIL = views.define_view("AuditView", Trail)


@router.get(
    "/audit",
    response_class=Response,
    responses={
        200: {
            **views.shows(TRAIL),
            "content": {
                "application/jsonl": {"schema": {"type": "string"}},
                "text/csv": {"schema": {"type": "string"}},
            },
        }
    },
)
async def audit(
    service: views.ServiceDep, parameters: Annotated[AuditParameters, Query()]
) -> Response:
    """Return the audit trail, or export it.

    ``?after=`` with the ``id`` of the last entry gives the next page; an empty one is the end.
    """
    if parameters.format is AuditFormat.JSON:
        entries = await run_in_threadpool(service.archive.audit_trail, parameters.part)
        return views.answer(Trail(entries=entries))
    kind, lines = {
        AuditFormat.JSONL: ("application/jsonl", _json_lines),
        AuditFormat.CSV: ("text/csv", _csv_lines),
    }[parameters.format]
    # From the beginning: without ``after`` the index returns the newest entries.
    whole = replace(parameters.part, after=parameters.after or 0)
    name = f"audit.{parameters.format}"
    return StreamingResponse(
        lines(_all(service.archive, whole)),
        media_type=kind,
        headers={"Content-Disposition": f'attachment; filename="{name}"'},
    )


def _all(archive: Archive, part: Range) -> Iterator[dict[str, Any]]:
    """Yield all entries of a part as they leave; each page waits for the disk."""
    page = replace(part, limit=EXPORT_PAGE_ENTRIES)
    while entries := archive.audit_trail(page):
        yield from map(views.to_json, entries)
        page = replace(page, after=entries[-1].id)


def _json_lines(entries: Iterator[dict[str, Any]]) -> Iterator[str]:
    for entry in entries:
        yield json.dumps(entry, ensure_ascii=False) + "\n"


def _csv_lines(entries: Iterator[dict[str, Any]]) -> Iterator[str]:
    """Yield a table; a cell that a spreadsheet would work out is kept from it by an apostrophe."""
    buffer = io.StringIO()
    table = csv.DictWriter(buffer, list(ENTRY.model_fields))
    table.writeheader()
    while True:
        yield buffer.getvalue()
        buffer.seek(0)
        buffer.truncate()
        rows = list(islice(entries, EXPORT_PAGE_ENTRIES))
        if not rows:
            return
        table.writerows({name: _inert(cell) for name, cell in row.items()} for row in rows)


def _inert(cell: object) -> object:
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@")) else cell


# --- telemetry kept on request: begin a recording, see how far it is, end it, take it away


RecordingId = Annotated[str, Path(alias="id", max_length=128, description="Id of a recording")]

RECORDING = views.define_view("RecordingView", RecordingRecord)


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingList:
    """Telemetry that was kept on request."""

    recordings: tuple[RecordingRecord, ...]
    """Oldest first."""


RECORDINGS = views.define_view("RecordingsView", RecordingList)


class RecordingAcceptedView(AcceptedView):
    """A recording that has begun."""

    id: str
    """Id of the recording."""


async def _await_order(
    client: Client, name: str, instruction: Instruction, order: Awaitable[T]
) -> T:
    """Wait for an order; it is on record, and so is why it is refused."""
    entry = client.actor.entry(name, by=instruction.by, why=instruction.reason)
    try:
        done = await order
    except PyrcalError as error:
        await client.service.audited(replace(entry, name=f"{name}.refused", answer=str(error)))
        raise
    await client.service.audited(replace(entry, text=getattr(done, "id", "")))
    return done


@router.post("/recordings", status_code=202, responses={**COMMAND})
async def begin(
    client: ClientDep, choice: Annotated[RecordingChoice, body(RecordingChoice)]
) -> RecordingAcceptedView:
    """Record telemetry from now on, and what came just before.

    The service holds the last seconds in memory: with ``before_s`` they are in it, and with a
    ``duration_s`` of 0 nothing else.
    The file is what ``pyrcal sim --replay`` plays and ``pyrcal archive aot`` reads.
    """
    who = client.actor.entry("", by=choice.by).who
    recordings = client.service.recordings
    begun = recordings.begin(choice.duration_s, who, choice.reason, choice.before_s)
    made = await _await_order(client, "recording.begin", choice, begun)
    past = f"the last {made.before_s:.1f} s, and " if choice.before_s else ""
    message = compose("archive.records", id=made.id, past=past, duration_s=made.duration_s)
    accepted = client.accepted(message, recording=f"/v1/recordings/{made.id}")
    return RecordingAcceptedView(id=made.id, **accepted.model_dump())


@router.get("/recordings", responses={200: views.shows(RECORDINGS)})
async def recordings(service: views.ServiceDep) -> Response:
    """Return the recordings, oldest first."""
    return views.answer(RecordingList(recordings=await run_in_threadpool(service.recordings.all)))


@router.get("/recordings/{id}", responses={200: views.shows(RECORDING), **UNKNOWN})
async def recording(service: views.ServiceDep, recording_id: RecordingId) -> Response:
    """Return the progress of a recording."""
    every = await run_in_threadpool(service.recordings.all)
    found = next((one for one in every if one.id == recording_id), None)
    return views.answer(views.found_or_refuse(found, f"unknown recording {recording_id}"))


@router.post("/recordings/{id}/end", status_code=202, responses={**COMMAND, **UNKNOWN})
async def end(client: ClientDep, recording_id: RecordingId, command: BodyDep) -> AcceptedView:
    """End a recording early."""
    recordings = client.service.recordings
    reason = f"{command.by or client.actor.key or 'an operator'} has ended it"
    record = await _await_order(
        client, "recording.end", command, recordings.end(reason, recording_id)
    )
    message = compose("archive.recorded", id=recording_id, size_mb=record.n_bytes / 1e6)
    return client.accepted(message, recording=f"/v1/recordings/{recording_id}")


@router.delete("/recordings/{id}", status_code=202, responses={**COMMAND, **UNKNOWN})
async def remove(client: ClientDep, recording_id: RecordingId, command: BodyDep) -> AcceptedView:
    """Remove a recording for good."""
    removed = client.service.recordings.remove(recording_id)
    await _await_order(client, "recording.remove", command, removed)
    return client.accepted(compose("archive.removed", id=recording_id), recordings="/v1/recordings")


_FILE = views.binary("HDF5, as docs/rtc.md and pyrcal sim have recordings", "application/x-hdf5")


@router.get(
    "/recordings/{id}/file",
    response_class=Response,
    responses={200: _FILE, **COMMAND, **UNKNOWN},
)
async def file(request: Request, service: views.ServiceDep, recording_id: RecordingId) -> Response:
    """Return a recording's file."""
    path = await run_in_threadpool(service.recordings.file, recording_id)
    tag = tag_of(recording_id).removeprefix("W/")  # a download may be resumed by a strong one
    headers = {"ETag": tag}
    return not_modified(request, tag) or FileResponse(
        path, media_type="application/x-hdf5", filename=path.name, headers=headers
    )
