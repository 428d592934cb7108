"""The archive: what of each kind lies in it, and what is kept for ever because somebody says so."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Path, Response
from fastapi.concurrency import run_in_threadpool

from service.archive import Archive, Pin
from service.archive.retention import Item, items
from service.routes.commands import AcceptedView, ClientDep
from service.routes.orders import Said
from service.routes.problems import INVALID, UNKNOWN
from service.routes.views import ServiceDep, answer, shows, view
from service.runtime.housekeeping import needed

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


view("ArchiveItemView", Item)
KEPT = view("ArchiveView", Kept)


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
async def pin(client: ClientDep, product_id: ProductId, said: Said) -> AcceptedView:
    """Keep a matrix for ever, whatever its age: who and why are kept with it."""
    entry = client.caller.entry("archive.pinned", product_id, by=said.by, why=said.reason)
    made = Pin(id=product_id, who=entry.who, why=entry.why)
    await run_in_threadpool(client.service.archive.pin, made)
    client.service.audit(entry)
    return AcceptedView(text=f"{product_id} is kept for ever", links=_LINKS)


@router.delete("/archive/{id}/pin", status_code=202, responses=UNKNOWN)
async def unpin(client: ClientDep, product_id: ProductId, said: Said) -> AcceptedView:
    """Let a matrix go when it is old."""
    await run_in_threadpool(client.service.archive.unpin, product_id)
    client.service.audit(
        client.caller.entry("archive.unpinned", product_id, by=said.by, why=said.reason)
    )
    return AcceptedView(text=f"{product_id} goes when it is old", links=_LINKS)


_LINKS = {"archive": "/v1/archive"}
