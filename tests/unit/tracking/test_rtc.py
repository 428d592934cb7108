from dataclasses import replace

import numpy as np
import pytest

from service.errors import CommandError
from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import ALARMS, Severity
from service.records.products import MatrixState
from service.records.state import Level, Mode
from service.tracking.dither_request import DEFAULT_DURATION_S
from service.wire import DitherRequest
from tests.support.situations import (
    SECOND,
    Story,
    dither_answered,
    estimate,
    of_kind,
    rtc,
    stopping,
)
from tests.support.states import changed


@pytest.fixture
def story():
    """An RTC whose matrix is known, α from two windows, and nothing done by itself."""
    story = Story(Mode.HOLD).meet()
    story.see(n_windows=2)
    return story


def test_the_first_basis_seen_is_adopted_and_a_pinned_one_stays():
    assert Story().meet().state.loop.basis_id == "kl-594"
    pinned = Story()
    pinned.state = changed(pinned.state, basis_id="pinned")
    assert pinned.meet().state.loop.basis_id == "pinned"


def test_a_matrix_nobody_knows_is_fetched_and_asked_for_again_only_after_three_seconds():
    story = Story()
    story.tell(ev.SessionStarted(session="s1"))
    assert story.tell(rtc()) == (ev.FetchMatrix(id="initial"),)
    assert not of_kind(story.wait(2), ev.FetchMatrix)
    assert of_kind(story.wait(1), ev.FetchMatrix)


def test_a_matrix_fetched_twice_is_on_the_shelf_once(story):
    fetched = story.state.reconstructor("initial")
    story.tell(ev.MatrixFetched(record=fetched))
    assert [record.id for record in story.state.matrices.reconstructors] == ["initial"]


def test_a_service_that_is_not_the_first_stands_by_until_the_first_has_gone(story):
    story.tell(ev.ServicesMet(drives=False, others=("abc",)))
    assert {"second-service", "standing-by"} <= story.alarms
    story.effects.clear()
    story.tell(rtc())
    story.see(n_windows=3)
    story.wait(120.0)
    assert not story.effects
    for command in (cmd.Refit(), cmd.Rollback(), cmd.StopDither(), cmd.SetLoop(loop="open")):
        with pytest.raises(CommandError, match="another service drives the RTC"):
            story.tell(command)
    story.tell(ev.ServicesMet(drives=True, others=()))
    assert not {"second-service", "standing-by"} & story.alarms
    assert "service.takes-over" in story.logged
    because = "another service was driving the RTC"
    assert because in {each.because for each in story.state.alpha.void_intervals}
    story.wait(10.0)
    assert story.asked(DitherRequest)


def test_the_first_of_two_services_drives_on_and_says_so(story):
    story.tell(ev.ServicesMet(drives=True, others=("abc",)))
    assert "second-service" in story.alarms
    assert "standing-by" not in story.alarms
    assert story.tell(cmd.StopDither()) == (stopping(story),)


def test_new_references_are_recorded_and_change_nothing_else(story):
    story.tell(rtc(reference_id="ncpa-1"))
    before = story.state
    story.wait(15.0)
    story.effects.clear()
    # A ramp and its end are one change.
    story.tell(rtc(reference_id="ncpa-2~"))
    story.tell(rtc(reference_id="ncpa-2"))
    loop = story.state.loop
    assert (loop.reference_id, loop.reference_since_ns_utc) == ("ncpa-2", story.now_ns)
    assert story.logged.count("references.changed") == 2
    assert story.state.matrices == before.matrices
    assert story.state.alpha.registration.alpha == before.alpha.registration.alpha
    assert not story.alarms
    story.wait(1.0)
    story.tell(rtc(reference_id="ncpa-2"))
    assert story.state.loop.reference_since_ns_utc == loop.reference_since_ns_utc


def test_the_first_references_are_no_change_and_those_of_a_new_session_may_be():
    story = Story(Mode.HOLD).meet()
    assert story.state.loop.reference_id == "pyramid-30"
    assert story.state.loop.reference_since_ns_utc is None
    story.tell(ev.SessionStarted(session="s2"))
    story.tell(rtc(session="s2", reference_id="ncpa-1"))
    assert story.state.loop.reference_since_ns_utc == story.now_ns


def renamed(story, config_id):
    """Let the RTC name its configuration otherwise a second later; it does not show its matrix."""
    story.shows = False
    story.wait(1.0)
    return story.tell(rtc(config_id=config_id))


def shown(story):
    story.tell(ev.MatrixFetched(record=story.state.reconstructor("initial")))


def test_a_renamed_sensor_is_told_once_and_its_matrix_is_read_again(story):
    fetched = ev.FetchMatrix(id="initial")
    assert fetched in renamed(story, "references-1")
    first = story.state.alarm("sensor-renamed")
    assert "R-31" in first.text
    assert ALARMS["sensor-renamed"].severity is Severity.WARNING
    shown(story)
    assert fetched in renamed(story, "references-2")
    assert story.logged.count("sensor-renamed") == 1
    assert story.state.alarm("sensor-renamed").text == first.text
    assert story.state.loop.config_id == "pyramid-30"
    story.tell(ev.SessionStarted(session="s2"))
    assert "sensor-renamed" not in story.alarms


def test_a_renamed_sensor_gets_a_new_matrix_once_matrix_and_window_agree(story):
    story.make("cm-1")
    renamed(story, "references-1")
    with pytest.raises(CommandError, match="being read back"):
        story.tell(cmd.Approve(id="cm-1"))
    shown(story)
    with pytest.raises(CommandError, match="references-1"):
        story.tell(cmd.Approve(id="cm-1"))
    story.see(n_windows=1)
    story.tell(rtc(config_id="references-1"))
    assert "sensor.same" in story.logged
    story.tell(cmd.Approve(id="cm-1"))
    assert story.asked(ev.SendMatrix)


def test_a_window_from_before_shows_nothing_of_a_renamed_sensor(story):
    before_ns = story.now_ns
    renamed(story, "references-1")
    shown(story)
    window = ev.WindowFitted(estimate=estimate(t_ns=story.now_ns), began_ns_utc=before_ns)
    n_accepted = story.state.windows.accepted
    story.tell(window)
    story.tell(rtc(config_id="references-1"))
    assert story.state.windows.accepted == n_accepted + 1
    assert "sensor.same" not in story.logged


@pytest.mark.parametrize("name", ["matrix-mismatch", "response-mismatch"])
def test_a_renamed_sensor_that_contradicts_the_model_stays_in_doubt(story, name):
    renamed(story, "references-1")
    shown(story)
    story.see(n_windows=1)
    story.tell(ev.ConditionChanged(name=name, text="it differs", t_ns_utc=story.now_ns))
    story.tell(rtc(config_id="references-1"))
    assert story.state.loop.renamed_ns_utc is not None


def test_an_open_loop_is_an_alarm_until_it_is_closed(story):
    story.tell(rtc(loop="open"))
    assert "loop-open" in story.alarms
    story.tell(rtc())
    assert "loop-open" not in story.alarms


@pytest.mark.parametrize(
    ("lead_s", "words"),
    [
        (3600, "3600 s ahead of UTC"),
        (-3600, "3600 s behind UTC"),
        (37, "37 s ahead of UTC"),
        (18, "18 s ahead of UTC"),
        (1234, "1234 s ahead of UTC"),
        (4, None),
        (-500, None),
    ],
)
def test_an_rtc_whose_clock_is_not_utc_raises_one_alarm_until_it_is(story, lead_s, words):
    for seconds in (0.0, 0.3):
        t_ns = story.now_ns + round((lead_s + seconds) * SECOND)
        story.tell(rtc(t_ns=t_ns, seq=int(10 * seconds)))
    text = story.state.alarm("rtc-clock")
    assert (text and text.text.removeprefix("the RTC's time stamps are ")) == words
    story.tell(rtc(t_ns=story.now_ns + 1, seq=9))
    assert "rtc-clock" not in story.alarms


def test_a_status_tells_which_matrix_is_in_use_even_when_its_acknowledgement_was_lost(story):
    story.make("cm-1", wanted=True)
    story.tell(rtc(cm_id="cm-1"))
    assert story.state.matrices.in_use == "cm-1"
    assert story.matrix_state("cm-1") is MatrixState.APPLIED
    assert story.matrix_state("initial") is MatrixState.SUPERSEDED


@pytest.mark.parametrize("shown", ["cm-1", "cm-2", "cm-0"])
def test_a_status_with_that_or_a_later_matrix_ends_the_alarm_that_it_was_not_applied(story, shown):
    story.use("cm-0")
    story.make("cm-1", wanted=True)
    story.wait(5)
    assert story.matrix_state("cm-1") is MatrixState.FAILED
    if shown == "cm-2":
        story.make("cm-2", wanted=True)
    story.tell(rtc(cm_id="cm-0"))
    assert "no-acknowledgement" in story.alarms
    story.tell(rtc(cm_id=shown))
    assert ("no-acknowledgement" in story.alarms) is (shown == "cm-0")
    in_use = MatrixState.APPLIED if shown == "cm-1" else MatrixState.FAILED
    assert story.matrix_state("cm-1") is in_use


def test_a_vanished_rtc_is_an_alarm_that_ends_with_its_next_status(story):
    story.tell(ev.RtcVanished())
    assert story.state.loop.rtc is None
    assert "rtc-vanished" in story.alarms
    story.meet(session="s2")
    assert "rtc-vanished" not in story.alarms


@pytest.mark.parametrize("event", [ev.RtcVanished(), ev.SessionStarted(session="s2")])
def test_nothing_known_is_lost_with_the_rtc(story, event):
    story.use("cm-1")
    before = story.state
    story.tell(event)
    assert story.state.alpha.registration.alpha == before.alpha.registration.alpha
    np.testing.assert_array_equal(
        story.state.alpha.registration.covariance, before.alpha.registration.covariance
    )
    assert story.state.matrices.reconstructors == before.matrices.reconstructors
    assert story.state.alpha.history == before.alpha.history


def test_a_restarted_rtc_has_to_confirm_the_registration(story):
    story.tell(ev.SessionStarted(session="s2"))
    assert story.state.alpha.registration.n_windows == 0
    assert (
        story.state.matrices.in_use,
        story.state.matrices.margin,
        story.state.dithers.dither,
    ) == (None, None, None)


def test_a_restarted_rtc_has_lost_what_was_sent_to_it(story):
    story.make("cm-1", wanted=True)
    story.make("cm-2", wanted=True)
    story.acknowledge("cm-2", MatrixState.STAGED)
    story.tell(ev.SessionStarted(session="s2"))
    assert story.matrix_state("cm-1") is MatrixState.FAILED
    assert story.matrix_state("cm-2") is MatrixState.FAILED
    assert story.state.reconstructor("cm-1").reason == "the RTC restarted"


def test_a_missing_acknowledgement_fails_the_reconstructor_after_three_seconds(story):
    story.make("cm-1", wanted=True)
    story.tell(ev.Tick(), after_s=3.0)
    assert story.matrix_state("cm-1") is MatrixState.PUBLISHED
    story.tell(ev.Tick(), after_s=0.1)
    assert story.matrix_state("cm-1") is MatrixState.FAILED
    assert "no-acknowledgement" in story.alarms


def test_a_staged_reconstructor_that_is_never_applied_fails_too(story):
    story.make("cm-1", wanted=True)
    story.acknowledge("cm-1", MatrixState.STAGED)
    story.wait(4)
    assert story.matrix_state("cm-1") is MatrixState.FAILED


def test_a_computation_that_never_ends_is_given_up_after_a_minute(story):
    story.tell(cmd.Refit())
    story.wait(60)
    assert story.state.matrices.making_since_ns_utc is not None
    story.wait(1)
    assert story.state.matrices.making_since_ns_utc is None
    assert "reconstructor.lost" in story.logged
    story.tell(cmd.Refit())


@pytest.mark.parametrize("name", ["second-rtc", "basis-mismatch"])
def test_an_alarm_the_link_repeats_is_over_after_fifteen_silent_seconds(story, name):
    story.tell(ev.ConditionChanged(name=name, text="found"))
    story.wait(10)
    story.tell(ev.ConditionChanged(name=name, text="found again"))
    story.wait(15)
    assert name in story.alarms
    story.wait(1)
    assert name not in story.alarms


def test_other_alarms_last_until_they_are_taken_back(story):
    story.tell(ev.ConditionChanged(name="instrument-mismatch", text="found"))
    story.wait(60, every_s=10)
    assert "instrument-mismatch" in story.alarms
    story.tell(ev.ConditionChanged(name="instrument-mismatch", text="fits", over=True))
    assert "instrument-mismatch" not in story.alarms


def test_something_noted_changes_only_the_log(story):
    before = story.state
    story.tell(ev.LogEvent(name="x", text="y", level=Level.WARNING))
    assert story.state.log[-1].text == "y"
    assert replace(story.state, log=()).alarms == replace(before, log=()).alarms
    assert story.state.alpha.registration is before.alpha.registration


class TestDither:
    """The dither's life as the RTC tells it."""

    @pytest.fixture
    def story(self):
        return Story(Mode.HOLD).meet()

    def answer(self, story, *, accepted=True, reason="", dither_id=None):
        return story.tell(
            dither_answered(
                dither_id or story.state.dithers.dither.id,
                accepted=accepted,
                reason=reason,
                start_seq=777 if accepted else None,
            )
        )

    def test_an_accepted_dither_has_a_first_frame(self, story):
        self.answer(story)
        assert story.state.dithers.dither.start_seq == 777

    def test_a_refused_dither_is_an_alarm_and_is_asked_for_again_after_ten_seconds(self, story):
        self.answer(story, accepted=False, reason="busy: measuring")
        assert story.state.dithers.dither is None
        assert "busy: measuring" in story.state.alarms.active[0].text
        assert not of_kind(story.wait(9), DitherRequest)
        assert of_kind(story.wait(1), DitherRequest)
        self.answer(story)
        assert not story.alarms

    def test_an_answer_to_another_dither_is_not_mistaken_for_it(self, story):
        self.answer(story, dither_id="dither-0")
        assert story.state.dithers.dither.start_seq is None

    def test_a_dither_that_ended_is_replaced_by_the_next(self, story):
        self.answer(story)
        first = story.state.dithers.dither.id
        story.tell(rtc(dither=story.state.dithers.dither), after_s=5)
        assert story.state.dithers.dither.id == first
        story.tell(rtc(), after_s=DEFAULT_DURATION_S - 5)
        assert "dither.ended" in story.logged
        assert story.alarms == {"windows-refused"}, "for two minutes no window has come"
        assert story.state.dithers.dither.id != first

    def test_a_status_older_than_the_dither_does_not_end_it(self, story):
        self.answer(story)
        story.tell(rtc(), after_s=2)
        assert story.state.dithers.dither is not None
        assert "dither.ended" not in story.logged


class TestFailures:
    """A job that failed is forgotten, so that it can be asked again."""

    def test_a_matrix_that_could_not_be_sent_has_failed(self, story):
        (effect,) = story.make("cm-1", wanted=True)
        story.tell(ev.JobFailed(effect=effect, text="the link is not open"))
        assert story.matrix_state("cm-1") is MatrixState.FAILED
        assert story.state.reconstructor("cm-1").reason == "the link is not open"

    def test_a_dither_the_rtc_did_not_answer_is_asked_for_after_five_seconds(self, story):
        effect = ev.Ask(request=story.state.dithers.dither.request)
        story.tell(ev.JobFailed(effect=effect, text="no answer"))
        assert story.state.dithers.dither is None
        assert not of_kind(story.wait(4), DitherRequest)
        assert of_kind(story.wait(1), DitherRequest)

    def test_a_margin_that_could_not_be_judged_leaves_the_state_as_it_was(self, story):
        before = story.state
        story.tell(ev.JobFailed(effect=ev.JudgeMatrix(id="initial"), text="died"))
        assert story.state.matrices.reconstructors == before.matrices.reconstructors
        assert story.state.log[-1].name == "job.failed"
