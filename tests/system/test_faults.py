"""What a real RTC does at its worst, done on request: the service names it, keeps what it knows,
and goes on."""

import time

import httpx
import pytest

from tests.system.night import ALPHA, N_START, N_TARGET, a_night, wait_for
from tests.system.test_service import check_registration

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(150)]

TELEMETRY = (
    "lost@18:0.3,0.6",
    "nan@19.5:0.3,0.3",
    "garbage@20.5:1,0.6",
    "duplicated@21.5:1,0.2",
    "reordered@22.3:1,0.2",
    "shape@23:0.3",
    "frozen@24.5:2.5",
    "clock@28:0.4",
    "pause@29.5:0.8",
)


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def faults(*texts):
    return [word for text in texts for word in ("--fault", text)]


def wait_for_fault(rtc, text):
    """Wait until the RTC has begun a fault."""
    wait_for(lambda: f"fault='{text}" in rtc.log, 60.0, f"{text}; {rtc.log_path}")


def accepts_windows_again(night):
    before = night.state["windows_accepted"]
    wait_for(lambda: night.state["windows_accepted"] > before + 1, 20.0, "windows are accepted")


def test_damaged_telemetry_costs_windows_and_nothing_else(night):
    service = night.service("auto")
    rtc = night.rtc(*faults(*TELEMETRY))
    night.wait_for_modes(N_TARGET)
    kept, in_use = night.shelf, night.state["in_use"]
    wait_for_fault(rtc, TELEMETRY[-1])
    time.sleep(1.5)
    assert service.popen.poll() is None, service.log
    accepts_windows_again(night)
    link = night.state["link"]
    assert link["frames_lost"] > 50
    assert link["frames_nonfinite"] > 20
    assert link["frames_duplicate"] >= 100
    assert link["frames_recovered"] + link["frames_late"] >= 50
    assert link["messages_malformed"]["frames"] >= 5
    assert "link.callback_failed" not in service.log
    for named in ("frames missing", "message.malformed", "the RTC's clock stepped or it paused"):
        assert named in service.log, named
    # frozen slopes answer no dither and ask for no commands
    named = ("off the loop equation", "optical gains of", "slopes answer commands")
    assert any(text in service.log for text in named), service.log
    state = night.state
    assert state["in_use"] == in_use
    assert {r["id"] for r in kept} <= {r["id"] for r in night.shelf}
    check_registration(state["registration"])
    assert set(night.alarms) <= {"watchdog", "frames-unused"}
    assert "frames-unused" in service.log
    assert link["frames_refused"] == {"shape": 300}
    assert "Traceback" not in service.log


def test_a_dither_that_never_reaches_the_mirror_is_named_and_asked_for_again(night):
    service = night.service("hold")
    night.rtc(*faults("dither-lost@0:9"))
    wait_for(lambda: night.state["dither"], 30.0, "a dither is asked for")
    first = night.state["dither"]["id"]
    wait_for(lambda: "dither-lost" in night.alarms, 6.0, "the alarm of a lost dither")
    wait_for(lambda: (night.state["dither"] or {"id": first})["id"] != first, 8.0, "another")
    wait_for(lambda: night.state["windows_accepted"] >= 1, 30.0, "a window")
    assert "dither-lost" not in night.alarms
    assert "estimate-stale" not in service.log
    assert "Traceback" not in service.log


def test_a_refusal_a_second_rtc_and_a_restart_are_named_and_survived(night):
    service = night.service("auto")
    words = faults("refuse@0:1", "dither-late@0:1,10", "second@28:2", "restart@50:1")
    rtc = night.rtc(*words)
    wait_for(lambda: night.ids("rejected"), 40.0, "a rejected reconstructor")
    (rejected,) = [r for r in night.shelf if r["state"] == "rejected"]
    assert rejected["reason"] == "range: refused as a fault asked for"
    assert night.state["registration"] is not None
    assert night.n_modes_in_use() == 0
    night.post("/v1/refit", {"n_modes": N_START})
    wait_for(lambda: night.n_modes_in_use() > 0, 20.0, "the next reconstructor")
    in_use = night.state["in_use"]

    wait_for_fault(rtc, "second@28")
    wait_for(lambda: "second-rtc" in night.alarms, 10.0, "the alarm of a second RTC")
    alpha = night.state["registration"]["alpha"]
    assert alpha["shift_x_subap"] == pytest.approx(ALPHA["shift_x_subap"], abs=0.02)
    wait_for(lambda: "second-rtc" not in night.alarms, 30.0, "the alarm is over")
    accepts_windows_again(night)
    assert in_use in {r["id"] for r in night.shelf}

    session = night.state["rtc"]["session"]
    wait_for_fault(rtc, "restart@50")
    wait_for(lambda: "rtc-vanished" in service.log, 10.0, "the RTC's absence is named")
    wait_for(lambda: (night.state["rtc"] or {}).get("session") not in {None, session}, 15.0)
    assert night.state["registration"] is not None
    night.wait_for_modes(N_TARGET)
    check_registration(night.state["registration"])
    assert {rejected["id"], in_use} <= {r["id"] for r in night.shelf}
    assert "Traceback" not in service.log


def test_a_swap_that_comes_late_is_an_alarm_until_it_comes(night):
    service = night.service("auto")
    night.rtc(*faults("late-swap@0:5,12"))
    wait_for(lambda: "no-acknowledgement" in night.alarms, 40.0, "the alarm")
    (late,) = night.ids("failed")
    wait_for(lambda: night.state["in_use"] == late, 15.0, "the late swap is taken in")
    wait_for(lambda: "no-acknowledgement" not in night.alarms, 5.0, "the alarm is over")
    assert "Traceback" not in service.log


def test_an_open_loop_little_stroke_and_a_stall_pass(night):
    service = night.service("hold")
    words = faults("open@9:4", "saturation@15:30,2.5", "stall@21:1.5")
    rtc = night.rtc(*words)
    wait_for(lambda: night.state["windows_accepted"] >= 2, 30.0, "two windows")
    alpha = night.state["registration"]["alpha"]
    wait_for(lambda: "loop-open" in night.alarms, 20.0, "the alarm of an open loop")
    assert night.state["registration"]["alpha"]["rotation_deg"] == pytest.approx(
        alpha["rotation_deg"], abs=0.05
    )
    wait_for(lambda: "loop-open" not in night.alarms, 10.0, "the alarm is over")
    wait_for_fault(rtc, "saturation@15")
    wait_for(lambda: "commands-off-loop" in night.alarms, 4.0, "the alarm of a saturated mirror")
    accepted = night.state["windows_accepted"]
    wait_for(lambda: "commands-off-loop" not in night.alarms, 6.0, "the alarm is over")
    assert night.state["windows_accepted"] == accepted
    assert "of 45 modes (" in service.log
    wait_for_fault(rtc, "stall@21")
    accepts_windows_again(night)
    check_registration(night.state["registration"])
    assert night.state["link"]["frames_lost"] == 0
    assert "Traceback" not in service.log


def test_a_deaf_rtc_is_an_alarm_and_hears_again(night):
    service = night.service("auto")
    night.rtc(*faults("deaf@0:9"))
    wait_for(lambda: "no-acknowledgement" in night.alarms, 40.0, "the alarm")
    (unheard,) = night.ids("failed")
    state = night.state
    assert state["in_use"] == state["rtc"]["cm_id"]
    assert night.n_modes_in_use() == 0, "the first matrix, the RTC's own, is kept"
    frames = night.state["link"]["frames_received"]
    wait_for(lambda: night.state["link"]["frames_received"] > max(frames, 9000), 30.0, "it hears")

    def asked_again():
        # refused while the service is about to try again by itself
        answer = night.client.post("/v1/refit", json={"n_modes": N_START})
        return answer.status_code == httpx.codes.ACCEPTED or night.n_modes_in_use() > 0

    wait_for(asked_again, 20.0, "a refit")
    wait_for(lambda: night.n_modes_in_use() > 0, 20.0, "the next reconstructor")
    assert unheard in night.ids("failed")
    assert "Traceback" not in service.log


def test_a_mute_rtc_is_believed_by_its_status_and_another_basis_is_an_alarm(night):
    service = night.service("auto")
    rtc = night.rtc(*faults("mute@0:1000", "basis@10:0.5"))
    night.wait_for_modes(N_TARGET)
    assert "reconstructor.applied" in rtc.log
    assert "no-acknowledgement" not in service.log
    assert night.state["rtc"]["cm_id"] == night.state["in_use"]
    alpha = night.state["registration"]["alpha"]
    wait_for(lambda: "basis-mismatch" in night.alarms, 30.0, "the alarm of another basis")
    assert "expected kl-90-" in night.alarms["basis-mismatch"]
    assert night.state["registration"]["alpha"] == pytest.approx(alpha, abs=0.02)
    check_registration(night.state["registration"])
    assert night.n_modes_in_use() == N_TARGET
    assert "Traceback" not in service.log
