from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import MeasureState
from service.records.products import MatrixState
from service.records.state import Mode
from service.tracking.operations.measurement import MAX_MATRIX_DELAY_S, MAX_MEASUREMENT_S
from service.wire import DitherRequest, MeasureRequest, Pattern
from tests.support.situations import Story, of_kind, rtc
from tests.support.states import changed


@pytest.fixture
def story():
    """The dither stopped, α known, nothing under way."""
    story = Story(Mode.HOLD).meet()
    story.see(n_windows=2)
    story.tell(cmd.StopDither())
    return story


def ask(story, **changes):
    command = cmd.Measure(id="im-1", pattern=Pattern.PUSH_PULL_MODAL)
    return story.tell(replace(command, **changes))


def answer(story, state=MeasureState.RUNNING, **changes):
    record = replace(story.state.measurement("im-1"), state=state, **changes)
    return story.tell(ev.MatrixMeasured(record=record))


def begin(story, **changes):
    ask(story, **changes)
    answer(story, start_seq=40)
    story.tell(ev.SessionStarted(session="s2"))
    story.tell(rtc(session="s2", loop="open"))
    return story


def close(story):
    story.tell(rtc(session="s2"))


def test_what_is_not_given_the_service_chooses_and_the_operators_choice_stands(story):
    given = {"modes": (3, 9), "amplitude_m": 1e-8, "n_average": 3}
    (asked,) = of_kind(ask(copy(story), **given), MeasureRequest)
    assert (asked.modes, asked.n_average, asked.amplitude_m) == ((3, 9), 3, (1e-8, 1e-8))
    (asked,) = of_kind(ask(story), MeasureRequest)
    assert asked.modes == tuple(range(400))
    assert asked.amplitude_m == (20e-9,) * 400
    assert asked.n_average == 10
    assert asked.frequency_hz is asked.duration_s is None
    assert story.state.measuring.state is MeasureState.ASKED


def test_sines_get_lines_of_their_own_between_the_loop_and_half_the_rate(story):
    (asked,) = of_kind(ask(story, pattern=Pattern.SINE), MeasureRequest)
    record = asked
    assert record.modes == tuple(range(0, 400, 10))
    assert record.n_average is None
    lines = np.array(record.frequency_hz)
    assert lines.min() >= 50.0
    assert lines.max() <= 450.0
    assert np.diff(lines).min() * record.duration_s > 4
    np.testing.assert_allclose(lines * record.duration_s, np.round(lines * record.duration_s))


def test_a_mode_can_be_chosen_and_a_dither_stopped_meanwhile(story):
    begin(story)
    story.tell(cmd.SetMode(mode=Mode.AUTO))
    story.tell(cmd.StopDither())
    assert story.state.measuring is not None


@pytest.mark.parametrize("pattern", list(Pattern))
def test_the_service_does_nothing_by_itself_meanwhile(story, pattern):
    begin(story, pattern=pattern)
    story.tell(cmd.SetMode(mode=Mode.AUTO))
    story.state = changed(story.state, stopped=False)
    close(story)
    assert story.wait(10) == ()


def test_windows_meanwhile_are_refused_with_the_reason(story):
    ask(story)
    accepted = story.state.windows.accepted
    story.see()
    assert story.state.windows.accepted == accepted


def test_a_stored_matrix_ends_it_and_keeps_how_it_was_asked_for(story):
    begin(story)
    asked_ns = story.state.measuring.asked_ns_utc
    answer(story, MeasureState.STORED, n_slopes=1384, asked_ns_utc=None, start_seq=None)
    record = story.state.measurement("im-1")
    assert story.state.measuring is None
    assert (record.state, record.asked_ns_utc, record.start_seq) == ("stored", asked_ns, 40)
    assert story.logged[-2:] == ["measurement.stored", "reconstructor.adopted"]


def test_a_refusal_ends_it_with_the_rtcs_words(story):
    ask(story)
    answer(story, MeasureState.REFUSED, reason="busy: dither other is on")
    assert story.state.measuring is None
    assert "busy: dither other is on" in story.state.log[-1].text


def test_a_late_answer_does_not_begin_again_what_is_over(story):
    begin(story)
    running = story.state.measurement("im-1")
    answer(story, MeasureState.STORED)
    story.tell(ev.MatrixMeasured(record=running))
    assert story.state.measuring is None


def test_a_silent_rtc_leaves_no_measurement_behind(story):
    (asked,) = of_kind(ask(story), MeasureRequest)
    story.tell(ev.JobFailed(effect=ev.Ask(request=asked), text="no answer from the RTC"))
    assert story.state.measurement("im-1").state is MeasureState.FAILED
    assert story.state.measurement("im-1").reason == "no answer from the RTC"
    ask(story, id="im-2")


def test_an_rtc_that_vanishes_takes_the_measurement_with_it(story):
    begin(story)
    story.tell(ev.RtcVanished())
    assert story.state.measurement("im-1").reason == "the RTC vanished"
    assert story.state.loop.rtc is None


def test_a_matrix_that_does_not_come_after_the_loop_has_closed_is_given_up(story):
    begin(story)
    story.wait(60)
    assert story.state.measuring is not None, "the loop is open: it may take long"
    close(story)
    story.wait(MAX_MATRIX_DELAY_S - 1)
    assert story.state.measuring is not None
    story.wait(3)


def test_nothing_is_measured_for_ever(story):
    begin(story, pattern=Pattern.SINE, duration_s=5.0)
    story.wait(MAX_MEASUREMENT_S + 60, every_s=60)
    assert story.state.measurement("im-1").state is MeasureState.FAILED


def test_a_matrix_nobody_here_asked_for_is_taken_in(story):
    begin(story)
    stranger = replace(story.state.measurement("im-1"), id="im-x", state=MeasureState.STORED)
    story.tell(ev.MatrixMeasured(record=stranger))
    assert story.state.measurement("im-x").state is MeasureState.STORED
    assert story.state.measuring.id == "im-1"


def test_reconstructors_are_left_as_they_are(story):
    story.make("cm-1")
    begin(story)
    answer(story, MeasureState.STORED)
    assert story.matrix_state("cm-1") is MatrixState.PROPOSED


def test_an_open_loop_is_no_alarm_while_the_service_has_asked_for_it(story):
    begin(story)
    assert "loop-open" not in story.alarms
    answer(story, MeasureState.STORED)
    story.tell(rtc(session="s2", loop="open"))
    assert "loop-open" in story.alarms, "the measurement is over"


def test_a_loop_that_opens_under_a_measurement_with_sines_is_an_alarm(story):
    begin(story, pattern=Pattern.SINE)
    assert "loop-open" in story.alarms


def test_what_is_given_up_is_over_whatever_comes(story):
    begin(story)
    late, (request,) = story.state.measurement("im-1"), story.asked(MeasureRequest)
    lost = ev.Ask(request=request)
    story.tell(cmd.GiveUp(id="im-1"))
    assert story.state.measuring is None
    for state in (MeasureState.RUNNING, MeasureState.STORED, MeasureState.FAILED):
        story.tell(ev.MatrixMeasured(record=replace(late, state=state)))
        assert story.state.measurement("im-1").state is MeasureState.GIVEN_UP
    story.tell(ev.JobFailed(effect=lost, text="no answer"))
    assert story.state.measurement("im-1").state is MeasureState.GIVEN_UP


def test_nothing_is_asked_while_tones_given_up_still_play(story):
    begin(story, pattern=Pattern.SINE, duration_s=30.0)
    close(story)
    story.tell(cmd.GiveUp(id="im-1"))
    story.tell(cmd.SetMode(mode=Mode.AUTO))
    story.state = changed(story.state, stopped=False, in_use="initial")
    assert not of_kind(story.wait(20), DitherRequest)
    assert of_kind(story.wait(15), DitherRequest)
