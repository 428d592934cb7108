"""Windows refused one after the other are an alarm, unless something else explains them."""

from dataclasses import replace

import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import WINDOWS_REFUSED
from service.records.estimates import RefusalKind, WindowRefused
from service.records.messages import compose
from service.records.state import Mode
from service.tracking.operations.running import ServiceState, operating
from service.tracking.window_processing import N_CONSECUTIVE_WINDOWS
from service.wire import DitherStatus
from tests.support.situations import ALPHA, Story, dither_answered, moved, rtc

MISSING = compose("window.frames-missing", missing=150, n_frames=2000, most=0.05)


@pytest.fixture
def story():
    """α is known, and a dither runs."""
    told = Story(Mode.HOLD).meet()
    told.see(n_windows=3)
    return told


def refuse(story, n=1, kind=RefusalKind.OTHER, reason=MISSING):
    for _ in range(n):
        refused = WindowRefused(reason=reason, t_ns_utc=story.now_ns, kind=kind)
        story.tell(ev.WindowLost(refused=refused), after_s=2.0)
    return story


def text_of(story):
    return next(alarm.text for alarm in story.state.alarms.active if alarm.name == WINDOWS_REFUSED)


@pytest.mark.parametrize("between", [0, 4])
def test_the_third_in_a_row_is_an_alarm_with_the_reason_and_the_service_is_degraded(story, between):
    assert WINDOWS_REFUSED not in refuse(story, N_CONSECUTIVE_WINDOWS - 1).alarms
    refuse(story, between, RefusalKind.CUT_SHORT)
    assert WINDOWS_REFUSED not in story.alarms, "a matrix was swapped in them: no fault"
    refuse(story)
    assert str(MISSING) in text_of(story)
    assert operating(story.state, "", story.now_ns).service_state is ServiceState.DEGRADED


def test_hundreds_of_them_are_one_line_of_alarm(story):
    refuse(story, 145)
    assert story.logged.count(WINDOWS_REFUSED) == 1
    assert story.state.windows.refused == 145


def test_the_last_one_is_known_without_the_log(story):
    assert story.state.windows.refusal is None
    last = refuse(story, 3).state.windows.refusal
    assert (last.text, last.times, last.last_ns_utc) == (str(MISSING), 3, story.now_ns)
    story.state = replace(story.state, log=())
    story.see()
    assert story.state.windows.refusal is last
    other = refuse(story, reason="edge slip").state.windows.refusal
    assert (other.text, other.times) == ("edge slip", 1)


def test_its_text_stays_while_the_cause_does_and_changes_with_it(story):
    refuse(story, N_CONSECUTIVE_WINDOWS)
    told = text_of(story)
    assert str(MISSING) in told
    refuse(story, reason=replace(MISSING, values=MISSING.values | {"missing": 153}))
    assert text_of(story) == told
    refuse(story, reason="the rotation is beyond 2 deg")
    assert "beyond 2 deg" in text_of(story)


def test_two_in_a_row_between_good_ones_are_none(story):
    for _ in range(20):
        refuse(story, N_CONSECUTIVE_WINDOWS - 1)
        story.see()
    assert not story.alarms


def test_it_ends_by_itself_after_as_many_good_ones_and_not_by_one(story):
    refuse(story, 5)
    story.see(n_windows=N_CONSECUTIVE_WINDOWS - 1)
    assert WINDOWS_REFUSED in story.alarms
    refuse(story)
    story.see(n_windows=N_CONSECUTIVE_WINDOWS - 1)
    assert WINDOWS_REFUSED in story.alarms, "every second window refused is no end of it"
    story.see()
    assert WINDOWS_REFUSED not in story.alarms


def test_a_window_far_from_alpha_could_be_used_and_has_an_alarm_of_its_own(story):
    refuse(story, N_CONSECUTIVE_WINDOWS - 1)
    story.see(moved(ALPHA, shift_x_subap=0.4))
    refuse(story, N_CONSECUTIVE_WINDOWS - 1)
    assert story.alarms == {"jump-suspected"}


@pytest.mark.parametrize(
    "event",
    [
        cmd.StopDither(),
        cmd.StopEverything(by="x", reason="y"),
        ev.RtcVanished(),
        ev.ConditionChanged(name="loop-diverging", text="found"),
        ev.SessionStarted(session="s2"),
        rtc(loop="open"),
    ],
    ids=lambda event: type(event).__name__,
)
def test_it_ends_where_no_window_is_expected_and_does_not_begin_there(story, event):
    refuse(story, 5)
    story.tell(event)
    story.tell(ev.Tick(), after_s=1.0)
    assert WINDOWS_REFUSED not in story.alarms
    refuse(story, 5)
    story.tell(ev.Tick(), after_s=1.0)
    assert WINDOWS_REFUSED not in story.alarms


def test_the_last_refusal_is_told_though_another_came_between_two_alike(story):
    refuse(story, reason="edge slip")
    refuse(story, reason="frames were lost")
    last = refuse(story, reason="edge slip").state.windows
    assert (last.refusal.text, last.refusal.times) == ("edge slip", 2)
    assert str(last.refused_because) == "edge slip"


def test_a_dither_of_a_minute_without_any_window_is_one_as_well(story):
    accepted = dither_answered(story.state.dithers.dither.id, accepted=True, reason="", start_seq=1)
    story.tell(accepted)
    for _ in range(58):
        story.tell(ev.Tick(), after_s=1.0)
    assert WINDOWS_REFUSED not in story.alarms
    for _ in range(4):
        story.tell(ev.Tick(), after_s=1.0)
    for _ in range(6):  # it does not waver, though windows had been used before
        story.tell(ev.Tick(), after_s=1.0)
        assert "no window was accepted for 60 s although a dither runs" in text_of(story)
    story.see(n_windows=N_CONSECUTIVE_WINDOWS)
    assert WINDOWS_REFUSED not in story.alarms


def test_in_slow_motion_a_dither_has_a_minute_of_its_own(story):
    """After 70 s by the clock the RTC has played half a second of it."""
    plays = story.state.dithers.dither
    story.tell(dither_answered(plays.id, accepted=True, reason="", start_seq=1))
    shown = DitherStatus(request=plays.request, start_seq=1)
    for k in range(70):
        story.tell(rtc(seq=1 + 7 * k, dither=shown), after_s=1.0)
    assert WINDOWS_REFUSED not in story.alarms
    story.tell(rtc(seq=60_000, dither=shown), after_s=1.0)
    assert "no window was accepted for 60 s" in text_of(story)
