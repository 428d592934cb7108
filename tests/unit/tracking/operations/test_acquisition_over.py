"""An acquisition that is over, and when the next one may begin by itself."""

import pytest

from service.estimation.windows import RefusalKind
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.operation_records import AcquisitionStage
from service.tracking.operations.acquisition import MIN_FINAL_WINDOWS, MISSES_WHILE_TRACKING
from service.tracking.products import MatrixState
from service.tracking.state import Mode
from service.wire import Loop, LoopRequest
from tests.unit.tracking.operations.test_acquisition import CALM, DIVERGING, FAR, Acquiring
from tests.unit.tracking.operations.test_acquisition_restart import Again
from tests.unit.tracking.situations import foreign, moved

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
