"""What goes from the archive, what never does, what is said of it, with and without a service."""

import asyncio
import json
import os
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import httpx
import numpy as np
import pytest

from pyrcal.__main__ import main
from service.api import create_app
from service.archive import Archive, Pin, retention
from service.archive.nights import DAY_NS
from service.archive.retention import RetentionPolicy, due, items
from service.errors import UnknownIdError
from service.records.alarms import Alarm
from service.records.messages import as_message
from service.records.products import MatrixState
from service.records.state import TrackerState
from service.runtime import archiving
from tests.support.archived import product, record_of
from tests.support.states import changed, tracker_state

NOW = 20_000 * DAY_NS
WRITTEN = Path(__file__).parents[1] / "data" / "archive"
N = 30
MATRIX = np.arange(30_000, dtype=np.float32).reshape(3, 10_000)


def fill(archive):
    """One reconstructor a day, the oldest 29 days old, all in use once."""
    for k in range(N):
        record = record_of(f"cm-{k:02}", created_ns_utc=NOW - (N - 1 - k) * DAY_NS, parent="rtc-0")
        archive.reconstructors.store(record, MATRIX, None, {})
        archive.record((replace(record, state=MatrixState.SUPERSEDED),), ())
        written = record.created_ns_utc
        os.utime(product(archive, record.id), ns=(written, written))


@pytest.fixture
def archive(tmp_path):
    archive = Archive(tmp_path)
    archive.open()
    with archive:
        fill(archive)
        yield archive


def going(archive, in_use=(), **keeping):
    return [item.id for item, _ in due(items(archive, in_use), RetentionPolicy(**keeping), NOW)]


def test_nothing_goes_unless_somebody_has_said_so(archive):
    assert going(archive) == []
    assert len(items(archive)) == N


def test_what_is_old_goes_but_for_the_newest_what_is_needed_and_what_is_pinned(archive):
    archive.pin(Pin(id="cm-02", who="Ada", why="for the paper"))
    alive = replace(archive.reconstructors.records()[5], state=MatrixState.APPLIED, parent="cm-07")
    archive.record((alive,), ())
    gone = going(archive, ("cm-03",), keep_days=19.5)
    assert gone == [f"cm-{k:02}" for k in range(10) if k not in {2, 3, 5, 7}]
    assert going(archive, keep_days=0.5)[-1] == f"cm-{N - 11}"
    because = {item.id: item.kept_because for item in items(archive, ("cm-03",))}
    assert because["cm-02"] == "pinned by Ada: for the paper"
    assert (because["cm-03"], because["cm-05"]) == ("in use", "in use")
    assert because["cm-07"] == "cm-05 was made from it"
    assert (because["cm-00"], because["cm-29"]) == ("", "one of the newest 10")


def test_as_much_goes_as_is_too_much_the_oldest_first(archive):
    n_bytes = product(archive, "cm-00").stat().st_size
    assert going(archive, keep_gb=27.5 * n_bytes / 1e9) == ["cm-00", "cm-01", "cm-02"]
    assert len(going(archive, keep_gb=1e-9)) == N - 10


def test_what_somebody_has_to_look_at_stays_until_then(archive):
    product(archive, "cm-00").unlink()
    with archive.index._use() as connection:
        connection.execute("UPDATE reconstructor SET record = 'x' WHERE id = 'cm-01'")
    assert going(archive, keep_days=26.5) == ["cm-02"]
    because = {item.id: item.kept_because for item in items(archive)}
    assert because["cm-00"].startswith("its file cannot be found")
    assert because["cm-01"] == "its record is not understood"


def test_what_is_known_of_one_stays_when_its_numbers_go_also_after_a_restart(archive):
    item = items(archive)[0]
    assert retention.remove(archive, item, "too old").text.endswith(
        "cm-00: numbers removed, too old"
    )
    with pytest.raises(UnknownIdError, match="no such matrix"):
        archive.reconstructors.matrix("cm-00")
    archive.close()
    assert archive.open() == ()
    first = archive.reconstructors.records()[0]
    assert (first.id, first.state) == ("cm-00", MatrixState.SUPERSEDED)
    assert not list(archive.directory.glob("reconstructors/cm-00*"))
    with pytest.raises(UnknownIdError, match="no such product"):
        archive.pin(Pin(id="cm-00", who="Ada", why=""))


def test_one_killed_between_index_and_disk_has_lost_nothing(archive):
    archive.index.forget_numbers("reconstructor", "cm-00")
    archive.close()
    assert archive.open() == ()
    np.testing.assert_array_equal(archive.reconstructors.matrix("cm-00"), MATRIX)
    assert archive.reconstructors.records()[0].state is MatrixState.SUPERSEDED


# --- while a service runs


@pytest.fixture
def quick(monkeypatch):
    for name in ("SPACE_CHECK_INTERVAL_S", "REMOVAL_PAUSE_S"):
        monkeypatch.setattr(archiving, name, 0.0)
    monkeypatch.setattr(archiving.time, "time_ns", lambda: NOW)


async def kept_for_a_moment(archive, keeping, state, monkeypatch):
    """Two whole rounds, however long the machine takes for them."""
    told, rounds = [], []

    def low_on_space(*args, **said):
        if len(rounds) == 2:
            raise asyncio.CancelledError
        rounds.append(1)
        return retention.low_on_space(*args, **said)

    monkeypatch.setattr(archiving, "low_on_space", low_on_space)
    recorder = archiving.ArchiveWriter(archive, lambda: state, told.append)
    with suppress(asyncio.CancelledError):
        await asyncio.wait_for(recorder.keep_house(keeping), 60.0)
    return told, recorder._entries


async def test_a_running_service_removes_what_is_old_and_says_so(archive, quick, monkeypatch):
    archive.pin(Pin(id="cm-01", who="Ada", why="mine"))
    state = tracker_state(system="small", in_use="cm-00")
    told, lines = await kept_for_a_moment(
        archive, RetentionPolicy(keep_days=26.5), state, monkeypatch
    )
    assert told == []
    assert [(line.who, line.name) for line in lines] == [("service", "archive.removed")]
    assert lines[0].text == "reconstructor cm-02: numbers removed, 27 days old, keep_days is 26.5"


async def test_little_room_is_an_alarm_until_there_is_more(archive, quick, monkeypatch):
    usage = SimpleNamespace(free=1_900_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    state = TrackerState(system="small")
    told, _ = await kept_for_a_moment(archive, RetentionPolicy(reserve_gb=2.0), state, monkeypatch)
    assert "1.9 GB are free" in told[0].text
    assert (told[0].name, told[0].over) == ("disk-low", False)
    raised = changed(
        state, active=(Alarm(name="disk-low", since_ns_utc=1, message=as_message("x", "")),)
    )
    usage.free = 2_100_000_000  # not a tenth more: it would come and go
    told, _ = await kept_for_a_moment(archive, RetentionPolicy(reserve_gb=2.0), raised, monkeypatch)
    assert not told[0].over
    usage.free = 2_300_000_000
    told, _ = await kept_for_a_moment(archive, RetentionPolicy(reserve_gb=2.0), raised, monkeypatch)
    assert told[0].over
    assert (await kept_for_a_moment(archive, RetentionPolicy(reserve_gb=2.0), state, monkeypatch))[
        0
    ] == []


# --- over HTTP


async def test_who_pins_a_matrix_and_why_is_kept_and_told(archive):
    lines = []
    tracker = tracker_state(system="small", in_use="cm-03")

    async def audited(entry):
        lines.append(entry)

    service = SimpleNamespace(
        archive=archive, audited=audited, snapshot=lambda: SimpleNamespace(tracker=tracker)
    )
    transport = httpx.ASGITransport(create_app(service), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        said = {"by": "Ada", "reason": "for the paper"}
        path = "/v1/archive/cm-04/pin"
        assert (await client.put(path, json=said)).json()["text"] == "cm-04 is kept for ever"
        body = (await client.get("/v1/archive")).json()
        because = {one["id"]: one["kept_because"] for one in body["products"]}
        assert because["cm-04"] == "pinned by Ada: for the paper"
        assert because["cm-03"] == "in use"
        assert body["n_bytes"] == sum(one["n_bytes"] for one in body["products"]) > N * 120_000
        assert (await client.request("DELETE", path, json={"by": "Eve"})).status_code == 202
        assert (await client.delete(path)).status_code == 404
        assert (await client.put("/v1/archive/cm-77/pin", json=said)).status_code == 404
    assert [(line.who, line.name, line.text) for line in lines] == [
        ("Ada", "archive.pinned", "cm-04"),
        ("Eve", "archive.unpinned", "cm-04"),
    ]
    assert archive.index.pins() == ()


# --- from the command line, beside a service that runs and without one


def told(capsys, *words):
    status = main(["archive", *words])
    said = capsys.readouterr()
    return status, said.out, said.err


def test_the_command_line_reads_beside_a_service(archive, tmp_path, capsys):
    where = ("--data-dir", str(tmp_path))
    status, out, _ = told(capsys, "list", *where, "--json")
    assert status == 0
    assert [item["id"] for item in json.loads(out)] == [f"cm-{k:02}" for k in range(N)]
    assert "cm-00" in told(capsys, "list", *where)[1]
    assert told(capsys, "verify", *where)[:2] == (
        0,
        f"{N} products, 0 damaged; the index is sound\n",
    )
    status, out, _ = told(capsys, "prune", "--dry-run", *where)
    assert (status, out) == (0, "")
    status, _, err = told(capsys, "prune", *where)
    assert status == 2
    assert "in use by another service" in err


def test_what_is_damaged_is_named_with_what_that_means(archive, tmp_path, capsys):
    path = product(archive, "cm-11")
    archive.close()
    path.chmod(0o644)
    data = bytearray(path.read_bytes())
    place = data.find(MATRIX.tobytes())
    data[place : place + 4] = b"\x00\x00\x80\x3f"
    path.write_bytes(data)
    product(archive, "cm-12").unlink()
    status, out, _ = told(capsys, "verify", "--data-dir", str(tmp_path), "--json")
    assert status == 1
    found = json.loads(out)
    assert (found["n_products"], found["index"]) == (N, "")
    first, second = sorted(found["damaged"], key=lambda damage: damage["id"])
    assert (first["id"], first["path"]) == ("cm-11", str(path))
    assert "found checksum" in first["found"]
    assert "cannot be sent, nor gone back to" in first["means"]
    assert "backup" in first["do"]
    assert "missing" in second["found"]
    status, out, _ = told(capsys, "show", "cm-11", "--data-dir", str(tmp_path), "--json")
    shown = json.loads(out)
    assert (status, shown["state"]) == (1, "superseded")
    assert shown["record"]["alpha"]["shift_x_subap"] == 0.2
    assert "found checksum" in shown["damage"]


def test_what_is_too_much_goes_when_no_service_runs(archive, tmp_path, capsys, monkeypatch):
    archive.close()
    n_bytes = product(archive, "cm-00").stat().st_size
    monkeypatch.setenv("PYRCAL_ARCHIVE__KEEP_GB", f"{28.5 * n_bytes / 1e9:.9f}")
    where = ("--data-dir", str(tmp_path))
    out = told(capsys, "prune", "--dry-run", "--json", *where)[1]
    assert [item["id"] for item in json.loads(out)] == ["cm-00", "cm-01"]
    assert product(archive, "cm-00").exists()
    assert told(capsys, "prune", *where)[0] == 0
    assert not product(archive, "cm-00").exists()
    with archive:
        archive.open()
        lines = archive.audit_trail()
    assert [(line.who, line.name) for line in lines] == [
        ("pyrcal archive prune", "archive.removed")
    ] * 2
    assert json.loads(told(capsys, "prune", "--json", *where)[1]) == []


def test_an_archive_of_before_is_read_and_left_as_it_was(tmp_path, capsys):
    shutil.copytree(WRITTEN, tmp_path / "var")
    where = ("--data-dir", str(tmp_path / "var"))
    status, out, _ = told(capsys, "list", *where, "--json")
    kinds = [(item["id"], item["kind"]) for item in json.loads(out)]
    assert status == 0
    assert ("cm-1", "reconstructor") in kinds
    assert ("im-1", "measurement") in kinds
    assert told(capsys, "verify", *where)[0] == 0
    before = (WRITTEN / "index.sqlite").read_bytes()
    assert (tmp_path / "var" / "index.sqlite").read_bytes() == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["list"], "found no index.sqlite, expected the data_dir of a service"),
        (["prune"], "found no index.sqlite"),
    ],
)
def test_a_folder_that_is_no_archive_is_refused_and_none_is_made(tmp_path, capsys, words, said):
    status, _, err = told(capsys, *words, "--data-dir", str(tmp_path / "nowhere"))
    assert status == 2
    assert said in err
    assert not (tmp_path / "nowhere").exists()


def test_an_id_that_is_none_is_refused(archive, tmp_path, capsys):
    status, _, err = told(capsys, "show", "cm-99", "--data-dir", str(tmp_path))
    assert status == 2
    assert "pyrcal archive list has all" in err
