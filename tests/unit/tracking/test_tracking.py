"""Jumps and outliers: what one window far out may do, and what it takes two for."""

from dataclasses import replace

import numpy as np
import pytest

from service.errors import CommandError
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import MatrixState
from service.records.registration import Source, Validity
from service.records.state import Level, Mode
from tests.support.situations import (
    ALPHA,
    POLICY,
    PRECISE,
    SECOND,
    START_NS,
    Story,
    estimate,
    moved,
    of_kind,
    rtc,
)
from tests.support.states import changed

THERE = moved(shift_x_subap=0.1)


@pytest.fixture
def story():
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=3)
    return story


@pytest.fixture
def calm():
    """A mirror that hardly drifts, well known."""
    story = Story(Mode.AUTO, replace(POLICY, drift_rate=POLICY.drift_rate / 10.0)).meet()
    story.see(n_windows=8)
    return story


class TestSuspicion:
    """One window far out."""

    def test_it_is_flagged_at_once_and_does_not_move_the_registration(self, story):
        before = story.state.alpha.registration
        story.see(THERE)
        known = story.state.alpha.registration
        assert known.alpha == before.alpha
        assert known.suspected_jump.alpha == THERE
        assert "jump-suspected" in story.alarms
        entry = next(e for e in story.state.log if e.name == "registration.jump-suspected")
        assert entry.level is Level.WARNING
        assert "+0.100" in entry.text
        assert story.state.windows.accepted == 3

    def test_nothing_may_be_made_from_it(self, story):
        story.use("cm-1", 400)
        story.wait(10)
        story.see(n_windows=2)
        made = len(story.asked(ev.MakeMatrix))
        story.see(THERE)
        assert story.state.alpha.registration.validity.level is Validity.INVALID
        assert not story.state.alpha.registration.usable
        story.wait(20)
        assert len(story.asked(ev.MakeMatrix)) == made

    def test_a_matrix_under_way_when_it_comes_is_kept_but_not_sent(self, story):
        story.see(THERE)
        assert not of_kind(story.make("cm-1"), ev.SendMatrix)
        assert story.matrix_state("cm-1") is MatrixState.PROPOSED
        with pytest.raises(CommandError, match="jump is suspected"):
            story.tell(cmd.Approve(id="cm-1"))

    def test_one_that_is_made_while_it_jumps_is_not_sent_and_another_is_made_at_once(self, story):
        assert story.state.matrices.making_since_ns_utc is not None
        story.see(THERE, n_windows=3)
        effects = story.make("cm-1", alpha=ALPHA)
        assert not of_kind(effects, ev.SendMatrix)
        assert of_kind(effects, ev.MakeMatrix)
        assert story.matrix_state("cm-1") is MatrixState.DISCARDED
        assert of_kind(story.make("cm-2"), ev.SendMatrix)

    def test_a_dither_is_due_until_a_window_has_decided(self, story):
        story.see(THERE)
        assert story.state.alpha.dither_due_since_ns_utc == story.now_ns
        assert "jump" in story.state.alpha.dither_due_reason
        story.see()
        assert story.state.alpha.dither_due_since_ns_utc is None

    def test_nobody_waits_for_the_deciding_window_for_ever(self, story):
        story.see(THERE)
        story.wait(61)
        assert story.state.alpha.registration.suspected_jump is None
        assert story.state.alpha.registration.validity.level is Validity.INVALID


class TestDecision:
    """The window after it."""

    def test_one_that_agrees_makes_it_a_jump_with_both_windows_in_the_estimate(self, story):
        story.see(THERE)
        story.see(moved(THERE, shift_x_subap=0.002))
        known = story.state.alpha.registration
        assert known.alpha.shift_x_subap == pytest.approx(THERE.shift_x_subap + 0.001, abs=1e-3)
        assert known.n_windows == 2
        assert known.suspected_jump is None
        assert known.usable
        assert "jump-suspected" not in story.alarms
        entry = next(e for e in story.state.log if e.name == "registration.jump")
        assert entry.level is Level.WARNING
        assert story.state.windows.accepted == 5
        # half the variance of one, and the walk between the two
        walked = 2.0 * story.policy.drift_rate[0] ** 2
        assert PRECISE[0, 0] / 2 < known.covariance[0, 0] < (PRECISE[0, 0] + walked) / 2

    def test_then_a_matrix_is_made_for_the_new_place_at_once(self):
        """Flagged within 5 s, a matrix wanted within two windows of 2 s: 11 s remain for it."""
        story = Story(Mode.AUTO, replace(POLICY, n_modes_target=400)).meet()
        story.see(n_windows=2)
        story.use("cm-1", 400)
        story.see(n_windows=5)
        jumped_ns = story.now_ns
        assert not of_kind(story.see(THERE), ev.MakeMatrix)
        assert "jump-suspected" in story.alarms
        assert story.now_ns - jumped_ns <= 5 * SECOND
        (made,) = of_kind(story.see(THERE), ev.MakeMatrix)
        assert made.why.startswith("moved by +0.1")
        assert story.now_ns - jumped_ns <= 4 * SECOND

    def test_one_that_agrees_with_all_before_makes_it_an_outlier(self, story):
        story.see(THERE)
        story.see()
        known = story.state.alpha.registration
        np.testing.assert_allclose(known.alpha.vector, ALPHA.vector, atol=1e-12)
        assert known.n_windows == 4
        assert (story.state.windows.accepted, story.state.windows.outlying) == (4, 1)
        assert "window.outlier" in story.logged
        assert "registration.jump" not in story.logged
        assert not story.alarms

    def test_one_that_agrees_with_neither_is_held_in_its_place(self, story):
        story.see(THERE)
        story.see(moved(shift_y_subap=-0.2))
        known = story.state.alpha.registration
        assert known.suspected_jump.alpha == moved(shift_y_subap=-0.2)
        assert known.alpha == story.state.alpha.history[2].filtered
        assert story.state.windows.outlying == 1
        assert not known.usable

    def test_the_window_in_which_it_jumped_is_between_both_places_and_bends_nothing(self, story):
        """So far away that it confirms the one after it: those two are enough."""
        story.see(moved(shift_x_subap=0.05))
        for n_windows in (2, 3):
            story.see(THERE)
            known = story.state.alpha.registration
            assert known.alpha.shift_x_subap == pytest.approx(THERE.shift_x_subap, abs=0.002)
            assert known.n_windows == n_windows

    def test_a_jump_in_the_middle_of_a_window_is_seen_by_the_one_after_it(self, story):
        """Half of 0.026 deg is 3 σ of what is expected, all of it seen from before 5.6 σ."""
        half, there = moved(rotation_rad=np.deg2rad(0.013)), moved(rotation_rad=np.deg2rad(0.026))
        story.see(half)
        assert "jump-suspected" not in story.alarms
        story.see(there)
        assert "registration.jump" in story.logged
        story.see(there)
        known = story.state.alpha.registration
        assert known.alpha.rotation_rad == pytest.approx(there.rotation_rad, abs=5e-5)
        assert "registration.jump" in story.logged

    def test_one_that_no_window_alone_tells_is_named_by_two_that_agree(self, calm):
        """0.012 deg are 3.4 σ of what is expected of a window, 4.1 σ of the mean of two."""
        story, there = calm, moved(rotation_rad=np.deg2rad(0.012))
        story.see(there)
        assert not {"registration.jump", "registration.jump-suspected"} & {*story.logged}
        story.see(there)
        assert "registration.jump" in story.logged
        assert "registration.jump-suspected" not in story.logged
        known = story.state.alpha.registration
        assert known.jumped_ns_utc == story.now_ns
        assert known.alpha.rotation_rad == pytest.approx(there.rotation_rad, abs=1e-5)

    def test_windows_on_either_side_name_none(self, calm):
        for turn in (0.012, -0.012, 0.012, -0.012):
            calm.see(moved(rotation_rad=np.deg2rad(turn)))
        assert "registration.jump" not in calm.logged

    def test_an_outlier_next_to_an_unlucky_window_is_none(self, calm):
        calm.see(moved(rotation_rad=np.deg2rad(0.006)))
        calm.see(moved(rotation_rad=np.deg2rad(0.03)))
        assert "registration.jump" not in calm.logged
        calm.see(n_windows=1)
        assert "window.outlier" in calm.logged
        assert "registration.jump" not in calm.logged

    def test_what_is_half_before_it_does_not_bend_what_is_known_after_it(self, calm):
        """The first window after a jump agrees with the second by its noise, and is of both."""
        story, step = calm, np.deg2rad(0.02)
        story.see(moved(rotation_rad=0.6 * step))
        story.see(moved(rotation_rad=step))
        known = story.state.alpha.registration
        assert "registration.jump" in story.logged
        assert known.n_windows == 1
        assert known.alpha.rotation_rad == pytest.approx(ALPHA.rotation_rad + step, abs=1e-5)

    def test_a_drift_ten_times_faster_than_expected_is_no_jump_after_another(self, story):
        for k in range(1, 20):
            story.see(moved(shift_x_subap=0.01 * k))
        assert "registration.jump" not in story.logged
        shift = story.state.alpha.registration.alpha.shift_x_subap
        assert shift == pytest.approx(ALPHA.shift_x_subap + 0.19, abs=0.005)

    def test_outliers_in_a_row_never_move_it_while_no_two_agree(self, story):
        rng = np.random.default_rng(2)
        for _ in range(20):
            far = dict(
                zip(("shift_x_subap", "shift_y_subap"), rng.uniform(-0.5, 0.5, 2), strict=True)
            )
            story.see(moved(**far))
        known = story.state.alpha.registration
        assert (
            np.abs(known.alpha.vector - ALPHA.vector).max() < 1e-6
            or known.suspected_jump is not None
        )

    def test_the_history_says_which_windows_entered(self, story):
        story.see(THERE)
        story.see()
        assert [entry.entered for entry in story.state.alpha.history] == [
            True,
            True,
            True,
            False,
            True,
        ]
        assert {entry.source for entry in story.state.alpha.history} == {Source.LOCK_IN}


class TestTime:
    """Which clock tells how old α is."""

    def test_a_clock_set_back_does_not_stop_the_walk(self, story):
        """An hour earlier by the RTC, a minute later by arrival: a minute has passed."""
        before = story.state.alpha.registration
        story.now_ns += 60 * SECOND
        early = estimate(t_ns=START_NS - 3600 * SECOND, covariance=1e6 * PRECISE)
        story.tell(ev.WindowFitted(estimate=replace(early, covariance=PRECISE * 100.0)))
        after = story.state.alpha.registration
        walked = before.covariance[0, 0] + 60.0 * story.policy.drift_rate[0] ** 2
        expected = 1.0 / (1.0 / walked + 1.0 / (100.0 * PRECISE[0, 0]))
        assert after.covariance[0, 0] == pytest.approx(expected, rel=0.02)

    def test_after_a_long_silence_a_window_stands_alone(self, story):
        story.wait(300)
        story.see(moved(shift_x_subap=0.05))
        assert story.state.alpha.registration.n_windows == 1

    def test_an_alpha_of_another_basis_is_dropped_when_the_rtc_names_its_own(self, story):
        known = replace(story.state.alpha.registration, basis_id="kl-300")
        story.state = changed(story.state, registration=known)
        story.tell(rtc())
        assert story.state.alpha.registration is None
        assert "kl-300" in next(e.text for e in story.state.log if e.name == "registration.void")
