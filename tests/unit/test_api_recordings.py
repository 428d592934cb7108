"""Telemetry kept on request: over REST, on the disk, and what retention makes of it."""

import asyncio
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from pyrcal.__main__ import main
from service.archive.retention import RetentionPolicy, due, items
from service.errors import StorageError
from service.files.recording import RecordedKind, Recording
from service.runtime import telemetry_recorder
from service.runtime.telemetry_recorder import TelemetryRecorder
from tests.support.api import assert_problem

WANTED = {"duration_s": 30, "by": "Ada", "reason": "strange edge"}


class Tap:
    """What the link does: hands on what the RTC sends."""

    recorder = None
    held_s = 0.0

    def __call__(self, recorder, before_s):
        self.recorder = recorder
        return min(before_s, self.held_s)


@pytest.fixture
def keeper(service, monkeypatch):
    monkeypatch.setattr(telemetry_recorder, "PROGRESS_CHECK_INTERVAL_S", 0.01)
    tap = Tap()
    service.recordings = TelemetryRecorder(
        archive=service.archive,
        retention=RetentionPolicy(),
        system="small",
        tap=tap,
        audit=service.audit,
    )
    service.recordings.tap = tap
    return service.recordings


async def begun(client, **changes):
    response = await client.post("/v1/recordings", json={**WANTED, **changes})
    assert response.status_code == 202, response.text
    return response.json()["id"]


async def of(client, name):
    return (await client.get(f"/v1/recordings/{name}")).json()


async def ended_by_itself(client, name):
    async with asyncio.timeout(10.0):
        while (await of(client, name))["state"] == "running":  # noqa: ASYNC110 - as a client waits
            await asyncio.sleep(0.01)


async def test_what_comes_is_kept_byte_for_byte_with_who_and_why(client, service, keeper):
    name = await begun(client)
    assert (await of(client, name))["state"] == "running"
    keeper.tap.recorder.put(RecordedKind.FRAMES, b"frames", b"header")
    again = await client.post("/v1/recordings", json=WANTED)
    assert_problem(again, 409, "not-now", f"{name} is under way")
    assert_problem(await client.get(f"/v1/recordings/{name}/file"), 409, "not-now", "end it first")
    ended = await client.post(f"/v1/recordings/{name}/end", json={"by": "Bob"})
    assert ended.status_code == 202
    assert keeper.tap.recorder is None
    told = await of(client, name)
    assert (told["state"], told["who"], told["why"]) == ("stored", "Ada", "strange edge")
    assert (told["reason"], told["n_bytes"]) == ("Bob has ended it", 12)
    sent = await client.get(f"/v1/recordings/{name}/file")
    path = service.archive.directory / "sent.h5"
    path.write_bytes(sent.content)
    with Recording(path) as recording:
        (message,) = recording.messages()
    assert (message.kind, message.payload) == (RecordedKind.FRAMES, b"frames")
    assert [entry.name for entry in service.trail] == [
        "recording.begin", "recording.begin.refused", "recording.ended", "recording.end"
    ]  # fmt: skip
    twice = await client.post(f"/v1/recordings/{name}/end", json={})
    assert_problem(twice, 409, "not-now", "is not under way")


def _refused(*_):
    raise RuntimeError("Can't decrement id ref count (file write failed)")


async def test_a_disk_that_refuses_ends_the_recording_and_nothing_else(
    client, service, keeper, monkeypatch
):
    """As h5py says it: a flush and a close that fail are RuntimeErrors."""
    name = await begun(client)
    recorder = keeper.tap.recorder
    file = recorder._file
    monkeypatch.setattr(recorder, "_write", _refused)
    monkeypatch.setattr(recorder, "_file", SimpleNamespace(close=_refused))
    running = asyncio.create_task(keeper.run())
    await ended_by_itself(client, name)
    told = await of(client, name)
    assert (told["state"], "file write failed" in told["reason"]) == ("stored", True)
    assert not running.done()
    file.close()
    running.cancel()


async def test_an_operator_may_end_it_while_its_time_is_up(client, keeper, monkeypatch):
    name = await begun(client)
    monkeypatch.setattr(keeper, "_check_recording_end", lambda _: "")
    async with keeper._guard:
        ended = asyncio.create_task(keeper.end("Bob has ended it"))
        await asyncio.sleep(0.05)
        due = [asyncio.create_task(keeper._end_if_due()) for _ in range(2)]
        await asyncio.sleep(0.05)
    assert (await ended).reason == "Bob has ended it"
    await asyncio.gather(*due)
    assert (await of(client, name))["state"] == "stored"


async def test_what_came_before_is_in_it_as_far_as_it_is_held(client, keeper):
    keeper.tap.held_s = 31.5
    response = await client.post("/v1/recordings", json={"before_s": 60, "duration_s": 0})
    assert "the last 31.5 s" in response.json()["text"]
    name = response.json()["id"]
    running = asyncio.create_task(keeper.run())
    await ended_by_itself(client, name)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    told = await of(client, name)
    assert (told["before_s"], told["duration_s"], told["reason"]) == (31.5, 0.0, "")
    nothing = await client.post("/v1/recordings", json={"before_s": 0, "duration_s": 0})
    assert_problem(nothing, 409, "not-now", "expected some of them")


async def test_it_ends_in_its_time_and_with_the_service(client, service, keeper):
    name = await begun(client, duration_s=0.05)
    running = asyncio.create_task(keeper.run())
    await ended_by_itself(client, name)
    assert (await of(client, name))["reason"] == ""
    last = await begun(client)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert (await of(client, last))["reason"] == "the service was ended"


@pytest.mark.parametrize("limit", ["MAX_RECORDING_GB", "full"])
async def test_one_that_is_too_large_or_fills_the_disk_is_ended(client, keeper, monkeypatch, limit):
    name = await begun(client)
    keeper.tap.recorder.put(RecordedKind.FRAMES, bytes(2000))
    if limit == "full":
        monkeypatch.setattr(keeper, "_retention", RetentionPolicy(reserve_gb=1e9))
    else:
        monkeypatch.setattr(telemetry_recorder, limit, 1e-6)
    running = asyncio.create_task(keeper.run())
    await ended_by_itself(client, name)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    expected = "the most there may be" if limit == "MAX_RECORDING_GB" else "are free in"
    assert expected in (await of(client, name))["reason"]


async def test_what_is_known_of_one_is_whole_while_it_is_written_anew(
    client, service, keeper, monkeypatch
):
    name = await begun(client)
    (record,) = service.archive.recordings.records()

    def refused(*_):
        raise OSError("no space left")

    monkeypatch.setattr(Path, "replace", refused)
    with pytest.raises(StorageError, match="no space left"):
        service.archive.recordings.write(replace(record, state="stored"))
    assert service.archive.recordings.records() == (record,)
    monkeypatch.undo()
    await client.post(f"/v1/recordings/{name}/end", json={})


async def test_a_disk_almost_full_takes_none(client, service, keeper, monkeypatch):
    monkeypatch.setattr(keeper, "_retention", RetentionPolicy(reserve_gb=1e9))
    refused = await client.post("/v1/recordings", json=WANTED)
    assert_problem(refused, 409, "not-now", "nothing is recorded", "are free in")
    assert "are free in" in service.trail[-1].answer


async def test_it_stays_until_somebody_removes_it_and_no_matrix_goes_for_it(
    client, service, keeper, capsys
):
    name = await begun(client)
    assert_problem(await client.delete(f"/v1/recordings/{name}"), 409, "not-now", "end it first")
    await client.post(f"/v1/recordings/{name}/end", json={})
    every = items(service.archive)
    (item,) = [one for one in every if one.kind == "recording"]
    assert item.kept_because == "requested by Ada: strange edge"
    assert not list(due(every, RetentionPolicy(keep_days=1e-9, keep_gb=1e-9), 2**62))
    shown = ["archive", "show", name, "--data-dir", str(service.archive.directory)]
    capsys.readouterr()  # of the log
    assert main([*shown, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["kind"], told["record"]["who"], told["damage"]) == ("recording", "Ada", None)
    service.archive.recordings.path_of(name).write_bytes(b"no HDF5")
    assert main(shown) == 1
    assert (await client.delete(f"/v1/recordings/{name}")).status_code == 202
    assert_problem(await client.delete(f"/v1/recordings/{name}"), 404, "unknown-id", name)


async def test_one_that_a_killed_service_has_left_is_there(client, service, keeper):
    name = await begun(client)
    assert service.archive.recordings.adopt(anew=False) == []
    (record,) = service.archive.recordings.records()
    assert (record.id, record.state) == (name, "stored")
    assert record.reason == "the service has ended meanwhile"
    await keeper.end("")
