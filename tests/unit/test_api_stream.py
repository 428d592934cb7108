"""News over real sockets: what comes at once, what a listener that was away has missed, the end."""

import asyncio
import contextlib
import json
import socket
from dataclasses import dataclass, replace

import httpx
import pytest

from service.api import create_app
from service.records.messages import as_message
from service.records.state import Level, LogEntry
from service.tracking.step_context import LOG_LENGTH
from service.web import page
from service.web.connections import Server
from tests.support.api import LINK, STATE, FakeService, a_snapshot
from tests.support.pace import patience

pytestmark = pytest.mark.timeout(60)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(page, "STREAM_PERIOD_S", 0.05)
    monkeypatch.setattr(page, "MAX_STREAM_SILENCE_S", 0.5)


@pytest.fixture
def service():
    return FakeService(a_snapshot())


@dataclass
class Listener:
    lines: object
    status: int
    kind: str

    async def message(self):
        """Return the next message as its fields; None: the stream has ended."""
        found = {}
        async with asyncio.timeout(patience(5.0)):
            async for line in self.lines:
                if not line:
                    return found
                name, _, value = line.partition(":")
                found[name] = value.strip()
        return None

    async def event(self, name):
        """Return the next event of a kind."""
        while (found := await self.message()) is not None:
            if found.get("event") == name:
                return found
        raise AssertionError(f"the stream ended before {name}")


@contextlib.asynccontextmanager
async def serving(service):
    """Yield how to listen, and the event that ends the service."""
    over = asyncio.Event()
    listener = socket.create_server(("127.0.0.1", 0))
    app = create_app(service, over=over)
    server = Server(app, over, within_s=5)
    task = asyncio.create_task(server.serve(sockets=[listener]))
    while not server.started:  # noqa: ASYNC110 - uvicorn has no event for it
        await asyncio.sleep(0.01)
    port = listener.getsockname()[1]

    @contextlib.asynccontextmanager
    async def listening(last=None):
        headers = {} if last is None else {"Last-Event-ID": last}
        async with (
            httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}", timeout=None) as client,
            client.stream("GET", "/v1/stream", headers=headers) as answer,
        ):
            kind = answer.headers["content-type"]
            yield Listener(answer.aiter_lines(), answer.status_code, kind)

    listening.port, listening.over, listening.app = port, over, app
    try:
        yield listening
    finally:
        over.set()
        server.should_exit = True
        await task


def line(k):
    return LogEntry(
        t_ns_utc=1000 + k, level=Level.INFO, name="mode", message=as_message("mode", f"line {k}")
    )


async def test_who_begins_to_listen_gets_the_state_and_is_told_to_read_the_log(service):
    async with serving(service) as listening, listening() as listener:
        assert (listener.status, listener.kind) == (200, "text/event-stream; charset=utf-8")
        assert await listener.message() == {"retry": "1000"}
        told = await listener.event("state")
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{listening.port}") as client:
            assert json.loads(told["data"]) == (await client.get("/v1/state")).json()
        assert (await listener.event("reset"))["id"]


async def test_a_change_is_told_and_the_clock_alone_is_none(service):
    async with serving(service) as listening, listening() as listener:
        await listener.event("reset")
        service.now = replace(service.now, now_ns=200)
        service.now = replace(service.now, link=replace(LINK, frame_age_s=3.0, telemetry_age_s=0.4))
        told = await listener.message()
        assert told[""] == "nothing new"  # the heartbeat came before any state
        assert json.loads((await listener.event("state"))["data"])["now_ns"] == 200
        service.change(mode="hold")
        told = await listener.message()
        assert json.loads(told["data"])["mode"] == "hold"


async def test_lines_of_the_log_come_one_by_one_as_events_shows_them(service):
    async with serving(service) as listening, listening() as listener:
        await listener.event("reset")
        service.change(log=(*STATE.log, line(1), line(2)))
        first, second = await listener.event("log"), await listener.event("log")
    assert json.loads(first["data"]) == {
        "t_ns_utc": 1001,
        "t_utc": "1970-01-01T00:00:00.000001Z",
        "level": "info",
        "name": "mode",
        "text": "line 1",
        "code": "mode",
        "values": {"about": "line 1"},
        "n_times": 1,
        "cause": "",
    }
    assert json.loads(second["data"])["text"] == "line 2"
    assert first["id"] != second["id"]


async def test_who_comes_back_gets_what_it_has_missed(service):
    async with serving(service) as listening:
        async with listening() as listener:
            await listener.event("reset")
            service.change(log=(*STATE.log, line(1)))
            heard = (await listener.event("log"))["id"]
        service.change(log=(*STATE.log, line(1), line(2), line(3)))
        async with listening(heard) as listener:
            missed = [json.loads((await listener.event("log"))["data"])["text"] for _ in range(2)]
            assert missed == ["line 2", "line 3"]
            service.change(log=(*STATE.log, line(1), line(2), line(3), line(4)))
            assert json.loads((await listener.event("log"))["data"])["text"] == "line 4"


async def test_who_was_away_for_longer_than_the_log_reaches_is_told_to_read_it_again(service):
    service.change(log=())
    async with serving(service) as listening:
        async with listening() as listener:
            empty = (await listener.event("reset"))["id"]
        service.change(log=(line(1),))
        async with listening(empty) as listener:
            assert json.loads((await listener.event("log"))["data"])["text"] == "line 1"
        # line 1 is not among them: who has just been sent it from the look before has missed others
        service.change(log=tuple(line(k) for k in range(10, 10 + LOG_LENGTH)))
        for last in (empty, "of another run"):
            async with listening(last) as listener:
                assert (await listener.event("reset"))["id"] not in {"", empty}


async def test_all_who_listen_share_one_look(service):
    looks = 0
    snapshot = service.snapshot

    def counted():
        nonlocal looks
        looks += 1
        return snapshot()

    service.snapshot = counted
    async with serving(service) as listening, contextlib.AsyncExitStack() as stack:
        listeners = [await stack.enter_async_context(listening()) for _ in range(10)]
        for listener in listeners:
            await listener.event("state")
        looks, loop = 0, asyncio.get_running_loop()
        began = loop.time()
        await asyncio.sleep(1.0)
        assert 0 < looks <= (loop.time() - began) / page.STREAM_PERIOD_S + 2


async def test_a_stream_ends_at_once_with_the_service(service):
    async with serving(service) as listening, listening() as listener:
        await listener.event("state")
        listening.over.set()
        async with asyncio.timeout(patience(1.0)):
            while await listener.message() is not None:
                pass


async def test_more_than_there_may_be_are_told_to_come_later(service, monkeypatch):
    monkeypatch.setattr(page, "MAX_LISTENERS", 1)
    async with serving(service) as listening, listening() as listener:
        await listener.event("state")
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{listening.port}") as client:
            refused = await client.get("/v1/stream")
    assert (refused.status_code, refused.json()["type"]) == (503, "urn:pyrcal:problem:busy")
    assert "Retry-After" in refused.headers
