"""What REST answers, as OpenAPI has it: of the routes, and of what records say of themselves.

The service hands out the file that is written here; it reads none of its own source.
"""

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
from fastapi import FastAPI
from fastapi.routing import APIRoute, iter_route_contexts
from pydantic import BaseModel, ConfigDict, TypeAdapter
from pydantic.json_schema import models_json_schema

from service.api import create_app
from service.model.misregistration import PARAMETERS, Misregistration
from service.runtime import telemetry_recorder
from service.tracking import commands
from service.web import matrices, problems
from service.web.authentication import OPEN, SCHEMES, needs, scope_of
from service.web.commands import JSON, Body
from service.web.connections import NOT_MODIFIED
from service.web.views import NAMED_VIEWS, SCHEMAS, USUAL_VIEWS, View

Schema = dict[str, Any]
"""A JSON schema."""


def document() -> dict[str, Any]:
    """Return what REST answers, with the desk for fits."""
    nobody: Any = object()  # neither is asked anything
    app = create_app(nobody, nobody)
    found = app.openapi()
    known = found["components"]["schemas"]
    known |= {"Problem": problems.Problem.model_json_schema()} | _views()
    _, of_fits = models_json_schema(
        [(kind, "serialization") for kind in (FitDocument, FitFigures)],
        ref_template=f"{SCHEMAS}{{model}}",
    )
    known |= of_fits["$defs"]
    _put_beside_the_four(known["FitDocument"])
    _tell_bodies(app, found)
    found["components"]["securitySchemes"] = SCHEMES
    _tell_scopes(app, found)
    for operations in found["paths"].values():
        for method, operation in operations.items():
            _tell_operation(method, operation, known)
    return found


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
        texts = _explained(records[name]) if "properties" in schema else {}
        if "action" in schema.get("properties", ()):  # what tells alternatives apart
            schema["required"] = [*schema.get("required", ()), "action"]
        for field, text in texts.items():
            if field in schema["properties"]:
                schema["properties"][field]["description"] = text
    return requests, schemas


def _views() -> dict[str, Schema]:
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
        "anamorphosis": {
            "type": "array",
            "items": {"type": "number"},
            "description": "Of a registration where it is followed: stretch along x over the mean "
            "of both axes, less 1, and along 45 deg.",
        },
    },
    "required": list(PARAMETERS),
}


def _put_beside_the_four(schema: Schema) -> None:
    """Add the four parameters of a registration to the keys they lie beside."""
    four = ((name, _FOUR["properties"][name]) for name in PARAMETERS)
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


def _explained(record: type) -> dict[str, str]:
    """Return what a record says of its fields, by name."""
    return {name: _for_readers(text) for name, text in _facts(record)[1].items()}


def _for_readers(text: str) -> str:
    """Return a record's description as it is true of JSON: null, four names, boundary units."""
    text = re.sub(r"\b(None|NaN)\b", "null", text.partition("\n\n")[0])
    return re.sub(r"``\(4,\)`` |,? ?numeric units( \([^)]*\))?", "", text)


# --- what a fit of a file answers: it is pyrcal/fitting's, and the service hands it on


class FitDocument(BaseModel):
    """What a fit has found: the object that ``pyrcal fit --json`` prints."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    sigma: dict[str, float | None]
    """1 σ of the four, by name; noise, disagreement of subsets and model error together."""

    covariance: list[list[float | None]]
    """4 x 4, in the units of the names."""

    gains: list[float | None]
    """Measured column over the model's, one for each mode used, passes divided out."""

    residual_fraction: float | None
    """RMS of what is left over RMS of the measurement."""

    condition_number: float | None
    """Of the synthetic matrix, modes used."""

    n_modes_used: int
    orientation: dict[str, Any]
    """Of the slopes, as the instrument file would say it."""

    subset_scatter: dict[str, float | None]
    """1 σ scatter of disjoint sets of modes, by name."""

    converged: bool
    verdict: str
    """Begins with "accepted" or "refused"; names what was left out."""

    registration: dict[str, Any] | None = None
    """Whether the registration is determined: determined, reason, sigma_statistical,
    sigma_systematic (by name), disjoint_sets."""

    reconstructor: dict[str, Any] | None = None
    """Whether the model's reconstructor holds the loop of the measured matrix: stable_modes of
    n_modes, gain, pole_radius, pole_radius_all, wavefront_ratio, noise_limited, reason."""

    anamorphosis: list[float] | None = None
    """Stretch of the mirror's image along x over the mean of both axes, less 1, and along 45 deg;
    null: the modes do not tell, or it was not to be fitted."""

    anamorphosis_sigma: list[float] | None = None
    """1 σ of both; null: it was not to be fitted."""

    image_offsets_px: list[list[float]] | None = None
    """Displacements [x, y] of a pyramid's four pupil images that were fitted, detector pixels, as
    `wfs.image_offsets_px` states them; null if the instrument file states them."""

    instrument_found: dict[str, dict[str, float | None]] = {}
    """What of the instrument was fitted, too, by its key: found, sigma, and as the file says it."""

    recommendation: str = ""
    """What to do with it, in one sentence: begins with "use it", "measure more" or "do not use"."""

    found_not_told: list[dict[str, Any]] = []
    unknown_not_found: list[str] = []
    """What the matrix has told: key, found, told (as the file says it), how, and whether to correct
    the file."""

    alternatives: list[dict[str, Any]] = []
    """What else might explain the matrix: words, misfit (χ² over the fit's; null: not comparable),
    moved (by name), moved_sigma, preferred, undecided."""

    left_over: dict[str, Any] | None = None
    """Where the residual is: border (over inside), subapertures and modes that stand out."""

    notes: list[str]
    """What was decided on the way, or overruled, and should be known."""

    seconds: float | None


class FitMap(BaseModel):
    """The signals of one mode: rows from the lowest y on, Sx beside Sy; null: not valid.

    Of pixels the four images, as they lie on the detector.
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    mode: int
    measured: list[list[int | None]]
    """Percent of three times the RMS of what was measured, cut there."""

    synthetic: list[list[int | None]]
    """The model's, gain applied, in the same unit."""


class FitFigures(BaseModel):
    """What the figures of a fit are drawn from."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    own_instrument: bool
    """Whether it is a fit of the service's own instrument, whose α it may be held against."""

    modes: list[int]
    """Basis indices of the modes used; ``gains`` of the fit are of these."""

    residual_by_mode: list[float | None]
    """RMS of what is left over RMS of the measurement, of each."""

    singular_values: dict[str, list[float | None]]
    """"measured" and "synthetic", each over its largest."""

    residual_map: list[list[int | None]]
    """What is left in each subaperture, percent of the measured RMS: rows from the lowest y on, Sx
    beside Sy; null: not valid."""

    maps: list[FitMap]
    """Of a few modes, the paper's where they were used."""
