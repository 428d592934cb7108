"""Tables of docs/rtc/fields.md: every key of every message, from the records of service.wire."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
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
    REFERENCES_LIMIT,
    STATUS_LIMIT,
    TEXT_LIMIT,
    Acknowledgement,
    AlarmMessage,
    DitherRequest,
    DitherStatus,
    DitherStop,
    FrameHeader,
    GainsMessage,
    LoopRequest,
    Manifest,
    MatrixLayout,
    MeasuredManifest,
    MeasureRequest,
    OffloadRequest,
    Pointing,
    RampRequest,
    ReferencesInUse,
    ReferencesRequest,
    Reply,
    StateMessage,
    Status,
)
from service.wire.codec import SHA256_EXPECTED, RegistrationNumbers, field_names, optional_keys
from service.wire.keys import ID_EXPECTED
from service.wire.matrices import MATRIX_LIMIT

Row = tuple[str, str, str, str, str]
"""Key, type, range, whether it may be nil, meaning."""

HEAD: Final = ("key", "type and range", "meaning")

MESSAGES: Final[dict[str, type]] = {
    "frames": FrameHeader,
    "status": Status,
    "dither": DitherRequest,
    "stop": DitherStop,
    "loop": LoopRequest,
    "measure": MeasureRequest,
    "ramp": RampRequest,
    "offload": OffloadRequest,
    "references": ReferencesRequest,
    "references-in-use": ReferencesInUse,
    "reply": Reply,
    "commit": Manifest,
    "ack": Acknowledgement,
    "im-commit": MeasuredManifest,
    "state": StateMessage,
    "gains": GainsMessage,
    "alarm": AlarmMessage,
}
"""Records that are messages, each with its ``v``."""

PARTS: Final[dict[str, type]] = {
    "status-dither": DitherRequest,
    "pointing": Pointing,
    "alpha": RegistrationNumbers,
}
"""Maps inside of messages."""

_VERSION: Final = ("`v`", "int", "1", "no", "Version of the contract.")
_ACTION: Final[dict[str, Row]] = {
    name: ("`action`", "str", f"`{word}`", "no", f"{what}.")
    for name, word, what in (
        ("dither", "start", "Start of a dither"),
        ("status-dither", "start", "Start of a dither"),
        ("stop", "stop", "End of the dither"),
    )
}
_DTYPE: Final = ("`dtype`", "str", "`<f4`", "no", "Little-endian float32.")

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
        return f"[{_type(core.item_type)}]"
    if isinstance(core, types.TupleType):
        return f"[{', '.join(map(_type, core.item_types))}]"
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
        return _range(kind.item_type)
    return ""


_NAMED_RANGES: Final = {
    "an integer from 0 to 2^63 - 1": ("int", "int"),
    "a finite number": ("float", "float"),
    f"a text of 0 to {TEXT_LIMIT} characters": ("str", "text"),
    "1 to 128 printable characters": ("str", "name"),
    ID_EXPECTED: ("str", "id"),
    SHA256_EXPECTED: ("str", "checksum"),
    "pairs of integers": ("int", "int"),
}
"""Ranges that the section *Types* of the page explains, with the name that stands for each."""


def _values(row: Row) -> str:
    """Return type and range of a key in one phrase, and whether it may be nil or absent."""
    _, kind, limits, nil, _ = row
    if limits in _NAMED_RANGES:
        text = kind.replace(*_NAMED_RANGES[limits])
    elif limits.startswith("`"):
        text = limits
    else:
        short = limits.removeprefix("an integer from ").removeprefix("a finite number ")
        short = re.sub(r"^from (\S+)$", r"≥ \1", short).removeprefix("from ")
        text = f"{kind} {short}".strip().replace("1 to 2^63 - 1", "≥ 1").replace("<=", "≤")
    text += " or nil" if nil.startswith("yes") else ""
    return text + (", may be absent" if nil.endswith("absent") else "")


def _message(name: str) -> str:
    """Return the table of a message, without the keys that it shares with others."""
    rows = rows_of(name)
    lines = []
    for title, group in _GROUPS.items():
        common = [row[:-1] for row in group(name)]
        shared = [row[0] for row in rows if name in MESSAGES and row[:-1] in common]
        rows = [row for row in rows if row[0] not in shared]
        anchor = title.lower().replace(" ", "-")
        lines += [f"[{title}](#{anchor}): {', '.join(shared)}."] if shared else []
    if name in _SAME_AS:
        rows = [row for row in rows if row not in rows_of(_SAME_AS[name])]
    return "\n\n".join([*lines, _keys(rows)])


def _keys(rows: Iterable[Row]) -> str:
    return table(HEAD, [(row[0], _values(row), row[-1]) for row in rows])


def _shared(_name: str = "") -> list[Row]:
    """Return the keys that mean the same in every message that has them."""
    keys = {"session", "basis_id", "config_id"}
    found = [row for row in rows_of("frames") if row[0].strip("`") in keys]
    system = [row for row in rows_of("alarm") if row[0] == "`system`"]
    return [_VERSION, *found, *system]


def _layout(name: str = "commit") -> list[Row]:
    """Return the keys of a manifest that describe the bytes of its matrix."""
    return [*_rows("layout", MatrixLayout), _DTYPE] if name in {"commit", "im-commit"} else []


_GROUPS: Final[dict[str, Callable[[str], list[Row]]]] = {
    "Shared keys": _shared,
    "Layout": _layout,
}

_SAME_AS: Final = {"status-dither": "dither", "offload": "alpha"}
"""Messages and parts that repeat the keys of another, as their sections say."""


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
        ("reference slopes, as a command and read back", f"{REFERENCES_LIMIT} bytes"),
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
        name: (lambda name=name: _message(name))  # type: ignore[misc]
        for name in (*MESSAGES, *PARTS)
    },
    "shared": lambda: _keys(_shared()),
    "layout": lambda: _keys(_layout()),
    "limits": _limits,
    "verification": _verification,
}
