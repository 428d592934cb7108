"""Evidence counts by when it was taken, not by when a busy worker was done with it."""

import re
from dataclasses import asdict, replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from service.errors import CommandError
from service.estimation.estimate import MODEL_ERROR_VARIANCE_RATIO
from service.model.misregistration import Misregistration
from service.records import commands as cmd
from service.records import events as ev
from service.records.estimates import (
    RandomEstimate,
    RefusalKind,
    WideCaptureEstimate,
    WindowRefused,
)
from service.records.products import MatrixState, ModeSet
from service.records.registration import Source, Validity
from service.records.state import Level, Mode
from service.tracking.dither_request import total_m
from service.tracking.filtering import HISTORY_LENGTH
from service.wire import DitherKind, DitherRequest, Pointing
from tests.support.situations import (
    ALPHA,
    POLICY,
    PRECISE,
    SECOND,
    START_NS,
    Story,
    dither_answered,
    estimate,
    judged,
    moved,
    of_kind,
    record,
    rtc,
    verdict,
)
from tests.support.states import changed
from tests.support.watchdog import SCATTER, watched

THERE = moved(shift_x_subap=0.15)
ELSEWHERE = moved(shift_x_subap=0.5, shift_y_subap=0.5)


class Late(Story):
    """A night in ``auto`` on which telemetry has times of its own, in seconds since its begin."""

    def __init__(self, mode=Mode.AUTO):
        super().__init__(mode)
        self.meet()
        self.zero_ns = self.now_ns
        for end_s in (2, 4, 6):
            self.window(end_s)
        self.effects.clear()

    @property
    def doubted(self):
        registration = self.state.alpha.registration
        return bool(registration.doubt) or registration.validity.level is Validity.INVALID

    def at(self, s):
        """The service's and the RTC's clock are there."""
        self.now_ns = max(self.now_ns, self.zero_ns + round(s * SECOND))
        return self.tell(rtc(t_ns=self.now_ns))

    def window(self, end_s, alpha=ALPHA, *, fitted_s=None, **began):
        """A window that ended then, fitted at once or later."""
        self.at(end_s if fitted_s is None else fitted_s)
        found = estimate(alpha, t_ns=self.zero_ns + round(end_s * SECOND))
        return self.tell(ev.WindowFitted(estimate=found, **began))

    def look(self, end_s, alpha, *, done_s=None):
        self.at(end_s if done_s is None else done_s)
        end_ns = self.zero_ns + round(end_s * SECOND)
        return self.tell(ev.PassiveFitted(estimate=watched(alpha, SCATTER), t_ns_utc=end_ns))


@pytest.fixture
def night():
    return Late()


class TestLookThatBarks:
    def test_a_window_from_before_it_ends_no_doubt_and_nothing_is_sent_for_the_old_place(
        self, night
    ):
        night.look(10, ELSEWHERE)
        assert night.doubted
        night.window(8, fitted_s=12)
        assert night.doubted
        night.tell(ev.MatrixMade(record=made(night), wanted=False))
        assert not of_kind(night.wait(10), ev.MakeMatrix | ev.SendMatrix)
        assert not night.asked(ev.SendMatrix)

    def test_one_that_began_before_it_and_ended_after_ends_none_either(self, night):
        night.look(10, ELSEWHERE)
        night.window(11, began_ns_utc=night.zero_ns + 9 * SECOND)
        assert night.doubted

    def test_one_taken_since_does(self, night):
        night.look(10, ELSEWHERE)
        night.window(12, began_ns_utc=night.zero_ns + 10 * SECOND)
        assert not night.doubted
        assert "watchdog" not in night.alarms

    def test_two_from_before_that_agree_on_another_place_do_not_say_where_it_is_now(self, night):
        night.look(20, ELSEWHERE)
        night.window(10, THERE, fitted_s=21)
        night.window(12, THERE, fitted_s=23)
        assert night.doubted
        night.window(25, THERE)
        assert not night.doubted

    def test_a_look_from_before_a_window_that_agreed_says_nothing_new(self, night):
        night.window(14)
        night.look(9, ELSEWHERE, done_s=15)
        assert not night.doubted
        assert "dithered window" in night.state.alpha.passive_unavailable_reason

    def test_a_clock_that_was_set_back_keeps_no_doubt_for_an_hour(self, night):
        night.look(3600, ELSEWHERE)
        assert night.doubted
        night.now_ns = night.zero_ns + 100 * SECOND
        night.tell(rtc(t_ns=night.now_ns))
        for end_s in (102, 104, 106):
            night.window(end_s)
        assert not night.doubted

    def test_a_worker_that_was_stopped_for_minutes_is_no_clock_that_was_set_back(self, night):
        night.look(300, ELSEWHERE)
        night.window(8, fitted_s=301)
        assert night.doubted


class TestWindowFarOut:
    def test_it_is_not_denied_by_one_from_before_it(self, night):
        night.window(10, THERE)
        assert night.doubted
        night.window(9, fitted_s=11)
        assert night.doubted
        assert night.state.windows.outlying == 0
        night.window(12)
        assert not night.doubted
        assert night.state.windows.outlying == 1


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.lists(
        st.tuples(st.integers(7, 40), st.integers(0, 12), st.sampled_from(["window", "look"])),
        min_size=1,
        max_size=12,
    )
)
def test_in_whatever_order_it_comes_nothing_taken_before_a_doubt_ends_it(evidence):
    night = Late()
    night.look(20, ELSEWHERE)
    assert night.doubted
    told = False
    for end_s, late_s, kind in sorted(evidence, key=lambda one: max(one[0], 20) + one[1]):
        done_s = max(end_s, 20) + late_s
        if kind == "look":
            night.look(end_s, ALPHA, done_s=done_s)
        else:
            night.window(end_s, fitted_s=done_s)
            told = told or end_s >= 20
        assert told or night.doubted


class TestLoopOutOfHand:
    def test_a_window_of_it_counts_for_nothing_once_it_is_over_either(self, night):
        before = night.state.windows.accepted
        night.at(10)
        night.tell(ev.ConditionChanged(name="loop-diverging", text="found"))
        night.at(14)
        night.tell(ev.ConditionChanged(name="loop-diverging", text="calm", over=True))
        night.window(13, fitted_s=15)
        assert night.state.windows.accepted == before
        assert "diverging" in night.state.log[-1].text
        night.window(17)
        assert night.state.windows.accepted == before + 1

    def test_the_frames_say_until_when(self, night):
        before = night.state.windows.accepted
        night.at(10)
        night.tell(ev.ConditionChanged(name="edge-slip", text="found"))
        over_ns = night.zero_ns + round(14.8 * SECOND)
        night.at(14)
        night.tell(ev.ConditionChanged(name="edge-slip", text="back", over=True, t_ns_utc=over_ns))
        night.window(16, began_ns_utc=night.zero_ns + round(14.2 * SECOND))
        assert night.state.windows.accepted == before

    def test_a_look_at_it_counts_for_nothing_either(self, night):
        night.at(10)
        night.tell(ev.ConditionChanged(name="loop-diverging", text="found"))
        night.at(14)
        night.tell(ev.ConditionChanged(name="loop-diverging", text="calm", over=True))
        night.look(13, ELSEWHERE, done_s=15)
        assert not night.doubted
        assert "not used" in night.state.alpha.passive_unavailable_reason


def test_a_look_at_a_session_that_is_over_counts_for_nothing(night):
    night.at(10)
    night.tell(ev.SessionStarted(session="s2"))
    night.tell(rtc(session="s2", t_ns=night.now_ns))
    end_ns = night.zero_ns + 9 * SECOND
    night.tell(ev.PassiveFitted(estimate=watched(ELSEWHERE), t_ns_utc=end_ns), 1.0)
    assert not night.state.alpha.registration.doubt


class TestSlew:
    FROM, TO = (
        Pointing(elevation_deg=70.0, azimuth_deg=0.0),
        Pointing(elevation_deg=40.0, azimuth_deg=0.0),
    )

    def point(self, night, s, where):
        night.at(s)
        night.tell(cmd.SetPointing(**asdict(where)))

    def test_a_window_from_before_it_says_nothing_of_where_the_telescope_is_now(self, night):
        self.point(night, 8, self.FROM)
        night.window(10)
        self.point(night, 14, self.TO)
        night.at(15)
        night.tell(ev.Tick())
        assert night.doubted
        night.window(12, fitted_s=16)
        assert night.doubted
        night.window(18, began_ns_utc=night.zero_ns + 16 * SECOND)
        assert not night.doubted


def made(story, matrix_id="cm-1", **changes):
    known, view = story.state.alpha.registration, story.state.loop.rtc
    return record(
        matrix_id,
        **({"judged": judged(known, view), "alpha": known.alpha} | changes),
    )


class TestVerdicts:
    def test_one_given_while_alpha_came_into_doubt_sends_nothing(self):
        night = Late(Mode.PROPOSE)
        proposal = made(night)
        of_old = replace(proposal.judged, leak=0.9)
        night.tell(ev.MatrixMade(record=replace(proposal, judged=of_old), wanted=False))
        assert of_kind(night.tell(cmd.Approve(id="cm-1")), ev.JudgeProposal)
        night.look(10, ELSEWHERE)
        passed = ev.ProposalJudged(id="cm-1", verdict=verdict(), judged=proposal.judged)
        assert not of_kind(night.tell(passed), ev.SendMatrix)
        assert night.matrix_state("cm-1") is MatrixState.PROPOSED
        with pytest.raises(CommandError, match="in question"):
            night.tell(cmd.Approve(id="cm-1"))

    def test_a_margin_of_the_place_before_a_jump_calms_nobody(self, night):
        then = judged(night.state.alpha.registration, night.state.loop.rtc)
        for end_s in (10, 12, 14):
            night.window(end_s, THERE)
        now = judged(night.state.alpha.registration, night.state.loop.rtc)
        short = verdict(accepted=False)
        night.tell(ev.MarginJudged(id="initial", verdict=short, judged=now))
        assert "margin" in night.alarms
        night.tell(ev.MarginJudged(id="initial", verdict=verdict(), judged=then))
        assert "margin" in night.alarms
        assert not night.state.matrices.margin.accepted

    def test_a_margin_worked_out_while_alpha_came_into_doubt_is_none(self, night):
        then = judged(night.state.alpha.registration, night.state.loop.rtc)
        night.look(10, ELSEWHERE)
        night.tell(ev.MarginJudged(id="initial", verdict=verdict(), judged=then))
        assert night.state.matrices.margin is None

    def test_what_is_applied_after_a_jump_is_not_as_good_as_it_was_judged_before(self):
        night = Late(Mode.PROPOSE)
        night.tell(ev.MatrixMade(record=made(night), wanted=False))
        night.tell(cmd.Approve(id="cm-1"))
        for end_s in (10, 12, 14):
            night.window(end_s, THERE)
        effects = night.acknowledge("cm-1")
        assert night.state.matrices.in_use == "cm-1"
        assert night.state.matrices.margin is None
        assert of_kind(effects, ev.JudgeMatrix)


def test_a_window_from_before_a_dither_was_lost_has_not_found_it_again(night):
    night.at(10)
    asked = night.state.dithers.dither
    night.tell(dither_answered(asked.id, accepted=True, reason="", start_seq=10))
    night.tell(ev.DitherSilent(id=asked.id, silent_s=1.0))
    assert "dither-lost" in night.alarms
    night.window(9, fitted_s=11)
    assert "dither-lost" in night.alarms
    night.window(13)
    assert "dither-lost" not in night.alarms


def test_what_was_seen_from_afar_before_an_acquisition_began_anew_counts_for_nothing(night):
    open_loop = {"loop": "open", "gains": (0.0,) * 594}
    night.at(10)
    night.tell(rtc(t_ns=night.now_ns, **open_loop))
    night.tell(cmd.Acquire())
    dither = night.state.dithers.dither
    found = estimate(ALPHA, t_ns=night.zero_ns + 9 * SECOND, modes=dither.request.modes)
    found = replace(found, covariance=np.diag([0.01, 0.01, 3e-4, 1e-3]) ** 2)
    far = WideCaptureEstimate(estimate=found, unexplained=0.05, n_starts=1)
    night.tell(ev.WideCaptureFitted(found=far))
    assert night.state.operations.acquisition.alpha is None
    later = replace(found, t_ns_utc=night.zero_ns + 14 * SECOND)
    night.tell(ev.WideCaptureFitted(found=replace(far, estimate=later)), 5.0)
    assert night.state.operations.acquisition.alpha is not None


# --- windows


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


def test_each_window_leaves_its_own_estimate_in_the_history_which_is_bounded(story):
    story.see()
    story.see(moved(shift_x_subap=0.004))
    first, second = story.state.alpha.history
    assert first.innovation == 0.0
    assert second.measured.shift_x_subap == pytest.approx(0.124)
    assert 0.12 < second.filtered.shift_x_subap < 0.124
    assert 0.0 < second.innovation < 4.0
    story.state = changed(story.state, history=(first,) * HISTORY_LENGTH)
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


@pytest.mark.parametrize(("share", "apart"), [(0.6, 0.0), (None, 0.0), (0.1, 0.1)])
def test_far_windows_that_the_model_does_not_explain_or_that_disagree_are_never_used(
    story, share, apart
):
    """Modes in another order lead every window to the same wrong place."""
    unexplained = None if share is None else np.full(4, share)
    for k in range(8):
        story.see(moved(FAR, shift_x_subap=apart * (k % 2)), unexplained=unexplained)
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


# --- what a window of random dither does to the registration


def random_estimate(alpha=ALPHA, *, t_ns=0, n_modes=400, **changes):
    values = {
        "alpha": alpha,
        "covariance": PRECISE,
        "optical_gain": np.full(n_modes, 0.6),
        "gain_sigma": np.full(n_modes, 0.04),
        "lag_frames": np.zeros(1),
        "misfit": 1.0,
        "step": np.zeros(4),
        "t_ns_utc": t_ns,
        "cm_id": "initial",
        "session": "s1",
        "modes": tuple(range(n_modes)),
    }
    return RandomEstimate(**(values | changes))


def see(story, **changes):
    story.now_ns += 5_000_000_000
    return story.tell(ev.WindowFitted(estimate=random_estimate(t_ns=story.now_ns, **changes)))


def test_a_window_of_random_dither_enters_the_registration_like_any_other():
    story = Story().meet()
    see(story)
    known = story.state.alpha.registration
    np.testing.assert_allclose(known.alpha.vector, ALPHA.vector)
    assert story.state.alpha.history[-1].source is Source.RANDOM
    assert known.optical_gain == pytest.approx(0.6)


def test_gains_of_hundreds_of_modes_are_kept_as_those_of_a_few_groups():
    story = Story().meet()
    see(story)
    gains = story.state.alpha.registration.optical_gains
    assert 4 <= len(gains) <= 32
    assert gains[0].mode < 50 < 350 < gains[-1].mode


def test_one_noisy_gain_among_hundreds_is_no_reason_to_refuse_a_window():
    story = Story().meet()
    gains = np.full(400, 0.6)
    gains[7] = -0.2
    see(story, optical_gain=gains, gain_sigma=np.full(400, 0.3))
    assert story.state.windows.accepted == 1


def test_neighbours_are_averaged_by_their_noise():
    """Two modes of gain 1 ± 0.1 and 0 ± 0.2: 0.8, ± 0.0894."""
    pair = random_estimate(
        n_modes=2, optical_gain=np.array([1.0, 0.0]), gain_sigma=np.array([0.1, 0.2])
    )
    modes, gains, sigma = pair.gains_by_group(1)
    assert modes == (1,)
    assert gains[0] == pytest.approx(0.8)
    assert sigma[0] == pytest.approx(1 / np.sqrt(125))


def test_a_jump_seen_by_random_signs_needs_a_second_window():
    story = Story().meet()
    for _ in range(3):
        see(story)
    see(story, alpha=moved(shift_x_subap=0.1))
    assert story.state.alpha.registration.suspected_jump is not None


def test_an_operator_may_dither_every_mode_of_the_basis():
    story = Story(policy=replace(POLICY, dither_enabled=False)).meet()
    command = cmd.StartDither(
        kind=DitherKind.BINARY, modes=ModeSet.ALL, total_amplitude_m=5e-9, duration_s=60.0
    )
    (asked,) = of_kind(story.tell(command), DitherRequest)
    assert asked.modes == tuple(range(594))
    assert total_m(asked) == pytest.approx(5e-9)
    assert "binary, 594 modes, 5 nm RMS in all" in story.state.log[-1].text


def test_random_signs_over_the_budget_must_be_meant():
    story = Story(policy=replace(POLICY, dither_enabled=False)).meet()
    command = cmd.StartDither(kind=DitherKind.BINARY, total_amplitude_m=20e-9, duration_s=60.0)
    with pytest.raises(CommandError, match="20 nm RMS in all, budget 8 nm"):
        story.tell(command)
    assert of_kind(story.tell(replace(command, over_budget=True)), DitherRequest)
