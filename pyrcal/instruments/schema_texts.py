"""Every key of a file in words: its type, its default, what it means; from its schema."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Any, get_args, get_type_hints

from service.files.toml import Table

Schema = Mapping[str, Any]

_LIMITS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyText:
    """A key of a table."""

    name: str
    type: str
    """Type and limits, in words."""

    needed: bool
    """True if a file must have it."""

    default: object
    """Default value; None if there is none, or a rule that the description states."""

    meaning: str
    """Description; empty if the name is sufficient."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TableText:
    """A table of a file."""

    header: str
    """Header in TOML: ``[wfs]``, ``[[wfs.mode]]``."""

    about: str
    """Purpose of the table."""

    keys: tuple[KeyText, ...]


def tables_of(whole: type[Table]) -> Iterator[TableText]:
    """Yield the tables of a file, each followed by those inside it."""
    schema = whole.model_json_schema()
    kinds: dict[str, Schema] = schema["$defs"]
    for section, place in schema["properties"].items():
        of_each = place.get("items", place)
        kind = kinds[of_each["$ref"].rpartition("/")[2]]
        record = whole.model_fields[section].annotation
        yield _table(f"[{section}]" if of_each is place else f"[[{section}]]", kind, record, kinds)
        for key, field in kind["properties"].items():
            inner = field.get("items", {}).get("$ref")
            if inner is not None:
                (each, _) = get_args(get_type_hints(record)[key])
                table = kinds[inner.rpartition("/")[2]]
                yield _table(f"[[{section}.{key}]]", table, each, kinds)
            # A table within a table may be optional, which JSON schemas say with anyOf.
            for of_key in (field, *field.get("anyOf", ())):
                table = kinds.get(of_key.get("$ref", "").rpartition("/")[2], {})
                if _text(table).startswith(f"`[{section}.{key}]"):
                    inside = _inside(record, key)
                    yield _table(f"[{section}.{key}]", table, inside, kinds)


def _inside(record: object, key: str) -> object:
    """Return the record of a table within another, which may be left out; None: no dataclass."""
    hint = get_type_hints(record)[key] if is_dataclass(record) else None
    return next((one for one in get_args(hint) if is_dataclass(one)), None)


def _table(header: str, kind: Schema, record: object, kinds: Mapping[str, Schema]) -> TableText:
    about = _text(kind).partition(": ")[2]
    needed = kind.get("required", ())
    texts = _field_texts(record) if isinstance(record, type) and is_dataclass(record) else {}
    return TableText(
        header=header,
        about=about[:1].upper() + about[1:],
        keys=tuple(
            KeyText(
                name=key,
                type=_type(field, kinds),
                needed=key in needed,
                default=field.get("default"),
                meaning=_text({"description": texts.get(key, "")} | field),
            )
            for key, field in kind["properties"].items()
        ),
    )


def _field_texts(record: type) -> dict[str, str]:
    """Return the docstring under each field of a record, inherited ones included."""
    # Of all bases, the record's own last, because it may describe a field in its own words.
    bases = [described(base) for base in reversed(record.__mro__[:-1])]
    return {key: text for texts in bases for key, text in texts.items() if text}


def _type(field: Schema, kinds: Mapping[str, Schema]) -> str:
    if "$ref" in field:
        return _type(kinds[field["$ref"].rpartition("/")[2]], kinds)
    if "anyOf" in field:
        several = [_type(each, kinds) for each in field["anyOf"] if each.get("type") != "null"]
        return " or ".join(dict.fromkeys(several))
    if "prefixItems" in field:
        parts = [_type(each, kinds) for each in field["prefixItems"]]
        alike = len(set(parts)) == 1
        return f"list of {len(parts)}: {parts[0] if alike else ', '.join(parts)}"
    if "enum" in field:
        return ", ".join(f"`{value}`" for value in field["enum"])
    if "const" in field:
        return f"`{field['const']}`"
    if field["type"] == "array":
        each = field.get("items", {})
        of = "tables, below" if "$ref" in each else _type(each, kinds) if each else ""
        return f"list of {of}" if of else "list"
    if field["type"] == "object" and "properties" in field:
        return "table of " + ", ".join(f"`{key}`" for key in field["properties"])
    limits = [f"{sign} {field[limit]:g}" for limit, sign in _LIMITS.items() if limit in field]
    return " ".join([field["type"], ", ".join(limits)]).strip()


def _text(field: Schema) -> str:
    text = " ".join(field.get("description", "").replace("``", "`").split())
    return text.replace("; None:", "; left out:").replace("None:", "Left out:")


def described(kind: type) -> dict[str, str]:
    """Return the names in the body of a class with the text that follows each in its source."""
    # From the source, because Python keeps no docstring of a field.
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    (body,) = (node.body for node in tree.body if isinstance(node, ast.ClassDef))
    texts: dict[str, str] = {}
    name = ""
    for statement in body:
        match statement:
            case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name)):
                texts[name] = ""
            case ast.Expr(value=ast.Constant(value=str(text))) if name:
                texts[name], name = " ".join(text.split()), ""
            case _:
                name = ""
    return texts
