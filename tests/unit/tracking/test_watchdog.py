"""Ordinary telemetry between dithers."""

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.loop import loop_numbers
from service.model.misregistration import Misregistration
from service.records import commands as cmd
from service.records import events as ev
from service.records.registration import Source, Validity
from service.records.state import Mode, TrackerState
from service.tracking.window_processing import fit_begins_at
from tests.support.situations import ALPHA, POLICY, SECOND, Story, moved, of_kind, rtc
from tests.support.states import changed
from tests.support.watchdog import SCATTER, learnt, watch, watched


@pytest.fixture
def story():
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=3)
    return story


def disagrees(story):
    """Whether a look has put α in question, and no window has told since."""
    return bool(story.state.alpha.registration.doubt)


def test_it_only_reports_while_there_is_nothing_to_compare_with():
    story = Story(Mode.AUTO).meet()
    watch(story, Misregistration())
    assert story.state.alpha.passive.consistent
    assert story.state.alpha.registration is None


def test_while_alpha_is_unknown_a_look_has_the_models_own_error_too():
    """On a coarse mirror that is larger than all that a look says of itself."""
    policy = replace(POLICY, floor=np.array([0.01, 0.02, 0.003, 0.004]))
    story = Story(Mode.AUTO, policy).meet()
    watch(story, Misregistration())
    expected = np.hypot(watched(ALPHA).sigma, policy.floor)
    np.testing.assert_allclose(story.state.alpha.passive.sigma, expected)


def test_while_alpha_is_unknown_each_look_begins_at_the_last_one():
    story = Story(Mode.AUTO).meet()
    assert fit_begins_at(story.state) is None
    watch(story, moved(shift_x_subap=0.1))
    assert fit_begins_at(story.state) == moved(shift_x_subap=0.1)
    story.see()
    assert fit_begins_at(story.state) == story.state.alpha.registration.alpha


def test_a_reading_too_far_away_for_its_fit_is_worth_nothing_and_says_so():
    """2 deg and 0.8 subapertures: the range of one linearised fit, about the nominal rotation."""
    story = Story(Mode.AUTO).meet()
    watch(story, moved(rotation_rad=np.deg2rad(3.0)))
    assert np.isinf(story.state.alpha.passive.sigma).all()
    assert fit_begins_at(story.state) is None
    turned = Story(Mode.AUTO, replace(POLICY, start=moved(rotation_rad=np.deg2rad(3.0)))).meet()
    watch(turned, moved(rotation_rad=np.deg2rad(3.0)))
    assert np.isfinite(turned.state.alpha.passive.sigma).all()


def test_why_there_is_no_look_is_told_until_there_is_one(story):
    story.tell(ev.PassiveUnavailable(text="no passive estimate: the loop is open"))
    assert story.state.alpha.passive_unavailable_reason == "no passive estimate: the loop is open"
    watch(story, ALPHA)
    assert story.state.alpha.passive_unavailable_reason == ""


def test_before_a_bias_is_learnt_a_shift_is_worth_ten_percent_and_says_so(story):
    before = story.state.alpha.registration
    watch(story, moved(shift_x_subap=0.06))
    after = story.state.alpha.registration
    assert np.all(story.state.alpha.passive.sigma[:2] >= 0.1)
    assert after.alpha.shift_x_subap == pytest.approx(before.alpha.shift_x_subap, abs=0.005)
    assert after.n_windows == before.n_windows
    assert after.window_ns_utc == before.window_ns_utc


def test_the_more_a_look_scatters_the_larger_its_bias_may_be_and_it_says_so(story):
    """A bright star in 25 m/s: 20 % of a subaperture, seen at a scatter of 1.25 %, is no jump."""
    scatter = SCATTER + np.array([0.0095, 0.0095, 0.0, 0.0])
    before = story.state.alpha.registration
    watch(story, moved(shift_x_subap=0.20), scatter=scatter)
    expected = watched(ALPHA, scatter).sigma
    np.testing.assert_allclose(story.state.alpha.passive.sigma, expected)
    assert expected[0] == pytest.approx(0.16, abs=0.005)
    assert story.state.alpha.passive.consistent
    after = story.state.alpha.registration.alpha
    assert after.shift_x_subap == pytest.approx(before.alpha.shift_x_subap, abs=0.005)


def test_a_bias_of_which_nothing_is_known_is_not_taken_for_a_jump_of_the_mirror(story):
    """40 % is 2.5 times the σ of a look that scatters by 1.25 %, and 3.8 that of a quiet one."""
    far = moved(shift_x_subap=0.40, shift_y_subap=0.40)
    watch(story, far, scatter=SCATTER + np.array([0.0095, 0.0095, 0.0, 0.0]))
    assert not disagrees(story)
    quiet = Story(Mode.AUTO).meet()
    quiet.see(n_windows=3)
    watch(quiet, far)
    assert disagrees(quiet)


def test_a_bias_that_was_learnt_is_not_excused_by_a_look_that_scatters_more(story):
    """A tenth of a subaperture is a jump even while the scatter rises to three times as much."""
    learnt(story)
    watch(story, moved(shift_x_subap=0.16), after_s=4.0, scatter=3 * SCATTER)
    assert disagrees(story)
    expected = watched(ALPHA, 3 * SCATTER).sigma
    np.testing.assert_allclose(story.state.alpha.passive.sigma, expected)


def test_the_bias_is_learnt_between_windows_and_shown(story):
    known = learnt(story).state.alpha.registration
    assert known.bias.offset[0] == pytest.approx(0.06, abs=0.004)
    assert story.state.alpha.passive.bias[0] == pytest.approx(0.06, abs=0.004)
    assert story.state.alpha.passive.sigma[0] < 0.02
    assert known.alpha.shift_x_subap == pytest.approx(ALPHA.shift_x_subap, abs=0.003)


def test_looks_that_scatter_more_than_they_say_are_no_jumps(story):
    """By 40 % in σ: χ² of four alone would be too large once in 60 looks."""
    said = 10 * SCATTER
    rng = np.random.default_rng(3)
    doubts = 0
    for k in range(200):
        if k % 5 == 0 or disagrees(story):
            story.see(every_s=5.0)
        drawn = ALPHA.vector + 1.4 * said * rng.standard_normal(4)
        watch(story, Misregistration.from_vector(drawn), after_s=5.0, scatter=said)
        doubts += disagrees(story)
    assert doubts <= 1
    assert story.state.alpha.registration.bias.scatter == pytest.approx(1.96, rel=0.4)
    watch(story, moved(shift_x_subap=0.3), after_s=5.0, scatter=said)
    assert disagrees(story)


def test_once_learnt_it_follows_a_drift_without_any_window(story):
    """2 % of a subaperture in 40 s, four looks: followed to a quarter of it, and σ says so."""
    learnt(story)
    for k in range(1, 5):
        watch(story, moved(shift_x_subap=0.06 + 0.005 * k))
    known = story.state.alpha.registration
    assert known.alpha.shift_x_subap == pytest.approx(ALPHA.shift_x_subap + 0.02, abs=0.005)
    silent = story.policy.drift_rate[0] * np.sqrt(40.0)
    assert known.sigma[0] < silent / 2
    assert story.state.alpha.history[-1].source is Source.PASSIVE


def test_how_well_the_model_fits_a_look_is_shown_and_in_the_history(story):
    now_ns = story.now_ns + 4 * SECOND
    look = replace(watched(ALPHA), misfit=1.7)
    story.tell(ev.PassiveFitted(estimate=look, t_ns_utc=now_ns), after_s=4.0)
    assert story.state.alpha.passive.misfit == 1.7
    assert story.state.alpha.history[-1].misfit == 1.7


class TestBark:
    """An estimate that fits neither α nor what is known of its bias."""

    @pytest.fixture
    def barking(self, story):
        learnt(story)
        self.before = story.state.alpha.registration
        watch(story, moved(shift_x_subap=0.30))
        return story

    def test_it_is_seen_and_a_dither_is_due_and_nobody_is_woken(self, barking):
        assert not barking.alarms
        assert "registration.passive-jump" in barking.logged
        assert barking.state.alpha.dither_due_since_ns_utc == barking.now_ns
        assert "wind" in barking.state.alpha.dither_due_reason
        assert not barking.state.alpha.passive.consistent

    def test_alpha_stays_valid_the_bias_is_forgotten_and_nothing_is_made_meanwhile(self, barking):
        known = barking.state.alpha.registration
        assert known.alpha == self.before.alpha
        np.testing.assert_array_equal(known.bias.offset, 0.0)
        assert known.validity.level is Validity.FRESH
        assert not of_kind(barking.wait(30), ev.MakeMatrix)
        assert not of_kind(barking.make("cm-1"), ev.SendMatrix)

    def test_a_look_that_agrees_does_not_end_the_question(self, barking):
        watch(barking, moved(shift_x_subap=0.30))
        assert disagrees(barking)
        assert barking.state.alpha.registration.usable
        assert not barking.alarms

    def test_a_second_one_that_disagrees_unanswered_is_an_alarm_and_voids_nothing(self, barking):
        watch(barking, moved(shift_x_subap=1.3))
        assert "watchdog" in barking.alarms
        assert barking.state.alpha.registration.usable

    def test_where_no_dither_can_be_had_the_first_is_an_alarm_with_the_reason(self, story):
        learnt(story)
        story.tell(cmd.StopDither())
        watch(story, moved(shift_x_subap=0.30))
        assert story.state.alpha.registration.validity.level is Validity.FRESH

    def test_what_a_window_has_made_void_a_look_makes_no_better(self, story):
        learnt(story)
        story.see(moved(shift_x_subap=0.4))
        watch(story, moved(shift_x_subap=0.46))
        assert story.state.alpha.registration.validity.level is Validity.INVALID

    def test_a_window_at_the_old_place_ends_it(self, barking):
        watch(barking, moved(shift_x_subap=1.3))
        barking.see()
        assert not disagrees(barking)
        assert barking.state.alpha.dither_due_since_ns_utc is None
        assert not barking.alarms & {"watchdog", "estimate-stale"}

    def test_a_window_far_away_is_a_jump_only_when_the_next_confirms_it(self, barking):
        barking.see(moved(shift_x_subap=0.24))
        assert "jump-suspected" in barking.alarms
        barking.see(moved(shift_x_subap=0.24))
        shift = barking.state.alpha.registration.alpha.shift_x_subap
        assert shift == pytest.approx(ALPHA.shift_x_subap + 0.24, abs=0.005)


class TestJump:
    """While the sums still hold telemetry from before a jump."""

    def test_they_are_not_used(self, story):
        learnt(story)
        there = moved(shift_x_subap=0.15)
        story.see(there, n_windows=2)
        before = story.state.alpha.registration
        watch(story, moved(shift_x_subap=0.10))
        assert story.state.alpha.registration.alpha == before.alpha

    def test_one_that_began_after_it_is(self, story):
        learnt(story)
        there = moved(shift_x_subap=0.15)
        story.see(there, n_windows=2)
        for used in (False, True):
            story.see(there, every_s=1.0)
            watch(story, moved(there, shift_x_subap=0.06), after_s=3.0)
            assert (story.state.alpha.history[-1].source is Source.PASSIVE) is used

    def test_nor_while_one_is_suspected(self, story):
        story.see(moved(shift_x_subap=0.15))
        before = story.state.alpha.registration
        watch(story, moved(shift_x_subap=0.15))
        assert story.state.alpha.registration.covariance is before.covariance


def test_it_is_of_the_time_of_its_telemetry_not_of_when_the_worker_was_done(story):
    end_ns = story.state.alpha.registration.t_ns_utc + 4 * SECOND
    story.tell(ev.PassiveFitted(estimate=watched(ALPHA), t_ns_utc=end_ns), after_s=60.0)
    assert story.state.alpha.registration.t_ns_utc == end_ns
    assert story.state.alpha.registration.bias.looked_ns_utc == end_ns


def test_a_registration_without_a_bias_knows_nothing_of_it(story):
    story.state = changed(
        story.state, registration=replace(story.state.alpha.registration, bias=None)
    )
    watch(story, moved(shift_x_subap=0.08))
    assert story.state.alpha.registration.bias.offset[0] > 0.05


@pytest.mark.parametrize(
    "changes", [{"n_controlled": 500}, {"leak": 0.99}, {"gains": (0.3,) * 400 + (0.0,) * 194}]
)
def test_another_loop_has_another_bias(story, changes):
    learnt(story)
    story.tell(rtc(t_ns=story.now_ns))
    assert story.state.alpha.registration.bias is not None
    story.tell(rtc(t_ns=story.now_ns, **changes))
    assert story.state.alpha.registration.bias is None
    assert story.state.alpha.registration.usable


@pytest.mark.parametrize(("n_controlled", "kept"), [(400, True), (300, False)])
@pytest.mark.parametrize("restarted", ["the RTC", "the service"])
def test_so_it_has_when_the_rtc_or_the_service_was_restarted(story, restarted, n_controlled, kept):
    learnt(story)
    if restarted == "the RTC":
        story.tell(ev.SessionStarted(session="s2"))
        story.tell(rtc(n_controlled, session="s2"))
    else:
        known, now_ns = story.state.alpha.registration, story.now_ns
        story = Story(Mode.AUTO, state=changed(TrackerState(system="flao"), registration=known))
        story.now_ns = now_ns
        story.meet(n_controlled=n_controlled)
    assert (story.state.alpha.registration.bias is not None) is kept


def test_a_look_that_was_under_way_when_the_loop_changed_is_not_used(story):
    learnt(story)
    before = loop_numbers(rtc())
    story.tell(rtc(300, t_ns=story.now_ns))
    look = ev.PassiveFitted(estimate=watched(ALPHA), t_ns_utc=story.now_ns, loop=before)
    known = story.state.alpha.registration
    story.tell(look, after_s=1.0)
    assert story.state.alpha.registration.alpha == known.alpha
    assert story.state.alpha.registration.bias is None
    assert "the loop has changed" in story.state.alpha.passive_unavailable_reason


@pytest.mark.parametrize("alarm", ["loop-diverging", "edge-slip", "commands-off-loop"])
def test_a_look_at_a_loop_out_of_hand_moves_nothing(story, alarm):
    learnt(story)
    known = story.state.alpha.registration
    story.tell(ev.ConditionChanged(name=alarm, text="it is"))
    watch(story, moved(shift_x_subap=0.08), after_s=4.0)
    assert story.state.alpha.registration.alpha == known.alpha
    assert "no measurement" in story.state.alpha.passive_unavailable_reason
    story.tell(ev.ConditionChanged(name=alarm, text="over", over=True))
    watch(story, moved(shift_x_subap=0.06), after_s=4.0)
    assert story.state.alpha.history[-1].source is Source.PASSIVE
    assert story.state.alpha.passive_unavailable_reason == ""


def test_a_bias_of_which_nothing_was_learnt_is_of_no_loop(story):
    before = story.state.alpha.registration.bias
    story.tell(rtc(300, t_ns=story.now_ns))
    assert story.state.alpha.registration.bias is before


def test_gains_that_follow_the_seeing_by_a_percent_unteach_no_bias(story):
    learnt(story)
    before = story.state.alpha.registration.bias
    gains = (0.4 * 1.01,) * 400 + (0.0,) * 194
    story.tell(rtc(t_ns=story.now_ns, gains=gains))
    assert story.state.alpha.registration.bias is before
    late = ev.PassiveFitted(
        estimate=watched(moved(shift_x_subap=0.06)),
        t_ns_utc=story.now_ns + 4 * SECOND,
        loop=loop_numbers(rtc()),
    )
    story.tell(late, 4.0)
    assert story.state.alpha.passive_unavailable_reason == ""
