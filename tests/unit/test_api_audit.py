"""The audit trail over HTTP, from an archive on the disk."""

import csv
import io
import json

import pytest

from service.archive import Archive, AuditEntry
from service.web import archive as kept
from tests.support.api import SECOND, FakeService, a_snapshot

N_ENTRIES = 12


@pytest.fixture
def service(tmp_path):
    archive = Archive(tmp_path)
    archive.open()
    with archive:
        entries = tuple(
            AuditEntry(
                t_ns_utc=k * SECOND,
                who="Ada" if k % 2 else "service",
                name=f"entry-{k}",
                text="=1+1" if k == 3 else "a, b",
                channel="page" if k % 2 else "",
                why="clouds\u2028",
            )
            for k in range(N_ENTRIES)
        )
        archive.record((), entries)
        yield FakeService(a_snapshot(), archive=archive)


async def names(client, query=""):
    answer = await client.get(f"/v1/audit{query}")
    assert answer.status_code == 200, answer.text
    return [entry["name"] for entry in answer.json()["entries"]]


async def test_the_newest_come_without_a_word_oldest_first(client):
    assert await names(client, "?limit=2") == ["entry-10", "entry-11"]
    (first, *_) = (await client.get("/v1/audit")).json()["entries"]
    assert first == {
        "t_ns_utc": 0,
        "t_utc": None,
        "who": "service",
        "name": "entry-0",
        "text": "a, b",
        "address": "",
        "channel": "",
        "why": "clouds\\u2028",
        "answer": "",
        "cause": "",
        "id": 1,
    }


async def test_whoever_turns_the_pages_sees_each_entry_once_and_what_comes_meanwhile(
    client, service
):
    found, after = [], 0
    while page := (await client.get(f"/v1/audit?limit=5&after={after}")).json()["entries"]:
        found += [entry["name"] for entry in page]
        after = page[-1]["id"]
        if len(found) == 5:
            late = AuditEntry(t_ns_utc=0, who="service", name="late", text="")
            service.archive.record((), (late,))
    assert found == [*(f"entry-{k}" for k in range(N_ENTRIES)), "late"]


@pytest.mark.parametrize(
    "query",
    [
        "since_ns=3000000000&until_ns=5000000000",
        "since=1970-01-01T00:00:03Z&until=1970-01-01T01:00:05%2B01:00",
    ],
)
async def test_a_time_is_told_in_nanoseconds_or_as_a_clock_does(client, query):
    assert await names(client, f"?{query}") == ["entry-3", "entry-4", "entry-5"]


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("since=yesterday", "query.since"),
        ("since=2026-03-01T21:14:03", "timezone"),
        ("since=2026", "expected a time such as 2026-03-01T21:14:03Z"),
        ("until=0.5", "expected a time such as"),
        ("since_ns=2&until_ns=1", "since <= until"),
        ("limit=0", "query.limit"),
        ("after=-1", "query.after"),
        (f"after={10**30}", "query.after"),
        (f"since_ns={10**30}", "query.since_ns"),
        ("format=xml", "query.format"),
        ("whom=me", "query.whom"),
    ],
)
async def test_a_part_that_there_cannot_be_is_refused(client, query, words):
    answer = await client.get(f"/v1/audit?{query}")
    assert answer.status_code == 422, answer.text
    assert words in answer.json()["detail"]


async def test_an_export_has_all_of_it_whatever_a_page_holds(client, monkeypatch):
    monkeypatch.setattr(kept, "EXPORT_PAGE_ENTRIES", 5)
    lines = await client.get("/v1/audit?format=jsonl")
    assert lines.headers["content-type"].startswith("application/jsonl")
    assert 'filename="audit.jsonl"' in lines.headers["content-disposition"]
    read = [json.loads(line) for line in lines.text.splitlines()]
    assert [entry["id"] for entry in read] == list(range(1, N_ENTRIES + 1))
    assert read[3]["t_utc"] == "1970-01-01T00:00:03.000000Z"
    table = list(csv.DictReader(io.StringIO((await client.get("/v1/audit?format=csv")).text)))
    assert [row["name"] for row in table] == [entry["name"] for entry in read]
    assert table[3]["t_utc"] == "1970-01-01T00:00:03.000000Z"
    assert table[0]["text"] == "a, b"
    assert table[3]["text"] == "'=1+1"
    assert len((await client.get("/v1/audit?format=csv&since_ns=11000000000")).text.split()) == 3


@pytest.mark.parametrize(
    ("headers", "channel"),
    [
        ({}, "rest"),
        ({"User-Agent": "curl/8"}, "rest"),
        ({"User-Agent": "pyrcal/1.0"}, "cli"),
        ({"Origin": "http://localhost", "User-Agent": "Mozilla"}, "page"),
        ({"Sec-Fetch-Site": "same-origin"}, "page"),
    ],
)
async def test_an_order_says_who_why_and_where_from(client, service, headers, channel):
    said = {"reason": "too many modes", "by": "Ada"}
    for method, path, body in (
        ("POST", "/v1/rollback", {}),
        ("POST", "/v1/reconstructors/cm-1/reject", {}),
        ("PUT", "/v1/mode", {"mode": "hold"}),
        ("DELETE", "/v1/measurements/im-1", {}),
    ):
        answer = await client.request(method, path, json={**body, **said}, headers=headers)
        assert answer.status_code == 202, answer.text
        assert answer.json()["text"].endswith("is on its way")
    for command, caller in zip(service.commands, service.callers, strict=True):
        assert (command.reason, command.by) == ("too many modes", "Ada")
        assert (caller.address, caller.channel) == ("127.0.0.1", channel)
    assert len(service.commands) == 4


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"reason": "a" * 501}, "body.reason"),
        ({"by": "b" * 101}, "body.by"),
        ({"reason": "\x1b[31m"}, r"found '\x1b' in reason"),
        ({"by": "A\nda"}, r"found '\n' in by"),
        ({"reason": 3}, "body.reason: found 3"),
        ({"reason": "a" * 501, "by": 4}, "body.by: found 4"),
    ],
)
async def test_words_that_cannot_be_kept_are_refused_with_all_that_is_wrong(
    client, service, said, words
):
    answer = await client.post("/v1/rollback", json=said)
    assert answer.status_code == 422
    assert words in answer.json()["detail"]
    assert "\x1b" not in answer.text
    assert service.commands == []
