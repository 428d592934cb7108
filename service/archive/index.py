"""Where each product is on its way, and who did what, when: SQLite."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from service.archive.records import NOT_UNDERSTOOD, from_json, to_json
from service.errors import ArchiveError, StorageError
from service.tracking.products import MeasurementRecord, ReconstructorRecord

Product = ReconstructorRecord | MeasurementRecord
Indexed = TypeVar("Indexed", bound=Product)

_VERSION = 2

_PRODUCTS = """
CREATE TABLE IF NOT EXISTS {} (
    id TEXT PRIMARY KEY,
    created_ns_utc INTEGER NOT NULL,
    record TEXT NOT NULL,
    product_sha256 TEXT
);
"""
"""A table for each kind."""

_SCHEMA = f"""
BEGIN;
{"".join(map(_PRODUCTS.format, ("reconstructor", "measurement", "noisy_matrix")))}
CREATE TABLE IF NOT EXISTS audit (
    t_ns_utc INTEGER NOT NULL,
    who TEXT NOT NULL,
    name TEXT NOT NULL,
    text TEXT NOT NULL
);
CREATE TRIGGER IF NOT EXISTS audit_keeps_its_entries BEFORE DELETE ON audit
    BEGIN SELECT RAISE(ABORT, 'the audit trail only grows'); END;
CREATE TRIGGER IF NOT EXISTS audit_keeps_its_words BEFORE UPDATE ON audit
    BEGIN SELECT RAISE(ABORT, 'the audit trail only grows'); END;
PRAGMA user_version = {_VERSION};
COMMIT;
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditEntry:
    """One line of the audit trail."""

    t_ns_utc: int
    """When, nanoseconds since the Unix epoch."""

    who: str
    """An operator, the service or the RTC."""

    name: str
    """Machine-readable, like ``reconstructor.applied``."""

    text: str
    """What happened."""


class Index:
    """The SQLite file; each call is one transaction, on the disk when it returns.

    One connection behind a lock: calls may come from any thread and queue up.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._connection: sqlite3.Connection | None = None

    def open(self) -> bool:
        """Open the file, or make it; return whether it had to be made.

        Raises
        ------
        ArchiveError
            If it is damaged, of another version, or cannot be written.
        """
        try:
            self._connection = sqlite3.connect(
                self._path, isolation_level=None, check_same_thread=False
            )
            with self._use() as connection:
                connection.execute("PRAGMA journal_mode = WAL")
                connection.execute("PRAGMA synchronous = FULL")
                version = connection.execute("PRAGMA user_version").fetchone()[0]
                if version > _VERSION:
                    raise ArchiveError(
                        f"{self._path}: found version {version}, expected {_VERSION}"
                    )
                connection.executescript(_SCHEMA)
                return bool(version == 0)
        except sqlite3.OperationalError as error:
            raise ArchiveError(f"{self._path}: cannot be opened: {error}") from error

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    def add(self, table: str, record: Product, sha256: str) -> bool:
        """Enter what is known of a product that is on the disk.

        Return whether there was none of this id.
        """
        with self._use() as connection:
            done = connection.execute(
                f"INSERT INTO {table} VALUES (?, ?, ?, ?)"
                " ON CONFLICT (id) DO UPDATE SET"
                " record = excluded.record, product_sha256 = excluded.product_sha256"
                " WHERE product_sha256 IS NULL",
                (record.id, begun_ns_utc(record), to_json(record), sha256),
            )
        return done.rowcount > 0

    def record(self, records: Sequence[ReconstructorRecord], entries: Sequence[AuditEntry]) -> None:
        """Replace what is known of reconstructors and add to the audit trail: all or nothing.

        A reconstructor that has no product here is entered.
        """
        with self._use() as connection:
            connection.execute("BEGIN IMMEDIATE")
            connection.executemany(
                "INSERT INTO reconstructor VALUES (?, ?, ?, NULL)"
                " ON CONFLICT (id) DO UPDATE SET record = excluded.record",
                [(r.id, r.created_ns_utc, to_json(r)) for r in records],
            )
            connection.executemany(
                "INSERT INTO audit VALUES (?, ?, ?, ?)",
                [(e.t_ns_utc, e.who, e.name, _storable(e.text)) for e in entries],
            )
            connection.execute("COMMIT")

    def checksums(self, table: str) -> dict[str, str]:
        """Return the checksum of every product of a kind that is stored, by id."""
        with self._use() as connection:
            rows = connection.execute(
                f"SELECT id, product_sha256 FROM {table} WHERE product_sha256 IS NOT NULL"
            ).fetchall()
        return dict(rows)

    def records(self, table: str, kind: type[Indexed]) -> tuple[list[Indexed], dict[str, str]]:
        """Return every record of a kind, and by id what is wrong with the others.

        A record that another version has written may not be understood.
        """
        with self._use() as connection:
            rows = connection.execute(f"SELECT id, record FROM {table} ORDER BY rowid").fetchall()
        understood, wrong = [], {}
        for name, text in rows:
            try:
                understood.append(from_json(text, kind))
            except NOT_UNDERSTOOD as error:
                wrong[name] = f"{self._path}: record of {table} {name} not understood: {error!r}"
        return understood, wrong

    def audit_trail(self, limit: int) -> tuple[AuditEntry, ...]:
        """Return the last ``limit`` entries, oldest first."""
        with self._use() as connection:
            rows = connection.execute(
                "SELECT t_ns_utc, who, name, text FROM audit ORDER BY rowid DESC LIMIT ?", (limit,)
            ).fetchall()
        return tuple(
            AuditEntry(t_ns_utc=t, who=who, name=name, text=text)
            for t, who, name, text in reversed(rows)
        )

    @contextmanager
    def _use(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            if self._connection is None:
                raise ArchiveError(f"{self._path}: not open")
            try:
                yield self._connection
            except sqlite3.OperationalError as error:
                text = f"{self._path}: cannot be used: {error} ({error.sqlite_errorname})"
                raise StorageError(text) from error
            except sqlite3.DatabaseError as error:
                raise ArchiveError(
                    f"{self._path}: damaged ({error}): move it away; the next start makes a new "
                    "one from the products, the audit trail stays in the old one"
                ) from error
            finally:
                if self._connection.in_transaction:
                    self._connection.rollback()


def begun_ns_utc(record: Product) -> int:
    """Return when a product was made or, where that is not known, asked for."""
    asked_ns = record.asked_ns_utc if isinstance(record, MeasurementRecord) else None
    return record.created_ns_utc or asked_ns or 0


def _storable(text: str) -> str:
    """Return a text that UTF-8 can hold: half a surrogate pair would be refused for ever."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
