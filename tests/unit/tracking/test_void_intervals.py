"""Which telemetry is void: by when it began, for what it is asked, and for how long it is kept."""

import pytest

from service.tracking import validity
from service.tracking.registration import Purpose
from service.tracking.validity import (
    INTERVALS_KEPT,
    KEPT_S,
    TelemetrySpan,
    invalidate_telemetry,
    make_valid,
    void_until,
    why_void,
)
from tests.states import changed, tracker_state
from tests.unit.tracking.situations import SECOND, START_NS, rtc, turned

STATE = tracker_state(rtc=rtc())


def at(began_s, lasts_s=2.0):
    """Telemetry that began so long after the RTC's last status."""
    began_ns = START_NS + round(began_s * SECOND)
    return TelemetrySpan(began_ns_utc=began_ns, ended_ns_utc=began_ns + round(lasts_s * SECOND))


def void(state, until_s, because, **kwargs):
    return turned(state, void_until, START_NS + round(until_s * SECOND), because, **kwargs)


def test_what_began_before_is_void_whenever_it_is_worked_out():
    state = void(STATE, 10.0, "the edge had slipped")
    assert why_void(state, at(9.9)) == "the edge had slipped"
    assert why_void(state, at(10.0)) is None, "a window may begin where the one before it ends"
    assert why_void(state, at(9.9995)) is None, "but for the rounding of a frame"
    assert why_void(STATE, at(-1e6)) is None


def test_each_purpose_is_asked_by_itself():
    state = void(STATE, 10.0, "it jumped", purpose=Purpose.PASSIVE)
    assert why_void(state, at(0.0)) is None
    assert why_void(state, at(0.0), Purpose.PASSIVE) == "it jumped"
    assert why_void(state, at(0.0), Purpose.SETTLE) is None


def test_the_first_reason_that_covers_is_told_and_a_later_one_for_what_came_after_it():
    state = void(void(STATE, 5.0, "one"), 10.0, "other")
    assert (why_void(state, at(4.0)), why_void(state, at(6.0))) == ("one", "other")


def test_the_same_reason_again_takes_the_place_of_the_last():
    state = void(void(STATE, 10.0, "one"), 5.0, "one")
    assert len(state.alpha.void_intervals) == 1
    assert why_void(state, at(6.0)) is None


def test_what_was_not_so_after_all_is_valid_again():
    state = void(void(STATE, 5.0, "moved"), 5.0, "slipped")
    assert why_void(turned(state, make_valid, Purpose.MEASURE, "moved"), at(0.0)) == "slipped"
    assert why_void(turned(state, make_valid, Purpose.MEASURE), at(0.0)) is None


def test_they_are_bounded_and_old_ones_go():
    state = STATE
    for k in range(3 * INTERVALS_KEPT):
        state = void(state, float(k), f"reason {k}")
    assert len(state.alpha.void_intervals) == INTERVALS_KEPT
    state = void(state, KEPT_S + 3 * INTERVALS_KEPT, "long after")
    assert [each.because for each in state.alpha.void_intervals] == ["long after"]


@pytest.mark.parametrize(("ahead_s", "is_void"), [(50.0, True), (70.0, False)])
def test_a_clock_that_was_set_back_makes_nothing_void(ahead_s, is_void):
    state = void(STATE, ahead_s, "one")
    assert (why_void(state, at(0.0)) is not None) is is_void


def test_telemetry_until_now_is_void_by_the_rtcs_clock_or_by_what_is_known_better():
    now = turned(STATE, invalidate_telemetry, "one")
    better = turned(STATE, invalidate_telemetry, "one", t_ns_utc=START_NS + SECOND)
    assert validity.end_of(now, "one") == START_NS
    assert validity.end_of(better, "one") == START_NS + SECOND
    assert validity.end_of(changed(now, void_intervals=()), "one") == 0
