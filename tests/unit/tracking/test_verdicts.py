"""A verdict of the gate is of a loop and an α: what it says of others, and what is done then."""

from dataclasses import replace

import numpy as np
import pytest

from service.errors import CommandError
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import MatrixState
from service.records.registration import Registration
from service.records.state import Mode
from service.tracker import step
from tests.support.situations import (
    ALL_SHOWN,
    ALPHA,
    N_MODES,
    POLICY,
    START_NS,
    Story,
    judged,
    moved,
    of_kind,
    record,
    rtc,
    verdict,
)
from tests.support.states import changed, tracker_state

HIGH = (0.9,) * 400 + (0.0,) * (N_MODES - 400)


@pytest.fixture
def waiting():
    """A proposal awaits an operator."""
    story = Story(Mode.PROPOSE).meet()
    story.see(n_windows=3)
    story.make("cm-1")
    return story


def judge(story, *, accepted=True, **changes):
    """Give the verdict that was asked for."""
    now = judged(story.state.alpha.registration, story.state.loop.rtc, **changes)
    event = ev.ProposalJudged(id="cm-1", verdict=verdict(accepted=accepted), judged=now)
    return story.tell(event, after_s=1.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gains": HIGH}, "gains have changed"),
        ({"leak": 0.99}, "leak was 0.999, it is 0.99"),
        ({"delay_frames": 2.5}, "delay was 2 frames, it is 2.5"),
    ],
)
def test_one_judged_for_another_loop_is_judged_again_with_the_gains_of_now(waiting, changes, words):
    waiting.tell(rtc(**changes))
    effects = waiting.tell(cmd.Approve(id="cm-1"))
    assert not of_kind(effects, ev.SendMatrix)
    (asked,) = of_kind(effects, ev.JudgeProposal)
    assert (asked.id, asked.gains) == ("cm-1", waiting.state.loop.rtc.gains[:400])
    assert words in next(e for e in waiting.state.log if "judged-again" in e.name).text


def test_gains_that_follow_the_seeing_by_a_few_percent_change_no_verdict(waiting):
    before = len(waiting.asked(ev.JudgeMatrix))
    for gain in (0.405, 0.41, 0.415, 0.41):
        gains = (gain,) * 400 + (0.0,) * (N_MODES - 400)
        waiting.tell(rtc(gains=gains), after_s=1.0)
    assert len(waiting.asked(ev.JudgeMatrix)) == before
    assert of_kind(waiting.tell(cmd.Approve(id="cm-1")), ev.SendMatrix)


def test_so_is_one_whose_alpha_is_known_much_worse_by_now(waiting):
    waiting.state = changed(
        waiting.state,
        registration=replace(
            waiting.state.alpha.registration, grown=np.array([0.03, 0.03, 0, 0]) ** 2
        ),
    )
    assert of_kind(waiting.tell(cmd.Approve(id="cm-1")), ev.JudgeProposal)


def test_it_is_sent_when_it_passes_anew(waiting):
    waiting.tell(rtc(gains=HIGH))
    waiting.tell(cmd.Approve(id="cm-1"))
    assert of_kind(judge(waiting), ev.SendMatrix)
    assert waiting.matrix_state("cm-1") is MatrixState.PUBLISHED
    waiting.acknowledge("cm-1")
    assert waiting.state.matrices.margin is waiting.state.reconstructor("cm-1").gate


def test_and_refused_with_the_gates_words_when_it_does_not(waiting):
    waiting.tell(rtc(gains=HIGH))
    waiting.tell(cmd.Approve(id="cm-1"))
    assert not of_kind(judge(waiting, accepted=False), ev.SendMatrix)
    assert waiting.matrix_state("cm-1") is MatrixState.REFUSED
    assert waiting.state.reconstructor("cm-1").reason == "too little margin"


def test_what_changes_while_it_is_judged_keeps_it_from_being_sent(waiting):
    waiting.tell(rtc(gains=HIGH))
    waiting.tell(cmd.Approve(id="cm-1"))
    waiting.tell(rtc(leak=0.99, gains=HIGH))
    assert not of_kind(judge(waiting, leak=0.999), ev.SendMatrix)
    assert waiting.matrix_state("cm-1") is MatrixState.PROPOSED


def test_approved_twice_it_is_sent_once(waiting):
    waiting.tell(rtc(gains=HIGH))
    waiting.tell(cmd.Approve(id="cm-1"))
    waiting.tell(cmd.Approve(id="cm-1"))
    assert of_kind(judge(waiting), ev.SendMatrix)
    assert not of_kind(judge(waiting), ev.SendMatrix)


def test_an_open_loop_does_not_tell_its_gains_so_the_verdict_stands(waiting):
    waiting.tell(rtc(loop="open", gains=(0.0,) * N_MODES))
    assert of_kind(waiting.tell(cmd.Approve(id="cm-1")), ev.SendMatrix)


def test_nor_can_one_be_judged_there_that_was_made_before_the_service_restarted(waiting):
    waiting.make("cm-2", judged=None)
    waiting.tell(rtc(loop="open", gains=(0.0,) * N_MODES))
    with pytest.raises(CommandError, match="close it first"):
        waiting.tell(cmd.Approve(id="cm-2"))


def test_one_must_be_able_to_go_back_with_the_loop_open(waiting):
    waiting.tell(rtc(loop="open", gains=(0.0,) * N_MODES))
    effects = waiting.make("cm-2", judged=None, gate=None, wanted=True)
    assert of_kind(effects, ev.SendMatrix)


def test_but_not_with_one_of_whose_verdict_nobody_knows_the_gains(waiting):
    waiting.tell(rtc(loop="open", gains=(0.0,) * N_MODES))
    assert not of_kind(waiting.make("cm-2", judged=None, wanted=True), ev.SendMatrix)
    assert waiting.matrix_state("cm-2") is MatrixState.PROPOSED


def test_with_an_invalid_alpha_nothing_can_be_judged(waiting):
    waiting.see(moved(shift_x_subap=0.3))
    waiting.wait(61)
    with pytest.raises(CommandError, match="α is invalid"):
        waiting.tell(cmd.Approve(id="cm-1"))


class TestAuto:
    """What nobody asked for is sent only to a closed loop that behaves."""

    @pytest.fixture
    def story(self):
        story = Story(Mode.AUTO).meet()
        story.see(n_windows=3)
        return story

    def made_before(self, story, change):
        """A matrix comes whose making began before something happened."""
        then = judged(story.state.alpha.registration, story.state.loop.rtc)
        change(story)
        return story.make("cm-1", judged=then, alpha=ALPHA)

    def test_other_gains_and_it_is_judged_again(self, story):
        effects = self.made_before(story, lambda s: s.tell(rtc(gains=HIGH)))
        assert not of_kind(effects, ev.SendMatrix)
        assert of_kind(effects, ev.JudgeProposal)
        assert of_kind(judge(story), ev.SendMatrix)

    @pytest.mark.parametrize(
        "change",
        [
            lambda s: s.tell(rtc(loop="open")),
            lambda s: s.tell(ev.ConditionChanged(name="edge-slip", text="the outer ring slips")),
            lambda s: s.meet(session="s2"),
        ],
        ids=["open", "slipping", "new session"],
    )
    def test_an_open_a_slipping_or_another_loop_and_it_is_not_sent(self, story, change):
        effects = self.made_before(story, change)
        assert not of_kind(effects, ev.SendMatrix | ev.JudgeProposal)
        assert story.matrix_state("cm-1") is MatrixState.PROPOSED


def test_a_matrix_an_operator_wants_back_is_judged_again_after_a_jump():
    story = Story(Mode.HOLD).meet()
    story.see(n_windows=3)
    then = judged(story.state.alpha.registration, story.state.loop.rtc)
    there = moved(shift_x_subap=0.3)
    story.see(there, n_windows=3)
    effects = story.make("cm-1", judged=then, alpha=ALPHA, wanted=True)
    assert not of_kind(effects, ev.SendMatrix)
    assert of_kind(effects, ev.JudgeProposal)
    assert of_kind(judge(story), ev.SendMatrix)


def test_an_acknowledgement_of_a_matrix_judged_for_another_loop_is_no_margin(waiting):
    waiting.tell(cmd.Approve(id="cm-1"))
    waiting.tell(rtc(gains=HIGH))
    waiting.acknowledge("cm-1")
    assert waiting.state.matrices.margin is None
    assert waiting.asked(ev.JudgeMatrix)[-1].id == "cm-1"


# --- an operator cannot approve a verdict that is of another registration


def proposed(alpha):
    """The service believes in ``alpha``; a proposal for ``ALPHA`` waits."""
    registration = Registration(
        alpha=alpha,
        covariance=np.diag([0.001, 0.001, 1e-5, 1e-4]) ** 2,
        floor=POLICY.floor,
        t_ns_utc=START_NS,
        arrived_ns_utc=START_NS,
        n_windows=5,
    )
    then = judged(replace(registration, alpha=ALPHA), rtc())
    return tracker_state(
        system="flao",
        rtc=rtc(),
        verified_ids=frozenset({"initial"}),
        reconstructors=(record("cm-1", judged=then),),
        registration=registration,
        mode_proof=ALL_SHOWN,
    )


def test_a_proposal_for_a_registration_left_behind_is_refused_and_still_there():
    state = proposed(moved(ALPHA, shift_x_subap=0.1))
    with pytest.raises(CommandError, match="refit"):
        step(state, cmd.Approve(id="cm-1"), POLICY, START_NS)
    assert state.reconstructor("cm-1").state is MatrixState.PROPOSED


def test_a_change_below_the_update_threshold_does_not_make_it_stale():
    state = proposed(replace(ALPHA, shift_x_subap=ALPHA.shift_x_subap + 0.005))
    state, _ = step(state, cmd.Approve(id="cm-1"), POLICY, START_NS)
    assert state.reconstructor("cm-1").state is MatrixState.PUBLISHED
