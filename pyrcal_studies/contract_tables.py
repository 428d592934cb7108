"""Tables of docs/rtc/fields.md: every key of every message, from the records of service.wire."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

from msgspec import inspect as types

from check_rtc.requirements import REQUIREMENTS
from pyrcal.instruments.schema_texts import described
from service.wire import (
    ATTACHMENT_LIMIT,
    BATCH_LIMIT,
    CHUNK_LIMIT,
    FRAMES_PER_BATCH,
    MESSAGE_LIMIT,
    STATUS_LIMIT,
    TEXT_LIMIT,
    Acknowledgement,
    AlarmMessage,
    DitherRequest,
    DitherStatus,
    DitherStop,
    FrameHeader,
    LoopRequest,
    Manifest,
    MatrixLayout,
    MeasuredManifest,
    MeasureRequest,
    OffloadRequest,
    Pointing,
    RampRequest,
    Reply,
    StateMessage,
    Status,
)
from service.wire.codec import RegistrationNumbers, field_names, optional_keys
from service.wire.matrices import MATRIX_LIMIT

Row = tuple[str, str, str, str, str, str]
"""Key, type, unit, range, whether it may be nil, meaning."""

HEAD: Final = ("key", "type", "unit", "range", "nil", "meaning")

MESSAGES: Final[dict[str, type]] = {
    "frames": FrameHeader,
    "status": Status,
    "dither": DitherRequest,
    "stop": DitherStop,
    "loop": LoopRequest,
    "measure": MeasureRequest,
    "ramp": RampRequest,
    "offload": OffloadRequest,
    "reply": Reply,
    "commit": Manifest,
    "ack": Acknowledgement,
    "im-commit": MeasuredManifest,
    "state": StateMessage,
    "alarm": AlarmMessage,
}
"""Records that are messages, each with its ``v``."""

PARTS: Final[dict[str, type]] = {
    "status-dither": DitherRequest,
    "pointing": Pointing,
    "alpha": RegistrationNumbers,
}
"""Maps inside of messages."""

_VERSION: Final = ("`v`", "int", "", "1", "no", "Version of the contract.")
_ACTION: Final[dict[str, Row]] = {
    name: ("`action`", "str", "", f"`{word}`", "no", f"Says that this is a {what}.")
    for name, word, what in (
        ("dither", "start", "start"),
        ("status-dither", "start", "dither"),
        ("stop", "stop", "stop"),
    )
}
_DTYPE: Final = ("`dtype`", "str", "", "`<f4`", "no", "Little-endian float32; there is no other.")

_UNITS: Final = {
    "_m": "m OPD",
    "_ns": "ns",
    "_hz": "Hz",
    "_s": "s",
    "_subap": "subapertures",
    "_deg": "degrees",
    "_frames": "frames",
    "_bytes": "bytes",
    "magnification": "ratio",
}

_WORDS: Final[dict[type[types.Type], str]] = {
    types.IntType: "int",
    types.FloatType: "float",
    types.StrType: "str",
    types.EnumType: "str",
    types.BytesType: "bin",
    types.BoolType: "bool",
    types.DictType: "map",
    types.DataclassType: "map",
}


def with_tables(page: str) -> str:
    """Return a page with every table between its marks as the code has it now."""
    return re.sub(
        r"(<!-- table: ([a-z-]+) -->\n).*?(<!-- end -->)",
        lambda found: f"{found[1]}{_TABLES[found[2]]()}\n{found[3]}",
        page,
        flags=re.DOTALL,
    )


def rows_of(name: str) -> list[Row]:
    """Return the rows of a message's table, or of a part's."""
    rows = list(_rows(name, {**MESSAGES, **PARTS}[name]))
    extra = [_VERSION] if name in MESSAGES else []
    if name in _ACTION:
        extra.append(_ACTION[name])
    if name == "status-dither":
        rows += list(_rows(name, DitherStatus))
    return [*extra, *rows]


def _rows(name: str, record: type) -> Iterator[Row]:
    bases = reversed(record.__mro__[:-1])
    texts = {key: text for base in bases for key, text in described(base).items()}
    known = {field.name: field.type for field in _info(record)}
    for key in field_names(record):
        kind = known[key]
        if key == "request":
            continue
        if key == "layout":
            yield from _rows(name, MatrixLayout)
            yield _DTYPE
            continue
        nil = "yes" if _optional(kind) else "no"
        if key in optional_keys(record):
            nil = "may be absent" if nil == "no" else "yes, or absent"
        yield (
            f"`{key}`",
            _type(kind),
            next((unit for end, unit in _UNITS.items() if key.endswith(end)), ""),
            _range(kind),
            nil,
            texts[key].replace("None", "nil").replace("``", "`"),
        )


def _info(record: type) -> tuple[Any, ...]:
    return tuple(getattr(types.type_info(record), "fields", ()))


def _optional(kind: types.Type) -> bool:
    return isinstance(kind, types.UnionType) and kind.includes_none


def _core(kind: types.Type) -> types.Type:
    """Return a type without nil and without what is said of its range."""
    if isinstance(kind, types.UnionType):
        kind = next(each for each in kind.types if not isinstance(each, types.NoneType))
    return kind.type if isinstance(kind, types.Metadata) else kind


def _type(kind: types.Type) -> str:
    core = _core(kind)
    if isinstance(core, types.VarTupleType):
        return f"array of {_type(core.item_type)}"
    if isinstance(core, types.TupleType):
        return f"array of {len(core.item_types)} {_type(core.item_types[0])}"
    return _WORDS[type(core)]


def _range(kind: types.Type) -> str:
    if isinstance(kind, types.UnionType):
        kind = next(each for each in kind.types if not isinstance(each, types.NoneType))
    if isinstance(kind, types.Metadata):
        text = str((kind.extra_json_schema or {})["description"])
        return text.replace(str(2**63 - 1), "2^63 - 1").replace(str(2**62), "2^62")
    if isinstance(kind, types.EnumType):
        return ", ".join(f"`{each}`" for each in kind.cls)
    if isinstance(kind, types.VarTupleType):
        return f"each {_range(kind.item_type)}"
    return "`true`, `false`" if isinstance(kind, types.BoolType) else ""


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _limits() -> str:
    rows = [
        ("frames in a batch", f"{FRAMES_PER_BATCH}"),
        ("payload of a batch", f"{BATCH_LIMIT} bytes"),
        ("attachment of a batch", f"{ATTACHMENT_LIMIT} bytes"),
        ("status without its `flux`", f"{MESSAGE_LIMIT} bytes"),
        ("status with it", f"{STATUS_LIMIT} bytes: images of up to 512 x 512 subapertures"),
        ("manifest, acknowledgement, command, reply", f"{MESSAGE_LIMIT} bytes"),
        ("chunk of a matrix", f"{CHUNK_LIMIT} bytes"),
        ("matrix", f"{MATRIX_LIMIT} bytes"),
        ("text", f"{TEXT_LIMIT} characters"),
    ]
    return table(("what", "at most"), rows)


def _verification() -> str:
    """Return the requirements that each check of ``pyrcal check-rtc`` verifies."""
    rows = [
        (f"`{name}`", one.says, ", ".join(one.labels), one.moves.value)
        for name, one in REQUIREMENTS.items()
    ]
    return table(("check", "what it verifies", "requirements", "what it moves"), rows)


_TABLES: Final[dict[str, Callable[[], str]]] = {
    **{
        name: (lambda name=name: table(HEAD, rows_of(name)))  # type: ignore[misc]
        for name in (*MESSAGES, *PARTS)
    },
    "limits": _limits,
    "verification": _verification,
}
