"""Where each reconstructor is on its way, and who did what, when: SQLite."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from service.archive.records import (
    measurement_from_json,
    measurement_to_json,
    record_from_json,
    record_to_json,
)
from service.errors import ArchiveError, StorageError
from service.state import MeasurementRecord, ReconstructorRecord

_Record = TypeVar("_Record")

_SCHEMA_VERSION = 2

_MEASUREMENTS = """
CREATE TABLE measurement (
    id TEXT PRIMARY KEY,
    created_ns_utc INTEGER NOT NULL,
    record TEXT NOT NULL,
    product_sha256 TEXT NOT NULL
);
"""

_SCHEMA = f"""
BEGIN;
CREATE TABLE reconstructor (
    id TEXT PRIMARY KEY,
    created_ns_utc INTEGER NOT NULL,
    record TEXT NOT NULL,
    product_sha256 TEXT
);
CREATE TABLE audit (
    t_ns_utc INTEGER NOT NULL,
    who TEXT NOT NULL,
    name TEXT NOT NULL,
    text TEXT NOT NULL
);
CREATE TRIGGER audit_keeps_its_entries BEFORE DELETE ON audit
    BEGIN SELECT RAISE(ABORT, 'the audit trail only grows'); END;
CREATE TRIGGER audit_keeps_its_words BEFORE UPDATE ON audit
    BEGIN SELECT RAISE(ABORT, 'the audit trail only grows'); END;
{_MEASUREMENTS}
PRAGMA user_version = {_SCHEMA_VERSION};
COMMIT;
"""

_FROM_VERSION_1 = f"""
BEGIN;
{_MEASUREMENTS}
PRAGMA user_version = {_SCHEMA_VERSION};
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
                if version == 0:
                    connection.executescript(_SCHEMA)
                elif version == 1:
                    connection.executescript(_FROM_VERSION_1)
                elif version != _SCHEMA_VERSION:
                    raise ArchiveError(
                        f"{self._path}: found version {version}, expected {_SCHEMA_VERSION}"
                    )
                return bool(version == 0)
        except sqlite3.OperationalError as error:
            raise ArchiveError(f"{self._path}: cannot be opened: {error}") from error

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    def add(self, record: ReconstructorRecord, sha256: str) -> None:
        """Enter a reconstructor whose product is on the disk.

        Raises
        ------
        ArchiveError
            If one of this id is already there.
        """
        with self._use() as connection:
            done = connection.execute(
                "INSERT INTO reconstructor VALUES (?, ?, ?, ?) ON CONFLICT (id) DO UPDATE SET"
                " record = excluded.record, product_sha256 = excluded.product_sha256"
                " WHERE product_sha256 IS NULL",
                (record.id, record.created_ns_utc, record_to_json(record), sha256),
            )
        if done.rowcount == 0:
            raise ArchiveError(f"reconstructor {record.id}: already stored, ids are never reused")

    def record(self, records: Sequence[ReconstructorRecord], entries: Sequence[AuditEntry]) -> None:
        """Replace what is known of reconstructors and add to the audit trail: all or nothing.

        A reconstructor that has no product here is entered.
        """
        with self._use() as connection:
            connection.execute("BEGIN IMMEDIATE")
            connection.executemany(
                "INSERT INTO reconstructor VALUES (?, ?, ?, NULL)"
                " ON CONFLICT (id) DO UPDATE SET record = excluded.record",
                [(r.id, r.created_ns_utc, record_to_json(r)) for r in records],
            )
            connection.executemany(
                "INSERT INTO audit VALUES (?, ?, ?, ?)",
                [(e.t_ns_utc, e.who, e.name, _storable(e.text)) for e in entries],
            )
            connection.execute("COMMIT")

    def product_sha256(self, matrix_id: str) -> str | None:
        """Return the checksum of a stored reconstructor, None where none is stored."""
        with self._use() as connection:
            row = connection.execute(
                "SELECT product_sha256 FROM reconstructor WHERE id = ?", (matrix_id,)
            ).fetchone()
        return None if row is None else row[0]

    def stored_ids(self) -> frozenset[str]:
        """Return the ids that have a product."""
        with self._use() as connection:
            rows = connection.execute(
                "SELECT id FROM reconstructor WHERE product_sha256 IS NOT NULL"
            ).fetchall()
        return frozenset(row[0] for row in rows)

    def records(self) -> tuple[list[ReconstructorRecord], dict[str, str]]:
        """Return every reconstructor, oldest first, and by id what is wrong with the others.

        A record that another version has written may not be understood.
        """
        return self._understood("reconstructor", record_from_json)

    def add_measurement(self, record: MeasurementRecord, sha256: str) -> None:
        """Enter a measured interaction matrix whose product is on the disk.

        Raises
        ------
        ArchiveError
            If one of this id is already there.
        """
        with self._use() as connection:
            done = connection.execute(
                "INSERT INTO measurement VALUES (?, ?, ?, ?) ON CONFLICT (id) DO NOTHING",
                (record.id, record.created_ns_utc or 0, measurement_to_json(record), sha256),
            )
        if done.rowcount == 0:
            raise ArchiveError(f"measurement {record.id}: already stored, ids are never reused")

    def measurement_sha256(self, measurement_id: str) -> str | None:
        """Return the checksum of a measured matrix, None where there is none."""
        with self._use() as connection:
            row = connection.execute(
                "SELECT product_sha256 FROM measurement WHERE id = ?", (measurement_id,)
            ).fetchone()
        return None if row is None else row[0]

    def measurements(self) -> tuple[list[MeasurementRecord], dict[str, str]]:
        """Return every measured interaction matrix, as :meth:`records`."""
        return self._understood("measurement", measurement_from_json)

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

    def _understood(
        self, table: Literal["reconstructor", "measurement"], read: Callable[[str], _Record]
    ) -> tuple[list[_Record], dict[str, str]]:
        with self._use() as connection:
            rows = connection.execute(
                f"SELECT id, record FROM {table} ORDER BY created_ns_utc, rowid"
            ).fetchall()
        understood, wrong = [], {}
        for name, text in rows:
            try:
                understood.append(read(text))
            except (ValueError, KeyError, TypeError) as error:
                wrong[name] = f"{self._path}: record of {table} {name} not understood: {error!r}"
        return understood, wrong

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


def _storable(text: str) -> str:
    """Return a text that UTF-8 can hold: half a surrogate pair would be refused for ever."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
