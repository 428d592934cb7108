"""The gate judges with the gains a matrix would run with, mode by mode."""

import numpy as np
import pytest

from service.control.gate import judge
from service.control.loop import ControlLoop
from service.control.reconstructor import invert
from service.model.misregistration import Misregistration
from tests.numerics import N_CONTROLLED, small_linearisation

SIGMA = np.array([0.003, 0.003, 9e-5, 3e-4])


def worst(optical_gain, gains):
    linear = small_linearisation()
    loop = ControlLoop(
        frame_rate_hz=1000.0,
        gains=np.asarray(gains),
        leak=1.0,
        delay_frames=2.0,
        optical_gain=optical_gain,
    )
    matrix = invert(linear.matrix_at(Misregistration()), N_CONTROLLED).matrix
    found = judge(matrix, linear, Misregistration(), np.diag(SIGMA**2), loop, bound=0.95)
    return found.worst_pole_radius


def test_one_gain_for_all_and_the_same_for_each_are_one_thing():
    gains = np.full(N_CONTROLLED, 0.4)
    assert worst(0.6, gains) == pytest.approx(worst(np.full(N_CONTROLLED, 0.6), gains), rel=1e-6)


def test_gains_that_undo_the_optical_gain_leave_the_same_loop():
    optical = np.linspace(0.5, 0.8, N_CONTROLLED)
    undone = worst(optical, 0.3 / optical)
    assert undone == pytest.approx(worst(1.0, np.full(N_CONTROLLED, 0.3)), rel=1e-3)


def test_one_mode_with_too_high_a_gain_is_seen():
    gains = np.full(N_CONTROLLED, 0.4)
    gains[17] = 1.3
    assert worst(1.0, gains) > 1.0
    assert worst(np.where(gains > 1.0, 0.3, 1.0), gains) < 0.8


def test_fewer_modes_of_a_loop_keep_their_own_gains():
    loop = ControlLoop(
        frame_rate_hz=1000.0,
        gains=np.arange(5.0),
        leak=1.0,
        delay_frames=2.0,
        optical_gain=np.arange(5.0) + 10.0,
    )
    few = loop.select_modes(slice(3))
    assert few.gains.tolist() == [0.0, 1.0, 2.0]
    assert few.optical_gain.tolist() == [10.0, 11.0, 12.0]
    one = ControlLoop(
        frame_rate_hz=1000.0, gains=np.arange(5.0), leak=1.0, delay_frames=2.0, optical_gain=0.5
    )
    assert one.select_modes(slice(2)).optical_gain == 0.5
