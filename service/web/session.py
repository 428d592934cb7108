"""Who asks, a browser that keeps a key, and whose keys there are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.errors import UnknownIdError
from service.web.authentication import COOKIE, OPEN, actor_of, needs, shown_key
from service.web.keys import Key, KeyFile, KeyScope
from service.web.problems import INVALID, UNKNOWN
from service.web.views import answer, define_view, shows

router = APIRouter(prefix="/v1", tags=["who may ask"], responses={**INVALID})


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """Whoever asks."""

    name: str | None
    """Of the key that was shown; null: there are no keys, and none is needed."""

    scope: KeyScope
    """What may be asked with it; "admin" where none is needed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Holders:
    """Who may ask."""

    keys: tuple[Key, ...]


SESSION = define_view("SessionView", Session)
define_view(
    "KeyView", Key, "name scope created_ns_utc", "A key, but for what only its owner knows."
)
KEYS = define_view("KeysView", Holders)


@router.get("/session", responses={200: shows(SESSION)})
async def session(request: Request) -> Response:
    """Return whose key was shown, and what may be asked with it."""
    key: Key | None = request.user
    if key is None:
        return answer(Session(name=None, scope=KeyScope.ADMIN))
    return answer(Session(name=key.name, scope=key.scope))


@router.post("/session", openapi_extra=needs(KeyScope.READ), responses={200: shows(SESSION)})
async def log_in(request: Request) -> Response:
    """Have the browser that shows a key in ``Authorization`` keep it, out of reach of scripts.

    The cookie goes to this host alone, with nothing that another site's page asks for, and lasts
    until the browser is closed.
    """
    answered = await session(request)
    secret, _ = shown_key(request)
    if request.user is not None and secret is not None:
        safe = request.headers.get("origin", "").startswith("https:")
        answered.set_cookie(COOKIE, secret, secure=safe, httponly=True, samesite="strict")
        request.app.state.service.audit(actor_of(request).entry("session.begun"))
    return answered


@router.delete("/session", status_code=204, openapi_extra=OPEN)
async def log_out(response: Response) -> None:
    """Have the browser forget the key."""
    response.delete_cookie(COOKIE, httponly=True, samesite="strict")


@router.get("/keys", openapi_extra=needs(KeyScope.ADMIN), responses={200: shows(KEYS)})
async def keys(request: Request) -> Response:
    """Return who may ask; ``pyrcal key add`` makes a key."""
    return answer(Holders(keys=_file(request).all() if request.user is not None else ()))


@router.delete(
    "/keys/{name}", status_code=204, openapi_extra=needs(KeyScope.ADMIN), responses=UNKNOWN
)
async def revoke(request: Request, name: Annotated[str, Path(description="Of the key")]) -> None:
    """Make a key worthless from this moment on, also where it has a stream open."""
    if request.user is None:
        raise UnknownIdError(f"key {name!r:.80}: no such key; there are none at all")
    await run_in_threadpool(_file(request).revoke, name)
    request.app.state.service.audit(actor_of(request).entry("key.revoked", name))


def _file(request: Request) -> KeyFile:
    file: KeyFile = request.app.state.keys
    return file
