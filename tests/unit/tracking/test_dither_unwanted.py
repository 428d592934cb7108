"""A dither the RTC plays although nobody wants one, or stronger than it may."""

from dataclasses import replace

import numpy as np
import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import NOT_AS_ASKED, NOT_STOPPED, OVER_BUDGET
from service.records.operations import AcquisitionStage, DitherPhase, MeasureState
from service.tracking.dither import (
    COST_AVERAGING_TIME_S,
    FAILED_DITHER_PAUSE_S,
    STOP_REQUEST_INTERVAL_S,
)
from service.tracking.dither_request import (
    MAX_STOP_DELAY_S,
    DitherParameters,
    check_dither_usable,
    plan_dither,
    total_m,
)
from service.wire import DitherRequest, DitherStop
from tests.support.situations import (
    POLICY,
    START_NS,
    Story,
    dither_answered,
    dither_request,
    foreign,
    of_kind,
    rtc,
    stopping,
)

START = 1000


def playing(story, dither, seconds=1, **changes):
    """Let the RTC's status show a dither once a second; return what is done about it."""
    effects = ()
    for _ in range(seconds):
        shown = replace(dither, start_seq=START)
        seq = START + round((story.now_ns - dither.asked_ns_utc) * 1e-6)
        status = rtc(dither=shown, seq=seq, **changes)
        effects += story.tell(status, after_s=1.0)
        effects += story.tell(ev.Tick())
    return effects


def silent(story, seconds=1):
    effects = ()
    for _ in range(seconds):
        effects += story.tell(rtc(), after_s=1.0)
    return effects


def named(dither, name):
    return replace(dither, request=replace(dither.request, id=name))


def accept(story, dither):
    return story.tell(
        dither_answered(dither.id, accepted=True, reason="", start_seq=START), after_s=0.3
    )


@pytest.fixture
def story():
    """The first window is in, and the RTC has been asked for a dither."""
    story = Story().meet()
    story.see()
    return story


class TestOffByTheOperator:
    def test_a_stop_that_fails_is_repeated_until_the_status_shows_none(self, story):
        dither = story.state.dithers.dither
        accept(story, dither)
        assert story.tell(cmd.StopDither()) == (stopping(story),)
        story.tell(ev.JobFailed(effect=stopping(story), text="no answer"))
        asked = of_kind(playing(story, dither, 20), DitherStop)
        assert len(asked) == pytest.approx(20 / STOP_REQUEST_INTERVAL_S, abs=1)
        assert NOT_STOPPED in story.alarms
        assert story.state.dithers.policy.phase is DitherPhase.OFF
        assert dither.id in story.state.dithers.policy.reason
        assert not silent(story, 60)
        assert NOT_STOPPED not in story.alarms
        assert story.state.dithers.policy.reason == "stopped by the operator"

    def test_a_start_that_overtakes_the_stop_is_stopped_too(self, story):
        dither = story.state.dithers.dither
        story.tell(cmd.StopDither())
        accept(story, dither)
        assert of_kind(playing(story, dither, 4), DitherStop)
        silent(story)
        assert not story.alarms

    def test_a_status_from_before_the_stop_is_no_alarm_and_nothing_is_asked_twice(self, story):
        dither = story.state.dithers.dither
        accept(story, dither)
        story.tell(cmd.StopDither())
        assert not playing(story, dither)
        silent(story)
        assert not story.alarms

    @pytest.mark.parametrize("name", ["operator-1", "noisy-1", "acquire-1"])
    def test_whatever_of_the_services_it_is(self, story, name):
        dither = named(story.state.dithers.dither, name)
        story.tell(cmd.StopDither())
        assert of_kind(playing(story, dither, 4), DitherStop)

    def test_somebody_elses_is_left_alone_and_told_as_it_is(self, story):
        dither = named(story.state.dithers.dither, "engineer-1")
        story.tell(cmd.StopDither())
        assert not playing(story, dither, 10)
        assert not story.alarms

    def test_what_it_costs_is_what_the_rtc_plays(self, story):
        dither = story.state.dithers.dither
        accept(story, dither)
        story.tell(cmd.StopDither())
        playing(story, dither, round(COST_AVERAGING_TIME_S))
        share = -np.expm1(-1.0)  # of the mean square, after one averaging time from zero
        expected = pytest.approx(total_m(dither.request) * np.sqrt(share), rel=0.01)
        assert story.state.dithers.policy.mean_cost_m == expected

    @pytest.mark.parametrize("alarm", ["loop-diverging", "edge-slip"])
    def test_a_loop_out_of_hand_keeps_none_on_the_mirror(self, story, alarm):
        dither = story.state.dithers.dither
        accept(story, dither)
        story.tell(cmd.StopDither())
        story.tell(ev.ConditionChanged(name=alarm, text="x"))
        assert of_kind(playing(story, dither, 4), DitherStop)

    def test_nobody_knows_whose_it_is_while_two_rtcs_send(self, story):
        dither = story.state.dithers.dither
        story.tell(cmd.StopDither())
        story.tell(ev.ConditionChanged(name="second-rtc", text="x"))
        assert not playing(story, dither, 4)

    def test_the_alarm_ends_with_the_rtc(self, story):
        dither = story.state.dithers.dither
        story.tell(cmd.StopDither())
        playing(story, dither, 10)
        assert NOT_STOPPED in story.alarms
        story.tell(ev.RtcVanished())
        assert NOT_STOPPED not in story.alarms

    def test_an_rtc_that_does_not_answer_keeps_no_matrix_waiting(self, story):
        before = story.state.dithers.no_dither_before_ns_utc
        story.tell(ev.JobFailed(effect=stopping(story), text="no answer"))
        assert story.state.dithers.no_dither_before_ns_utc == before

    def test_the_operator_may_have_it_again(self, story):
        dither = story.state.dithers.dither
        accept(story, dither)
        story.tell(cmd.StopDither())
        playing(story, dither, round(MAX_STOP_DELAY_S) + 2)
        story.tell(cmd.StartDither())
        assert not of_kind(playing(story, dither, 10), DitherStop)
        assert NOT_STOPPED not in story.alarms


def louder(dither, by=10.0):
    amplitude_m = tuple(by * a for a in dither.request.amplitude_m)
    return replace(dither, request=replace(dither.request, amplitude_m=amplitude_m))


class TestTooStrong:
    @pytest.fixture
    def loud(self, story):
        """80 nm where 8 nm were asked for."""
        dither = story.state.dithers.dither
        accept(story, dither)
        return louder(dither)

    def test_it_is_stopped_at_once_with_an_alarm_that_tells_how_strong_it_was(self, story, loud):
        assert playing(story, loud) == (stopping(story),)
        assert story.state.dithers.dither is None
        text = next(a.text for a in story.state.alarms.active if a.name == OVER_BUDGET)
        assert "a dither of 80 nm RMS in all, more than the budget of 8 nm" in text
        assert "dither.other" in story.logged

    def test_another_is_tried_after_a_minute_and_ends_the_alarm_if_it_is_as_it_may_be(
        self, story, loud
    ):
        playing(story, loud)
        assert not of_kind(silent(story, round(FAILED_DITHER_PAUSE_S) - 2), DitherRequest)
        assert OVER_BUDGET in story.alarms
        assert of_kind(silent(story, 4), DitherRequest)
        accept(story, story.state.dithers.dither)
        assert OVER_BUDGET in story.alarms
        playing(story, story.state.dithers.dither)
        assert OVER_BUDGET not in story.alarms

    def test_an_rtc_that_does_so_always_does_it_for_a_second_a_minute(self, story, loud):
        on, n_tried, lived_s = loud, 0, 0
        for _ in range(600):
            lived_s += on is not None
            for effect in playing(story, on) if on is not None else silent(story):
                match effect:
                    case ev.Ask(request=DitherRequest()):
                        dither = story.state.dithers.dither
                        accept(story, dither)
                        on, n_tried = louder(dither), n_tried + 1
                    case ev.Ask(request=DitherStop()):
                        on = None
        assert n_tried == pytest.approx(600 / FAILED_DITHER_PAUSE_S, abs=1)
        assert lived_s <= n_tried + 1
        assert OVER_BUDGET in story.alarms

    def test_one_that_does_not_stop_is_asked_again_and_again_and_read_all_the_same(
        self, story, loud
    ):
        asked = of_kind(playing(story, loud, 20), DitherStop)
        assert len(asked) == pytest.approx(20 / STOP_REQUEST_INTERVAL_S, abs=1)
        assert {OVER_BUDGET, NOT_STOPPED} <= story.alarms
        assert story.state.dithers.dither.id == loud.id
        silent(story)
        assert NOT_STOPPED not in story.alarms
        assert "dither-lost" not in story.alarms

    def test_rounding_is_no_excess(self, story, loud):
        assert not playing(story, louder(loud, 0.1 * 1.0005), 3)
        assert not story.alarms
        assert story.state.dithers.dither is not None

    def test_within_the_budget_the_rtcs_word_counts(self, story):
        story.see(n_windows=12)
        weak = louder(story.state.dithers.dither, 0.5)
        accept(story, weak)
        assert not playing(story, weak, 3)
        assert not story.alarms

    @pytest.mark.parametrize(("by", "stopped"), [(1.0, False), (1.0005, False), (4.0, True)])
    def test_an_operators_may_exceed_the_budget_but_not_what_was_asked_for(
        self, story, by, stopped
    ):
        story.tell(cmd.StopDither())
        story.tell(cmd.StartDither(amplitude_m=10e-9, over_budget=True))
        dither = story.state.dithers.dither
        accept(story, dither)
        effects = playing(story, louder(dither, by), 3)
        assert bool(of_kind(effects, DitherStop)) is stopped
        assert (OVER_BUDGET in story.alarms) is stopped

    def test_an_operator_who_wants_none_has_no_alarm(self, story, loud):
        playing(story, loud)
        story.tell(cmd.StopDither())
        silent(story, 2)
        assert not story.alarms


def test_settings_that_forbid_it_do_not_tolerate_what_an_earlier_service_has_left():
    dither = Story().meet().state.dithers.dither
    story = Story(policy=replace(POLICY, dither_enabled=False)).meet()
    asked = of_kind(playing(story, dither, 20), DitherStop)
    assert len(asked) == pytest.approx(20 / STOP_REQUEST_INTERVAL_S, abs=1)


class TestByTheFrames:
    """The status says what was asked for; the frames hold something else."""

    @pytest.fixture
    def on(self, story):
        accept(story, story.state.dithers.dither)
        playing(story, story.state.dithers.dither)
        return story.state.dithers.dither

    def measured(self, story, dither, by, text="the frames hold much"):
        asked = total_m(dither.request)
        return story.tell(
            ev.DitherMeasured(id=dither.id, found_m=by * asked, asked_m=asked, text=text)
        )

    def test_too_strong_it_is_stopped_at_once_and_named(self, story, on):
        assert of_kind(self.measured(story, on, 20.0), DitherStop)
        assert story.state.dithers.dither is None
        (alarm,) = [a for a in story.state.alarms.active if a.name == OVER_BUDGET]
        assert "the frames hold much; the budget is 8 nm" in alarm.text

    def test_a_status_that_goes_on_saying_all_is_well_ends_no_alarm(self, story, on):
        self.measured(story, on, 20.0)
        assert of_kind(silent(story, round(FAILED_DITHER_PAUSE_S) + 3), DitherRequest)
        accept(story, story.state.dithers.dither)
        playing(story, story.state.dithers.dither, 2)
        assert OVER_BUDGET in story.alarms
        self.measured(story, story.state.dithers.dither, 1.0, text="")
        assert OVER_BUDGET not in story.alarms

    def test_one_that_is_not_stopped_is_told_again_and_again(self, story, on):
        self.measured(story, on, 20.0)
        asked = of_kind(playing(story, on, 20), DitherStop)
        assert len(asked) == pytest.approx(20 / STOP_REQUEST_INTERVAL_S, abs=1)
        assert {OVER_BUDGET, NOT_STOPPED} <= story.alarms

    def test_otherwise_than_asked_but_within_the_budget_it_is_named_and_goes_on(self, story, on):
        assert not self.measured(story, on, 0.1)
        assert story.state.dithers.dither is not None
        assert NOT_AS_ASKED in story.alarms
        self.measured(story, on, 1.0, text="")
        assert NOT_AS_ASKED not in story.alarms

    def test_what_an_operator_asked_for_may_cost_more_than_the_budget(self, story):
        story.tell(cmd.StopDither())
        story.tell(rtc(), after_s=1.0)
        meant = cmd.StartDither(
            modes=(501,), frequency_hz=(250.0,), amplitude_m=15e-9, over_budget=True
        )
        story.tell(meant)
        dither = story.state.dithers.dither
        accept(story, dither)
        playing(story, dither)
        assert not self.measured(story, dither, 1.05)
        assert of_kind(self.measured(story, dither, 2.0), DitherStop)

    def test_an_acquisition_ends_and_says_why(self):
        story = Story(policy=replace(POLICY, acquires=True)).meet()
        story.tell(cmd.Acquire())
        story.tell(ev.SessionStarted(session="s2"))
        view = rtc(session="s2", loop="open", gains=(0.0,) * 594)
        story.tell(view)
        dither = story.state.dithers.dither
        accept(story, dither)
        self.measured(story, dither, 5.0)
        assert story.state.operations.acquisition.stage is AcquisitionStage.FAILED

    def test_a_noisy_matrix_ends_and_says_why(self, story):
        story.tell(cmd.StopDither())
        story.tell(rtc(), after_s=1.0)
        story.tell(cmd.MeasureNoisy(id="noisy-1"))
        dither = story.state.dithers.dither
        accept(story, dither)
        playing(story, dither)
        self.measured(story, dither, 5.0)
        (noisy,) = story.state.noisy
        assert noisy.state is MeasureState.FAILED


# --- a dither that runs already when the service meets the RTC: after a restart, or in a replay


CHOICE = DitherParameters(total_m=8e-9, window_s=2.0, n_windows=59)
RUNNING = replace(plan_dither(rtc(), POLICY, START_NS, choice=CHOICE), start_seq=4000)


def with_dither(dither=RUNNING, **changes):
    return {"dither": dither} | changes


def other(**changes):
    """The dither that runs, with something of its request otherwise."""
    return replace(RUNNING, request=replace(RUNNING.request, **changes))


def test_a_running_dither_is_adopted_with_its_first_frame_and_none_is_asked_for():
    story = Story().meet(**with_dither())
    assert story.state.dithers.dither == replace(
        RUNNING, asked_ns_utc=story.state.dithers.dither.asked_ns_utc
    )
    assert story.state.dithers.dither.asked_ns_utc >= START_NS
    assert not story.asked(DitherRequest)
    assert not story.asked(DitherStop)
    assert "dither.adopted" in story.logged


def test_another_is_asked_for_when_the_adopted_one_has_ended():
    story = Story().meet(**with_dither())
    story.tell(rtc(), after_s=3)
    assert story.asked(DitherRequest)


def test_a_refusal_because_one_runs_is_no_alarm_once_it_is_adopted():
    story = Story().meet()
    (asked,) = story.asked(DitherRequest)
    story.tell(dither_answered(asked.id, accepted=False, reason="busy", start_seq=None))
    assert "dither" in story.alarms
    story.tell(rtc(**with_dither()))
    assert story.state.dithers.dither.id == RUNNING.id
    assert "dither" not in story.alarms


def test_an_operator_who_stopped_the_dither_is_obeyed():
    story = Story().meet(**with_dither())
    story.tell(cmd.StopDither())
    story.tell(rtc(**with_dither()))
    assert story.state.dithers.dither is None


def test_lines_that_do_not_fit_a_window_are_not_adopted_and_the_services_own_is_stopped():
    odd = other(frequency_hz=(211.317, 239.0, 283.0, 331.0))
    story = Story().meet(**with_dither(odd))
    assert story.state.dithers.dither is None
    assert story.asked(DitherStop)


def test_one_over_budget_from_before_a_restart_is_stopped_and_read_only_where_it_will_not_stop():
    loud = other(amplitude_m=(20e-9,) * 4)
    story = Story()
    story.tell(ev.SessionStarted(session="s1"))
    assert story.tell(rtc(**with_dither(loud))) == (
        ev.FetchMatrix(id="initial"),
        stopping(story),
    )
    assert OVER_BUDGET in story.alarms
    story.tell(ev.MatrixFetched(record=foreign()))
    assert story.state.dithers.dither is None
    story.tell(rtc(**with_dither(loud)), after_s=1)
    assert story.state.dithers.dither is None
    story.tell(rtc(**with_dither(loud)), after_s=5)
    assert story.state.dithers.dither.id == loud.id


def test_only_a_sine_can_be_demodulated():
    random = replace(RUNNING, request=dither_request("d-1"))
    assert check_dither_usable(random, rtc(), POLICY) == "d-1 is binary, not a sine"
    assert check_dither_usable(RUNNING, rtc(), POLICY) is None
