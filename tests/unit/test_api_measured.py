"""Measured interaction matrices over real HTTP messages, with a hand-written service behind."""

import hashlib
import io
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from service.errors import CommandError, LinkError, UnknownIdError
from service.tracking.commands import GiveUp, Measure
from service.tracking.operation_records import MeasurementRecord, MeasureState
from service.wire import Pattern
from tests.states import tracker_state
from tests.unit.obedient import Obedient

MATRIX = np.arange(12, dtype=np.float32).reshape(4, 3)
FILE = b"\x89HDF the product"
STORED = MeasurementRecord(
    id="im-1",
    state=MeasureState.STORED,
    pattern=Pattern.PUSH_PULL_MODAL,
    modes=(0, 7, 3),
    amplitude_m=(1e-8, 2e-8, 2e-8),
    n_average=5,
    asked_ns_utc=900,
    start_seq=70,
    created_ns_utc=1_000,
    n_slopes=4,
    double_pass=False,
    session="s-1",
    basis_id="kl",
    config_id="b1",
    sha256=hashlib.sha256(MATRIX.tobytes()).hexdigest(),
)
RUNNING = replace(
    STORED,
    id="im-2",
    state=MeasureState.RUNNING,
    created_ns_utc=None,
    n_slopes=None,
    double_pass=None,
    sha256="",
)


class FakeMatrices:
    """The archive's measured matrices."""

    def __init__(self, folder):
        self.path = folder / "product.h5"
        self.path.write_bytes(FILE)

    def matrix(self, measurement_id):
        if measurement_id != "im-1":
            raise UnknownIdError(f"measurement {measurement_id}: no such matrix in the archive")
        return MATRIX

    def file(self, measurement_id):
        self.matrix(measurement_id)
        return self.path


@pytest.fixture
def service(tmp_path):
    return Obedient(
        tracker_state(system="flao-lbt", measurements=(STORED, RUNNING)),
        now_ns=1_763_696_400_250_000_000,
        archive=SimpleNamespace(measured=FakeMatrices(tmp_path)),
    )


async def test_a_bare_request_measures_push_pull_modal(client, service):
    response = await client.post("/v1/measurements")
    assert response.status_code == 202, response.text
    body = response.json()
    assert body["id"] == "im-20251121T034000.250000"
    assert body["links"]["measurement"] == f"/v1/measurements/{body['id']}"
    assert service.commands == [Measure(id=body["id"], pattern=Pattern.PUSH_PULL_MODAL)]


async def test_every_choice_reaches_the_command(client, service):
    body = {
        "pattern": "sine",
        "modes": [3, 9],
        "amplitude_m": 5e-9,
        "frequency_hz": [60.0, 80.0],
        "duration_s": 12.0,
    }
    response = await client.post("/v1/measurements", json=body)
    assert response.status_code == 202, response.text
    (command,) = service.commands
    assert command == Measure(
        id=response.json()["id"],
        pattern=Pattern.SINE,
        modes=(3, 9),
        amplitude_m=5e-9,
        frequency_hz=(60.0, 80.0),
        duration_s=12.0,
    )


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"pattern": "poke"}, "pattern: found 'poke'"),
        ({"modes": []}, "modes"),
        ({"modes": [-1]}, "modes.0"),
        ({"modes": [1, 1]}, "modes without any of them twice"),
        ({"amplitude_m": 0.0}, "amplitude_m"),
        ({"n_average": 0}, "n_average"),
        ({"pattern": "sine", "n_average": 3}, "no n_average with a sine"),
        ({"duration_s": 3.0}, "no frequency_hz and no duration_s with push-pull-modal"),
        ({"pattern": "sine", "modes": [1, 2], "frequency_hz": [60.0]}, "1 given for 2"),
        ({"pattern": "sine", "frequency_hz": [60.0]}, "1 given for 0"),
        ({"averages": 3}, "averages: unknown"),
    ],
)
async def test_a_request_that_cannot_be_meant_is_refused(client, service, body, words):
    response = await client.post("/v1/measurements", json=body)
    assert response.status_code == 422, response.text
    assert response.headers["content-type"] == "application/problem+json"
    assert words in response.json()["detail"]
    assert service.commands == []


@pytest.mark.parametrize(
    ("refusal", "status"),
    [
        (CommandError("the RTC refused: busy: dither d-1 is on until frame 9"), 409),
        (LinkError("no answer from the RTC"), 504),
    ],
)
async def test_a_refusal_arrives_in_its_own_words(client, service, refusal, status):
    service.refusal = refusal
    response = await client.post("/v1/measurements", json={})
    assert response.status_code == status
    assert response.json()["detail"] == str(refusal)


async def test_a_measurement_can_be_given_up(client, service):
    response = await client.delete("/v1/measurements/im-2")
    assert response.status_code == 202, response.text
    assert response.json()["links"]["measurement"] == "/v1/measurements/im-2"
    assert service.commands == [GiveUp(id="im-2")]


@pytest.mark.parametrize(
    ("refusal", "status"),
    [
        (UnknownIdError("unknown measurement im-2"), 404),
        (CommandError("im-2 is stored: there is nothing to give up"), 409),
    ],
)
async def test_what_cannot_be_given_up_is_told(client, service, refusal, status):
    service.refusal = refusal
    response = await client.delete("/v1/measurements/im-2")
    assert (response.status_code, response.json()["detail"]) == (status, str(refusal))


async def test_measurements_are_listed_oldest_first(client):
    body = (await client.get("/v1/measurements")).json()
    assert [m["id"] for m in body["measurements"]] == ["im-1", "im-2"]
    assert [m["state"] for m in body["measurements"]] == ["stored", "running"]


async def test_a_measurement_tells_how_it_was_made(client):
    body = (await client.get("/v1/measurements/im-1")).json()
    assert body["modes"] == [0, 7, 3]
    assert body["amplitude_m"] == [1e-8, 2e-8, 2e-8]
    assert (body["pattern"], body["n_average"]) == ("push-pull-modal", 5)
    assert (body["n_slopes"], body["double_pass"]) == (4, False)
    assert body["sha256"] == STORED.sha256


@pytest.mark.parametrize("path", ["im-9", "im-9/matrix", "im-9/matrix?format=hdf5"])
async def test_an_unknown_measurement_is_not_found(client, path):
    response = await client.get(f"/v1/measurements/{path}")
    assert response.status_code == 404
    assert "im-9" in response.json()["detail"]


async def test_the_matrix_leaves_as_a_numpy_file(client):
    response = await client.get("/v1/measurements/im-1/matrix")
    assert response.headers["x-shape"] == "4,3"
    assert response.headers["content-disposition"] == 'attachment; filename="im-1.npy"'
    found = np.load(io.BytesIO(response.content), allow_pickle=False)
    np.testing.assert_array_equal(found, MATRIX)


async def test_the_raw_matrix_has_the_announced_checksum(client):
    response = await client.get("/v1/measurements/im-1/matrix", params={"format": "raw"})
    assert hashlib.sha256(response.content).hexdigest() == STORED.sha256


async def test_the_product_leaves_as_it_lies_in_the_archive(client):
    response = await client.get("/v1/measurements/im-1/matrix", params={"format": "hdf5"})
    assert response.content == FILE
    assert response.headers["content-type"] == "application/x-hdf5"
    assert response.headers["content-disposition"] == 'attachment; filename="im-1.h5"'


async def test_another_format_is_refused(client):
    response = await client.get("/v1/measurements/im-1/matrix", params={"format": "csv"})
    assert response.status_code == 422
