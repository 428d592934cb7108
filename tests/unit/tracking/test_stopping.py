"""Stop everything: whatever runs is ended, nothing else is begun or sent until it is released."""

import pytest

from service.errors import CommandError
from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import AcquisitionStage, MeasureState
from service.records.products import MatrixState
from service.records.state import Mode
from service.tracking.interlocks import ALLOWS
from service.tracking.operations.running import running_operations
from service.tracking.resume import resumed, saved_of
from service.wire import DitherStop, Loop, LoopRequest
from tests.support.acquiring import DIVERGING, Acquiring
from tests.support.activities import (
    ACTIVITIES,
    acquiring,
    gathering,
    idle,
    making,
    measuring,
    own_dither,
    ramping,
    sending,
)
from tests.support.situations import POLICY, of_kind
from tests.support.states import tracker_state
from tests.support.world import World

STOP = cmd.StopEverything(by="Ada", reason="someone is on the platform")


def harmless(effect):
    stop = isinstance(effect, ev.Ask) and isinstance(effect.request, DitherStop)
    return stop or isinstance(effect, ev.FetchMatrix)


def stopped(world):
    """Stop everything; from here on only effects of afterwards are in the list."""
    world.tell(STOP)
    world.effects.clear()
    return world


def alarm(world):
    return next((one for one in world.state.alarms.active if one.name == "stopped"), None)


def test_it_is_allowed_whatever_runs_and_so_is_its_end():
    assert all({cmd.StopEverything, cmd.Resume} <= allowed for allowed in ALLOWS.values())


@pytest.mark.parametrize("activity", ACTIVITIES, ids=lambda activity: activity.__name__)
def test_nothing_is_asked_of_the_rtc_any_more_but_that_dithers_end(activity):
    world = activity()
    world.tell(cmd.SetMode(mode=Mode.AUTO))
    stopped(world).pass_(120.0)
    assert [one for one in world.effects if not harmless(one)] == []
    assert world.playing is None or world.playing.request.id == "of-another-program"


def test_a_dither_ends_at_once():
    assert stopped(own_dither()).pass_(1.0).playing is None


@pytest.mark.parametrize("activity", ACTIVITIES, ids=lambda activity: activity.__name__)
def test_the_rtc_is_asked_once_to_end_a_dither(activity):
    effects = activity().tell(STOP)
    assert len(of_kind(effects, DitherStop)) <= 1


def test_an_acquisition_gives_back_the_loop_and_does_not_begin_again():
    world = acquiring()
    assert world.loop == "open"
    effects = world.tell(STOP)
    assert [one.loop for one in of_kind(effects, LoopRequest)] == [Loop.CLOSED]
    world.pass_(60.0)
    assert world.state.operations.acquisition.stage is AcquisitionStage.ABORTED
    assert world.state.operations.acquisition.held_off
    assert world.loop == "closed"


def test_a_loop_that_diverges_is_acquired_only_once_it_is_released():
    story = Acquiring()
    story.tell(STOP)
    story.tell(DIVERGING)
    story.wait(10)
    assert story.stage is AcquisitionStage.IDLE
    story.tell(cmd.Resume())
    assert story.stage is AcquisitionStage.OPENING


def test_measurements_are_given_up():
    world = stopped(measuring())
    assert world.state.measurement("im-1").state is MeasureState.GIVEN_UP
    world.pass_(10.0)
    assert world.effects == [one for one in world.effects if harmless(one)]
    noisy = stopped(gathering())
    assert noisy.state.measurement("noisy-1").state is MeasureState.GIVEN_UP
    assert noisy.pass_(1.0).playing is None


def test_a_gain_ramp_is_the_rtcs_and_named():
    world = stopped(ramping())
    assert world.pass_(30.0).loop == "closed"


def test_a_matrix_that_was_being_made_is_kept_and_not_sent():
    world = making()
    world.tell(cmd.SetMode(mode=Mode.AUTO))
    stopped(world).pass_(10.0)
    assert world.state.matrices.reconstructors[-1].state is MatrixState.PROPOSED
    assert world.state.matrices.in_use == "cm-1"


def test_one_that_is_on_its_way_cannot_be_called_back():
    world = sending()
    name = world.state.matrices.reconstructors[-1].id
    stopped(world).pass_(3.0)
    assert world.state.matrices.in_use == name


@pytest.mark.parametrize(
    "command",
    [
        cmd.Refit(),
        cmd.StartDither(),
        cmd.Acquire(),
        cmd.Rollback(),
        cmd.SetLoop(loop="closed"),
        cmd.Measure(id="im-9"),
    ],
)
def test_a_command_is_refused_with_who_stopped_it_and_how_it_is_released(command):
    with pytest.raises(CommandError, match=r"stopped by Ada \(someone.*release the stop"):
        stopped(idle()).tell(command)


def test_the_loop_may_be_opened_while_everything_is_stopped():
    """Alarms ask for it; it is no reason to release the stop, which would begin more."""
    world = stopped(idle())
    effects = world.tell(cmd.SetLoop(loop="open"))
    assert [request.loop for request in of_kind(effects, LoopRequest)] == [Loop.OPEN]
    assert world.state.operator.stopped_because


def test_released_it_goes_on_as_it_was_ordered_before():
    world = World(Mode.AUTO)
    world.pass_(6.0)
    assert world.playing is not None
    stopped(world).pass_(20.0)
    assert world.playing is None
    world.tell(cmd.Resume(by="Ada"))
    assert alarm(world) is None
    assert world.state.operator.mode is Mode.AUTO
    world.pass_(6.0)
    assert world.playing is not None


def test_only_what_is_stopped_is_released():
    world = idle()
    with pytest.raises(CommandError, match=r"nothing is stopped$"):
        world.tell(cmd.Resume())
    world.tell(cmd.SetMode(mode=Mode.HOLD))
    with pytest.raises(CommandError, match="nothing is stopped; mode is hold: set another"):
        world.tell(cmd.Resume())


def test_who_stopped_it_first_is_remembered():
    world = stopped(idle())
    world.tell(cmd.StopEverything(by="Bob"))
    assert "Ada" in world.state.operator.stopped_because


def test_a_restart_releases_nothing():
    world = stopped(idle())
    saved = saved_of(world.state, world.now_ns)
    fresh = tracker_state(system=world.state.system, mode=Mode.AUTO)
    world.state = resumed(fresh, saved, POLICY, world.now_ns)
    assert "Ada" in alarm(world).text
    world.pass_(30.0)
    assert [one for one in world.effects if not harmless(one)] == []
    world.tell(cmd.Resume())
    assert not world.state.operator.stopped_because
    assert not [
        one for one in running_operations(world.state, world.now_ns) if "stopped" in one.text
    ]


def test_it_stays_so_while_the_rtc_is_away_and_comes_back():
    world = stopped(own_dither())
    world.tell(ev.RtcVanished())
    world.tell(STOP)
    world.begin_session()
    world.pass_(20.0)
    assert alarm(world) is not None
    assert [one for one in world.effects if not harmless(one)] == []


def test_released_at_once_it_takes_no_dither_for_its_own_that_is_about_to_end():
    world = own_dither()
    world.tell(STOP)
    world.tell(cmd.Resume())
    world.pass_(20.0)
    assert not [entry.text for entry in world.state.log if "busy: " in entry.text]
    assert world.playing is not None


def test_a_dither_that_was_told_to_end_is_not_taken_for_one_that_runs():
    world = own_dither()
    world.tell(STOP)
    world.tell(cmd.Resume())
    assert world.state.loop.rtc.dither_id is not None
    assert world.state.dithers.dither is None
