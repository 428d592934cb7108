import numpy as np
import pytest

from service.model.misregistration import Misregistration
from sim_rtc.schedule import Drift, Jump, Schedule, random_registration

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
