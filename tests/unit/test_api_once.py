"""Orders sent twice, and orders on what has changed since it was seen."""

import asyncio
from dataclasses import replace

import pytest

from service.errors import CommandError, StorageError
from service.records.messages import as_message
from service.records.products import MatrixState, ReconstructorRecord
from service.web import connections
from tests.support.api import FakeService, a_snapshot
from tests.support.states import tracker_state

CM = ReconstructorRecord(id="cm-1", state=MatrixState.PROPOSED, n_modes=400, created_ns_utc=1)


class Slow(FakeService):
    """Counts what it is asked, and takes its time."""

    async def submit(self, command, caller, order_id=""):
        await asyncio.sleep(0.01)
        caller.check()
        await super().submit(command, caller, order_id)
        return as_message("command", f"order {len(self.commands)}")


@pytest.fixture
def service():
    known = tracker_state(system="flao-lbt", reconstructors=(CM,))
    return Slow(a_snapshot(known, now_ns=0, started_ns=0))


def keyed(client, key="k-1", path="/v1/rollback", **body):
    return client.post(path, json=body, headers={"Idempotency-Key": key})


async def test_an_order_sent_again_is_answered_as_before_and_carried_out_once(client, service):
    first, again = await keyed(client), await keyed(client)
    assert first.json()["text"] == again.json()["text"] == "order 1"
    for answer in (first, again):
        assert answer.headers.pop("x-request-id"), "of each request its own"
    assert (again.status_code, again.headers) == (first.status_code, first.headers)
    assert (await keyed(client, "k-2")).json()["text"] == "order 2"
    await client.post("/v1/rollback")
    await client.post("/v1/rollback")
    assert len(service.commands) == 4


async def test_a_double_click_is_one_click(client, service):
    answers = await asyncio.gather(*(keyed(client) for _ in range(5)))
    assert {answer.json()["text"] for answer in answers} == {"order 1"}
    assert len(service.commands) == 1


@pytest.mark.parametrize(
    "other", [{"path": "/v1/rollback", "reason": "so"}, {"path": "/v1/refit"}, {"path": "/v1/stop"}]
)
async def test_a_key_is_for_one_request(client, service, other):
    await keyed(client)
    answer = await keyed(client, **other)
    assert answer.status_code == 422
    assert "Idempotency-Key: found a key that was used with another" in answer.json()["detail"]
    assert answer.headers["content-type"] == "application/problem+json"
    assert len(service.commands) == 1


async def test_a_refusal_is_an_answer_too_but_not_that_nothing_could_be_done(client, service):
    service.refusal = CommandError("not now")
    assert (await keyed(client)).status_code == 409
    service.refusal = None
    assert (await keyed(client)).json()["detail"] == "not now"
    service.refusal = StorageError("the disk is full")
    assert (await keyed(client, "k-2")).status_code == 507
    service.refusal = None
    assert (await keyed(client, "k-2")).status_code == 202


async def test_of_clicks_that_waited_for_a_failure_one_is_carried_out(client, service):
    obeyed = service.submit

    async def full_at_first(*_):
        service.submit = obeyed
        await asyncio.sleep(0.01)  # the others wait
        raise StorageError("the disk is full")

    service.submit = full_at_first
    first, *others = await asyncio.gather(*(keyed(client) for _ in range(4)))
    assert first.status_code == 507
    assert {click.json()["text"] for click in others} == {"order 1"}
    assert len(service.commands) == 1


@pytest.mark.parametrize("key", ["", "k" * 201])
async def test_a_key_that_is_none_is_refused(client, service, key):
    answer = await keyed(client, key)
    assert answer.status_code == 422
    assert f"found {len(key)} characters, expected 1 to 200" in answer.json()["detail"]
    assert service.commands == []


async def test_an_upload_takes_no_key(client):
    answer = await client.post("/v1/fits", content=b"x", headers={"Idempotency-Key": "k"})
    assert answer.status_code == 422
    assert "none with an upload" in answer.json()["detail"]


async def test_what_is_remembered_is_bounded_and_the_oldest_goes_first(
    client, service, monkeypatch
):
    monkeypatch.setattr(connections, "MAX_KEPT_ANSWERS", 3)
    for k in range(4):
        await keyed(client, f"k-{k}")
    assert (await keyed(client, "k-3")).json()["text"] == "order 4"
    assert (await keyed(client, "k-0")).json()["text"] == "order 5"


# --- what an order was decided on

DECISIONS = [
    ("/v1/reconstructors/cm-1", "/v1/reconstructors/cm-1/approve"),
    ("/v1/reconstructors/cm-1", "/v1/reconstructors/cm-1/reject"),
    ("/v1/reconstructors/cm-1", "/v1/reconstructors/cm-1/publish"),
    ("/v1/reconstructors", "/v1/rollback"),
]


@pytest.mark.parametrize(("seen", "order"), DECISIONS)
async def test_who_decides_on_what_has_changed_since_is_told_to_look_again(
    client, service, seen, order
):
    tag = (await client.get(seen)).headers["etag"]
    assert (await client.get(seen)).headers["etag"] == tag
    assert (await client.post(order, headers={"If-Match": tag})).status_code == 202
    discarded = replace(CM, state=MatrixState.DISCARDED)
    service.change(reconstructors=(discarded,))
    answer = await client.post(order, headers={"If-Match": tag})
    assert answer.status_code == 412
    assert answer.json()["type"] == "urn:pyrcal:problem:stale"
    assert "read it again" in answer.json()["detail"]
    now = (await client.get(seen)).headers["etag"]
    for given in (now, f'"other", {now}', "*"):
        assert (await client.post(order, headers={"If-Match": given})).status_code == 202
    assert len(service.commands) == 4


async def test_a_rollback_is_decided_on_the_one_before_whatever_is_judged_or_proposed_beside_it(
    client, service
):
    def use(*records):
        service.change(reconstructors=records, in_use=records[-1].id)

    async def back(tag):
        return (await client.post("/v1/rollback", headers={"If-Match": tag})).status_code

    before, used = replace(CM, state=MatrixState.SUPERSEDED), replace(CM, id="cm-2")
    use(before, replace(used, state=MatrixState.APPLIED))
    all_, one = [
        (await client.get(f"/v1/reconstructors{path}")).headers["etag"] for path in ("", "/cm-1")
    ]
    assert (await client.get("/v1/reconstructors/previous")).headers["etag"] == one
    use(before, replace(used, state=MatrixState.APPLIED, reason="judged again"))
    assert (await back(all_), await back(one)) == (412, 202)
    use(before, replace(used, state=MatrixState.SUPERSEDED), replace(used, id="cm-3"))
    assert await back(one) == 412


@pytest.mark.parametrize(("seen", "order"), DECISIONS)
async def test_who_wants_to_be_held_to_it_must_say_what_was_seen(client, service, seen, order):
    strict = {"Prefer": "respond-async, handling=strict"}
    answer = await client.post(order, headers=strict)
    assert answer.status_code == 428
    assert "found no If-Match" in answer.json()["detail"]
    tag = (await client.get(seen)).headers["etag"]
    assert (await client.post(order, headers={**strict, "If-Match": tag})).status_code == 202
    assert (await client.post(order)).status_code == 202
    assert (await client.put("/v1/mode", json={"mode": "hold"}, headers=strict)).status_code == 202
