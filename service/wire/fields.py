"""Strict reading of msgpack maps: each key is present, of its type and in its range."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgpack
import numpy as np

from service.errors import WireError
from service.wire.keys import checked_id

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

VERSION: Final = 1
"""The ``v`` of every message."""

MESSAGE_LIMIT: Final = 64 * 1024
"""Bytes: a longer status, manifest or command is refused unread."""

TEXT_LIMIT: Final = 1024
"""Characters of the longest text."""

INTEGER_LIMIT: Final = 2**63 - 1
"""Largest integer on the wire."""

SHA256_PATTERN = re.compile(r"[0-9a-f]{64}")

_E = TypeVar("_E", bound=StrEnum)
_T = TypeVar("_T")


def pack(record: DataclassInstance, omit: tuple[str, ...] = (), **replaced: object) -> bytes:
    """Return the msgpack map of a record whose fields are named like the keys, with its ``v``.

    Parameters
    ----------
    record
        The record.
    omit
        Fields that are no keys.
    **replaced
        Keys that are no fields, or whose field travels in another form.
    """
    values = {f.name: getattr(record, f.name) for f in fields(record) if f.name not in omit}
    data: bytes = msgpack.packb({"v": VERSION, **values, **replaced}, default=_plain)
    return data


def _plain(value: object) -> object:
    """Turn numpy scalars and arrays into what msgpack knows."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise WireError(f"range: {value!r:.80} of type {type(value).__name__} cannot travel")


class Fields:
    """A received map; every read names the key, what was found and what was expected."""

    __slots__ = ("_values", "_where")

    def __init__(self, values: object, where: str) -> None:
        if not isinstance(values, dict):
            raise WireError(f"range: {where} is {_show(values)}, expected a map")
        self._values: dict[str, Any] = values
        self._where = where

    @classmethod
    def unpack(cls, data: bytes, where: str, limit: int = MESSAGE_LIMIT) -> Fields:
        """Read a message.

        Parameters
        ----------
        data
            The bytes.
        where
            What the message is, for the text of a refusal.
        limit
            Most bytes it may have.

        Raises
        ------
        WireError
            If it is too long or no msgpack map.
        """
        if len(data) > limit:
            raise WireError(f"range: {where} has {len(data)} bytes, expected at most {limit}")
        try:
            values = msgpack.unpackb(data)
        except (ValueError, msgpack.exceptions.UnpackException) as error:
            raise WireError(f"range: {where} is not msgpack: {error!s:.100}") from error
        return cls(values, where)

    def of_this_version(self) -> Fields:
        """Return itself.

        Raises
        ------
        WireError
            If ``v`` is not the version this code speaks.
        """
        version = self.get("v")
        if version != VERSION or isinstance(version, bool):
            raise WireError(f"v: {_show(version)} in {self._where}, expected {VERSION}")
        return self

    def get(self, key: str) -> Any:  # noqa: ANN401  whatever msgpack made of it
        """Return the value of a key that must be present."""
        try:
            return self._values[key]
        except KeyError:
            raise WireError(f"missing: key {key!r} in {self._where}") from None

    def integer(self, key: str, low: int = 0, high: int = INTEGER_LIMIT) -> int:
        """Return an integer from ``low`` to ``high``."""
        return self._integer(key, self.get(key), low, high)

    def number(
        self,
        key: str,
        low: float = -math.inf,
        high: float = math.inf,
        *,
        above: float = -math.inf,
    ) -> float:
        """Return a finite number from ``low`` to ``high``, and greater than ``above``."""
        return self._number(key, self.get(key), low, high, above)

    def flag(self, key: str) -> bool:
        """Return true or false."""
        value = self.get(key)
        if not isinstance(value, bool):
            raise self.refusal(key, value, "true or false")
        return value

    def text(self, key: str, *, low: int = 0, limit: int = TEXT_LIMIT) -> str:
        """Return a printable text of ``low`` to ``limit`` characters."""
        value = self.get(key)
        if not isinstance(value, str) or not low <= len(value) <= limit or "\0" in value:
            raise self.refusal(key, value, f"a text of {low} to {limit} characters")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of texts."""
        found = self._list(key)
        for value in found:
            if not isinstance(value, str) or len(value) > TEXT_LIMIT:
                raise self.refusal(key, value, f"texts of at most {TEXT_LIMIT} characters")
        return tuple(found)

    def opaque(self, key: str) -> str:
        """Return a string that is only ever compared (session, basis, configuration)."""
        value = self.get(key)
        if not isinstance(value, str) or not 0 < len(value) <= 128 or not value.isprintable():
            raise self.refusal(key, value, "1 to 128 printable characters")
        return value

    def identifier(self, key: str) -> str:
        """Return an id."""
        return checked_id(self.get(key), f"key {key!r} in {self._where}")

    def sha256(self, key: str) -> str:
        """Return a checksum."""
        value = self.get(key)
        if not isinstance(value, str) or SHA256_PATTERN.fullmatch(value) is None:
            raise self.refusal(key, value, "64 lower-case hex digits")
        return value

    def choice(self, key: str, kind: type[_E]) -> _E:
        """Return one of the alternatives of ``kind``."""
        value = self.get(key)
        try:
            return kind(value)
        except ValueError:
            expected = ", ".join(kind)
            raise self.refusal(key, value, f"one of {expected}") from None

    def optional(self, key: str, read: Callable[[str], _T]) -> _T | None:
        """Return what ``read`` makes of the key, or None where it is nil."""
        return None if self.get(key) is None else read(key)

    def extension(self, key: str, read: Callable[[str], _T]) -> _T | None:
        """Return what ``read`` makes of the key, or None where it is nil or not there at all.

        For keys that came after the contract: who does not know them need not send them.
        """
        return None if self._values.get(key) is None else read(key)

    def integers(self, key: str, low: int = 0, high: int = INTEGER_LIMIT) -> tuple[int, ...]:
        """Return a list of integers."""
        return tuple(self._integer(key, v, low, high) for v in self._list(key))

    def numbers(
        self, key: str, low: float = -math.inf, *, above: float = -math.inf
    ) -> tuple[float, ...]:
        """Return a list of finite numbers from ``low`` on, and greater than ``above``."""
        return tuple(self._number(key, v, low, math.inf, above) for v in self._list(key))

    def pairs(self, key: str) -> tuple[tuple[int, int], ...]:
        """Return a list of pairs of integers from 0 on."""
        found = []
        for value in self._list(key):
            if not isinstance(value, list) or len(value) != 2:
                raise self.refusal(key, value, "pairs of integers")
            first, last = (self._integer(key, v, 0, INTEGER_LIMIT) for v in value)
            found.append((first, last))
        return tuple(found)

    def child(self, key: str) -> Fields:
        """Return the map below a key."""
        return Fields(self.get(key), f"{key!r} of {self._where}")

    def named_numbers(self, key: str, names: Sequence[str]) -> dict[str, float]:
        """Return a map of exactly these finite numbers."""
        below = self.child(key)
        return {name: below.number(name) for name in names}

    def refusal(self, key: str, value: object, expected: str) -> WireError:
        """Return the error that says what the key held and what it should hold."""
        return WireError(f"range: {key} is {_show(value)} in {self._where}, expected {expected}")

    def _list(self, key: str) -> list[Any]:
        value = self.get(key)
        if not isinstance(value, list):
            raise self.refusal(key, value, "a list")
        return value

    def _integer(self, key: str, value: object, low: int, high: int) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise self.refusal(key, value, f"an integer from {low} to {high}")
        return value

    def _number(self, key: str, value: object, low: float, high: float, above: float) -> float:
        good = isinstance(value, int | float) and not isinstance(value, bool)
        number = float(value) if good else math.nan  # type: ignore[arg-type]
        if not math.isfinite(number) or not low <= number <= high or not number > above:
            raise self.refusal(key, value, _span(low, high, above))
        return number


def _span(low: float, high: float, above: float) -> str:
    if above > -math.inf:
        return f"a finite number > {above:g} and <= {high:g}"
    return f"a finite number from {low:g} to {high:g}"


def _show(value: object) -> str:
    if isinstance(value, bytes | list | dict):
        return f"a {type(value).__name__} of {len(value)}"
    return f"{value!r:.60} ({type(value).__name__})"
