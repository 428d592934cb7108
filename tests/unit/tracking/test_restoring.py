"""A night goes on after a restart of the service."""

from dataclasses import replace

import numpy as np
import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.registration import Validity
from service.records.state import Level, Mode, TrackerState
from service.tracking.resume import resumed, saved_of
from service.wire import DitherRequest, DitherStop
from tests.support.situations import (
    ALPHA,
    POLICY,
    PRECISE,
    SECOND,
    START_NS,
    Story,
    moved,
    of_kind,
    rtc,
)
from tests.support.states import changed, tracker_state


@pytest.fixture
def before():
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=5)
    return story


def restarted(before, away_s, **changes):
    """The service this much later, with nothing but what the one before has saved."""
    saved = saved_of(before.state, before.now_ns)
    now_ns = before.now_ns + round(away_s * SECOND)
    fresh = tracker_state(**({"system": "flao", "mode": Mode.AUTO} | changes))
    again = Story(state=resumed(fresh, saved, POLICY, now_ns))
    again.now_ns = now_ns
    return again


def test_nothing_is_saved_while_nothing_is_known():
    assert saved_of(TrackerState(system="flao"), START_NS) is None


def test_alpha_is_known_at_once_with_its_sigma_grown_by_the_time_away(before):
    again = restarted(before, 100.0)
    known = again.state.alpha.registration
    assert known.alpha == before.state.alpha.registration.alpha
    walked = POLICY.drift_rate**2 * 100.0
    expected = np.sqrt(
        np.diag(before.state.alpha.registration.covariance) + walked + POLICY.floor**2
    )
    np.testing.assert_allclose(known.sigma, expected)
    assert known.restored_ns_utc == again.now_ns
    assert again.state.log[0].text == "α of 100 s ago; initial was in use then"
    assert again.state.alpha.dither_due_since_ns_utc == again.now_ns


def test_nothing_is_made_from_it_until_windows_confirm_it(before):
    again = restarted(before, 5.0)
    assert again.state.alpha.registration.validity.level is Validity.STALE
    again.meet()
    assert not of_kind(again.wait(20), ev.MakeMatrix)
    assert not of_kind(again.see(), ev.MakeMatrix)
    assert of_kind(again.see(), ev.MakeMatrix)


def test_a_window_is_weighed_against_the_time_away(before):
    """An hour: what was known counts for nothing beside a window."""
    again = restarted(before, 3600.0).meet()
    again.see(moved(shift_x_subap=0.05))
    known = again.state.alpha.registration
    assert known.alpha.shift_x_subap == pytest.approx(ALPHA.shift_x_subap + 0.05, abs=2e-4)
    assert known.covariance[0, 0] == pytest.approx(PRECISE[0, 0], rel=0.01)


def test_a_window_that_disagrees_is_a_suspected_jump_as_ever(before):
    again = restarted(before, 5.0).meet()
    again.see(moved(shift_x_subap=0.2))
    assert "jump-suspected" in again.alarms


def test_a_restored_alpha_that_no_window_finds_is_dropped(before):
    """It is 2.8 deg off: fits that begin there are refused, those of an unknown α are not."""
    off = moved(ALPHA, rotation_rad=np.deg2rad(2.8))
    before.state = changed(
        before.state, registration=replace(before.state.alpha.registration, alpha=off)
    )
    again = restarted(before, 5.0).meet()
    again.see(n_windows=2)
    assert again.state.alpha.registration.alpha == off
    again.see()
    assert again.state.alpha.registration is None
    assert "alpha-not-restored" in again.alarms
    assert of_kind(again.see(n_windows=2), ev.MakeMatrix)
    assert again.state.alpha.registration.alpha.vector == pytest.approx(ALPHA.vector, abs=1e-3)
    assert "alpha-not-restored" not in again.alarms


def test_a_doubt_survives_but_the_window_that_raised_it_does_not(before):
    before.see(moved(shift_x_subap=0.2))
    again = restarted(before, 5.0)
    assert again.state.alpha.registration.suspected_jump is None
    assert again.state.alpha.registration.validity.level is Validity.INVALID
    again.meet()
    again.see()
    assert again.state.alpha.registration.usable


@pytest.mark.parametrize(
    ("changes", "away_s", "reason"),
    [
        ({"system": "other"}, 5.0, "of system flao, this is other"),
        ({"basis_id": "kl-300"}, 5.0, "of basis kl-594, the instrument file has kl-300"),
        ({"config_id": "binned"}, 5.0, "of configuration pyramid-30"),
        ({}, -3600.0, "3600 s in the future"),
    ],
)
def test_what_does_not_fit_is_left_and_said(before, changes, away_s, reason):
    again = restarted(before, away_s, **changes)
    assert again.state.alpha.registration is None
    (entry,) = (e for e in again.state.log if e.name == "registration.not-restored")
    assert entry.level is Level.WARNING
    assert reason in entry.text
    assert reason in again.state.alarm("alpha-not-restored").text
    again.meet()
    again.see()
    assert again.state.alarm("alpha-not-restored") is None, "α is known again"


def test_what_does_not_fit_the_rtc_that_comes_is_dropped(before):
    known = replace(before.state.alpha.registration, basis_id="kl-300")
    before.state = changed(before.state, registration=known)
    again = restarted(before, 5.0)
    assert again.state.alpha.registration is not None
    again.meet()
    assert again.state.alpha.registration is None


# --- what an operator has ordered outlives the service


def ordered_before(before, mode=Mode.AUTO, **changes):
    """Return the service five seconds later, its settings saying ``mode``."""
    now_ns = before.now_ns + 5 * SECOND
    fresh = tracker_state(**({"system": "flao", "mode": mode} | changes))
    saved = saved_of(before.state, before.now_ns)
    state = fresh if saved is None else resumed(fresh, saved, POLICY, now_ns)
    again = Story(state=state)
    again.now_ns = now_ns
    return again


@pytest.fixture
def rolled_back():
    """In auto, by the settings; the operator has gone back to the matrix before."""
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=3)
    story.use("cm-1").use("cm-2")
    story.tell(cmd.Rollback())
    story.make("copy", alpha=ALPHA, wanted=True)
    story.acknowledge("copy")
    assert story.state.operator.mode is Mode.HOLD
    return story


class TestTheMode:
    def test_a_matrix_gone_back_to_is_not_replaced_after_a_restart(self, rolled_back):
        again = ordered_before(rolled_back)
        assert again.state.operator.mode is Mode.HOLD
        again.meet(cm_id="copy")
        again.see(replace(ALPHA, shift_x_subap=0.3), n_windows=10)
        assert not again.asked(ev.MakeMatrix)
        (entry,) = [entry for entry in again.state.log if entry.name == "mode"]
        assert entry.level is Level.WARNING
        assert "mode is hold, as an operator set it" in entry.text
        assert "not auto as the settings say; set the mode to" in entry.text

    def test_it_stands_through_two_restarts(self, rolled_back):
        assert ordered_before(ordered_before(rolled_back)).state.operator.mode is Mode.HOLD

    def test_settings_that_have_been_changed_since_have_the_last_word(self, rolled_back):
        again = ordered_before(rolled_back, Mode.PROPOSE)
        assert again.state.operator.mode is Mode.PROPOSE
        assert ordered_before(again, Mode.AUTO).state.operator.mode is Mode.AUTO

    def test_what_was_said_last_counts(self, rolled_back):
        rolled_back.tell(cmd.SetMode(mode=Mode.PROPOSE))
        assert ordered_before(rolled_back).state.operator.mode is Mode.PROPOSE
        rolled_back.tell(cmd.SetMode(mode=Mode.AUTO))
        again = ordered_before(rolled_back)
        assert again.state.operator.mode is Mode.AUTO
        assert "mode" not in again.logged

    def test_where_nobody_has_ordered_one_the_settings_may_change_it(self):
        story = Story(Mode.HOLD).meet()
        story.see(n_windows=3)
        again = ordered_before(story, Mode.AUTO)
        assert again.state.operator.mode is Mode.AUTO
        assert "mode" not in again.logged


class TestTheDither:
    def test_off_it_stays_off_until_the_operator_wants_it(self):
        story = Story().meet()
        story.tell(cmd.StopDither())
        again = ordered_before(story)
        again.meet()
        again.wait(60)
        assert not again.asked(DitherRequest)
        assert again.state.dithers.policy.reason == "stopped by the operator"
        assert of_kind(again.tell(cmd.StartDither()), DitherRequest)
        assert not ordered_before(again).state.dithers.stopped

    def test_what_the_dead_service_left_on_the_mirror_is_stopped(self):
        story = Story().meet()
        dither = replace(story.state.dithers.dither, start_seq=1000, asked_ns_utc=0)
        story.tell(cmd.StopDither())
        again = ordered_before(story).meet(dither_id=dither.id, dither=dither)
        assert again.asked(DitherStop)
        assert again.state.dithers.dither is None


@pytest.mark.parametrize("changes", [{"basis_id": "kl-300"}, {"config_id": "binned"}])
def test_orders_stand_where_alpha_does_not_fit(rolled_back, changes):
    rolled_back.tell(cmd.StopDither())
    again = ordered_before(rolled_back, **changes)
    assert again.state.alpha.registration is None
    assert (again.state.operator.mode, again.state.dithers.stopped) == (Mode.HOLD, True)


def test_those_for_another_system_are_none(rolled_back):
    rolled_back.tell(cmd.StopDither())
    again = ordered_before(rolled_back, system="other")
    assert (again.state.operator.mode, again.state.dithers.stopped) == (Mode.AUTO, False)


def test_a_new_session_of_the_rtc_undoes_none(rolled_back):
    rolled_back.tell(cmd.StopDither())
    rolled_back.tell(ev.SessionStarted(session="s2"))
    rolled_back.tell(rtc(session="s2"))
    assert (rolled_back.state.operator.mode, rolled_back.state.dithers.stopped) == (
        Mode.HOLD,
        True,
    )
