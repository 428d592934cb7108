"""The service as an operator meets it: real processes, real zenoh, real HTTP."""

import json
import signal
import time

import pytest

from service.archive import Archive
from tests.support.night import (
    INSTRUMENT,
    N_START,
    N_TARGET,
    a_night,
    session_members,
    wait_for,
)
from tests.support.pace import patience
from tests.support.service import TOLERANCE, check_registration

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def test_in_auto_the_registration_is_found_and_the_loop_served_first_its_modes_then_more(night):
    service = night.service("auto")
    night.rtc()
    night.wait_for_modes(N_TARGET)
    # the acknowledgement comes first, the next status says the same
    wait_for(lambda: (now := night.state)["rtc"]["cm_id"] == now["in_use"], 5.0, "one story")
    state = night.state
    check_registration(state["registration"])
    assert state["margin"]["accepted"]
    assert state["rtc"]["n_controlled"] == N_TARGET
    own = [record for record in night.shelf if record["parent"] is not None]
    assert [record["n_modes"] for record in own[:2]] == [N_START, N_TARGET]
    assert all(record["applied_frame_seq"] > 0 for record in own[:2])
    night.no_frame_is_lost()
    night.check_alarms("watchdog")
    status = night.start("status", ["pyrcal", "status", "--url", str(night.client.base_url)])
    assert status.ended(20.0) in {0, 1}, status.log
    assert f"loop closed at 1000 Hz, {N_TARGET} of 90 modes" in status.log

    assert len(session_members(service.popen.pid)) > 1
    service.send(signal.SIGINT)
    assert service.ended(5.0) == 0, service.log
    service.alone()
    assert "Traceback" not in service.log


@pytest.mark.long
def test_in_propose_the_operator_decides(night):
    night.service("propose")
    night.rtc()
    (first,) = wait_for(lambda: night.ids("proposed"), 40.0, "a proposal")
    initial = night.state["in_use"]
    time.sleep(3.0)
    assert night.state["in_use"] == initial
    assert not night.ids("published")

    night.post(f"/v1/reconstructors/{first}/approve")
    wait_for(lambda: night.state["in_use"] == first, 10.0, "the approved one in use")

    (second,) = wait_for(lambda: night.ids("proposed"), 20.0, "the next proposal")
    night.post(f"/v1/reconstructors/{second}/reject", {"reason": "not tonight"})
    assert night.client.get(f"/v1/reconstructors/{second}").json()["state"] == "discarded"
    answer = night.client.post(f"/v1/reconstructors/{second}/approve")
    assert answer.status_code == 409
    assert "discarded, not proposed" in answer.json()["detail"]

    night.post("/v1/rollback")
    wait_for(lambda: night.state["in_use"] not in {first, initial}, 10.0, "a copy in use")
    copy = night.client.get(f"/v1/reconstructors/{night.state['in_use']}").json()
    assert copy["parent"] == initial
    assert night.state["mode"] == "hold"
    time.sleep(patience(1.0))  # one that was being made is on the shelf by now
    n_known = len(night.shelf)
    time.sleep(4.0)
    assert len(night.shelf) == n_known
    assert night.state["in_use"] == copy["id"]


@pytest.mark.long
def test_an_rtc_that_is_killed_and_restarted_is_calibrated_again(night):
    night.service("auto")
    rtc = night.rtc()
    night.wait_for_modes(N_TARGET)
    before = night.state
    n_known = len(night.shelf)
    rtc.kill()
    wait_for(lambda: "rtc-vanished" in night.alarms, 10.0, "the alarm")
    after = night.state
    assert after["rtc"] is None
    alpha = before["registration"]["alpha"]
    assert after["registration"]["alpha"] == pytest.approx(alpha, abs=0.05)
    assert len(night.shelf) >= n_known

    anew = night.wait_for_rtc(night.rtc(seed=4))
    assert anew["rtc"]["session"] != before["rtc"]["session"]
    assert anew["registration"]["n_windows"] == 0
    night.wait_for_modes(N_TARGET)
    state = night.state
    assert "rtc-vanished" not in night.alarms
    assert state["in_use"] != before["in_use"]
    check_registration(state["registration"])


@pytest.mark.long
def test_a_service_killed_in_a_move_picks_up_where_it_was_and_leads_the_image_home(night):
    """Its RTC sends pixels, and has a stage that overdoes what it is asked by a fifth."""
    pixels = night.directory / "pixels.toml"
    text = INSTRUMENT.read_text(encoding="utf-8")
    pixels.write_text(text + '\n[slopes]\nkind = "intensity"\n', encoding="utf-8")
    with night.settings.open("a", encoding="utf-8") as settings:
        settings.write("[offload]\nenabled = true\n")
    truth = night.directory / "truth.jsonl"
    service = night.service("auto", pixels)
    # a machine that makes its optics later than the stage has told shows the service a jump
    night.rtc(f"--stage=1.2,{patience(3.0):.1f}", "--truth", str(truth), instrument=pixels)

    def moves(n):
        found = night.state["offload"]
        return found if found is not None and found["n_moves"] >= n else None

    def true():
        told = [line for line in truth.read_text().split("\n")[:-1] if '"rotation_deg"' in line]
        return json.loads(told[-1])

    wait_for(lambda: moves(1), 40.0, "a move")
    assert night.state["rtc"]["n_slopes"] == 448
    saved = night.directory / "data" / "tracking.json"
    wait_for(lambda: saved.exists() and '"n_moves": 1' in saved.read_text(), what="it is saved")
    in_use, ids = night.state["in_use"], [r["id"] for r in night.shelf if r["parent"]]
    service.kill()

    again = night.service("auto", pixels)
    wait_for(lambda: night.state["in_use"] == in_use, 20.0, "the matrix in use is known")
    kept = [record["id"] for record in night.shelf if record["parent"]]
    assert kept[: len(ids)] == ids
    assert night.state["registration"]["restored_ns_utc"] is not None
    assert moves(1)["total"]["shift_x_subap"] == pytest.approx(-0.1, abs=0.03)
    matrix = night.client.get(f"/v1/reconstructors/{in_use}/matrix")
    assert matrix.status_code == 200

    def home():
        known, truly = night.state["registration"], true()
        found = [known["alpha"][name] - truly[name] for name in TOLERANCE]
        near = [abs(error) < TOLERANCE[name] for error, name in zip(found, TOLERANCE, strict=True)]
        return all(near) and known["n_windows"] >= 2 and moves(2)

    wait_for(home, 40.0, lambda: f"α as it is, after two moves; {night.state['registration']}")
    assert "registration.jump" not in again.log + service.log
    assert "Traceback" not in again.log


class TestRefusedAtTheStart:
    """Exit status 2 and one line that names what to change."""

    def refused(self, night, *words):
        process = night.start("service", ["service", "run", *words])
        assert process.ended(20.0) == 2, process.log
        lines = [line for line in process.log.splitlines() if line.startswith("pyrcal: ")]
        assert len(lines) == 1, process.log
        assert "Traceback" not in process.log
        return lines[0]

    def test_a_data_directory_another_service_uses(self, night):
        data = night.directory / "data"
        with Archive(data) as archive:
            archive.open()
            line = self.refused(night, "--port", "0", "--data-dir", str(data))
        assert "in use by another service" in line
