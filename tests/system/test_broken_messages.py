"""An RTC that breaks the contract, message by message: the service says so, and goes on."""

import contextlib
import json
import time

import httpx
import msgpack
import numpy as np
import pytest

from service.wire import Keys
from tests.support.fake_rtc import client_session
from tests.support.night import a_night, wait_for
from tests.support.pace import Deadline, patience
from tests.support.stranger import Stranger, open_client, small_telescope

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]

TOLD_WITHIN_S = 3.0
"""A fault of the RTC's messages is named within this."""

SLACK_S = 2.0
"""For REST on a loaded machine."""


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    with a_night(tmp_path_factory.mktemp("night")) as night:
        night.service("auto")
        yield night


@pytest.fixture
def rtc(night, request):
    """A stranger in a session of its own, all well so far."""
    with stranger(night, request.node.name) as rtc:
        met(night, rtc)
        yield rtc


@contextlib.contextmanager
def stranger(night, name, **options):
    response, variance_m2 = small_telescope()
    rtc = Stranger(night.zenoh, response, variance_m2, **options)
    rtc.session = f"{name}-{time.monotonic_ns()}"[-100:]
    with rtc:
        yield rtc


def met(night, rtc):
    wait_for(
        lambda: (night.state["rtc"] or {}).get("session") == rtc.session, 10.0, "the RTC is known"
    )


def waits(night):
    return {wait["name"]: wait["text"] for wait in night.state["waiting_for"]}


def named(night, where, name, words, timeout_s=TOLD_WITHIN_S + SLACK_S):
    """Wait until an alarm, or what is waited for, says these words."""
    text = ""
    deadline = Deadline(timeout_s)
    while words not in text:
        assert not deadline.passed, f"{words} is not in {name}: {text}"
        time.sleep(0.1)
        text = where(night).get(name, "")
    return text


def alarms(night):
    return night.alarms


def received(night):
    return night.state["link"]["frames_received"]


def goes_on(night):
    before = received(night)
    wait_for(lambda: received(night) > before + 500, 5.0, "telemetry goes on")


def test_one_frame_with_a_leap_of_its_number_is_named_and_telemetry_goes_on(night, rtc):
    def leap(header, *rows):
        rtc.on_frames = None
        return (header | {"seq0": 2**61}, *rows)

    rtc.on_frames = leap
    named(night, alarms, "frames-unused", "leaps from")
    goes_on(night)
    wait_for(lambda: night.state["ready"], 5.0, lambda: f"ready; {waits(night)}")


@pytest.mark.long
def test_a_sequence_that_starts_over_in_its_session_is_named_and_the_service_not_ready(night, rtc):
    wait_for(lambda: rtc.seq > 500, 5.0, "a second of frames")
    rtc.on_frames = lambda header, *rows: (header | {"seq0": header["seq0"] % 50}, *rows)
    named(night, alarms, "frames-unused", "goes back from")
    named(night, waits, "frames-unused", "goes back from")
    answer = night.client.get("/readyz")
    assert answer.status_code == 503
    assert "goes back from" in answer.text
    assert "frames-unused" in night.alarms


def test_a_message_of_an_unknown_session_takes_nothing_over_and_is_named(night, rtc):
    header, status = rtc.header(0, 1), rtc.status()
    row = np.zeros((1, rtc.n_slopes + 2 * rtc.n_modes), "<f4").tobytes()
    ack = {"v": 1, "id": "cm-x", "sha256": "0" * 64, "state": "applied", "reason": ""}
    ack |= {"frame_seq": 5}
    with contextlib.closing(open_client(night.zenoh)) as outside:
        for kind in ("tel/frames", "tel/status", "cm/ack"):
            other = {"session": f"intruder-{time.monotonic_ns()}"}
            if kind == "tel/frames":
                outside.put(f"{rtc.root}/{kind}", row, attachment=msgpack.packb(header | other))
            else:
                said = status if kind == "tel/status" else ack
                outside.put(f"{rtc.root}/{kind}", msgpack.packb(said | other))
            named(night, alarms, "second-rtc", other["session"])
            assert night.state["link"]["session"] == rtc.session, kind
    goes_on(night)


def test_an_attachment_that_cannot_be_read_is_named_within_three_seconds(night, rtc):
    for twist, found in (
        ({"seq0": -1}, "seq0"),
        ({"n_slopes": 5}, "float32"),
        ({"v": 2}, "expected 1"),
        ({"session": None}, "session"),
    ):
        rtc.on_frames = lambda header, *rows, twist=twist: (header | twist, *rows)
        named(night, alarms, "frames-unused", found)
        rtc.on_frames = None
        goes_on(night)


def test_frames_that_are_not_finite_are_named_within_three_seconds(night, rtc):
    def spoilt(header, slopes, commands, dither):
        slopes[:, 3] = np.nan
        return header, slopes, commands, dither

    rtc.on_frames = spoilt
    named(night, alarms, "frames-unused", "nonfinite")


def test_an_rtc_that_is_not_there_is_waited_for(night):
    named(night, waits, "rtc", "no RTC is there", 5.0)
    wait_for(lambda: night.state["ready"], 5.0, "it is ready for one")
    wait_for(lambda: "telemetry: " in night.client.get("/readyz").text, 5.0, "and says it is not")


def test_telemetry_that_makes_no_sense_is_counted_and_the_service_goes_on(night):
    wait_for(lambda: night.state["rtc"] is None, 10.0, "no RTC")
    keys = Keys("small")
    before = night.metrics
    with client_session(night.zenoh) as session:
        session.put(keys.frames, b"\x00" * 100)
        session.put(keys.frames, b"\x00" * 100, attachment=b"not msgpack")
        session.put(keys.status, b"\xff\xff")
        session.put(keys.acknowledgement, b"")
        session.put(keys.status, b"\x80")

        def moved():
            now = night.metrics
            return all(
                now.get(f'pyrcal_messages_malformed_total{{kind="{kind}"}}', 0.0)
                >= before.get(f'pyrcal_messages_malformed_total{{kind="{kind}"}}', 0.0) + count
                for kind, count in (("frames", 2), ("status", 2), ("ack", 1))
            )

        wait_for(moved, 10.0, lambda: f"counters: {json.dumps(night.metrics, indent=1)}")
    assert night.client.get("/healthz").status_code == 200
    assert night.state["rtc"] is None
    events = night.client.get("/v1/events").json()["log"]
    assert any(event["name"] == "message.malformed" for event in events)


@pytest.mark.long
def test_five_hundred_statuses_a_second_end_no_window_and_leave_rest_alone(night, rtc):
    before, pumped = night.state["windows_accepted"], 0
    with httpx.Client(base_url=night.client.base_url, timeout=patience(2.0)) as in_a_hurry:

        def pump():
            nonlocal pumped
            for _ in range(50):
                rtc.send_status()
            pumped += 50
            assert in_a_hurry.get("/healthz").status_code == 200
            return pumped > 7000 and night.state["windows_accepted"] > before

        wait_for(pump, 60.0, lambda: f"a window; {night.alarms}", every_s=0.05)
        named(night, alarms, "status-flood", "statuses")


@pytest.mark.long
def test_a_second_service_stands_by_and_the_rtc_hears_of_one_alone(night):
    response, variance_m2 = small_telescope(shift_x_subap=0.1)
    assumed, _ = small_telescope()
    second = night.second_service()
    try:
        with Stranger(night.zenoh, response, variance_m2, assumed=assumed) as rtc:
            rtc.session = f"shared-{time.monotonic_ns()}"
            wait_for(lambda: not isinstance(_state_of(second), str), 40.0, "a second service")
            named(second, waits, "standing-by", "another service drives", 20.0)
            named(night, alarms, "second-service", "end all but one")
            wait_for(lambda: rtc.applied, 60.0, "a matrix applied")
            wait_for(lambda: night.ids("applied"), 5.0, "the service knows of it")
            time.sleep(5.0)
            assert not second.shelf
            assert second.client.get("/readyz").status_code == 503
            answer = second.client.post("/v1/loop", json={"loop": "open"})
            assert "another service drives" in answer.json()["detail"]
            assert set(rtc.applied) <= {record["id"] for record in night.shelf}
    finally:
        second.client.close()
        second.processes.pop().kill()


def _state_of(night):
    try:
        return night.state
    except httpx.TransportError as error:
        return str(error)


def test_what_an_rtc_does_not_offer_is_said_at_once(night, rtc):
    answer = night.client.post("/v1/loop/ramp", timeout=patience(2.0))
    assert answer.status_code in {409, 504}
    assert "offers no ramp" in answer.text
