"""Commands as JSON: read straight into the records that the tracker obeys, all faults at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Request
from fastapi.exceptions import RequestValidationError
from pydantic import TypeAdapter, ValidationError
from pydantic_core import from_json

from service.routes.views import Schema, explained
from service.tracking import commands
from service.tracking.commands import Instruction

JSON = "application/json"
_SCHEMAS = "#/components/schemas/{model}"

Command = TypeVar("Command", bound=Instruction)


class Body:
    """What a request has to say, as a command; a dependency of a route.

    Parameters
    ----------
    kind
        The command, or a union of several told apart by their ``action``.
    """

    def __init__(self, kind: Any) -> None:  # noqa: ANN401  of the type of a type
        self.adapter = TypeAdapter[Any](kind)
        self.required = not self._reads(b"{}")

    async def __call__(self, request: Request) -> Any:  # noqa: ANN401  the command
        """Return the command; without a body, one that leaves all to the service.

        Raises
        ------
        RequestValidationError
            If it is none: every fault, and where it is.
        """
        raw = await request.body()
        if not raw:
            if self.required:
                raise RequestValidationError([{"type": "missing", "loc": ("body",)}])
            raw = b"{}"
        elif request.headers.get("content-type", "").partition(";")[0].strip().lower() != JSON:
            # a page from elsewhere may send anything else without being asked
            raise RequestValidationError([{"type": "not_json", "loc": ("body",), "input": raw}])
        try:
            return self.adapter.validate_json(raw)
        except ValidationError as error:
            raise RequestValidationError(_faults(error, raw)) from None

    def _reads(self, raw: bytes) -> bool:
        try:
            self.adapter.validate_json(raw)
        except ValidationError:
            return False
        return True


def body(kind: Any) -> Any:  # noqa: ANN401  as FastAPI has it
    """Return what makes a parameter of a route the body of the request."""
    return Depends(Body(kind))


Said = Annotated[Instruction, body(Instruction)]
"""The body of a request whose path says all the rest."""


def about(kind: type[Command], said: Instruction, **more: str) -> Command:
    """Return the command that says the same, and what the path or the service adds."""
    return kind(**said.said(), **more)


Path = tuple[int | str, ...]


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a fault is in the JSON."""

    path: Path
    tried: tuple[tuple[Path, int | str], ...]
    """Alternatives of unions that led there, and where each union is."""


def _faults(error: ValidationError, raw: bytes) -> list[dict[str, Any]]:
    """Return all faults, each where it is in the body.

    Of a union only the alternatives count that fit best; pydantic names them all.
    """
    try:
        whole = from_json(raw)
    except ValueError:
        whole = None
    found = [
        (_place(fault["loc"], whole, missing=fault["type"] == "missing"), fault)
        for fault in error.errors(include_url=False)
    ]
    depths: dict[Path, dict[int | str, int]] = {}
    for place, _ in found:
        for where, branch in place.tried:
            deepest = depths.setdefault(where, {})
            deepest[branch] = max(deepest.get(branch, 0), len(place.path))
    joined: dict[Path, dict[str, Any]] = {}
    for place, fault in found:
        if any(depths[where][one] < max(depths[where].values()) for where, one in place.tried):
            continue
        before = joined.get(place.path)
        if before is None or (_is_of_type(before) and not _is_of_type(fault)):
            joined[place.path] = {**fault, "loc": ("body", *place.path)}
        elif _is_of_type(before):
            before["msg"] += f" or {fault['msg'].removeprefix('Input should be ')}"
    return list(joined.values())


def _place(loc: Path, value: Any, *, missing: bool) -> _Place:  # noqa: ANN401  as JSON has it
    path: Path = ()
    tried: list[tuple[Path, int | str]] = []
    for k, part in enumerate(loc):
        inside = isinstance(value, dict) and part in value
        if inside or (isinstance(value, list) and isinstance(part, int) and part < len(value)):
            value = value[part]
        elif not missing or k < len(loc) - 1:
            tried.append((path, part))
            continue
        path = (*path, part)
    return _Place(path, tuple(tried))


def _is_of_type(fault: Mapping[str, Any]) -> bool:
    """Return whether a fault is that the value is something else altogether."""
    kind: str = fault["type"]
    return kind == "enum" or kind.endswith("_type")


# --- the OpenAPI document


def bodies(by_operation: Mapping[str, Body]) -> tuple[dict[str, Schema], dict[str, Schema]]:
    """Return request bodies by operation, and the schemas of all that they hold by name."""
    found, document = TypeAdapter.json_schemas(
        [(name, "validation", body.adapter) for name, body in by_operation.items()],
        ref_template=_SCHEMAS,
    )
    requests = {
        name: {
            "content": {JSON: {"schema": found[name, "validation"]}},
            "required": body.required,
        }
        for name, body in by_operation.items()
    }
    schemas: dict[str, Schema] = document.get("$defs", {})
    for name, schema in schemas.items():
        texts = explained(vars(commands)[name]) if "properties" in schema else {}
        if "action" in schema.get("properties", ()):  # what tells alternatives apart
            schema["required"] = [*schema.get("required", ()), "action"]
        for field, text in texts.items():
            if field in schema["properties"]:
                schema["properties"][field]["description"] = text
    return requests, schemas
