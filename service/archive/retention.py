"""Decide what is kept for ever and what may go."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from service.archive.archive import Archive
from service.archive.index import AuditEntry, by_service
from service.archive.nights import DAY_NS
from service.archive.store import Folder
from service.config.settings import Settings

NEWEST_KEPT = 10
"""Newest products of each kind that are kept for a rollback, whatever their age."""

GIGABYTE = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class RetentionPolicy:
    """The user's limits on what is kept; 0: no limit."""

    keep_days: float = 0.0
    keep_gb: float = 0.0
    """Limit of all products together, in units of 1e9 bytes."""

    reserve_gb: float = 0.0
    """Free space below which an alarm is raised."""


EVERYTHING = RetentionPolicy()


def retention_policy(settings: Settings) -> RetentionPolicy:
    """Return the limits that the settings name in ``[archive]``."""
    table = settings.archive
    return RetentionPolicy(
        keep_days=table.keep_days, keep_gb=table.keep_gb, reserve_gb=table.reserve_gb
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """A product whose numbers are stored in the archive."""

    id: str
    kind: str
    """"reconstructor", "measurement", "noisy matrix" or "recording"."""

    state: str
    """State of the product."""

    stored_ns_utc: int
    """Time at which its file was written, by the service's clock; 0 if there is no file."""

    n_bytes: int
    counted: bool = True
    """True if it counts in ``keep_gb``."""

    kept_because: str = ""
    """Why it is kept for ever; empty: it goes when it is old, or there is too much."""


def items(archive: Archive, in_use: Collection[str] = ()) -> tuple[Item, ...]:
    """Return all products, oldest first.

    Parameters
    ----------
    archive
        Open.
    in_use
        Ids that somebody needs whatever their state says.

    Raises
    ------
    ArchiveError
        If the index cannot be read.
    """
    found, pins = [], archive.index.pins()
    for store in archive.stores:
        records = {record.id: record for record in store.records()}
        there = [_item(store, one, records) for one in store.stored()]
        there.sort(key=lambda item: item.stored_ns_utc)
        kept = {item.id: f"one of the newest {NEWEST_KEPT}" for item in there[-NEWEST_KEPT:]}
        kept |= dict.fromkeys(in_use, "in use") | store.kept(records.values())
        kept |= {pin.id: f"pinned by {pin.who}: {pin.why}" for pin in pins}
        found += [
            replace(item, kept_because=item.kept_because or kept.get(item.id, "")) for item in there
        ]
    return tuple(sorted(found, key=lambda item: item.stored_ns_utc))


def _item(store: Folder, product_id: str, records: Mapping[str, Any]) -> Item:
    """Return a product; a damaged one is kept until somebody has seen it."""
    record = records.get(product_id)
    path, fault = store.path_of(product_id), "" if record else "its record is not understood"
    try:
        status = path.stat()
    except OSError as error:
        status, fault = None, f"its file cannot be found: {error.strerror}"
    return Item(
        id=product_id,
        kind=store.noun,
        counted=store.counted,
        state="" if record is None else record.state,
        stored_ns_utc=0 if status is None else status.st_mtime_ns,
        n_bytes=0 if status is None else status.st_size,
        kept_because=fault,
    )


def due(
    every: Collection[Item], retention: RetentionPolicy, now_ns: int
) -> Iterator[tuple[Item, str]]:
    """Yield what is to go, and why: what is too old, then as much as is too much, oldest first.

    Recordings are large, and stay until somebody removes them: no matrix goes because of one.
    """
    n_bytes = sum(item.n_bytes for item in every if item.counted)
    for item in sorted(every, key=lambda item: item.stored_ns_utc):
        age_days = (now_ns - item.stored_ns_utc) / DAY_NS
        if item.kept_because:
            continue
        if 0 < retention.keep_days < age_days:
            why = f"{age_days:.0f} days old, keep_days is {retention.keep_days:g}"
        elif 0 < retention.keep_gb * GIGABYTE < n_bytes:
            there = n_bytes / GIGABYTE
            why = f"{there:.3g} GB are there, keep_gb is {retention.keep_gb:g}"
        else:
            continue
        n_bytes -= item.n_bytes
        yield item, why


def remove(archive: Archive, item: Item, why: str) -> AuditEntry | None:
    """Remove the numbers of a product unless it was pinned meanwhile; return a log line.

    Raises
    ------
    ArchiveError
        If the disk refuses.
    """
    # Asked again, because the list of what is due may be minutes old.
    if any(pin.id == item.id for pin in archive.index.pins()):
        return None
    next(store for store in archive.stores if store.noun == item.kind).remove(item.id)
    return by_service("archive.removed", f"{item.kind} {item.id}: numbers removed, {why}")


def low_on_space(directory: Path, retention: RetentionPolicy, *, low: bool) -> str | None:
    """Return a warning if the disk has little room, else None.

    After a warning (``low``) a tenth more must be free before it ends.

    Raises
    ------
    OSError
        If the free space cannot be read.
    """
    free_gb = shutil.disk_usage(directory).free / GIGABYTE
    if free_gb >= retention.reserve_gb * (1.1 if low else 1.0):
        return None
    return (
        f"{free_gb:.1f} GB are free in {directory}, reserve_gb is {retention.reserve_gb:g}: free "
        "space there, remove recordings, or lower [archive] keep_days or keep_gb; once it is full "
        "no order is taken"
    )
