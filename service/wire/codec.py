"""Conversion of records to msgpack maps and back, with checks of keys, types and ranges.

The annotated types of a record's fields define what its keys may hold. A :class:`Form` adds the
rules of one kind of message that types cannot express. Every error names the key, the value found
and the values expected. The module also defines the annotated types that several messages share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, asdict, dataclass, fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Final,
    Generic,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgpack
import msgspec
import numpy as np
from msgspec import Meta

from service.errors import WireError
from service.wire.keys import ID_EXPECTED, ID_PATTERN, RESERVED_IDS, validate_id

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

VERSION: Final = 1
"""The ``v`` of every message."""

MESSAGE_LIMIT: Final = 64 * 1024
"""Largest status, manifest or command, in bytes; a longer one is refused before it is parsed."""

TEXT_LIMIT: Final = 1024
"""Largest number of characters in a text."""

INTEGER_LIMIT: Final = 2**63 - 1
"""Largest integer on the wire, that of a signed 64-bit type."""

_MAX_FLOAT: Final = float(np.finfo(np.float64).max)

_T = TypeVar("_T")
_R = TypeVar("_R", bound="DataclassInstance")


def integer(low: int = 0, high: int = INTEGER_LIMIT) -> Meta:
    """Return the constraint of an ``int`` from ``low`` to ``high``, both included."""
    return Meta(ge=low, le=high, description=f"an integer from {low} to {high}")


def number(low: float, high: float = _MAX_FLOAT) -> Meta:
    """Return the constraint of a finite ``float`` from ``low`` to ``high``, both included."""
    span = f" from {low:g}" + ("" if high == _MAX_FLOAT else f" to {high:g}")
    return Meta(ge=low, le=high, description=f"a finite number{span}")


def above(low: float, high: float = _MAX_FLOAT) -> Meta:
    """Return the constraint of a finite ``float`` above ``low`` and up to ``high``."""
    span = f" > {low:g}" + ("" if high == _MAX_FLOAT else f" and <= {high:g}")
    return Meta(gt=low, le=high, description=f"a finite number{span}")


Count = Annotated[int, integer()]
Finite = Annotated[float, Meta(ge=-_MAX_FLOAT, le=_MAX_FLOAT, description="a finite number")]
Positive = Annotated[float, above(0.0)]
Text = Annotated[
    str,
    Meta(
        pattern=rf"\A[^\0]{{0,{TEXT_LIMIT}}}\Z",
        description=f"a text of 0 to {TEXT_LIMIT} characters",
    ),
]
Opaque = Annotated[
    str, Meta(min_length=1, max_length=128, description="1 to 128 printable characters")
]
"""Name whose meaning is known to its sender only."""

_RESERVED = "|".join(sorted(RESERVED_IDS))
Id = Annotated[
    str,
    Meta(pattern=rf"\A(?!({_RESERVED})\Z){ID_PATTERN.pattern}\Z", description=ID_EXPECTED),
]
SHA256_EXPECTED: Final = "64 lower-case hex digits"
Sha256 = Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z", description=SHA256_EXPECTED)]


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationNumbers:
    """The four parameters of a registration, or their 1 σ."""

    shift_x_subap: Finite
    """Shift along +x of the sensor."""

    shift_y_subap: Finite
    """Shift along +y of the sensor."""

    rotation_deg: Finite
    """Rotation from +x towards +y."""

    magnification: Finite
    """Magnification; 1 is that of the instrument file."""


Map = dict[str, Any]
"""A message, or a nested map of one, as msgpack returns it."""


def _same_keys(keys: Map, _where: str = "") -> Map:
    return keys


def _accept(_record: object, _where: str) -> None:
    """Accept every record: for messages whose field types are the only rules."""


@dataclass(frozen=True, slots=True)
class Form(Generic[_R]):
    """Rules of one kind of message that the fields of its record do not express."""

    kind: type[_R]
    """Type of the record; its fields are the keys of the message."""

    where: str
    """Name of the message in the texts of errors, such as "a status"."""

    _: KW_ONLY
    first: tuple[str, ...] = ()
    """Keys that are sent before the others, which follow in the order of the fields."""

    optional_keys: tuple[str, ...] = ()
    """Keys that an older sender does not know, or that apply to some messages only."""

    unpack: Callable[[bytes, str], Map] | None = None
    """Parser of the bytes; None if they are a map of at most :data:`MESSAGE_LIMIT` bytes."""

    keys: Callable[[Map], Map] = _same_keys
    """Conversion from fields to keys, where they differ."""

    fields: Callable[[Map, str], Map] = _same_keys
    """Conversion from keys to fields, where they differ."""

    check: Callable[[_R, str], None] = _accept
    """Check of rules that involve several fields; raises a ``WireError``."""

    checked_when_sent: bool = True
    """True if :func:`encode` checks the message too; False for messages that an RTC ignores."""


_FORMS: dict[type, Form[Any]] = {}


def register(kind: type[_R], where: str, **how: Any) -> None:  # noqa: ANN401 - fields of Form
    """Register a type of record as a message, with the other fields of its :class:`Form`."""
    _FORMS[kind] = Form(kind, where, **how)


def encode(record: DataclassInstance) -> bytes:
    """Return the bytes of a message.

    Raises
    ------
    WireError
        If the record breaks the contract.
    """
    form = _FORMS[type(record)]
    data: bytes = msgpack.packb({"v": VERSION, **to_map(record)}, default=_plain)
    if form.checked_when_sent:
        # Dataclasses do not check their fields. Decoding here turns a mistake of the sender into
        # an error where it was made, instead of a refusal by the other side.
        decode(form.kind, data)
    return data


def decode(kind: type[_R], data: bytes) -> _R:
    """Return the record of a message's bytes.

    Raises
    ------
    WireError
        If they break the contract; the text can be the ``reason`` of a reply.
    """
    form: Form[_R] = _FORMS[kind]
    values = (form.unpack or unpack)(data, form.where)
    return from_map(kind, check_version(values, form.where), form.where)


def to_map(record: DataclassInstance) -> Map:
    """Return the map of a record that is a message or a nested part of one."""
    kind = type(record)
    return _FORMS[kind].keys({name: getattr(record, name) for name in field_names(kind)})


def from_map(kind: type[_R], values: Map, where: str) -> _R:
    """Return the record of a map that is a message or a nested part of one.

    Raises
    ------
    WireError
        If it breaks the contract.
    """
    form: Form[_R] = _FORMS[kind]
    record = read(form.fields(values, where), kind, where, form.optional_keys)
    # After all single fields: a rule for several may assume that each of them is valid.
    form.check(record, where)
    return record


def _plain(value: object) -> object:
    """Return numpy scalars, arrays, records and mappings as types that msgpack can pack."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise WireError(f"range: {value!r:.80} of type {type(value).__name__} cannot travel")


def unpack(data: bytes, where: str, limit: int = MESSAGE_LIMIT) -> Map:
    """Return the map that the bytes of a message contain.

    Parameters
    ----------
    data
        Bytes of the message.
    where
        Name of the message in the text of an error.
    limit
        Largest number of bytes.

    Raises
    ------
    WireError
        If there are more bytes, or they are not a msgpack map.
    """
    # Before parsing, which takes time and memory in proportion to the length.
    if len(data) > limit:
        raise WireError(f"range: {where} has {len(data)} bytes, expected at most {limit}")
    try:
        values = msgpack.unpackb(data)
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        raise WireError(f"range: {where} is not msgpack: {error!s:.100}") from error
    return require_map(values, where)


def require_map(values: object, where: str) -> Map:
    """Return ``values`` if it is a map.

    Raises
    ------
    WireError
        If it is something else.
    """
    if not isinstance(values, dict):
        raise WireError(f"range: {where} is {_show(values)}, expected a map")
    return values


def check_version(values: Map, where: str) -> Map:
    """Return the map if its ``v`` is :data:`VERSION`.

    Raises
    ------
    WireError
        If the version is missing or different.
    """
    version = require(values, "v", where)
    if version != VERSION or isinstance(version, bool):  # True == 1 in Python
        raise WireError(f"v: {_show(version)} in {where}, expected {VERSION}")
    return values


def require(values: Map, key: str, where: str) -> Any:  # noqa: ANN401 - any msgpack value
    """Return the value of a key that must be present.

    Raises
    ------
    WireError
        If the key is absent.
    """
    if key not in values:
        raise WireError(f"missing: key {key!r} in {where}")
    return values[key]


@cache
def field_names(kind: type[DataclassInstance]) -> tuple[str, ...]:
    """Return the names of a record's fields in the order in which they are sent."""
    first = _FORMS[kind].first if kind in _FORMS else ()
    return (*first, *(field.name for field in fields(kind) if field.name not in first))


def optional_keys(kind: type[DataclassInstance]) -> tuple[str, ...]:
    """Return the keys of a record that a message may leave out."""
    return _FORMS[kind].optional_keys if kind in _FORMS else ()


def read(values: Map, kind: type[_R], where: str, absent: tuple[str, ...] = ()) -> _R:
    """Return the record of a map whose keys are named like the fields.

    Parameters
    ----------
    values
        The map. Keys that are not fields are ignored, so that either side can add some later.
    kind
        Type of the record.
    where
        Name of the map in the text of an error.
    absent
        Keys that may be absent; their fields then have their defaults.

    Raises
    ------
    WireError
        If a key is missing or its value does not match the type of the field.
    """
    for name in field_names(kind):
        if name not in absent:
            require(values, name, where)
    try:
        # bytes are builtin here: otherwise msgspec would expect them in base64, as in JSON.
        record = msgspec.convert(values, kind, builtin_types=(bytes,))
    except msgspec.ValidationError as error:
        raise _find_mismatch(values, kind, where) from error
    # A regular expression cannot express "printable", so msgspec has checked the length only.
    for name in _opaque_fields(kind):
        value = getattr(record, name)
        if value is not None and not value.isprintable():
            raise refusal(name, value, describe_field(kind, name), where)
    return record


def read_registration(values: Map, key: str, where: str) -> dict[str, float] | None:
    """Return the four numbers of the registration at ``key``; None if the value is nil.

    Raises
    ------
    WireError
        If one of them is missing or not finite.
    """
    numbers = require(values, key, where)
    if numbers is None:
        return None
    inside = f"{key!r} of {where}"
    return asdict(read(require_map(numbers, inside), RegistrationNumbers, inside))


def check_applicability(record: DataclassInstance, where: str, **applies: bool) -> None:
    """Check that each named field has a value if and only if it applies to this message.

    Raises
    ------
    WireError
        If a field that applies is None, or one that does not apply has a value.
    """
    for key, is_needed in applies.items():
        value = getattr(record, key)
        if is_needed and value is None:
            raise refusal(key, value, describe_field(type(record), key), where)
        if not is_needed and value is not None:
            raise refusal(key, value, "nil, it does not apply", where)


def without_nil(keys: Map, *names: str) -> Map:
    """Return the map without these keys where they are nil, as an older sender writes it.

    Absent and nil mean the same for them.
    """
    return {key: value for key, value in keys.items() if value is not None or key not in names}


def nil_reason_to_text(values: Map, _where: str) -> Map:
    """Return the map with an empty ``reason`` in place of nil."""
    return values | {"reason": ""} if values.get("reason", "") is None else values


def refusal(key: str, value: object, expected: str, where: str) -> WireError:
    """Return the error for a key, with the value found and the values expected."""
    return WireError(f"range: {key} is {_show(value)} in {where}, expected {expected}")


def describe_field(kind: type[DataclassInstance], key: str) -> str:
    """Return a text on the values that a field may have, such as "a finite number > 0"."""
    return _describe_type(_field_types(kind)[key])


def _find_mismatch(value: Any, kind: Any, where: str, key: str = "") -> WireError:  # noqa: ANN401
    """Return the error for a value that does not match its type, with the key at fault.

    msgspec's own message has a path but not the texts of the contract. This function descends
    into the first part that does not match, so that the error names a key of the message.
    """
    kind, parts = _without_none(kind), []
    is_record = is_dataclass(kind)
    if is_record:
        if not isinstance(value, dict):
            return WireError(f"range: {key!r} of {where} is {_show(value)}, expected a map")
        where, types = (f"{key!r} of {where}" if key else where), _field_types(kind)
        parts = [(part, types[name], name) for name, part in value.items() if name in types]
    elif isinstance(value, list):
        parts = [
            (part, item, key)
            for part, item in zip(value, _item_types(kind, len(value)), strict=False)
        ]
    for part, expected, name in parts:
        if not _matches_type(part, expected):
            return _find_mismatch(part, expected, where, name)
    if is_record:
        lacking = next(name for name in _field_types(kind) if name not in value)
        return WireError(f"missing: key {lacking!r} in {where}")
    # An invalid id has an error code of its own in the contract.
    if _describe_type(kind) == ID_EXPECTED:
        validate_id(value, f"key {key!r} in {where}")
    return refusal(key, value, _describe_type(kind), where)


def _matches_type(value: object, kind: Any) -> bool:  # noqa: ANN401 - an annotated type
    try:
        msgspec.convert(value, kind, builtin_types=(bytes,))
    except msgspec.ValidationError:
        return False
    return True


@cache
def _field_types(kind: type[DataclassInstance]) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


@cache
def _opaque_fields(kind: type[DataclassInstance]) -> tuple[str, ...]:
    printable = _describe_type(Opaque)
    return tuple(name for name, at in _field_types(kind).items() if _describe_type(at) == printable)


def _without_none(kind: Any) -> Any:  # noqa: ANN401 - a type
    """Return the type ``T`` of ``T | None``, and any other type as it is."""
    is_union = get_origin(kind) in {Union, UnionType}
    return next(one for one in get_args(kind) if one is not NoneType) if is_union else kind


def _item_types(kind: Any, n_items: int) -> tuple[Any, ...]:  # noqa: ANN401 - a type
    """Return the type of each item of a list; empty if ``kind`` has another length."""
    bare = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    items = get_args(bare) if get_origin(bare) is tuple else ()
    items = items[:1] * n_items if items[1:] == (...,) else items
    return items if len(items) == n_items else ()


def _describe_type(kind: Any) -> str:  # noqa: ANN401 - a type
    kind = _without_none(kind)
    if get_origin(kind) is Annotated:
        return str(kind.__metadata__[0].description)
    if get_origin(kind) is tuple:
        return "a list"
    if issubclass(kind, Enum):
        return f"one of {', '.join(str(one.value) for one in kind)}"
    return "true or false" if kind is bool else "bytes"


def _show(value: object) -> str:
    if isinstance(value, bytes | list | tuple | dict):
        # msgpack has lists only; a tuple is one of our own records.
        kind = "list" if isinstance(value, tuple) else type(value).__name__
        return f"a {kind} of {len(value)}"
    return f"{value!r:.60} ({type(value).__name__})"
