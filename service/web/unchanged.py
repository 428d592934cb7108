"""What a client has already is not sent again: an ETag on each answer, 304 where it is the same."""

from __future__ import annotations

from hashlib import blake2b
from http import HTTPStatus
from typing import Any

from fastapi import Request, Response
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import Message, Receive, Scope, Send
from typing_extensions import override

from service.web.connections import Middleware

NOT_MODIFIED: dict[str, Any] = {
    "description": "It is what `If-None-Match` names: the client has it already",
    "headers": {"ETag": {"description": "Of the answer", "schema": {"type": "string"}}},
}
"""The OpenAPI description of an answer without a body."""

_KEPT = "private, no-cache"
"""A browser keeps an answer and asks each time whether it still holds; nobody between does."""


def tag_of(*parts: object) -> str:
    """Return a weak ETag that differs when one of the parts does."""
    return f'W/"{blake2b(repr(parts).encode(), digest_size=12).hexdigest()}"'


def has_already(headers: Headers, tag: str) -> bool:
    """Return whether a request says that the client has what carries this ETag."""
    sent = {one.strip().removeprefix("W/") for one in headers.get("if-none-match", "").split(",")}
    return "*" in sent or tag.removeprefix("W/") in sent


def not_modified(request: Request, tag: str) -> Response | None:
    """Return the answer that nothing has changed, None: what it asks for has to be made."""
    if not has_already(request.headers, tag):
        return None
    headers = {"ETag": tag, "Cache-Control": _KEPT}
    return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)


class Unchanged(Middleware):
    """Gives every JSON document an ETag, and sends it only to a client that has another one.

    What comes bit by bit passes as it is, and so does what has an ETag of its own and is no JSON.
    """

    @override
    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        asked, head = Headers(scope=scope), None

        async def sent(message: Message) -> None:
            nonlocal head
            if message["type"] == "http.response.start" and _can_be_kept(scope, message):
                head = message
                return None
            if head is None:
                return await send(message)
            begun, head = head, None
            if message.get("more_body", False):
                await send(begun)
                return await send(message)
            headers = MutableHeaders(scope=begun)
            tag = headers.setdefault("ETag", tag_of(message["body"]))
            headers.setdefault("Cache-Control", _KEPT)
            if has_already(asked, tag):
                begun["status"], message["body"] = HTTPStatus.NOT_MODIFIED.value, b""
                del headers["content-length"], headers["content-type"]
            await send(begun)
            return await send(message)

        await self._app(scope, receive, sent)


def _can_be_kept(scope: Scope, start: Message) -> bool:
    is_json = Headers(raw=start["headers"]).get("content-type", "") == "application/json"
    return scope["method"] == "GET" and start["status"] == HTTPStatus.OK and is_json
