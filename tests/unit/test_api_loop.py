"""Changing the loop over real HTTP messages, with a hand-written service behind it."""

import pytest

from service.errors import CommandError, LinkError
from service.tracking.commands import GainGroup, ModeGroup, Ramp, SetLoop
from tests.unit.obedient import Obedient


@pytest.fixture
def service():
    return Obedient()


@pytest.mark.parametrize(
    ("body", "command"),
    [
        ({"loop": "open"}, SetLoop(loop="open")),
        ({"loop": "closed", "leak": 0.99}, SetLoop(loop="closed", leak=0.99)),
        ({"n_controlled": 300}, SetLoop(n_controlled=300)),
        (
            {"gains": [{"first": 0, "last": 1, "gain": 0.4}, {"first": 2, "last": 9, "gain": 0}]},
            SetLoop(
                gains=(GainGroup(first=0, last=1, gain=0.4), GainGroup(first=2, last=9, gain=0.0))
            ),
        ),
    ],
)
async def test_what_is_asked_of_the_loop_reaches_the_command(client, service, body, command):
    response = await client.post("/v1/loop", json=body)
    assert response.status_code == 202, response.text
    assert response.json()["links"]["state"] == "/v1/state"
    assert service.commands == [command]


async def test_a_bare_ramp_leaves_the_choice_to_the_service(client, service):
    assert (await client.post("/v1/loop/ramp")).status_code == 202
    assert service.commands == [Ramp()]


async def test_a_ramp_as_wanted(client, service):
    body = {"groups": [{"first": 0, "last": 1}], "gains": [0.2, 0.5], "step_s": 0.5}
    assert (await client.post("/v1/loop/ramp", json=body)).status_code == 202
    assert service.commands == [
        Ramp(groups=(ModeGroup(first=0, last=1),), gains=(0.2, 0.5), step_s=0.5)
    ]


@pytest.mark.parametrize(
    ("path", "body", "words"),
    [
        ("", {}, "at least one of loop, gains, leak, n_controlled"),
        ("", {"loop": "partial"}, "loop: found 'partial'"),
        ("", {"leak": 1.5}, "leak"),
        ("", {"n_controlled": 0}, "n_controlled"),
        ("", {"gains": []}, "gains"),
        ("", {"gains": [{"first": 3, "last": 2, "gain": 0.1}]}, "first <= last"),
        ("", {"gains": [{"first": 0, "last": 2, "gain": -0.1}]}, "gain"),
        (
            "",
            {"gains": [{"first": 0, "last": 2, "gain": 0.1}, {"first": 2, "last": 3, "gain": 0}]},
            "no mode in two groups: mode 2 is",
        ),
        ("", {"speed": 3}, "speed: unknown"),
        ("/ramp", {"gains": [0.0]}, "gains.0"),
        ("/ramp", {"groups": [{"first": 0, "last": 1}] * 2}, "no mode in two groups"),
        ("/ramp", {"step_s": 61.0}, "step_s"),
    ],
)
async def test_a_loop_that_cannot_be_meant_is_refused(client, service, path, body, words):
    response = await client.post(f"/v1/loop{path}", json=body)
    assert response.status_code == 422, response.text
    assert words in response.json()["detail"]
    assert service.commands == []


@pytest.mark.parametrize("path", ["", "/ramp"])
@pytest.mark.parametrize(
    ("refusal", "status"),
    [
        (CommandError("the RTC refused: busy: im-1 is being measured"), 409),
        (LinkError("no answer from the RTC"), 504),
    ],
)
async def test_a_refusal_arrives_in_its_own_words(client, service, path, refusal, status):
    service.refusal = refusal
    response = await client.post(f"/v1/loop{path}", json={"leak": 0.9} if not path else {})
    assert (response.status_code, response.json()["detail"]) == (status, str(refusal))
