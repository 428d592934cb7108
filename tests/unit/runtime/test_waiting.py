"""What the link complains of, and whom the service waits for, from what is known at one moment."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from service.control.gains import gain_table
from service.link.statistics import Counters
from service.records.alarms import Alarm, Prerequisite, Responsible
from service.records.messages import as_message
from service.records.products import MatrixState
from service.records.registration import ModeGain
from service.records.state import Mode, TrackerState
from service.runtime.readiness import (
    DERIVED_EACH_SECOND,
    ReadinessInputs,
    ReadinessLog,
    Revival,
    complaints,
    detect_link_changes,
    gains_message,
    state_message,
    waiting_for,
)
from service.wire import GainsMessage, decode, encode
from tests.support.situations import ALPHA, START_NS, Story, moved, record, rtc
from tests.support.states import changed, tracker_state
from tests.support.waiting import SECOND, WELL, disposition, link


def waits(link, state=None, *, preparing=False):
    state = state or TrackerState(system="small")
    return {
        w.name: w for w in waiting_for(ReadinessInputs(state=state, link=link, preparing=preparing))
    }


# ---------------------------------------------------------------- complaints


def unused(*came):
    """Return which frames are not used."""
    return complaints(link(*came))["frames-unused"].values["about"]


def test_nothing_is_complained_of_while_all_is_well():
    assert complaints(link(*WELL)) == {}
    assert complaints(link()) == {}


@pytest.mark.parametrize(
    "outcome",
    ["late", "nonfinite", "shape", "leap", "sequence", "malformed", "session", "of-tomorrow"],
)
def test_frames_that_come_and_are_not_used_are_named_whatever_the_reason(outcome):
    made = complaints(link(disposition(outcome, 900, text="found x, expected y")))["frames-unused"]
    assert (made.values["about"], made.values["n_used"]) == (outcome, 0)


def test_duplicates_are_missed_only_where_they_are_all_that_comes():
    assert complaints(link(*WELL, disposition("duplicate", 2000))) == {}
    assert unused(disposition("duplicate", 2000)) == "duplicate"


def test_a_few_late_or_unfinite_frames_are_no_alarm_and_one_broken_batch_is():
    assert complaints(link(*WELL, disposition("late", 100), disposition("nonfinite", 100))) == {}
    assert unused(*WELL, disposition("leap", 1)) == "leap"
    assert unused(*WELL, disposition("leap", 0, age_s=9.0)) == "leap"
    assert complaints(link(*WELL, disposition("leap", 0, age_s=11.0))) == {}


def test_while_another_session_waits_to_be_taken_its_frames_are_not_missed():
    frames = disposition("session", 900)
    assert complaints(link(frames, session_waiting="s2")) == {}
    assert complaints(link(*WELL, frames)) == {}
    assert unused(frames) == "session"


def test_messages_that_broke_the_contract_are_named_with_what_was_found():
    bad = disposition("malformed", 1, "status", "range: leak is 2")
    made = complaints(link(*WELL, bad))["messages-refused"]
    assert made.key == "link.messages-refused: status"
    assert "range: leak is 2" in made.values["details"]
    assert complaints(link(*WELL, replace(bad, n=0, age_s=11.0))) == {}


def test_a_flood_of_statuses_is_named_with_its_rate():
    made = complaints(link(*WELL, disposition("spared", 990, "status")))["status-flood"]
    assert made.values["rate_hz"] == pytest.approx(500.0, rel=0.02)


def test_a_complaint_that_lasts_has_its_newest_text_and_ends_some_seconds_after_the_last():
    state = TrackerState(system="small")
    (made,) = detect_link_changes(link(disposition("late", 900, text="x 1")), state, START_NS)
    alarm = Alarm(
        name=made.name,
        since_ns_utc=START_NS,
        message=made.text,
        seen_ns_utc=START_NS + SECOND,
    )
    state = changed(state, active=(alarm,))
    (again,) = detect_link_changes(
        link(disposition("late", 950, text="x 2")), state, START_NS + SECOND
    )
    assert again.text.key == made.text.key
    assert again.text.values["n_frames"] == 950
    (other,) = detect_link_changes(
        link(disposition("shape", 950, text="y")), state, START_NS + SECOND
    )
    assert other.text.key == "link.frames-unused: shape"
    assert detect_link_changes(link(*WELL), state, START_NS + 3 * SECOND) == []
    (over,) = detect_link_changes(link(*WELL), state, START_NS + 5 * SECOND)
    assert (over.name, over.over) == ("frames-unused", True)
    assert {made.name, over.name} <= set(DERIVED_EACH_SECOND)


def test_what_came_is_counted_for_two_seconds_and_remembered_for_good():
    tally = Counters()
    for k in range(100):
        tally.add("frames", "used", 10, 0.1 * k)
        tally.add("frames", "late", 3 * (k == 50), 0.1 * k, "why")
    used, late = tally.dispositions(10.0)
    assert 180 <= used.n <= 230
    assert (late.n, late.age_s, late.text) == (0, 5.0, "why")
    assert tally.of("frames") == {"used": 1000, "late": 3}


# ---------------------------------------------------------------- waiting


def test_nothing_is_waited_for_while_all_is_well():
    state = tracker_state(
        system="small",
        mode=Mode.AUTO,
        rtc=rtc(cm_id="a"),
        verified_ids=frozenset({"a"}),
        reconstructors=(record("a", MatrixState.APPLIED),),
    )
    assert waits(link(*WELL), state) == {}


@pytest.mark.parametrize(
    ("found", "name", "party", "hinders"),
    [
        (link(rtc_alive=False, session=None, frame_age_s=None, status_age_s=None), "rtc", "rtc", 0),
        (link(session=None, frame_age_s=None, status_age_s=None), "telemetry", "rtc", 0),
        (link(*WELL[:1], status_age_s=None), "status", "rtc", 1),
        (link(*WELL[:1], status_age_s=3.1), "status", "rtc", 1),
        (link(frame_age_s=3.1), "frames", "rtc", 0),
        (link(disposition("late", 500, text="x")), "frames-unused", "rtc", 1),
        (link(disposition("session", 500), session_waiting="s2"), "session", "rtc", 0),
    ],
)
def test_what_the_rtc_does_not_send_is_waited_for(found, name, party, hinders):
    wait = waits(found)[name]
    assert (wait.responsible, wait.blocks) == (party, bool(hinders))
    assert len(wait.text) > 20


def test_a_network_that_is_not_there_is_waited_for_and_no_rtc_is_blamed():
    """Nothing of an RTC can arrive, however well it runs."""
    late = link(rtc_alive=False, session=None, frame_age_s=None, missing="no router answers")
    inputs = ReadinessInputs(
        state=TrackerState(system="small"), link=late, preparing=False, rest_missing="port taken"
    )
    found = [(w.name, w.responsible, w.text, w.blocks) for w in waiting_for(inputs)]
    assert found == [
        ("link", "network", "no router answers", True),
        ("rest", "network", "port taken", False),
    ]


def test_what_the_rtc_says_of_itself_is_waited_for_in_its_words_while_it_is_there():
    state = tracker_state(system="small", rtc=rtc(trouble="aol1_imWFS2: its counter stands at 7"))
    wait = waits(link(*WELL), state)["rtc-trouble"]
    assert (wait.responsible, wait.blocks) == ("rtc", True)
    assert wait.text == "aol1_imWFS2: its counter stands at 7"
    assert "rtc-trouble" not in waits(link(*WELL, rtc_alive=False), state)


def test_a_first_status_is_given_three_seconds():
    assert waits(link(*WELL[:1], status_age_s=None, session_age_s=2.9)) == {}


def test_the_model_is_waited_for_first():
    found = waiting_for(
        ReadinessInputs(state=TrackerState(system="s"), link=link(rtc_alive=False), preparing=True)
    )
    assert (found[0].name, found[0].responsible, found[0].blocks) == (
        "model",
        Responsible.WORKER,
        True,
    )


def test_a_matrix_without_a_name_or_without_its_numbers_is_waited_for():
    state = tracker_state(system="s", rtc=rtc(cm_id=None), read_back_error="no answer")
    wait = waits(link(*WELL), state)["matrix-name"]
    assert "cm_id is nil" in wait.text
    state = changed(state, rtc=rtc(cm_id="theirs"))
    assert "theirs" in waits(link(*WELL), state)["matrix-in-use"].text


@pytest.mark.parametrize(
    ("name", "party", "hinders"),
    [
        ("basis-mismatch", Responsible.OPERATOR, True),
        ("standing-by", Responsible.SERVICE, True),
        ("wrong-matrix", Responsible.RTC, False),
        ("dither", Responsible.RTC, False),
        ("loop-open", Responsible.OPERATOR, False),
    ],
)
def test_alarms_that_keep_the_service_from_its_job_are_waits(name, party, hinders):
    alarm = Alarm(name=name, since_ns_utc=0, message=as_message("x", "as the alarm says"))
    wait = waits(link(*WELL), tracker_state(system="s", active=(alarm,)))[name]
    assert (wait.responsible, wait.blocks, wait.text) == (party, hinders, "as the alarm says")


def test_what_an_operator_has_to_do_is_named():
    state = tracker_state(
        system="s",
        mode=Mode.HOLD,
        stopped=True,
        reconstructors=(record("a"), record("b", MatrixState.PUBLISHED)),
    )
    found = waits(link(*WELL), state)
    parties = {name: found[name].responsible for name in ("mode", "dither-stopped", "approval")}
    assert set(parties.values()) == {Responsible.OPERATOR}
    assert found["acknowledgement"].responsible is Responsible.RTC


def test_who_is_to_approve_of_a_proposal_hears_when_another_one_replaces_it():
    story = Story(Mode.PROPOSE).meet()
    story.see(n_windows=6)
    story.make("cm-1", created_ns_utc=START_NS)
    asked = "reconstructor cm-1 is proposed: approve or reject it"
    assert waits(link(*WELL), story.state)["approval"].text == asked
    known = story.state.alpha.registration
    moved_on = replace(known, alpha=moved(known.alpha, shift_x_subap=0.03))
    found = waits(link(*WELL), changed(story.state, registration=moved_on))["approval"].text
    then = datetime.fromtimestamp(START_NS / SECOND + 30, UTC).strftime("%H:%M:%S")
    assert found == f"{asked}; α has moved on since: a newer one follows after {then} UTC"


def test_a_wait_is_on_record_once_it_lasts_and_not_again_and_again():
    told, wait = (
        ReadinessLog(),
        Prerequisite(name="status", responsible=Responsible.RTC, text="none comes"),
    )
    lines = [told.due_lines((wait,), (), k * SECOND) for k in range(100)]
    assert [k for k, found in enumerate(lines) if found] == [2]
    assert lines[2] == ["rtc: none comes"]
    for k in range(100, 200):
        present = (wait,) if k % 10 else ()
        lines.append(told.due_lines(present, (), k * SECOND))
    assert len([k for k, found in enumerate(lines) if found and k > 99]) <= 2
    alarm = Alarm(name="status", since_ns_utc=0, message=as_message("x", ""))
    fresh = ReadinessLog()
    assert not any(fresh.due_lines((wait,), (alarm,), k * SECOND) for k in range(10))


def test_a_silent_token_has_the_link_opened_anew_ever_less_often():
    revival, silent = Revival(), link(disposition("used", 0, age_s=30.0))
    assert [t for t in range(100) if revival.due(silent, float(t))] == [10, 31, 72]
    assert [t for t in range(100, 3000) if revival.due(silent, float(t))][-2:] == [2421, 2722]
    assert not revival.due(link(*WELL), 3000.0)
    assert [t for t in range(3001, 3020) if revival.due(silent, float(t))] == [3011]


@pytest.mark.parametrize(
    "heard",
    [
        link(*WELL),
        link(disposition("used", 5, "status")),
        link(disposition("shape", 9)),
        link(),
    ],
)
def test_a_link_on_which_anything_comes_is_left_as_it_is(heard):
    gone = replace(heard, rtc_alive=False, dispositions=())
    revival = Revival()
    assert not any(
        revival.due(heard if heard.dispositions else gone, float(t)) for t in range(1000)
    )


def test_a_token_that_came_back_is_given_its_time():
    revival, silent = Revival(), link()
    for t in range(9):
        assert not revival.due(silent, float(t))
    assert not revival.due(link(rtc_alive=False), 9.0)
    assert not any(revival.due(silent, float(t)) for t in range(10, 20))
    assert revival.due(silent, 20.0)


def test_the_state_on_the_network_is_short_and_in_boundary_units():
    story = Story(Mode.HOLD).meet()
    nothing = state_message(story.state, 5)
    assert nothing.alpha is nothing.validity is None
    story.see()
    message = state_message(story.state, 5)
    assert message.validity == story.state.alpha.registration.validity.level
    assert (message.mode, message.in_use, message.t_ns) == ("hold", "initial", 5)
    assert message.alpha == pytest.approx(ALPHA.to_boundary())
    assert message.sigma["shift_x_subap"] == pytest.approx(np.hypot(0.002, 0.003))


def test_the_gains_on_the_network_are_of_all_modes_once_one_was_dithered():
    story = Story(Mode.HOLD).meet()
    assert gains_message(TrackerState(system="small")) is gains_message(story.state) is None
    story.see()
    assert gains_message(story.state) is None
    measured = (ModeGain(mode=20, gain=0.5, sigma=0.01, scatter=0.02, t_ns_utc=START_NS),)
    known = replace(story.state.alpha.registration, optical_gains=measured)
    message = gains_message(changed(story.state, registration=known))
    assert decode(GainsMessage, encode(message)) == message
    assert message.modes == tuple(one.mode for one in measured)
    gains, sigma = (np.frombuffer(data, "<f4") for data in (message.optical_gain, message.sigma))
    n_modes = story.state.loop.rtc.n_modes
    table = gain_table(measured, n_modes)
    np.testing.assert_allclose(gains, table.optical_gain, rtol=1e-6)
    np.testing.assert_allclose(sigma, table.optical_gain * table.relative_sigma, rtol=1e-6)
    assert message.t_ns == START_NS
    assert (message.frame_rate_hz, message.magnitude) == (1000.0, 8.0)


# ---------------------------------------------------------------- losses


def test_what_keeps_a_matrix_from_being_made_is_waited_for():
    state = tracker_state(system="small", rtc=rtc(), hindrance="Mode 30 does not answer.")
    found = waits(link(*WELL), state)["new-matrix"]
    assert (found.responsible, found.blocks) == (Responsible.OPERATOR, False)
    assert found.text == "Mode 30 does not answer."


def test_what_kept_a_matrix_is_not_said_while_an_alarm_forbids_all_decisions():
    hindrance, alarm = (
        "Raise [dither] budget_m.",
        Alarm(name="no-frames", since_ns_utc=0, message=as_message("x", "")),
    )
    state = tracker_state(system="s", rtc=rtc(), hindrance=hindrance)
    assert "new-matrix" in waits(link(*WELL), state)
    assert "new-matrix" not in waits(link(*WELL), changed(state, active=(alarm,)))
    assert "new-matrix" not in waits(link(*WELL), changed(state, rtc=None))
