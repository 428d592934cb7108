"""Records <-> msgpack maps, checked for keys, types and ranges.

The types of a record's fields say what its keys may hold; a refusal names the key, what was found
and what was expected. A :class:`Form` says what else a kind of message asks for. Here are the types
that messages share.
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
from service.wire.keys import ID_EXPECTED, ID_PATTERN, RESERVED_IDS, checked_id

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

_FINITE: Final = float(np.finfo(np.float64).max)

_T = TypeVar("_T")
_R = TypeVar("_R", bound="DataclassInstance")


def integer(low: int = 0, high: int = INTEGER_LIMIT) -> Meta:
    """Return what makes an ``int`` one from ``low`` to ``high``."""
    return Meta(ge=low, le=high, description=f"an integer from {low} to {high}")


def number(low: float, high: float = _FINITE) -> Meta:
    """Return what makes a ``float`` a finite one from ``low`` to ``high``."""
    span = f" from {low:g}" + ("" if high == _FINITE else f" to {high:g}")
    return Meta(ge=low, le=high, description=f"a finite number{span}")


def above(low: float, high: float = _FINITE) -> Meta:
    """Return what makes a ``float`` a finite one greater than ``low``, to ``high``."""
    span = f" > {low:g}" + ("" if high == _FINITE else f" and <= {high:g}")
    return Meta(gt=low, le=high, description=f"a finite number{span}")


Count = Annotated[int, integer()]
Finite = Annotated[float, Meta(ge=-_FINITE, le=_FINITE, description="a finite number")]
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
"""A name that only its sender understands."""

_RESERVED = "|".join(sorted(RESERVED_IDS))
Id = Annotated[
    str,
    Meta(pattern=rf"\A(?!({_RESERVED})\Z){ID_PATTERN.pattern}\Z", description=ID_EXPECTED),
]
SHA256_EXPECTED: Final = "64 lower-case hex digits"
Sha256 = Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z", description=SHA256_EXPECTED)]


@dataclass(frozen=True, slots=True, kw_only=True)
class FourNumbers:
    """The four parameters of a registration, or their 1 σ, by their names at every boundary."""

    shift_x_subap: Finite
    """Along +x of the sensor."""

    shift_y_subap: Finite
    """Along +y of the sensor."""

    rotation_deg: Finite
    """From +x towards +y."""

    magnification: Finite
    """1: as the instrument file says."""


Map = dict[str, Any]
"""A message, or a part of one, as msgpack has it."""


def _untouched(keys: Map, _where: str = "") -> Map:
    return keys


def _no_more(_record: object, _where: str) -> None:
    """Ask for no more than the types of the fields do."""


@dataclass(frozen=True, slots=True)
class Form(Generic[_R]):
    """Further rules for one kind of message, beyond the fields of its record."""

    kind: type[_R]
    """Of the record: its fields are the keys."""

    where: str
    """What a message is called in refusals."""

    _: KW_ONLY
    first: tuple[str, ...] = ()
    """Keys that travel before the others, which follow in the order of the fields."""

    may_be_absent: tuple[str, ...] = ()
    """Keys that came after the contract, or that mean something in some messages alone."""

    opened: Callable[[bytes, str], Map] | None = None
    """Bytes to keys; None: a map of at most :data:`MESSAGE_LIMIT` bytes."""

    keys: Callable[[Map], Map] = _untouched
    """Fields to keys, where they differ."""

    fields: Callable[[Map, str], Map] = _untouched
    """Keys to fields, where they differ."""

    check: Callable[[_R, str], None] = _no_more
    """What fields must be together."""

    held: bool = True
    """Whether what is sent is held against the contract first; not what an RTC ignores."""


_FORMS: dict[type, Form[Any]] = {}


def travels(kind: type[_R], where: str, **how: Any) -> None:  # noqa: ANN401 - as Form has it
    """Let records of a kind travel, in the :class:`Form` that the rest describes."""
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
    if form.held:
        decode(form.kind, data)
    return data


def decode(kind: type[_R], data: bytes) -> _R:
    """Return the record that a message is.

    Raises
    ------
    WireError
        If it breaks the contract; the text is fit for the ``reason`` of a reply.
    """
    form: Form[_R] = _FORMS[kind]
    values = (form.opened or unpack)(data, form.where)
    return of_map(kind, of_this_version(values, form.where), form.where)


def to_map(record: DataclassInstance) -> Map:
    """Return the map of a record, be it a message or a part of one."""
    kind = type(record)
    return _FORMS[kind].keys({name: getattr(record, name) for name in names_of(kind)})


def of_map(kind: type[_R], values: Map, where: str) -> _R:
    """Return the record of a map, be it a message or a part of one.

    Raises
    ------
    WireError
        If it breaks the contract.
    """
    form: Form[_R] = _FORMS[kind]
    record = read(form.fields(values, where), kind, where, form.may_be_absent)
    form.check(record, where)
    return record


def _plain(value: object) -> object:
    """Turn numpy scalars, arrays and records into what msgpack knows."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise WireError(f"range: {value!r:.80} of type {type(value).__name__} cannot travel")


def unpack(data: bytes, where: str, limit: int = MESSAGE_LIMIT) -> Map:
    """Return the map that a message is.

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
    return as_map(values, where)


def as_map(values: object, where: str) -> Map:
    """Return what must be a map.

    Raises
    ------
    WireError
        If it is none.
    """
    if not isinstance(values, dict):
        raise WireError(f"range: {where} is {_show(values)}, expected a map")
    return values


def of_this_version(values: Map, where: str) -> Map:
    """Return a map whose ``v`` is the version this code speaks.

    Raises
    ------
    WireError
        If it is another.
    """
    version = get(values, "v", where)
    if version != VERSION or isinstance(version, bool):
        raise WireError(f"v: {_show(version)} in {where}, expected {VERSION}")
    return values


def get(values: Map, key: str, where: str) -> Any:  # noqa: ANN401  as msgpack made it
    """Return the value of a key that must be present.

    Raises
    ------
    WireError
        If it is not.
    """
    if key not in values:
        raise WireError(f"missing: key {key!r} in {where}")
    return values[key]


@cache
def names_of(kind: type[DataclassInstance]) -> tuple[str, ...]:
    """Return the fields of a record in the order in which they travel."""
    first = _FORMS[kind].first if kind in _FORMS else ()
    return (*first, *(field.name for field in fields(kind) if field.name not in first))


def may_be_absent(kind: type[DataclassInstance]) -> tuple[str, ...]:
    """Return the keys of a record that need not be sent."""
    return _FORMS[kind].may_be_absent if kind in _FORMS else ()


def read(values: Map, kind: type[_R], where: str, absent: tuple[str, ...] = ()) -> _R:
    """Return the record of a map whose keys are named like the fields.

    Parameters
    ----------
    values
        The map; a key that is no field is ignored.
    kind
        The record's type.
    where
        What the map is, for the text of a refusal.
    absent
        Keys that need not be there.

    Raises
    ------
    WireError
        If a key is missing or its value is not what the field's type says.
    """
    for name in names_of(kind):
        if name not in values and name not in absent:
            get(values, name, where)
    try:
        record = msgspec.convert(values, kind, builtin_types=(bytes,))
    except msgspec.ValidationError as error:
        raise _refused(values, kind, where) from error
    for name in _opaque(kind):
        if not getattr(record, name).isprintable():
            raise refusal(name, getattr(record, name), expected_of(kind, name), where)
    return record


def read_four(values: Map, key: str, where: str) -> dict[str, float] | None:
    """Return the four numbers of a registration below a key, None where it is nil.

    Raises
    ------
    WireError
        If one of them is missing or not finite.
    """
    below = get(values, key, where)
    if below is None:
        return None
    inside = f"{key!r} of {where}"
    return asdict(read(as_map(below, inside), FourNumbers, inside))


def applicable(record: DataclassInstance, where: str, **applies: bool) -> None:
    """Refuse a field that is None though it applies, or something though it does not.

    Raises
    ------
    WireError
        If one is.
    """
    for key, does in applies.items():
        value = getattr(record, key)
        if does and value is None:
            raise refusal(key, value, expected_of(type(record), key), where)
        if not does and value is not None:
            raise refusal(key, value, "nil, it does not apply", where)


def reason_or_none(values: Map, _where: str) -> Map:
    """Return a map in which a reason that is nil is an empty one."""
    return values | {"reason": ""} if values.get("reason", "") is None else values


def refusal(key: str, value: object, expected: str, where: str) -> WireError:
    """Return the error that says what a key held and what it should hold."""
    return WireError(f"range: {key} is {_show(value)} in {where}, expected {expected}")


def expected_of(kind: type[DataclassInstance], key: str) -> str:
    """Return in words what a field may hold."""
    return _words(_types(kind)[key])


def _refused(value: Any, kind: Any, where: str, key: str = "") -> WireError:  # noqa: ANN401
    """Return the error of a value that is not of a type: of the first part of it that is wrong."""
    kind, parts = _without_none(kind), []
    is_record = is_dataclass(kind)
    if is_record:
        if not isinstance(value, dict):
            return WireError(f"range: {key!r} of {where} is {_show(value)}, expected a map")
        where, types = (f"{key!r} of {where}" if key else where), _types(kind)
        parts = [(part, types[name], name) for name, part in value.items() if name in types]
    elif isinstance(value, list):
        parts = [
            (part, item, key) for part, item in zip(value, _items(kind, len(value)), strict=False)
        ]
    for part, expected, name in parts:
        if not _is_of(part, expected):
            return _refused(part, expected, where, name)
    if is_record:
        lacking = next(name for name in _types(kind) if name not in value)
        return WireError(f"missing: key {lacking!r} in {where}")
    if _words(kind) == ID_EXPECTED:
        checked_id(value, f"key {key!r} in {where}")
    return refusal(key, value, _words(kind), where)


def _is_of(value: object, kind: Any) -> bool:  # noqa: ANN401  a type, annotated
    try:
        msgspec.convert(value, kind, builtin_types=(bytes,))
    except msgspec.ValidationError:
        return False
    return True


@cache
def _types(kind: type[DataclassInstance]) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


@cache
def _opaque(kind: type[DataclassInstance]) -> tuple[str, ...]:
    printable = _words(Opaque)
    return tuple(name for name, at in _types(kind).items() if _words(at) == printable)


def _without_none(kind: Any) -> Any:  # noqa: ANN401  a type
    """Return a type without the None that it may be as well."""
    is_union = get_origin(kind) in {Union, UnionType}
    return next(one for one in get_args(kind) if one is not NoneType) if is_union else kind


def _items(kind: Any, n_items: int) -> tuple[Any, ...]:  # noqa: ANN401  a type
    """Return the type of each item of a list; none: it is no list, or of another length."""
    bare = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    items = get_args(bare) if get_origin(bare) is tuple else ()
    items = items[:1] * n_items if items[1:] == (...,) else items
    return items if len(items) == n_items else ()


def _words(kind: Any) -> str:  # noqa: ANN401  a type
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
        kind = "list" if isinstance(value, tuple) else type(value).__name__
        return f"a {kind} of {len(value)}"
    return f"{value!r:.60} ({type(value).__name__})"
