"""Frames that are lost, or come ever later, become an alarm."""

import pytest

from service.records.alarms import Alarm
from service.records.state import TrackerState
from service.runtime.losses import Losses, silence
from service.runtime.readiness import detect_link_changes
from tests.support.situations import START_NS, rtc
from tests.support.states import changed
from tests.support.waiting import SECOND, WELL, disposition, link


class Counting:
    """A link at 1 kHz whose counters are looked at once a second; a share of its frames is lost."""

    def __init__(self):
        self.losses, self.now_s = Losses(), 100.0
        self.received = self.lost = self.nonfinite = self.overwritten = 0

    def pass_(self, seconds, *, come=1000, lost=0, nonfinite=0, overwritten=0):
        said = ""
        for _ in range(seconds):
            self.now_s += 1.0
            self.received += come - lost - nonfinite
            self.lost += lost
            self.nonfinite += nonfinite
            self.overwritten += overwritten
            counted = link(
                *WELL,
                frames_received=self.received,
                frames_lost=self.lost,
                frames_nonfinite=self.nonfinite,
                frames_overwritten=self.overwritten,
            )
            said = self.losses.complaint(counted, self.now_s)["frames-lost"]
        return said


@pytest.mark.parametrize(
    ("how", "n_frames", "details"),
    [
        ({"lost": 20}, 5000, "100 never came"),
        ({"nonfinite": 20}, 5000, "100 are not finite"),
        ({"overwritten": 20}, 5000, "100 were not read in time"),
    ],
)
def test_more_than_one_frame_in_a_hundred_lost_over_five_seconds_is_named(how, n_frames, details):
    counting = Counting()
    assert not counting.pass_(20)
    found = counting.pass_(5, **how).values
    assert (found["n_frames"], found["percent"]) == (n_frames, pytest.approx(2.0, abs=0.05))
    assert found["details"] == details


def test_a_few_lost_frames_are_nothing_and_what_was_recovered_is_not_lost():
    counting = Counting()
    assert not counting.pass_(20, lost=9)
    counting.lost += 200  # a hole, filled before the next look
    counting.lost -= 200
    assert not counting.pass_(1)
    assert not Counting().pass_(4, lost=500), "less than five seconds are no measure"


def test_a_complaint_of_losses_ends_only_with_half_as_many():
    counting = Counting()
    assert counting.pass_(10, lost=12)
    assert counting.pass_(20, lost=8), "it does not flicker about the limit"
    assert not counting.pass_(10, lost=4)
    assert not counting.pass_(20, lost=8)


def test_lost_frames_are_an_alarm_that_ends_by_itself():
    state = TrackerState(system="small")
    text = Counting().pass_(10, lost=50)
    (made,) = detect_link_changes(link(*WELL), state, START_NS, {"frames-lost": text})
    assert made.name == "frames-lost"
    alarm = Alarm(name=made.name, since_ns_utc=0, message=made.text, seen_ns_utc=START_NS)
    state = changed(state, active=(alarm,))
    assert detect_link_changes(link(*WELL), state, START_NS + 2 * SECOND) == []
    (over,) = detect_link_changes(link(*WELL), state, START_NS + 4 * SECOND)
    assert (over.name, over.over) == ("frames-lost", True)


def test_frames_that_come_at_a_fraction_of_their_rate_are_named_before_any_is_lost():
    counting = Counting()
    assert not counting.pass_(20)
    assert not counting.pass_(1, come=77), "one bad second is none"
    text = counting.pass_(1, come=77)
    assert text.code == "link.frames-slow"
    assert (text.values["rate_hz"], text.values["before_hz"]) == pytest.approx((77.0, 1000.0))
    later = counting.pass_(20, come=77), counting.pass_(2, come=400)
    assert [one.values["before_hz"] for one in later] == pytest.approx([1000.0, 1000.0])
    assert not counting.pass_(2, come=600)


def test_telemetry_that_is_slow_from_the_start_or_stops_is_not_said_to_have_become_slow():
    assert not Counting().pass_(20, come=77)
    counting = Counting()
    assert not counting.pass_(20)
    assert not any(counting.pass_(1, come=come) for come in (400, 0, 0, 0, 0, 0))


def test_what_is_lost_goes_before_how_slowly_it_comes():
    counting = Counting()
    assert not counting.pass_(20)
    assert counting.pass_(5, come=1077, lost=1000).code == "link.frames-lost"


@pytest.mark.parametrize(
    ("status", "age_s", "named"),
    [
        (rtc(), 2.4, True),
        (rtc(), 1.9, False),
        (rtc(), None, False),
        (rtc(loop="open"), 60.0, False),
        (None, 60.0, False),
    ],
)
def test_frames_that_stay_away_from_a_closed_loop_are_named(status, age_s, named):
    (text,) = silence(status, age_s).values()
    assert bool(text) is named
    assert not named or text.values["silent_s"] == age_s


def test_it_is_an_alarm_that_ends_with_the_frames_and_is_not_made_beside_what_names_them():
    state = changed(TrackerState(system="small"), rtc=rtc())
    stays_away = link(*WELL, frame_age_s=5.0)
    (made,) = detect_link_changes(stays_away, state, START_NS)
    assert (made.name, made.over) == ("no-frames", False)
    alarm = Alarm(name=made.name, since_ns_utc=0, message=made.text, seen_ns_utc=START_NS)
    state = changed(state, active=(alarm,))
    (over,) = detect_link_changes(link(*WELL), state, START_NS + 4 * SECOND)
    assert (over.name, over.over) == ("no-frames", True)
    other = link(disposition("basis", 100), frame_age_s=5.0)
    assert not detect_link_changes(other, changed(state, active=()), START_NS)
