"""A dither that does not reach the mirror, or not as it was asked for."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from service.control.dither import look_up_precision
from service.control.loop import compute_amplification
from service.errors import CommandError
from service.estimation.windows import DITHER_SETTLING_S
from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import OVER_BUDGET
from service.records.operations import DitherPhase, DitherPurpose
from service.records.state import Level, Mode
from service.tracking.dither import FIRST_DITHER_RETRY_S, MAX_DITHER_RETRY_S
from service.tracking.dither_plan import (
    FAINT_WINDOW_S,
    MAX_DITHER_DURATION_S,
    MIN_WINDOWS_FOR_PAUSE,
    budget_m,
)
from service.tracking.dither_request import (
    LINE_RANGE,
    LOW_MODE,
    LOW_MODE_SHARE,
    N_LINES,
    DitherParameters,
    choose_modes,
    clear_lines,
    controlled,
    expected_amplification,
    infer_purpose,
    name_dither,
    plan_dither,
    total_m,
)
from service.tracking.mode_proof import answers_well
from service.tracking.operations.running import OperationKind, running_operations
from service.wire import DitherRequest, DitherStop
from tests.support.dithered import DitheredNight
from tests.support.situations import (
    ALPHA,
    N_MODES,
    POLICY,
    Story,
    dither_answered,
    moved,
    of_kind,
    rtc,
)
from tests.support.states import changed

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


@pytest.mark.parametrize("purpose", DitherPurpose)
def test_the_id_of_a_dither_that_nobody_follows_shows_its_purpose(purpose):
    assert infer_purpose(name_dither(purpose, START), None) is purpose


@pytest.mark.parametrize(
    "foreign", ["dither-by-hand", "dither", "dither-", "noisy1", "lab-dither-1"]
)
def test_the_dither_of_another_program_goes_on_though_its_id_begins_like_ours(foreign):
    story = Story(policy=replace(POLICY, dither_enabled=False)).meet(dither_id=foreign)
    assert not story.asked(DitherStop)
    (running,) = running_operations(story.state, story.now_ns)
    assert running.kind is OperationKind.OTHER_DITHER


def test_a_noisy_matrix_of_any_id_is_measured_by_a_dither_of_that_purpose():
    story = Story(Mode.HOLD, policy=replace(POLICY, dither_enabled=False)).meet()
    story.tell(cmd.MeasureNoisy(id="dither-7"), after_s=1)
    story.tell(rtc(), after_s=1)
    dither = story.state.dithers.dither
    assert (dither.id, dither.purpose) == ("dither-7", DitherPurpose.NOISY)
    assert infer_purpose(dither.id, dither) is DitherPurpose.NOISY
    assert running_operations(story.state, story.now_ns)[-1].kind is OperationKind.OTHER_DITHER


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


# --- which modes are dithered


ALL = replace(POLICY, n_modes_target=N_MODES)
BUDGET_M = POLICY.dither_budget_m


def raised(night, n_controlled):
    """More modes are controlled from now on."""
    night.view = rtc(n_controlled, magnitude=night.view.magnitude)
    return night


def on_the_mirror_m(request, view):
    """RMS that the loop makes of a dither, all lines together, with the gain that adds most."""
    fractions = np.array(request.frequency_hz) / view.frame_rate_hz
    own = np.isin(request.modes, view.in_loop)
    by = compute_amplification(0.4, fractions, leak=view.leak, delay_frames=view.delay_frames)
    return float(np.sqrt(np.sum((np.where(own, by, 1.0) * request.amplitude_m) ** 2)))


def test_free_modes_are_amplified_by_nothing():
    view = rtc(400)
    assert not controlled(choose_modes(view, POLICY), view)
    assert expected_amplification(view, POLICY) == 1.0


def test_modes_of_the_loop_are_amplified_as_its_gain_leak_and_delay_say():
    view = rtc(N_MODES)
    assert controlled(choose_modes(view, ALL), view) == (590, 591, 592, 593)
    strong = replace(view, gains=(0.6,) * N_MODES)
    assert 1.1 < expected_amplification(view, ALL) < expected_amplification(strong, ALL)
    assert expected_amplification(replace(view, loop="open"), ALL) == 1.0


def test_modes_that_come_into_the_loop_are_left_for_free_ones_at_once():
    night = DitheredNight(POLICY).live(20.0)
    first = night.playing.request
    assert min(first.modes[:N_LINES]) >= POLICY.n_modes_target
    raised(night, max(first.modes) + 1).live(4.0)
    assert "dither.stopped" in night.logged
    assert min(night.requests[-1].modes[:N_LINES]) > max(first.modes)
    n_asked = len(night.requests)
    night.live(20.0)
    assert len(night.requests) == n_asked, "and it stays there"
    assert not night.alarms


def test_a_low_mode_of_the_loop_is_dithered_besides_the_free_ones_for_the_optical_gains():
    night = DitheredNight(POLICY).live(60.0)
    request = night.requests[-1]
    assert (len(request.modes), request.modes[N_LINES:]) == (N_LINES + 1, (LOW_MODE,))
    *strong, low = request.amplitude_m
    assert low**2 == pytest.approx(LOW_MODE_SHARE * total_m(request) ** 2)
    np.testing.assert_allclose(strong, strong[0])
    plan = night.state.dithers.policy.plan
    assert total_m(request) == pytest.approx(plan.total_m), "it costs no more than four modes"
    lines = np.array(request.frequency_hz)
    assert np.abs(lines[:-1] - lines[-1]).min() > 20.0
    assert "dither.stopped" not in night.logged, "it is of the loop on purpose"


@pytest.mark.parametrize(
    ("policy", "changes"),
    [
        ({"dither_modes": (501, 502, 503, 504)}, {}),
        ({"dither_amplitude_m": 2e-9}, {}),
        ({"dither_frequencies_hz": (210.0, 240.0, 280.0, 330.0)}, {}),
        ({}, {"max_dither_modes": 4}),
        ({}, {"n_controlled": 10}),
        ({"dither_avoid_hz": (261.0, *np.arange(345.0, 450.0, 15.0))}, {}),
    ],
)
def test_there_is_no_low_mode_where_the_settings_fix_the_dither_or_nothing_has_room(
    policy, changes
):
    night = DitheredNight(replace(POLICY, **policy), **changes)
    assert night.requests
    assert LOW_MODE not in night.requests[0].modes


def test_a_low_mode_that_a_window_contradicts_is_dithered_no_more():
    night = DitheredNight(POLICY)
    view, state = night.view, night.state
    choice = DitherParameters(total_m=8e-9, window_s=1.0, n_windows=1, low_mode=True)
    assert LOW_MODE in plan_dither(view, POLICY, 1, choice=choice).request.modes
    doubted = replace(choice, low_mode=False)
    assert LOW_MODE not in plan_dither(view, POLICY, 1, choice=doubted).request.modes
    assert answers_well(state, LOW_MODE)
    proof = replace(state.matrices.mode_proof, suspected=frozenset({LOW_MODE}))
    assert not answers_well(changed(state, mode_proof=proof), LOW_MODE)


def test_where_none_is_free_the_dither_is_weaker_by_what_the_loop_makes_of_it():
    night = DitheredNight(ALL, n_controlled=400, magnitude=12.0).live(20.0)
    assert total_m(night.playing.request) == pytest.approx(BUDGET_M)
    raised(night, N_MODES).live(60.0)
    request = night.requests[-1]
    assert set(request.modes) <= set(night.view.in_loop)
    assert 0.6 * BUDGET_M < total_m(request) < BUDGET_M
    assert on_the_mirror_m(request, night.view) <= BUDGET_M * (1.0 + 1e-9)
    assert OVER_BUDGET not in night.logged
    assert not night.alarms


def test_a_dither_amplified_by_much_gives_way_to_a_weaker_one_at_once():
    night = DitheredNight(ALL, n_controlled=400, magnitude=12.0).live(20.0)
    view = rtc(N_MODES, magnitude=12.0, gains=(0.6,) * N_MODES)
    night.view = view
    effects = []
    for _ in range(10):
        before = len(night.effects)
        night.live(0.5)
        effects += night.effects[before:]
    assert of_kind(effects, DitherStop)
    assert of_kind(effects, DitherRequest)
    assert on_the_mirror_m(night.requests[-1], view) <= BUDGET_M
    assert not night.alarms


def test_modes_that_the_settings_fix_stay():
    fixed = replace(POLICY, dither_modes=(500, 501, 502, 503))
    night = DitheredNight(fixed).live(20.0)
    n_asked = len(night.requests)
    raised(night, 594).live(10.0)
    assert {request.modes for request in night.requests} == {(500, 501, 502, 503)}
    assert len(night.requests) <= n_asked + 1


def test_the_amplification_is_that_of_a_loop_that_runs():
    leak, gain, n = 0.99, 0.4, 6000
    for fraction in (*LINE_RANGE, 0.211, 0.05):
        dither = np.sin(2 * np.pi * fraction * np.arange(n))
        command, moved = np.zeros(n + 2), np.zeros(n)
        for k in range(n):
            moved[k] = command[k] + dither[k]
            command[k + 2] = leak * command[k + 1] - gain * moved[k]
        line = np.exp(-2j * np.pi * fraction * np.arange(n))[n // 2 :]
        found = abs(line @ moved[n // 2 :]) / abs(line @ dither[n // 2 :])
        expected = compute_amplification(
            np.array(gain), np.array(fraction), leak=leak, delay_frames=2.0
        )
        assert found == pytest.approx(float(expected), rel=0.01)


def informed(blind):
    """Settings of a telescope whose modes all tell as much of α, but for those that are blind."""
    told = np.broadcast_to(np.diag([1.0, 1.0, 4.0, 4.0]), (N_MODES, 4, 4)).copy()
    told[list(blind)] *= 1e-3
    return replace(ALL, mode_information=told)


def test_where_none_is_free_those_that_tell_most_are_dithered_not_the_last():
    """The last modes of a basis are seen badly: the rotation was 27 of its own σ off by them."""
    policy = informed(range(580, N_MODES))
    for n_controlled in (400, N_MODES):
        modes = choose_modes(rtc(n_controlled), policy)
        assert len(modes) == 4
        assert min(modes) >= N_MODES - 100
        assert max(modes) < 580
    assert choose_modes(rtc(400, max_dither_modes=3), policy) == modes[:3]


def test_the_dither_stays_where_it_is_when_its_modes_come_into_the_loop():
    night = DitheredNight(informed(range(580, N_MODES)), n_controlled=400).live(20.0)
    raised(night, N_MODES).live(20.0)
    assert len({request.modes for request in night.requests}) == 1
    assert on_the_mirror_m(night.requests[-1], night.view) <= BUDGET_M * (1.0 + 1e-9)
    assert not night.alarms


def test_the_lines_of_a_faster_loop_are_left_where_a_slower_one_cannot_tell_them():
    """The RTC may come back at another frame rate: binned, for a faint star."""
    last = (169.0, 207.0, 233.0, 265.0)
    asked = DitherParameters(total_m=1e-9, window_s=1.0, n_windows=1, last_hz=last)
    assert clear_lines(rtc(frame_rate_hz=800.0), 4, asked) == last
    slower = clear_lines(rtc(frame_rate_hz=500.0), 4, asked)
    assert 0.2 * 500.0 <= min(slower) < max(slower) <= 0.35 * 500.0


# --- the schedule


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


@settings(max_examples=8, deadline=None, derandomize=True)
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
