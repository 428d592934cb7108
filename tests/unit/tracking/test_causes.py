"""Whatever an order leads to carries its id: effects, lines of the log, records, and failures."""

import pytest

from service.errors import CommandError
from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import MeasureState
from service.records.state import Mode
from service.wire import DitherRequest, Reply
from tests.support.activities import idle, sending
from tests.support.situations import START_NS, Story, rtc

DITHER = (DitherRequest, "noisy-1")
SOME_NS = 1_795_574_159_123_456_000


def lines(world, cause):
    return [line.name for line in world.state.log if line.cause == cause]


def ordered(world, command, cause="order-1"):
    before = {line.line for line in world.state.log}
    effects = world.tell(command, cause=cause)
    assert {effect.cause for effect in effects} <= {cause}
    assert {line.cause for line in world.state.log if line.line not in before} <= {cause}
    return effects


def test_an_id_says_of_what_and_when():
    assert ev.new_id(ev.kebab(cmd.SetMode), SOME_NS) == "set-mode-20261125T023559.123456"


def test_what_happens_by_itself_is_its_own_cause():
    story = Story()
    (fetch, *_) = [*story.tell(ev.SessionStarted(session="s1")), *story.tell(rtc())]
    assert fetch.cause == ev.new_id("status", START_NS)
    assert story.state.log[0].cause == ev.new_id("session-started", START_NS)


def test_all_the_way_of_a_rollback_goes_back_to_its_order():
    world = idle()
    ordered(world, cmd.Rollback(), "rollback-1")
    world.pass_(2.0)
    copy = world.state.matrices.reconstructors[-1]
    assert copy.cause == "rollback-1"
    ways = ["mode", "reconstructor.made", "reconstructor.published", "reconstructor.applied"]
    assert [name for name in lines(world, "rollback-1") if name in ways] == ways


def test_who_sends_what_another_has_made_is_the_cause_from_then_on():
    world = idle()
    ordered(world, cmd.Refit(), "refit-1")
    world.pass_(1.0)
    made = world.state.matrices.reconstructors[-1]
    assert made.cause == "refit-1"
    ordered(world, cmd.Approve(id=made.id), "approve-1")
    world.pass_(1.0)
    assert world.state.reconstructor(made.id).cause == "approve-1"
    assert "reconstructor.applied" in lines(world, "approve-1")
    assert "reconstructor.made" in lines(world, "refit-1")


def test_an_acquisition_goes_back_to_its_order_to_the_end():
    world = idle()
    ordered(world, cmd.Acquire(), "acquire-1")
    world.pass_(120.0)
    told = lines(world, "acquire-1")
    assert {"acquisition.begun", "acquisition.confirming", "acquisition.tracking"} <= {*told}


def test_a_status_in_between_is_not_the_acquisitions():
    world = idle()
    world.tell(cmd.Acquire(), cause="acquire-1")
    world.tell(cmd.SetMode(mode=Mode.HOLD), cause="mode-1")
    assert lines(world, "mode-1") == ["mode"]


def test_a_noisy_matrix_goes_back_to_its_order_though_its_dither_waits():
    world = idle()
    ordered(world, cmd.MeasureNoisy(id="noisy-1", duration_s=10.0), "noisy-order")
    world.pass_(20.0)
    record = world.state.measurement("noisy-1")
    assert (record.state, record.cause) == (MeasureState.STORED, "noisy-order")
    assert lines(world, "noisy-order")[0] == "noisy-matrix.asked"
    assert lines(world, "noisy-order")[-1] == "noisy-matrix.stored"
    asked = [each for each in world.effects if isinstance(each, ev.Ask)]
    (played,) = [one for one in asked if (type(one.request), one.request.id) == DITHER]
    assert played.cause == "noisy-order"


def test_a_matrix_that_the_rtc_measures_goes_back_to_its_order():
    world = idle()
    ordered(world, cmd.Measure(id="im-1"), "measure-1")
    world.pass_(10.0)
    assert world.state.measurement("im-1").state is MeasureState.STORED
    names = ["measurement.asked", "measurement.running", "measurement.stored"]
    assert [name for name in lines(world, "measure-1") if name.startswith("measurement")] == names


@pytest.mark.parametrize(
    ("command", "of"),
    [(cmd.StartDither(), "dither"), (cmd.SetLoop(leak=0.99), "command"), (cmd.Ramp(), "command")],
)
def test_what_is_asked_of_the_rtc_knows_its_order(command, of):
    world = idle()
    ordered(world, command)
    asked = getattr(world.state.dithers if of == "dither" else world.state.loop, of)
    assert asked.cause == "order-1"


def test_what_came_to_nothing_is_kept_for_whoever_ordered_it():
    world = idle()
    (asked, *_) = ordered(world, cmd.StartDither())
    reply = Reply(id=asked.request.id, accepted=False, reason="busy: other", start_seq=None)
    assert not world.state.failure("order-1")
    world.tell(ev.Answered(request=asked.request, reply=reply), cause=asked.cause)
    assert world.state.failure("order-1") == "the RTC refused the dither: busy: other"
    assert not world.state.failure("order-2")


def test_a_verdict_that_cannot_be_had_ends_the_order_that_waits_for_it():
    world = sending()
    record = world.state.matrices.reconstructors[-1]
    effect = ev.JudgeProposal(id=record.id, gains=(), cause="approve-1")
    world.tell(ev.JobFailed(effect=effect, text="the worker died"), cause=effect.cause)
    assert world.state.failure("approve-1") == "the worker died"


def test_two_effects_that_differ_in_their_cause_alone_are_one():
    assert ev.JudgeMatrix(id="cm-1", cause="a") == ev.JudgeMatrix(id="cm-1", cause="b")


def test_a_refusal_leaves_nothing_behind():
    world = idle()
    before = world.state
    with pytest.raises(CommandError):
        world.tell(cmd.AbortAcquisition(), cause="abort-1")
    assert world.state is before
