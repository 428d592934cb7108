"""The archive's disk: what is old goes, a little at a time; one that is almost full is told."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

import structlog

from service.archive import Archive, AuditEntry
from service.archive.retention import Keeping, due, items, low_on_space, remove
from service.errors import ArchiveError
from service.tracking import events as ev
from service.tracking.alarms import DISK_LOW
from service.tracking.state import TrackerState

LOOK_S = 30.0
"""Between two looks at the free space."""

PRUNE_S = 3600.0
"""Between two looks for what is old."""

REST_S = 0.5
"""Between two products that are removed: others want the disk, too."""


async def keep_house(
    archive: Archive,
    keeping: Keeping,
    state: Callable[[], TrackerState],
    post: Callable[[ev.Trouble], object],
    audit: Callable[[AuditEntry], None],
) -> None:
    """Look after the archive until cancelled; the disk is waited for in threads.

    Parameters
    ----------
    archive
        Open.
    keeping
        What the user has decided to keep.
    state
        Returns what is known now.
    post
        Takes the alarm, and its end.
    audit
        Takes a line for each product that is removed.
    """
    log, next_s = structlog.get_logger(), time.monotonic() + LOOK_S
    while True:
        low = state().alarm(DISK_LOW) is not None
        try:
            text = await asyncio.to_thread(low_on_space, archive.directory, keeping, low=low)
            if text is not None or low:
                post(ev.Trouble(name=DISK_LOW, text=text or "", over=text is None))
            if time.monotonic() >= next_s:
                next_s = time.monotonic() + PRUNE_S
                await _prune(archive, keeping, state, audit)
        except (OSError, ArchiveError) as error:  # the recorder tells of a disk that refuses
            log.warning("archive.not-looked-after", text=str(error))
        except Exception:
            log.exception("archive.not-looked-after")
        await asyncio.sleep(LOOK_S)


async def _prune(
    archive: Archive,
    keeping: Keeping,
    state: Callable[[], TrackerState],
    audit: Callable[[AuditEntry], None],
) -> None:
    """Remove what is old or too much, one by one; what has come into use meanwhile stays."""
    every = await asyncio.to_thread(items, archive, needed(state()))
    for item, why in tuple(due(every, keeping, time.time_ns())):
        if item.id in needed(state()):
            continue
        entry = await asyncio.to_thread(remove, archive, item, why)
        if entry is not None:
            audit(entry)
        await asyncio.sleep(REST_S)


def needed(state: TrackerState) -> frozenset[str]:
    """Return the ids of matrices that somebody may ask for at any moment."""
    ids = (state.in_use, state.previous, state.acquisition.matrix, state.acquisition.applied)
    return frozenset(one for one in ids if one is not None)
