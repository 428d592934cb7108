"""``pyrcal archive``: list, verify, prune and export a service's archive."""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Any

from pyrcal.terminal import show_progress
from service.archive import Archive
from service.archive.nights import FOREVER_NS, HOUR_NS, MAX_DOWNSAMPLED
from service.archive.retention import Item, due, items, remove, retention_policy
from service.archive.serialisation import to_json
from service.config import Settings, load_settings
from service.errors import ArchiveError, ConfigurationError, UnknownIdError, say, shown
from service.files.documents import json_text
from service.records.products import MatrixState

DONE, DAMAGED = 0, 1

ALPHA_MARGIN_NS = HOUR_NS
"""Time before and after the telemetry for which α is included, nanoseconds."""


def main(options: argparse.Namespace) -> int:
    """Run an archive command; return the exit status: 0 done, 1 something is damaged.

    Raises
    ------
    ArchiveError, ConfigurationError, UnknownIdError
        If it cannot be done.
    """
    settings = read_settings(options)
    if options.action == "aot":
        return _aot(options, settings)
    if options.action == "prune":
        return _prune(settings, dry_run=options.dry_run, as_json=options.json)
    with open_archive(settings) as archive:
        every = items(archive, _list_saved_matrices(archive))
        if options.action == "list":
            return _list(every, as_json=options.json)
        if options.action == "show":
            return _show(archive, every, options.id, as_json=options.json)
        return _verify(archive, every, as_json=options.json)


def read_settings(options: argparse.Namespace) -> Settings:
    """Return the settings of the service whose files the archive options name."""
    given = {} if options.data_dir is None else {"service.data_dir": options.data_dir}
    return load_settings(options.config, os.environ, given)


@contextmanager
def open_archive(settings: Settings) -> Iterator[Archive]:
    """Open the archive to read, whether a service runs or not."""
    # With the site's noon, because it decides which night a measurement belongs to.
    with Archive(settings.service.data_dir, settings.archive.noon_utc_h) as archive:
        archive.look()
        yield archive


def _list(every: tuple[Item, ...], *, as_json: bool) -> int:
    if as_json:
        print(json_text([asdict(item) for item in every], indent=2))
        return DONE
    for item in every:
        print(shown(_line(item)))
    counted, others = (
        sum(item.n_bytes for item in every if item.counted is so) / 1e6 for so in (True, False)
    )
    text = f"{counted:.1f} MB that count in keep_gb, {others:.1f} MB that do not"
    say(f"{len(every)} products: {text}")
    return DONE


def _line(item: Item) -> str:
    stored = datetime.fromtimestamp(item.stored_ns_utc // 1_000_000_000, UTC)
    size_mb = item.n_bytes / 1e6
    text = (
        f"{stored:%Y-%m-%dT%H:%M:%SZ} {item.kind:13} {item.state:10} {size_mb:9.3f} MB  {item.id}"
    )
    return f"{text}  kept: {item.kept_because}" if item.kept_because else text


def _show(archive: Archive, every: tuple[Item, ...], product_id: str, *, as_json: bool) -> int:
    item = next((item for item in every if item.id == product_id), None)
    if item is None:
        raise UnknownIdError(
            f"{product_id}: no such product in {archive.directory}; pyrcal archive list has all"
        )
    store = next(store for store in archive.stores if store.noun == item.kind)
    record = next((record for record in store.records() if record.id == product_id), None)
    # The numbers are read as well, because the index does not know of damage.
    damage = next(verify(archive, [item]))
    document: dict[str, Any] = {
        **asdict(item),
        "path": str(store.path_of(item.id)),
        "damage": damage and damage.found,
        "record": {} if record is None else json.loads(to_json(record)),
    }
    if as_json:
        print(json_text(document, indent=2))
    else:
        of_record = document.pop("record")
        for name, value in {**document, **of_record}.items():
            print(shown(f"{name:18} {value if isinstance(value, str) else json.dumps(value)}"))
    return DAMAGED if damage else DONE


def _verify(archive: Archive, every: tuple[Item, ...], *, as_json: bool) -> int:
    wrong = []
    # One at a time with progress: reading every matrix of a full archive takes minutes.
    for k, damage in enumerate(verify(archive, every), start=1):
        show_progress(f"{k} of {len(every)}")
        if damage is not None:
            wrong.append(damage)
    fault = archive.index.fault()
    if as_json:
        document = {
            "n_products": len(every),
            "index": fault,
            "damaged": [asdict(one) for one in wrong],
        }
        print(json_text(document, indent=2))
    else:
        for one in wrong:
            print(shown(f"DAMAGED {one.kind} {one.id}: {one.path}: {one.found}"))
            print(f"    {one.means}; {one.do}")
        if fault:
            print(shown(f"DAMAGED index: {fault}"))
            print("    end the service, move index.sqlite aside: its next start makes another")
        index = "damaged" if fault else "sound"
        print(f"{len(every)} products, {len(wrong)} damaged; the index is {index}")
    return DAMAGED if wrong or fault else DONE


def _prune(settings: Settings, *, dry_run: bool, as_json: bool) -> int:
    """Remove what the retention settings allow.

    A running service does this itself and holds the lock.
    """
    retention = retention_policy(settings)
    # Opened to read first, which rejects a folder without an archive before anything is written.
    with open_archive(settings) as archive:
        # Opening to write takes the lock: a dry run must work while a service runs.
        if not dry_run:
            archive.close()
            archive.open()
        going = tuple(due(items(archive, _list_saved_matrices(archive)), retention, time.time_ns()))
        gone = []
        for item, why in going:
            # None if it was pinned after the list was made: it stays.
            entry = None if dry_run else remove(archive, item, why)
            if entry is not None:
                archive.record((), (replace(entry, who="pyrcal archive prune"),))
            if dry_run or entry is not None:
                gone.append((item, why))
    if as_json:
        print(json_text([{**asdict(item), "why": why} for item, why in gone], indent=2))
    else:
        for item, why in gone:
            print(shown(f"{_line(item)}  {'would go' if dry_run else 'removed'}: {why}"))
        say(f"{len(gone)} products, {sum(item.n_bytes for item, _ in gone) / 1e6:.1f} MB")
    return DONE


def _aot(options: argparse.Namespace, settings: Settings) -> int:
    """Write the measurements of a night, or those around a recording, as AOT FITS."""
    # Imported here, because the other commands of the archive must not wait for it.
    from pyrcal.importers.aot import excerpt, write_aot
    from pyrcal.importers.registration import Dated
    from service.instrument import load_instrument

    if (options.night is None) is (options.recording is None):
        raise ConfigurationError("expected --night DATE for α alone, or --recording FILE")
    instrument = load_instrument(options.instrument or settings.service.instrument)
    taken, span = None, (0, FOREVER_NS)
    if options.recording is not None:
        taken = excerpt(options.recording, options.skip, options.seconds)
        span = (taken.first_ns_utc - ALPHA_MARGIN_NS, taken.last_ns_utc + ALPHA_MARGIN_NS)
    with open_archive(settings) as archive:
        if options.night is not None:
            nights = archive.nights.between(*span)
            night = next((night for night in nights if night.date == options.night), None)
            if night is None:
                raise UnknownIdError(f"{options.night}: nothing was measured in this night")
            span = (night.since_ns_utc, night.until_ns_utc)
        entries = archive.nights.estimates(*span, MAX_DOWNSAMPLED)
    estimates = [Dated(t_ns_utc=e.t_ns_utc, alpha=e.filtered) for e in entries if e.entered]
    write_aot(options.output, instrument, estimates, taken)
    n_frames, n_damaged = (0, 0) if taken is None else (taken.n_frames, taken.n_damaged)
    damaged = f"; {n_damaged} damaged messages left out" if n_damaged else ""
    say(f"{options.output}: {len(estimates)} estimates of α, {n_frames} frames{damaged}")
    return DONE


def _list_saved_matrices(archive: Archive) -> tuple[str, ...]:
    """Return the ids of the matrices that the saved state names, in use and of an acquisition."""
    saved = archive.tracking.read()
    if saved is None:
        return ()
    # The saved state refers to it, so it must be kept.
    acquiring = None if saved.acquisition is None else saved.acquisition.matrix
    return tuple(one for one in (saved.in_use, acquiring) if one is not None)


_IN_USE = "the RTC has it, and goes on; it could not be sent again to one that restarts"


@dataclass(frozen=True, slots=True, kw_only=True)
class Damage:
    """A product that differs from what was stored."""

    id: str
    kind: str
    path: str
    found: str
    means: str
    do: str


def verify(archive: Archive, which: Collection[Item]) -> Iterator[Damage | None]:
    """Read every product and yield its damage, or None if it is intact."""
    of_kind = {store.noun: store for store in archive.stores}
    for item in which:
        store = of_kind[item.kind]
        try:
            store.matrix(item.id)
        except ArchiveError as error:
            path = str(store.path_of(item.id))
            yield Damage(
                id=item.id,
                kind=item.kind,
                path=path,
                found=str(error).removeprefix(f"{path}: "),
                means=_IN_USE if item.state == MatrixState.APPLIED else store.lost_with_it,
                do="put it back from a backup; else move it aside, and have another made or "
                "measured",
            )
        else:
            yield None
