"""Whole stories: what the service does, event after event, as a pure function of them."""

from types import NoneType
from typing import get_args, get_type_hints

import numpy as np
import pytest

from service import wire
from service.records import alarms
from service.records import events as ev
from service.records.events import Event
from service.records.products import MatrixState
from service.records.state import Mode
from service.tracker import ANSWERS, DECIDERS, FAILURES, REACTIONS, step
from service.tracking.step_context import StepContext
from service.wire import DitherRequest
from tests.support.activities import (
    acquiring,
    gathering,
    idle,
    measuring,
    ramping,
    stopped,
    waiting_for_a_noisy_one,
)
from tests.support.situations import ALPHA, POLICY, Story, dither_answered, moved, of_kind, rtc
from tests.support.states import tracker_state


def apply_what_is_sent(story, effects, n_modes):
    """Play the RTC's part of a publication: the mode number first, then the swap."""
    (sent,) = of_kind(effects, ev.SendMatrix)
    story.acknowledge(sent.id, MatrixState.STAGED)
    story.acknowledge(sent.id)
    playing = story.state.dithers.dither and story.state.dithers.dither.id
    story.tell(rtc(n_modes, cm_id=sent.id, dither_id=playing))


def test_the_main_job_in_auto():
    story = Story(Mode.AUTO)
    story.meet()
    dither = story.asked(DitherRequest)[0]
    story.tell(dither_answered(dither.id, accepted=True, reason="", start_seq=10))
    story.see(n_windows=2)
    assert [effect.n_modes for effect in story.asked(ev.MakeMatrix)] == [400]
    apply_what_is_sent(story, story.make("cm-1"), 400)
    story.wait(6)
    assert [effect.n_modes for effect in story.asked(ev.MakeMatrix)] == [400, 500]
    apply_what_is_sent(story, story.make("cm-2", n_modes=500), 500)
    assert story.state.matrices.in_use == "cm-2"
    assert [record.state for record in story.state.matrices.reconstructors] == [
        MatrixState.SUPERSEDED,
        MatrixState.SUPERSEDED,
        MatrixState.APPLIED,
    ]
    assert not story.alarms
    assert story.state.alpha.registration.alpha == ALPHA


def test_after_a_jump_the_loop_gets_a_reconstructor_for_the_new_place():
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=2)
    apply_what_is_sent(story, story.make("cm-1"), 400)
    story.wait(10)
    before = len(story.asked(ev.MakeMatrix))
    there = moved(shift_x_subap=0.2)
    story.make("cm-2", MatrixState.REFUSED)
    story.see(there, n_windows=20)
    last = story.asked(ev.MakeMatrix)[before:]
    assert [effect.n_modes for effect in last] == [400]
    assert "moved by +0.2" in last[0].why
    assert story.state.alpha.registration.alpha.shift_x_subap == pytest.approx(0.32, abs=0.003)


def test_a_restarted_rtc_gets_its_reconstructors_again():
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=2)
    apply_what_is_sent(story, story.make("cm-1"), 400)
    story.tell(ev.RtcVanished(), after_s=10)
    story.wait(20)
    story.meet(session="s2")
    assert story.state.matrices.in_use == "initial"
    assert story.state.alpha.registration.alpha == ALPHA
    dithers = story.asked(DitherRequest)
    assert dithers[-1].id != dithers[0].id
    (made,) = of_kind(story.see(n_windows=2), ev.MakeMatrix)
    assert made.n_modes == 400
    (sent,) = of_kind(story.make("cm-2"), ev.SendMatrix)
    assert sent.id == "cm-2"


def test_a_restarted_service_knows_the_matrix_it_once_made():
    shelf = Story(Mode.AUTO).meet().use("cm-1").state.matrices.reconstructors
    again = Story(Mode.AUTO, state=tracker_state(system="flao", reconstructors=shelf[1:]))
    again.tell(ev.SessionStarted(session="s1"))
    again.tell(rtc(cm_id="cm-1"))
    assert again.asked(ev.FetchMatrix) == [ev.FetchMatrix(id="cm-1")]
    assert again.state.matrices.in_use == "cm-1"
    assert again.state.reconstructor("cm-1").parent == "initial"


def test_a_step_leaves_the_state_it_was_given_as_it_was():
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=2)
    before = story.state
    covariance = before.alpha.registration.covariance.copy()
    n_logged, n_records = len(before.log), len(before.matrices.reconstructors)
    after, _ = step(before, ev.RtcVanished(), POLICY, story.now_ns)
    assert after.loop.rtc is None
    assert (len(before.log), len(before.matrices.reconstructors)) == (n_logged, n_records)
    np.testing.assert_array_equal(before.alpha.registration.covariance, covariance)
    assert before.loop.rtc is not None


def test_there_is_a_reaction_to_every_event_and_command_and_to_nothing_else():
    requests = set(get_args(wire.Command))
    assert set(REACTIONS) == set(get_args(Event))
    assert set(ANSWERS) == requests
    assert set(FAILURES) == (set(get_args(ev.Effect)) - {ev.Ask}) | requests


def test_every_function_of_a_table_says_what_it_does():
    functions = [decider.decide for decider in DECIDERS]
    functions += [guard for decider in DECIDERS for guard in decider.guards]
    for table in (REACTIONS, ANSWERS, FAILURES):
        assert all(table.values())
        functions += [react for reactions in table.values() for react in reactions]
    for function in functions:
        assert function.__name__ != "<lambda>", function
        assert function.__doc__, function


def test_deciders_and_guards_are_not_given_the_event():
    for name, guards, decide in DECIDERS:
        assert list(get_type_hints(decide).values()) == [StepContext, NoneType], name
        for guard in guards:
            assert list(get_type_hints(guard).values()) == [StepContext, bool], name


ALWAYS = {"a restored α", "the pointing law", "windows in a row", "the probation", "alarms"}
ALWAYS |= {"alarms of what was decided"}
OF_SERVICE = {"the dither", "reconstructors", "references", "the offload"}
IN_USE = {"the RTC's matrix", "references in use"}
REST = {
    *IN_USE,
    "the acquisition",
    "a noisy matrix",
    "unwanted dithers",
}


STANDBY = ev.ServicesMet(drives=False, others=("the service on pyrcal-2",))
DIVERGING = ev.ConditionChanged(name=alarms.DIVERGING, text="the loop diverges")


@pytest.mark.parametrize(
    ("activity", "event", "decided"),
    [
        (idle, ev.Tick(), REST | OF_SERVICE),
        (idle, STANDBY, {"the acquisition", "a noisy matrix"}),
        (idle, ev.RtcVanished(), {"the acquisition", "a noisy matrix"}),
        (idle, DIVERGING, REST),
        (measuring, ev.Tick(), set()),
        (stopped, ev.Tick(), {*IN_USE, "unwanted dithers"}),
        (acquiring, ev.Tick(), {*IN_USE, "the acquisition"}),
        (
            waiting_for_a_noisy_one,
            ev.Tick(),
            {*IN_USE, "the acquisition", "a noisy matrix"},
        ),
        (gathering, ev.Tick(), REST | OF_SERVICE),
        (ramping, ev.Tick(), REST),
    ],
)
def test_what_is_decided_during_an_operation(activity, event, decided):
    world = activity()
    world.tell(event)
    context = StepContext(world.state, POLICY, world.now_ns)
    found = {one.name for one in DECIDERS if all(guard(context) for guard in one.guards)}
    assert found - ALWAYS == decided
    assert found >= ALWAYS
