import re
from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from service.errors import ModelError
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import ExpectedGain, MatrixState
from service.records.state import Mode
from service.tracking.dither_request import DitherParameters, lock_in_plan, plan_dither
from service.tracking.update_policy import THRESHOLD_DECAY_S, is_outdated
from service.wire import DitherRequest, DitherStop
from tests.support import situations
from tests.support.situations import (
    ALPHA,
    N_MODES,
    POLICY,
    START_NS,
    Story,
    judged,
    moved,
    of_kind,
    rtc,
    verdict,
)

PARALYSING = [
    "second-rtc",
    "basis-mismatch",
    "instrument-mismatch",
    "loop-diverging",
    "edge-slip",
    "archive-failed",
]


@pytest.fixture
def story():
    return Story(Mode.AUTO).meet()


CHOICE = DitherParameters(total_m=8e-9, window_s=2.0, n_windows=59)

OPEN = ({"loop": "open"}, {"loop": "partial", "gains": (0.0,) * N_MODES})
"""With all gains 0 no mode is in the loop, whatever the RTC calls that."""


class TestDither:
    """When it is asked for, and which."""

    @pytest.mark.parametrize("mode", list(Mode))
    def test_it_is_asked_for_once_the_loop_is_closed_and_its_matrix_known(self, mode):
        assert len(Story(mode).meet().asked(DitherRequest)) == 1

    @pytest.mark.parametrize("loop", OPEN)
    def test_not_while_the_loop_is_not_closed(self, loop):
        story = Story().meet(**loop)
        story.wait(10)
        assert not story.asked(DitherRequest)

    def test_not_while_the_matrix_is_unknown(self):
        story = Story()
        story.tell(ev.SessionStarted(session="s1"))
        story.tell(rtc())
        story.wait(10)
        assert not story.asked(DitherRequest)

    def test_not_when_the_settings_forbid_it(self):
        story = Story(policy=replace(POLICY, dither_enabled=False)).meet()
        story.wait(10)
        assert not story.asked(DitherRequest)

    @pytest.mark.parametrize("name", PARALYSING)
    def test_not_while_an_alarm_forbids_everything(self, name):
        story = Story()
        story.tell(ev.ConditionChanged(name=name, text="found"))
        story.meet()
        story.tell(ev.ConditionChanged(name=name, text="found"))
        story.wait(10)
        assert set(map(type, story.effects)) <= {ev.FetchMatrix}
        story.tell(ev.ConditionChanged(name=name, text="gone", over=True))
        assert story.asked(ev.FetchMatrix) or story.asked(DitherRequest)

    @pytest.mark.parametrize("name", ["dither-1", "noisy-0"])
    def test_one_left_behind_before_a_restart_is_stopped_first(self, name):
        story = Story().meet(dither_id=name)
        assert story.asked(DitherStop)
        assert not story.asked(DitherRequest)
        story.tell(rtc(), after_s=3)
        assert story.asked(DitherRequest)

    def test_its_lines_lie_above_a_fifth_of_the_frame_rate_and_fit_a_window(self):
        dither = plan_dither(rtc(), POLICY, START_NS, choice=CHOICE)
        assert all(200.0 < line < 350.0 for line in dither.frequency_hz)
        assert all((line * POLICY.window_s).is_integer() for line in dither.frequency_hz)
        sums = {a + b for a in dither.frequency_hz for b in dither.frequency_hz}
        differences = {abs(a - b) for a in dither.frequency_hz for b in dither.frequency_hz}
        assert not (sums | differences) & set(dither.frequency_hz)

    def test_settings_overrule_the_services_choice_and_a_request_overrules_both(self):
        policy = replace(POLICY, dither_modes=(7, 9), dither_frequencies_hz=(210.0, 260.0))
        chosen = plan_dither(rtc(), policy, START_NS, choice=CHOICE).request
        assert (chosen.modes, chosen.frequency_hz) == ((7, 9), (210.0, 260.0))
        asked = plan_dither(
            rtc(),
            policy,
            START_NS,
            choice=CHOICE,
            modes=(3,),
            frequency_hz=(300.0,),
            amplitude_m=2e-9,
        ).request
        assert (asked.modes, asked.frequency_hz, asked.amplitude_m) == ((3,), (300.0,), (2e-9,))

    def test_the_first_window_waits_until_the_loop_has_settled(self):
        dither = replace(plan_dither(rtc(), POLICY, START_NS, choice=CHOICE), start_seq=1000)
        plan = lock_in_plan(dither, rtc(), 2.0)
        assert (plan.first_seq, plan.n_frames) == (1300, 2000)

    def test_lines_of_a_slow_loop_have_no_room_for_their_side_bins(self):
        slow = rtc(frame_rate_hz=60.0)
        with pytest.raises(ModelError, match="room for the side bins"):
            lock_in_plan(plan_dither(slow, POLICY, START_NS, choice=CHOICE), slow, 2.0)


class TestMargin:
    """When the matrix in use is judged."""

    def test_after_two_windows_and_again_where_no_answer_came(self):
        story = Story(Mode.HOLD).meet()
        assert not of_kind(story.see(), ev.JudgeMatrix)
        assert of_kind(story.see(), ev.JudgeMatrix) == [ev.JudgeMatrix(id="initial")]
        assert not of_kind(story.wait(15), ev.JudgeMatrix)
        assert of_kind(story.wait(1), ev.JudgeMatrix)

    @pytest.mark.parametrize(("accepted", "windows"), [(True, 30), (False, 7)])
    def test_then_seldom_while_the_verdict_holds(self, accepted, windows):
        story = self.looked_at(accepted=accepted)
        assert not of_kind(story.see(n_windows=windows), ev.JudgeMatrix)
        assert of_kind(story.see(), ev.JudgeMatrix)

    def test_at_once_where_alpha_may_be_out_of_its_reach(self):
        story = self.looked_at()
        within = 3 * story.state.alpha.registration.sigma[0] + 0.04
        assert not of_kind(story.see(moved(shift_x_subap=0.04)), ev.JudgeMatrix)
        effects = [e for _ in range(6) for e in story.see(moved(shift_x_subap=within + 0.1))]
        assert of_kind(effects, ev.JudgeMatrix)

    def looked_at(self, *, accepted=True):
        story = Story(Mode.HOLD).meet()
        story.see(n_windows=2)
        then = judged(story.state.alpha.registration, rtc())
        story.tell(ev.MarginJudged(id="initial", verdict=verdict(accepted=accepted), judged=then))
        return story

    def test_not_while_a_reconstructor_is_being_computed(self):
        story = Story(Mode.HOLD).meet()
        story.see(n_windows=2)
        story.tell(cmd.Refit())
        assert not of_kind(story.wait(30), ev.JudgeMatrix)


class TestUpdate:
    """When a reconstructor is made without being asked for."""

    def test_two_windows_must_agree_first(self, story):
        assert not of_kind(story.see(), ev.MakeMatrix)
        (made,) = of_kind(story.see(), ev.MakeMatrix)
        assert made.n_modes == 400
        assert "not made for a known registration" in made.why

    def test_a_jump_starts_the_counting_again(self, story):
        story.see()
        assert not of_kind(story.see(moved(shift_x_subap=0.2)), ev.MakeMatrix)
        assert of_kind(story.see(moved(shift_x_subap=0.2)), ev.MakeMatrix)

    def test_only_one_is_made_at_a_time(self, story):
        story.see(n_windows=10)
        assert len(story.asked(ev.MakeMatrix)) == 1

    def test_first_as_many_modes_as_now_then_the_target(self, story):
        story.see(n_windows=2)
        story.use("cm-1", 400)
        assert not of_kind(story.wait(4), ev.MakeMatrix)
        (more,) = of_kind(story.wait(2), ev.MakeMatrix)
        assert more.n_modes == 500
        assert "400 of 500" in more.why
        story.use("cm-2", 500)
        assert not of_kind(story.wait(120), ev.MakeMatrix)

    def test_the_target_is_no_more_than_the_basis_has(self):
        story = Story(policy=replace(POLICY, n_modes_target=1000)).meet()
        story.see(n_windows=2)
        story.use("cm-1")
        assert of_kind(story.wait(10), ev.MakeMatrix)[0].n_modes == N_MODES

    def settled(self):
        story = Story(policy=replace(POLICY, n_modes_target=400)).meet()
        story.see(n_windows=2)
        story.use("cm-1")
        story.wait(10)
        return story

    def test_noise_makes_no_new_reconstructor(self):
        story = self.settled()
        assert not of_kind(story.see(moved(shift_x_subap=0.005), n_windows=5), ev.MakeMatrix)

    @pytest.mark.parametrize(
        "by", [{"shift_x_subap": 0.03}, {"rotation_rad": 2e-3}, {"magnification": 0.003}]
    )
    def test_a_move_beyond_its_threshold_does(self, by):
        story = self.settled()
        (made,) = of_kind(story.see(moved(**by), n_windows=6), ev.MakeMatrix)
        assert made.why.startswith("moved by")

    @pytest.mark.parametrize("loop", OPEN)
    def test_nothing_is_made_while_the_loop_is_not_closed(self, loop):
        story = Story().meet()
        story.tell(rtc(**loop))
        assert not of_kind(story.see(n_windows=5), ev.MakeMatrix)

    @pytest.mark.parametrize(
        "outcome",
        [
            MatrixState.REFUSED,
            MatrixState.REJECTED,
            MatrixState.FAILED,
            MatrixState.DISCARDED,
        ],
    )
    def test_after_a_failure_or_an_operators_no_it_waits_half_a_minute(self, outcome):
        by_hand = outcome is MatrixState.DISCARDED
        story = Story(Mode.PROPOSE if by_hand else Mode.AUTO).meet()
        story.see(n_windows=2)
        refused = outcome is MatrixState.REFUSED
        sent = story.make("cm-1", outcome if refused else MatrixState.PROPOSED)
        if by_hand:
            story.tell(cmd.Reject(id="cm-1"))
        elif outcome is MatrixState.REJECTED:
            story.acknowledge("cm-1", outcome, "no")
        elif outcome is MatrixState.FAILED:
            story.tell(ev.JobFailed(effect=sent[0], text="no"))
        assert not of_kind(story.wait(29), ev.MakeMatrix)
        assert of_kind(story.wait(1), ev.MakeMatrix)

    def test_a_job_that_failed_is_not_asked_for_again_at_once(self, story):
        (effect,) = of_kind(story.see(n_windows=2), ev.MakeMatrix)
        assert not of_kind(story.tell(ev.JobFailed(effect=effect, text="died")), ev.MakeMatrix)
        assert not of_kind(story.wait(4), ev.MakeMatrix)
        assert of_kind(story.wait(1), ev.MakeMatrix)


class TestProposals:
    """A proposal waits, but not for ever and not in the way."""

    def proposed(self):
        story = Story(Mode.PROPOSE).meet()
        story.see(n_windows=2)
        story.make("cm-1")
        return story

    def test_while_it_fits_nothing_else_is_made(self):
        story = self.proposed()
        assert not of_kind(story.see(n_windows=50), ev.MakeMatrix)

    def test_when_the_mirror_has_moved_another_is_made_and_replaces_it(self):
        story = self.proposed()
        assert of_kind(story.see(moved(shift_x_subap=0.1), n_windows=4), ev.MakeMatrix)
        story.make("cm-2")
        assert story.matrix_state("cm-1") is MatrixState.DISCARDED
        assert not story.asked(ev.SendMatrix)

    def drifting(self):
        """A proposal is five seconds old, and α by a fortieth of a subaperture elsewhere."""
        wide = replace(POLICY, update_threshold=np.array([0.08, 0.08, np.deg2rad(0.08), 0.005]))
        story = Story(Mode.PROPOSE, wide).meet()
        story.see(n_windows=6)
        story.make("cm-1")
        for k in range(1, 6):
            story.see(moved(shift_x_subap=0.005 * k), every_s=1.0)
        story.see(moved(shift_x_subap=0.025), n_windows=5, every_s=0.2)
        assert is_outdated(story.state, story.state.reconstructor("cm-1"))
        return story

    def looked_at(self, story, seconds):
        """Return what is made while windows go on as before, beside a matrix not made for α."""
        effects = ()
        for _ in range(seconds):
            effects += story.see(moved(shift_x_subap=0.025), every_s=1.0)
        return of_kind(effects, ev.MakeMatrix)

    def test_an_operator_has_half_a_minute_before_a_better_one_replaces_it(self):
        story = self.drifting()
        assert not story.asked(ev.MakeMatrix)[1:], "but the first"
        assert not self.looked_at(story, 23)
        assert self.looked_at(story, 2)

    def test_approved_meanwhile_it_is_sent_if_the_gate_accepts_it_for_alpha_of_now(self):
        story = self.drifting()
        effects = story.tell(cmd.Approve(id="cm-1"))
        assert of_kind(effects, ev.SendMatrix | ev.JudgeProposal)

    def test_one_from_before_a_jump_is_replaced_at_once(self):
        story = self.drifting()
        effects = story.see(moved(shift_x_subap=0.4), n_windows=4)
        assert of_kind(effects, ev.MakeMatrix)

    def test_in_auto_a_proposal_left_behind_stops_nothing(self):
        story = self.proposed()
        story.wait(10)
        assert of_kind(story.tell(cmd.SetMode(mode=Mode.AUTO)), ev.MakeMatrix)

    def test_a_matrix_made_while_the_rtc_was_away_does_not_stop_the_next(self):
        story = Story(Mode.AUTO).meet()
        story.see(n_windows=2)
        story.tell(ev.RtcVanished())
        story.make("cm-1")
        assert not story.asked(ev.SendMatrix)
        story.wait(10)
        story.meet(session="s2")
        assert of_kind(story.see(n_windows=2), ev.MakeMatrix)


# --- whether another reconstructor is worth a swap


FAR_THRESHOLDS = replace(
    POLICY,
    n_modes_target=400,
    update_threshold=np.array([0.5, 0.5, 0.1, 0.1]),
    update_gain_m=0.5e-9,
    update_margin=0.1,
)
NEAR = moved(shift_x_subap=0.04)


def told(loss_m=0.0, radius=0.6, fresh=0.6):
    return ExpectedGain(
        loss_m=loss_m, wavefront_m=1e-7, pole_radius=radius, fresh_pole_radius=fresh
    )


@pytest.fixture
def moved_a_little():
    """A reconstructor in use that was made for ``ALPHA``, the mirror since moved a little."""
    moved_a_little = Story(Mode.AUTO, FAR_THRESHOLDS).meet()
    moved_a_little.see(n_windows=2)
    moved_a_little.use("cm-1")
    moved_a_little.wait(THRESHOLD_DECAY_S + 5)
    moved_a_little.see(NEAR, n_windows=8)
    moved_a_little.effects.clear()
    return moved_a_little


def look_at(moved_a_little, expected, alpha=NEAR, matrix_id="cm-1"):
    """Tell what the worker found; return the reconstructors asked for in the next seconds."""
    now = situations.judged(moved_a_little.state.alpha.registration, moved_a_little.state.loop.rtc)
    effects = moved_a_little.tell(
        ev.MarginJudged(id=matrix_id, verdict=verdict(), alpha=alpha, expected=expected, judged=now)
    )
    return of_kind((*effects, *moved_a_little.wait(3)), ev.MakeMatrix)


def test_nothing_to_win_is_no_reason(moved_a_little):
    assert not look_at(moved_a_little, told(loss_m=0.1e-9, radius=0.62))


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ({"loss_m": 1e-9}, "expected to win .*nm over cm-1"),
        ({"radius": 0.7}, "cm-1 has lost 25% of its stability margin"),
        ({"loss_m": float("inf"), "radius": 1.1}, ""),
    ],
)
def test_nanometres_margin_or_an_unstable_loop_are(moved_a_little, found, words):
    (made,) = look_at(moved_a_little, told(**found))
    assert re.search(words, made.why)
    assert made.n_modes == 400


def test_noise_is_not(moved_a_little):
    """The same loss at a registration that noise alone would bring about."""
    near = moved(shift_x_subap=0.004)
    assert not look_at(moved_a_little, told(loss_m=1e-9, radius=0.7), alpha=near)


def test_a_loss_of_another_matrix_is_not(moved_a_little):
    moved_a_little.use("cm-2")
    moved_a_little.wait(THRESHOLD_DECAY_S + 5)
    assert not look_at(moved_a_little, told(loss_m=1e-9), matrix_id="cm-1")


def test_soon_after_an_update_it_takes_twice_as_much_and_later_as_much_as_ever(moved_a_little):
    moved_a_little.use("cm-2")
    for k in range(1, 9):
        moved_a_little.see(moved(NEAR, shift_x_subap=0.005 * k))
    there = moved(NEAR, shift_x_subap=0.04)
    assert not look_at(moved_a_little, told(loss_m=0.8e-9), alpha=there, matrix_id="cm-2")
    assert look_at(copy(moved_a_little), told(loss_m=1.5e-9), alpha=there, matrix_id="cm-2")
    moved_a_little.wait(THRESHOLD_DECAY_S)
    moved_a_little.see(there, n_windows=6)
    assert look_at(moved_a_little, told(loss_m=0.8e-9), alpha=there, matrix_id="cm-2")


def test_a_move_is_looked_at_at_once_and_the_new_matrix_comes_before_the_margin_of_the_old(
    moved_a_little,
):
    look_at(moved_a_little, told())
    effects = moved_a_little.see(moved(NEAR, shift_x_subap=0.03), n_windows=2)
    asked = [type(e) for e in effects if isinstance(e, (ev.MakeMatrix, ev.JudgeMatrix))]
    assert asked == [ev.MakeMatrix, ev.JudgeMatrix]


def test_a_registration_that_may_have_jumped_makes_nothing(moved_a_little):
    moved_a_little.see(moved(shift_x_subap=0.4))
    assert moved_a_little.state.alpha.registration.suspected_jump is not None
    assert not look_at(moved_a_little, told(loss_m=5e-9))


def test_a_jump_asks_for_one_whatever_it_wins(moved_a_little):
    moved_a_little.see(moved(NEAR, rotation_rad=np.deg2rad(0.04)), n_windows=2)
    assert "registration.jump" in moved_a_little.logged
    (made,) = moved_a_little.asked(ev.MakeMatrix)
    assert made.why == "cm-1 was made before the mirror jumped"


def test_a_jump_that_a_verdict_still_reaches_asks_for_none(moved_a_little):
    moved_a_little.use("cm-2")
    moved_a_little.effects.clear()
    moved_a_little.see(moved(NEAR, rotation_rad=np.deg2rad(0.018)), n_windows=4)
    assert "registration.jump" in moved_a_little.logged
    assert not moved_a_little.asked(ev.MakeMatrix)


def test_far_enough_needs_no_estimate(moved_a_little):
    moved_a_little.policy = replace(
        FAR_THRESHOLDS, update_threshold=np.array([0.03, 0.03, 0.1, 0.1])
    )
    (made,) = of_kind(moved_a_little.wait(2), ev.MakeMatrix)
    assert made.why.startswith("moved by")


def test_the_state_remembers_what_was_found(moved_a_little):
    look_at(moved_a_little, told(loss_m=0.1e-9))
    assert moved_a_little.state.matrices.assessment.id == "cm-1"
    assert moved_a_little.state.matrices.assessment.alpha == NEAR
    assert moved_a_little.state.matrices.assessment.expected.loss_m == 0.1e-9
    moved_a_little.use("cm-2")
    assert moved_a_little.state.matrices.assessment is None
    assert ALPHA != NEAR
