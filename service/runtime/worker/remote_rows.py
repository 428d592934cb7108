"""Rows of D(α) computed by a Dask worker with a model of its own; only kilobytes are sent to it.

Instrument and modes are sent once and kept. Of each matrix it receives α and the numbers of its
rows.
"""

from __future__ import annotations

import operator
import pickle
import threading
from dataclasses import dataclass
from typing import Any

from service.model.sensors.sensor import Array, RowsElsewhere, RowTask


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoteRows:
    """A function of rows, and of the parts that it is made of."""

    described: bytes
    """Pickled instrument and modes, which identify the model."""

    @classmethod
    def of(cls, rows: RowsElsewhere) -> RemoteRows:
        """Return what is sent of a function of rows: all but its parts."""
        return cls(described=pickle.dumps((rows.prepare, rows.make)))

    def __call__(self, row: int, *parts: object) -> Array:
        """Return a row, of what this process has made of the parts before, or makes of them now."""
        return _HERE.rows(self.described, parts)(row)


class _Kept:
    """The last model and the last function of rows of this process."""

    def __init__(self) -> None:
        self._making = threading.Lock()
        self._parts: tuple[object, ...] = ()
        self._model: Any = None
        self._described = b""
        self._rows: RowTask | None = None

    def rows(self, described: bytes, parts: tuple[object, ...]) -> RowTask:
        """Return a function of rows; one thread makes it, the others wait."""
        with self._making:
            known = len(parts) == len(self._parts) and all(map(operator.is_, parts, self._parts))
            if self._rows is None or not known or described != self._described:
                self._rows = None  # before the next one takes memory
                prepare, make = pickle.loads(described)  # of this very program
                if not known:
                    self._model = None
                    self._model, self._parts = prepare(*parts), parts
                self._rows, self._described = make(self._model), described
            return self._rows


_HERE = _Kept()
