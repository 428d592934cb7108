import json
import re
import time

import pytest

from pyrcal.client.rest import Fetched, UnreachableError
from pyrcal.demo.children import Child
from pyrcal.demo.truth import TruthFile
from pyrcal.demo.watch import (
    HEADING,
    HOLD_S,
    MAX_STRETCH,
    Promise,
    Stopwatch,
    TelemetryObserver,
    explain_waiting,
    live_line,
    rate_line,
    slow_line,
)
from tests.support.demo_report import TRUE, service_state, shelf, waiting

SECOND_NS = 1_000_000_000


def stopwatch(*looks):
    """A stopwatch that has seen pairs of wall clock and telemetry, seconds."""
    clock = Stopwatch(100.0, 5 * SECOND_NS)
    for wall_s, telemetry_s in looks:
        clock.look(100.0 + wall_s, round((5.0 + telemetry_s) * SECOND_NS))
    return clock


def steadily(seconds, pace):
    return [(n * 0.5, n * 0.5 * pace) for n in range(1, 2 * seconds + 1)]


def test_in_real_time_the_seconds_of_wall_and_telemetry_are_the_same():
    clock = stopwatch(*steadily(20, 1.0))
    assert clock.spent_s == pytest.approx(20.0)
    assert clock.pace == pytest.approx(1.0)


def test_on_a_slow_machine_the_seconds_of_telemetry_count():
    clock = stopwatch(*steadily(20, 0.6))
    assert clock.wall_s == pytest.approx(20.0)
    assert clock.spent_s == pytest.approx(12.0)
    assert clock.pace == pytest.approx(0.6)


def test_a_simulator_that_stops_does_not_stop_the_clock():
    clock = stopwatch(*steadily(10, 1.0), *[(10.0 + n, 10.0) for n in range(1, 21)])
    assert clock.spent_s == pytest.approx(25.0)
    assert clock.silent_s == pytest.approx(20.0)


def test_in_slow_motion_frames_say_that_the_simulator_goes_on():
    """Half a second of loop time, a line of the truth, takes twelve seconds here."""
    clock = Stopwatch(100.0, 0)
    for n in range(1, 241):
        clock.look(100.0 + n * 0.5, n // 24 * SECOND_NS // 2, 100.0 + n * 0.5 - 0.3)
    assert clock.spent_s == pytest.approx(5.0)
    assert clock.silent_s <= 0.5


def test_a_step_of_the_simulators_clock_is_not_time_that_passed():
    clock = stopwatch((0.5, 0.5), (1.0, 3601.0), (1.5, 3601.5), (2.0, 12.0), (2.5, 12.5))
    assert clock.spent_s <= 2.5
    assert clock.telemetry_s == pytest.approx(2.5)


def test_the_pace_of_the_first_seconds_is_not_told():
    assert stopwatch((0.5, 0.0), (1.0, 0.5)).pace is None


class Scene:
    """A service over REST and a truth file, both on a clock that only a sleep moves."""

    def __init__(self, tmp_path, monkeypatch):
        self.now_s, self.pace, self.ready_at_s = 0.0, 1.0, 6.0
        self.answers, self.right_at_s = True, 20.0
        self.alarms, self.lines = [], []
        self.path = tmp_path / "truth.jsonl"
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(time, "sleep", self.sleep)

    def sleep(self, seconds):
        self.now_s += seconds
        telemetry_s = self.now_s * self.pace
        cm_id, error_nm = ("cm-500", 100.0) if self.right else ("initial", 120.0)
        line = TRUE | {"kind": "truth", "t_ns_utc": round(telemetry_s * SECOND_NS)}
        line |= {"wavefront_error_nm": error_nm, "cm_id": cm_id}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    @property
    def right(self):
        return self.now_s >= self.right_at_s

    def get(self, path):
        if not self.answers:
            raise UnreachableError("no service")
        if path == "/v1/events":
            log = [{"name": "window.refused", "text": "the loop is open"}]
            return Fetched({"alarms": [], "log": log}, "")
        records = shelf() if self.right else shelf()[:1]
        if path == "/v1/reconstructors":
            return Fetched({"reconstructors": records}, "")
        state = service_state(self.alarms)
        if self.now_s < self.ready_at_s:
            state["waiting_for"] = [waiting("model", "worker", "the model is being prepared")]
        state["rtc"] = {"n_controlled": 400, "frame_rate_hz": 1000.0}
        state["in_use"], state["margin"] = "initial", None
        state["link"] = {"frames_received": round(1000 * self.now_s), "frames_lost": 0}
        if not self.right:
            state["registration"] = None
            state |= {"windows_accepted": 0, "windows_refused": 3}
        else:
            state["registration"]["age_s"] = 0.5
        return Fetched(state, "")

    def watch(self, seconds=60.0, *, whole=False, large=False, started=()):
        promise = Promise(seconds=seconds, whole=whole, large=large)
        truth = TruthFile(self.path)
        return TelemetryObserver(self, truth, list(started), promise, self.lines.append)


@pytest.fixture
def scene(tmp_path, monkeypatch):
    return Scene(tmp_path, monkeypatch)


def test_the_clock_starts_when_all_is_ready_and_until_then_it_says_what_it_waits_for(scene):
    watch = scene.watch()
    watch.run()
    report = watch.make_final_report()
    assert report.good
    assert report.seconds_to_ready == pytest.approx(6.0, abs=0.6)
    assert report.seconds_to_first_applied == pytest.approx(14.0, abs=0.6)
    assert [line for line in scene.lines if "preparing:" in line]


def test_it_ends_when_all_has_been_right_for_some_seconds(scene):
    scene.watch().run()
    assert 20.0 + HOLD_S <= scene.now_s <= 20.0 + HOLD_S + 3.0


def test_it_takes_all_its_time_where_something_is_to_happen_later(scene):
    scene.watch(whole=True).run()
    assert scene.now_s == pytest.approx(66.0, abs=1.1)


def test_when_time_is_up_it_fails_and_names_the_reason(scene):
    scene.right_at_s = 1e9
    watch = scene.watch()
    watch.run()
    report = watch.make_final_report()
    assert scene.now_s == pytest.approx(66.0, abs=1.1)
    assert "no estimate of the registration" in report.failures
    assert report.reasons == ["refused windows: 3 of 3; the last: the loop is open"]


def test_a_slow_machine_gets_its_seconds_of_telemetry_and_is_told_that_it_is_slow(scene):
    scene.pace, scene.right_at_s = 0.5, 90.0
    watch = scene.watch()
    watch.run()
    assert watch.make_final_report().good
    assert any("0.5 of real time" in line for line in scene.lines)


def test_a_machine_however_slow_comes_to_an_end(scene):
    scene.pace, scene.right_at_s = 0.01, 1e9
    scene.watch(seconds=20.0).run()
    assert scene.now_s == pytest.approx(6.0 + MAX_STRETCH * 20.0, abs=1.1)


def test_thousands_of_modes_get_more_of_the_clock(scene):
    scene.pace, scene.right_at_s = 0.05, 500.0
    watch = scene.watch(seconds=20.0, large=True)
    watch.run()
    assert watch.make_final_report().good


def test_a_worker_that_is_behind_gets_more_time(scene):
    scene.alarms, scene.right_at_s = ["worker-behind"], 1e9
    scene.watch(seconds=20.0).run()
    assert scene.now_s == pytest.approx(6.0 + MAX_STRETCH * 20.0, abs=1.1)
    assert any("worker is behind" in line for line in scene.lines)


def test_an_old_answer_is_never_shown_as_a_fresh_one(scene):
    watch = scene.watch(seconds=30.0)
    sleep = scene.sleep

    def sleep_and_fall_silent(seconds):
        scene.answers = scene.now_s < 12.0
        sleep(seconds)

    time.sleep = sleep_and_fall_silent  # the scene's own patch is undone with it
    watch.run()
    silent = [line for line in scene.lines if "no answer from the service for" in line]
    assert len(silent) >= 8
    assert not any("modes)" in line for line in scene.lines[scene.lines.index(silent[0]) :])
    failures = watch.make_final_report().failures
    assert any("the service has not answered for" in text for text in failures)


def test_a_model_that_is_never_ready_ends_the_demo_with_the_reason(scene):
    scene.ready_at_s = scene.right_at_s = 1e9
    watch = scene.watch()
    watch.run()
    assert 100.0 < scene.now_s < 300.0
    assert watch.make_final_report().reasons[0].startswith("the service was not ready")


class Ended:
    """A process that has ended."""

    returncode = 3

    def poll(self):
        return self.returncode


def test_a_process_that_ends_ends_the_demo_with_its_last_words(scene, tmp_path):
    log = tmp_path / "simulator.log"
    log.write_text("starting\nsim_rtc: no such telescope\n", encoding="utf-8")
    child = Child(name="simulator", log=log, process=Ended())
    watch = scene.watch(started=[child])
    watch.run()
    assert scene.now_s < 10.0
    ending = "the simulator ended with status 3: sim_rtc: no such telescope"
    assert ending in watch.make_final_report().reasons


SHOWN = {
    "ready": True,
    "ready_reason": "ready",
    "rtc": {"n_controlled": 400},
    "in_use": "cm-1",
    "alarms": [],
    "waiting_for": [],
    "margin": {"worst_pole_radius": 0.712},
    "link": {"frames_received": 12_345, "frames_lost": 2},
    "registration": {
        "alpha": {
            "shift_x_subap": 0.12,
            "shift_y_subap": -0.08,
            "rotation_deg": 0.2,
            "magnification": 1.003,
        },
        "sigma": {
            "shift_x_subap": 0.003,
            "shift_y_subap": 0.003,
            "rotation_deg": 0.005,
            "magnification": 0.0003,
        },
        "age_s": 1.25,
    },
}


def test_a_line_shows_frames_registration_loop_and_matrix():
    line = live_line(12.0, SHOWN, {"wavefront_error_nm": 117.6})
    for part in ("12345", "+0.1200±0.0030", "+0.2000±0.0050", "1.00300", "118", "0.712", "cm-1"):
        assert part in line
    assert "(400 modes)" in line


def test_the_columns_stand_below_their_headings():
    line = live_line(12.0, SHOWN, {"wavefront_error_nm": 117.6})
    heading = HEADING.splitlines()[0]
    assert [m.start() for m in re.finditer(r"\|", line)] == [
        m.start() for m in re.finditer(r"\|", heading)
    ]


def test_a_line_without_a_registration_is_as_wide():
    full = live_line(12.0, SHOWN, None)
    empty = live_line(12.0, SHOWN | {"registration": None}, None)
    assert empty.index("cm-1") == full.index("cm-1")


def test_alarms_and_what_is_waited_for_are_seen():
    assert "[margin]" in live_line(1.0, SHOWN | {"alarms": [{"name": "margin"}]}, None)
    assert "no RTC" in live_line(1.0, SHOWN | {"rtc": None}, None)
    preparing = SHOWN | {"ready": False, "ready_reason": "the model is being prepared"}
    assert "the model is being prepared" in live_line(1.0, preparing, None)
    waits = [{"name": "margin"}, {"name": "status"}]
    waiting = SHOWN | {"alarms": [{"name": "margin"}], "waiting_for": waits}
    assert "[margin] waits for status" in live_line(1.0, waiting, None)
    assert "the service is starting" in live_line(1.0, None, None)


def test_a_simulator_or_a_worker_that_is_slow_is_said_to_be_slow():
    assert slow_line(0.97, behind=False) is None
    assert slow_line(None, behind=False) is None
    assert "the simulator runs at 0.6 of real time" in slow_line(0.61, behind=False)
    assert "worker is behind" in slow_line(1.0, behind=True)


def test_while_it_prepares_the_demo_says_what_it_waits_for():
    assert explain_waiting(None) == "the service is starting"
    wait = {
        "name": "model",
        "responsible": "worker",
        "text": "it is being prepared",
        "blocks": True,
    }
    assert explain_waiting({"waiting_for": [wait]}) == "for the worker: it is being prepared"
    assert "telescope" in explain_waiting({"waiting_for": []})


def test_a_loop_that_runs_slower_than_usual_is_told():
    assert rate_line(None) is None
    assert rate_line({"rtc": None}) is None
    assert rate_line({"rtc": {"frame_rate_hz": 1000.0}}) is None
    slower = {"rtc": {"frame_rate_hz": 100.0}}
    assert "simulated at 100 Hz of 1000: what this machine holds" in rate_line(slower)
    assert "simulated at 100 Hz of 500: what this machine holds" in rate_line(slower, 500.0)
