"""An RTC that applies another matrix than it says: named, nothing more sent, the loop safe."""

from dataclasses import replace

import pytest

from service.errors import CommandError
from service.estimation.comparison import ProbationFinding, Verdict
from service.records import alarms
from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import AcquisitionStage, ProbationState
from service.records.products import MatrixState
from service.records.state import Mode
from service.tracking.operations import acquisition
from service.tracking.step_context import StepContext
from service.wire import Loop, LoopRequest
from tests.support.situations import POLICY, Story, acknowledged, foreign, moved, rtc
from tests.support.states import changed

OWN_SUM, OUR_SUM = "a" * 64, "b" * 64
SWAP = 1000
"""Frame from which the RTC says that the matrix is applied; at 1 kHz."""


@pytest.fixture
def story():
    """The first matrix of ours has been acknowledged as applied; no status has come since."""
    story = Story(Mode.AUTO)
    story.tell(ev.SessionStarted(session="s1"))
    story.tell(rtc(seq=0))
    story.tell(ev.MatrixFetched(record=replace(foreign(), sha256=OWN_SUM)))
    story.tell(ev.Tick(), after_s=3)
    story.see(n_windows=3)
    story.make("cm-1", sha256=OUR_SUM)
    story.acknowledge("cm-1", frame_seq=SWAP)
    story.effects = []
    return story


def names(story, matrix_id, seq):
    """A status of this frame names a matrix."""
    return story.tell(rtc(cm_id=matrix_id, seq=seq), after_s=0.2)


def opposite(story, matrix_id):
    return story.tell(ev.MatrixMisapplied(id=matrix_id))


def goes_back(story, *, answered=True):
    """The numbers of the RTC's own matrix are sent again as cm-2, and acknowledged."""
    unjudged = {"alpha": None, "sigma": None, "gate": None, "judged": None, "parent": "initial"}
    story.make("cm-2", sha256=OWN_SUM, **unjudged)
    if answered:
        story.acknowledge("cm-2", frame_seq=SWAP + 500)


def diverges(story, after_s=0.0):
    return story.tell(ev.ConditionChanged(name=alarms.LOST, text="the loop is lost"), after_s)


def trial(story):
    return story.state.operations.probation


def opened(story):
    return [request for request in story.asked(LoopRequest) if request.loop is Loop.OPEN]


class TestAppliedWithoutASwap:
    def test_a_status_of_the_time_of_the_swap_proves_nothing(self, story):
        names(story, "initial", SWAP + 400)
        assert story.state.matrices.in_use == "cm-1"
        assert alarms.MISAPPLIED not in story.alarms
        names(story, "cm-1", SWAP + 600)
        assert alarms.MISAPPLIED not in story.alarms

    def test_nor_does_a_matrix_that_was_read_before_the_swap(self, story):
        story.tell(ev.MatrixFetched(record=replace(foreign("other"), sha256="c" * 64)))
        assert story.state.matrices.in_use == "cm-1"
        assert story.state.reconstructor("other") is None

    def test_one_that_is_later_does(self, story):
        names(story, "initial", SWAP + 501)
        assert story.state.matrices.in_use == "initial"
        assert story.matrix_state("cm-1") is MatrixState.FAILED
        (alarm,) = (a for a in story.state.alarms.active if a.name == alarms.MISAPPLIED)
        for part in ("applies another matrix than it says", "cm-1", "1000", "1501", "initial"):
            assert part in alarm.text
        assert trial(story).state is ProbationState.NOT_JUDGED

    def test_then_nothing_is_made_or_sent_until_an_operator_sets_the_mode(self, story):
        names(story, "initial", SWAP + 501)
        story.see(moved(shift_x_subap=0.1), n_windows=5)
        story.make("cm-2", sha256="c" * 64)
        assert not story.asked(ev.MakeMatrix)
        assert not story.asked(ev.SendMatrix)
        with pytest.raises(CommandError, match="applies another matrix than it says"):
            story.tell(cmd.Approve(id="cm-2"))
        story.tell(cmd.SetMode(mode=Mode.AUTO))
        assert alarms.MISAPPLIED not in story.alarms
        story.tell(cmd.Approve(id="cm-2"))
        assert [effect.id for effect in story.asked(ev.SendMatrix)] == ["cm-2"]

    def test_a_swap_that_comes_late_is_taken_in_and_the_alarm_lasts(self, story):
        names(story, "initial", SWAP + 501)
        names(story, "cm-1", SWAP + 4000)
        assert story.state.matrices.in_use == "cm-1"
        assert story.matrix_state("cm-1") is MatrixState.APPLIED
        assert trial(story).state is ProbationState.RUNNING
        assert alarms.MISAPPLIED in story.alarms

    def test_an_rtc_may_take_another_matrix_once_the_swap_was_seen(self, story):
        names(story, "cm-1", SWAP + 200)
        names(story, "initial", SWAP + 900)
        assert story.state.matrices.in_use == "initial"
        assert alarms.MISAPPLIED not in story.alarms

    def test_an_acknowledgement_without_a_frame_proves_nothing(self, story):
        names(story, "cm-1", SWAP + 200)
        story.make("cm-2", sha256="c" * 64, wanted=True)
        story.tell(acknowledged("cm-2", state="applied", frame_seq=None))
        names(story, "cm-1", SWAP + 9000)
        assert alarms.MISAPPLIED not in story.alarms


class TestSignTurned:
    def test_the_matrix_before_is_sent_again_and_the_cause_is_named(self, story):
        effects = opposite(story, "cm-1")
        assert [e.source for e in effects if isinstance(e, ev.RepublishMatrix)] == ["initial"]
        assert alarms.MISAPPLIED in story.alarms
        assert story.state.operator.mode is Mode.HOLD

    def test_also_where_the_frames_come_before_the_acknowledgement(self, story):
        story.make("cm-3", sha256="c" * 64)
        names(story, "cm-1", SWAP + 100)
        story.tell(cmd.SetMode(mode=Mode.PROPOSE))
        story.make("cm-4", sha256="d" * 64, wanted=True)
        story.effects = []
        opposite(story, "cm-4")
        assert not story.asked(ev.RepublishMatrix)
        story.acknowledge("cm-4", frame_seq=SWAP + 900)
        story.tell(ev.Tick())
        assert [effect.source for effect in story.asked(ev.RepublishMatrix)] == ["cm-1"]

    def test_a_way_back_that_does_not_help_ends_sending_and_opens_the_loop(self, story):
        opposite(story, "cm-1")
        goes_back(story)
        diverges(story)
        assert trial(story).state is ProbationState.WATCHED
        diverges(story, after_s=0.9)
        assert not opened(story)
        diverges(story, after_s=0.2)
        assert len(opened(story)) == 1
        story.tell(rtc(loop="open", cm_id="cm-2", seq=SWAP + 2000), after_s=0.2)
        story.wait(30)
        assert trial(story).state is ProbationState.OPENED
        assert len(story.asked(ev.SendMatrix)) == 1
        assert story.state.operator.mode is Mode.HOLD
        assert {alarms.MISAPPLIED, alarms.LOOP_OPENED} <= story.alarms

    def test_a_mirror_at_its_limits_cannot_be_compared_and_was_not_helped(self, story):
        opposite(story, "cm-1")
        goes_back(story)
        diverges(story)
        finding = ProbationFinding(
            verdict=Verdict.UNKNOWN, before="initial", after="cm-2", text="no mode moves"
        )
        story.tell(ev.Compared(finding=finding), 0.2)
        assert trial(story).state is ProbationState.WATCHED
        diverges(story, after_s=1.0)
        assert opened(story)

    def test_a_way_back_that_comes_late_has_less_time_to_help(self, story):
        opposite(story, "cm-1")
        story.tell(ev.Tick(), 1.3)
        goes_back(story)
        diverges(story, after_s=0.1)
        assert not opened(story)
        diverges(story, after_s=0.2)
        assert len(opened(story)) == 1

    def test_a_way_back_that_helps_leaves_the_loop_closed(self, story):
        opposite(story, "cm-1")
        goes_back(story)
        finding = ProbationFinding(
            verdict=Verdict.AS_GOOD, before="initial", after="cm-2", text="as good"
        )
        story.tell(ev.Compared(finding=finding), 1.0)
        assert trial(story).state is ProbationState.ROLLED_BACK
        assert not opened(story)
        assert alarms.MISAPPLIED in story.alarms

    def test_a_way_back_that_takes_too_long_is_not_waited_for(self, story):
        opposite(story, "cm-1")
        goes_back(story, answered=False)
        story.tell(ev.Tick(), 1.4)
        assert not opened(story)
        story.tell(ev.Tick(), 0.2)
        assert len(opened(story)) == 1
        story.acknowledge("cm-2", frame_seq=SWAP + 2000)
        assert trial(story).state is ProbationState.OPENING, "it comes too late"

    def test_a_way_back_that_is_not_swapped_in_opens_the_loop(self, story):
        names(story, "cm-1", SWAP + 100)
        opposite(story, "cm-1")
        goes_back(story)
        names(story, "cm-1", SWAP + 1001)
        assert len(opened(story)) == 1


def test_an_acquisition_does_not_begin_again_with_such_an_rtc(story):
    state = changed(
        story.state,
        acquisition=replace(
            story.state.operations.acquisition,
            stage=AcquisitionStage.PARTIAL,
            attempt=1,
            matrix="cm-1",
        ),
        misapplied="the RTC applies another matrix than it says",
    )
    context = StepContext(state, POLICY, story.now_ns)
    reason = "cm-1 was not applied"
    acquisition._restart_acquisition(context, reason)
    assert context.acquisition.stage is AcquisitionStage.FAILED
