"""Errors as ``application/problem+json`` (RFC 9457)."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import iter_route_contexts
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException

from service import errors

MEDIA_TYPE = "application/problem+json"

_OF_ERROR: dict[type[errors.PyrcalError], tuple[HTTPStatus, str]] = {
    errors.UnknownIdError: (HTTPStatus.NOT_FOUND, "unknown-id"),
    errors.StaleError: (HTTPStatus.PRECONDITION_FAILED, "stale"),
    errors.UntaggedError: (HTTPStatus.PRECONDITION_REQUIRED, "if-match"),
    errors.TooLargeError: (HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "too-large"),
    errors.TooSlowError: (HTTPStatus.REQUEST_TIMEOUT, "too-slow"),
    errors.BusyError: (HTTPStatus.SERVICE_UNAVAILABLE, "busy"),
    errors.MatrixError: (HTTPStatus.UNPROCESSABLE_ENTITY, "unusable-matrix"),
    errors.CommandError: (HTTPStatus.CONFLICT, "not-now"),
    errors.LinkError: (HTTPStatus.GATEWAY_TIMEOUT, "rtc-silent"),
    errors.StorageError: (HTTPStatus.INSUFFICIENT_STORAGE, "archive-failed"),
    errors.ArchiveError: (HTTPStatus.INTERNAL_SERVER_ERROR, "archive"),
    errors.PyrcalError: (HTTPStatus.INTERNAL_SERVER_ERROR, "internal"),
}

BUSY_RETRY_S = 30
"""``Retry-After`` when too much is under way, seconds: a fit takes that long."""


class Problem(BaseModel):
    """An error: what went wrong and what to do about it."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    type: str
    """``urn:pyrcal:problem:<kind>``; the kind is stable, a program may branch on it."""

    title: str
    """The HTTP status in words."""

    status: int
    """The HTTP status."""

    detail: str
    """Description: what was found and what was expected."""

    instance: str
    """Path of the request."""

    @classmethod
    def of(cls, status: HTTPStatus, kind: str, detail: str, instance: str) -> Problem:
        """Return a problem of this ``kind``."""
        return cls(
            type=f"urn:pyrcal:problem:{kind}",
            title=status.phrase,
            status=status,
            detail=detail,
            instance=instance,
        )


def problem_response(description: str) -> dict[str, Any]:
    """Return the OpenAPI description of an error response."""
    return {
        "description": description,
        "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
    }


Responses = dict[int | str, dict[str, Any]]
"""OpenAPI descriptions by HTTP status."""

INVALID: Responses = {422: problem_response("A parameter or a field of the body cannot be used")}
EVERYWHERE: Responses = {
    400: problem_response("Content-Length and Transfer-Encoding were sent together"),
    401: problem_response("A key is needed, and none was given, or a wrong one"),
    403: problem_response("The key's scope does not allow it, or another site's page has sent it"),
    408: problem_response("The request did not come in time"),
    413: problem_response("The body is larger than this service takes"),
    421: problem_response("Host is a name that this service does not know"),
    431: problem_response("More headers than this service takes"),
}
UNKNOWN: Responses = {404: problem_response("No such thing")}
DECISION: Responses = {
    412: problem_response("It has changed: If-Match names another ETag"),
    428: problem_response("Prefer: handling=strict was sent, and no If-Match"),
}
COMMAND: Responses = {
    409: problem_response("Cannot be carried out in the present state"),
    504: problem_response("The RTC does not answer"),
    507: problem_response("It cannot be recorded: the disk refuses; nothing has been done"),
}


def problem(
    request: Request,
    status: HTTPStatus,
    kind: str,
    detail: str,
    headers: Mapping[str, str] | None = None,
) -> JSONResponse:
    """Return a problem of this ``kind``."""
    body = Problem.of(status, kind, detail, request.url.path)
    return JSONResponse(
        body.model_dump(), status_code=status, headers=headers, media_type=MEDIA_TYPE
    )


def install(app: FastAPI) -> None:
    """Make every error of ``app`` a problem."""
    app.exception_handler(errors.PyrcalError)(_known)
    app.exception_handler(RequestValidationError)(_invalid)
    app.exception_handler(HTTPException)(_http)
    app.exception_handler(Exception)(_fault)


def known_problem(request: Request, error: errors.PyrcalError) -> JSONResponse:
    """Return the problem that an error of this service is."""
    # The nearest class counts: StorageError is an ArchiveError, too.
    status, kind = next(_OF_ERROR[cls] for cls in type(error).__mro__ if cls in _OF_ERROR)
    later = {"Retry-After": str(BUSY_RETRY_S)} if status is HTTPStatus.SERVICE_UNAVAILABLE else None
    return problem(request, status, kind, str(error), later)


async def _known(request: Request, error: errors.PyrcalError) -> JSONResponse:
    return known_problem(request, error)


async def _invalid(request: Request, error: RequestValidationError) -> JSONResponse:
    detail = "; ".join(_line(e) for e in error.errors())
    return problem(request, HTTPStatus.UNPROCESSABLE_ENTITY, "invalid", detail)


def _line(error: Mapping[str, Any]) -> str:
    where = ".".join(str(part) for part in error["loc"])
    if error["type"] in {"extra_forbidden", "unexpected_keyword_argument"}:
        return f"{where}: unknown"
    if error["type"] == "union_tag_not_found":
        return f"{where}.{error['ctx']['discriminator'].strip(chr(39))}: missing"
    if error["type"] == "missing":
        return f"{where}: missing"
    if error["type"] == "json_invalid":
        return f"{where}: not JSON: {error['ctx']['error']}"
    if isinstance(error["input"], bytes):
        return f"{where}: expected JSON with Content-Type: application/json"
    expected = error["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    if expected.startswith("found "):
        return f"{where}: {expected}"
    return f"{where}: found {error['input']!r:.80}, expected {expected}"


async def _http(request: Request, error: HTTPException) -> JSONResponse:
    status = HTTPStatus(error.status_code)
    detail = {
        HTTPStatus.NOT_FOUND: f"there is nothing at {request.url.path}",
        HTTPStatus.METHOD_NOT_ALLOWED: f"{request.method} is not possible at {request.url.path}",
    }.get(status, error.detail)
    headers = dict(error.headers or {})
    if status is HTTPStatus.METHOD_NOT_ALLOWED:  # Starlette names those of one route
        headers["Allow"] = ", ".join(sorted(_methods(request)))
    return problem(request, status, "http", detail, headers)


def _methods(request: Request) -> set[str]:
    """Return the methods there are at the path of a request."""
    routes = iter_route_contexts(request.app.routes)
    path = request.scope["path"]
    return {m for r in routes if r.path_regex.match(path) for m in r.methods or ()}


async def _fault(request: Request, _error: Exception) -> JSONResponse:
    # Without the exception's text, which may hold paths or data.
    detail = "a fault of the service itself; its log says more"
    return problem(request, HTTPStatus.INTERNAL_SERVER_ERROR, "internal", detail)
