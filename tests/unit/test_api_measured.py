"""Measured interaction matrices, and noisy ones, over real HTTP messages."""

import hashlib
import io
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from service.records.commands import GiveUp, Measure, MeasureNoisy
from service.records.operations import MeasureState
from service.records.products import ModeSet
from service.web.views import NOISY_MEASUREMENT, to_json
from service.wire import Pattern
from tests.support.api import FakeService, a_snapshot
from tests.support.api_measured import FILE, MATRIX, NOISY, STORED, FakeMatrices
from tests.support.states import tracker_state

NOW_NS, NOW = 1_763_696_400_250_000_000, "20251121T034000.250000"
RUNNING = replace(
    STORED,
    id="im-2",
    state=MeasureState.RUNNING,
    created_ns_utc=None,
    n_slopes=None,
    double_pass=None,
    sha256="",
)
NOISY_RUNNING = replace(NOISY, id="noisy-2", state=MeasureState.RUNNING, finding=None)


@pytest.fixture
def service(tmp_path):
    shelves = {
        "measured": FakeMatrices(tmp_path, "im-1"),
        "noisy": FakeMatrices(tmp_path, "noisy-1"),
    }
    records = (STORED, RUNNING, NOISY, NOISY_RUNNING)
    known = a_snapshot(tracker_state(measurements=records), now_ns=NOW_NS)
    return FakeService(known, archive=SimpleNamespace(**shelves))


@pytest.mark.parametrize(
    ("path", "link", "body", "command"),
    [
        ("measurements", "measurement", None, Measure(id=f"im-{NOW}", pattern="push-pull-modal")),
        (
            "measurements",
            "measurement",
            {
                "pattern": "sine",
                "modes": [3, 9],
                "amplitude_m": 5e-9,
                "frequency_hz": [60.0, 80.0],
                "duration_s": 12.0,
            },
            Measure(
                id=f"im-{NOW}",
                pattern=Pattern.SINE,
                modes=(3, 9),
                amplitude_m=5e-9,
                frequency_hz=(60.0, 80.0),
                duration_s=12.0,
            ),
        ),
        ("noisy-matrix", "matrix", None, MeasureNoisy(id=f"noisy-{NOW}")),
        (
            "noisy-matrix",
            "matrix",
            {"modes": "all", "total_amplitude_m": 2e-9, "duration_s": 60, "over_budget": True},
            MeasureNoisy(
                id=f"noisy-{NOW}",
                modes=ModeSet.ALL,
                total_amplitude_m=2e-9,
                duration_s=60.0,
                over_budget=True,
            ),
        ),
        (
            "noisy-matrix",
            "matrix",
            {"modes": [3, 9]},
            MeasureNoisy(id=f"noisy-{NOW}", modes=(3, 9)),
        ),
    ],
)
async def test_every_choice_reaches_the_command(client, service, path, link, body, command):
    response = await client.post(f"/v1/{path}", json=body)
    assert response.status_code == 202, response.text
    answer = response.json()
    assert (answer["id"], answer["links"][link]) == (command.id, f"/v1/{path}/{command.id}")
    assert service.commands == [command]


@pytest.mark.parametrize(
    ("path", "link"),
    [
        ("measurements/im-2", "measurement"),
        ("measurements/noisy-2", ""),
        ("noisy-matrix/noisy-2", ""),
    ],
)
async def test_one_can_be_given_up(client, service, path, link):
    response = await client.delete(f"/v1/{path}")
    assert response.status_code == 202, response.text
    assert not link or response.json()["links"][link] == f"/v1/{path}"
    assert service.commands == [GiveUp(id=path.partition("/")[2])]


@pytest.mark.parametrize(
    ("path", "name", "ids"),
    [
        ("measurements", "measurements", ["im-1", "im-2"]),
        ("noisy-matrix", "noisy_matrices", ["noisy-1", "noisy-2"]),
    ],
)
async def test_they_are_listed_oldest_first(client, path, name, ids):
    listed = (await client.get(f"/v1/{path}")).json()[name]
    assert [one["id"] for one in listed] == ids
    assert [one["state"] for one in listed] == ["stored", "running"]


async def test_a_measurement_tells_how_it_was_made(client):
    body = (await client.get("/v1/measurements/im-1")).json()
    assert body["modes"] == [0, 7, 3]
    assert body["amplitude_m"] == [1e-8, 2e-8, 2e-8]
    assert (body["pattern"], body["n_average"]) == ("push-pull-modal", 5)
    assert (body["n_slopes"], body["double_pass"]) == (4, False)
    assert body["sha256"] == STORED.sha256


async def test_a_noisy_matrix_tells_how_it_was_made_and_what_it_says(client):
    body = (await client.get("/v1/noisy-matrix/noisy-1")).json()
    assert (body["n_modes"], body["modes"], body["seed"]) == (3, [0, 7, 3], 77)
    assert body["amplitude_m"] == pytest.approx(5e-9 / np.sqrt(3))
    found = body["finding"]
    assert found["alpha"]["rotation_deg"] == pytest.approx(0.2)
    assert found["sigma"]["rotation_deg"] == pytest.approx(0.02)
    assert (found["snr"], found["misfit"]) == (1.4, 1.01)
    assert (found["n_frames"], found["n_missing"]) == (29_994, 6)
    as_measured = (await client.get("/v1/measurements/noisy-2")).json()
    assert (as_measured["id"], as_measured["pattern"]) == ("noisy-2", None)
    assert as_measured["amplitude_m"] == pytest.approx([5e-9 / np.sqrt(3)] * 3)


async def test_one_under_way_has_found_nothing_yet(client, service):
    body = (await client.get("/v1/noisy-matrix/noisy-2")).json()
    assert (body["state"], body["finding"]) == ("running", None)
    state = to_json(service.tracker.noisy_measurement, NOISY_MEASUREMENT)
    assert (state["id"], state["state"], state["duration_s"]) == ("noisy-2", "running", 30.0)


@pytest.mark.parametrize(
    "path",
    [
        "measurements/im-9",
        "measurements/im-9/matrix",
        "measurements/im-9/matrix?format=hdf5",
        "noisy-matrix/noisy-9",
        "noisy-matrix/noisy-9/file",
    ],
)
async def test_an_unknown_one_is_not_found(client, path):
    response = await client.get(f"/v1/{path}")
    assert response.status_code == 404
    assert path.split("/")[1] in response.json()["detail"]


async def test_the_matrix_leaves_as_a_numpy_file(client):
    response = await client.get("/v1/measurements/im-1/matrix")
    assert response.headers["x-shape"] == "4,3"
    assert response.headers["content-disposition"] == 'attachment; filename="im-1.npy"'
    found = np.load(io.BytesIO(response.content), allow_pickle=False)
    np.testing.assert_array_equal(found, MATRIX)
    raw = await client.get("/v1/measurements/im-1/matrix", params={"format": "raw"})
    assert hashlib.sha256(raw.content).hexdigest() == STORED.sha256
    other = await client.get("/v1/measurements/im-1/matrix", params={"format": "csv"})
    assert other.status_code == 422


@pytest.mark.parametrize(
    "path", ["measurements/im-1/matrix?format=hdf5", "noisy-matrix/noisy-1/file"]
)
async def test_the_product_leaves_as_it_lies_in_the_archive(client, path):
    response = await client.get(f"/v1/{path}")
    assert response.content == FILE
    assert response.headers["content-type"] == "application/x-hdf5"
    name = path.split("/")[1]
    assert response.headers["content-disposition"] == f'attachment; filename="{name}.h5"'


@pytest.mark.parametrize("action", ["approve", "publish", "reject"])
async def test_no_route_publishes_a_noisy_matrix(client, service, action):
    response = await client.post(f"/v1/noisy-matrix/noisy-1/{action}")
    assert response.status_code in {404, 405}
    assert service.commands == []
