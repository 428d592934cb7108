"""What is kept: the matrices of each kind, which of them for ever, and the audit trail."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import islice
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse
from pydantic import Field

from service.archive import Archive, AuditEntry, Pin, Range
from service.archive.nights import FOREVER_NS
from service.archive.retention import Item, items
from service.runtime.archiving import needed
from service.web.commands import AcceptedView, ClientDep, Said
from service.web.problems import INVALID, UNKNOWN
from service.web.reading import TimeParameters
from service.web.views import ServiceDep, answer, define_view, shows, to_json

router = APIRouter(prefix="/v1", tags=["what it has kept"], responses={**INVALID})

ProductId = Annotated[str, Path(alias="id", description="Id of a matrix of any kind")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """What lies in the archive."""

    products: tuple[Item, ...]
    """Oldest first."""

    n_bytes: int
    """Of all of them."""

    n_bytes_free: int
    """On their disk."""


define_view("ArchiveItemView", Item)
KEPT = define_view("ArchiveView", Kept)


@router.get("/archive", responses={200: shows(KEPT)})
async def archive(service: ServiceDep) -> Response:
    """Return the matrices that are kept, and why those stay that are never removed."""
    in_use = needed(service.snapshot().tracker)
    return answer(await run_in_threadpool(_kept, service.archive, in_use))


def _kept(kept: Archive, in_use: frozenset[str]) -> Kept:
    found = items(kept, in_use)
    n_free = shutil.disk_usage(kept.directory).free
    return Kept(products=found, n_bytes=sum(one.n_bytes for one in found), n_bytes_free=n_free)


@router.put("/archive/{id}/pin", status_code=202, responses=UNKNOWN)
async def pin(client: ClientDep, product_id: ProductId, instruction: Said) -> AcceptedView:
    """Keep a matrix for ever, whatever its age: who and why are kept with it."""
    entry = client.actor.entry(
        "archive.pinned", product_id, by=instruction.by, why=instruction.reason
    )
    made = Pin(id=product_id, who=entry.who, why=entry.why)
    await run_in_threadpool(client.service.archive.pin, made)
    client.service.audit(entry)
    return client.accepted(f"{product_id} is kept for ever", archive="/v1/archive")


@router.delete("/archive/{id}/pin", status_code=202, responses=UNKNOWN)
async def unpin(client: ClientDep, product_id: ProductId, instruction: Said) -> AcceptedView:
    """Let a matrix go when it is old."""
    await run_in_threadpool(client.service.archive.unpin, product_id)
    client.service.audit(
        client.actor.entry(
            "archive.unpinned", product_id, by=instruction.by, why=instruction.reason
        )
    )
    return client.accepted(f"{product_id} goes when it is old", archive="/v1/archive")


# --- the audit trail: who ordered what, when, why and from where, and what it was answered


PAGE = 1000
"""Entries that are read from the disk at once for an export."""


class AuditFormat(StrEnum):
    """How the audit trail leaves."""

    JSON = "json"
    JSONL = "jsonl"
    """One entry on a line, all of the range."""

    CSV = "csv"
    """The same as a table with a head."""


class AuditParameters(TimeParameters):
    """Which part of the audit trail to return, and how."""

    limit: Annotated[int, Field(ge=1, le=5000)] = 200
    """At most so many entries; an export has all of them."""

    after: Annotated[int, Field(ge=0, le=FOREVER_NS)] | None = None
    """``id`` of the last entry of the page before: those that follow; null: the newest ones."""

    format: AuditFormat = AuditFormat.JSON
    """"json", "jsonl" or "csv"."""

    @property
    def part(self) -> Range:
        """The part that is asked for."""
        first_ns, last_ns = self.between
        return Range(since_ns=first_ns, until_ns=last_ns, after=self.after, limit=self.limit)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trail:
    """A part of the audit trail."""

    entries: tuple[AuditEntry, ...]
    """Oldest first."""


ENTRY = define_view("AuditEntryView", AuditEntry)
TRAIL = define_view("AuditView", Trail)


@router.get(
    "/audit",
    response_class=Response,
    responses={
        200: {
            **shows(TRAIL),
            "content": {
                **shows(TRAIL)["content"],
                "application/jsonl": {"schema": {"type": "string"}},
                "text/csv": {"schema": {"type": "string"}},
            },
        }
    },
)
async def audit(service: ServiceDep, parameters: Annotated[AuditParameters, Query()]) -> Response:
    """Return the audit trail: the newest entries, those after one, those of a time; or export it.

    ``?after=`` with the ``id`` of the last entry gives the next page; an empty one is the end.
    """
    if parameters.format is AuditFormat.JSON:
        entries = await run_in_threadpool(service.archive.audit_trail, parameters.part)
        return answer(Trail(entries=entries))
    kind, lines = {
        AuditFormat.JSONL: ("application/jsonl", _json_lines),
        AuditFormat.CSV: ("text/csv", _csv_lines),
    }[parameters.format]
    whole = replace(parameters.part, after=parameters.after or 0)
    name = f"audit.{parameters.format}"
    return StreamingResponse(
        lines(_all(service.archive, whole)),
        media_type=kind,
        headers={"Content-Disposition": f'attachment; filename="{name}"'},
    )


def _all(archive: Archive, part: Range) -> Iterator[dict[str, Any]]:
    """Yield all entries of a part as they leave; each page waits for the disk."""
    page = replace(part, limit=PAGE)
    while entries := archive.audit_trail(page):
        yield from map(to_json, entries)
        page = replace(page, after=entries[-1].id)


def _json_lines(entries: Iterator[dict[str, Any]]) -> Iterator[str]:
    for entry in entries:
        yield json.dumps(entry, ensure_ascii=False) + "\n"


def _csv_lines(entries: Iterator[dict[str, Any]]) -> Iterator[str]:
    """Yield a table; a cell that a spreadsheet would work out is kept from it by an apostrophe."""
    buffer = io.StringIO()
    names = (n for name, part in ENTRY.parts.items() for n in (name, part.clock) if n)
    table = csv.DictWriter(buffer, list(names))
    table.writeheader()
    while True:
        yield buffer.getvalue()
        buffer.seek(0)
        buffer.truncate()
        rows = list(islice(entries, PAGE))
        if not rows:
            return
        table.writerows({name: _inert(cell) for name, cell in row.items()} for row in rows)


def _inert(cell: object) -> object:
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@")) else cell
