"""An acquisition that is over, and when the next one may begin by itself."""

import pytest

from service import events as ev
from service.reactions.acquisition_closed import ENOUGH_WINDOWS
from service.reactions.acquisition_plan import MISSES_DESPITE
from service.state import AcquisitionStage, MatrixState
from tests.unit.reactions.situations import foreign, moved
from tests.unit.reactions.test_acquisition import CALM, DIVERGING, Acquiring
from tests.unit.reactions.test_acquisition_restart import Again

SLIPPED = ev.Trouble(name="edge-slip", text="found")


class Failed(Acquiring):
    """No number of modes passed the gate; the loop was left open."""

    def __init__(self):
        super().__init__()
        self.to_partial()
        self.make("cm-150", MatrixState.REFUSED, n_modes=150)
        assert self.stage is AcquisitionStage.FAILED

    def close_on_their_own(self):
        """The operator closes the loop as the alarm says, on a matrix of nobody here."""
        self.tell(ev.SetLoop(closed=True))
        self.status(cm_id="own")
        self.tell(ev.MatrixFetched(record=foreign("own")))
        return self


def test_a_failure_is_over_when_windows_agree_in_a_loop_somebody_has_closed():
    story = Failed().close_on_their_own()
    story.see(n_windows=ENOUGH_WINDOWS - 1)
    assert story.stage is AcquisitionStage.FAILED
    assert "acquisition" in story.alarms
    story.see()
    assert story.stage is AcquisitionStage.IDLE
    assert "acquisition" not in story.alarms
    assert "acquisition.idle" in story.logged
    assert "windows agree" in story.text


def test_the_next_trouble_is_met_as_the_first_was():
    story = Failed().close_on_their_own()
    story.see(n_windows=3)
    story.tell(SLIPPED)
    story.wait(4)
    assert story.stage is AcquisitionStage.OPENING
    assert story.state.acquisition.attempt == 1
    assert story.asked(ev.AskLoop)[-1].closed is False


def test_but_nothing_is_over_while_the_loop_does_not_hold():
    story = Failed().close_on_their_own()
    story.tell(DIVERGING)
    story.see(n_windows=5)
    assert story.stage is AcquisitionStage.FAILED
    story.tell(CALM)
    assert story.stage is AcquisitionStage.FAILED
    story.see(n_windows=ENOUGH_WINDOWS)
    assert story.stage is AcquisitionStage.IDLE


def test_windows_that_contradict_one_another_are_not_enough():
    story = Failed().close_on_their_own()
    story.see()
    story.see(moved(shift_x_subap=0.4))
    assert story.state.registration.candidate is not None
    assert story.stage is AcquisitionStage.FAILED


def test_windows_that_find_nothing_leave_a_failure_as_it_is():
    story = Failed().close_on_their_own()
    for _ in range(2 * MISSES_DESPITE):
        story.miss_afar("the fit did not settle: it is far away")
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
    again.see(n_windows=ENOUGH_WINDOWS)
    assert again.stage is AcquisitionStage.IDLE
    assert "acquisition" not in again.alarms
