"""What α is worth as time passes and the telescope moves, and which telemetry is void."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.products import MatrixState
from service.records.registration import Purpose, Validity
from service.records.state import Mode, TrackerState
from service.tracking import validity
from service.tracking.validity import (
    INTERVALS_KEPT,
    MAX_TELEMETRY_AGE_S,
    explain_void,
    invalidate_telemetry,
    make_valid,
    separation_deg,
    void_until,
)
from service.wire import Pointing
from tests.support.situations import (
    POLICY,
    PRECISE,
    SECOND,
    START_NS,
    Story,
    moved,
    of_kind,
    rtc,
    turned,
    verdict,
)
from tests.support.states import changed, tracker_state

BENDING = replace(
    POLICY, flexure_per_degree=np.array([0.02, 0.02, 2e-4, 1e-4]), dither_enabled=False
)
HERE = Pointing(elevation_deg=60.0, azimuth_deg=100.0)
STATE = tracker_state(rtc=rtc())


@pytest.fixture
def story():
    story = Story(Mode.AUTO, BENDING).meet()
    point(story, HERE)
    story.see(n_windows=3)
    return story


def point(story, pointing):
    return story.tell(cmd.SetPointing(**asdict(pointing)))


def worth(story):
    return story.state.alpha.registration.validity.level


class TestTime:
    """σ grows while nothing is measured."""

    def test_it_grows_with_the_square_root_of_time(self, story):
        before = story.state.alpha.registration
        story.wait(30)
        after = story.state.alpha.registration
        expected = np.sqrt(before.sigma**2 + 30.0 * POLICY.drift_rate**2)
        np.testing.assert_allclose(after.sigma, expected)
        np.testing.assert_array_equal(after.covariance, before.covariance)

    def test_the_rtcs_clock_counts_while_it_tells_the_time(self, story):
        """A simulated RTC that needs 30 s for one second of its own."""
        before = story.state.alpha.registration
        story.tell(rtc(t_ns=before.t_ns_utc + SECOND))
        story.wait(30)
        expected = np.sqrt(before.sigma**2 + 1.0 * POLICY.drift_rate**2)
        np.testing.assert_allclose(story.state.alpha.registration.sigma, expected)

    def test_it_is_fresh_then_ageing_then_stale_then_invalid(self, story):
        """Shifts: half of 5 % after (0.025/0.006)² = 17 s, 5 % after 69 s, 10 % after 278 s."""
        seen = {}
        for second in range(300):
            seen.setdefault(worth(story), second)
            story.wait(1)
        assert list(seen) == [each for each in Validity if each is not Validity.PREDICTED]
        assert seen[Validity.AGEING] == pytest.approx(17, abs=2)
        assert seen[Validity.STALE] == pytest.approx(69, abs=2)
        assert seen[Validity.INVALID] == pytest.approx(278, abs=3)

    def test_until_when_it_is_valid_is_told_beforehand(self, story):
        until_ns = story.state.alpha.registration.validity.until_ns_utc
        story.wait((until_ns - story.now_ns) / SECOND - 1)
        assert worth(story) is Validity.AGEING
        assert story.state.alpha.registration.validity.until_ns_utc == pytest.approx(
            until_ns, abs=1e6
        )
        story.wait(3)
        assert worth(story) is Validity.STALE
        assert story.state.alpha.registration.validity.until_ns_utc is None

    def test_what_never_drifts_never_goes_stale(self):
        story = Story(Mode.AUTO, replace(POLICY, drift_rate=np.zeros(4))).meet()
        story.see(n_windows=2)
        story.wait(300)
        assert worth(story) is Validity.FRESH
        assert story.state.alpha.registration.validity.until_ns_utc is None

    def test_stale_is_an_alarm_with_the_parameter_and_a_dither_is_due(self, story):
        story.wait(80)
        alarm = next(a for a in story.state.alarms.active if a.name == "estimate-stale")
        assert "shift_x_subap, less the model error, has grown beyond 0.05" in alarm.text
        assert story.state.alpha.dither_due_since_ns_utc is not None
        story.see()
        assert not story.alarms
        assert story.state.alpha.dither_due_since_ns_utc is None

    def test_a_sigma_that_the_first_windows_still_bring_down_is_no_alarm(self):
        """On a faint star one says less of α than the limit asks; none that follows is one."""
        story = Story(Mode.HOLD).meet()
        for _ in range(2):
            story.see(covariance=np.diag(1.9 * POLICY.stale_sigma) ** 2)
            assert worth(story) is Validity.STALE
            assert "estimate-stale" not in story.alarms
        story.wait(11)
        assert "estimate-stale" in story.alarms

    def test_an_alarm_that_lasts_says_the_same_all_the_time(self, story):
        story.wait(80)
        texts = set()
        for _ in range(20):
            story.wait(1)
            texts |= {a.text for a in story.state.alarms.active}
        assert len(texts) == 1

    def test_an_open_loop_needs_no_alpha(self, story):
        for _ in range(80):
            story.tell(rtc(loop="open"), after_s=1.0)
            story.tell(ev.Tick())
        assert worth(story) is Validity.STALE
        assert "estimate-stale" not in story.alarms

    def test_a_margin_that_only_a_grown_sigma_takes_away_has_it_dithered_and_is_no_age(self, story):
        edge = verdict(accepted=False, radius=0.7)
        story.tell(ev.MarginJudged(id="initial", verdict=edge))
        story.wait(10)
        assert "estimate-stale" not in story.alarms
        story.see()
        short = verdict(accepted=False, radius=0.97)
        story.tell(ev.MarginJudged(id="initial", verdict=short))
        story.wait(0.2, every_s=0.2)
        assert "estimate-stale" not in story.alarms
        story.state = changed(story.state, dither=None, no_dither_before_ns_utc=2**63)
        story.wait(5)
        assert "estimate-stale" not in story.alarms

    def test_the_alarm_and_the_validity_say_the_same_at_every_moment(self, story):
        """It had come and gone with every window, four times in six seconds, while α was fresh."""
        short = verdict(accepted=False, radius=0.97)
        story.tell(ev.MarginJudged(id="initial", verdict=short))
        for second in range(300):
            story.wait(1)
            if second < 30 and second % 3 == 0:
                story.see()
            stale = worth(story) in {Validity.STALE, Validity.INVALID}
            assert stale is ("estimate-stale" in story.alarms)
        assert story.logged.count("estimate-stale") == 1

    @pytest.mark.parametrize(("share", "stale"), [(0.9, True), (0.7, False)])
    def test_a_sigma_that_wavers_about_the_limit_does_not_come_and_go(self, story, share, stale):
        """A faint window brings σ a little below the limit, and the next seconds above it again."""
        story.wait(80)
        assert "estimate-stale" in story.alarms
        known = story.state.alpha.registration
        sigma = share * POLICY.stale_sigma
        after = replace(known, covariance=np.diag(sigma**2), t_ns_utc=story.state.loop.rtc.t_ns)
        story.state = changed(story.state, registration=replace(after, arrived_ns_utc=story.now_ns))
        story.tell(ev.Tick())
        assert ("estimate-stale" in story.alarms) is stale
        assert (worth(story) is Validity.STALE) is stale

    @pytest.mark.parametrize("of", ["policy", "window"])
    def test_a_model_error_is_not_age(self, story, of):
        """Images somewhere within 0.15 pixel made α ageing at once and for good."""
        floor = np.array([2.0, 2.0, 4.0, 4.0]) * POLICY.useless_sigma
        if of == "policy":
            story = Story(Mode.AUTO, replace(story.policy, floor=floor)).meet()
            story.see(n_windows=2)
        else:
            known = replace(story.state.alpha.registration, floor=floor)
            story.state = changed(story.state, registration=known)
        story.tell(ev.Tick())
        assert worth(story) is Validity.FRESH
        assert np.all(story.state.alpha.registration.sigma > POLICY.useless_sigma)
        story.wait(80)
        assert worth(story) is Validity.STALE

    def test_places_of_images_widen_what_is_shown_and_decide_nothing(self):
        places = np.array([0.04, 0.04, 3e-4, 3e-4])
        stories = [
            Story(Mode.AUTO, replace(POLICY, image_floor=each)).meet()
            for each in (np.zeros(4), places)
        ]
        for story in stories:
            story.see(n_windows=2)
        before, after = (story.state.alpha.registration for story in stories)
        np.testing.assert_array_equal(before.sigma, after.sigma)
        np.testing.assert_array_equal(before.covariance_to_hold_in, after.covariance_to_hold_in)
        np.testing.assert_allclose(after.shown_sigma, np.hypot(before.sigma, places))
        shown = stories[1].state.alpha.history[-1].filtered_sigma
        assert np.all(shown >= places)

    def test_what_is_judged_is_judged_with_the_sigma_of_now(self, story):
        story.wait(40)
        total = story.state.alpha.registration.total_covariance
        grown = PRECISE[0, 0] / 3 + 40 * POLICY.drift_rate[0] ** 2
        assert total[0, 0] > grown


class TestPointing:
    """A telescope that moves bends."""

    def test_a_change_of_elevation_adds_flexure_and_one_of_azimuth_none(self, story):
        before = story.state.alpha.registration.sigma
        point(story, replace(HERE, azimuth_deg=102.0))
        story.wait(1)
        turned = story.state.alpha.registration.sigma
        np.testing.assert_allclose(turned, np.sqrt(before**2 + POLICY.drift_rate**2))
        point(story, replace(HERE, elevation_deg=62.0))
        story.wait(1)
        bent = story.state.alpha.registration.sigma
        added = 2.0 * POLICY.drift_rate**2 + (2.0 * BENDING.flexure_per_degree) ** 2
        np.testing.assert_allclose(bent, np.sqrt(before**2 + added))

    def test_the_next_window_is_believed_as_far_as_the_telescope_has_bent(self, story):
        """Without it 8 % of a subaperture after 2 s would be a jump."""
        point(story, replace(HERE, elevation_deg=64.0))
        story.see(moved(shift_x_subap=0.08))
        assert not story.alarms
        shift = story.state.alpha.registration.alpha.shift_x_subap
        assert shift == pytest.approx(0.2, abs=0.003)

    def test_a_slew_makes_alpha_invalid_until_the_next_window(self, story):
        point(story, replace(HERE, elevation_deg=48.0))
        story.wait(1)
        assert worth(story) is Validity.INVALID
        assert story.state.alpha.dither_due_reason == (
            "the telescope has moved by 12 deg since the last dithered window"
        )
        assert "estimate-stale" in story.alarms
        assert not of_kind(story.make("cm-1"), ev.SendMatrix)
        assert story.matrix_state("cm-1") is MatrixState.PROPOSED
        story.see()
        assert worth(story) is Validity.FRESH
        assert story.state.alpha.registration.n_windows == 1

    def test_a_turn_in_azimuth_is_a_slew_as_well(self, story):
        point(story, replace(HERE, azimuth_deg=130.0))
        story.wait(1)
        assert "moved by 15 deg" in story.state.alpha.registration.validity.reason

    def test_a_status_that_knows_it_overrules_what_was_told(self, story):
        there = Pointing(elevation_deg=30.0, azimuth_deg=0.0)
        story.tell(rtc(pointing=there))
        assert story.state.alpha.pointing == there
        story.tell(rtc())
        assert story.state.alpha.pointing == there

    def test_before_anybody_has_told_nothing_bends(self):
        story = Story(Mode.AUTO, BENDING).meet()
        story.see(n_windows=2)
        point(story, replace(HERE, elevation_deg=10.0))
        story.wait(1)
        assert worth(story) is Validity.FRESH

    @pytest.mark.parametrize(
        ("other", "angle_deg"),
        [
            (Pointing(elevation_deg=60.0, azimuth_deg=100.0), 0.0),
            (Pointing(elevation_deg=45.0, azimuth_deg=100.0), 15.0),
            (Pointing(elevation_deg=60.0, azimuth_deg=460.0), 0.0),
            (Pointing(elevation_deg=60.0, azimuth_deg=280.0), 60.0),
        ],
    )
    def test_the_angle_between_two_directions_is_that_on_the_sky(self, other, angle_deg):
        """Across the zenith: 2 x 30 deg."""
        assert separation_deg(HERE, other) == pytest.approx(angle_deg, abs=1e-5)


def test_nothing_is_due_while_nothing_is_known():
    story = Story(state=TrackerState(system="flao"))
    story.wait(100)
    assert story.state.alpha.dither_due_since_ns_utc is None
    assert not story.alarms


def at(began_s):
    """The beginning of telemetry, so long after the RTC's last status."""
    return START_NS + round(began_s * SECOND)


def void(state, until_s, because, **kwargs):
    return turned(state, void_until, START_NS + round(until_s * SECOND), because, **kwargs)


def test_what_began_before_is_void_whenever_it_is_worked_out():
    state = void(STATE, 10.0, "the edge had slipped")
    assert explain_void(state, at(9.9)) == "the edge had slipped"
    assert explain_void(state, at(10.0)) is None, "a window may begin where the one before it ends"
    assert explain_void(state, at(9.9995)) is None, "but for the rounding of a frame"
    assert explain_void(STATE, at(-1e6)) is None


def test_each_purpose_is_asked_by_itself():
    state = void(STATE, 10.0, "it jumped", purpose=Purpose.PASSIVE)
    assert explain_void(state, at(0.0)) is None
    assert explain_void(state, at(0.0), Purpose.PASSIVE) == "it jumped"
    assert explain_void(state, at(0.0), Purpose.SETTLE) is None


def test_the_first_reason_that_covers_is_told_and_a_later_one_for_what_came_after_it():
    state = void(void(STATE, 5.0, "one"), 10.0, "other")
    assert (explain_void(state, at(4.0)), explain_void(state, at(6.0))) == ("one", "other")


def test_the_same_reason_again_takes_the_place_of_the_last():
    state = void(void(STATE, 10.0, "one"), 5.0, "one")
    assert len(state.alpha.void_intervals) == 1
    assert explain_void(state, at(6.0)) is None


def test_what_was_not_so_after_all_is_valid_again():
    state = void(void(STATE, 5.0, "moved"), 5.0, "slipped")
    assert explain_void(turned(state, make_valid, Purpose.MEASURE, "moved"), at(0.0)) == "slipped"
    assert explain_void(turned(state, make_valid, Purpose.MEASURE), at(0.0)) is None


def test_they_are_bounded_and_old_ones_go():
    state = STATE
    for k in range(3 * INTERVALS_KEPT):
        state = void(state, float(k), f"reason {k}")
    assert len(state.alpha.void_intervals) == INTERVALS_KEPT
    state = void(state, MAX_TELEMETRY_AGE_S + 3 * INTERVALS_KEPT, "long after")
    assert [each.because for each in state.alpha.void_intervals] == ["long after"]


@pytest.mark.parametrize(("ahead_s", "is_void"), [(50.0, True), (70.0, False)])
def test_a_clock_that_was_set_back_makes_nothing_void(ahead_s, is_void):
    state = void(STATE, ahead_s, "one")
    assert (explain_void(state, at(0.0)) is not None) is is_void


def test_telemetry_until_now_is_void_by_the_rtcs_clock_or_by_what_is_known_better():
    now = turned(STATE, invalidate_telemetry, "one")
    better = turned(STATE, invalidate_telemetry, "one", t_ns_utc=START_NS + SECOND)
    assert validity.end_of(now, "one") == START_NS
    assert validity.end_of(better, "one") == START_NS + SECOND
    assert validity.end_of(changed(now, void_intervals=()), "one") == 0
    gone = turned(changed(better, rtc=None), invalidate_telemetry, "one")
    assert validity.end_of(gone, "one") == START_NS + SECOND  # no clock tells more
