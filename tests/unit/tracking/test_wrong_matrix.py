"""What the RTC says it holds is compared with what was sent; one without a name is asked for."""

import pytest

from service.errors import CommandError
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import MatrixState
from service.records.state import Mode
from service.wire import DitherRequest
from tests.support.situations import Story, acknowledged, foreign, record, rtc
from tests.support.states import changed

SUM, OTHER = "a" * 64, "b" * 64


def sent(story=None):
    """A matrix on its way to the RTC, beside the one it brought."""
    story = story or Story()
    story.meet()
    story.tell(ev.MatrixFetched(record=foreign()))
    story.see(n_windows=2)
    story.make("cm-1", MatrixState.PUBLISHED, sha256=SUM)
    story.shows = False
    return story


def answer(story, sha256, state=MatrixState.APPLIED, matrix_id="cm-1", frame_seq=1000):
    applied = state is MatrixState.APPLIED
    story.tell(
        acknowledged(
            matrix_id,
            sha256=sha256,
            state=state,
            reason="",
            frame_seq=frame_seq if applied else None,
        )
    )


@pytest.mark.parametrize("state", [MatrixState.STAGED, MatrixState.APPLIED])
def test_another_sum_than_was_sent_is_an_alarm_and_nothing_is_published_any_more(state):
    story = sent()
    answer(story, OTHER, state)
    story.effects.clear()
    assert story.matrix_state("cm-1") is MatrixState.FAILED
    alarm = next(a for a in story.state.alarms.active if a.name == "wrong-matrix")
    assert SUM in alarm.text
    assert OTHER in alarm.text
    story.tell(rtc(cm_id="cm-1"))
    assert story.state.matrices.in_use != "cm-1"
    story.make("cm-2", MatrixState.PROPOSED)
    with pytest.raises(CommandError, match="cm-1"):
        story.tell(cmd.Approve(id="cm-2"))
    story.wait(60.0)
    assert not story.asked(ev.SendMatrix)
    assert not story.asked(ev.MakeMatrix)


def test_the_same_sum_is_applied():
    story = sent()
    answer(story, SUM)
    assert story.matrix_state("cm-1") is MatrixState.APPLIED
    assert "wrong-matrix" not in story.alarms


def test_a_wrong_matrix_is_read_back_and_is_over_when_it_is_right():
    story = sent()
    answer(story, OTHER)
    story.tell(rtc(cm_id="cm-1"))
    story.wait(11.0)
    assert ev.FetchMatrix(id="cm-1") in story.asked(ev.FetchMatrix)
    story.tell(ev.MatrixFetched(record=record("cm-1", sha256=OTHER)))
    assert "wrong-matrix" in story.alarms
    story.tell(ev.MatrixFetched(record=record("cm-1", sha256=SUM)))
    assert "wrong-matrix" not in story.alarms
    assert story.state.matrices.in_use == "cm-1"


def test_a_wrong_matrix_is_over_when_the_rtc_acknowledges_the_right_one_or_starts_over():
    story = sent()
    answer(story, OTHER)
    answer(story, SUM, frame_seq=1001)
    assert "wrong-matrix" not in story.alarms
    assert story.state.matrices.in_use == "cm-1"
    story = sent()
    answer(story, OTHER)
    story.tell(ev.SessionStarted(session="s2"))
    assert "wrong-matrix" not in story.alarms
    assert story.state.matrices.mismatched_id is None


def test_a_commit_the_rtc_could_not_read_is_not_taken_for_a_matrix_on_its_way():
    """Anyone may have sent it: the reason is logged, and the matrix waits for its own answer."""
    story = sent()
    story.tell(acknowledged(None, state=MatrixState.REJECTED, reason="signature", frame_seq=None))
    assert story.matrix_state("cm-1") is MatrixState.PUBLISHED
    (said,) = (e for e in story.state.log if e.name == "acknowledgement.unreadable-commit")
    assert "signature" in said.text
    assert "cm-1" in said.text
    answer(story, SUM)
    assert story.state.matrices.in_use == "cm-1"


def test_a_commit_that_only_the_rtc_has_seen_is_told_with_its_reason():
    story = sent()
    answer(story, SUM)
    story.tell(acknowledged(None, state=MatrixState.REJECTED, reason="no map", frame_seq=None))
    said = [e for e in story.state.log if e.name == "acknowledgement.unreadable-commit"]
    assert "no map. This service has sent none" in said[-1].text


# ---------------------------------------------------------------- a known id in a new session


def restarted(story=None):
    """The RTC starts anew and names the matrix that it had."""
    story = story or sent()
    answer(story, SUM)
    story.tell(ev.SessionStarted(session="s2"))
    story.effects.clear()
    story.tell(rtc(cm_id="cm-1", session="s2"))
    return story


def test_after_a_restart_a_known_matrix_is_read_back_before_it_is_believed():
    story = restarted()
    assert story.asked(ev.FetchMatrix) == [ev.FetchMatrix(id="cm-1")]
    assert story.state.matrices.in_use is None
    story.tell(ev.MatrixFetched(record=record("cm-1", sha256=SUM)))
    assert story.state.matrices.in_use == "cm-1"
    assert story.matrix_state("cm-1") is MatrixState.APPLIED
    story.effects.clear()
    story.tell(rtc(cm_id="cm-1", session="s2"))
    story.wait(30.0)
    assert not story.asked(ev.FetchMatrix)


@pytest.mark.parametrize("order", [cmd.Rollback(), cmd.Publish(id="cm-1")])
def test_nothing_is_sent_to_an_rtc_whose_matrix_is_being_read_back(order):
    story = restarted()
    story.tell(order)
    story.make("cm-2", wanted=True)
    assert not story.asked(ev.SendMatrix)
    with pytest.raises(CommandError, match="read back"):
        story.tell(cmd.Approve(id="cm-2"))
    story.tell(ev.MatrixFetched(record=record("cm-1", sha256=SUM)))
    story.tell(cmd.Approve(id="cm-2"))
    assert story.asked(ev.SendMatrix)


@pytest.mark.parametrize("order", [cmd.Rollback(), cmd.Publish(id="cm-1")])
def test_other_numbers_under_a_known_id_forbid_all_sending(order):
    story = restarted()
    story.tell(ev.MatrixFetched(record=record("cm-1", sha256=OTHER)))
    story.tell(rtc(cm_id="cm-1", session="s2"))
    assert "wrong-matrix" in story.alarms
    assert story.state.matrices.in_use is None
    story.tell(order)
    story.make("cm-2", wanted=True)
    with pytest.raises(CommandError, match="other numbers"):
        story.tell(cmd.Approve(id="cm-2"))
    assert not story.asked(ev.SendMatrix)


def test_an_rtc_that_does_not_offer_its_matrix_is_believed_by_the_id():
    story = restarted()
    (fetch,) = story.asked(ev.FetchMatrix)
    story.tell(ev.JobFailed(effect=fetch, text="no answer on rtc/cm/applied"))
    story.tell(rtc(cm_id="cm-1", session="s2"))
    assert story.state.matrices.in_use == "cm-1"
    story.tell(cmd.Rollback())


# ---------------------------------------------------------------- a matrix without a name


def test_an_rtc_that_names_no_matrix_is_dithered_all_the_same_and_asked_now_and_then():
    story = Story(Mode.AUTO)
    story.tell(rtc(cm_id=None))
    story.wait(25.0)
    assert story.asked(DitherRequest)
    assert 2 <= len(story.asked(ev.FetchMatrix)) <= 4
    assert set(story.asked(ev.FetchMatrix)) == {ev.FetchMatrix(id=None)}


def test_what_it_answers_is_the_matrix_in_use():
    story = Story(Mode.AUTO)
    story.tell(rtc(cm_id=None))
    story.tell(ev.MatrixFetched(record=foreign("theirs")))
    assert story.state.matrices.in_use == "theirs"


def test_an_rtc_that_does_not_offer_its_matrix_is_dithered_all_the_same():
    story = Story(Mode.AUTO)
    story.tell(rtc(cm_id="theirs"))
    (fetch,) = story.asked(ev.FetchMatrix)
    assert not story.asked(DitherRequest)
    story.tell(ev.JobFailed(effect=fetch, text="no answer on rtc/cm/applied"))
    story.wait(2.0)
    assert story.state.matrices.read_back_error == "no answer on rtc/cm/applied"
    assert story.asked(DitherRequest)
    assert changed(story.state, active=()).matrices.in_use is None
