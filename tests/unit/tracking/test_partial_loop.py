"""A loop some of whose gains an operator has set to 0: closed on the other modes."""

from dataclasses import replace

import pytest

from service.estimation.loop import extend_gains
from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import MeasureState
from service.records.registration import Validity
from service.records.state import Mode
from service.tracking.update_policy import more_modes_to_try
from service.wire import LoopRequest
from tests.support.dithered import DitheredNight
from tests.support.situations import ALPHA, N_MODES, POLICY, Story, moved, of_kind, rtc

ONE_STILL = (0.0, *(0.4,) * 399, *(0.0,) * (N_MODES - 400))
NONE = (0.0,) * N_MODES


def partial(gains=ONE_STILL, **changes):
    return rtc(loop="partial", gains=gains, **changes)


def test_the_modes_in_the_loop_are_the_controlled_ones_with_a_gain():
    assert rtc(400).in_loop == tuple(range(400))
    assert partial().in_loop == tuple(range(1, 400))
    assert partial(NONE).in_loop == ()
    assert rtc(400, loop="open").in_loop == ()


def test_alpha_is_dithered_for_and_followed_as_in_any_closed_loop():
    night = DitheredNight(POLICY, gains=ONE_STILL, loop="partial")
    night.live(200)
    assert night.share_on > 0.9
    assert night.state.alpha.registration.validity.level is Validity.FRESH
    assert not night.alarms


def test_another_matrix_is_made_and_sent_when_the_mirror_has_moved():
    story = Story(Mode.AUTO).meet(loop="partial", gains=ONE_STILL)
    story.see(n_windows=4)
    story.use("cm-1")
    story.tell(partial(cm_id="cm-1"))
    story.see(moved(ALPHA, shift_x_subap=0.1), n_windows=4)
    assert story.asked(ev.MakeMatrix)


def test_it_is_logged_once_how_many_modes_are_in_the_loop():
    story = Story().meet()
    for _ in range(3):
        story.tell(partial(), after_s=1.0)
    said = [entry.text for entry in story.state.log if entry.name == "loop.partial"]
    assert said == ["399 of 400 controlled modes have a gain: the others are let be"]
    assert "loop-open" not in story.alarms


def test_a_loop_without_any_gain_is_an_open_one_and_says_why():
    story = Story().meet()
    story.tell(partial(NONE))
    (alarm,) = [alarm for alarm in story.state.alarms.active if alarm.name == "loop-open"]
    assert alarm.text == "all gains of the loop are 0: close it to calibrate"
    story.tell(partial())
    assert "loop-open" not in story.alarms


@pytest.mark.parametrize("last_gain", [0.0, 0.4])
def test_modes_above_those_that_were_taken_out_are_not_tried(last_gain):
    """They would get the gain of the last, and not be in the loop."""
    gains = (*(0.4,) * 399, last_gain, *(0.0,) * (N_MODES - 400))
    story = Story(Mode.AUTO).meet()
    view = partial(gains)
    assert extend_gains(view, 500)[450] == last_gain
    assert bool(more_modes_to_try(story.state, view, POLICY, story.now_ns)) is bool(last_gain)


def test_a_measurement_that_found_it_partial_is_over_when_it_is_partial_again():
    story = Story().meet(loop="partial", gains=ONE_STILL)
    story.tell(cmd.StopDither())
    story.tell(cmd.Measure(id="im-1", pattern="hadamard"))
    asked = story.state.measuring
    record = replace(asked, state=MeasureState.RUNNING, start_seq=10)
    story.tell(ev.MatrixMeasured(record=record))
    story.tell(partial())
    story.wait(20)
    assert story.state.measuring is None
    assert not of_kind(story.effects, LoopRequest)
