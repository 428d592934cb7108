from service.reactions.journal import LOG_LENGTH, logged, with_alarm, without_alarm
from service.state import Level, TrackerState

STATE = TrackerState(system="flao")


def test_a_repeated_line_only_renews_its_time():
    state = logged(logged(STATE, "x", "same", 1), "x", "same", 9)
    assert [(entry.t_ns_utc, entry.text) for entry in state.log] == [(9, "same")]


def test_the_same_text_after_another_line_is_a_new_line():
    state = STATE
    for text in ("one", "two", "one"):
        state = logged(state, "x", text, 1)
    assert [entry.text for entry in state.log] == ["one", "two", "one"]


def test_the_log_forgets_its_oldest_lines():
    state = STATE
    for number in range(LOG_LENGTH + 3):
        state = logged(state, "x", str(number), number)
    assert len(state.log) == LOG_LENGTH
    assert state.log[0].text == "3"


def test_an_alarm_raised_again_keeps_its_beginning_and_is_logged_once():
    state = with_alarm(with_alarm(STATE, "margin", "short", 5), "margin", "shorter", 8)
    (alarm,) = state.alarms
    assert (alarm.since_ns_utc, alarm.seen_ns_utc, alarm.text) == (5, 8, "shorter")
    assert [(entry.level, entry.text) for entry in state.log] == [(Level.ALARM, "short")]


def test_an_alarm_that_ends_says_so_once():
    state = without_alarm(with_alarm(STATE, "margin", "short", 5), "margin", 9)
    assert not state.alarms
    assert state.log[-1].text == "margin: over"
    assert without_alarm(state, "margin", 10) is state
