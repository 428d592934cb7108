"""Every command in every activity: all comes to an end, or the command is refused in one line."""

from dataclasses import replace

import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import Alarm
from service.records.messages import as_message
from service.records.operations import Acquisition, AcquisitionStage, MeasureState
from service.records.state import Mode
from service.tracking.operations.running import (
    CurrentOperation,
    ServiceState,
    operating,
    running_operations,
)
from service.wire import Loop, Pattern
from tests.support.activities import (
    ACTIVITIES,
    COMMANDS,
    LONGEST_S,
    gathering,
    measuring,
    others_dither,
    ramping,
    refused,
    strands,
    waiting_for_a_noisy_one,
)
from tests.support.situations import POLICY, Story, rtc
from tests.support.states import changed
from tests.support.world import World


@pytest.mark.parametrize("activity", ACTIVITIES, ids=lambda activity: activity.__name__)
def test_it_is_carried_out_and_all_ends_or_it_is_refused_in_one_line(activity):
    left_alone = ended(activity())
    for command in COMMANDS:
        world = activity()
        refusal = refused(world, command)
        assert "\n" not in refusal, command
        # refused, it has changed nothing: all goes on as if nothing had been said
        after = left_alone if refusal else ended(world)
        assert not strands(after), command
        assert not [entry.text for entry in after.state.log if "busy: " in entry.text], command


def ended(world):
    """Let everything come to its end, or the longest time pass."""
    passed_s = 0
    while strands(world) and passed_s < LONGEST_S:
        world.pass_(5.0)
        passed_s += 5
    return world


@pytest.mark.parametrize("activity", ACTIVITIES[1:], ids=lambda activity: activity.__name__)
def test_what_runs_is_named_with_what_ends_it(activity):
    world = activity()
    running = running_operations(world.state, world.now_ns)
    assert running
    assert all("; " in one.text for one in running)
    assert all("\n" not in one.text for one in running)


REFUSED = [
    (measuring, "im-1", [cmd.Acquire(), cmd.SetLoop(loop="open"), cmd.Ramp(), cmd.Refit()]),
    (
        gathering,
        "noisy-1",
        [
            cmd.Acquire(),
            cmd.SetLoop(loop="open"),
            cmd.Ramp(),
            cmd.StartDither(),
            cmd.Measure(id="im-9", pattern=Pattern.PUSH_PULL_MODAL),
            cmd.MeasureNoisy(id="noisy-9"),
        ],
    ),
    (
        ramping,
        "open the loop to end it",
        [
            cmd.Acquire(),
            cmd.SetLoop(gains=(cmd.GainGroup(first=0, last=399, gain=0.3),)),
            cmd.Ramp(),
            cmd.StartDither(),
            cmd.Measure(id="im-9", pattern=Pattern.PUSH_PULL_MODAL),
            cmd.MeasureNoisy(id="noisy-9"),
        ],
    ),
    (
        others_dither,
        "of-another-program is running; stop it first",
        [cmd.MeasureNoisy(id="noisy-9"), cmd.StartDither()],
    ),
]


def test_a_gain_ramp_ends_when_the_loop_is_opened():
    world = ramping()
    world.tell(cmd.SetLoop(loop="open"))
    world.pass_(2.0)
    assert world.state.loop.rtc.loop == "open"
    assert not running_operations(world.state, world.now_ns)


def test_while_gains_are_tried_nothing_is_made_sent_or_dithered():
    world = ramping()
    world.tell(cmd.SetMode(mode=Mode.AUTO))
    world.effects.clear()
    world.pass_(15.0)
    assert not world.effects
    world.pass_(10.0)
    assert not running_operations(world.state, world.now_ns)


def test_a_loop_that_goes_out_of_hand_while_signs_are_gathered_takes_the_dither_with_it():
    world = World(Mode.AUTO, replace(POLICY, acquires=True))
    world.pass_(20.0)
    world.tell(cmd.MeasureNoisy(id="noisy-1", duration_s=60.0))
    world.pass_(5.0)
    world.tell(ev.ConditionChanged(name="loop-diverging", text="found"))
    world.pass_(4.0)
    assert world.state.operations.acquisition.under_way
    (noisy,) = world.state.noisy
    assert noisy.state is MeasureState.FAILED
    assert "acquisition" in noisy.reason


def test_a_stopped_dither_ends_the_wait_for_one_that_measures():
    world = waiting_for_a_noisy_one()
    world.tell(cmd.StopDither())
    (noisy,) = world.state.noisy
    assert noisy.state is MeasureState.FAILED
    assert "stopped" in noisy.reason
    assert not world.pass_(20.0).playing


def test_a_ramp_nobody_answers_for_keeps_nothing_back_for_ever():
    story = Story().meet()
    story.tell(cmd.Ramp())
    assert running_operations(story.state, story.now_ns)
    story.wait(60.0)
    assert not [one for one in running_operations(story.state, story.now_ns) if "ramp" in one.text]


# --- what the service is in, in a control room's words: derived from what runs and what is wron


@pytest.fixture
def story():
    told = Story(Mode.AUTO).meet()
    told.see(n_windows=2)
    return told


def found(state, hindered="", now_ns=0):
    here = operating(state, hindered, now_ns)
    return here.service_state, here.current_operation, here.because


def alarmed(state, *names):
    raised = tuple(
        Alarm(name=name, since_ns_utc=1, message=as_message("x", f"{name} found")) for name in names
    )
    return changed(state, active=raised)


def test_a_closed_loop_with_a_known_registration_is_tracked(story):
    here = operating(story.state, "", story.now_ns)
    assert here.words == "Operational, Tracking"


def test_without_a_closed_loop_it_is_ready_and_says_what_for(story):
    gone = changed(story.state, rtc=None, active=())
    assert found(gone) == (ServiceState.READY, CurrentOperation.IDLE, "no RTC is there")
    opened = changed(story.state, rtc=rtc(loop=Loop.OPEN), active=())
    assert found(opened) == (ServiceState.READY, CurrentOperation.IDLE, "the loop is open")


def test_what_is_not_known_yet_is_not_tracked():
    fresh = Story(Mode.AUTO).meet()
    assert found(fresh.state)[:2] == (ServiceState.OPERATIONAL, CurrentOperation.IDLE)


def test_what_has_the_mirror_is_what_it_does_whatever_the_loop(story):
    acquiring = Acquisition(stage=AcquisitionStage.COARSE, text="looking")
    looking = changed(story.state, rtc=rtc(loop=Loop.OPEN), acquisition=acquiring)
    assert found(looking)[:2] == (ServiceState.OPERATIONAL, CurrentOperation.ACQUIRING)
    stopped = changed(story.state, stopped_because="Ada stopped it")
    assert found(stopped)[:2] == (ServiceState.READY, CurrentOperation.HOLD)
    assert "Ada stopped it" in found(stopped)[2]
    assert found(changed(story.state, mode=Mode.HOLD))[1] is CurrentOperation.HOLD


def test_the_worst_alarm_and_what_hinders_say_whether_it_does_its_work(story):
    state = story.state
    assert found(alarmed(state, "loop-open"))[0] is ServiceState.OPERATIONAL
    serious = alarmed(state, "loop-open", "margin")
    assert found(serious) == (ServiceState.DEGRADED, CurrentOperation.TRACKING, "margin found")
    assert found(serious, "no worker")[::2] == (ServiceState.NOT_READY, "no worker")
    critical = alarmed(state, "margin", "edge-slip")
    assert found(critical, "no worker")[::2] == (ServiceState.ERROR, "edge-slip found")


def test_a_muted_alarm_is_the_matter_all_the_same(story):
    story.tell(ev.ConditionChanged(name="edge-slip", text="found"))
    before = found(story.state, now_ns=story.now_ns)
    story.tell(cmd.MuteAlarm(name="edge-slip", for_s=60.0))
    assert found(story.state, now_ns=story.now_ns) == before
