"""Noisy interaction matrices: asked for, waited for, given up, stored; never published."""

from dataclasses import replace

import numpy as np
import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import MeasureState
from service.records.products import ModeSet
from service.tracking.operations.measurement import DITHER_END_TIMEOUT_S
from service.wire import DitherKind, DitherRequest, DitherStop
from tests.support.situations import POLICY, Story, dither_answered, of_kind, rtc
from tests.support.world import FOUND

ASK = cmd.MeasureNoisy(
    id="noisy-1", modes=ModeSet.CONTROLLED, total_amplitude_m=5e-9, duration_s=30.0
)
STILL = replace(POLICY, dither_enabled=False)


@pytest.fixture
def story():
    """A loop in which the service does not dither by itself."""
    return Story(policy=STILL).meet()


@pytest.fixture
def dithering():
    """A loop in which the service's own dither runs."""
    story = Story().meet()
    own = story.state.dithers.dither
    answer = dither_answered(own.id, accepted=True, reason="", start_seq=500)
    story.tell(answer)
    status(story, dither=replace(own, start_seq=500))
    return story


def status(story, **changes):
    return story.tell(rtc(**changes))


def state_of(story, noisy_id="noisy-1"):
    return story.state.measurement(noisy_id).state


def begun(story):
    story.tell(ASK)
    story.tell(dither_answered("noisy-1", accepted=True, reason="", start_seq=1000))
    status(story, dither=story.state.dithers.dither, seq=1100)
    return story


def test_random_signs_on_all_controlled_modes_are_asked_for(story):
    (dither,) = of_kind(story.tell(ASK), DitherRequest)
    assert (dither.id, dither.kind, dither.modes) == (
        "noisy-1",
        DitherKind.BINARY,
        tuple(range(400)),
    )
    assert np.sqrt(np.sum(np.square(dither.amplitude_m))) == pytest.approx(5e-9)
    assert state_of(story) is MeasureState.ASKED
    assert story.state.noisy_measurement.seed == dither.seed


def test_the_services_own_dither_makes_way_and_none_of_its_own_follows(dithering):
    effects = dithering.tell(ASK)
    assert of_kind(effects, DitherStop)
    assert not of_kind(effects, DitherRequest)
    assert state_of(dithering) is MeasureState.WAITING
    assert not dithering.wait(2.0)
    (asked,) = of_kind(status(dithering, dither_id=None), DitherRequest)
    assert asked.id == "noisy-1"


def test_a_dither_that_does_not_make_way_ends_the_wait(dithering):
    own = dithering.state.dithers.dither
    dithering.tell(ASK)
    status(dithering, dither=own)
    dithering.wait(DITHER_END_TIMEOUT_S + 2.0)
    assert state_of(dithering) is MeasureState.FAILED


def test_it_runs_from_when_the_rtc_has_accepted(story):
    begun(story)
    assert state_of(story) is MeasureState.RUNNING
    assert story.state.dithers.dither.id == "noisy-1"


def test_the_end_of_the_dither_is_the_beginning_of_the_fit(story):
    begun(story)
    effects = status(story, dither_id=None, seq=1100 + 31_000)
    (finish,) = of_kind(effects, ev.FinishNoisy)
    assert finish.record.id == "noisy-1"
    assert state_of(story) is MeasureState.FINISHING
    assert not of_kind(story.wait(3.0), ev.FinishNoisy)


def finished(story):
    begun(story)
    status(story, dither_id=None, seq=1100 + 31_000)
    record = replace(story.state.noisy_measurement, state=MeasureState.STORED, finding=FOUND)
    story.tell(ev.MatrixMeasured(record=record))
    return story


def test_what_is_archived_is_stored_and_the_service_dithers_on(story):
    finished(story)
    assert state_of(story) is MeasureState.STORED
    assert story.state.noisy_measurement is None
    assert "signal / noise of an element 1.40" in story.state.log[-1].text


def test_a_session_that_ends_in_the_middle_is_finished_with_what_there_is(story):
    begun(story)
    effects = story.tell(ev.SessionStarted(session="s2"))
    assert of_kind(effects, ev.FinishNoisy)


@pytest.mark.parametrize(
    ("event", "words"),
    [
        (
            dither_answered("noisy-1", accepted=False, reason="busy: ramp", start_seq=None),
            "the RTC refused the dither: busy: ramp",
        ),
        ("silence", "no answer from the RTC"),
    ],
)
def test_a_dither_that_never_begins_is_a_failure_with_its_reason(story, event, words):
    (asked,) = of_kind(story.tell(ASK), DitherRequest)
    if event == "silence":
        event = ev.JobFailed(effect=ev.Ask(request=asked), text=words)
    story.tell(event)
    assert state_of(story) is MeasureState.FAILED
    assert story.state.measurement("noisy-1").reason == words


@pytest.mark.parametrize(
    ("ratio", "state"), [(1.05, MeasureState.RUNNING), (30.0, MeasureState.FAILED)]
)
def test_a_dither_that_is_too_strong_ends_it(story, ratio, state):
    begun(story)
    found = ev.DitherMeasured(
        id="noisy-1", found_m=ratio * 5e-9, asked_m=5e-9, text="other than requested"
    )
    effects = story.tell(found)
    assert state_of(story) is state
    assert bool(of_kind(effects, DitherStop)) is (state is MeasureState.FAILED)


def test_a_fit_that_fails_is_a_failure_with_its_reason(story):
    begun(story)
    (finish,) = of_kind(status(story, dither_id=None, seq=1100 + 31_000), ev.FinishNoisy)
    story.tell(ev.JobFailed(effect=finish, text="no window of its dither was whole"))
    assert state_of(story) is MeasureState.FAILED


def test_one_given_up_ends_its_dither_and_stays_given_up(story):
    begun(story)
    effects = story.tell(cmd.GiveUp(id="noisy-1"))
    assert of_kind(effects, DitherStop)
    assert story.state.dithers.dither is None
    record = replace(story.state.noisy[-1], state=MeasureState.STORED, finding=FOUND)
    story.tell(ev.MatrixMeasured(record=record))
    assert state_of(story) is MeasureState.GIVEN_UP


def test_more_than_the_budget_must_be_meant(story):
    story.tell(replace(ASK, total_amplitude_m=11e-9, over_budget=True))
    assert story.state.noisy_measurement.total_m == pytest.approx(11e-9)
