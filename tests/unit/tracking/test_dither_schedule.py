"""As little dither as serves: when it is on, how strong, where, and that it costs what it says."""

from dataclasses import replace
from functools import cache

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from service.control.dither import look_up_precision
from service.errors import CommandError
from service.estimation.windows import DITHER_SETTLING_S
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.dither_plan import (
    FAINT_WINDOW_S,
    MAX_DITHER_DURATION_S,
    MIN_WINDOWS_FOR_PAUSE,
    budget_m,
)
from service.tracking.dither_request import DitherPhase, total_m
from service.wire import DitherRequest, DitherStop
from tests.states import changed
from tests.unit.tracking.dithered import DitheredNight
from tests.unit.tracking.situations import ALPHA, POLICY, Story, moved, of_kind

FAST = np.array([0.05, 0.05, np.deg2rad(0.05), 0.0005]) / np.sqrt(60.0)
"""The default flexure: 5 % of a subaperture in a minute."""

BRISK = replace(POLICY, drift_rate=FAST, longest_pause_s=60.0)
CALM = replace(BRISK, drift_rate=FAST / 10.0)


def sigma_of(story):
    return np.sqrt(np.diag(story.state.alpha.registration.covariance))


@cache
def brisk_night():
    """Two minutes that tests only look at."""
    return DitheredNight(BRISK).live(120)


@cache
def calm_night():
    """Five minutes that tests only look at."""
    return DitheredNight(CALM).live(320)


class TestHowMuch:
    def test_until_alpha_is_known_the_whole_budget_without_pause(self):
        night = DitheredNight(CALM).live(4)
        assert night.state.dithers.policy.phase is DitherPhase.ACQUIRE
        assert total_m(night.requests[0]) == pytest.approx(CALM.dither_budget_m)
        night.live(4)
        assert night.state.alpha.registration.n_windows >= MIN_WINDOWS_FOR_PAUSE
        assert night.state.dithers.policy.phase is not DitherPhase.ACQUIRE

    def test_a_calm_mirror_is_looked_at_once_a_minute(self):
        night = calm_night()
        later = np.array(night.lived[40:])
        assert night.state.dithers.policy.phase is DitherPhase.SPARSE
        assert np.mean(later > 0.0) < 0.1
        assert np.all(sigma_of(night) < CALM.dither_sigma)
        assert len(night.requests) <= 7

    def test_a_brisk_one_is_followed_without_pause(self):
        night = brisk_night()
        assert night.state.dithers.policy.phase is DitherPhase.FOLLOW
        assert np.mean(np.array(night.lived[40:]) > 0.0) > 0.9

    def test_ordinary_telemetry_spares_most_of_it_and_what_is_left_costs_what_it_says(self):
        night = DitheredNight(BRISK, looks=True).live(300)
        assert night.state.dithers.policy.phase is DitherPhase.SPARSE
        assert night.share_on < 0.4
        assert np.all(sigma_of(night) < 2.0 * BRISK.dither_sigma)
        shown = np.sqrt(night.state.dithers.policy.mean_square_m2)
        # of a memory of ten minutes, five
        assert shown == pytest.approx(night.mean_m * np.sqrt(1.0 - np.exp(-0.5)), rel=0.15)

    def test_of_a_bright_star_less_is_needed(self):
        bright, faint = DitheredNight(BRISK, magnitude=7.0).live(120), brisk_night()
        assert total_m(bright.requests[-1]) < total_m(faint.requests[-1])

    @pytest.mark.parametrize(
        ("budget_m", "magnitude"), [(1e-9, 7.0), (1e-9, 12.5), (3e-9, 10.0), (8e-9, 7.0)]
    )
    def test_no_budget_is_ever_exceeded(self, budget_m, magnitude):
        policy = replace(BRISK, dither_budget_m=budget_m)
        night = DitheredNight(policy, magnitude=magnitude, looks=True).live(100)
        assert 0.0 < max(night.lived) <= budget_m * (1.0 + 1e-9)

    def test_faint_stars_have_long_windows(self):
        night = DitheredNight(BRISK, magnitude=12.5).live(60)
        assert all(window_s >= FAINT_WINDOW_S for window_s in night.windows_s)
        assert night.state.windows.accepted >= 5

    def test_a_nanometre_is_enough_for_half_a_percent_of_a_calm_mirror(self):
        policy = replace(CALM, dither_budget_m=1e-9, drift_rate=FAST / 100.0)
        night = DitheredNight(policy, kappa=look_up_precision(10.0) / 2.0).live(180)
        assert sigma_of(night)[0] < 0.005
        assert max(night.lived) <= 1e-9 * (1.0 + 1e-9)

    def test_the_settings_amplitude_is_taken_as_it_is(self):
        night = DitheredNight(replace(CALM, dither_amplitude_m=1e-9)).live(30)
        assert {d.amplitude_m for d in night.requests} == {(1e-9,) * 4}

    def test_without_pauses_when_the_settings_say_so(self):
        night = DitheredNight(replace(CALM, longest_pause_s=0.0)).live(100)
        assert np.mean(np.array(night.lived[20:]) > 0.0) > 0.9


class TestPrecision:
    def test_what_windows_show_replaces_the_table(self):
        night = DitheredNight(CALM, kappa=look_up_precision(10.0) / 10.0).live(60)
        np.testing.assert_allclose(night.state.dithers.policy.precision.ratio, 0.1, rtol=1e-6)
        wary = DitheredNight(CALM).live(60)
        assert (
            night.state.dithers.policy.plan.total_m < 0.7 * wary.state.dithers.policy.plan.total_m
        )

    def test_it_is_kept_from_star_to_star_and_from_session_to_session(self):
        night = DitheredNight(CALM, kappa=look_up_precision(10.0) / 3.0).live(30)
        night.tell(ev.RtcVanished())
        night.meet(session="s2", magnitude=7.0)
        assert night.state.dithers.policy.precision.n_windows >= 3

    def test_a_refused_window_teaches_nothing(self):
        night = DitheredNight(CALM, kappa=look_up_precision(10.0) * 15.0)
        night.live(30)
        assert night.state.windows.accepted == 0
        assert night.state.dithers.policy.precision is None


class TestWhen:
    def test_doubt_is_answered_at_once_with_the_whole_budget(self):
        night = DitheredNight(CALM).live(60)
        while night.playing is not None:
            night.live(0.5)
        night.state = changed(night.state, dither_due_since_ns_utc=1, dither_due_reason="a doubt")
        asked = of_kind(night.tell(ev.Tick()), DitherRequest)
        assert [total_m(a) for a in asked] == pytest.approx([CALM.dither_budget_m])
        assert night.state.dithers.policy.reason == "a doubt"

    def test_a_dither_that_has_done_its_work_is_stopped(self):
        night = DitheredNight(CALM).live(15)
        assert night.playing is None
        assert "dither.stopped" in night.logged
        assert night.requests[0].duration_s > 20.0
        assert night.state.dithers.policy.next_ns_utc > night.now_ns

    def test_the_one_just_stopped_is_not_adopted_while_the_status_still_shows_it(self):
        night = DitheredNight(CALM)
        running = None
        while night.playing is not None or running is None:
            running = night.playing or running
            night.live(0.5)
        shown = replace(night.view, seq=night.seq, dither=running)
        night.tell(shown, 0.5)
        assert night.state.dithers.dither is None

    def test_an_rtc_that_does_not_stop_it_is_not_asked_for_ever_and_read_all_the_same(self):
        night = DitheredNight(CALM)
        night.deaf = True
        night.live(25)
        assert 1 <= len(night.asked(DitherStop)) <= 3
        assert night.state.dithers.dither.id == night.requests[0].id
        assert night.state.windows.accepted > MIN_WINDOWS_FOR_PAUSE + 2

    def test_no_request_outlives_a_dead_service_for_long(self):
        night = brisk_night()
        assert max(dither.duration_s for dither in night.requests) <= MAX_DITHER_DURATION_S + 5.0

    def test_a_sitting_lasts_for_its_windows_and_no_longer(self):
        night = calm_night()
        last = night.requests[-1]
        n_windows = (last.duration_s - DITHER_SETTLING_S) / night.windows_s[-1]
        assert 1.0 <= n_windows < 3.5
        assert last.duration_s < 7.5

    def test_a_moved_mirror_brings_it_back(self):
        def alpha(t_s):
            return moved(ALPHA, shift_x_subap=0.2 if t_s > 100 else 0.0)

        night = DitheredNight(CALM, alpha=alpha).live(240)
        assert night.state.alpha.registration.alpha.shift_x_subap == pytest.approx(0.32, abs=0.02)

    def test_stopped_by_the_operator_it_says_so_and_stays_off(self):
        night = DitheredNight(BRISK).live(30)
        night.pass_on(night.tell(cmd.StopDither()))
        n_requests = len(night.requests)
        night.live(120)
        assert len(night.requests) == n_requests
        assert night.state.dithers.policy.phase is DitherPhase.OFF
        assert night.state.dithers.policy.reason == "stopped by the operator"
        night.pass_on(night.tell(cmd.StartDither()))
        assert len(night.requests) == n_requests + 1
        night.live(60)
        assert night.state.dithers.policy.phase is DitherPhase.FOLLOW

    def test_an_operators_own_is_left_alone_to_its_end(self):
        night = DitheredNight(CALM).live(60)
        night.pass_on(night.tell(cmd.StopDither()))
        night.pass_on(night.tell(cmd.StartDither(amplitude_m=1e-9, duration_s=20.0)))
        night.live(15)
        assert night.state.dithers.policy.phase is DitherPhase.OPERATOR
        assert night.playing.id.startswith("operator-")
        night.live(10)
        assert night.playing is None

    def test_an_operators_own_has_the_stars_windows_and_keeps_clear_of_vibrations(self):
        night = DitheredNight(CALM, magnitude=12.5).live(60)
        night.tell(ev.Vibrations(lines_hz=(239.0,)))
        night.pass_on(night.tell(cmd.StopDither()))
        night.pass_on(night.tell(cmd.StartDither(amplitude_m=1e-9)))
        asked = night.requests[-1]
        assert night.windows_s[-1] >= FAINT_WINDOW_S
        assert min(abs(line - 239.0) for line in asked.frequency_hz) >= 8.0

    def test_small_changes_of_the_optimum_change_nothing(self):
        night = DitheredNight(BRISK).live(60)
        before = night.requests[-1]
        night.kappa = 1.1 * night.kappa
        night.live(90)
        assert night.requests[-1].amplitude_m == before.amplitude_m
        assert night.requests[-1].frequency_hz == before.frequency_hz


class TestLines:
    def clear(self, dither, vibration_hz):
        return min(abs(line - vibration_hz) for line in dither.frequency_hz)

    def test_they_move_off_a_vibration_with_the_next_request_and_stay_there(self):
        night = DitheredNight(BRISK).live(40)
        assert self.clear(night.requests[-1], 239.0) < 1.0
        night.tell(ev.Vibrations(lines_hz=(239.0,)))
        assert "vibrations" in night.logged
        night.live(60)
        assert self.clear(night.requests[-1], 239.0) >= 8.0
        last = night.requests[-1].frequency_hz
        night.tell(ev.Vibrations(lines_hz=()))
        night.live(60)
        assert night.requests[-1].frequency_hz == last

    def test_lines_the_settings_fix_stay_and_are_named(self):
        fixed = replace(
            BRISK,
            dither_modes=(501, 502),
            dither_frequencies_hz=(210.0, 260.0),
            dither_avoid_hz=(212.0,),
        )
        night = DitheredNight(fixed)
        assert night.requests[0].frequency_hz == (210.0, 260.0)
        assert "lines at (210.0,) Hz are on vibrations" in night.state.log[-2].text

    def test_a_vibration_the_settings_know_is_avoided_from_the_start(self):
        night = DitheredNight(replace(BRISK, dither_avoid_hz=(211.0,)))
        assert self.clear(night.requests[0], 211.0) >= 8.0
        assert night.state.dithers.policy.avoided_hz == (211.0,)

    def test_where_vibrations_leave_no_room_the_lines_stay(self):
        everywhere = tuple(np.arange(190.0, 370.0, 5.0))
        night = DitheredNight(replace(BRISK, dither_avoid_hz=everywhere)).live(20)
        assert night.requests
        assert "dither.on-vibrations" in night.logged
        assert night.state.windows.accepted > 0


class TestOperatorsBudget:
    @pytest.fixture
    def story(self):
        story = Story(policy=replace(POLICY, dither_budget_m=8e-9)).meet()
        story.tell(cmd.StopDither())
        return story

    def test_more_than_the_budget_must_be_meant(self, story):
        with pytest.raises(CommandError, match="20 nm RMS in all, budget 8 nm; say over_budget"):
            story.tell(cmd.StartDither(amplitude_m=10e-9))
        story.tell(cmd.StartDither(amplitude_m=10e-9, over_budget=True))
        assert "over budget, as asked" in story.state.log[-1].text

    def test_within_the_budget_nothing_need_be_said(self, story):
        story.tell(cmd.StartDither(amplitude_m=4e-9))
        assert total_m(story.asked(DitherRequest)[-1]) == pytest.approx(8e-9)


telescopes = st.fixed_dictionaries(
    {
        "max_dither_m": st.floats(1e-10, 1e-7),
        "max_dither_modes": st.integers(1, 8),
        "magnitude": st.none() | st.floats(4.0, 15.0),
        "frame_rate_hz": st.sampled_from([500.0, 800.0, 1000.0, 1700.0, 2000.0]),
    }
)
policies = st.builds(
    lambda budget, sigma, drift, pause, avoid: replace(
        POLICY,
        dither_budget_m=budget,
        dither_sigma=POLICY.dither_sigma * sigma,
        drift_rate=FAST * drift,
        longest_pause_s=pause,
        dither_avoid_hz=tuple(avoid),
    ),
    budget=st.floats(3e-10, 3e-8),
    sigma=st.floats(0.1, 10.0),
    drift=st.floats(1e-4, 10.0),
    pause=st.sampled_from([0.0, 20.0, 60.0]),
    avoid=st.lists(st.floats(50.0, 450.0), max_size=3),
)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(telescopes, policies, st.lists(st.floats(100.0, 500.0), max_size=3), st.booleans())
def test_every_dither_asked_for_obeys_budget_limits_and_clearances(
    telescope, policy, vibrations, due
):
    night = DitheredNight(policy, looks=True, **telescope).live(6)
    night.tell(ev.Vibrations(lines_hz=tuple(vibrations)))
    if due:
        night.state = changed(night.state, dither_due_since_ns_utc=1)
    known = len(night.requests)
    night.live(40)
    view = night.view
    for number, dither in enumerate(night.requests):
        window_s = night.windows_s[number]
        assert total_m(dither) <= policy.dither_budget_m * (1.0 + 1e-9)
        assert max(dither.amplitude_m) <= view.max_dither_m * (1.0 + 1e-9)
        assert len(set(dither.modes)) == len(dither.modes) <= view.max_dither_modes
        assert max(dither.modes) < view.n_modes
        assert dither.duration_s <= MAX_DITHER_DURATION_S + 2.0 * DITHER_SETTLING_S + window_s
        avoid = (*policy.dither_avoid_hz, *(vibrations if number >= known else ()))
        gaps = [abs(line - vibration) for line in dither.frequency_hz for vibration in avoid]
        assert min(gaps, default=8.0) >= 8.0 - 1e-6
    assert budget_m(view, policy) <= policy.dither_budget_m
