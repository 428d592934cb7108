"""OpenAPI document of the service: FastAPI's own, with what only the source and other tables have.

FastAPI describes routes, parameters and response models. Added are the descriptions of records'
fields, which are docstrings in their source, the bodies of orders, API keys and ETags. The service
serves the file that is written here; it does not read its own source.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping
from functools import cache
from itertools import pairwise
from typing import Any, cast

from fastapi import FastAPI
from fastapi.routing import APIRoute, iter_route_contexts
from pydantic import AliasPath, TypeAdapter

from service.api import create_app
from service.records import commands
from service.runtime import telemetry_recorder
from service.web import matrices, problems
from service.web.authentication import OPEN, SCHEMES, needs, scope_of
from service.web.commands import JSON, Body
from service.web.connections import NOT_MODIFIED
from service.web.views import View, clock_of, owner_of

Schema = dict[str, Any]
"""A JSON schema."""

SCHEMAS = "#/components/schemas/"


def document() -> dict[str, Any]:
    """Return the OpenAPI document of all routes, those of fits included."""
    nobody: Any = object()  # no request is answered
    app = create_app(nobody, nobody)
    found = app.openapi()
    known = found["components"]["schemas"]
    known["Problem"] = problems.Problem.model_json_schema()
    for view in View.__subclasses__():
        _describe_fields(view, known[view.__name__])
    _tell_bodies(app, found)
    found["components"]["securitySchemes"] = SCHEMES
    _tell_scopes(app, found)
    for operations in found["paths"].values():
        for method, operation in operations.items():
            _tell_operation(method, operation, known)
    return found


def _describe_fields(view: type[View], schema: Schema) -> None:
    """Add the descriptions of a view's fields, which are those of its record."""
    schema["description"] = _for_readers(schema["description"])
    for name, field in view.model_fields.items():
        steps = [str(step) for step in cast(AliasPath, field.validation_alias).path]
        text = _texts_of(owner_of(view.record, steps)).get(steps[-1], "")
        if text:
            schema["properties"][name].setdefault("description", _for_readers(text))
        if clock := clock_of(name):
            schema["properties"][clock]["description"] = f"``{name}`` by the clock."


def _tell_bodies(app: FastAPI, document: dict[str, Any]) -> None:
    """Say of each operation what it reads."""
    read = {
        f"{method.lower()} {route.path_format}": found.call
        for route in iter_route_contexts(app.routes)
        if isinstance(route.original_route, APIRoute)
        for found in route.dependant.dependencies
        for method in route.methods or ()
        if isinstance(found.call, Body)
    }
    bodies, schemas = _bodies(read)
    for operation, body in bodies.items():
        method, _, path = operation.partition(" ")
        document["paths"][path][method]["requestBody"] = body
    document["components"]["schemas"] |= schemas


def _tell_scopes(app: FastAPI, document: dict[str, Any]) -> None:
    """Say of each operation which key it needs."""
    for route in iter_route_contexts(app.routes):
        for method in route.methods or () if route.path_format in document["paths"] else ():
            scope = scope_of(route, method)
            security = OPEN if scope is None else needs(scope)
            document["paths"][route.path_format][method.lower()] |= security


def _tell_operation(method: str, operation: dict[str, Any], known: dict[str, Any]) -> None:
    """Say in one line what an operation does, what its answers are, and which are not sent again.

    FastAPI's own summary is the name of a function.
    """
    first, _, rest = operation["description"].partition("\n\n")
    operation["summary"] = " ".join(first.split()).rstrip(".")
    operation["description"] = rest or first
    answers = operation["responses"]
    for found in answers.values():
        contents = found.get("content", {}).values()
        names = [one["schema"].get("$ref", "").rpartition("/")[2] for one in contents]
        if found["description"] == "Successful Response":
            told = known.get(names[0], {}) if names else {}
            found["description"] = told.get("description", "Done").partition("\n\n")[0]
        if any(name.endswith("AcceptedView") for name in names):
            found["headers"] = {"Location": _LOCATION}
    kept = answers.get("200", {}).get("content", {}).keys()
    if method == "get" and kept & _HAVE_TAGS:
        answers["304"] = NOT_MODIFIED


_HAVE_TAGS = {"application/json", *matrices.MEDIA_TYPES.values()}
"""Kinds of answers with an ETag."""

_LOCATION = {
    "description": "Where to look for what was begun",
    "schema": {"type": "string", "format": "uri-reference"},
}


def _bodies(by_operation: Mapping[str, Body]) -> tuple[dict[str, Schema], dict[str, Schema]]:
    """Return request bodies by operation, and the schemas of all that they hold by name."""
    found, document = TypeAdapter.json_schemas(
        [(name, "validation", body.adapter) for name, body in by_operation.items()],
        ref_template=f"{SCHEMAS}{{model}}",
    )
    requests = {
        name: {
            "content": {JSON: {"schema": found[name, "validation"]}},
            "required": body.required,
        }
        for name, body in by_operation.items()
    }
    schemas: dict[str, Schema] = document.get("$defs", {})
    records = vars(commands) | vars(telemetry_recorder)
    for name, schema in schemas.items():
        texts = _texts_of(records[name]) if "properties" in schema else {}
        if "action" in schema.get("properties", ()):  # what tells alternatives apart
            schema["required"] = [*schema.get("required", ()), "action"]
        for field, text in texts.items():
            if field in schema["properties"]:
                schema["properties"][field]["description"] = _for_readers(text)
    return requests, schemas


@cache
def _texts_of(record: type) -> dict[str, str]:
    """Return the docstrings of a record's fields and properties, by name."""
    texts = {}
    for statement, after in pairwise([*_statements(record), ast.Pass()]):
        match statement, after:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(
                value=ast.Constant(value=str(text))
            ):
                texts[name] = inspect.cleandoc(text)
            case ast.FunctionDef(name=name), _ if isinstance(getattr(record, name), property):
                texts[name] = ast.get_docstring(statement) or ""
            case _:
                pass
    return texts


def _statements(record: type) -> Iterator[ast.stmt]:
    """Yield what the source of a record says, of those it is derived from first."""
    for base in reversed(record.__mro__[:-1]):
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        yield from tree.body if isinstance(tree, ast.ClassDef) else ()


def _for_readers(text: str) -> str:
    """Return a record's description as it is true of JSON: null, four names, boundary units."""
    text = re.sub(r"\b(None|NaN)\b", "null", text.partition("\n\n")[0])
    return re.sub(r"``\(4,\)`` |,? ?numeric units( \([^)]*\))?", "", text)
