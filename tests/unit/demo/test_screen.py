import re

from service.demo.report import Report, Stage
from service.demo.screen import HEADING, live_line, table

STATE = {
    "ready": True,
    "ready_reason": "ready",
    "rtc": {"n_controlled": 400},
    "in_use": "cm-1",
    "alarms": [],
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
