"""States change only as the tables declare; an RTC's contradiction changes none."""

from pathlib import Path

import pytest

from pyrcal_studies.campaign import golden
from pyrcal_studies.state_machines import MACHINES, draw
from service.config import load_settings
from service.errors import PyrcalError
from service.records import alarms
from service.records import events as ev
from service.records.operations import UNDER_WAY, AcquisitionStage, MeasurementRecord, MeasureState
from service.records.products import MatrixState
from service.records.state import Mode, OperatorState, TrackerState
from service.runtime.policy import policy_of
from service.tracker import step
from service.tracking import reconstructors, resume, transitions
from service.tracking.alarm_rules import REPEATED_ALARM_TIMEOUT_S
from service.tracking.step_context import StepContext
from service.tracking.transitions import TABLES, is_declared
from service.wire import LoopRequest, MeasureRequest, Pattern
from tests.support.situations import POLICY, Story, acknowledged, of_kind, record

NIGHTS = Path(__file__).parents[2] / "data" / "golden"
REPORT = transitions.report_undeclared
OTHER_SHA = "ab" * 32


def states_of_night(name, until):
    """Replay a golden night up to the first state that is wanted; return state, policy and time."""
    (instrument,) = golden.read(NIGHTS / golden.INSTRUMENT)
    begin, *entries = golden.read(NIGHTS / f"{name}.jsonl.xz")
    settings = policy_of(load_settings(None, {}, begin["settings"]))
    policy = golden.with_instrument(settings, instrument)
    state = TrackerState(system=begin["system"], operator=OperatorState(mode=Mode(begin["mode"])))
    for entry in entries:
        event = golden.decoded(ev.Event, entry["event"])
        try:
            state, _ = step(state, event, policy, entry["t"], entry.get("cause", ""))
        except PyrcalError:
            continue
        if until(state):
            return state, policy, entry["t"]
    raise AssertionError(f"{name} has no such state")


def rejection_of_reused_id(state):
    """R-72: somebody's commit has the id of the matrix in use, and another checksum."""
    return acknowledged(
        state.matrices.in_use,
        state="rejected",
        reason="id: was used, expected a new id",
        sha256=OTHER_SHA,
        session=state.loop.rtc.session,
    )


def test_a_reused_id_opens_no_loop_while_an_acquisition_widens():
    state, policy, now_ns = states_of_night(
        "acquire-alone",
        lambda state: (
            state.operations.acquisition.stage is AcquisitionStage.WIDENING
            and state.used is not None
        ),
    )
    after, effects = step(state, rejection_of_reused_id(state), policy, now_ns)
    assert not of_kind(effects, LoopRequest)
    assert after.operations.acquisition.stage is AcquisitionStage.WIDENING
    assert after.used.state is MatrixState.APPLIED
    assert after.matrices.mismatched_id is None


def test_a_reused_id_is_logged_only_while_the_mirror_is_tracked():
    state, policy, now_ns = states_of_night(
        "steady", lambda state: state.used is not None and state.used.applied_frame_seq is not None
    )
    after, _ = step(state, rejection_of_reused_id(state), policy, now_ns)
    assert after.used.state is MatrixState.APPLIED
    assert after.alarms.active == state.alarms.active
    assert "acknowledgement.other-commit" in [line.name for line in after.log]


@pytest.mark.parametrize("used", [MatrixState.APPLIED, MatrixState.SUPERSEDED])
def test_what_was_applied_is_not_rejected_any_more(used):
    story = Story(Mode.PROPOSE).meet()
    story.see(n_windows=3)
    story.use("cm-1")
    if used is MatrixState.SUPERSEDED:
        story.use("cm-2")
    story.acknowledge("cm-1", MatrixState.REJECTED, "no such id")
    assert story.matrix_state("cm-1") is used
    assert not story.alarms & {alarms.UNDECLARED, alarms.OTHER_SUM}


def test_a_rejection_of_what_is_on_its_way_counts_with_its_checksum_only():
    story = Story(Mode.PROPOSE).meet()
    story.see(n_windows=3)
    story.make("cm-1", wanted=True, sha256="cd" * 32)
    assert story.matrix_state("cm-1") is MatrixState.PUBLISHED
    story.tell(acknowledged("cm-1", state="rejected", reason="id", sha256=OTHER_SHA))
    assert story.matrix_state("cm-1") is MatrixState.PUBLISHED
    story.tell(acknowledged("cm-1", state="rejected", reason="range", sha256="cd" * 32))
    assert story.matrix_state("cm-1") is MatrixState.REJECTED


class TestUndeclared:
    @pytest.fixture
    def story(self, monkeypatch):
        monkeypatch.setattr(transitions, "report_undeclared", REPORT)
        story = Story(Mode.PROPOSE).meet()
        story.see(n_windows=3)
        return story.use("cm-1")

    def changed(self, story, act):
        context = StepContext(story.state, POLICY, story.now_ns, "cause-7")
        act(context)
        return context

    def test_it_is_not_made_but_logged_with_both_states_and_the_cause(self, story):
        context = self.changed(
            story,
            lambda it: reconstructors.change_state(it, "cm-1", MatrixState.PUBLISHED, "a fault"),
        )
        assert context.state.used.state is MatrixState.APPLIED
        assert context.state.used.reason != "a fault"
        (line,) = [line for line in context.state.log if line.name == "transition.undeclared"]
        for part in ("cm-1", "applied", "published", "cause-7"):
            assert part in line.text
        assert context.state.alarm(alarms.UNDECLARED) is not None

    def test_nothing_is_sent_for_it(self, story):
        context = self.changed(story, lambda it: reconstructors.send(it, "cm-1"))
        assert not context.effects

    def test_the_service_goes_on_and_the_alarm_ends(self, story):
        story.state = self.changed(
            story,
            lambda it: reconstructors.change_state(it, "cm-1", MatrixState.STAGED, "a fault"),
        ).state
        story.tell(ev.Tick(), 1.0)
        assert alarms.UNDECLARED in story.alarms
        story.use("cm-2")
        assert story.matrix_state("cm-2") is MatrixState.APPLIED
        story.wait(REPEATED_ALARM_TIMEOUT_S + 1.0)
        assert alarms.UNDECLARED not in story.alarms


def test_it_fails_a_test():
    story = Story(Mode.PROPOSE).meet()
    story.see(n_windows=3)
    story.use("cm-1")
    context = StepContext(story.state, POLICY, story.now_ns)
    with pytest.raises(AssertionError, match="no declared transition"):
        reconstructors.change_state(context, "cm-1", MatrixState.STAGED, "a fault")


def test_a_reply_that_is_late_does_not_lose_a_stored_measurement():
    story = Story(Mode.PROPOSE).meet()
    strokes = {"modes": (3,), "amplitude_m": (1e-9,), "frequency_hz": (60.0,), "duration_s": 1.0}
    request = MeasureRequest(id="im-1", pattern=Pattern.SINE, n_average=None, **strokes)
    stored = MeasurementRecord(
        id="im-1",
        state=MeasureState.STORED,
        pattern=Pattern.SINE,
        modes=(3,),
        amplitude_m=(1e-9,),
        n_slopes=10,
    )
    story.tell(ev.MatrixMeasured(record=stored))
    story.tell(ev.JobFailed(effect=ev.Ask(request=request), text="no answer within 5 s"))
    assert story.state.measurement("im-1").state is MeasureState.STORED


@pytest.mark.parametrize("kind", TABLES, ids=lambda kind: kind.__name__)
def test_each_table_has_all_states_and_all_can_be_reached(kind):
    (machine,) = [machine for machine in MACHINES if machine.states is kind]
    reached = set(machine.first)
    for _ in kind:
        reached |= {after for before in reached for after in TABLES[kind][before]}
    assert reached == set(TABLES[kind]) == set(kind) == set(machine.seen)
    assert all(before not in after for before, after in TABLES[kind].items())


@pytest.mark.parametrize("stage", sorted(UNDER_WAY))
def test_an_acquisition_can_be_ended_in_every_stage(stage):
    ends = {AcquisitionStage.FAILED, AcquisitionStage.ABORTED, AcquisitionStage.INTERRUPTED}
    assert all(is_declared(stage, end) for end in ends)


def test_a_restart_changes_states_as_declared():
    for before in MatrixState:
        (after,) = resume.restored((record("cm-1", before),))
        assert is_declared(before, after.state)


def test_a_diagram_has_an_arrow_for_each_transition():
    for machine in MACHINES:
        n_transitions = sum(map(len, TABLES[machine.states].values()))
        assert draw(machine).count(' z"') == n_transitions
