"""Operators' notes about a moment of the night."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from service.archive.nights import Values

SCHEMA = """
CREATE TABLE IF NOT EXISTS annotation (
    t_ns_utc INTEGER NOT NULL, written_ns_utc INTEGER NOT NULL,
    who TEXT NOT NULL, note TEXT NOT NULL
);
CREATE INDEX IF NOT EXISTS annotation_by_time ON annotation (t_ns_utc);
"""

_COLUMNS = "t_ns_utc, written_ns_utc, who, note"

INSERT = f"INSERT INTO annotation ({_COLUMNS}) VALUES (?, ?, ?, ?)"


@dataclass(frozen=True, slots=True, kw_only=True)
class Annotation:
    """An operator's note."""

    t_ns_utc: int
    """Of what time it is."""

    written_ns_utc: int
    """When it was written."""

    who: str
    note: str
    id: int = 0
    """From 1 on, growing; 0: not kept yet."""


class Annotations:
    """Keeps and reads them; what has been noted is never changed.

    Parameters
    ----------
    asked
        Returns the rows that a question to the index finds.
    add
        Carries out an insertion; returns the id of the row.
    """

    def __init__(
        self,
        asked: Callable[[str, Values], list[Any]],
        add: Callable[[str, tuple[str | int, ...]], int],
    ) -> None:
        self._asked = asked
        self._add = add

    def add(self, made: Annotation) -> int:
        """Keep one, on the disk when it returns; return its id.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        return self._add(INSERT, (made.t_ns_utc, made.written_ns_utc, made.who, made.note))

    def between(self, first_ns: int, last_ns: int, n_most: int) -> tuple[Annotation, ...]:
        """Return the newest ones about a time, which has both ends; oldest first.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        rows = self._asked(
            f"SELECT {_COLUMNS}, rowid FROM annotation WHERE t_ns_utc BETWEEN ? AND ?"
            " ORDER BY t_ns_utc DESC, rowid DESC LIMIT ?",
            (first_ns, last_ns, n_most),
        )
        return tuple(
            Annotation(t_ns_utc=t_ns, written_ns_utc=written_ns, who=who, note=note, id=number)
            for t_ns, written_ns, who, note, number in reversed(rows)
        )
