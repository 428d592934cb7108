"""Who may ask over HTTP, and how much: foreign pages, endless bodies, half-open connections."""

import asyncio
import contextlib
import json

import httpx
import pytest

from service.api import create_app
from service.web import connections
from service.web.authentication import Hosts
from service.web.keys import KeyFile, KeyScope
from tests.support.api import FakeService, a_snapshot, assert_problem
from tests.support.api_admission import serving
from tests.support.pace import patience

pytestmark = pytest.mark.timeout(60)


@pytest.fixture
def service():
    return FakeService(a_snapshot())


def client_of(service, hosts=None, host="127.0.0.1:8080"):
    app = create_app(service, hosts=hosts or Hosts())
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    return httpx.AsyncClient(transport=transport, base_url=f"http://{host}")


# --- a page in the operator's browser


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "http://localhost:3000",
        "https://127.0.0.1",
        "http://127.0.0.1:8080.evil.example",
        "null",
        "file://",
        "",
    ],
)
async def test_a_page_from_elsewhere_cannot_act(service, origin):
    async with client_of(service) as client:
        headers = {"Origin": origin, "Content-Type": "text/plain"}
        response = await client.post("/v1/rollback", headers=headers)
    assert_problem(response, 403, "foreign-origin", "expected none or http://127.0.0.1:8080")
    assert service.commands == []


@pytest.mark.parametrize(
    ("site", "status"),
    [("cross-site", 403), ("same-site", 403), ("same-origin", 202), ("none", 202)],
)
async def test_a_browser_that_hides_the_origin_cannot_order_from_elsewhere(service, site, status):
    async with client_of(service) as client:
        response = await client.post("/v1/rollback", headers={"Sec-Fetch-Site": site})
        assert response.status_code == status
        linked = await client.get("/v1/state", headers={"Sec-Fetch-Site": site})
        assert linked.status_code == 200
    assert len(service.commands) == (status == 202)


@pytest.mark.parametrize("origin", ["http://127.0.0.1:8080", "HTTP://127.0.0.1:8080", None])
async def test_its_own_page_and_programs_that_are_no_browser_can(service, origin):
    headers = {} if origin is None else {"Origin": origin}
    async with client_of(service) as client:
        assert (await client.post("/v1/rollback", headers=headers)).status_code == 202
    assert len(service.commands) == 1


async def test_the_port_a_scheme_stands_for_need_not_be_written(service):
    hosts = Hosts(allowed=("pyrcal.observatory.org",))
    async with client_of(service, hosts, "pyrcal.observatory.org") as client:
        headers = {"Origin": "https://pyrcal.observatory.org:443"}
        assert (await client.post("/v1/rollback", headers=headers)).status_code == 202


@pytest.mark.parametrize("method", ["GET", "POST", "OPTIONS"])
async def test_a_name_that_was_bound_to_this_address_by_a_stranger_is_refused(service, method):
    async with client_of(service, host="evil.example:8080") as client:
        response = await client.request(method, "/v1/rollback")
    assert_problem(response, 421, "foreign-host", "evil.example:8080", "api.allowed_hosts")
    assert service.commands == []


@pytest.mark.parametrize(
    ("bound", "allowed", "host", "known"),
    [
        ("127.0.0.1", (), "localhost", True),
        ("127.0.0.1", (), "LOCALHOST.:8080", True),
        ("127.0.0.1", (), "127.0.0.1:1", True),
        ("127.0.0.1", (), "[::1]:8080", True),
        ("127.0.0.1", (), "10.0.0.5:8080", False),
        ("127.0.0.1", (), "127.0.0.1.evil.example", False),
        ("127.0.0.1", (), "evil@127.0.0.1", False),
        ("127.0.0.1", (), "", False),
        ("10.0.0.5", (), "10.0.0.5:8080", True),
        ("10.0.0.5", (), "10.0.0.6:8080", False),
        ("rtc-host", (), "rtc-host:8080", True),
        ("0.0.0.0", (), "10.0.0.5:8080", True),
        ("::", (), "[fe80::1]:8080", True),
        ("0.0.0.0", (), "rtc-host:8080", False),
        ("0.0.0.0", ("RTC-host",), "rtc-host:8080", True),
        ("0.0.0.0", ("rtc-host",), "other:8080", False),
    ],
)
async def test_hosts_are_loopback_the_bound_address_and_those_of_the_settings(
    service, bound, allowed, host, known
):
    hosts = Hosts(bound=bound, allowed=allowed)
    async with client_of(service, hosts) as client:
        response = await client.get("/v1/state", headers={"Host": host})
    assert response.status_code == (200 if known else 421)


# --- bodies


async def test_a_body_beyond_the_limit_is_refused_before_it_is_read(service):
    read = 0

    async def endless():
        nonlocal read
        while True:
            read += 1 << 16
            yield b" " * (1 << 16)

    async with client_of(service) as client:
        told = await client.post("/v1/refit", content=b" " * 2_000_000)
        assert_problem(told, 413, "too-large", "2.0 MB", "at most 1.0 MB")
        response = await client.post("/v1/refit", content=endless())
    assert_problem(response, 413, "too-large", "at most 1.0 MB")
    assert read < 1_300_000


async def test_a_body_within_the_limit_reaches_the_service(service):
    body = json.dumps({"mode": "auto"}) + " " * 900_000
    async with client_of(service) as client:
        headers = {"Content-Type": "application/json"}
        assert (await client.put("/v1/mode", content=body, headers=headers)).status_code == 202


# --- connections, over real sockets


async def connected(port, sent=b""):
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(sent)
    await writer.drain()
    return reader, writer


def parts(answer):
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]), head.lower(), json.loads(body)


async def state_of(port):
    async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}") as client:
        return await client.get("/v1/state")


async def test_a_body_that_does_not_come_is_ended_with_408(service, monkeypatch):
    monkeypatch.setattr(connections, "MAX_BODY_S", 0.5)
    async with serving(service) as port:
        head = b"POST /v1/refit HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n{"
        reader, writer = await connected(port, head)
        status, _, problem = parts(await asyncio.wait_for(reader.readuntil(b"}"), 5.0))
        assert (status, problem["status"]) == (408, 408)
        assert "0.5 s" in problem["detail"]
        writer.close()
    assert service.commands == []


SLOW_BODY = (
    b"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    b"Content-Length: 100\r\n\r\n{"
)


async def test_a_body_may_come_in_many_pieces(service):
    async with serving(service) as port:
        head = SLOW_BODY.replace(b"Length: 100", b"Length: 8001")
        reader, writer = await connected(port, head)
        for k in range(8):
            await asyncio.sleep(0.02)
            writer.write(b" " * 1000 if k < 7 else b" " * 999 + b"}")
        assert b"202 Accepted" in await asyncio.wait_for(reader.readuntil(b"\r\n"), 5.0)
        writer.close()


HALF_HEAD = b"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\nX-"


async def ended(connection):
    with contextlib.suppress(ConnectionResetError):
        assert await asyncio.wait_for(connection[0].read(), patience(5.0)) == b""
    return True


@contextlib.asynccontextmanager
async def held(port, *sent, local="127.0.0.1"):
    """Connections that have sent something, in this order."""
    lines = [await asyncio.open_connection("127.0.0.1", port, local_addr=(local, 0)) for _ in sent]
    for (_, writer), data in zip(lines, sent, strict=True):
        writer.write(data)
    yield lines
    for _, writer in lines:
        writer.close()


@pytest.mark.parametrize("sent", [b"", HALF_HEAD, SLOW_BODY])
async def test_for_more_connections_than_there_may_be_the_oldest_end(service, monkeypatch, sent):
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 3)
    async with serving(service) as port, held(port, *[sent] * 3) as lines:
        assert service.crowd.complaint() is None
        async with held(port, sent):
            assert await ended(lines[0])
            assert (await state_of(port)).status_code == 200
            assert service.crowd.complaint().key == "rest.crowded: 127.0.0.1"
            assert service.crowd.complaint().values["n"] == 1
            assert not any(reader.at_eof() for reader, _ in lines[1:])
            monkeypatch.setattr(connections, "CROWD_REPORT_S", 0.0)
            assert service.crowd.complaint() is None


async def test_connections_without_a_request_end_before_those_that_are_answered(
    service, monkeypatch
):
    """The page's stream is older than a crowd, and outlives it."""
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 3)
    stream = b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\n\r\n"
    async with serving(service) as port, held(port, stream) as lines:
        assert b" 200 " in await asyncio.wait_for(lines[0][0].readline(), patience(5.0))
        async with held(port, b"", SLOW_BODY, b"") as idle:
            assert await ended(idle[0])
            assert not any(reader.at_eof() for reader, _ in [*lines, *idle[1:]])


async def test_a_request_that_comes_with_a_crowd_is_answered(service, monkeypatch):
    """Its connection is older than most of the crowd's, and its bytes have not been read yet."""
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 3)
    monkeypatch.setattr(connections, "ARRIVAL_S", 0.5)
    stream = b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\n\r\n"
    async with serving(service) as port, held(port, b"") as lines, held(port, *[b""] * 6) as crowd:
        lines[0][1].write(stream)
        assert b" 200 " in await asyncio.wait_for(lines[0][0].readline(), patience(5.0))
        assert await ended(crowd[0])
        assert not lines[0][0].at_eof()


async def test_the_address_with_most_connections_makes_room(service, monkeypatch):
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 3)
    async with (
        serving(service) as port,
        held(port, b"", local="127.0.0.2") as lines,
        held(port, b"", b"", b"") as crowd,
    ):
        assert await ended(crowd[0])
        assert not any(reader.at_eof() for reader, _ in [*lines, *crowd[1:]])


@pytest.mark.parametrize("sent", [b"", HALF_HEAD])
async def test_the_head_of_a_request_has_a_time_limit(service, monkeypatch, sent):
    """Bytes that trickle do not extend it."""
    monkeypatch.setattr(connections, "MAX_HEAD_S", 1)
    async with serving(service) as port:
        reader, writer = await connected(port, sent)

        async def trickle():
            while not reader.at_eof():
                writer.write(sent and b"x")
                await asyncio.sleep(0.05)

        async with asyncio.timeout(patience(5.0)):
            with contextlib.suppress(ConnectionResetError):
                await asyncio.gather(reader.read(), trickle())
        writer.close()
    assert service.commands == []


async def test_a_head_in_many_pieces_is_answered(service):
    async with serving(service) as port:
        head = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
        reader, writer = await connected(port)
        for k in range(0, len(head), 8):
            writer.write(head[k : k + 8])
            await asyncio.sleep(0.01)
        assert b" 200 " in await asyncio.wait_for(reader.readline(), patience(5.0))
        writer.close()


async def test_what_is_no_http_is_refused(service):
    async with serving(service) as port:
        reader, writer = await connected(port, b"\x16\x03\x01 nonsense\r\n\r\n")
        assert b" 400 " in await asyncio.wait_for(reader.readline(), 5.0)
        writer.close()


async def test_half_an_order_is_no_order(service):
    """Its beginning may be one: what a client leaves behind is not carried out."""
    async with serving(service) as port:
        head = b"POST /v1/refit HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        _, writer = await connected(port, head + b"Content-Length: 100\r\n\r\n{}")
        await asyncio.sleep(0.2)
        writer.close()
        await asyncio.sleep(0.2)
    assert service.commands == []


# --- heads, and who stands behind a proxy


@pytest.mark.parametrize(
    "path", ["/v1/state", "/v1/nothing", "/v1/session", "/healthz", "/metrics", "/openapi.json"]
)
async def test_no_answer_is_taken_for_another_type_or_kept_unasked(service, path):
    async with client_of(service) as client:
        answer = await client.get(path)
    assert answer.headers["x-content-type-options"] == "nosniff"
    asked_again = path in {"/v1/state", "/healthz", "/openapi.json"}
    kept = "private, no-cache" if asked_again else "no-store"
    assert answer.headers["cache-control"] == kept


async def test_a_request_of_two_lengths_is_refused_and_nothing_after_it_is_read(service):
    async with serving(service) as port:
        head = b"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\n"
        smuggled = b"POST /v1/rollback HTTP/1.1\r\nHost: localhost\r\n\r\n"
        body = b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n"
        reader, writer = await connected(port, head + body + smuggled)
        status, told, problem = parts(await asyncio.wait_for(reader.read(), 5.0))
        assert (status, problem["type"]) == (400, "urn:pyrcal:problem:two-lengths")
        assert b"connection: close" in told
        writer.close()
    assert service.commands == []


@pytest.mark.parametrize(("n_headers", "expected"), [(90, 200), (101, 431), (10_000, 431)])
async def test_more_headers_than_anybody_sends_are_refused(service, n_headers, expected):
    async with serving(service) as port:
        more = b"".join(b"a%d: b\r\n" % k for k in range(n_headers))
        head = b"GET /v1/state HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n"
        reader, writer = await connected(port, head + more + b"\r\n")
        assert b" %d " % expected in await asyncio.wait_for(reader.readline(), 5.0)
        writer.close()


FORWARDED = {"X-Forwarded-For": "6.6.6.6", "X-Forwarded-Proto": "https"}


@pytest.mark.parametrize(
    ("proxies", "address", "secure"),
    [
        ((), "127.0.0.1", False),
        (("10.0.0.7",), "127.0.0.1", False),
        (("127.0.0.1",), "6.6.6.6", True),
        (("127.0.0.0/24",), "6.6.6.6", True),
    ],
)
async def test_who_asks_is_said_by_nobody_but_the_proxies_that_are_named(
    service, tmp_path, proxies, address, secure
):
    keys = KeyFile(tmp_path)
    secret = keys.add("ada", KeyScope.OPERATE)
    headers = {"Authorization": f"Bearer {secret}", **FORWARDED}
    async with (
        serving(service, keys, proxies) as port,
        httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}") as client,
    ):
        await client.post("/v1/stop", json={"by": "Ada"}, headers=headers)
        told = await client.post("/v1/session", headers=headers)
    assert service.trail[-1].address == address
    assert ("Secure" in told.headers["set-cookie"]) == secure
