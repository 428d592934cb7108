"""Fits over real HTTP messages, with a hand-written desk behind them."""

import json
from dataclasses import replace
from types import SimpleNamespace

import httpx
import pytest

from pyrcal.fitting.figures import numbers
from pyrcal.fitting.report import document
from service.api import create_app
from service.errors import BusyError, MatrixError, TooLargeError, UnknownIdError
from service.runtime.uploads import FitJob, FitState
from tests.support.api import assert_problem
from tests.support.api_measured import FILE, FakeMatrices
from tests.support.made import a_fit, a_report

JOB = FitJob(id="fit-1", state=FitState.WAITING, asked_ns_utc=7, n_bytes=4, sha256="ab")


class FakeDesk:
    """Remembers what it was asked."""

    def __init__(self):
        self.asked = None
        self.body = b""
        self.length = None
        self.refusal = None
        self.known = {JOB.id: JOB}

    async def take(self, asked, body, n_bytes, name):
        if self.refusal is not None:
            raise self.refusal
        self.asked, self.length, self.name = asked, n_bytes, name
        self.body = b"".join([chunk async for chunk in body])
        return JOB

    def jobs(self):
        return tuple(self.known.values())

    def job(self, fit_id):
        if fit_id not in self.known:
            raise UnknownIdError(f"unknown fit {fit_id}")
        return self.known[fit_id]

    async def give_up(self, fit_id):
        ended = replace(self.job(fit_id), state=FitState.GIVEN_UP, reason="given up")
        self.known[fit_id] = ended
        return ended


@pytest.fixture
def desk():
    return FakeDesk()


@pytest.fixture
async def client(desk, tmp_path):
    service = SimpleNamespace(archive=SimpleNamespace(measured=FakeMatrices(tmp_path, "im-1")))
    transport = httpx.ASGITransport(create_app(service, desk), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        yield client


async def test_the_body_is_the_file_and_the_parameters_are_those_of_the_command(client, desk):
    parameters = {
        "dataset": "D",
        "method": "paper",
        "modes": "0:4",
        "start": "0.1,0,65,0.98",
        "gain_map": "true",
        "anamorphosis": "false",
        "instrument": "flao-lbt",
        "reference": "im.h5",
        "name": "last night",
    }
    response = await client.post("/v1/fits", params=parameters, content=b"file")
    assert response.status_code == 202, response.text
    assert response.json() == {
        "id": "fit-1",
        "links": {"fit": "/v1/fits/fit-1", "fits": "/v1/fits"},
    }
    assert response.headers["location"] == "/v1/fits/fit-1"
    assert (desk.body, desk.length) == (b"file", 4)
    assert desk.name == "last night"
    assert desk.asked == {
        "dataset": "D",
        "method": "paper",
        "modes": "0:4",
        "start": "0.1,0,65,0.98",
        "gain_map": True,
        "anamorphosis": False,
        "instrument": "flao-lbt",
        "reference": "im.h5",
    }


async def test_without_parameters_the_defaults_of_the_command_hold(client, desk):
    assert (await client.post("/v1/fits", content=b"file")).status_code == 202
    assert desk.asked == {
        **dict.fromkeys(("dataset", "modes", "start", "instrument", "reference")),
        "method": "joint",
        "gain_map": False,
        "anamorphosis": True,
    }


@pytest.mark.parametrize(
    "parameters",
    [
        {"method": "guess"},
        {"modes": "4:1"},
        {"start": "1,2,3"},
        {"instrument": "/etc/passwd"},
        {"instrument": "a/b.toml"},
        {"instrument": "b.toml"},
        {"datset": "D"},
    ],
)
async def test_a_parameter_that_means_nothing_is_named(client, desk, parameters):
    response = await client.post("/v1/fits", params=parameters, content=b"file")
    assert_problem(response, 422, "invalid", *parameters)
    assert desk.asked is None


@pytest.mark.parametrize(
    ("refusal", "status", "kind"),
    [
        (TooLargeError("found 2000 MB, expected at most 512 MB"), 413, "too-large"),
        (BusyError("found 4 fits unfinished"), 503, "busy"),
        (MatrixError("found an empty body"), 422, "unusable-matrix"),
    ],
)
async def test_an_upload_that_is_not_taken_says_why(client, desk, refusal, status, kind):
    desk.refusal = refusal
    assert_problem(await client.post("/v1/fits", content=b"x"), status, kind, str(refusal))


async def test_a_matrix_the_rtc_has_measured_needs_no_upload(client, desk):
    response = await client.post("/v1/fits", params={"measurement": "im-1", "modes": "0:4"})
    assert response.status_code == 202, response.text
    assert (desk.body, desk.length) == (FILE, len(FILE))


async def test_a_measurement_nobody_made_is_404(client):
    response = await client.post("/v1/fits", params={"measurement": "im-2"})
    assert_problem(response, 404, "unknown-id", "im-2")


async def test_a_measurement_and_a_body_are_one_too_many(client):
    response = await client.post("/v1/fits", params={"measurement": "im-1"}, content=b"file")
    assert_problem(response, 422, "unusable-matrix", "expected one of the two")


async def test_fits_are_listed_with_their_state(client):
    body = (await client.get("/v1/fits")).json()
    assert body == {
        "fits": [
            {
                "id": "fit-1",
                "state": "waiting",
                "stage": "",
                "name": "",
                "asked_ns_utc": 7,
                "asked_utc": "1970-01-01T00:00:00.000000Z",
                "n_bytes": 4,
                "sha256": "ab",
                "reason": "",
            }
        ]
    }


async def test_an_unfinished_fit_is_202_with_its_state(client):
    response = await client.get("/v1/fits/fit-1")
    assert response.status_code == 202
    assert response.json()["state"] == "waiting"


async def test_a_finished_fit_is_the_document_and_nothing_else(client, desk):
    found = document(a_report())
    desk.known["fit-1"] = replace(JOB, state=FitState.DONE, document=found)
    response = await client.get("/v1/fits/fit-1")
    assert response.status_code == 200
    assert response.json() == found


async def test_a_fit_that_failed_is_found_with_its_failure(client, desk):
    desk.known["fit-1"] = replace(JOB, state=FitState.FAILED, reason="it is transposed")
    response = await client.get("/v1/fits/fit-1")
    assert response.status_code == 200, "the request is answered; it was the fit that failed"
    told = response.json()
    assert (told["state"], told["reason"]) == ("failed", "it is transposed")
    assert "verdict" not in told


async def test_figures_are_there_when_the_fit_is(client, desk):
    assert_problem(await client.get("/v1/fits/fit-1/figures"), 404, "unknown-id", "waiting")
    drawn = json.dumps({"own_instrument": True, **numbers(a_fit())}).encode()
    desk.known["fit-1"] = replace(JOB, state=FitState.DONE, figures=drawn)
    response = await client.get("/v1/fits/fit-1/figures")
    assert response.content == drawn
    described = (await client.get("/openapi.json")).json()["components"]["schemas"]
    assert set(described["FitFigures"]["properties"]) == set(response.json())


async def test_a_fit_is_given_up(client, desk):
    response = await client.delete("/v1/fits/fit-1")
    assert (response.status_code, response.json()["state"]) == (200, "given-up")
    ended = await client.get("/v1/fits/fit-1")
    assert (ended.status_code, ended.json()["state"]) == (200, "given-up")
    assert_problem(await client.delete("/v1/fits/fit-9"), 404, "unknown-id", "fit-9")


async def test_an_unknown_fit_is_404(client):
    assert_problem(await client.get("/v1/fits/fit-9"), 404, "unknown-id", "fit-9")


async def test_the_document_is_described(client):
    described = (await client.get("/openapi.json")).json()
    schema = described["components"]["schemas"]["FitDocument"]
    assert set(schema["properties"]) == set(document(a_report()))
    upload = described["paths"]["/v1/fits"]["post"]["requestBody"]["content"]
    assert "application/octet-stream" in upload


async def test_without_a_desk_there_are_no_fits():
    transport = httpx.ASGITransport(create_app(object()))
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        assert (await client.get("/v1/fits")).status_code == 404
