"""The RTC's loop as an operator changes it over HTTP, and a measurement given up half-way."""

import httpx
import pytest

from tests.support.night import N_START, a_night, wait_for

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(120)]


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def quiet_night(night):
    """A closed loop whose dither an operator has stopped."""
    service = night.service("hold")
    night.rtc()
    wait_for(lambda: night.state["in_use"], what="the RTC's matrix")
    night.post("/v1/dither", {"action": "stop"})
    wait_for(lambda: night.state["dither"] is None, what="no dither")
    return service


def gain_of(night, mode):
    groups = night.state["rtc"]["gains"]
    return next(g["gain"] for g in groups if g["first"] <= mode <= g["last"])


def test_the_loop_is_opened_closed_and_tuned_and_a_ramp_picks_its_gains(night):
    service = quiet_night(night)
    body = {"gains": [{"first": 0, "last": 1, "gain": 0.25}], "leak": 0.99}
    night.post("/v1/loop", body)
    wait_for(lambda: gain_of(night, 1) == 0.25, what="the gain of tip and tilt")
    assert gain_of(night, 2) not in {0.0, 0.25}
    assert night.state["rtc"]["leak"] == 0.99
    wait_for(lambda: night.state["loop_command"]["state"] == "accepted", 5.0, "it is accepted")

    tried = {0.05, 0.35}
    ramp = {"gains": sorted(tried), "step_s": 1.0}
    night.post("/v1/loop/ramp", ramp)
    second = night.client.post("/v1/loop/ramp", json=ramp)
    assert second.status_code == httpx.codes.CONFLICT, second.text
    assert "is under way; wait for it" in second.json()["detail"]

    def asks_again():
        answer = night.client.post("/v1/loop", json={"leak": 0.99})
        return answer.status_code == httpx.codes.ACCEPTED

    wait_for(asks_again, 15.0, "the end of the ramp")
    wait_for(lambda: {gain_of(night, m) for m in range(N_START)} <= tried, 5.0, "its gains")

    session = night.state["rtc"]["session"]
    night.post("/v1/loop", {"loop": "open"})
    wait_for(lambda: "loop-open" in night.alarms, what="an open loop is an alarm")
    wait_for(lambda: night.rtc_says("session") not in {None, session}, what="a new session")
    refused = night.client.post("/v1/loop/ramp")
    assert refused.status_code == httpx.codes.CONFLICT
    night.post("/v1/loop", {"loop": "closed"})
    wait_for(lambda: "loop-open" not in night.alarms, what="the loop is closed")
    answer = night.client.post("/v1/loop", json={"n_controlled": 91})
    assert "found 91 modes; expected 1 to 90" in answer.json()["detail"]
    assert "commands-off-loop" not in service.log
    assert "Traceback" not in service.log


def test_a_measurement_is_seen_while_it_lasts_and_can_be_given_up(night):
    service = quiet_night(night)
    answer = night.client.post("/v1/measurements", json={"n_average": 80})
    assert answer.status_code == httpx.codes.ACCEPTED, answer.text
    name = answer.json()["id"]
    wait_for(lambda: night.rtc_says("loop") == "open", what="an open loop")
    state = night.state
    assert (state["measuring"]["id"], state["measuring"]["opens_loop"]) == (name, True)
    night.check_alarms()
    assert night.metrics['pyrcal_measuring{pattern="push-pull-modal"}'] == 1

    path = f"/v1/measurements/{name}"
    assert night.client.delete(path).status_code == httpx.codes.ACCEPTED
    assert night.state["measuring"] is None
    assert night.client.get(path).json()["state"] == "given-up"
    wait_for(lambda: "busy" in service.log, 10.0, "the RTC goes on, and says so")
    wait_for(lambda: "measurement.ignored" in service.log, 40.0, "what it sends is ignored")
    wait_for(lambda: night.rtc_says("loop") == "closed", what="a closed loop")
    assert night.client.get(f"{path}/matrix").status_code == httpx.codes.NOT_FOUND
    assert night.client.delete(path).status_code == httpx.codes.CONFLICT
    assert "Traceback" not in service.log
