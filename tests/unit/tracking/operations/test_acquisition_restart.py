"""A service that ends in the middle of an acquisition, and the one after it."""

from dataclasses import replace

import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.estimates import RefusalKind
from service.records.operations import AcquisitionStage
from service.records.products import MatrixState
from service.records.state import Mode
from service.tracking.operations.acquisition import (
    MAX_ATTEMPTS,
    MIN_FINAL_WINDOWS,
    MISSES_WHILE_TRACKING,
)
from service.tracking.resume import resumed, saved_of
from service.wire import DitherRequest, DitherStop, Loop, LoopRequest
from tests.support.acquiring import ACQUIRES, CALM, DIVERGING, FAR, Acquiring
from tests.support.situations import POLICY, SECOND, foreign, moved
from tests.support.states import tracker_state

N_MODES = 594
OPEN = {"loop": "open", "gains": (0.0,) * N_MODES, "cm_id": "initial"}


class Again(Acquiring):
    """What the service does that has only what the one of ``before`` has saved."""

    def __init__(self, before, mode=Mode.AUTO, policy=ACQUIRES, away_s=20.0):
        super().__init__(mode, policy)
        self.effects, self.session = [], before.session
        self.now_ns = before.now_ns + round(away_s * SECOND)
        fresh = tracker_state(system="flao", mode=mode)
        saved = saved_of(before.state, before.now_ns)
        self.state = fresh if saved is None else resumed(fresh, saved, policy, self.now_ns)

    def find(self, **changes):
        """The RTC is there, and like this."""
        seen = OPEN | {"session": f"s{self.session}"} | changes
        self.tell(ev.SessionStarted(session=seen["session"]), 0.1)
        self.status(**seen)
        if self.state.loop.rtc.cm_id == "initial":
            self.tell(ev.MatrixFetched(record=foreign()))
        return self

    @property
    def loop_orders(self):
        return [asked.loop is Loop.CLOSED for asked in self.asked(LoopRequest)]


@pytest.fixture
def opened():
    """A healthy loop was opened because an operator asked; the mirror is looked for."""
    story = Acquiring()
    story.see(n_windows=3)
    story.tell(cmd.Acquire())
    story.open()
    assert story.stage is AcquisitionStage.COARSE
    return story


def test_in_auto_it_begins_anew_with_the_loop_the_one_before_had_opened(opened):
    again = Again(opened)
    assert again.stage is AcquisitionStage.INTERRUPTED
    assert "acquisition" in again.alarms
    again.find()
    assert "acquisition" not in again.alarms
    again.still_open()
    assert again.stage is AcquisitionStage.COARSE
    assert again.loop_orders == []
    again.see_afar()
    again.see_afar()
    (made,) = again.asked(ev.MakeMatrix)
    assert made.gains == (0.4,) * 150 + (0.0,) * 444
    again.close(150)
    assert again.stage is AcquisitionStage.WIDENING
    again.see(FAR)
    assert again.asked(ev.MakeMatrix)[-1].n_modes == 400


def test_the_alpha_it_had_forgotten_is_not_believed_again(opened):
    assert opened.state.alpha.registration is None
    assert Again(opened).state.alpha.registration is None


@pytest.mark.parametrize("mode", [Mode.PROPOSE, Mode.HOLD])
def test_in_other_modes_it_waits_and_says_what_to_do(opened, mode):
    again = Again(opened, mode).find()
    again.wait(60)
    assert again.stage is AcquisitionStage.INTERRUPTED
    assert not again.asked(LoopRequest)
    assert not again.asked(DitherRequest)
    (alarm,) = [alarm for alarm in again.state.alarms.active if alarm.name == "acquisition"]
    assert f"the mode is {mode}" in alarm.text
    assert again.text == alarm.text
    assert "loop-open" not in again.alarms
    assert again.logged.count("acquisition.interrupted") == 2  # before the RTC was there, and since


def test_it_begins_when_the_operator_says_auto(opened):
    again = Again(opened, Mode.PROPOSE).find()
    again.tell(cmd.SetMode(mode=Mode.AUTO))
    again.still_open()
    assert again.stage is AcquisitionStage.COARSE
    assert "acquisition" not in again.alarms


def test_it_begins_when_the_operator_asks_and_comes_back_to_the_loop_as_it_was(opened):
    again = Again(opened, Mode.PROPOSE).find()
    again.tell(cmd.Acquire())
    assert again.stage is AcquisitionStage.COARSE
    found = again.state.operations.acquisition.found
    assert (found.closed, found.n_controlled, set(found.gains[:400])) == (True, 400, {0.4})


@pytest.mark.parametrize(
    "policy", [POLICY, replace(ACQUIRES, dither_enabled=False)], ids=["no auto", "no dither"]
)
def test_not_where_the_settings_forbid_it(opened, policy):
    again = Again(opened, policy=policy).find()
    again.wait(10)
    assert again.stage is AcquisitionStage.INTERRUPTED


def test_a_loop_that_is_open_in_another_session_is_not_touched(opened):
    """Somebody closed it and opened it again, or the RTC restarted: it may be open on purpose."""
    again = Again(opened).find(session="s9")
    again.wait(60)
    assert again.stage is AcquisitionStage.INTERRUPTED
    assert not again.asked(LoopRequest)
    assert not again.asked(DitherRequest)
    again.tell(cmd.Acquire())
    assert again.state.operations.acquisition.found.closed is False


def test_who_aborts_gets_a_healthy_loop_back_as_it_was(opened):
    again = Again(opened, Mode.PROPOSE).find()
    again.tell(cmd.AbortAcquisition())
    assert again.stage is AcquisitionStage.ABORTED
    (asked,) = again.asked(LoopRequest)
    assert (asked.loop, asked.leak) == (Loop.CLOSED, 0.999)
    assert "acquisition" not in again.alarms


def test_who_aborts_in_another_session_closes_nothing(opened):
    again = Again(opened, Mode.PROPOSE).find(session="s9")
    again.tell(cmd.AbortAcquisition())
    assert not again.asked(LoopRequest)


def test_who_aborts_after_a_matrix_was_sent_closes_nothing():
    """The RTC no longer has the matrix with which the loop held."""
    story = Acquiring().to_partial()
    story.make("cm-150", n_modes=150)
    again = Again(story, Mode.PROPOSE).find(cm_id="cm-150")
    again.tell(cmd.Acquire())
    again.tell(cmd.AbortAcquisition())
    assert not again.asked(LoopRequest)


def test_a_loop_that_diverged_is_not_given_back():
    story = Acquiring()
    story.tell(DIVERGING)
    story.wait(4)
    story.open()
    again = Again(story, Mode.PROPOSE).find()
    again.tell(cmd.AbortAcquisition())
    assert not again.asked(LoopRequest)


def test_a_loop_closed_on_the_matrix_that_was_judged_is_followed_from_there():
    story = Acquiring().to_widening()
    matrix = story.state.matrices.in_use
    again = Again(story)
    assert again.state.alpha.registration is not None
    again.find(loop="closed", gains=(0.4,) * 150 + (0.0,) * 444, n_controlled=150, cm_id=matrix)
    assert again.stage is AcquisitionStage.ABORTED
    assert f"closed on {matrix}, which had passed the gate" in again.text
    assert "acquisition" not in again.alarms
    assert not again.asked(LoopRequest)


def test_a_loop_the_operator_closes_meanwhile_is_the_operators(opened):
    again = Again(opened, Mode.PROPOSE).find()
    again.tell(cmd.SetLoop(loop="closed"))
    again.status()
    assert again.stage is AcquisitionStage.ABORTED
    assert "acquisition" not in again.alarms


def test_a_loop_that_had_not_been_opened_yet_is_left_closed():
    story = Acquiring()
    story.tell(cmd.Acquire())
    assert story.stage is AcquisitionStage.OPENING
    again = Again(story)
    again.find(loop="closed", gains=(0.4,) * 400 + (0.0,) * 194)
    assert again.stage is AcquisitionStage.ABORTED
    assert not again.asked(LoopRequest)


def test_it_is_not_begun_anew_for_ever(opened):
    for _ in range(MAX_ATTEMPTS - 1):
        opened = Again(opened).find()
        opened.still_open()
        assert opened.stage is AcquisitionStage.COARSE
    last = Again(opened).find()
    assert last.stage is AcquisitionStage.FAILED
    assert "acquisition" in last.alarms
    assert not last.asked(DitherRequest)


def test_a_service_that_only_waited_leaves_it_to_the_next(opened):
    waiting = Again(opened, Mode.PROPOSE)
    for away_s in (20.0, 30.0):
        waiting = Again(waiting, Mode.PROPOSE, away_s=away_s)
        assert "acquisition" in waiting.alarms
    again = Again(waiting).find()
    again.still_open()
    assert again.stage is AcquisitionStage.COARSE


def test_the_dither_left_behind_is_stopped_before_another_is_asked_for(opened):
    again = Again(opened, away_s=1.0).find(dither_id="acquire-1")
    assert again.asked(DitherStop)
    assert not again.asked(DitherRequest)
    again.still_open()
    assert again.asked(DitherRequest)


def test_one_that_had_failed_has_still_failed():
    story = Acquiring().to_partial()
    story.make("cm-150", MatrixState.REFUSED, n_modes=150)
    assert story.stage is AcquisitionStage.FAILED
    again = Again(story)
    assert again.stage is AcquisitionStage.FAILED
    assert "acquisition" in again.alarms
    again.find()
    again.tell(DIVERGING)
    again.wait(60)
    assert not again.asked(LoopRequest)


def test_one_that_was_aborted_leaves_no_alpha_behind(opened):
    opened.tell(cmd.AbortAcquisition())
    again = Again(opened)
    assert again.stage is AcquisitionStage.ABORTED
    assert again.state.alpha.registration is None
    assert "acquisition" not in again.alarms


def test_one_that_ended_tracking_is_not_spoken_of():
    story = Acquiring().to_widening()
    story.see(FAR)
    story.widen(400)
    story.see(FAR, n_windows=2)
    story.closed(400)
    assert story.stage is AcquisitionStage.TRACKING
    again = Again(story)
    assert again.stage is AcquisitionStage.IDLE
    assert again.state.alpha.registration is not None


class TestGap:
    """The RTC's token goes away for some seconds, and the same session comes back."""

    def test_in_auto_it_begins_anew_in_the_same_session(self, opened):
        opened.tell(ev.RtcVanished())
        assert opened.stage is AcquisitionStage.INTERRUPTED
        assert {"acquisition", "rtc-vanished"} <= opened.alarms
        assert "not restart by itself" not in opened.text
        opened.still_open()
        opened.still_open()
        assert opened.stage is AcquisitionStage.COARSE
        assert opened.state.operations.acquisition.attempt == 2
        assert not {"acquisition", "rtc-vanished", "loop-open"} & opened.alarms
        opened.see_afar()
        opened.see_afar()
        opened.close(150)
        assert opened.stage is AcquisitionStage.WIDENING

    def test_it_ends_in_the_same_state_as_after_a_restart_of_the_service(self, opened):
        again = Again(opened).find()
        again.still_open()
        opened.tell(ev.RtcVanished())
        opened.still_open()
        opened.still_open()
        one, other = again.state.operations.acquisition, opened.state.operations.acquisition
        assert (one.stage, one.attempt, one.found) == (other.stage, other.attempt, other.found)

    def test_a_link_that_fails_again_and_again_ends_it(self, opened):
        for _ in range(MAX_ATTEMPTS):
            assert opened.stage is AcquisitionStage.COARSE
            opened.tell(ev.RtcVanished())
            opened.still_open()
            opened.still_open()
        assert opened.stage is AcquisitionStage.FAILED
        assert "the RTC vanished, after 3 attempts" in opened.text

    def test_a_service_that_ends_in_the_gap_leaves_it_to_the_next(self, opened):
        opened.tell(ev.RtcVanished())
        again = Again(opened)
        again.find()
        again.still_open()
        assert again.stage is AcquisitionStage.COARSE


# --- an acquisition that is over, and when the next one may begin by itself


SLIPPED = ev.ConditionChanged(name="edge-slip", text="found")


class Failed(Acquiring):
    """No number of modes passed the gate; the loop was left open."""

    def __init__(self):
        super().__init__()
        self.to_partial()
        self.make("cm-150", MatrixState.REFUSED, n_modes=150)
        assert self.stage is AcquisitionStage.FAILED

    def close_on_their_own(self, **changes):
        """The operator closes the loop as the alarm says, on a matrix of nobody here."""
        self.tell(cmd.SetLoop(loop="closed"))
        self.status(cm_id="own", **changes)
        self.tell(ev.MatrixFetched(record=foreign("own")))
        return self


def test_a_failure_is_over_when_windows_agree_in_a_loop_somebody_has_closed():
    story = Failed().close_on_their_own()
    story.see(n_windows=MIN_FINAL_WINDOWS - 1)
    assert story.stage is AcquisitionStage.FAILED
    assert "acquisition" in story.alarms
    story.see()
    assert story.stage is AcquisitionStage.IDLE
    assert "acquisition" not in story.alarms
    assert "acquisition.idle" in story.logged


def test_a_loop_of_a_part_of_the_modes_will_do():
    gains = (0.0,) + (0.4,) * 399 + (0.0,) * 194
    story = Failed().close_on_their_own(loop="partial", gains=gains)
    story.see(n_windows=MIN_FINAL_WINDOWS)
    assert story.stage is AcquisitionStage.IDLE


def test_the_next_trouble_is_met_as_the_first_was():
    story = Failed().close_on_their_own()
    story.see(n_windows=3)
    story.tell(SLIPPED)
    story.wait(4)
    assert story.stage is AcquisitionStage.OPENING
    assert story.state.operations.acquisition.attempt == 1
    assert story.asked(LoopRequest)[-1].loop is Loop.OPEN


def test_but_nothing_is_over_while_the_loop_does_not_hold():
    story = Failed().close_on_their_own()
    story.tell(DIVERGING)
    story.see(n_windows=5)
    assert story.stage is AcquisitionStage.FAILED
    story.tell(CALM)
    assert story.stage is AcquisitionStage.FAILED
    story.see(n_windows=MIN_FINAL_WINDOWS)
    assert story.stage is AcquisitionStage.IDLE


def test_windows_that_contradict_one_another_are_not_enough():
    story = Failed().close_on_their_own()
    story.see()
    story.see(moved(shift_x_subap=0.4))
    assert story.state.alpha.registration.suspected_jump is not None
    assert story.stage is AcquisitionStage.FAILED


def test_windows_that_find_nothing_leave_a_failure_as_it_is():
    story = Failed().close_on_their_own()
    for _ in range(2 * MISSES_WHILE_TRACKING):
        story.miss_afar("it is far away", RefusalKind.OUT_OF_REACH)
    assert story.stage is AcquisitionStage.FAILED
    assert "acquisition" in story.alarms


@pytest.mark.parametrize("n_before", [0, 1])
def test_a_restarted_service_can_leave_it_too(n_before):
    story = Failed().close_on_their_own()
    story.see(n_windows=n_before)
    again = Again(story)
    assert again.stage is AcquisitionStage.FAILED
    again.find(loop="closed", gains=(0.4,) * 400 + (0.0,) * 194, cm_id="own")
    again.tell(ev.MatrixFetched(record=foreign("own")))
    again.see(n_windows=MIN_FINAL_WINDOWS)
    assert again.stage is AcquisitionStage.IDLE
    assert "acquisition" not in again.alarms


class Ended(Acquiring):
    """Begun by itself, and ended by the operator while the alarm that began it lasts."""

    def __init__(self, trouble=DIVERGING):
        super().__init__()
        self.tell(trouble)
        self.wait(4)
        assert self.stage is AcquisitionStage.OPENING
        self.tell(cmd.AbortAcquisition(), 1.0)

    @property
    def began(self):
        return self.logged.count("acquisition.begun")


@pytest.mark.parametrize("trouble", [DIVERGING, SLIPPED])
def test_what_an_operator_ended_does_not_begin_again_while_its_alarm_lasts(trouble):
    story = Ended(trouble)
    story.wait(600, every_s=10)
    assert story.stage is AcquisitionStage.ABORTED
    assert story.began == 1
    assert [asked.loop for asked in story.asked(LoopRequest)] == [Loop.OPEN]


def test_nor_when_the_alarm_goes_and_comes():
    story = Ended()
    for _ in range(3):
        story.tell(CALM)
        story.tell(DIVERGING, 1.0)
        story.wait(10)
    assert story.began == 1


def test_nor_when_windows_find_nothing():
    story = Ended()
    story.tell(CALM)
    for _ in range(MISSES_WHILE_TRACKING):
        story.miss_afar("it is far away", RefusalKind.OUT_OF_REACH)
    assert story.began == 1


def test_windows_that_agree_in_a_closed_loop_let_the_next_trouble_count():
    story = Ended()
    story.tell(CALM)
    story.see(n_windows=MIN_FINAL_WINDOWS)
    assert (story.stage, story.state.operations.acquisition.held_off) == (
        AcquisitionStage.IDLE,
        False,
    )
    story.tell(DIVERGING)
    story.wait(4)
    assert story.stage is AcquisitionStage.OPENING


def test_windows_from_before_it_was_ended_do_not_count():
    story = Acquiring().to_widening()
    story.see(FAR)
    story.widen(400)
    story.see(FAR)
    assert story.state.alpha.registration.n_windows >= MIN_FINAL_WINDOWS
    story.tell(cmd.AbortAcquisition())
    assert story.stage is AcquisitionStage.ABORTED
    story.tell(DIVERGING)
    story.wait(10)
    assert story.stage is AcquisitionStage.ABORTED


def test_setting_the_mode_anew_lets_it_begin():
    story = Ended()
    story.tell(cmd.SetMode(mode=Mode.AUTO))
    assert story.stage is AcquisitionStage.OPENING
    assert story.began == 2


def test_a_mode_that_is_set_while_everything_is_stopped_counts():
    story = Ended()
    story.tell(cmd.StopEverything())
    story.tell(cmd.SetMode(mode=Mode.AUTO))
    assert not story.state.operations.acquisition.held_off
    assert story.began == 1
    story.tell(cmd.Resume())
    assert story.stage is AcquisitionStage.OPENING


def test_so_does_an_operator_who_asks():
    story = Ended()
    story.tell(cmd.Acquire())
    assert story.stage is AcquisitionStage.OPENING
    assert not story.state.operations.acquisition.held_off


def test_a_restarted_service_does_not_begin_what_an_operator_ended():
    again = Again(Ended())
    again.find(loop="closed", gains=(0.4,) * 400 + (0.0,) * 194)
    again.tell(DIVERGING)
    again.wait(60)
    assert again.stage is AcquisitionStage.ABORTED
    assert not again.asked(LoopRequest)


def test_one_that_hold_ended_is_not_held_off():
    story = Acquiring()
    story.tell(DIVERGING)
    story.wait(4)
    story.tell(cmd.SetMode(mode=Mode.HOLD))
    assert (story.stage, story.state.operations.acquisition.held_off) == (
        AcquisitionStage.ABORTED,
        False,
    )
    assert "none begins" not in story.text
