from dataclasses import replace

import numpy as np
import pytest

from service.control.gains import gain_table
from service.errors import CommandError
from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import CommandState
from service.records.registration import ModeGain
from service.records.state import Mode
from service.tracking.operator import RECLOSING_INTERVAL_S
from service.wire import Loop, LoopRequest, Pattern, RampRequest
from tests.support.situations import (
    N_MODES,
    START_NS,
    Story,
    judged,
    loop_answered,
    of_kind,
    rtc,
    verdict,
)
from tests.support.states import changed


@pytest.fixture
def story():
    """A closed loop of 400 modes, nothing under way."""
    story = Story(Mode.HOLD).meet()
    story.tell(cmd.StopDither())
    return story


def group(first, last, gain):
    return cmd.GainGroup(first=first, last=last, gain=gain)


def ask(story, **changes):
    (asked,) = of_kind(story.tell(cmd.SetLoop(**changes)), LoopRequest)
    return asked


def test_opening_says_nothing_of_the_rest(story):
    asked = ask(story, loop="open")
    assert (asked.loop, asked.gains, asked.leak, asked.n_controlled) == (
        Loop.OPEN,
        None,
        None,
        None,
    )
    assert story.state.loop.command.state is CommandState.ASKED
    assert story.state.loop.command.text == "open"


def test_gains_go_to_their_groups_and_the_other_modes_keep_theirs(story):
    gains = ask(story, gains=(group(0, 1, 0.5), group(100, 399, 0.2))).gains
    assert gains == (0.5,) * 2 + (0.4,) * 98 + (0.2,) * 300 + (0.0,) * 194
    more = ask(story, gains=(group(400, 449, 0.1),), n_controlled=450)
    assert more.gains == (0.4,) * 400 + (0.1,) * 50 + (0.0,) * 144
    assert more.n_controlled == 450


def test_an_open_loop_does_not_tell_its_gains_so_all_must_be_named(story):
    story.tell(rtc(loop="open", gains=(0.0,) * 594))
    with pytest.raises(CommandError, match="found gains for 2 modes; expected all 400"):
        ask(story, gains=(group(0, 1, 0.5),))
    asked = ask(story, loop="closed", gains=(group(0, 1, 0.5), group(2, 399, 0.3)))
    assert asked.gains == (0.5,) * 2 + (0.3,) * 398 + (0.0,) * 194


def test_the_rtcs_answer_is_kept_with_the_command(story):
    asked = ask(story, leak=0.99)
    story.tell(loop_answered(asked.id, accepted=False, reason="range: leak 0.99"))
    last = story.state.loop.command
    assert (last.state, last.reason) == (CommandState.REFUSED, "range: leak 0.99")
    assert story.logged[-1] == "loop.refused"


def test_no_answer_is_told_as_not_known(story):
    asked = ask(story, leak=0.99)
    story.tell(ev.JobFailed(effect=ev.Ask(request=asked), text="no answer from the RTC"))
    assert story.state.loop.command.state is CommandState.FAILED


def test_a_late_answer_does_not_settle_a_later_command(story):
    first = ask(story, leak=0.99)
    story.now_ns += 1
    ask(story, leak=0.98)
    story.tell(loop_answered(first.id, accepted=True, reason=""))
    assert story.state.loop.command.state is CommandState.ASKED


def test_other_gains_have_another_margin():
    story = Story(Mode.HOLD).meet()
    story.see(n_windows=2)
    story.wait(3)
    before = len(story.asked(ev.JudgeMatrix))
    asked = ask(story, gains=(group(0, 1, 0.5),))
    story.tell(loop_answered(asked.id, accepted=True, reason=""))
    assert len(story.asked(ev.JudgeMatrix)) == before
    gains = (0.5, 0.5, *rtc().gains[2:])
    story.tell(replace(rtc(), gains=gains, cm_id="initial"))
    assert len(story.asked(ev.JudgeMatrix)) == before + 1


def test_a_verdict_on_the_gains_before_is_dropped_and_asked_for_again():
    story = Story(Mode.HOLD).meet()
    story.see(n_windows=2)
    known = story.state.alpha.registration
    before = ev.MarginJudged(
        id="initial", verdict=verdict(accepted=False), judged=judged(known, rtc())
    )
    story.tell(replace(rtc(), leak=0.99))
    assert of_kind(story.tell(before), ev.JudgeMatrix)
    assert "margin" not in story.alarms
    now = replace(before, judged=judged(known, rtc(), leak=0.99))
    story.tell(now)
    assert "margin" in story.alarms


def test_a_ramp_tries_the_papers_groups_and_fewer_of_few_modes(story):
    (asked,) = of_kind(story.tell(cmd.Ramp(gains=(0.2, 0.4))), RampRequest)
    assert asked.groups == ((0, 1), (2, 99), (100, 399))
    assert (asked.gains, asked.frames_per_gain) == ((0.2, 0.4), 1000)
    assert story.state.loop.command.lasts_s == 6.0
    few = Story(Mode.HOLD).meet(n_controlled=60, gains=rtc(60).gains)
    few.tell(cmd.StopDither())
    (asked,) = of_kind(few.tell(cmd.Ramp()), RampRequest)
    assert asked.groups == ((0, 1), (2, 59))


def test_nothing_is_made_while_gains_are_only_tried():
    story = Story(Mode.AUTO).meet()
    story.tell(cmd.Ramp(gains=(0.2, 0.4)))
    story.tell(loop_answered(story.state.loop.command.id, accepted=True, reason=""))
    story.see(n_windows=2, every_s=2.0)
    assert not story.asked(ev.MakeMatrix)
    story.wait(3)
    assert story.asked(ev.MakeMatrix)


class TestAMeasurementGivenUp:
    def begin(self, story, pattern=Pattern.PUSH_PULL_MODAL, *, loop="open"):
        story.tell(cmd.Measure(id="im-1", pattern=pattern))
        story.tell(rtc(loop=loop))

    def test_the_loop_is_closed_again_as_often_as_it_takes(self, story):
        self.begin(story)
        (asked,) = of_kind(story.tell(cmd.GiveUp(id="im-1")), LoopRequest)
        assert asked.loop is Loop.CLOSED
        story.tell(loop_answered(asked.id, accepted=False, reason="busy: im-1"))
        assert len(of_kind(story.wait(2.2 * RECLOSING_INTERVAL_S), LoopRequest)) == 2
        story.tell(rtc())
        assert not of_kind(story.wait(60), LoopRequest)
        assert story.state.loop.close_since_ns_utc is None

    def test_a_loop_that_opens_only_then_is_closed_too(self, story):
        self.begin(story, loop="closed")
        assert not of_kind(story.tell(cmd.GiveUp(id="im-1")), LoopRequest)
        story.tell(rtc(loop="open"), after_s=1)
        assert of_kind(story.tell(ev.Tick()), LoopRequest)

    def test_a_loop_that_was_open_before_stays_open(self, story):
        story.tell(rtc(loop="open"))
        self.begin(story)
        assert not of_kind(story.tell(cmd.GiveUp(id="im-1")), LoopRequest)
        assert not of_kind(story.wait(20), LoopRequest)

    def test_an_operator_who_opens_the_loop_is_obeyed(self, story):
        self.begin(story)
        story.tell(cmd.GiveUp(id="im-1"))
        story.tell(cmd.SetLoop(loop="open"), after_s=1)
        assert not of_kind(story.wait(20), LoopRequest)

    def test_a_loop_nobody_closes_is_not_asked_about_for_ever(self, story):
        self.begin(story)
        story.tell(cmd.GiveUp(id="im-1"))
        story.wait(3700, every_s=60)
        assert story.state.loop.close_since_ns_utc is None


# --- loop gains by the table of optical gains, when an operator asks for them


MEASURED = tuple(
    ModeGain(mode=mode, gain=0.7, sigma=0.01, scatter=0.02, t_ns_utc=START_NS)
    for mode in (509, 527, 545, 563)
)


@pytest.fixture
def measured():
    measured = Story(Mode.HOLD).meet()
    measured.see(n_windows=2)
    known = replace(measured.state.alpha.registration, optical_gains=MEASURED)
    measured.state = changed(measured.state, registration=known)
    return measured


def test_they_act_alike_on_every_controlled_mode_and_the_gate_is_asked(measured):
    (effect,) = measured.tell(cmd.SetLoop(effective_gain=0.3))
    assert effect.judged
    asked = effect.request
    assert len(asked.gains) == N_MODES
    in_effect = np.array(asked.gains[:400]) * gain_table(MEASURED, 400).optical_gain
    np.testing.assert_allclose(in_effect, 0.3, rtol=1e-12)
    assert set(asked.gains[400:]) == {0.0}
    assert "gain 0.3 in effect on every mode, by the gain table" in measured.state.loop.command.text


def test_asked_twice_they_are_the_same(measured):
    (first,) = of_kind(measured.tell(cmd.SetLoop(effective_gain=0.3)), LoopRequest)
    measured.now_ns += 1
    (second,) = of_kind(measured.tell(cmd.SetLoop(effective_gain=0.3)), LoopRequest)
    assert first.gains == second.gains


def test_gains_an_operator_names_are_his_own_business(measured):
    groups = (cmd.GainGroup(first=0, last=1, gain=0.5),)
    (asked,) = measured.tell(cmd.SetLoop(gains=groups))
    assert not asked.judged


def test_without_a_measured_gain_there_is_nothing_to_undo():
    with pytest.raises(CommandError, match="no optical gain is measured yet; start a dither"):
        Story(Mode.HOLD).meet().tell(cmd.SetLoop(effective_gain=0.3))


def test_the_service_never_sets_them_by_itself():
    measured = Story(Mode.AUTO).meet()
    measured.see(n_windows=30)
    measured.wait(60)
    assert not measured.asked(LoopRequest)
