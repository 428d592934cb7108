"""What the service is in, in a control room's words: derived from what runs and what is wrong."""

import pytest

from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.alarms import Alarm
from service.tracking.operation_records import Acquisition, AcquisitionStage
from service.tracking.operations.running import CurrentOperation, ServiceState, operating
from service.tracking.state import Mode
from service.wire import Loop
from tests.states import changed
from tests.unit.tracking.situations import Story, rtc


@pytest.fixture
def story():
    told = Story(Mode.AUTO).meet()
    told.see(n_windows=2)
    return told


def found(state, hindered="", now_ns=0):
    here = operating(state, hindered, now_ns)
    return here.service_state, here.current_operation, here.because


def alarmed(state, *names):
    raised = tuple(Alarm(name=name, since_ns_utc=1, text=f"{name} found") for name in names)
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
