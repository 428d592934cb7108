"""What is not sent twice, where to look for what was begun, and what became of a refit."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.products import MatrixState, ReconstructorRecord
from service.tracker import step
from tests.support.api import SECOND, STATE, assert_problem, entry
from tests.support.situations import POLICY, rtc
from tests.support.states import changed

DESCRIBED = json.loads(
    (Path(__file__).parents[2] / "docs" / "openapi.json").read_text(encoding="utf-8")
)["paths"]


async def tag_of(client, path):
    response = await client.get(path)
    assert response.status_code == 200, response.text
    return response.headers["etag"]


async def again(client, path, tag):
    return await client.get(path, headers={"If-None-Match": tag})


@pytest.mark.parametrize(
    "path",
    [
        "/v1/reconstructors",
        "/v1/reconstructors/cm-1",
        "/v1/reconstructors/cm-1/matrix",
        "/v1/reconstructors/cm-1/matrix?format=raw",
        "/v1/alpha/history?points=8",
        "/v1/nights",
        "/v1/audit",
        "/v1/gains",
        "/openapi.json",
    ],
)
async def test_what_the_client_has_is_not_sent_again(client, path):
    tag = await tag_of(client, path)
    for sent in (tag, f'"another", {tag.removeprefix("W/")}', "*"):
        same = await again(client, path, sent)
        assert (same.status_code, same.content) == (304, b"")
        assert same.headers["etag"] == tag
    assert (await again(client, path, '"another"')).status_code == 200


async def test_what_has_changed_is_sent(client, service):
    tag = await tag_of(client, "/v1/alpha/history")
    service.change(history=(*STATE.alpha.history[2:], entry(5)))
    changed = await again(client, "/v1/alpha/history", tag)
    assert changed.status_code == 200
    assert len(changed.json()["entries"]) == 4
    service.archive.record((), (), (entry(1),))  # of the run before
    older = await again(client, "/v1/alpha/history", changed.headers["etag"])
    assert len(older.json()["entries"]) == 5


async def test_numbers_of_another_format_are_others(client):
    tags = {
        await tag_of(client, f"/v1/reconstructors/cm-1/matrix?format={form}")
        for form in ("npy", "raw")
    }
    assert len(tags) == 2


async def test_numbers_are_not_read_from_the_disk_for_who_has_them(client, service):
    path = "/v1/reconstructors/cm-1/matrix"
    tag = await tag_of(client, path)
    service.thread = None
    assert (await again(client, path, tag)).status_code == 304
    assert service.thread is None


async def test_a_problem_has_no_tag(client):
    assert "etag" not in (await client.get("/v1/reconstructors/cm-9")).headers


@pytest.mark.parametrize(
    ("path", "body", "where"),
    [
        ("/v1/reconstructors/cm-1/approve", {}, "/v1/reconstructors/cm-1"),
        ("/v1/acquisition", {"action": "start"}, "/v1/state"),
        ("/v1/loop", {"loop": "open"}, "/v1/state"),
    ],
)
async def test_where_to_look_for_what_was_begun_is_in_the_head(client, path, body, where):
    response = await client.post(path, json=body)
    assert response.status_code == 202, response.text
    assert response.headers["location"] == where
    assert where in response.json()["links"].values()


async def test_what_is_measured_is_where_the_head_says(client):
    response = await client.post("/v1/measurements", json={})
    assert response.headers["location"] == f"/v1/measurements/{response.json()['id']}"


async def test_a_refit_is_a_job_that_tells_what_it_has_made(client, service):
    response = await client.post("/v1/refit", json={"n_modes": 300})
    where, name = response.headers["location"], response.json()["id"]
    assert where == f"/v1/refits/{name}"
    assert service.commands == [cmd.Refit(n_modes=300)]
    job = (await client.get(where)).json()
    assert (job["state"], job["n_modes"], job["reconstructor"]) == ("running", 300, None)
    assert job["asked_ns_utc"] == 100 * SECOND


MADE = ReconstructorRecord(
    id="cm-2", state=MatrixState.REFUSED, n_modes=300, created_ns_utc=3, reason="unstable"
)
MAKE = ev.MakeMatrix(n_modes=300, why="")


@pytest.mark.parametrize(
    ("event", "state", "made", "reason"),
    [
        (ev.MatrixMade(record=MADE, wanted=True), "refused", "cm-2", "unstable"),
        (ev.JobFailed(effect=MAKE, text="no model"), "failed", None, "no model"),
    ],
)
async def test_how_a_refit_ends_is_kept(client, service, event, state, made, reason):
    begun = changed(service.now.tracker, rtc=rtc())
    for told, cause in (
        (cmd.Refit(n_modes=300), "refit-1"),
        (ev.JobFailed(effect=MAKE, text="another"), "refit-2"),
        (ev.JobFailed(effect=ev.JudgeMatrix(id="cm-1"), text="what else it led to"), "refit-1"),
        (event, "refit-1"),
        (ev.JobFailed(effect=MAKE, text="again"), "refit-1"),
    ):
        begun, _ = step(begun, told, POLICY, service.now.now_ns, cause)
    service.now = replace(service.now, tracker=begun)
    job = (await client.get("/v1/refits/refit-1")).json()
    assert (job["state"], job["reconstructor"]) == (state, made)
    assert reason in job["reason"]


async def test_a_refit_nobody_has_ordered_is_unknown(client):
    assert_problem(await client.get("/v1/refits/refit-9"), 404, "unknown-id", "refit-9")


def test_every_operation_says_what_it_does_and_no_answer_is_called_successful():
    for path, operations in DESCRIBED.items():
        for method, operation in operations.items():
            summary = operation["summary"]
            name = operation["operationId"].replace("_", " ")
            assert len(summary.split()) >= 3, f"{method} {path}: {summary}"
            assert summary.lower() != name
            for status, found in operation["responses"].items():
                assert found["description"] != "Successful Response", f"{method} {path} {status}"
            begun = operation["responses"].get("202", {})
            if method != "get":
                assert "202" not in operation["responses"] or "Location" in begun["headers"]
