from concurrent.futures import Executor, Future
from types import SimpleNamespace

import numpy as np
import pytest

from service.model.misregistration import Misregistration
from sim_rtc.telescope.registration import (
    Drift,
    Flexure,
    Jump,
    MovingOptics,
    Schedule,
    Walk,
    far_registration,
    random_registration,
)

START = Misregistration(shift_x_subap=0.1)


def test_a_drift_moves_by_its_rate_in_a_minute():
    schedule = Schedule(start=START, drift=Drift(shift_y_subap=0.06, rotation_deg=0.3))
    moved = schedule.alpha_at(30.0).to_boundary()
    assert moved["shift_x_subap"] == pytest.approx(0.1)
    assert moved["shift_y_subap"] == pytest.approx(0.03)
    assert moved["rotation_deg"] == pytest.approx(0.15)
    assert moved["magnification"] == pytest.approx(1.0)


def test_a_jump_belongs_to_the_time_after_it():
    jumps = (Jump(time_s=20.0, magnification=0.002), Jump(time_s=10.0, shift_x_subap=0.2))
    schedule = Schedule(start=START, jumps=jumps)
    assert schedule.alpha_at(9.999).shift_x_subap == pytest.approx(0.1)
    assert schedule.alpha_before(10.0).shift_x_subap == pytest.approx(0.1)
    assert schedule.alpha_at(10.0).shift_x_subap == pytest.approx(0.3)
    assert schedule.alpha_at(25.0).magnification == pytest.approx(1.002)
    assert [schedule.next_jump_after(t) for t in (0.0, 10.0, 20.0)] == [10.0, 20.0, np.inf]


def test_random_registrations_fill_the_range_a_loop_can_hold():
    rng = np.random.default_rng(1)
    drawn = np.array([list(random_registration(rng).to_boundary().values()) for _ in range(400)])
    shift = np.hypot(drawn[:, 0], drawn[:, 1])
    assert 0.19 < shift.max() <= 0.2
    # Uniform in the disc: half of them within 0.7071 of its radius.
    assert np.mean(shift < 0.2 * np.sqrt(0.5)) == pytest.approx(0.5, abs=0.1)
    assert 0.28 < np.abs(drawn[:, 2]).max() <= 0.3
    assert 0.0047 < np.abs(drawn[:, 3] - 1).max() <= 0.005


def test_a_far_registration_is_beyond_what_400_modes_hold_whichever_way_it_lies():
    rng = np.random.default_rng(1)
    drawn = np.array([list(far_registration(rng, 0.1).to_boundary().values()) for _ in range(400)])
    shift = np.hypot(drawn[:, 0], drawn[:, 1])
    assert 0.40 <= shift.min() < shift.max() <= 0.42
    turn = drawn[:, 2] - np.rad2deg(0.1)
    assert 0.6 <= np.abs(turn).min() < np.abs(turn).max() <= 0.7
    assert 0.002 <= np.abs(drawn[:, 3] - 1).min() < np.abs(drawn[:, 3] - 1).max() <= 0.004
    # every quarter of the directions, both senses of the rotation, larger and smaller
    assert {tuple(signs) for signs in np.sign(drawn[:, :2])} == {
        (x, y) for x in (-1, 1) for y in (-1, 1)
    }
    assert set(np.sign(turn)) == set(np.sign(drawn[:, 3] - 1)) == {-1.0, 1.0}


def test_a_flexure_is_a_sine_that_begins_at_zero():
    flexure = Flexure(shift_x_subap=0.2, rotation_deg=0.1, period_s=80.0)
    schedule = Schedule(start=START, flexure=flexure)
    moved = [schedule.alpha_at(t).to_boundary() for t in (0.0, 20.0, 40.0, 60.0)]
    assert [m["shift_x_subap"] for m in moved] == pytest.approx([0.1, 0.3, 0.1, -0.1])
    assert moved[1]["rotation_deg"] == pytest.approx(0.1)
    assert schedule.drifts
    # Straight pieces of a twelfth of the period.
    assert schedule.segment_s == pytest.approx(80.0 / 12)


def test_a_walk_is_the_same_whatever_was_asked_before_and_continuous():
    walk = Walk(shift_x_subap=0.05, magnification=0.001, seed=7)
    late_first = [walk.offset(t) for t in (100.0, 10.0)]
    early_first = [walk.offset(t) for t in (10.0, 100.0)][::-1]
    np.testing.assert_array_equal(late_first, early_first)
    times = np.arange(0.0, 200.0, 0.5)
    steps = np.abs(np.diff([walk.offset(t) for t in times], axis=0))
    assert steps[:, 0].max() < 0.5 / 20 * 0.05 * 4
    assert not steps[:, 1].any()
    np.testing.assert_array_equal(walk.offset(0.0), 0.0)


def test_a_walk_spreads_with_the_square_root_of_time():
    ends = np.array(
        [
            [Walk(shift_x_subap=0.05, seed=seed).offset(t)[0] for t in (60.0, 540.0)]
            for seed in range(400)
        ]
    )
    # 400 walks: 3.5 % on a standard deviation.
    np.testing.assert_allclose(ends.std(axis=0), [0.05, 0.15], rtol=0.14)


def test_nothing_asked_for_is_nothing_moved():
    still = Schedule(start=START)
    assert not still.drifts
    assert still.alpha_at(1e4) == START


def test_a_stage_moves_what_drifts_and_jumps_by_themselves_as_well():
    class Plant:
        def optics(self, alpha):
            return SimpleNamespace(alpha=alpha)

    class AtOnce(Executor):
        def submit(self, function, /, *args):
            future = Future()
            future.set_result(function(*args))
            return future

    schedule = Schedule(start=START, jumps=(Jump(time_s=10.0, shift_y_subap=0.2),))
    optics = MovingOptics(Plant(), schedule, AtOnce())
    assert optics.start().alpha.shift_x_subap == pytest.approx(0.1)
    optics.at(1.0)
    assert optics.move(np.array([-0.1, 0.0, 0.01, 0.0]), 1.5) == 2.5
    seen = {time_s: optics.at(time_s).alpha for time_s in (2.0, 2.5, 9.0, 10.0, 10.5)}
    assert seen[2.0].shift_x_subap == pytest.approx(0.1)
    assert seen[2.5].shift_x_subap == pytest.approx(0.0)
    assert seen[2.5].rotation_rad == pytest.approx(START.rotation_rad + 0.01)
    assert seen[10.5].shift_y_subap == pytest.approx(START.shift_y_subap + 0.2)
    assert seen[10.5].shift_x_subap == pytest.approx(0.0)
