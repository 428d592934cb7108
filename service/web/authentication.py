"""Check the host, the origin and the API key of each HTTP request.

A page of another site, open in an operator's browser, can send requests to this service: from its
own origin, or under a host name that its owner resolves to this address (DNS rebinding). Both are
refused. Programs send no ``Origin``. Once there are API keys, each request needs one whose scope
covers that of the route.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from ipaddress import ip_address
from typing import Annotated

import structlog
from fastapi import APIRouter, Path, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.routing import APIRoute, RouteContext, iter_route_contexts
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from typing_extensions import override

from service.archive import Actor, AuditEntry, Channel
from service.errors import ConfigurationError, UnknownIdError
from service.web.connections import UNAVAILABLE_RETRY_S, Middleware, bounded, to_its_end
from service.web.keys import Key, KeyFile, KeyScope
from service.web.problems import INVALID, UNKNOWN, problem
from service.web.views import answer, define_view, held, shows
from service.wire.access import is_loopback

COOKIE = "pyrcal_key"
"""Name of the cookie in which a browser keeps the key."""

MAX_AUDITED_REFUSALS, AUDIT_PERIOD_S = 20, 60.0
"""Largest number of refusals in the audit trail within this period, seconds; the others are
counted. The trail is never shortened."""

MAX_HEADERS = 100
"""Headers of a request; browsers send about twenty, proxies a few more."""

_CLOSE_CONNECTION = {"Connection": "close"}
"""Header that closes the connection: after a malformed request its other bytes are unreliable."""

_READS = {"GET", "HEAD", "OPTIONS"}
_OWN_SITES = {"same-origin", "none"}

_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:\d{1,5})?", re.IGNORECASE)

_PORTS = {"http": ":80", "https": ":443"}
"""Default ports, which an origin may omit."""

Security = dict[str, list[dict[str, list[str]]]]

OPEN: Security = {"security": []}
"""``openapi_extra`` of a route that needs no key."""


def needs(scope: KeyScope) -> Security:
    """Return ``openapi_extra`` of a route that needs a key of this scope."""
    return {"security": [{scheme: [scope.value]} for scheme in SCHEMES]}


SCHEMES: dict[str, dict[str, str]] = {
    "bearer": {"type": "http", "scheme": "bearer", "description": "An API key"},
    "cookie": {
        "type": "apiKey",
        "in": "cookie",
        "name": COOKIE,
        "description": "The same, kept by a browser that logged in; orders need its Origin, too",
    },
}
"""Ways to send a key, as in OpenAPI. Loopback needs none as long as no key exists."""


def scope_of(route: RouteContext, method: str) -> KeyScope | None:
    """Return the scope that a route needs; None if it needs no key.

    By default a method that only reads needs ``read``, any other ``operate``. Files of the page are
    served without a key.
    """
    if not isinstance(route.original_route, APIRoute):
        return None
    security = (route.openapi_extra or {}).get("security")
    if security is None:
        return KeyScope.READ if method in _READS else KeyScope.OPERATE
    return KeyScope(security[0]["bearer"][0]) if security else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Hosts:
    """Host names and addresses that requests may name; loopback is always allowed."""

    bound: str = "127.0.0.1"
    """Address that the service listens on. If it listens on all interfaces, any numeric address is
    allowed: only host names can be rebound."""

    allowed: tuple[str, ...] = ()
    """Further host names, without a port."""

    @property
    def local(self) -> bool:
        """Return True if only this machine can connect."""
        return is_loopback(self.bound)

    def know(self, host: str) -> bool:
        """Return whether the value of a ``Host`` header is allowed."""
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        # A trailing dot names the same host.
        name = match[1].strip("[]").rstrip(".").lower()
        if name in {"localhost", self.bound.lower(), *(n.lower() for n in self.allowed)}:
            return True
        try:
            return ip_address(name).is_loopback or ip_address(self.bound).is_unspecified
        except ValueError:
            return False


@dataclass(frozen=True, slots=True)
class Refusal:
    """Reason why a request is refused, and its HTTP status."""

    status: HTTPStatus
    kind: str
    """Type of the problem in the response."""

    detail: str
    headers: Mapping[str, str] = field(default_factory=dict)
    who: str = ""
    """Name of the key in the request; empty if it had no valid one."""


class RefusalLog:
    """Record of refused requests in the audit trail, limited in rate.

    Parameters
    ----------
    audit
        Stores an entry of the trail.
    """

    def __init__(self, audit: Callable[[AuditEntry], object]) -> None:
        self._audit = audit
        self._since_s = -AUDIT_PERIOD_S
        self._remaining = self._n_omitted = 0

    def record(self, request: Request, refusal: Refusal) -> None:
        """Add a refusal to the audit trail, or count it if the trail has enough of this period."""
        now_s = time.monotonic()
        if now_s - self._since_s >= AUDIT_PERIOD_S:
            self._since_s, self._remaining = now_s, MAX_AUDITED_REFUSALS
        if self._remaining == 0:
            self._n_omitted += 1
            return
        self._remaining -= 1
        more = f"; {self._n_omitted} more were refused meanwhile" if self._n_omitted else ""
        self._n_omitted = 0
        address = address_of(request)
        entry = AuditEntry(
            t_ns_utc=time.time_ns(),
            who=refusal.who or address or "somebody",
            name=f"request.{refusal.kind}",
            text=f"{request.method} {request.url.path:.200}",
            address=address,
            channel=channel_of(request),
            answer=f"{refusal.status}: {refusal.detail}{more}",
        )
        structlog.get_logger().warning(
            "api.refused", kind=entry.name, who=entry.who, asked=entry.text, answer=entry.answer
        )
        self._audit(entry)


def address_of(request: Request) -> str:
    """Return the address of a client; empty if it is unknown."""
    return "" if request.client is None else request.client.host


def actor_of(request: Request) -> Actor:
    """Return the sender of an admitted request, for the audit trail."""
    key: Key | None = request.user
    return Actor(
        address=address_of(request),
        key="" if key is None else key.name,
        channel=channel_of(request),
    )


def channel_of(request: Request) -> Channel:
    """Return the interface that a request used: the page, the command line, or REST."""
    sent = request.headers
    if "origin" in sent or "sec-fetch-site" in sent:  # only browsers send these
        return Channel.PAGE
    return Channel.CLI if sent.get("user-agent", "").startswith("pyrcal") else Channel.REST


class Authentication(Middleware):
    """Middleware that passes on permitted requests, each with its whole body.

    ``request.user`` is then the key of the request, or None if there are no keys or none is needed.
    As soon as a key has existed, one is required from every address: a request from loopback may
    come through a proxy or from any account on this machine; and revoking the last key does not
    lift the requirement.

    Parameters
    ----------
    app
        The application.
    hosts
        Host names that requests may name.
    keys
        Existing keys; None if none is required.
    audit
        Stores an entry of the audit trail.
    """

    def __init__(
        self,
        app: ASGIApp,
        hosts: Hosts,
        keys: KeyFile | None,
        audit: Callable[[AuditEntry], object],
    ) -> None:
        super().__init__(app)
        self._hosts = hosts
        self._keys = keys
        self._refusals = RefusalLog(audit)
        self._routes: tuple[RouteContext, ...] = ()
        self._trouble = ""

    @override
    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        await to_its_end(self._admit, scope, receive, send)

    async def _admit(self, scope: Scope, receive: Receive, send: Send) -> None:
        request, scope["user"] = Request(scope), None
        refusal = self._check_origin(request)
        if refusal is None and (needed := self._scope_of(request)) is not None:
            scope["user"], refusal = self._check_key(request, needed)
            send = self._while_valid(scope["user"], send)
        if refusal is not None:
            self._refusals.record(request, refusal)
            fields = (refusal.status, refusal.kind, refusal.detail, refusal.headers)
            return await problem(request, *fields)(scope, receive, send)
        return await bounded(self._app, scope, receive, send)

    def _check_origin(self, request: Request) -> Refusal | None:
        """Return why host or origin of a request are refused, or None."""
        if (refusal := _check_headers(request)) is not None:
            return refusal
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if not self._hosts.know(host):
            detail = (
                f"found Host {host!r:.100}, expected localhost or the address this service listens "
                "on; name others in the settings, api.allowed_hosts"
            )
            return Refusal(HTTPStatus.MISDIRECTED_REQUEST, "foreign-host", detail)
        if origin is not None and not _same(origin.lower(), host.lower()):
            detail = (
                f"found Origin {origin!r:.100}, expected none or http://{host}: a page from "
                "elsewhere cannot use this service"
            )
            return Refusal(HTTPStatus.FORBIDDEN, "foreign-origin", detail)
        site = request.headers.get("sec-fetch-site", "same-origin").lower()
        # Links from other pages may be followed. Orders need an origin, or a browser could be made
        # to send them without one.
        if request.method not in _READS and origin is None and site not in _OWN_SITES:
            detail = (
                f"found Sec-Fetch-Site {site!r:.100} and no Origin, expected a request of this "
                "page or of a program: a page from elsewhere cannot use this service"
            )
            return Refusal(HTTPStatus.FORBIDDEN, "foreign-origin", detail)
        return None

    def _check_key(self, request: Request, needed: KeyScope) -> tuple[Key | None, Refusal | None]:
        """Return the key of a request, and the refusal if it does not permit the request."""
        secret, by_cookie = read_key(request)
        try:
            if self._keys is None or self._is_valid(None):
                return None, None
            key = None if secret is None else self._keys.key_of(secret)
        except ConfigurationError as error:
            if self._trouble != str(error):  # logged once, not with each request
                self._trouble = str(error)
                structlog.get_logger().error("api.keys", text=self._trouble)
            detail = "the file of the API keys cannot be read; the service's log says more"
            later = {"Retry-After": str(UNAVAILABLE_RETRY_S)}
            return None, Refusal(HTTPStatus.SERVICE_UNAVAILABLE, "keys", detail, later)
        if key is None:
            return None, _without_key(needed, shown=secret is not None)
        if not key.scope.covers(needed):
            detail = f"key {key.name} is of scope {key.scope}, this needs one of scope {needed}"
            headers = _challenge(f', error="insufficient_scope", scope="{needed}"')
            return key, Refusal(HTTPStatus.FORBIDDEN, "scope", detail, headers, key.name)
        # Browsers send a cookie by themselves; only a page's script sends an Origin with it.
        if by_cookie and request.method not in _READS and "origin" not in request.headers:
            detail = "found a browser's cookie and no Origin, expected both: is it this page's?"
            return key, Refusal(HTTPStatus.FORBIDDEN, "foreign-origin", detail, who=key.name)
        return key, None

    def _scope_of(self, request: Request) -> KeyScope | None:
        """Return the scope that a request needs; None if it needs no key."""
        self._routes = self._routes or tuple(iter_route_contexts(request.app.routes))
        for route in self._routes:
            if route.path_regex.match(request.scope["path"]) and (
                route.methods is None or request.method in route.methods
            ):
                return scope_of(route, request.method)
        # Unknown paths need a key, too, so that they do not show which routes exist.
        return KeyScope.READ if request.method in _READS else KeyScope.OPERATE

    def _while_valid(self, key: Key | None, send: Send) -> Send:
        """Return a sender that ends a streamed response as soon as its key is revoked."""
        ended = False

        async def sent(message: Message) -> None:
            nonlocal ended
            if ended:
                return
            if message.get("more_body", False):
                try:
                    # Asked with each part: a stream may stay open for days.
                    ended = not self._is_valid(key)
                # A file of keys that cannot be read permits nothing.
                except ConfigurationError:
                    ended = True
                if ended:
                    message = {"type": "http.response.body", "body": b"", "more_body": False}
            await send(message)

        return sent

    def _is_valid(self, key: Key | None) -> bool:
        """Return whether a key is valid now; for None, whether no key is required.

        Raises
        ------
        ConfigurationError
            If the file of keys cannot be read.
        """
        keys = () if self._keys is None else self._keys.all()
        if key is None:
            # The file remains when the last key is revoked: no keys in it is not the same as no
            # file.
            return self._keys is None or (self._hosts.local and not self._keys.path.exists())
        return key in keys


def _check_headers(request: Request) -> Refusal | None:
    """Return why the headers of a request are refused, or None."""
    n_headers = len(request.headers)
    if n_headers > MAX_HEADERS:
        detail = f"found {n_headers} headers, expected at most {MAX_HEADERS}"
        status = HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE
        return Refusal(status, "headers", detail, _CLOSE_CONNECTION)
    if {"content-length", "transfer-encoding"}.issubset(request.headers):
        # A proxy that uses one of them and a server that uses the other would see two different
        # requests (request smuggling).
        detail = "found Content-Length and Transfer-Encoding, expected one of them"
        return Refusal(HTTPStatus.BAD_REQUEST, "two-lengths", detail, _CLOSE_CONNECTION)
    return None


def _without_key(needed: KeyScope, *, shown: bool) -> Refusal:
    """Return the refusal of a request without a key, or with an invalid one."""
    expected = f"expected a key of scope {needed}"
    if not shown:
        detail = f"found no key, {expected}: Authorization: Bearer KEY, or log in at the page"
        return Refusal(HTTPStatus.UNAUTHORIZED, "no-key", detail, _challenge())
    detail = f"found a key that is none, or no longer, {expected}"
    headers = _challenge(', error="invalid_token"')
    return Refusal(HTTPStatus.UNAUTHORIZED, "wrong-key", detail, headers)


def read_key(request: Request) -> tuple[str | None, bool]:
    """Return the key in a request, or None, and whether it came as a cookie."""
    scheme, _, secret = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return secret.strip(), False
    return request.cookies.get(COOKIE), True


def _challenge(more: str = "") -> dict[str, str]:
    """Return the header that describes how to send a key (RFC 6750)."""
    return {"WWW-Authenticate": f'Bearer realm="pyrcal"{more}'}


def _same(origin: str, host: str) -> bool:
    scheme, _, authority = origin.partition("://")
    port = _PORTS.get(scheme)
    return port is not None and authority.removesuffix(port) == host.removesuffix(port)


# --- routes: the session of a browser, and the list of keys


router = APIRouter(prefix="/v1", tags=["access"], responses={**INVALID})

KeysDep = Annotated[KeyFile, held("keys")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """The key of a request and its scope."""

    name: str | None
    """Name of the key that was sent; null if there are no keys and none is needed."""

    scope: KeyScope
    """Scope of the key; "admin" if none is needed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Holders:
    """Names and scopes of the keys."""

    keys: tuple[Key, ...]


SESSION = define_view("SessionView", Session)
define_view("KeyView", Key, "name scope created_ns_utc", "An API key, without its secret.")
KEYS = define_view("KeysView", Holders)


@router.get("/session", responses={200: shows(SESSION)})
async def session(request: Request) -> Response:
    """Return the name and scope of the key."""
    key: Key | None = request.user
    if key is None:
        return _forbid_caching(answer(Session(name=None, scope=KeyScope.ADMIN)))
    return _forbid_caching(answer(Session(name=key.name, scope=key.scope)))


def _forbid_caching(answered: Response) -> Response:
    """Forbid browsers to cache a response about keys, because others may use the same browser."""
    answered.headers["Cache-Control"] = "no-store"
    return answered


@router.post("/session", openapi_extra=needs(KeyScope.READ), responses={200: shows(SESSION)})
async def log_in(request: Request) -> Response:
    """Store the key of ``Authorization`` in a cookie of the browser that scripts cannot read.

    The browser sends the cookie to this host only, never with requests from pages of other sites,
    and deletes it when it is closed.
    """
    answered = await session(request)
    secret, _ = read_key(request)
    if request.user is not None and secret is not None:
        # Behind a proxy the request comes over http: the origin shows how the browser reached it.
        safe = request.url.scheme == "https" or request.headers.get("origin", "")[:6] == "https:"
        answered.set_cookie(COOKIE, secret, secure=safe, httponly=True, samesite="strict")
        request.app.state.service.audit(actor_of(request).entry("session.begun"))
    return answered


@router.delete("/session", status_code=204, openapi_extra=OPEN)
async def log_out(response: Response) -> None:
    """Delete the cookie with the key."""
    response.delete_cookie(COOKIE, httponly=True, samesite="strict")


@router.get("/keys", openapi_extra=needs(KeyScope.ADMIN), responses={200: shows(KEYS)})
async def keys(request: Request, file: KeysDep) -> Response:
    """Return the names and scopes of all keys."""
    return _forbid_caching(answer(Holders(keys=file.all() if request.user is not None else ())))


@router.delete(
    "/keys/{name}", status_code=204, openapi_extra=needs(KeyScope.ADMIN), responses=UNKNOWN
)
async def revoke(
    request: Request, file: KeysDep, name: Annotated[str, Path(description="Name of the key")]
) -> None:
    """Revoke a key at once, open streams included."""
    if request.user is None:
        raise UnknownIdError(f"key {name!r:.80}: no such key; there are none at all")
    await run_in_threadpool(file.revoke, name)
    request.app.state.service.audit(actor_of(request).entry("key.revoked", name))
