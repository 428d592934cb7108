import re
from dataclasses import replace

import numpy as np
import pytest

from service.estimation.estimate import MODEL_ERROR_VARIANCE_RATIO
from service.estimation.windows import RefusalKind, WindowRefused
from service.model.misregistration import Misregistration
from service.tracking import events as ev
from service.tracking.filtering import HISTORY_LENGTH
from service.tracking.state import Level, Mode
from tests.states import changed
from tests.unit.tracking.situations import (
    ALPHA,
    POLICY,
    PRECISE,
    START_NS,
    Story,
    estimate,
    moved,
)


@pytest.fixture
def story():
    return Story(Mode.HOLD).meet()


def test_the_first_window_becomes_the_registration_with_the_floor_in_its_sigma(story):
    story.see()
    known = story.state.alpha.registration
    assert known.alpha == ALPHA
    np.testing.assert_allclose(known.covariance, PRECISE)
    np.testing.assert_allclose(known.sigma, np.hypot([0.002, 0.002, 5e-5, 2e-4], known.floor))
    assert (known.n_windows, known.optical_gain) == (1, pytest.approx(0.6))
    assert story.state.windows.accepted == 1


def test_two_equal_windows_halve_the_variance_but_for_the_walk_between_them(story):
    story.see(n_windows=2)
    walked = PRECISE + np.diag(story.policy.drift_rate**2 * 2.0)
    expected = np.linalg.inv(np.linalg.inv(walked) + np.linalg.inv(PRECISE))
    np.testing.assert_allclose(story.state.alpha.registration.covariance, expected)
    assert story.state.alpha.registration.n_windows == 2


def test_what_the_model_does_not_explain_stays_in_sigma_however_many_windows_agree(story):
    story.see(n_windows=20, misfit=3.0)
    known, noise = story.state.alpha.registration, np.diag(PRECISE)
    np.testing.assert_allclose(
        known.floor**2, story.policy.floor**2 + MODEL_ERROR_VARIANCE_RATIO * 2.0 * noise
    )
    assert np.all(known.sigma > known.floor)


def test_how_well_the_model_fits_each_window_is_in_the_history_whether_it_entered_or_not(story):
    story.see(misfit=1.1)
    story.see(moved(shift_x_subap=0.3), misfit=2.0)
    entries = story.state.alpha.history
    assert [(entry.misfit, entry.entered) for entry in entries] == [(1.1, True), (2.0, False)]


def test_one_odd_misfit_among_many_moves_the_model_error_by_a_tenth(story):
    story.see(n_windows=15, misfit=0.98)
    np.testing.assert_allclose(story.state.alpha.registration.floor, story.policy.floor)
    story.see(misfit=1.5)
    added = story.state.alpha.registration.floor**2 - story.policy.floor**2
    np.testing.assert_allclose(added, 0.1 * MODEL_ERROR_VARIANCE_RATIO * 0.5 * np.diag(PRECISE))


def test_a_window_weaker_than_what_is_asked_of_alpha_says_nothing_of_the_model(story):
    weak = np.diag(np.maximum(np.diag(PRECISE), (1.1 * story.policy.dither_sigma) ** 2))
    story.see(n_windows=5, misfit=1.5, covariance=weak)
    np.testing.assert_array_equal(story.state.alpha.registration.floor, story.policy.floor)


def test_each_window_leaves_its_own_estimate_in_the_history(story):
    story.see()
    story.see(moved(shift_x_subap=0.004))
    first, second = story.state.alpha.history
    assert first.innovation == 0.0
    assert second.measured.shift_x_subap == pytest.approx(0.124)
    assert 0.12 < second.filtered.shift_x_subap < 0.124
    assert 0.0 < second.innovation < 4.0


def test_the_history_is_bounded(story):
    story.see()
    full = story.state.alpha.history * HISTORY_LENGTH
    story.state = changed(story.state, history=full)
    story.see(moved(shift_x_subap=0.001))
    assert len(story.state.alpha.history) == HISTORY_LENGTH
    assert story.state.alpha.history[-1].measured.shift_x_subap == pytest.approx(0.121)


def test_a_window_from_before_the_estimate_does_not_shrink_its_uncertainty_below_zero(story):
    story.see(n_windows=2)
    early = estimate(t_ns=START_NS - 3_600_000_000_000)
    story.tell(ev.WindowFitted(estimate=early))
    assert np.all(np.linalg.eigvalsh(story.state.alpha.registration.covariance) > 0.0)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"session": "s0"}, "the RTC has restarted since"),
        ({"lag_frames": np.full(4, 0.9)}, r"lag commands by \+0.90 frame"),
        ({"optical_gain": np.array([0.6, 0.6, 0.05, 0.6])}, "optical gains of 0.05 to 0.60"),
        ({"optical_gain": np.array([0.6, 0.6, 3.5, 0.6])}, "optical gains of 0.60 to 3.50"),
        ({"covariance": PRECISE * 1e4}, "too uncertain"),
        ({"alpha": moved(shift_y_subap=-0.9)}, "outside the capture range"),
        ({"alpha": moved(magnification=0.02)}, "outside the capture range"),
    ],
)
def test_a_useless_window_is_refused_with_its_reason(story, changes, reason):
    story.see()
    before = story.state.alpha.registration
    story.tell(ev.WindowFitted(estimate=estimate(**changes)))
    assert story.state.alpha.registration is before
    assert (story.state.windows.accepted, story.state.windows.refused) == (1, 1)
    assert story.state.log[-1].name == "window.refused"
    assert re.search(reason, story.state.log[-1].text)


def test_while_alpha_is_not_known_the_capture_range_is_about_the_nominal_rotation():
    """65.08 deg, as at the LBT; the fit of the window began there."""
    nominal = Misregistration(rotation_rad=np.deg2rad(65.08))
    story = Story(Mode.AUTO, policy=replace(POLICY, start=nominal, acquires=True)).meet()
    story.see(Misregistration(), n_windows=2)
    assert story.state.alpha.registration is None
    assert re.search("outside the capture range.*rotation_deg': 65.08", story.state.log[-1].text)
    story.see(moved(nominal, rotation_rad=0.01), n_windows=3)
    assert story.state.alpha.registration.alpha.rotation_rad == pytest.approx(
        nominal.rotation_rad + 0.01
    )
    assert not story.state.operations.acquisition.under_way


FAR = Misregistration(rotation_rad=np.deg2rad(5.0))


def test_windows_far_from_their_start_that_agree_are_used_while_alpha_is_unknown(story):
    """The third: a bench that is turned by more than a window captures."""
    story.see(FAR, n_windows=2, unexplained=np.full(4, 0.3))
    assert story.state.alpha.registration is None
    story.see(moved(FAR, shift_x_subap=0.004), unexplained=np.full(4, 0.3))
    known = story.state.alpha.registration
    assert known.alpha.rotation_rad == pytest.approx(FAR.rotation_rad)
    assert story.state.alpha.far_windows == ()


@pytest.mark.parametrize("share", [0.6, None])
def test_far_windows_that_the_model_does_not_explain_are_never_used(story, share):
    """Modes in another order lead every window to the same wrong place."""
    unexplained = None if share is None else np.full(4, share)
    story.see(FAR, n_windows=8, unexplained=unexplained)
    assert story.state.alpha.registration is None


def test_far_windows_that_disagree_are_never_used(story):
    for k in range(8):
        far = moved(FAR, shift_x_subap=0.1 * (k % 2))
        story.see(far, unexplained=np.full(4, 0.1))
    assert story.state.alpha.registration is None


def test_a_known_alpha_is_not_moved_by_far_windows_that_agree(story):
    story.see(n_windows=2)
    story.see(FAR, n_windows=4, unexplained=np.full(4, 0.1))
    assert story.state.alpha.registration.alpha.rotation_rad == pytest.approx(ALPHA.rotation_rad)


def test_fits_begin_where_the_rtcs_own_matrix_was_measured(story):
    recognised = ev.ModesRecognised(id="initial", strange=(), text="all", alpha=FAR)
    story.tell(recognised)
    story.see(moved(FAR, rotation_rad=0.01))
    known = story.state.alpha.registration
    assert known.alpha.rotation_rad == pytest.approx(FAR.rotation_rad + 0.01)


def test_the_model_error_that_the_own_matrix_tells_is_in_sigma_of_weak_windows_too(story):
    own = (0.02, 0.03, 0.004, 0.005)
    story.tell(ev.ModesRecognised(id="initial", strange=(), text="all", model_error=own))
    weak = np.diag(np.maximum(np.diag(PRECISE), (1.1 * story.policy.dither_sigma) ** 2))
    story.see(n_windows=3, covariance=weak)
    floor = story.state.alpha.registration.floor
    np.testing.assert_allclose(floor, np.hypot(story.policy.floor, own))


def test_misaligned_columns_are_an_alarm_until_a_window_is_good_again(story):
    story.tell(ev.WindowFitted(estimate=estimate(lag_frames=np.full(4, -0.5))))
    assert "columns-misaligned" in story.alarms
    story.see()
    assert "columns-misaligned" not in story.alarms


@pytest.mark.parametrize(
    ("alarm", "word"), [("loop-diverging", "diverging"), ("edge-slip", "slipped")]
)
def test_telemetry_of_a_loop_out_of_hand_is_no_measurement(story, alarm, word):
    story.tell(ev.ConditionChanged(name=alarm, text="it is"))
    story.see()
    assert story.state.alpha.registration is None
    assert word in story.state.log[-1].text


@pytest.mark.parametrize(
    ("kind", "level"),
    [(RefusalKind.CUT_SHORT, Level.INFO), (RefusalKind.OTHER, Level.WARNING)],
)
def test_a_lost_window_is_a_warning_unless_the_service_itself_cut_it_short(story, kind, level):
    lost = WindowRefused(reason="whatever is said of it", t_ns_utc=START_NS, kind=kind)
    story.tell(ev.WindowLost(refused=lost))
    assert story.state.windows.refused == 1
    assert story.state.log[-1].level is level


def test_by_day_a_mirror_seen_twice_shows_twice_the_gain_and_the_window_counts():
    story = Story(Mode.HOLD).meet()
    story.tell(ev.WindowFitted(estimate=estimate(optical_gain=np.full(4, 1.8 + 0.0j))))
    assert story.state.windows.accepted == 1
    assert story.state.alpha.registration.optical_gain == pytest.approx(1.8)


def test_a_window_in_flight_when_the_commands_go_off_the_loop_is_not_good():
    story = Story().meet()
    story.tell(ev.ConditionChanged(name="commands-off-loop", text="saturated"))
    story.see()
    assert story.state.alpha.registration is None
    assert "off the loop equation" in story.state.log[-1].text
    story.tell(ev.ConditionChanged(name="commands-off-loop", text="again", over=True))
    story.see()
    assert story.state.alpha.registration is not None
