"""Noisy interaction matrices over real HTTP messages, with a hand-written service behind."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from service.errors import CommandError, UnknownIdError
from service.model.misregistration import Misregistration
from service.tracking.commands import GiveUp, MeasureNoisy
from service.tracking.operation_records import MeasurementRecord, MeasureState, NoisyFinding
from service.tracking.products import ModeSet
from service.web.views import NOISY_MEASUREMENT, to_json
from tests.states import tracker_state
from tests.unit.obedient import Obedient

FILE, IMAGE = b"\x89HDF the product", b"\x89PNG the picture"
STORED = MeasurementRecord(
    id="noisy-1",
    state=MeasureState.STORED,
    pattern=None,
    modes=(0, 7, 3),
    amplitude_m=(5e-9 / 3**0.5,) * 3,
    duration_s=30.0,
    window_s=5.0,
    seed=77,
    asked_ns_utc=900,
    basis_id="kl",
    config_id="b1",
    finding=NoisyFinding(
        n_slopes=4,
        n_frames=29_994,
        n_missing=6,
        snr=1.4,
        alpha=Misregistration(shift_x_subap=0.1, rotation_rad=np.deg2rad(0.2)),
        covariance=np.diag([0.01, 0.01, np.deg2rad(0.02), 0.001]) ** 2,
        optical_gain=0.6,
        misfit=1.01,
        cm_id="cm-1",
        session="s-1",
        created_ns_utc=1_000,
        sha256="0" * 64,
    ),
)
RUNNING = replace(STORED, id="noisy-2", state=MeasureState.RUNNING, finding=None)


class FakeMatrices:
    """The archive's noisy matrices."""

    def __init__(self, folder):
        self.path = folder / "product.h5"
        self.path.write_bytes(FILE)

    def matrix(self, noisy_id):
        raise AssertionError(f"{noisy_id}: its numbers leave with their noise alone")

    def file(self, noisy_id):
        if noisy_id != "noisy-1":
            raise UnknownIdError(f"noisy matrix {noisy_id}: no such matrix in the archive")
        return self.path


@pytest.fixture
def service(tmp_path):
    return Obedient(
        tracker_state(system="flao-lbt", measurements=(STORED, RUNNING)),
        now_ns=1_763_696_400_250_000_000,
        archive=SimpleNamespace(noisy=FakeMatrices(tmp_path)),
    )


async def test_a_bare_request_takes_the_controlled_modes(client, service):
    response = await client.post("/v1/noisy-matrix")
    assert response.status_code == 202, response.text
    body = response.json()
    assert body["id"] == "noisy-20251121T034000.250000"
    assert body["links"]["matrix"] == f"/v1/noisy-matrix/{body['id']}"
    assert service.commands == [MeasureNoisy(id=body["id"])]


@pytest.mark.parametrize(("modes", "expected"), [("all", ModeSet.ALL), ([3, 9], (3, 9))])
async def test_every_choice_reaches_the_command(client, service, modes, expected):
    body = {
        "modes": modes,
        "total_amplitude_m": 2e-9,
        "duration_s": 60,
        "over_budget": True,
    }
    response = await client.post("/v1/noisy-matrix", json=body)
    assert response.status_code == 202, response.text
    (command,) = service.commands
    assert command == MeasureNoisy(
        id=response.json()["id"],
        modes=expected,
        total_amplitude_m=2e-9,
        duration_s=60.0,
        over_budget=True,
    )


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (
            {"modes": "every"},
            "modes: found 'every', expected a valid array or 'controlled' or 'all'",
        ),
        ({"modes": []}, "modes: found []"),
        ({"modes": [1, 1]}, "expected modes without any of them twice"),
        ({"modes": [-1]}, "modes.0: found -1"),
        ({"total_amplitude_m": 0.0}, "total_amplitude_m"),
        ({"duration_s": 4000.0}, "duration_s"),
        ({"amplitude_m": 1e-9}, "amplitude_m: unknown"),
    ],
)
async def test_a_request_that_cannot_be_meant_is_refused(client, service, body, words):
    response = await client.post("/v1/noisy-matrix", json=body)
    assert response.status_code == 422, response.text
    assert words in response.json()["detail"]
    assert service.commands == []


async def test_a_refusal_arrives_in_its_own_words(client, service):
    service.refusal = CommandError("11 nm RMS in all, budget 8 nm")
    response = await client.post("/v1/noisy-matrix", json={})
    assert (response.status_code, response.json()["detail"]) == (409, str(service.refusal))


async def test_one_can_be_given_up(client, service):
    response = await client.delete("/v1/noisy-matrix/noisy-2")
    assert response.status_code == 202, response.text
    assert service.commands == [GiveUp(id="noisy-2")]


async def test_they_are_listed_oldest_first(client):
    body = (await client.get("/v1/noisy-matrix")).json()
    assert [m["id"] for m in body["noisy_matrices"]] == ["noisy-1", "noisy-2"]
    assert [m["state"] for m in body["noisy_matrices"]] == ["stored", "running"]


async def test_one_tells_how_it_was_made_and_what_it_says(client):
    body = (await client.get("/v1/noisy-matrix/noisy-1")).json()
    assert (body["n_modes"], body["modes"], body["seed"]) == (3, [0, 7, 3], 77)
    assert body["amplitude_m"] == pytest.approx(5e-9 / np.sqrt(3))
    found = body["finding"]
    assert found["alpha"]["rotation_deg"] == pytest.approx(0.2)
    assert found["sigma"]["rotation_deg"] == pytest.approx(0.02)
    assert (found["snr"], found["misfit"]) == (1.4, 1.01)
    assert (found["n_frames"], found["n_missing"]) == (29_994, 6)


async def test_one_under_way_has_found_nothing_yet(client):
    body = (await client.get("/v1/noisy-matrix/noisy-2")).json()
    assert (body["state"], body["finding"]) == ("running", None)


@pytest.mark.parametrize("path", ["noisy-9", "noisy-9/file"])
async def test_an_unknown_one_is_not_found(client, path):
    response = await client.get(f"/v1/noisy-matrix/{path}")
    assert response.status_code == 404
    assert "noisy-9" in response.json()["detail"]


async def test_the_product_leaves_as_it_lies_in_the_archive(client):
    response = await client.get("/v1/noisy-matrix/noisy-1/file")
    assert response.content == FILE
    assert response.headers["content-disposition"] == 'attachment; filename="noisy-1.h5"'


@pytest.mark.parametrize("action", ["approve", "publish", "reject"])
async def test_no_route_publishes_one(client, service, action):
    response = await client.post(f"/v1/noisy-matrix/noisy-1/{action}")
    assert response.status_code in {404, 405}
    assert service.commands == []


async def test_the_state_shows_the_one_under_way(client):
    shown = (await client.get("/v1/noisy-matrix/noisy-2")).json()
    assert shown["state"] == "running"
    state = to_json(
        tracker_state(system="x", measurements=(RUNNING,)).noisy_measurement, NOISY_MEASUREMENT
    )
    found = (state["id"], state["state"], state["duration_s"])
    assert found == ("noisy-2", MeasureState.RUNNING, 30.0)


async def test_it_is_a_measured_matrix_of_no_pattern_an_rtc_could_be_asked_for(client, service):
    body = (await client.get("/v1/measurements/noisy-2")).json()
    assert (body["id"], body["pattern"], body["amplitude_m"]) == (
        "noisy-2",
        None,
        pytest.approx([5e-9 / np.sqrt(3)] * 3),
    )
    assert (await client.get("/v1/measurements")).json()["measurements"] == []
    response = await client.delete("/v1/measurements/noisy-2")
    assert response.status_code == 202, response.text
    assert service.commands == [GiveUp(id="noisy-2")]
