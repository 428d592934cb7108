"""α over the nights: on the disk, for a chart of any time, beside what happened."""

import sqlite3
from contextlib import closing
from dataclasses import fields
from types import SimpleNamespace

import httpx
import numpy as np
import pytest

from service.api import create_app
from service.archive import Archive, AuditEntry
from service.archive import nights as of_nights
from service.archive.nights import DAY_NS, HOUR_NS, MarkKind
from service.errors import ArchiveError, StorageError, TooLargeError
from service.model.misregistration import Misregistration
from service.records.registration import HistoryEntry, Source
from service.web.history import downsample
from tests.support.archive_nights import NOON, SECOND, entry
from tests.support.states import tracker_state


def line(t_ns, name, text="so it was", who="service"):
    return AuditEntry(t_ns_utc=t_ns, who=who, name=name, text=text)


def assert_same(found, expected):
    for field in fields(HistoryEntry):
        ours, theirs = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(theirs, Misregistration):
            ours, theirs = ours.vector, theirs.vector
        if isinstance(theirs, np.ndarray | float):
            np.testing.assert_allclose(ours, theirs, rtol=1e-14, err_msg=field.name)
        else:
            assert (ours, type(ours)) == (theirs, type(theirs)), field.name


def test_an_estimate_comes_back_as_it_was_whatever_it_holds(tmp_path):
    every = (
        entry(NOON),
        entry(
            NOON + 1,
            source=Source.PASSIVE,
            entered=False,
            in_use=None,
            misfit=float("nan"),
            measured_sigma=np.array([np.inf, 0.1, 0.2, 0.3]),
        ),
    )
    archive = Archive(tmp_path)
    archive.open()
    archive.record((), (), every)
    archive.close()
    assert archive.open() == ()
    with archive:
        for found, expected in zip(archive.nights.estimates(0, 2 * NOON, 10), every, strict=True):
            assert_same(found, expected)


def test_the_newest_or_the_oldest_of_a_time_come_oldest_first(archive):
    archive.record((), (), [entry(NOON + k) for k in range(10)])

    def times(*asked, **how):
        return [found.t_ns_utc - NOON for found in archive.nights.estimates(*asked, **how)]

    assert times(NOON + 2, NOON + 7, 3) == [5, 6, 7]
    assert times(NOON + 2, NOON + 7, 3, newest=False) == [2, 3, 4]
    assert times(NOON + 20, NOON + 30, 3) == []


def test_of_many_the_same_are_kept_as_of_those_in_memory(archive, monkeypatch):
    rng = np.random.default_rng(3)
    values = np.cumsum(rng.normal(0.0, 0.01, (3000, 4)), axis=0)
    values[:, 3] = 1.0 + 0.01 * values[:, 3]
    every = tuple(
        entry(NOON + k * SECOND, filtered=Misregistration.from_vector(value))
        for k, value in enumerate(values)
    )
    archive.record((), (), every)
    found = archive.nights.downsampled(0, 2 * NOON, 400)
    assert 200 < len(found) <= 400
    assert [one.t_ns_utc for one in found] == [one.t_ns_utc for one in downsample(every, 400)]
    assert len(archive.nights.downsampled(NOON, NOON + 99 * SECOND, 400)) == 100
    monkeypatch.setattr(of_nights, "MAX_DOWNSAMPLED", 2999)
    with pytest.raises(TooLargeError, match="found 3000 estimates in this time, expected at most"):
        archive.nights.downsampled(0, 2 * NOON, 400)


@pytest.mark.parametrize(("noon_utc_h", "n_before", "n_after"), [(12, 2, 10), (19, 9, 3)])
def test_a_night_ends_at_noon_where_the_telescope_is(tmp_path, noon_utc_h, n_before, n_after):
    archive = Archive(tmp_path, noon_utc_h)
    archive.open()
    with archive:
        first_ns = NOON - 2 * HOUR_NS
        archive.record((), (), [entry(first_ns + k * HOUR_NS) for k in range(12)])
        before, after = archive.nights.between(0, 2 * NOON)
    assert (before.date, after.date) == ("2024-10-03", "2024-10-04")
    assert (before.n_estimates, after.n_estimates) == (n_before, n_after)
    assert after.since_ns_utc == before.until_ns_utc + 1 == NOON + (noon_utc_h - 12) * HOUR_NS
    assert before.duration_s == (n_before - 1) * 3600.0


def test_a_night_is_told_with_what_happened_in_it(archive):
    told = [
        line(NOON, "service.ready"),
        line(NOON + 1, "reconstructor.adopted"),
        line(NOON + 2, "margin", "too short"),
        line(NOON + 3, "margin", "margin: over"),
        line(NOON + 4, "registration.jump"),
        line(NOON + 5, "reconstructor.applied"),
        line(NOON + 6, "reconstructor.applied", who="Ada"),
        line(NOON + 7, "window.refused"),
        line(NOON + DAY_NS, "loop-open", "close it"),
    ]
    archive.record((), told, [entry(NOON + k * SECOND) for k in (0, 60, 90)])
    first, second = archive.nights.between(0, 2 * NOON)
    assert (first.n_estimates, first.duration_s) == (3, 90.0)
    assert (first.n_swaps, first.n_jumps, first.n_alarms) == (2, 1, 1)
    assert (second.n_estimates, second.duration_s, second.n_alarms) == (0, 0.0, 1)
    marks = archive.nights.marks(first.since_ns_utc, first.until_ns_utc, 100)
    assert [mark.kind for mark in marks] == [
        MarkKind.START,
        MarkKind.SWAP,
        MarkKind.ALARM,
        MarkKind.OVER,
        MarkKind.JUMP,
        MarkKind.SWAP,
    ]
    assert archive.nights.marks(0, 2 * NOON, 1)[0].name == "loop-open"
    assert archive.nights.between(NOON + DAY_NS, 2 * NOON) == (second,)


def test_who_reads_is_not_kept_waiting_by_who_writes_nor_the_other_way_round(archive):
    archive.record((), (), [entry(NOON)])
    with archive.index._lock:
        assert len(archive.nights.estimates(0, 2 * NOON, 10)) == 1
    with closing(sqlite3.connect(archive.directory / "index.sqlite")) as reader:
        reader.execute("BEGIN")
        reader.execute("SELECT * FROM estimate").fetchone()
        archive.record((), (line(NOON, "note"),))
    with pytest.raises(StorageError, match="readonly"):
        archive.index.asked("DELETE FROM estimate", ())


def test_an_index_that_has_gone_or_is_damaged_is_named(archive, tmp_path):
    path = tmp_path / "index.sqlite"
    archive.close()
    path.write_bytes(b"not a database" * 1000)
    with pytest.raises(ArchiveError, match=r"index\.sqlite: damaged .*move it away"):
        archive.nights.marks(0, NOON, 1)
    path.unlink()
    with pytest.raises(StorageError, match=r"index\.sqlite: cannot be used"):
        archive.nights.between(0, NOON)


# --- over HTTP


@pytest.fixture
async def client(archive):
    """Of a service that remembers the last three estimates of ten."""
    every = tuple(entry(NOON + k * SECOND, shift_x=0.1 * k) for k in range(10))
    archive.record((), [line(NOON + SECOND, "registration.jump")], every)
    state = tracker_state(system="small", history=every[7:])
    service = SimpleNamespace(archive=archive, snapshot=lambda: SimpleNamespace(tracker=state))
    transport = httpx.ASGITransport(create_app(service), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        yield client


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("", range(10)),
        ("limit=2", [8, 9]),
        ("limit=5", [5, 6, 7, 8, 9]),
        (f"until_ns={NOON + 5 * SECOND}&limit=2", [4, 5]),
        (f"since_ns={NOON + 8 * SECOND}", [8, 9]),
        (f"since_ns={NOON + 6 * SECOND}&until_ns={NOON + 8 * SECOND}&limit=9", [6, 7, 8]),
        (f"after={NOON + 2 * SECOND}&limit=3", [3, 4, 5]),
        (f"after={NOON + 5 * SECOND}&limit=3", [6, 7, 8]),
        ("points=8", [0, 9]),
        ("points=16", range(10)),
    ],
)
async def test_the_history_goes_on_in_the_archive_where_memory_ends(client, query, expected):
    answer = await client.get(f"/v1/alpha/history?{query}")
    assert answer.status_code == 200, answer.text
    found = [(one["t_ns_utc"] - NOON) // SECOND for one in answer.json()["entries"]]
    assert found == list(expected)


async def test_nights_and_marks_are_told_over_http(client):
    (night,) = (await client.get("/v1/nights")).json()["nights"]
    assert night["date"] == "2024-10-04"
    assert night["since_utc"] == "2024-10-04T12:00:00.000000Z"
    assert (night["n_estimates"], night["duration_s"], night["n_jumps"]) == (10, 9.0, 1)
    (mark,) = (await client.get(f"/v1/marks?since_ns={NOON}")).json()["marks"]
    assert (mark["kind"], mark["name"]) == ("jump", "registration.jump")
    assert (await client.get(f"/v1/marks?since_ns={2 * NOON}")).json()["marks"] == []
    assert (await client.get("/v1/marks?limit=0")).status_code == 422


async def test_too_much_at_once_is_refused_with_what_to_do(client, monkeypatch):
    monkeypatch.setattr(of_nights, "MAX_DOWNSAMPLED", 5)
    answer = await client.get("/v1/alpha/history?points=8")
    assert answer.status_code == 413
    assert "ask for less of it" in answer.json()["detail"]
