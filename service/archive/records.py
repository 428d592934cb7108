"""Records of products <-> JSON: angles in degrees, names and units as at every boundary."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.misregistration import BOUNDARY_SCALE, Misregistration

NOT_UNDERSTOOD = (ValueError, KeyError, TypeError, ModelError)
"""What reading a record of another version, or a damaged one, raises."""

COVARIANCE_SCALE = np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)
"""Multiply a covariance in numeric units by this to get boundary units."""

_OF_THIS_RUN = "judged"
"""What a restarted service must find out anew."""

_NUMERIC = tuple(field.name for field in fields(Misregistration))
_RADIANS, _DEGREES, _DEGREES_PER_RADIAN = "rotation_rad", "rotation_deg", float(BOUNDARY_SCALE[2])

_Record = TypeVar("_Record")


def to_json(record: object) -> str:
    """Return a record as JSON; a pole radius may be ``Infinity``, as Python writes it."""
    values = _in_degrees(msgspec.to_builtins(record, enc_hook=_plain))
    values.pop(_OF_THIS_RUN, None)
    return json.dumps(values)


def from_json(text: str, kind: type[_Record]) -> _Record:
    """Return the record of this kind that :func:`to_json` wrote.

    Raises
    ------
    ValueError, KeyError, TypeError, ModelError
        If the text is something else.
    """
    values = json.loads(text, object_hook=_in_radians)
    record = msgspec.convert(values, kind, dec_hook=_array)
    refuse_unknown(values, record)
    return record


def refuse_unknown(values: object, record: object) -> None:
    """Refuse what was read into a record if it holds keys that the record does not have.

    Raises
    ------
    ValueError
        If it does: another version has written it.
    """
    if isinstance(values, list) and isinstance(record, tuple):
        for entry, of_record in zip(values, record, strict=True):
            refuse_unknown(entry, of_record)
    elif isinstance(values, dict) and is_dataclass(record):
        known = {field.name for field in fields(record)}
        if not values.keys() <= known:
            raise ValueError(f"unknown keys {', '.join(sorted(values.keys() - known))}")
        for name, value in values.items():
            refuse_unknown(value, getattr(record, name))


def plain_numbers(value: object) -> object:
    """Turn numpy's scalars and arrays into Python's."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be stored")


def _plain(value: object) -> object:
    if not isinstance(value, np.ndarray):
        return plain_numbers(value)
    if value.ndim == 1:
        return dict(zip(_NUMERIC, value.tolist(), strict=True))
    return (value * COVARIANCE_SCALE).tolist()


def _array(_kind: type, value: Any) -> NDArray[np.float64]:  # noqa: ANN401  whatever JSON holds
    if isinstance(value, dict):
        return np.array([value[name] for name in _NUMERIC], dtype=np.float64)
    return np.asarray(np.array(value, dtype=np.float64) / COVARIANCE_SCALE)


def _in_degrees(value: Any) -> Any:  # noqa: ANN401  any value of a record
    if not isinstance(value, dict):
        return value
    found = {name: _in_degrees(below) for name, below in value.items()}
    if _RADIANS in found:
        found[_DEGREES] = found.pop(_RADIANS) * _DEGREES_PER_RADIAN
    return found


def _in_radians(values: dict[str, Any]) -> dict[str, Any]:
    if _DEGREES in values:
        values[_RADIANS] = values.pop(_DEGREES) / _DEGREES_PER_RADIAN
    return values
