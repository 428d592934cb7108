"""What a real RTC does at its worst, done on request: the service names it, keeps what it knows,
and goes on."""

import httpx
import pytest

from tests.support.night import N_START, N_TARGET, a_night, wait_for
from tests.support.pace import slowness
from tests.support.service import check_registration

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(150)]

TELEMETRY = (
    ("lost", 0.0, ":0.3,0.6"),
    ("nan", 1.5, ":0.3,0.3"),
    ("garbage", 2.5, ":1,0.6"),
    ("duplicated", 3.5, ":1,0.2"),
    ("reordered", 4.3, ":1,0.2"),
    ("shape", 5.0, ":0.3"),
    ("frozen", 6.5, ":2.5"),
    ("clock", 10.0, ":0.4"),
    ("pause", 11.5, ":0.8"),
)
"""Kind, seconds after the first, arguments."""


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


@pytest.fixture
def late(night):
    """Seconds on an idle machine as seconds on this one, as it is now.

    A fault's time is counted by the RTC from its start: what it is to find must be there by then.
    """
    factor = slowness(again=True)
    return lambda seconds: f"{seconds * factor:.1f}"


def faults(*texts):
    return [word for text in texts for word in ("--fault", text)]


def wait_for_fault(rtc, kind):
    """Wait until the RTC has begun a fault."""
    wait_for(lambda: f"fault='{kind}@" in rtc.log, 60.0, f"{kind}; {rtc.log_path}")


def named(service, alarm, timeout_s):
    """Wait until an alarm has been raised, be it over by now."""
    wait_for(lambda: alarm in service.log, timeout_s, lambda: f"{alarm}; {service.log}")


def is_over(night, alarm, timeout_s):
    wait_for(lambda: alarm not in night.alarms, timeout_s, f"{alarm} is over")


def accepts_windows_again(night):
    before = night.state["windows_accepted"]
    wait_for(
        lambda: night.state["windows_accepted"] > before + 1,
        20.0,
        lambda: f"windows are accepted; {night.alarms}",
    )


def test_damaged_telemetry_costs_windows_and_nothing_else(night, late):
    service = night.service("auto")
    first = float(late(20.0))  # modes beyond the RTC's own are shown before they are raised
    rtc = night.rtc(*faults(*(f"{kind}@{first + s:.1f}{rest}" for kind, s, rest in TELEMETRY)))
    night.wait_for_modes(N_TARGET)
    wait_for_fault(rtc, "lost")  # α is as good as it gets, and its matrix in use
    kept, in_use = night.shelf, night.state["in_use"]
    wait_for_fault(rtc, "pause")
    accepts_windows_again(night)
    assert service.popen.poll() is None, service.log
    link = night.state["link"]
    assert link["frames_lost"] > 50
    assert link["frames_nonfinite"] > 20
    assert link["frames_duplicate"] >= 100
    assert link["frames_recovered"] + link["frames_late"] >= 50
    assert link["messages_malformed"]["frames"] >= 5
    assert "link.callback_failed" not in service.log
    for text in ("frames missing", "message.malformed", "the RTC's clock stepped or it paused"):
        assert text in service.log, text
    assert "slopes-stand" in service.log, "a camera that stands has an alarm of its own"
    state = night.state
    assert state["in_use"] == in_use
    assert {r["id"] for r in kept} <= {r["id"] for r in night.shelf}
    check_registration(state["registration"])
    known = ("watchdog", "frames-unused", "frames-lost", "windows-refused", "slopes-stand")
    night.check_alarms(*known)
    assert "frames-unused" in service.log
    assert "frames-lost" in service.log
    assert link["frames_refused"] == {"shape": 300}
    assert "Traceback" not in service.log


def test_a_dither_that_never_reaches_the_mirror_is_named_and_asked_for_again(night, late):
    service = night.service("hold")
    night.rtc(*faults(f"dither-lost@0:{late(9.0)}"))
    first = wait_for(lambda: night.state["dither"], 30.0, "a dither is asked for")["id"]
    named(service, "dither-lost", 6.0)
    wait_for(lambda: (night.state["dither"] or {"id": first})["id"] != first, 8.0, "another")
    wait_for(lambda: night.state["windows_accepted"] >= 1, 30.0, "a window")
    is_over(night, "dither-lost", 1.0)
    assert "estimate-stale" not in service.log or slowness(again=True) > 1.5
    assert "Traceback" not in service.log


def test_a_refusal_is_told_with_its_reason_and_the_next_matrix_is_taken(night):
    service = night.service("auto")
    night.rtc(*faults("refuse@0:1", "dither-late@0:1,10"))
    wait_for(lambda: night.ids("rejected"), 40.0, "a rejected reconstructor")
    (rejected,) = [r for r in night.shelf if r["state"] == "rejected"]
    assert rejected["reason"] == "range: refused, as --fault requests"
    assert night.state["registration"] is not None
    assert night.n_modes_in_use() == 0
    night.post("/v1/refit", {"n_modes": N_START})
    wait_for(lambda: night.n_modes_in_use() > 0, 20.0, "the next reconstructor")
    assert rejected["id"] in {r["id"] for r in night.shelf}
    assert "Traceback" not in service.log


def test_a_second_rtc_is_named_and_survived(night, late):
    service = night.service("auto")
    rtc = night.rtc(*faults(f"second@{late(12)}:2"))
    wait_for(lambda: night.n_modes_in_use() > 0, 40.0, "a reconstructor of its own")
    in_use = night.state["in_use"]
    wait_for_fault(rtc, "second")
    named(service, "second-rtc", 10.0)
    is_over(night, "second-rtc", 30.0)
    night.wait_for_modes(N_TARGET)
    accepts_windows_again(night)
    check_registration(night.state["registration"])
    assert in_use in {r["id"] for r in night.shelf}
    assert "Traceback" not in service.log


def test_a_swap_that_comes_late_is_an_alarm_until_it_comes(night, late):
    service = night.service("auto")
    night.rtc(*faults(f"late-swap@0:{late(5.0)},{late(12.0)}"))
    wait_for(lambda: "no-acknowledgement" in night.alarms, 40.0, "the alarm", every_s=0.02)
    (swapped,) = night.ids("failed")
    wait_for(lambda: night.state["in_use"] == swapped, 15.0, "the late swap is taken in")
    is_over(night, "no-acknowledgement", 5.0)
    assert "Traceback" not in service.log


def test_a_swap_that_comes_after_it_was_acknowledged_is_named(night, late):
    service = night.service("auto")
    night.rtc(*faults(f"early-ack@0:{late(3.0)},1000"))
    named(service, "matrix-misapplied", 40.0)
    wait_for(lambda: night.state["in_use"].startswith("cm-"), 15.0, "the late swap is taken in")
    state = night.state
    assert "matrix-misapplied" in {waiting["name"] for waiting in state["waiting_for"]}
    sent = [r["id"] for r in night.shelf if r["published_ns_utc"] is not None]
    assert sent == [state["in_use"]]
    assert "Traceback" not in service.log


def test_a_matrix_of_the_wrong_sign_is_taken_back_and_the_loop_opened(night):
    service = night.service("auto")
    night.rtc(*faults("turned-sign@0:1000"))
    named(service, "matrix-misapplied", 40.0)
    named(service, "loop.accepted", 10.0)
    sent = [r["id"] for r in night.shelf if r["published_ns_utc"] is not None]
    assert len(sent) == 2
    assert "Traceback" not in service.log


def saturated(night):
    """Return how many windows there were, at the end and at the beginning of a saturation."""
    accepted = []

    def is_passed():
        state = night.state
        if "commands-off-loop" not in {alarm["name"] for alarm in state["alarms"]}:
            return bool(accepted)
        accepted.append(state["windows_accepted"])
        return False

    wait_for(is_passed, 12.0, "the alarm of a saturated mirror, and its end", every_s=0.02)
    return accepted[-1], accepted[0]


def test_an_open_loop_little_stroke_and_a_stall_pass(night, late):
    service = night.service("hold")
    words = (f"open@{late(8)}:4", f"saturation@{late(14)}:30,2.5", f"stall@{late(19)}:1.5")
    rtc = night.rtc(*faults(*words))
    wait_for(lambda: night.state["windows_accepted"] >= 2, 30.0, "two windows")
    alpha = night.state["registration"]["alpha"]
    named(service, "loop-open", 20.0)
    assert night.state["registration"]["alpha"]["rotation_deg"] == pytest.approx(
        alpha["rotation_deg"], abs=0.05
    )
    is_over(night, "loop-open", 10.0)
    wait_for_fault(rtc, "saturation")
    last, first = saturated(night)
    assert last == first, "windows of a saturated mirror"
    assert "of 45 modes (" in service.log
    wait_for_fault(rtc, "stall")
    accepts_windows_again(night)
    check_registration(night.state["registration"])
    night.no_frame_is_lost()
    assert "Traceback" not in service.log


def test_a_deaf_rtc_is_an_alarm_and_hears_again(night, late):
    service = night.service("auto")
    deaf_s = float(late(9.0))
    night.rtc(*faults(f"deaf@0:{deaf_s}"))
    (unheard,) = wait_for(lambda: night.ids("failed"), 40.0, "it is not acknowledged")
    named(service, "no-acknowledgement", 5.0)
    state = night.state
    assert state["in_use"] == state["rtc"]["cm_id"]
    assert night.n_modes_in_use() == 0, "the first matrix, the RTC's own, is kept"
    n_deaf = 1000 * deaf_s
    wait_for(lambda: night.state["link"]["frames_received"] > n_deaf, 30.0, "it hears")

    def asked_again():
        # refused while the service is about to try again by itself
        answer = night.client.post("/v1/refit", json={"n_modes": N_START})
        return answer.status_code == httpx.codes.ACCEPTED or night.n_modes_in_use() > 0

    wait_for(asked_again, 20.0, "a refit")
    wait_for(lambda: night.n_modes_in_use() > 0, 20.0, "the next reconstructor")
    assert unheard in night.ids("failed")
    assert "Traceback" not in service.log


def refused(night, reason):
    """Return how many frames were refused for this reason."""
    return night.state["link"]["frames_refused"].get(reason, 0)


@pytest.mark.parametrize("named_by", ["reference_id", "config_id"])
def test_reference_slopes_may_change_in_either_way(night, named_by):
    """A window of 1 s fits between two changes; none raises an alarm that stops anything."""
    service = night.service("auto")
    rtc = night.rtc("--references", "60,6", "--references-named-by", named_by)
    night.wait_for_modes(N_TARGET)
    for name in ("references-3", "references-4", "references-5"):
        wait_for(lambda name=name: night.state["reference_id"] == name, 60.0, name)
        n_accepted = night.state["windows_accepted"]
        more = f"a window with {name}; {service.log_path}"
        wait_for(lambda n=n_accepted: night.state["windows_accepted"] > n, 20.0, more)
    state = night.state
    check_registration(state["registration"])
    assert state["reference_since_ns_utc"] is not None
    assert state["link"]["frames_refused"] == {}
    night.check_alarms(*(["sensor-renamed"] if named_by == "config_id" else []))
    assert night.n_modes_in_use() == N_TARGET
    assert "Traceback" not in service.log + rtc.log


def test_a_mute_rtc_is_believed_by_its_status_and_another_basis_is_an_alarm(night, late):
    service = night.service("auto")
    rtc = night.rtc(*faults("mute@0:1000", f"basis@{late(20)}:8"))
    night.wait_for_modes(N_TARGET)
    assert "reconstructor.applied" in rtc.log
    assert "no-acknowledgement" not in service.log
    wait_for(lambda: (now := night.state)["rtc"]["cm_id"] == now["in_use"], 5.0, "one story")
    named(service, "basis-mismatch", 30.0)
    assert "expected kl-90-" in service.log
    then, n_refused = night.state, refused(night, "basis")
    wait_for(lambda: refused(night, "basis") > n_refused + 3000, 20.0, "seconds of telemetry")
    now = night.state
    assert "basis-mismatch" in night.alarms
    assert now["windows_accepted"] == then["windows_accepted"]
    assert now["registration"]["alpha"] == then["registration"]["alpha"]
    check_registration(now["registration"])
    assert night.n_modes_in_use() == N_TARGET
    assert "Traceback" not in service.log
