"""Loops whose poles are known by hand, and noise that bounds the answer."""

import numpy as np
import pytest

from pyrcal.fitting.control_check import check_control

RNG = np.random.default_rng(2)
MODEL = np.linalg.qr(RNG.normal(size=(200, 12)))[0]


def check(plant, *, gains=None, **options):
    n = MODEL.shape[1]
    rows = np.ones(len(MODEL), dtype=bool)
    gains = np.ones(n) if gains is None else gains
    return check_control(plant, MODEL, gains, np.arange(n), rows, **options)


def test_a_model_that_is_the_plant_has_the_poles_of_an_aligned_loop():
    found = check(MODEL, gain=0.5)
    assert found.holds
    # z^2 - z + 0.5 = 0: |z| = sqrt(0.5)
    assert found.pole_radius == pytest.approx(np.sqrt(0.5), abs=1e-6)
    assert found.loss_ratio == pytest.approx(1.0, abs=1e-6)


def test_calibration_gains_are_divided_out():
    gains = np.linspace(0.5, 2.0, 12)
    assert check(MODEL * gains, gains=gains).pole_radius == pytest.approx(np.sqrt(0.5), abs=1e-6)


def test_a_mode_of_the_other_sign_bounds_the_number_of_modes_and_is_named():
    plant = MODEL.copy()
    plant[:, 7] *= -1.0
    found = check(plant)
    assert found.stable_modes == 7
    assert found.pole_radius_all > 1.0
    assert found.weakest_modes == (7,)
    assert not found.noise_limited


def test_noise_that_alone_makes_a_loop_unstable_is_said_to_bound_the_answer():
    plant = MODEL + RNG.normal(size=MODEL.shape)
    found = check(plant)
    assert not found.holds
    assert found.noise_limited
    assert "noise" in found.reason


@pytest.mark.parametrize("wrong", [26, 33, 41])
def test_the_number_of_stable_modes_is_found_to_three_percent(wrong):
    model = np.linalg.qr(np.random.default_rng(1).normal(size=(200, 60)))[0]
    plant = model.copy()
    plant[:, wrong] *= -1.0
    rows = np.ones(len(model), dtype=bool)
    found = check_control(plant, model, np.ones(60), np.arange(60), rows)
    assert 0.97 * wrong - 1 <= found.stable_modes <= wrong
