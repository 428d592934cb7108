from dataclasses import replace

from service.records.messages import Range, compose, widen
from service.records.state import Level, TrackerState
from service.tracking.step_context import LOG_LENGTH, StepContext, log_bursts, logged
from tests.support.situations import turned

STATE = TrackerState(system="flao")
WEAK = compose("window.dither-weak", mode=3, found_nm=2.5, place=" at 211.0 Hz", requested_nm=5.0)


def counted(state, now_ns):
    return turned(state, log_bursts, now_ns=now_ns)


def with_alarm(state, name, text, now_ns):
    return turned(state, StepContext.raise_alarm, name, text, now_ns=now_ns)


def without_alarm(state, name, now_ns):
    return turned(state, StepContext.clear_alarm, name, now_ns=now_ns)


SECOND_NS = 10**9


def test_a_repeated_line_is_counted():
    state = logged(logged(STATE, "x", "same", 1), "x", "same", 9)
    (entry,) = state.log
    assert (entry.t_ns_utc, entry.last_ns_utc, entry.text, entry.times) == (1, 9, "same", 2)


def test_a_burst_of_refused_windows_is_one_line_and_then_one_with_a_count():
    """Eleven windows a second were refused; their texts differ in their numbers."""
    state = STATE
    for k in range(600):
        weak = replace(WEAK, values=WEAK.values | {"found_nm": 0.1 * k})
        state = logged(state, "window.refused", weak, k * SECOND_NS // 11)
        state = logged(state, "other", str(k), k * SECOND_NS // 11) if k % 50 == 0 else state
        state = counted(state, k * SECOND_NS // 11)
    lines = [entry for entry in state.log if entry.name == "window.refused"]
    assert [entry.times for entry in lines] == [600]
    state = counted(state, 61 * SECOND_NS)
    lines = [entry for entry in state.log if entry.name == "window.refused"]
    whole = WEAK.format_ranges({"found_nm": Range(0.0, 59.9)})
    assert lines[-1].message.key == "log.burst: window.dither-weak"
    assert lines[-1].text == f"{whole} (600 times in 54 s, 00:00:00 to 00:00:54 UTC)"
    assert "carries 0.00 to 59.90 nm" in lines[-1].text
    assert lines[-1].t_ns_utc == 599 * SECOND_NS // 11, "and has the time of its end"
    assert [entry.times for entry in lines] == [1, 1]
    assert counted(state, 200 * SECOND_NS) is state


def test_the_first_id_of_a_burst_stands_for_all():
    state = STATE
    for k in range(3):
        lost = compose("dither.not-in-frames", id=f"dither-18{k}", silent_s=5.0 - 2 * k)
        state = logged(state, "dither.lost", lost, k * SECOND_NS)
    state = counted(state, 61 * SECOND_NS)
    assert [entry.text for entry in state.log] == [
        "the RTC accepted dither-180: its frames held none of it for 5.0 s",
        "the RTC accepted dither-180: its frames held none of it for 1.0 to 5.0 s (3 times in 2 s, "
        "00:00:00 to 00:00:02 UTC)",
    ]


def test_a_number_in_a_text_without_a_code_is_news():
    state = logged(STATE, "job.failed", "no answer in 2 s", 1)
    state = logged(state, "job.failed", "no answer in 3 s", 2)
    state = logged(state, "job.failed", "no answer in 2 s", 3)
    assert [entry.times for entry in state.log] == [2, 1]


def test_a_range_is_one_number_if_both_look_alike():
    assert f"{Range(1.0, 1.04):.1f}" == "1.0"
    assert f"{Range(1, 3)}" == "1 to 3"
    widened = widen(widen({}, WEAK), replace(WEAK, values=WEAK.values | {"mode": 1}))
    assert widened == {"mode": (1, 3), "found_nm": (2.5, 2.5), "requested_nm": (5.0, 5.0)}


def test_after_a_minute_a_repeated_line_is_told_again():
    state = logged(STATE, "window.refused", "a", 1)
    state = logged(state, "window.refused", "a", 61 * SECOND_NS)
    assert [entry.times for entry in state.log] == [1, 1]


def test_another_reason_is_another_line():
    state = logged(logged(STATE, "window.refused", "a", 1), "window.refused", "b", 2)
    assert [entry.text for entry in state.log] == ["a", "b"]


def test_deeds_that_name_what_they_are_of_are_never_counted_together():
    state = logged(STATE, "reconstructor.published", "cm-1", 1)
    state = logged(state, "reconstructor.published", "cm-2", 2)
    assert [entry.text for entry in state.log] == ["cm-1", "cm-2"]


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
    (alarm,) = state.alarms.active
    assert (alarm.since_ns_utc, alarm.seen_ns_utc, alarm.text) == (5, 8, "shorter")
    assert [(entry.level, entry.text) for entry in state.log] == [(Level.ALARM, "short")]


def test_an_alarm_that_ends_says_so_once():
    state = without_alarm(with_alarm(STATE, "margin", "short", 5), "margin", 9)
    assert not state.alarms.active
    assert state.log[-1].text == "margin: over"
    assert without_alarm(state, "margin", 10) is state
