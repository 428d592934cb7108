"""Acquisitions over real HTTP messages, with a hand-written service behind it."""

from dataclasses import replace

import pytest

from service.errors import CommandError
from service.tracking.commands import AbortAcquisition, Acquire
from service.tracking.operation_records import Acquisition, AcquisitionStage
from service.web.views import to_json
from tests.unit.obedient import Obedient
from tests.unit.tracking.situations import ALPHA


@pytest.fixture
def service():
    return Obedient()


@pytest.mark.parametrize(
    ("action", "command"), [("start", Acquire()), ("abort", AbortAcquisition())]
)
async def test_what_is_asked_reaches_the_command(client, service, action, command):
    response = await client.post("/v1/acquisition", json={"action": action})
    assert response.status_code == 202, response.text
    assert service.commands == [command]


@pytest.mark.parametrize("body", [{}, {"action": "go"}, {"action": "start", "modes": [1]}])
async def test_what_makes_no_sense_is_refused(client, service, body):
    response = await client.post("/v1/acquisition", json=body)
    assert response.status_code == 422
    assert not service.commands


async def test_one_that_cannot_begin_says_why(client, service):
    service.refusal = CommandError("no RTC is there")
    response = await client.post("/v1/acquisition", json={"action": "start"})
    assert response.status_code == 409
    assert "no RTC is there" in response.json()["detail"]


def test_the_view_tells_stage_and_what_was_found_in_degrees():
    under_way = Acquisition(stage=AcquisitionStage.CONFIRMING, text="looking", attempt=1)
    shown = to_json(replace(under_way, alpha=ALPHA))
    assert (shown["stage"], shown["under_way"], shown["n_attempts"]) == ("confirming", True, 1)
    assert shown["alpha"]["rotation_deg"] == pytest.approx(0.2)
    assert to_json(Acquisition())["alpha"] is None
