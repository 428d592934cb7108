"""What leaves over REST: which fields of which record, and how they are written.

Records leave as they are: a view names the fields of one, in boundary units. A registration, or its
1 σ, leaves as its four parameters; a number that is not finite is null. The OpenAPI document takes
types and descriptions from the records themselves, when it is asked for.
"""

from __future__ import annotations

import ast
import inspect
import math
import re
import sys
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from functools import cache
from itertools import pairwise
from operator import attrgetter
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from fastapi import Depends, Request
from fastapi.responses import JSONResponse
from numpy.typing import NDArray

from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration
from service.routes.service import Fits, Service

Schema = dict[str, Any]
"""A JSON schema."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A picture of a record."""

    name: str
    """Of its schema."""

    record: type
    text: str
    """What it shows."""

    paths: Mapping[str, str]
    """Where to find each field, from the record on, by the name it leaves under."""

    below: Mapping[str, View]
    """Views of the records in its fields, where they are not the usual ones."""


_USUAL: dict[type, View] = {}
_NAMED: dict[str, View] = {}


def view(name: str, record: type, fields_of: str = "", text: str = "", **below: View) -> View:
    """Make a view known, and return it.

    Parameters
    ----------
    name
        Of its schema.
    record
        The record's type; the first view of one is its usual view.
    fields_of
        Which fields leave, separated by spaces; ``name=path`` for one that leaves under another
        name. Empty: all of them.
    text
        What it shows; empty: the record's own words.
    **below
        Views of the records in its fields, where they are not the usual ones.
    """
    words = fields_of.split() or [field.name for field in fields(record)]
    paths = {}
    for word in words:
        own, _, path = word.rpartition("=")
        paths[own or path.rpartition(".")[2]] = path
    text = text or inspect.cleandoc(record.__doc__ or "")
    made = View(name=name, record=record, text=text, paths=paths, below=below)
    _NAMED[name] = made
    _USUAL.setdefault(record, made)
    return made


def picture(record: object, of: View | None = None) -> dict[str, Any]:
    """Return what JSON can hold of a record, as its usual view or another shows it."""
    of = of or _USUAL[type(record)]
    return {
        name: _plain(attrgetter(path)(record), of.below.get(name))
        for name, path in of.paths.items()
    }


def answer(record: object, of: View | None = None) -> JSONResponse:
    """Return the answer that shows a record."""
    return JSONResponse(picture(record, of))


def four(vector: NDArray[np.float64]) -> dict[str, float | None]:
    """Return a 4-vector in numeric units under its names and in the units of every boundary."""
    values = (vector * BOUNDARY_SCALE).tolist()
    return {name: finite(value) for name, value in zip(PARAMETERS, values, strict=True)}


def finite(value: float) -> float | None:
    """Return the number, or None where it is not finite."""
    return value if math.isfinite(value) else None


def _plain(value: Any, of: View | None) -> Any:  # noqa: ANN401  any value of a record
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, float):
        return finite(value)
    if isinstance(value, Misregistration):
        return four(value.vector)
    if isinstance(value, np.ndarray):
        return four(value)
    if isinstance(value, tuple | list):
        return [_plain(entry, of) for entry in value]
    if isinstance(value, Mapping):
        return {key: _plain(entry, of) for key, entry in value.items()}
    return picture(value, of)


def _service_of(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


def _fits_of(request: Request) -> Fits:
    fits: Fits = request.app.state.fits
    return fits


ServiceDep = Annotated[Service, Depends(_service_of)]
"""The service a route works for."""

FitsDep = Annotated[Fits, Depends(_fits_of)]
"""The desk a route works for."""


# --- the OpenAPI document


def shows(of: View) -> dict[str, Any]:
    """Return the OpenAPI description of an answer that shows a record."""
    schema = {"$ref": f"{_SCHEMAS}{of.name}"}
    content = {"application/json": {"schema": schema}}
    return {"description": "Successful Response", "content": content}


def schemas() -> dict[str, Schema]:
    """Return the schemas of all views, and of what they hold, by name."""
    found: dict[str, Schema] = {"FourView": _FOUR}
    for of in _NAMED.values():
        properties = {}
        for name, path in of.paths.items():
            kind, text = _field(of.record, path)
            properties[name] = _schema(kind, of.below.get(name), found)
            if text:
                properties[name] = {**properties[name], "description": _for_readers(text)}
        found[of.name] = {
            "type": "object",
            "description": _for_readers(of.text),
            "properties": properties,
            "required": list(properties),
        }
    return found


_SCHEMAS = "#/components/schemas/"
_NUMBER: Schema = {"anyOf": [{"type": "number"}, {"type": "null"}]}
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


def _schema(kind: Any, of: View | None, found: dict[str, Schema]) -> Schema:  # noqa: ANN401  a type
    """Return the schema of a type; those of alternatives that it holds are added to ``found``."""
    origin, inside = get_origin(kind), get_args(kind)
    if kind in _OF_KIND:
        return _OF_KIND[kind]
    if origin in {Union, UnionType}:
        schema = _schema(next(one for one in inside if one is not NoneType), of, found)
        return schema if schema == _NUMBER else {"anyOf": [schema, {"type": "null"}]}
    if kind is Misregistration or origin is np.ndarray:
        return {"$ref": f"{_SCHEMAS}FourView"}
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
        return {"$ref": f"{_SCHEMAS}{kind.__name__}"}
    return {"$ref": f"{_SCHEMAS}{(of or _USUAL[kind]).name}"}


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
    hints = get_type_hints(record) if is_dataclass(record) else {}
    tree = ast.parse(textwrap.dedent(inspect.getsource(record)))
    texts = {}
    (body,) = (node.body for node in tree.body if isinstance(node, ast.ClassDef))
    for statement, after in pairwise([*body, ast.Pass()]):
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


def _for_readers(text: str) -> str:
    """Return a record's description as it is true of JSON: null, four names, boundary units."""
    text = re.sub(r"\b(None|NaN)\b", "null", text.partition("\n\n")[0])
    return re.sub(r"``\(4,\)`` |,? ?numeric units( \([^)]*\))?", "", text)
