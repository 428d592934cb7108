import json
import re
from dataclasses import replace

import pytest

from pyrcal.demo.report import Circumstances, Report, Stage, make_report, table
from pyrcal.demo.truth import TruthFile
from tests.support.demo_report import TRUE, gate, service_state, shelf, waiting

WELL = Circumstances(seconds_to_ready=4.0, seconds_to_first_applied=12.0, pace=1.0)


@pytest.fixture
def truth(tmp_path):
    """Three seconds under each matrix, the error falling with the number of modes."""
    lines = []
    for index, (name, error_nm) in enumerate(
        [("initial", 120.0), ("cm-400", 119.0), ("cm-500", 105.0)]
    ):
        for second in range(4):
            t_ns = (10 * index + second) * 1_000_000_000
            lines.append(
                TRUE
                | {
                    "kind": "truth",
                    "t_ns_utc": t_ns,
                    "wavefront_error_nm": 999.0 if second == 0 else error_nm,
                    "cm_id": name,
                }
            )
    path = tmp_path / "truth.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    file = TruthFile(path)
    file.read()
    return file


def names(texts, *words):
    """Whether there is one text, which has these numbers and names."""
    (text,) = texts
    return all(word in text for word in words)


def test_a_night_that_went_well_is_good(truth):
    report = make_report(service_state(), shelf(), truth, WELL)
    assert report.failures == []
    assert report.good
    assert report.start.worst_pole_radius == 0.93
    assert report.first_update.wavefront_error_nm == pytest.approx(119.0)
    assert report.target_modes.wavefront_error_nm == pytest.approx(105.0)
    assert (report.reconstructors_published, report.reconstructors_applied) == (2, 2)


def test_before_and_after_stand_side_by_side(truth):
    report = make_report(service_state(), shelf(), truth, WELL)
    assert report.wavefront_ratio == pytest.approx(120.0 / 105.0)
    (line,) = [line for line in table(report).splitlines() if "Strehl" in line]
    # Marechal: exp(-(2 pi 120/1650)^2), exp(-(2 pi 105/1650)^2)
    assert re.findall(r"[\d.]+", line) == ["120", "105", "1.14", "1.65", "0.81", "0.85"]


def test_a_night_that_won_less_than_was_promised_fails(truth):
    promised = replace(WELL, wanted_ratio=1.5)
    report = make_report(service_state(), shelf(), truth, promised)
    assert names(report.failures, "1.14 times", "expected 1.5")


def test_the_picture_shows_both_stages(truth, tmp_path):
    pytest.importorskip("matplotlib")
    from pyrcal.demo.figure import draw

    for line in truth.lines:
        line["n_controlled"] = 500 if line["cm_id"] == "cm-500" else 400
    draw(make_report(service_state(), shelf(), truth, WELL), truth, tmp_path / "night.png")
    assert (tmp_path / "night.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("shift_x_subap", 0.0201),
        ("shift_y_subap", -0.0201),
        ("rotation_deg", 0.0501),
        ("magnification", -0.00201),
    ],
)
def test_an_estimate_beyond_its_tolerance_fails(truth, name, error):
    report = make_report(service_state(**{name: error}), shelf(), truth, WELL)
    assert not report.good
    assert any(text.startswith(f"{name} is off by") for text in report.failures)


@pytest.mark.parametrize(
    ("across_subap", "allowed_deg"), [(7.0, 0.2143), (15.0, 0.1), (30.0, 0.05), (90.0, 0.05)]
)
def test_a_small_pupil_may_turn_until_its_edge_moves_as_far(truth, across_subap, allowed_deg):
    """0.05 deg at 15 subapertures from the middle: 0.0131 of one; 0.2143 deg at 3.5, too."""
    well = replace(WELL, across_subap=across_subap)
    for error, refused in ((0.99 * allowed_deg, False), (1.01 * allowed_deg, True)):
        report = make_report(service_state(rotation_deg=error), shelf(), truth, well)
        found = [text for text in report.failures if "allowed" in text]
        assert bool(found) is refused, found


def test_an_estimate_within_its_tolerance_but_surer_than_it_may_be_fails(truth):
    report = make_report(service_state(rotation_deg=0.03), shelf(), truth, WELL)
    assert names(report.failures, "rotation_deg", "+5.0 sigma")
    assert report.error_in_sigma["rotation_deg"] == pytest.approx(5.0)


def test_a_margin_that_did_not_recover_fails(truth):
    report = make_report(service_state(), shelf(cm_400={"gate": gate(0.94)}), truth, WELL)
    assert names(report.failures, "margin")


def test_a_matrix_that_nobody_had_time_to_judge_is_no_margin_that_did_not_recover(truth):
    report = make_report(service_state(), shelf(initial={"gate": None}), truth, WELL)
    assert report.good
    assert "not judged" in table(report)
    unknown = make_report(service_state(), shelf(cm_400={"gate": None}), truth, WELL)
    assert names(unknown.failures, "margin")


def test_a_worker_that_is_behind_is_told_and_fails_nothing_by_itself(truth):
    report = make_report(service_state(alarms=["worker-behind"]), shelf(), truth, WELL)
    assert report.good
    assert report.alarms == ["worker-behind: found"]
    behind = [{"name": "worker-behind", "text": "busy all the time"}]
    assert "too slow: busy all the time" in failed(truth, alarms=behind)


def test_more_modes_that_do_not_lower_the_wavefront_error_fail(truth):
    for line in truth.lines:
        if line["cm_id"] == "cm-500":
            line["wavefront_error_nm"] = 121.0
    report = make_report(service_state(), shelf(), truth, WELL)
    assert names(report.failures, "wavefront error")


def test_a_matrix_applied_just_before_the_end_is_not_yet_the_one_that_is_judged(truth):
    records = shelf()
    last = records[-1] | {"id": "cm-501", "parent": "cm-500"}
    report = make_report(service_state(), [*records, last], truth, WELL)
    assert report.good
    assert report.target_modes.id == "cm-500"


def test_a_night_without_more_modes_fails(truth):
    report = make_report(service_state(), shelf()[:2], truth, WELL)
    assert report.target_modes.id is None
    assert not report.good


def test_frames_skipped_at_a_swap_fail(truth):
    truth.lines.append({"kind": "swap", "cm_id": "cm-500", "frames_skipped": 3})
    report = make_report(service_state(), shelf(), truth, WELL)
    assert names(report.failures, "3 frames", "cm-500")


def test_an_alarm_that_lasts_to_the_end_fails(truth):
    report = make_report(service_state(alarms=["margin"]), shelf(), truth, WELL)
    assert report.failures == ["alarm margin: found"]


def test_without_a_registration_there_is_nothing_to_compare(truth):
    state = service_state() | {"registration": None}
    report = make_report(state, shelf(), truth, Circumstances())
    assert any("registration" in text for text in report.failures)
    assert report.true_alpha == TRUE


def test_a_service_that_never_answered_fails(truth):
    report = make_report(None, [], truth, Circumstances())
    assert names(report.failures, "never answered")


def test_what_was_refused_and_rejected_is_counted(truth):
    extra = [
        shelf(cm_400={"state": state, "applied_frame_seq": None})[1]
        for state in ("refused", "rejected", "rejected")
    ]
    report = make_report(service_state(), shelf() + extra, truth, WELL)
    assert report.reconstructors_refused_by_gate == 1
    assert report.reconstructors_rejected_by_rtc == 2


def test_the_report_is_json_with_its_verdict(truth):
    report = make_report(service_state(), shelf(), truth, WELL)
    found = json.loads(report.to_json())
    assert found["good"] is True
    assert found["true_alpha"] == TRUE
    assert found["target_modes"]["n_modes"] == 500


def failed(truth, circumstances=WELL, **changes):
    """A night without an estimate, and what is said of it."""
    state = service_state() | {"registration": None, "windows_accepted": 0} | changes
    report = make_report(state, shelf()[:1], truth, circumstances)
    assert not report.good
    return report.reasons


def test_a_good_night_needs_no_reasons(truth):
    slow = Circumstances(pace=0.3, frameless_s=9.0)
    assert make_report(service_state(), shelf(), truth, slow).reasons == []


def test_refused_windows_are_the_reason_with_what_was_said_of_the_last(truth):
    circumstances = Circumstances(refusal="the loop changed within the window")
    reasons = failed(truth, circumstances, windows_refused=27)
    assert names(reasons, "27 of 27", circumstances.refusal)


def test_telemetry_that_gave_no_window_at_all_is_the_reason(truth):
    assert names(failed(truth, windows_refused=0), "no window")


def test_frames_that_never_came_or_stopped_are_the_reason(truth):
    link = {"frames_received": 0, "frames_lost": 0}
    assert any("no frames: none" in text for text in failed(truth, link=link))
    stopped = failed(truth, Circumstances(frameless_s=12.3))
    assert any("no frames" in text and "12 s ago" in text for text in stopped)


def test_a_simulator_that_is_slow_or_silent_is_the_reason(truth):
    slow = failed(truth, Circumstances(pace=0.62))
    assert any("simulator" in text and "0.62 s" in text for text in slow)
    silent = failed(truth, Circumstances(silent_s=8.0))
    assert any("simulator" in text and "for 8 s" in text for text in silent)


def test_a_service_that_was_never_ready_says_what_it_waited_for(truth):
    reasons = failed(truth, waiting_for=[waiting("model", "worker", "the model is prepared")])
    assert names(reasons, "not ready", "worker", "the model is prepared")


def test_what_the_service_waits_for_is_passed_on_once(truth):
    waits = [waiting("status", "rtc", "no status"), waiting("margin", "operator", "approve")]
    reasons = failed(truth, waiting_for=waits, alarms=[{"name": "margin", "text": "approve"}])
    assert "waiting: for the rtc: no status" in reasons
    assert not any("approve" in reason for reason in reasons)


def test_a_process_that_ended_is_named_with_its_last_words(truth):
    ending = "the service ended with status 2: pyrcal: no such thing"
    report = make_report(None, [], truth, Circumstances(endings=(ending,)))
    assert names(report.failures, "never answered")
    assert report.reasons == [ending]


def test_an_old_answer_is_not_a_good_one(truth):
    report = make_report(service_state(), shelf(), truth, Circumstances(unanswered_s=7.2))
    assert names(report.failures, "not answered", "7 s")


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


MEASURED = replace(WELL, measured_plant=True, wanted_ratio=1 / 1.1)


def without_truth(truth):
    truth.lines = [
        line | dict.fromkeys(TRUE) if line["kind"] == "truth" else line for line in truth.lines
    ]
    return truth


def test_on_a_measured_plant_a_tenth_more_wavefront_error_is_good(truth):
    truth.read()
    report = make_report(service_state(), shelf(), without_truth(truth), MEASURED)
    assert report.good
    assert (report.true_alpha, report.error) == (None, None)
    assert report.estimated_alpha == TRUE
    assert report.wavefront_ratio == pytest.approx(120 / 105)
    assert "not known" in table(report)


def test_on_a_measured_plant_the_first_matrix_counts_where_no_modes_are_added(truth):
    truth.read()
    for line in truth.lines:
        if line.get("cm_id") == "cm-400":
            line["wavefront_error_nm"] = 133.0
    report = make_report(service_state(), shelf()[:2], without_truth(truth), MEASURED)
    assert not report.good
    assert report.wavefront_ratio == pytest.approx(120 / 133)


def test_on_a_measured_plant_without_an_estimate_nothing_is_good(truth):
    truth.read()
    state = service_state() | {"registration": None}
    report = make_report(state, shelf()[:1], without_truth(truth), MEASURED)
    assert len(report.failures) == 2
