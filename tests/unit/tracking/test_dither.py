"""A dither that does not reach the mirror, or not as it was asked for."""

from dataclasses import replace
from itertools import pairwise

import pytest

from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.dither import FIRST_DITHER_RETRY_S, MAX_DITHER_RETRY_S
from service.tracking.state import Level, Mode
from service.wire import DitherRequest, DitherStop
from tests.states import changed
from tests.unit.tracking.situations import Story, dither_answered, of_kind, rtc

START = 1000


@pytest.fixture
def story():
    """A dither accepted, to begin at frame 1000."""
    story = Story(Mode.HOLD).meet(seq=900)
    accept(story)
    return story


def accept(story, start_seq=START):
    dither = story.state.dithers.dither
    story.tell(dither_answered(dither.id, accepted=True, reason="", start_seq=start_seq))


def status(story, seq, *, dither=None, after_s=0.5, **changes):
    return story.tell(rtc(seq=seq, dither=dither, **changes), after_s=after_s)


def silence(story, silent_s):
    return story.tell(
        ev.DitherSilent(id=story.state.dithers.dither.id, silent_s=silent_s), after_s=0.5
    )


class TestTheStatusShowsNone:
    def test_it_is_missed_by_the_first_status_that_should_show_it_and_asked_for_again(self, story):
        first = story.state.dithers.dither.id
        (asked,) = of_kind(status(story, START + 500), DitherRequest)
        assert asked.id != first
        assert "dither-lost" in story.alarms
        assert "dither.lost" in story.logged

    def test_a_status_made_before_it_began_says_nothing(self, story):
        status(story, START - 1)
        assert story.state.dithers.dither is not None
        assert not story.alarms

    def test_one_that_has_run_its_time_has_ended(self, story):
        stop_seq = START + round(story.state.dithers.dither.request.duration_s * 1000)
        status(story, stop_seq - 1500)
        assert "dither-lost" in story.alarms
        story = Story(Mode.HOLD).meet(seq=900)
        accept(story)
        status(story, stop_seq)
        assert not story.alarms
        assert "dither.ended" in story.logged

    def test_one_lost_again_and_again_is_asked_for_less_and_less_often(self, story):
        asked, seq = [], START
        for _ in range(40):
            seq += 1000
            if of_kind(status(story, seq, after_s=1.0), DitherRequest):
                asked.append(seq)
                accept(story, start_seq=seq)
        waits = [after - before for before, after in pairwise(asked)]
        assert len(asked) <= 6
        assert waits == sorted(waits)

    def test_a_window_that_holds_it_ends_the_alarm(self, story):
        status(story, START + 500)
        story.see()
        assert "dither-lost" not in story.alarms
        assert story.state.dithers.losses == 0

    def test_an_operator_who_wants_none_ends_the_alarm(self, story):
        status(story, START + 500)
        story.tell(cmd.StopDither())
        assert "dither-lost" not in story.alarms


class TestTheFramesHoldNone:
    @pytest.fixture
    def shown(self, story):
        """The status shows it all the same."""
        shown = story.state.dithers.dither
        status(story, START + 100, dither=shown)
        return shown

    def test_it_is_named_after_a_second_and_another_is_asked_for_soon(self, story, shown):
        silence(story, 1.0)
        assert "dither-lost" in story.alarms
        assert story.state.dithers.dither is not None
        effects = silence(story, FIRST_DITHER_RETRY_S)
        assert of_kind(effects, DitherStop), "the RTC plays no second one beside it"
        assert story.state.dithers.dither is None
        status(story, START + 2000)
        assert of_kind(story.wait(2), DitherRequest)

    def test_what_a_status_shows_and_the_frames_do_not_is_not_adopted(self, story, shown):
        silence(story, 2 * FIRST_DITHER_RETRY_S)
        for second in range(5):
            status(story, START + 3000 + 1000 * second, dither=shown, after_s=1)
            assert story.state.dithers.dither is None

    def test_the_next_is_given_more_time(self, story, shown):
        silence(story, FIRST_DITHER_RETRY_S)
        status(story, START + 3000, after_s=5)
        accept(story, START + 3100)
        status(story, START + 3200, dither=replace(story.state.dithers.dither, asked_ns_utc=0))
        silence(story, 1.5 * FIRST_DITHER_RETRY_S)
        assert story.state.dithers.dither is not None
        silence(story, 2 * FIRST_DITHER_RETRY_S)
        assert story.state.dithers.dither is None

    def test_patience_has_an_end(self, story, shown):
        story.state = changed(story.state, losses=50)
        silence(story, MAX_DITHER_RETRY_S - 1)
        assert story.state.dithers.dither is not None
        silence(story, MAX_DITHER_RETRY_S)
        assert story.state.dithers.dither is None

    def test_silence_of_another_dither_means_nothing(self, story):
        story.tell(ev.DitherSilent(id="dither-0", silent_s=100.0))
        assert story.state.dithers.dither is not None
        assert not story.alarms


@pytest.mark.parametrize(
    "changes",
    [
        {"start_seq": START + 700},
        {"amplitude_m": (3e-9,) * 4},
        {"frequency_hz": (212.0, 240.0, 284.0, 332.0)},
    ],
)
def test_the_rtcs_word_counts_where_it_plays_something_else(story, changes):
    changes = dict(changes)
    dither = story.state.dithers.dither
    playing = replace(dither, start_seq=changes.pop("start_seq", START))
    playing = replace(playing, request=replace(dither.request, **changes))
    status(story, START + 100, dither=playing)
    assert story.state.dithers.dither == playing
    assert story.logged[-1] == "dither.other"
    before = story.state
    status(story, START + 200, dither=playing)
    assert story.state.dithers.dither == before.dithers.dither
    assert story.logged.count("dither.other") == 1


def test_the_services_own_come_and_go_without_a_word_in_the_audit_and_an_operators_do_not(story):
    stop_seq = START + round(story.state.dithers.dither.request.duration_s * 1000)
    status(story, stop_seq)
    told = {line.name: line.level for line in story.state.log}
    assert told["dither.started"] is told["dither.ended"] is Level.DEBUG
    story.tell(cmd.StopDither())
    story.tell(cmd.StartDither(amplitude_m=1e-9))
    accept(story, stop_seq + 500)
    told = {line.name: line.level for line in story.state.log}
    assert told["dither.started"] is told["dither.stopped"] is Level.INFO
