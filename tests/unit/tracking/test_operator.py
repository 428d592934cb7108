from dataclasses import replace

import pytest

from service.errors import CommandError
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import MatrixState
from service.records.state import Level, Mode
from service.wire import DitherRequest
from tests.support.situations import Story, moved, of_kind, record, stopping
from tests.support.states import changed


@pytest.fixture
def story():
    """α known, one proposal on the shelf, nothing done by itself."""
    story = Story(Mode.HOLD).meet()
    story.see(n_windows=2)
    story.make("cm-1")
    return story


def refused(story, command, match, kind=CommandError):
    """The command is refused with these words, and the state stands."""
    before = story.state
    with pytest.raises(kind, match=match):
        story.tell(command)
    assert story.state is before


@pytest.mark.parametrize("mode", list(Mode))
def test_the_mode_can_always_be_changed(mode):
    story = Story(Mode.PROPOSE)
    story.tell(cmd.SetMode(mode=mode))
    assert story.state.operator.mode is mode
    assert story.state.log[-1].text == f"mode is {mode.value}"


class TestApproval:
    def test_an_approved_proposal_is_sent(self, story):
        (sent,) = of_kind(story.tell(cmd.Approve(id="cm-1")), ev.SendMatrix)
        assert sent.id == "cm-1"
        assert story.matrix_state("cm-1") is MatrixState.PUBLISHED

    def test_a_rejected_one_never_is(self, story):
        story.tell(cmd.Reject(id="cm-1", reason="not tonight"))
        assert story.state.reconstructor("cm-1").reason == "not tonight"
        refused(story, cmd.Approve(id="cm-1"), "cm-1 is discarded, not proposed")
        assert not story.asked(ev.SendMatrix)

    def test_a_rejection_without_words_names_the_operator(self, story):
        story.tell(cmd.Reject(id="cm-1"))
        assert story.state.reconstructor("cm-1").reason == "by the operator"


class TestRefit:
    def test_it_computes_for_as_many_modes_as_are_controlled(self, story):
        assert story.tell(cmd.Refit())[0] == ev.MakeMatrix(n_modes=400, why="the operator asked")

    def test_or_for_as_many_as_asked(self, story):
        assert story.tell(cmd.Refit(n_modes=594))[0].n_modes == 594

    def test_it_works_in_hold_too_and_the_result_waits_for_approval(self, story):
        story.tell(cmd.Refit())
        story.make("cm-2")
        assert story.matrix_state("cm-2") is MatrixState.PROPOSED


class TestGoingBack:
    @pytest.fixture
    def story(self):
        """Two reconstructors have been in use, cm-2 is now."""
        story = Story(Mode.AUTO).meet()
        story.see(n_windows=2)
        return story.use("cm-1").use("cm-2", 500)

    def test_a_rollback_copies_the_last_one_superseded_and_holds(self, story):
        (copied,) = of_kind(story.tell(cmd.Rollback()), ev.RepublishMatrix)
        assert copied.source == "cm-1"
        assert story.state.operator.mode is Mode.HOLD

    def test_the_copy_is_sent_without_further_approval(self, story):
        story.tell(cmd.Rollback())
        (sent,) = of_kind(story.make("cm-3", wanted=True, parent="cm-1"), ev.SendMatrix)
        assert (sent.id, sent.n_modes) == ("cm-3", 400)
        assert sent.gains == (0.4,) * 400 + (0.0,) * 194

    def test_unless_the_gate_refuses_it(self, story):
        story.tell(cmd.Rollback())
        assert not of_kind(story.make("cm-3", MatrixState.REFUSED, wanted=True), ev.SendMatrix)

    def test_but_an_operator_goes_back_anyway(self, story):
        (copied,) = of_kind(story.tell(cmd.Rollback(anyway=True)), ev.RepublishMatrix)
        assert copied.anyway
        why = "the operator goes back to cm-1, though the gate refuses it"
        back = record("cm-3", parent="cm-1", gate=None, judged=None, reason=why)
        (sent,) = of_kind(
            story.tell(ev.MatrixMade(record=back, wanted=True, anyway=True)), ev.SendMatrix
        )
        assert sent.id == "cm-3"
        assert why in story.state.log[-1].text
        assert story.state.log[-1].level is Level.WARNING

    def test_a_suspected_jump_keeps_nobody_from_it(self, story):
        shelf = story.state.matrices.reconstructors
        summed = tuple(replace(r, sha256="ab") if r.id == "cm-1" else r for r in shelf)
        story.state = changed(story.state, reconstructors=summed)
        story.see(moved(shift_x_subap=0.15))
        assert story.state.alpha.registration.suspected_jump is not None
        story.tell(cmd.Rollback())
        made = story.make("cm-3", wanted=True, parent="cm-1", sha256="ab")
        assert of_kind(made, ev.SendMatrix)

    def test_nothing_replaces_it_by_itself(self, story):
        story.tell(cmd.Rollback())
        story.use("cm-3")
        before = len(story.asked(ev.MakeMatrix))
        story.see(n_windows=60)
        assert len(story.asked(ev.MakeMatrix)) == before

    def test_any_known_reconstructor_can_be_published_again(self, story):
        (copied,) = of_kind(story.tell(cmd.Publish(id="initial")), ev.RepublishMatrix)
        assert copied.source == "initial"
        assert story.state.operator.mode is Mode.HOLD

    def test_while_the_gate_cannot_judge_only_what_has_been_in_use_is_sent(self, story):
        story.make("cm-3", MatrixState.REFUSED)
        story.state = changed(story.state, registration=None)
        refused(story, cmd.Publish(id="cm-3"), "α is not known yet")
        assert of_kind(story.tell(cmd.Publish(id="cm-1")), ev.RepublishMatrix)

    def test_what_the_gate_could_not_judge_is_sent_and_said_to_be(self, story):
        story.state = changed(story.state, registration=None)
        story.tell(cmd.Rollback())
        why = "the operator goes back to cm-1; the gate could not judge it: α is unknown"
        effects = story.make("cm-3", wanted=True, gate=None, judged=None, alpha=None, reason=why)
        assert of_kind(effects, ev.SendMatrix)
        made, published = story.state.log[-2:]
        assert (made.name, published.name) == ("reconstructor.made", "reconstructor.published")
        assert why in made.text
        assert why in published.text
        assert published.level is Level.WARNING
        for state in (MatrixState.STAGED, MatrixState.APPLIED):
            story.acknowledge("cm-3", state)
            assert story.state.reconstructor("cm-3").reason == why

    def test_of_what_it_judged_nothing_of_the_kind_is_said(self, story):
        story.tell(cmd.Rollback())
        story.make("cm-3", wanted=True, reason="the operator goes back to cm-1")
        assert story.state.log[-1].text == "cm-3 sent to the RTC"
        story.acknowledge("cm-3")
        assert story.state.reconstructor("cm-3").reason == ""

    def test_it_need_not_wait_for_a_computation_under_way(self, story):
        story.tell(cmd.Refit())
        story.tell(cmd.Rollback())
        assert not of_kind(story.make("cm-3"), ev.SendMatrix), "mode is hold by now"
        assert of_kind(story.make("cm-4", wanted=True, parent="cm-1"), ev.SendMatrix)


class TestDither:
    def test_stopped_it_stays_stopped_until_started(self):
        story = Story().meet()
        assert story.tell(cmd.StopDither()) == (stopping(story),)
        story.wait(30)
        assert story.state.dithers.dither is None
        assert len(story.asked(DitherRequest)) == 1
        story.tell(cmd.StartDither())
        assert len(story.asked(DitherRequest)) == 2

    def test_stopping_needs_nothing(self):
        story = Story()
        assert story.tell(cmd.StopDither()) == (stopping(story),)

    def test_what_is_asked_for_is_what_the_rtc_is_asked(self):
        story = Story().meet()
        story.tell(cmd.StopDither())
        story.tell(
            cmd.StartDither(
                modes=(3, 5), amplitude_m=2e-9, frequency_hz=(220.0, 260.0), duration_s=10.0
            )
        )
        dither = story.asked(DitherRequest)[-1]
        assert dither.modes == (3, 5)
        assert dither.amplitude_m == (2e-9, 2e-9)
        assert dither.frequency_hz == (220.0, 260.0)
        assert dither.duration_s == 10.0
