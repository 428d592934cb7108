"""Whether another reconstructor is worth a swap."""

import re
from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from service.control.expected_gain import ExpectedGain
from service.tracking import events as ev
from service.tracking.state import Mode
from service.tracking.update_policy import THRESHOLD_DECAY_S
from tests.unit.tracking import situations
from tests.unit.tracking.situations import ALPHA, POLICY, Story, moved, of_kind, verdict

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
def story():
    """A reconstructor in use that was made for ``ALPHA``, the mirror since moved a little."""
    story = Story(Mode.AUTO, FAR_THRESHOLDS).meet()
    story.see(n_windows=2)
    story.use("cm-1")
    story.wait(THRESHOLD_DECAY_S + 5)
    story.see(NEAR, n_windows=8)
    story.effects.clear()
    return story


def judged(story, expected, alpha=NEAR, matrix_id="cm-1"):
    """Tell what the worker found; return the reconstructors asked for in the next seconds."""
    now = situations.judged(story.state.alpha.registration, story.state.loop.rtc)
    effects = story.tell(
        ev.MarginJudged(id=matrix_id, verdict=verdict(), alpha=alpha, expected=expected, judged=now)
    )
    return of_kind((*effects, *story.wait(3)), ev.MakeMatrix)


def test_nothing_to_win_is_no_reason(story):
    assert not judged(story, told(loss_m=0.1e-9, radius=0.62))


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ({"loss_m": 1e-9}, "expected to win .*nm over cm-1"),
        ({"radius": 0.7}, "cm-1 has lost 25% of its stability margin"),
        ({"loss_m": float("inf"), "radius": 1.1}, ""),
    ],
)
def test_nanometres_margin_or_an_unstable_loop_are(story, found, words):
    (made,) = judged(story, told(**found))
    assert re.search(words, made.why)
    assert made.n_modes == 400


def test_noise_is_not(story):
    """The same loss at a registration that noise alone would bring about."""
    near = moved(shift_x_subap=0.004)
    assert not judged(story, told(loss_m=1e-9, radius=0.7), alpha=near)


def test_a_loss_of_another_matrix_is_not(story):
    story.use("cm-2")
    story.wait(THRESHOLD_DECAY_S + 5)
    assert not judged(story, told(loss_m=1e-9), matrix_id="cm-1")


def test_soon_after_an_update_it_takes_twice_as_much_and_later_as_much_as_ever(story):
    story.use("cm-2")
    for k in range(1, 9):
        story.see(moved(NEAR, shift_x_subap=0.005 * k))
    there = moved(NEAR, shift_x_subap=0.04)
    assert not judged(story, told(loss_m=0.8e-9), alpha=there, matrix_id="cm-2")
    assert judged(copy(story), told(loss_m=1.5e-9), alpha=there, matrix_id="cm-2")
    story.wait(THRESHOLD_DECAY_S)
    story.see(there, n_windows=6)
    assert judged(story, told(loss_m=0.8e-9), alpha=there, matrix_id="cm-2")


def test_a_move_is_looked_at_at_once_and_the_new_matrix_comes_before_the_margin_of_the_old(story):
    judged(story, told())
    effects = story.see(moved(NEAR, shift_x_subap=0.03), n_windows=2)
    asked = [type(e) for e in effects if isinstance(e, (ev.MakeMatrix, ev.JudgeMatrix))]
    assert asked == [ev.MakeMatrix, ev.JudgeMatrix]


def test_a_registration_that_may_have_jumped_makes_nothing(story):
    story.see(moved(shift_x_subap=0.4))
    assert story.state.alpha.registration.suspected_jump is not None
    assert not judged(story, told(loss_m=5e-9))


def test_a_jump_asks_for_one_whatever_it_wins(story):
    story.see(moved(NEAR, rotation_rad=np.deg2rad(0.04)), n_windows=2)
    assert "registration.jump" in story.logged
    (made,) = story.asked(ev.MakeMatrix)
    assert made.why == "cm-1 was made before the mirror jumped"


def test_a_jump_that_a_verdict_still_reaches_asks_for_none(story):
    story.use("cm-2")
    story.effects.clear()
    story.see(moved(NEAR, rotation_rad=np.deg2rad(0.018)), n_windows=4)
    assert "registration.jump" in story.logged
    assert not story.asked(ev.MakeMatrix)


def test_far_enough_needs_no_estimate(story):
    story.policy = replace(FAR_THRESHOLDS, update_threshold=np.array([0.03, 0.03, 0.1, 0.1]))
    (made,) = of_kind(story.wait(2), ev.MakeMatrix)
    assert made.why.startswith("moved by")


def test_the_state_remembers_what_was_found(story):
    judged(story, told(loss_m=0.1e-9))
    assert story.state.matrices.assessment.id == "cm-1"
    assert story.state.matrices.assessment.alpha == NEAR
    assert story.state.matrices.assessment.expected.loss_m == 0.1e-9
    story.use("cm-2")
    assert story.state.matrices.assessment is None
    assert ALPHA != NEAR
