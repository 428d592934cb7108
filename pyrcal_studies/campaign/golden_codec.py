"""Frozen records as JSON and back, guided by the type hints of their fields.

A record is ``{"is": class name, field: value}`` with the fields that are not at their defaults. Of
a class only its name is written, so that it may move to another module. Where a record itself
changes, nights are retold before: ``python -m pyrcal_studies.campaign.golden_nights --retell``.
"""

from __future__ import annotations

import base64
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

Json = Any
"""None, bool, int, float, str, and lists and dictionaries of them."""

Value = Any
"""Of whatever type is asked for."""

_PLAIN = frozenset({NoneType, bool, int, float, str})
"""What JSON has as it is."""

LEFT_OUT = frozenset({("Status", "flux")})
"""Fields that the tracker carries and does not read, besides those that make no record another:
class and field."""


def encoded(value: object) -> Json:
    """Return a value as JSON, every digit of its numbers kept.

    Raises
    ------
    TypeError
        If there is no way to write it.
    """
    if type(value) in _PLAIN:
        return value
    match value:
        case Enum():
            return value.value
        case np.generic():
            return encoded(value.item())
        case bytes():
            return {"bytes": base64.b64encode(value).decode()}
        case np.ndarray():
            return _array_encoded(value)
        case tuple() | list():
            return [item if type(item) in _PLAIN else encoded(item) for item in value]
        case _ if is_dataclass(value):
            return {"is": type(value).__name__} | {
                field.name: encoded(getattr(value, field.name))
                for field in fields(value)
                if not _left_out(value, field)
            }
        case _:
            raise TypeError(f"found {type(value).__name__}; expected a record, a number or a text")


def decoded(hint: object, value: Json) -> Value:
    """Return the value of this type that was encoded.

    Raises
    ------
    TypeError
        If the type does not have such values.
    """
    if value is None or type(value) is hint:
        return value
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return _of_union(hint, value)
    if isinstance(value, dict):
        return _of_mapping(hint, value)
    if origin is tuple:
        args = get_args(hint)
        hints = args[:1] * len(value) if args[1:] == (...,) else args
        return tuple(
            item if type(item) is each else decoded(each, item)
            for each, item in zip(hints, value, strict=True)
        )
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(value)
    if hint is float:
        return float(value)
    if origin is Literal or (hint in (bool, int, str) and isinstance(value, hint)):
        return value
    raise TypeError(f"found {value!r}; expected {hint}")


def _left_out(record: object, field: Field[Any]) -> bool:
    if not field.compare or (type(record).__name__, field.name) in LEFT_OUT:
        return True
    value = getattr(record, field.name)
    if isinstance(value, np.ndarray) or field.default is MISSING:
        return False
    return type(value) is type(field.default) and bool(value == field.default)


def _array_encoded(value: np.ndarray[Any, Any]) -> Json:
    flat = np.ascontiguousarray(value).ravel()
    if flat.dtype.kind == "c":
        flat = flat.view(flat.real.dtype)
    return {"array": flat.tolist(), "type": value.dtype.str, "shape": list(value.shape)}


def _array_decoded(value: dict[str, Json]) -> np.ndarray[Any, Any]:
    dtype = np.dtype(value["type"])
    flat = np.array(value["array"], dtype=np.empty(0, dtype).real.dtype)
    return flat.view(dtype).reshape(value["shape"])


def _of_mapping(hint: object, value: dict[str, Json]) -> Value:
    if "is" in value:
        return _record(hint, value)
    if "array" in value:
        return _array_decoded(value)
    if "bytes" in value:
        return base64.b64decode(value["bytes"])
    raise TypeError(f"found {sorted(value)}; expected {hint}")


def _record(hint: object, value: dict[str, Json]) -> Value:
    if not isinstance(hint, type) or hint.__name__ != value["is"]:
        raise TypeError(f"found a {value['is']}; expected {hint}")
    hints = _hints(hint)
    given = {name: item for name, item in value.items() if name != "is"}
    return hint(**{name: decoded(hints[name], item) for name, item in given.items()})


def _of_union(hint: object, value: Json) -> Value:
    """Return the value of the first type of a union that has such values."""
    for one in _members(hint):
        if (
            isinstance(value, dict)
            and "is" in value
            and getattr(one, "__name__", "") != value["is"]
        ):
            continue
        try:
            return decoded(one, value)
        except (TypeError, ValueError):
            if isinstance(value, dict) and "is" in value:
                raise
    raise TypeError(f"found {value!r}; expected {hint}")


@cache
def _hints(record: type) -> dict[str, Any]:
    return get_type_hints(record)


@cache
def _members(hint: object) -> tuple[Value, ...]:
    """Return the types of a union, the texts and numbers that anything could be last."""
    plain = (bool, int, float, str)
    args = [one for one in get_args(hint) if one is not NoneType]
    return tuple(sorted(args, key=lambda one: plain.index(one) + 1 if one in plain else 0))
