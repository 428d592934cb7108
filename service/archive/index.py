"""The SQLite index of products, and the audit trail."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import astuple, dataclass, fields
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from service.archive import nights
from service.archive.nights import TrendSample, Values
from service.archive.serialisation import NOT_UNDERSTOOD, from_json, to_json
from service.errors import ArchiveError, StorageError, shown
from service.records.operations import MeasurementRecord
from service.records.products import ReconstructorRecord, ReferencesRecord
from service.records.registration import HistoryEntry

Sent = ReconstructorRecord | ReferencesRecord
"""Records of products whose state changes on the way to the RTC and after."""

Product = Sent | MeasurementRecord
Indexed = TypeVar("Indexed", bound=Product)

_VERSION = 5

_SENT = {"reconstructor": ReconstructorRecord, "reference_slopes": ReferencesRecord}
"""Kinds of records whose state changes, by their tables."""

_PRODUCTS = """
CREATE TABLE IF NOT EXISTS {} (
    id TEXT PRIMARY KEY,
    created_ns_utc INTEGER NOT NULL,
    record TEXT NOT NULL,
    product_sha256 TEXT
);
"""
"""A table for each kind."""

_TABLES = ("reconstructor", "measurement", "noisy_matrix", "reference_slopes")

_SCHEMA = f"""
{"".join(map(_PRODUCTS.format, _TABLES))}
CREATE TABLE IF NOT EXISTS pin (
    id TEXT PRIMARY KEY, who TEXT NOT NULL, why TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS audit (
    t_ns_utc INTEGER NOT NULL,
    who TEXT NOT NULL,
    name TEXT NOT NULL,
    text TEXT NOT NULL,
    address TEXT NOT NULL,
    whence TEXT NOT NULL,
    why TEXT NOT NULL,
    answer TEXT NOT NULL,
    cause TEXT NOT NULL
);
CREATE INDEX IF NOT EXISTS audit_by_time ON audit (t_ns_utc);
{nights.SCHEMA}
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
    """Time, nanoseconds since the Unix epoch."""

    who: str
    """Name of the person who gave the order, else the address; "service" for its own actions."""

    name: str
    """Machine-readable, like ``reconstructor.applied``; an order has two lines: ``Approve`` when
    it came, ``Approve.answered`` or ``Approve.refused`` when that was known."""

    text: str
    """Event or order."""

    address: str = ""
    """Address of the client that gave the order."""

    channel: str = ""
    """"page", "rest" or "cli"; empty: no order."""

    why: str = ""
    """The reason given with the order."""

    answer: str = ""
    """Response to the order."""

    cause: str = ""
    """Id of the order or event that has led to it, the order's own for its two lines; empty: it was
    none of the tracker's."""

    id: int = 0
    """Place in the trail, from 1 on, growing; 0: not written yet."""


class Channel(StrEnum):
    """Channel by which an order arrived."""

    PAGE = "page"
    """A browser."""

    REST = "rest"
    """A program of somebody's own."""

    CLI = "cli"
    """``pyrcal`` on a command line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Actor:
    """Sender of an order, apart from the name in it."""

    address: str = ""
    key: str = ""
    """Name of the API key it was given with; empty: none is needed."""

    channel: Channel = Channel.REST
    check: Callable[[], None] = lambda: None
    """Raises where what the order was decided on has changed."""

    def entry(self, name: str, text: str = "", *, by: str = "", why: str = "") -> AuditEntry:
        """Return a line of the audit trail on what they do; ``by``: what they call themselves."""
        return AuditEntry(
            t_ns_utc=time.time_ns(),
            who=self.key or by or self.address or "operator",
            name=name,
            text=text,
            address=self.address,
            channel=self.channel,
            why=why,
        )


def by_service(name: str, text: str) -> AuditEntry:
    """Return an entry of what the service itself does now."""
    return AuditEntry(t_ns_utc=time.time_ns(), who="service", name=name, text=text)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pin:
    """A product that is kept for ever."""

    id: str
    who: str
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Range:
    """A part of the audit trail."""

    since_ns: int = 0
    until_ns: int = (1 << 63) - 1
    """Both of them belong to it; nanoseconds since the Unix epoch."""

    after: int | None = None
    """The first entries after this id; None: the last ones."""

    limit: int = 100
    """Most entries."""


class Index:
    """The SQLite file; each call is one transaction, on the disk when it returns.

    One connection behind a lock: calls may come from any thread and queue up.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._connection: sqlite3.Connection | None = None
        self._is_copy = False

    def open(self) -> bool:
        """Open the file, or make it; return whether it had to be made.

        Raises
        ------
        StorageError
            If the disk refuses to be written.
        ArchiveError
            If it is damaged, of another version, or cannot be opened.
        """
        try:
            connection = sqlite3.connect(self._path, **_OPTIONS)
        except sqlite3.OperationalError as error:
            raise ArchiveError(f"{self._path}: cannot be opened: {error}") from error
        anew = self._bring_up(connection)
        self._is_copy = False
        return anew

    def open_copy(self) -> bool:
        """Open a copy in memory while the disk refuses; return whether there is no file to copy.

        It lacks what a service that was killed had written last.
        """
        memory = sqlite3.connect(self._name_of_copy, uri=True, **_OPTIONS)
        # If the file cannot be read, the copy stays empty and is rebuilt from the products.
        with contextlib.suppress(sqlite3.Error):
            # immutable: without it SQLite must create files next to the index to read it, which a
            # full disk refuses.
            name = f"{self._path.absolute().as_uri()}?mode=ro&immutable=1"
            with closing(sqlite3.connect(name, uri=True)) as file:
                file.backup(memory)
        self._is_copy = True
        return self._bring_up(memory)

    def forbid_writing(self) -> None:
        """Refuse to change the copy any more: what would be lost must wait."""
        with self._use() as connection:
            connection.execute("PRAGMA query_only = ON")

    @property
    def _name_of_copy(self) -> str:
        # Names in the shared cache hold for the whole process: the id of the object separates the
        # copies of two archives.
        return f"file:pyrcal-{os.getpid()}-{id(self)}?mode=memory&cache=shared"

    def _bring_up(self, connection: sqlite3.Connection) -> bool:
        """Use a connection once its tables are those of this version; return if there were none."""
        try:
            with self._explained():
                # Before any statement that changes the file: one of a later version must stay as it
                # is.
                version = self._version(connection)
                connection.execute("PRAGMA journal_mode = WAL")
                # With NORMAL a power cut loses the last transactions of a write-ahead log, which
                # were reported as stored.
                connection.execute("PRAGMA synchronous = FULL")
                # One transaction, or a kill in between would leave a file with some of the tables.
                connection.executescript(f"BEGIN;{_SCHEMA}")
        except ArchiveError:
            connection.close()
            raise
        # The former connection is closed only here: if the new one fails, it stays in use.
        self.close()
        with self._lock:
            self._connection = connection
        return bool(version == 0)

    def look(self) -> None:
        """Open the file to read it, while a service may be using it.

        Raises
        ------
        ArchiveError
            If it is not there, damaged, or of a later version.
        """
        name = f"{self._path.absolute().as_uri()}?mode=ro"
        with self._explained():
            self._connection = sqlite3.connect(name, uri=True, isolation_level=None)
            try:
                self._version(self._connection)
                self._add_missing_tables(self._connection)
            except BaseException:
                # SQLite removes its shared-memory file when the last connection is closed
                self._connection.close()
                self._connection = None
                raise

    def _add_missing_tables(self, connection: sqlite3.Connection) -> None:
        """Add tables that an earlier service of this version did not have, in memory only."""
        known = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
        for table in (name for name in _TABLES if name not in known):
            connection.execute(_PRODUCTS.format(table).replace("CREATE", "CREATE TEMP"))

    def _version(self, connection: sqlite3.Connection) -> int:
        version: int = connection.execute("PRAGMA user_version").fetchone()[0]
        if version > _VERSION:
            raise ArchiveError(
                f"{self._path}: found version {version}, which a later pyrcal has written, "
                f"expected {_VERSION}: run that pyrcal, nothing has been changed"
            )
        if 0 < version < _VERSION:
            raise ArchiveError(
                f"{self._path}: found version {version}, which a pyrcal before 1.0 has written, "
                f"expected {_VERSION}: move it away; the next start makes a new one from the "
                "products, the audit trail stays in the old one"
            )
        return version

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
                # A product that is stored is never replaced.
                " WHERE product_sha256 IS NULL",
                (record.id, begun_ns_utc(record), to_json(record), sha256),
            )
        return done.rowcount > 0

    def record(
        self,
        records: Sequence[Sent],
        entries: Sequence[AuditEntry],
        estimates: Sequence[HistoryEntry] = (),
        samples: Sequence[TrendSample] = (),
    ) -> None:
        """Replace what is known of matrices and references, add to trail and history, or nothing.

        One that has no product here is entered.
        """
        with self._use() as connection:
            # Takes the write lock at once: a deferred transaction may fail half-way with "database
            # is locked".
            connection.execute("BEGIN IMMEDIATE")
            for table, kind in _SENT.items():
                connection.executemany(
                    f"INSERT INTO {table} VALUES (?, ?, ?, NULL)"
                    " ON CONFLICT (id) DO UPDATE SET record = excluded.record",
                    [(r.id, r.created_ns_utc, to_json(r)) for r in records if isinstance(r, kind)],
                )
            connection.executemany(
                f"INSERT INTO audit ({_COLUMNS}) VALUES ({', '.join('?' * _N_COLUMNS)})",
                [tuple(map(_storable, astuple(entry)[:_N_COLUMNS])) for entry in entries],
            )
            connection.executemany(nights.INSERT_ESTIMATE, nights.rows_of_estimates(estimates))
            connection.executemany(nights.INSERT_SAMPLE, nights.rows_of_samples(samples))
            connection.executemany(nights.INSERT_GAINS, nights.rows_of_gains(samples))
            connection.execute("COMMIT")

    def add_row(self, insertion: str, values: tuple[str | int, ...]) -> int:
        """Carry out an insertion, and return the number of its row."""
        with self._use() as connection:
            done = connection.execute(insertion, tuple(map(_storable, values)))
        return done.lastrowid or 0

    def asked(self, question: str, values: Values) -> list[Any]:
        """Return rows over a connection that only reads; no writer waits."""
        name = f"{self._path.absolute().as_uri()}?mode=ro"
        # A second connection reaches a database in memory only by its name in the shared cache.
        name = self._name_of_copy if self._is_copy else name
        # With a write-ahead log a reader does not block the writer, so no lock is taken.
        with self._explained(), closing(sqlite3.connect(name, uri=True)) as connection:
            return connection.execute(question, values).fetchall()

    def forget_numbers(self, table: str, product_id: str) -> None:
        """Keep what is known of a product, and no longer that its numbers are there."""
        with self._use() as connection:
            connection.execute(
                f"UPDATE {table} SET product_sha256 = NULL WHERE id = ?", (product_id,)
            )

    def pin(self, pin: Pin) -> None:
        """Keep a product for ever; who has pinned it last counts."""
        values = tuple(map(_storable, astuple(pin)))
        with self._use() as connection:
            connection.execute("INSERT OR REPLACE INTO pin VALUES (?, ?, ?)", values)

    def unpin(self, product_id: str) -> bool:
        """Let a product go when it is old; return whether it was pinned."""
        with self._use() as connection:
            return connection.execute("DELETE FROM pin WHERE id = ?", (product_id,)).rowcount > 0

    def fault(self) -> str:
        """Return what SQLite finds wrong with the file; empty: nothing."""
        with self._use() as connection:
            (found,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
        return "" if found == "ok" else str(found)

    def pins(self) -> tuple[Pin, ...]:
        """Return all of them."""
        with self._use() as connection:
            rows = connection.execute("SELECT id, who, why FROM pin").fetchall()
        return tuple(Pin(id=one, who=who, why=why) for one, who, why in rows)

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

    def audit_trail(self, part: Range) -> tuple[AuditEntry, ...]:
        """Return the entries of a part, oldest first."""
        order = "DESC" if part.after is None else "ASC"
        with self._use() as connection:
            rows = connection.execute(
                f"SELECT {_COLUMNS}, rowid FROM audit"
                " WHERE t_ns_utc BETWEEN ? AND ? AND rowid > ?"
                f" ORDER BY rowid {order} LIMIT ?",
                (part.since_ns, part.until_ns, part.after or 0, part.limit),
            ).fetchall()
        names = [field.name for field in fields(AuditEntry)]
        found = [AuditEntry(**dict(zip(names, row, strict=True))) for row in rows]
        return tuple(sorted(found, key=lambda entry: entry.id))

    @contextmanager
    def _use(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            if self._connection is None:
                raise ArchiveError(f"{self._path}: not open")
            try:
                with self._explained():
                    yield self._connection
            finally:
                # An exception must not leave the transaction open for the next caller.
                if self._connection.in_transaction:
                    self._connection.rollback()

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            text = f"{self._path}: cannot be used: {error} ({error.sqlite_errorname})"
            raise StorageError(text) from error
        except sqlite3.DatabaseError as error:
            raise ArchiveError(
                f"{self._path}: damaged ({error}): move it away; the next start makes a new "
                "one from the products, audit trail and history stay in the old one"
            ) from error


def begun_ns_utc(record: Product) -> int:
    """Return the time when a product was made or, if unknown, requested."""
    asked_ns = record.asked_ns_utc if isinstance(record, MeasurementRecord) else None
    return record.created_ns_utc or asked_ns or 0


_OPTIONS: dict[str, Any] = {"isolation_level": None, "check_same_thread": False}

_N_COLUMNS = len(fields(AuditEntry)) - 1
_COLUMNS = ", ".join(
    {"channel": "whence"}.get(field.name, field.name) for field in fields(AuditEntry)[:_N_COLUMNS]
)
"""Columns of the file, whose names are older than the fields'."""


def _storable(value: str | int) -> str | int:
    """Return a text that acts on no terminal, and that UTF-8 can hold.

    Half a surrogate pair would be refused for ever.
    """
    if isinstance(value, int):
        return value
    return shown(value)
