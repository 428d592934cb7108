"""The OpenAPI document's schemas of all views, from the records' own types and descriptions."""

from __future__ import annotations

import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from enum import StrEnum
from functools import cache
from itertools import pairwise
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from service.model.misregistration import PARAMETERS, Misregistration
from service.web.views import NAMED_VIEWS, USUAL_VIEWS, View

Schema = dict[str, Any]
"""A JSON schema."""


def shows(of: View) -> dict[str, Any]:
    """Return the OpenAPI description of an answer that shows a record."""
    schema = {"$ref": f"{SCHEMAS}{of.name}"}
    content = {"application/json": {"schema": schema}}
    return {"description": _for_readers(of.text), "content": content}


def schemas() -> dict[str, Schema]:
    """Return the schemas of all views, and of what they hold, by name."""
    found: dict[str, Schema] = {"FourView": _FOUR}
    for of in NAMED_VIEWS.values():
        properties = {}
        for name, part in of.parts.items():
            kind, text = _field(of.record, part.path)
            properties[name] = _schema(kind, part.below, found)
            if text:
                properties[name] = {**properties[name], "description": _for_readers(text)}
            if part.clock:
                properties[part.clock] = {**_CLOCK, "description": f"``{name}`` by the clock."}
        found[of.name] = {
            "type": "object",
            "description": _for_readers(of.text),
            "properties": properties,
            "required": list(properties),
        }
    return found


SCHEMAS = "#/components/schemas/"
_NUMBER: Schema = {"anyOf": [{"type": "number"}, {"type": "null"}]}
_CLOCK: Schema = {"anyOf": [{"type": "string", "format": "date-time"}, {"type": "null"}]}
_OF_KIND: dict[object, Schema] = {
    float: _NUMBER,
    int: {"type": "integer"},
    bool: {"type": "boolean"},
    str: {"type": "string"},
}
_FOUR: Schema = {
    "type": "object",
    "description": "The four parameters of a registration, or their 1 σ.",
    "properties": {
        "shift_x_subap": {**_NUMBER, "description": "Along sensor +x, subapertures."},
        "shift_y_subap": {**_NUMBER, "description": "Along sensor +y, subapertures."},
        "rotation_deg": {**_NUMBER, "description": "From sensor +x towards +y, degrees."},
        "magnification": {**_NUMBER, "description": "Ratio; 1 is nominal."},
    },
    "required": list(PARAMETERS),
}


def beside_the_four(schema: Schema) -> None:
    """Add the four parameters of a registration to the keys they lie beside."""
    four = _FOUR["properties"].items()
    titled = {name: {**said, "title": name.replace("_", " ").title()} for name, said in four}
    schema["properties"] = titled | schema["properties"]
    schema["required"] = [*PARAMETERS, *schema["required"]]


def _schema(kind: Any, of: View | None, found: dict[str, Schema]) -> Schema:  # noqa: ANN401  a type
    """Return the schema of a type; those of alternatives that it holds are added to ``found``."""
    origin, inside = get_origin(kind), get_args(kind)
    if kind in _OF_KIND:
        return _OF_KIND[kind]
    if origin in {Union, UnionType}:
        schema = _schema(next(one for one in inside if one is not NoneType), of, found)
        return schema if schema == _NUMBER else {"anyOf": [schema, {"type": "null"}]}
    if kind is Misregistration or origin is np.ndarray:
        return {"$ref": f"{SCHEMAS}FourView"}
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {"type": "object", "additionalProperties": _schema(inside[1], of, found)}
    if origin in {tuple, list}:
        return {"type": "array", "items": _schema(inside[0], of, found)}
    if issubclass(kind, StrEnum):
        found[kind.__name__] = {
            "type": "string",
            "enum": [entry.value for entry in kind],
            "description": inspect.getdoc(kind) or "",
        }
        return {"$ref": f"{SCHEMAS}{kind.__name__}"}
    return {"$ref": f"{SCHEMAS}{(of or USUAL_VIEWS[kind]).name}"}


def _field(record: type, path: str) -> tuple[Any, str]:
    """Return the type of what a path leads to, and what the record says of it."""
    first, _, rest = path.partition(".")
    hints, texts = _facts(record)
    if not rest:
        return hints[first], texts.get(first, "")
    return _field(_without_none(hints[first]), rest)


def _without_none(kind: Any) -> Any:  # noqa: ANN401  a type
    return next((one for one in get_args(kind) if one is not NoneType), kind)


@cache
def _facts(record: type) -> tuple[dict[str, Any], dict[str, str]]:
    """Return types and descriptions of a record's fields and properties, by name."""
    if record is object:
        return {}, {}
    hints, texts = (dict(facts) for facts in _facts(record.__mro__[1]))
    hints |= get_type_hints(record) if is_dataclass(record) else {}
    for statement, after in pairwise([*_statements(record), ast.Pass()]):
        match statement, after:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(
                value=ast.Constant(value=str(text))
            ):
                texts[name] = inspect.cleandoc(text)
            case ast.FunctionDef(name=name), _ if isinstance(getattr(record, name), property):
                module = vars(sys.modules[record.__module__])
                hints[name] = get_type_hints(getattr(record, name).fget, module)["return"]
                texts[name] = ast.get_docstring(statement) or ""
            case _:
                pass
    return hints, texts


def _statements(record: type) -> Iterator[ast.stmt]:
    """Yield what the source of a record says, of those it is derived from first."""
    for base in reversed(record.__mro__[:-1]):
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        yield from tree.body if isinstance(tree, ast.ClassDef) else ()


def explained(record: type) -> dict[str, str]:
    """Return what a record says of its fields, by name."""
    return {name: _for_readers(text) for name, text in _facts(record)[1].items()}


def _for_readers(text: str) -> str:
    """Return a record's description as it is true of JSON: null, four names, boundary units."""
    text = re.sub(r"\b(None|NaN)\b", "null", text.partition("\n\n")[0])
    return re.sub(r"``\(4,\)`` |,? ?numeric units( \([^)]*\))?", "", text)
