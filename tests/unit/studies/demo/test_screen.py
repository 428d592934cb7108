import re

from studies.demo.report import Report, Stage
from studies.demo.screen import HEADING, awaited, live_line, slow_line, table

STATE = {
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
    line = live_line(12.0, STATE, {"wavefront_error_nm": 117.6})
    for part in ("12345", "+0.1200±0.0030", "+0.2000±0.0050", "1.00300", "118", "0.712", "cm-1"):
        assert part in line
    assert "(400 modes)" in line


def test_the_columns_stand_below_their_headings():
    line = live_line(12.0, STATE, {"wavefront_error_nm": 117.6})
    heading = HEADING.splitlines()[0]
    assert [m.start() for m in re.finditer(r"\|", line)] == [
        m.start() for m in re.finditer(r"\|", heading)
    ]


def test_a_line_without_a_registration_is_as_wide():
    full = live_line(12.0, STATE, None)
    empty = live_line(12.0, STATE | {"registration": None}, None)
    assert empty.index("cm-1") == full.index("cm-1")


def test_alarms_and_what_is_waited_for_are_seen():
    assert "[margin]" in live_line(1.0, STATE | {"alarms": [{"name": "margin"}]}, None)
    assert "no RTC" in live_line(1.0, STATE | {"rtc": None}, None)
    preparing = STATE | {"ready": False, "ready_reason": "the model is being prepared"}
    assert "the model is being prepared" in live_line(1.0, preparing, None)
    waits = [{"name": "margin"}, {"name": "status"}]
    waiting = STATE | {"alarms": [{"name": "margin"}], "waiting_for": waits}
    assert "[margin] waits for status" in live_line(1.0, waiting, None)
    assert "the service is starting" in live_line(1.0, None, None)


def test_the_table_says_what_failed_or_that_all_is_good():
    assert table(Report()).endswith("GOOD: the main job was done")
    text = table(Report(failures=["no estimate of the registration"]))
    assert "FAILED: no estimate of the registration" in text
    assert "GOOD" not in text


def test_the_table_shows_what_was_reached_and_what_was_not():
    text = table(Report(start=Stage(id="a", n_modes=400, worst_pole_radius=0.93)))
    assert "400" in text
    assert "0.930" in text
    assert text.count("never reached") == 2


def test_the_table_names_the_reasons_behind_a_failure():
    text = table(Report(failures=["no estimate"], reasons=["no frames"]))
    assert text.endswith("FAILED: no estimate\nbecause: no frames")


def test_the_table_tells_preparing_from_doing():
    text = table(Report(seconds_to_ready=7.5, seconds_to_first_applied=9.2))
    assert "ready 7.5 s after the start" in text
    assert "first applied 9.2 s after it was ready" in text
    assert "never ready" in table(Report())


def test_a_slow_machine_is_said_to_be_slow_and_a_slow_telescope_is_not_its_fault():
    assert slow_line(0.97, real_time=True, behind=False) is None
    assert slow_line(None, real_time=True, behind=False) is None
    slow = slow_line(0.61, real_time=True, behind=False)
    assert "this machine is slow: the simulator runs at 0.6 of real time" in slow
    assert "this machine" not in slow_line(0.2, real_time=False, behind=False)
    assert "worker is behind" in slow_line(1.0, real_time=True, behind=True)


def test_while_it_prepares_the_demo_says_what_it_waits_for():
    assert awaited(None) == "the service is starting"
    wait = {"name": "model", "party": "worker", "text": "it is being prepared", "hinders": True}
    assert awaited({"waiting_for": [wait]}) == "for the worker: it is being prepared"
    assert "telescope" in awaited({"waiting_for": []})
