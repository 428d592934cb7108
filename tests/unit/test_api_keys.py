"""Who may act: nobody without a key, with a wrong one or of another scope, from a foreign page."""

import asyncio
import re
from functools import cache
from http import HTTPStatus

import httpx
import pytest
from fastapi import Request

from pyrcal_studies.openapi import document
from service.api import create_app
from service.web import authentication, page
from service.web.authentication import COOKIE, Hosts, Refusal, RefusalLog
from service.web.keys import KeyFile, KeyScope
from tests.support.api import FakeService, a_snapshot, assert_problem
from tests.support.api_admission import serving

ORIGIN = "http://127.0.0.1:8080"
OPEN = {("GET", "/healthz"), ("GET", "/readyz"), ("DELETE", "/v1/session")}
"""What needs no key, of REST."""

OF_ADMINS = {("GET", "/v1/keys"), ("DELETE", "/v1/keys/{name}")}

FILES = {"/", "/docs", "/openapi.json", "/dashboard/page.js", "/docs/files/start.js"}
"""Files of the package; what is not listed here needs a key."""


@pytest.fixture
def service():
    return FakeService(a_snapshot())


@pytest.fixture
def keys(tmp_path):
    return KeyFile(tmp_path)


@pytest.fixture
def secrets(keys):
    return {scope: keys.add(f"{scope}er", scope) for scope in KeyScope}


def client_of(service, keys, hosts=None):
    app = create_app(service, object(), hosts=hosts or Hosts(), keys=keys)
    transport = httpx.ASGITransport(app, raise_app_exceptions=False, client=("10.0.0.7", 5))
    return httpx.AsyncClient(transport=transport, base_url=ORIGIN)


@pytest.fixture
async def client(service, keys, secrets):
    async with client_of(service, keys) as client:
        yield client


def bearer(secret, **more):
    return {"Authorization": f"Bearer {secret}", **more}


@cache
def operations():
    """Every operation of the OpenAPI: method, path, the scopes it says."""
    return list(_operations())


def _operations():
    for path, methods in document()["paths"].items():
        for method, operation in methods.items():
            yield method.upper(), path, operation["security"]


def as_asked(path):
    return re.sub(r"\{\w+\}", "x", path)


def test_every_route_says_which_scope_it_needs_and_what_needs_none_is_listed_here():
    assert len(operations()) > 40
    scopes = {}
    for method, path, security in operations():
        assert [set(one) for one in security] in ([], [{"bearer"}, {"cookie"}]), path
        said = {scope for one in security for (scope,) in one.values()}
        assert len(said) <= 1
        scopes[method, path] = KeyScope(said.pop()) if said else None
    assert {asked for asked, scope in scopes.items() if scope is None} == OPEN
    assert {asked for asked, scope in scopes.items() if scope is KeyScope.ADMIN} == OF_ADMINS
    for (method, path), scope in scopes.items():
        acts = method != "GET" and path != "/v1/session"
        assert not (acts and scope is KeyScope.READ), f"{method} {path} changes something"


async def test_a_route_that_says_nothing_is_no_open_one(service, keys, secrets):
    app = create_app(service, keys=keys)
    app.get("/v1/new")(lambda: {})
    app.post("/v1/new")(lambda: {})
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url=ORIGIN) as client:
        for send, scope in ((client.get, KeyScope.READ), (client.post, KeyScope.OPERATE)):
            assert (await send("/v1/new")).status_code == 401
            assert (await send("/v1/new", headers=bearer(secrets[scope]))).status_code == 200
        assert_problem(await client.post("/v1/new", headers=bearer(secrets["read"])), 403, "scope")


async def test_without_key_with_a_wrong_one_or_from_a_foreign_page_0_succeed_and_each_is_told(
    client, service, secrets, monkeypatch
):
    """Every operation, asked in every way that must not do."""
    ways = [
        ({}, 401, "no-key"),
        ({"Authorization": "Basic YTpi"}, 401, "no-key"),
        (bearer("pyrcal_wrong"), 401, "wrong-key"),
        ({"Cookie": f"{COOKIE}=pyrcal_wrong"}, 401, "wrong-key"),
        (bearer(secrets[KeyScope.ADMIN], Origin="http://evil.example"), 403, "foreign-origin"),
        (
            {"Cookie": f"{COOKIE}={secrets[KeyScope.ADMIN]}", "Origin": "http://127.0.0.1:3000"},
            403,
            "foreign-origin",
        ),
        (bearer(secrets[KeyScope.ADMIN], Host="evil.example"), 421, "foreign-host"),
    ]
    asked = [
        (method, path, headers, status, kind)
        for method, path, _ in operations()
        for headers, status, kind in ways
        if (method, path) not in OPEN
    ]
    asked += [
        (method, path, bearer(secrets[scope]), 403, "scope")
        for method, path, security in operations()
        for scope in KeyScope
        if security and not scope.covers(KeyScope(security[0]["bearer"][0]))
    ]
    monkeypatch.setattr(authentication, "MAX_AUDITED_REFUSALS", len(asked))
    for method, path, headers, status, kind in asked:
        response = await client.request(method, as_asked(path), headers=headers)
        assert_problem(response, status, kind)
        entry = service.trail[-1]
        assert entry.name == f"request.{kind}"
        assert entry.text == f"{method} {as_asked(path)}"
        assert entry.address == "10.0.0.7"
        assert entry.answer.startswith(f"{status}: ")
    assert len(service.trail) == len(asked) > 300
    assert service.commands == []
    assert not any(secret in repr(service.trail) for secret in secrets.values())


async def test_each_scope_may_do_its_own_and_no_more(client, service, secrets):
    may = {
        KeyScope.READ: (200, 403, 403),
        KeyScope.OPERATE: (200, 202, 403),
        KeyScope.ADMIN: (200, 202, 200),
    }
    for scope, expected in may.items():
        headers = bearer(secrets[scope])
        answers = (
            await client.get("/v1/state", headers=headers),
            await client.post("/v1/rollback", headers=headers),
            await client.get("/v1/keys", headers=headers),
        )
        assert tuple(answer.status_code for answer in answers) == expected, scope
    assert len(service.commands) == 2


@pytest.mark.parametrize(
    "path", ["/v1/state/", "/v1//state", "//v1/state", "/v1/nothing", "/metrics"]
)
async def test_there_is_no_way_round(client, path):
    assert_problem(await client.get(path), 401, "no-key")


@pytest.mark.parametrize("path", sorted(FILES | {path for _, path in OPEN if "v1" not in path}))
async def test_what_is_no_secret_needs_no_key(client, service, path):
    assert (await client.get(path)).status_code == 200
    assert service.trail == []


async def test_a_refusal_says_what_to_do(client, secrets):
    none = await client.get("/v1/state")
    assert_problem(none, 401, "no-key", "Authorization: Bearer KEY", "scope read")
    assert none.headers["www-authenticate"] == 'Bearer realm="pyrcal"'
    lesser = await client.post("/v1/stop", headers=bearer(secrets[KeyScope.READ]))
    assert_problem(lesser, 403, "scope", "key reader is of scope read", "one of scope operate")
    assert 'error="insufficient_scope"' in lesser.headers["www-authenticate"]


async def test_on_loopback_without_keys_everything_works_as_before(service, keys):
    async with client_of(service, keys) as client:
        assert (await client.post("/v1/rollback")).status_code == 202
        assert (await client.get("/v1/session")).json() == {"name": None, "scope": "admin"}
        assert (await client.get("/v1/keys")).json() == {"keys": []}
        assert_problem(await client.delete("/v1/keys/ada"), 404, "unknown-id")
    assert service.callers[0].key == ""
    assert service.trail == []


async def test_open_to_others_nobody_may_act_without_a_key_even_when_the_last_is_revoked(
    service, keys
):
    async with client_of(service, keys, Hosts(bound="0.0.0.0")) as client:
        assert (await client.get("/healthz")).status_code == 200
        assert_problem(await client.get("/v1/state"), 401, "no-key")


async def test_a_running_service_sees_keys_come_and_go(service, keys):
    async with client_of(service, keys) as client:
        assert (await client.get("/v1/state")).status_code == 200
        secret = KeyFile(keys.path.parent).add("ada", KeyScope.READ)
        assert_problem(await client.get("/v1/state"), 401, "no-key")
        assert (await client.get("/v1/state", headers=bearer(secret))).status_code == 200
        KeyFile(keys.path.parent).add("bob", KeyScope.READ)
        KeyFile(keys.path.parent).revoke("ada")
        assert_problem(await client.get("/v1/state", headers=bearer(secret)), 401, "wrong-key")


async def test_a_file_that_cannot_be_read_lets_nobody_in(client, keys, secrets):
    keys.path.write_text("nonsense")
    for headers in ({}, bearer(secrets[KeyScope.ADMIN])):
        answer = await client.post("/v1/rollback", headers=headers)
        assert_problem(answer, 503, "keys", "cannot be read")
        assert int(answer.headers["retry-after"]) > 0
    assert (await client.get("/healthz")).status_code == 200


# --- the audit trail names the key


async def test_an_order_is_the_key_s(client, service, secrets):
    headers = bearer(secrets[KeyScope.OPERATE])
    await client.post("/v1/rollback", headers=headers)
    await client.post("/v1/rollback", headers=headers, json={"by": "Ada"})
    assert [command.by for command in service.commands] == ["operateer", "Ada (operateer)"]
    assert [caller.key for caller in service.callers] == ["operateer"] * 2
    assert service.callers[0].address == "10.0.0.7"


async def test_an_answer_is_given_again_to_its_own_key_alone(client, service, keys, secrets):
    other = keys.add("other", KeyScope.OPERATE)
    once = {"Idempotency-Key": "k"}
    for secret in (secrets[KeyScope.OPERATE], secrets[KeyScope.OPERATE], other):
        answer = await client.post("/v1/rollback", headers=bearer(secret, **once))
        assert answer.status_code == 202
    assert [caller.key for caller in service.callers] == ["operateer", "other"]
    assert (await client.post("/v1/rollback", headers=once)).status_code == 401


async def test_a_flood_of_refusals_is_counted_not_written(monkeypatch):
    now_s, told = 1000.0, []
    monkeypatch.setattr(authentication.time, "monotonic", lambda: now_s)
    refusals = RefusalLog(told.append)
    scope = {
        "type": "http",
        "method": "GET",
        "path": "/v1/state",
        "headers": [],
        "query_string": b"",
    }
    request = Request({**scope, "client": ("10.0.0.7", 5)})
    refusal = Refusal(HTTPStatus.UNAUTHORIZED, "no-key", "found no key")
    for _ in range(520):
        refusals.record(request, refusal)
    assert [entry.name for entry in told] == ["request.no-key"] * 20
    now_s += 61.0
    for _ in range(2):
        refusals.record(request, refusal)
    assert [entry.answer for entry in told[20:]] == [
        "401: found no key; 500 more were refused meanwhile",
        "401: found no key",
    ]


# --- wrong keys


async def test_who_has_a_key_is_not_locked_out_by_who_tries_some(client, secrets):
    for _ in range(50):
        assert_problem(await client.get("/v1/state", headers=bearer("guess")), 401, "wrong-key")
    assert_problem(await client.get("/v1/state"), 401, "no-key")
    right = bearer(secrets[KeyScope.OPERATE])
    assert (await client.post("/v1/stop", headers=right)).status_code == 202


# --- the page


async def test_a_browser_logs_in_keeps_the_key_from_scripts_and_logs_out(client, service, secrets):
    secret = secrets[KeyScope.OPERATE]
    begun = await client.post("/v1/session", headers=bearer(secret, Origin=ORIGIN))
    assert begun.json() == {"name": "operateer", "scope": "operate"}
    cookie = begun.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "samesite=strict" in cookie.lower()
    assert "Secure" not in cookie
    assert "Domain" not in cookie
    assert service.trail[-1].name == "session.begun"
    assert (await client.get("/v1/session")).json()["name"] == "operateer"
    order = {"Origin": ORIGIN}
    assert (await client.post("/v1/rollback", headers=order)).status_code == 202
    assert service.callers[0].key == "operateer"
    ended = await client.delete("/v1/session", headers=order)
    assert ended.status_code == 204
    assert_problem(await client.get("/v1/session"), 401, "no-key")


async def test_behind_a_proxy_with_tls_the_cookie_never_leaves_without_it(service, keys, secrets):
    hosts = Hosts(allowed=("pyrcal.example",))
    async with client_of(service, keys, hosts) as client:
        sent = {"Origin": "https://pyrcal.example", "Host": "pyrcal.example"}
        headers = bearer(secrets[KeyScope.READ], **sent)
        assert "Secure" in (await client.post("/v1/session", headers=headers)).headers["set-cookie"]


async def test_a_wrong_key_logs_nobody_in(client):
    answer = await client.post("/v1/session", headers=bearer("guess", Origin=ORIGIN))
    assert_problem(answer, 401, "wrong-key")
    assert "set-cookie" not in answer.headers


async def test_a_cookie_orders_nothing_without_the_origin_that_browsers_send(
    client, service, secrets
):
    cookie = {"Cookie": f"{COOKIE}={secrets[KeyScope.ADMIN]}"}
    assert (await client.get("/v1/state", headers=cookie)).status_code == 200
    assert_problem(await client.post("/v1/rollback", headers=cookie), 403, "foreign-origin")
    assert service.commands == []
    assert service.trail[-1].who == "adminer"


# --- keys over REST


async def test_who_has_a_key_is_for_admins_to_see_and_one_can_be_revoked_at_once(
    client, service, secrets
):
    admin = bearer(secrets[KeyScope.ADMIN])
    shown = (await client.get("/v1/keys", headers=admin)).json()["keys"]
    assert [(key["name"], key["scope"]) for key in shown] == [
        ("reader", "read"),
        ("operateer", "operate"),
        ("adminer", "admin"),
    ]
    assert all(set(k) == {"name", "scope", "created_ns_utc", "created_utc"} for k in shown)
    assert (await client.delete("/v1/keys/operateer", headers=admin)).status_code == 204
    entry = service.trail[-1]
    assert (entry.who, entry.name, entry.text) == ("adminer", "key.revoked", "operateer")
    gone = await client.post("/v1/rollback", headers=bearer(secrets[KeyScope.OPERATE]))
    assert_problem(gone, 401, "wrong-key")
    again = await client.delete("/v1/keys/operateer", headers=admin)
    assert_problem(again, 404, "unknown-id", "no such key")


async def test_to_revoke_the_last_key_opens_no_door(client, service, keys, secrets):
    """What schemathesis has found: it revoked its own key, and was let in from then on."""
    for key in keys.all():
        keys.revoke(key.name)
    assert_problem(await client.post("/v1/rollback"), 401, "no-key")
    keys.path.unlink()
    assert (await client.post("/v1/rollback")).status_code == 202


async def test_a_stream_ends_when_its_key_is_revoked(service, keys, secrets, monkeypatch):
    monkeypatch.setattr(page, "MAX_STREAM_SILENCE_S", 0.5)
    async with serving(service, keys) as port:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        head = (
            f"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {secrets['read']}"
        )
        writer.write(f"{head}\r\n\r\n".encode())
        await asyncio.wait_for(reader.readuntil(b"event: state"), 5.0)
        keys.revoke("reader")
        rest = await asyncio.wait_for(reader.readuntil(b"\r\n0\r\n\r\n"), 5.0)
        assert rest.count(b"event: state") <= 2
        writer.close()


async def test_a_stream_that_needed_no_key_ends_when_there_is_one(service, keys, monkeypatch):
    monkeypatch.setattr(page, "MAX_STREAM_SILENCE_S", 0.5)
    async with serving(service, keys) as port:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\n\r\n")
        await asyncio.wait_for(reader.readuntil(b"event: state"), 5.0)
        keys.add("ada", KeyScope.READ)
        await asyncio.wait_for(reader.readuntil(b"\r\n0\r\n\r\n"), 5.0)
        writer.close()


async def test_a_stream_needs_a_key_like_everything(client):
    assert_problem(await client.get("/v1/stream"), 401, "no-key")


def test_the_openapi_says_how_a_key_is_shown():
    schemes = document()["components"]["securitySchemes"]
    assert schemes["bearer"] | {"description": ""} == {
        "type": "http",
        "scheme": "bearer",
        "description": "",
    }
    assert (schemes["cookie"]["in"], schemes["cookie"]["name"]) == ("cookie", COOKIE)


async def test_what_a_path_can_do_is_told_whole(client, secrets):
    """Starlette names the methods of the first route of a path only."""
    answer = await client.put("/v1/measurements", headers=bearer(secrets[KeyScope.OPERATE]))
    assert_problem(answer, 405, "http")
    assert answer.headers["allow"] == "GET, POST"
