"""Acknowledged, muted, gone unseen: what operators do about alarms, told to the tracker."""

from dataclasses import replace

import pytest

from service.archive.serialisation import TrackingFile
from service.errors import CommandError, UnknownIdError
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.alarm_records import muted_records, stale_records, worst_severity
from service.tracking.alarms import ALARMS, AlarmState, Interlock, Severity, blocking_alarm
from service.tracking.resume import resumed, saved_of
from service.tracking.state import TrackerState
from tests.unit.tracking.situations import POLICY, Story, judged, verdict

ADA = {"by": "Ada", "reason": "seen"}


@pytest.fixture
def story():
    told = Story().meet()
    told.tell(ev.Tick())
    return told


def raised(story, name, *, over=False):
    story.tell(ev.ConditionChanged(name=name, text=f"{name} found", over=over))


def note(story, name):
    return next((note for note in story.state.alarms.records if note.name == name), None)


def restarted(story, tmp_path):
    """What the next service knows, of what was left on the disk."""
    file = TrackingFile(tmp_path / "tracking.json")
    file.write(saved_of(story.state, story.now_ns))
    again = Story()
    again.state = resumed(TrackerState(system="small"), file.read(), POLICY, story.now_ns)
    again.now_ns = story.now_ns
    return again


@pytest.fixture
def small(story):
    story.state = replace(story.state, system="small")
    return story


def test_one_that_goes_unseen_is_stale_until_somebody_has_seen_it(story):
    raised(story, "edge-slip")
    assert note(story, "edge-slip").alarm_state is AlarmState.ACTIVE
    raised(story, "edge-slip", over=True)
    (left,) = stale_records(story.state)
    assert (left.text, left.worst) == ("edge-slip found", Severity.CRITICAL)
    assert left.over_ns_utc == story.now_ns
    story.wait(20)
    assert stale_records(story.state) == (left,)
    story.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))
    assert note(story, "edge-slip") is None
    assert story.state.log[-1].text == "edge-slip by Ada (seen)"


def test_one_that_is_acknowledged_stays_while_it_lasts_and_is_then_done_with(story):
    raised(story, "edge-slip")
    story.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))
    assert "edge-slip" in story.alarms
    seen = note(story, "edge-slip").acknowledged
    assert (seen.by, seen.reason, seen.t_ns_utc) == ("Ada", "seen", story.now_ns)
    raised(story, "edge-slip")
    assert note(story, "edge-slip").alarm_state is AlarmState.ACKNOWLEDGED
    raised(story, "edge-slip", over=True)
    assert story.state.alarms.records == ()
    raised(story, "edge-slip")
    assert note(story, "edge-slip").alarm_state is AlarmState.ACTIVE


def test_the_worst_is_kept_and_what_becomes_worse_is_acknowledged_again(story):
    story.see(n_windows=2)
    story.use("cm-1")

    def margin(radius):
        found = verdict(accepted=False, radius=radius)
        story.tell(ev.MarginJudged(id="cm-1", verdict=found, judged=judged_now(story)))

    margin(0.97)
    assert note(story, "margin").worst is Severity.SERIOUS
    story.tell(cmd.AcknowledgeAlarm(name="margin", severity=Severity.SERIOUS, **ADA))
    margin(1.02)
    assert note(story, "margin").alarm_state is AlarmState.ACTIVE
    margin(0.97)
    assert note(story, "margin").worst is worst_severity(story.state) is Severity.CRITICAL
    assert (
        next(a for a in story.state.alarms.active if a.name == "margin").definition
        is ALARMS["margin"]
    )
    with pytest.raises(CommandError, match="margin has been critical, and serious was seen"):
        story.tell(cmd.AcknowledgeAlarm(name="margin", severity=Severity.SERIOUS))
    story.tell(cmd.AcknowledgeAlarm(name="margin", severity=Severity.CRITICAL))


def judged_now(story):
    return judged(story.state.alpha.registration, story.state.loop.rtc)


def test_what_an_operators_order_ends_has_been_seen(story):
    story.tell(cmd.StopEverything())
    story.tell(cmd.Resume(**ADA))
    assert story.state.alarms.records == ()


def test_what_makes_no_sense_is_refused_in_a_sentence(story):
    with pytest.raises(UnknownIdError, match="unknown alarm nonsense"):
        story.tell(cmd.AcknowledgeAlarm(name="nonsense"))
    with pytest.raises(CommandError, match="edge-slip neither lasts nor is stale"):
        story.tell(cmd.AcknowledgeAlarm(name="edge-slip"))
    with pytest.raises(CommandError, match="edge-slip is not muted"):
        story.tell(cmd.UnmuteAlarm(name="edge-slip"))
    raised(story, "edge-slip")
    story.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))
    with pytest.raises(CommandError, match="edge-slip was acknowledged by Ada"):
        story.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))


def test_a_muted_one_forbids_what_it_forbids_and_comes_back_by_itself(story):
    story.tell(cmd.MuteAlarm(name="matrix-mismatch", for_s=60.0, **ADA))
    raised(story, "matrix-mismatch")
    (quiet,) = muted_records(story.state)
    assert (quiet.name, quiet.alarm_state) == ("matrix-mismatch", AlarmState.ACTIVE)
    assert blocking_alarm(story.state.alarms.active, Interlock.SEND_NEW).name == "matrix-mismatch"
    story.wait(61)
    assert muted_records(story.state) == ()
    assert note(story, "matrix-mismatch").alarm_state is AlarmState.ACTIVE


def test_one_muted_before_it_comes_can_be_unmuted(story):
    story.tell(cmd.MuteAlarm(name="rtc-vanished", for_s=60.0))
    story.tell(cmd.UnmuteAlarm(name="rtc-vanished"))
    assert story.state.alarms.records == ()


def test_a_restart_changes_nothing_of_what_was_seen_and_what_was_not(small, tmp_path):
    for name in ("edge-slip", "frames-lost", "disk-low"):
        raised(small, name)
    raised(small, "disk-low", over=True)
    small.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))
    small.tell(cmd.MuteAlarm(name="second-rtc", for_s=3600.0, **ADA))
    again = restarted(small, tmp_path)
    assert {left.name for left in stale_records(again.state)} == {"disk-low", "frames-lost"}
    assert [quiet.name for quiet in muted_records(again.state)] == ["second-rtc"]
    raised(again, "edge-slip")
    assert note(again, "edge-slip").alarm_state is AlarmState.ACKNOWLEDGED
    raised(again, "frames-lost")
    assert note(again, "frames-lost").alarm_state is AlarmState.ACTIVE


def test_what_was_acknowledged_and_is_not_raised_again_after_a_restart_is_over(small, tmp_path):
    raised(small, "edge-slip")
    small.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))
    again = restarted(small, tmp_path)
    again.wait(30)
    assert note(again, "edge-slip") is not None
    again.wait(40)
    assert note(again, "edge-slip") is None


def test_what_lasts_without_news_costs_the_disk_nothing(story):
    raised(story, "frames-unused")
    before = story.state.alarms.records
    for k in range(5):
        story.tell(ev.ConditionChanged(name="frames-unused", text=f"{k} frames"))
        story.wait(1)
    assert story.state.alarms.records is before
