"""Notes of operators, and how two reconstructors are compared."""

import numpy as np
import pytest

from service.archive.nights import Annotation
from service.errors import StorageError
from tests.unit.test_api import MATRIX, SECOND, assert_problem, service

__all__ = ["service"]  # a fixture

NOTED = {"note": "dome closed, wind 18 m/s", "t_ns_utc": 50 * SECOND, "by": "Ada"}


async def test_a_note_is_kept_with_its_time_in_the_history_and_the_trail(client, service):
    response = await client.post("/v1/annotations", json=NOTED)
    assert response.status_code == 201, response.text
    where = response.headers["location"]
    (found,) = (await client.get(where)).json()["annotations"]
    assert (found["id"], found["t_ns_utc"], found["who"]) == (1, 50 * SECOND, "Ada")
    assert found["note"] == NOTED["note"]
    assert found["written_ns_utc"] > 50 * SECOND
    (mark,) = (await client.get("/v1/marks")).json()["marks"]
    assert (mark["kind"], mark["name"], mark["text"]) == ("note", "Ada", NOTED["note"])
    (entry,) = service.trail
    assert (entry.name, entry.who, entry.text) == ("annotation", "Ada", NOTED["note"])


async def test_a_note_without_a_time_is_of_now(client):
    await client.post("/v1/annotations", json={"note": "clouds"})
    (found,) = (await client.get("/v1/annotations")).json()["annotations"]
    assert found["t_ns_utc"] == found["written_ns_utc"]


async def test_notes_of_a_time_are_its_newest_oldest_first(client, service):
    for k in range(5):
        note = Annotation(t_ns_utc=k * SECOND, written_ns_utc=k, who="Ada", note=f"note {k}")
        service.archive.nights.add_note(note)
    asked = {"since_ns": SECOND, "until_ns": 4 * SECOND, "limit": 3}
    found = (await client.get("/v1/annotations", params=asked)).json()["annotations"]
    assert [one["note"] for one in found] == ["note 2", "note 3", "note 4"]


@pytest.mark.parametrize("body", [{}, {"note": ""}, {"note": "x" * 2001}, {"t_ns_utc": 5}])
async def test_a_note_that_says_nothing_is_refused(client, body):
    assert_problem(await client.post("/v1/annotations", json=body), 422, "invalid", "note")


async def test_a_note_the_disk_refuses_is_told(client, service, monkeypatch):
    def refuses(_):
        raise StorageError("disk full")

    monkeypatch.setattr(service.archive.nights, "add_note", refuses)
    refused = await client.post("/v1/annotations", json=NOTED)
    assert_problem(refused, 507, "archive-failed", "disk full")
    assert not service.trail


async def test_two_reconstructors_are_compared_mode_by_mode(client, service, monkeypatch):
    turned = -2.0 * MATRIX[:2]
    matrices = {"cm-1": MATRIX, "cm-2": turned, "cm-3": MATRIX[:, :2]}
    monkeypatch.setattr(service, "matrix", matrices.__getitem__)
    body = (await client.get("/v1/reconstructors/cm-1/compared-with/cm-2")).json()
    assert body["modes"] == [0, 1]
    assert body["gain"] == pytest.approx([0.5, 0.5])
    assert body["cosine"] == pytest.approx([-1.0, -1.0])
    assert body["difference"] == pytest.approx(1.5)
    same = (await client.get("/v1/reconstructors/cm-1/compared-with/candidate")).json()
    assert (same["other"], same["difference"]) == ("cm-1", 0.0)
    np.testing.assert_allclose(same["cosine"], 1.0, rtol=1e-3)
    other = await client.get("/v1/reconstructors/cm-1/compared-with/cm-3")
    assert_problem(other, 409, "not-now", "4 slopes in cm-1 and 2 in cm-3")
