"""A dither the RTC plays although nobody wants one."""

from dataclasses import replace

import pytest

from service import events as ev
from service.reactions.dither_choice import total_m
from service.reactions.dither_unwanted import GONE_WITHIN_S, NOT_STOPPED, TELL_EVERY_S
from service.state import DitherPhase
from tests.unit.reactions.situations import POLICY, Story, of_kind, rtc

START = 1000


def playing(story, dither, seconds=1, **changes):
    """Let the RTC's status show a dither once a second; return what is done about it."""
    effects = ()
    for _ in range(seconds):
        shown = replace(dither, start_seq=START, asked_ns_utc=0, window_s=None)
        seq = START + round((story.now_ns - dither.asked_ns_utc) * 1e-6)
        status = rtc(dither_id=dither.id, dither=shown, seq=seq, **changes)
        effects += story.tell(ev.StatusSeen(rtc=status), after_s=1.0)
        effects += story.tell(ev.Tick())
    return effects


def silent(story, seconds=1):
    effects = ()
    for _ in range(seconds):
        effects += story.tell(ev.StatusSeen(rtc=rtc()), after_s=1.0)
    return effects


def accept(story, dither):
    return story.tell(
        ev.DitherAnswered(id=dither.id, accepted=True, reason="", start_seq=START), after_s=0.3
    )


@pytest.fixture
def story():
    """The first window is in, and the RTC has been asked for a dither."""
    story = Story().meet()
    story.see()
    return story


class TestOffByTheOperator:
    def test_a_stop_that_fails_is_repeated_until_the_status_shows_none(self, story):
        dither = story.state.dither
        accept(story, dither)
        assert of_kind(story.tell(ev.StopDither()), ev.AskNoDither) == [ev.AskNoDither()]
        story.tell(ev.JobFailed(effect=ev.AskNoDither(), text="no answer"))
        asked = of_kind(playing(story, dither, 20), ev.AskNoDither)
        assert len(asked) == pytest.approx(20 / TELL_EVERY_S, abs=1)
        assert NOT_STOPPED in story.alarms
        assert story.state.dithering.phase is DitherPhase.OFF
        assert dither.id in story.state.dithering.reason
        assert not silent(story, 60)
        assert NOT_STOPPED not in story.alarms
        assert story.state.dithering.reason == "stopped by the operator"

    def test_a_start_that_overtakes_the_stop_is_stopped_too(self, story):
        dither = story.state.dither
        story.tell(ev.StopDither())
        accept(story, dither)
        assert of_kind(playing(story, dither, 4), ev.AskNoDither)
        silent(story)
        assert not story.alarms

    def test_a_status_from_before_the_stop_is_no_alarm_and_nothing_is_asked_twice(self, story):
        dither = story.state.dither
        accept(story, dither)
        story.tell(ev.StopDither())
        assert not playing(story, dither)
        silent(story)
        assert not story.alarms

    @pytest.mark.parametrize("name", ["operator-1", "noisy-1", "acquire-1"])
    def test_whatever_of_the_services_it_is(self, story, name):
        dither = replace(story.state.dither, id=name)
        story.tell(ev.StopDither())
        assert of_kind(playing(story, dither, 4), ev.AskNoDither)

    def test_somebody_elses_is_left_alone_and_told_as_it_is(self, story):
        dither = replace(story.state.dither, id="engineer-1")
        story.tell(ev.StopDither())
        assert not playing(story, dither, 10)
        assert not story.alarms

    def test_what_it_costs_is_what_the_rtc_plays(self, story):
        dither = story.state.dither
        accept(story, dither)
        story.tell(ev.StopDither())
        playing(story, dither, 3600)
        expected = pytest.approx(total_m(dither), rel=0.01)
        assert story.state.dithering.mean_cost_m == expected

    @pytest.mark.parametrize("alarm", ["loop-diverging", "edge-slip"])
    def test_a_loop_out_of_hand_keeps_none_on_the_mirror(self, story, alarm):
        dither = story.state.dither
        accept(story, dither)
        story.tell(ev.StopDither())
        story.tell(ev.Trouble(name=alarm, text="x"))
        assert of_kind(playing(story, dither, 4), ev.AskNoDither)

    def test_nobody_knows_whose_it_is_while_two_rtcs_send(self, story):
        dither = story.state.dither
        story.tell(ev.StopDither())
        story.tell(ev.Trouble(name="second-rtc", text="x"))
        assert not playing(story, dither, 4)

    def test_the_alarm_ends_with_the_rtc(self, story):
        dither = story.state.dither
        story.tell(ev.StopDither())
        playing(story, dither, 10)
        assert NOT_STOPPED in story.alarms
        story.tell(ev.RtcVanished())
        assert NOT_STOPPED not in story.alarms

    def test_an_rtc_that_does_not_answer_keeps_no_matrix_waiting(self, story):
        before = story.state.retry_ns_utc
        story.tell(ev.JobFailed(effect=ev.AskNoDither(), text="no answer"))
        assert story.state.retry_ns_utc == before

    def test_the_operator_may_have_it_again(self, story):
        dither = story.state.dither
        accept(story, dither)
        story.tell(ev.StopDither())
        playing(story, dither, round(GONE_WITHIN_S) + 2)
        story.tell(ev.StartDither())
        assert not of_kind(playing(story, dither, 10), ev.AskNoDither)
        assert NOT_STOPPED not in story.alarms


def test_settings_that_forbid_it_do_not_tolerate_what_an_earlier_service_has_left():
    dither = Story().meet().state.dither
    story = Story(policy=replace(POLICY, dither_enabled=False)).meet()
    asked = of_kind(playing(story, dither, 20), ev.AskNoDither)
    assert len(asked) == pytest.approx(20 / TELL_EVERY_S, abs=1)
    assert "the settings forbid" in next(a.text for a in story.state.alarms)
