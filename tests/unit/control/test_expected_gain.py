"""Against closed forms, a direct solution per frequency, and a loop run frame by frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.control.expected_gain import (
    Sky,
    compute_radial_orders,
    estimate_noise_loss_m,
    estimate_slope_noise,
    extrapolate_variance_m2,
    predict_gain,
)
from service.control.loop import ControlLoop
from service.control.reconstructor import invert
from service.model.misregistration import Misregistration
from tests.support.numerics import N_CONTROLLED, N_MODES, small_basis, small_instrument, small_model

NOISE = 0.05
SKY = Sky(
    variance_m2=small_basis().variance_m2[:N_MODES],
    beyond_m2=0.0,
    crossing_hz=1.5,
    slope_noise=NOISE,
)
TIMING = ControlLoop(
    frame_rate_hz=500.0,
    delay_frames=2.0,
    leak=1.0,
    gains=np.full(N_CONTROLLED, 0.4),
    optical_gain=np.ones(N_MODES),
)


def matrix_at(alpha):
    return small_model().interaction_matrix(alpha)


def shifted(by):
    return Misregistration(shift_x_subap=by)


def judged(alpha, sky=SKY, timing=TIMING):
    in_use = invert(matrix_at(Misregistration()), N_CONTROLLED).matrix
    fresh = invert(matrix_at(alpha), N_CONTROLLED).matrix
    return predict_gain(in_use, fresh, matrix_at(alpha), timing, sky)


def test_a_matrix_that_fits_has_nothing_to_gain():
    found = judged(Misregistration())
    assert found.loss_m == pytest.approx(0.0, abs=1e-15)
    assert found.pole_radius == pytest.approx(found.fresh_pole_radius)


def test_the_loss_grows_about_as_the_square_of_a_shift():
    one, two = judged(shifted(0.1)).loss_m, judged(shifted(0.2)).loss_m
    # without a linear term: the next one is of the fourth order
    assert two == pytest.approx(4 * one, rel=0.25)
    assert one > 0.0


def test_the_margin_shrinks_with_a_shift_and_a_new_matrix_has_all_of_it():
    near, far = judged(shifted(0.1)), judged(shifted(0.2))
    assert near.fresh_pole_radius == pytest.approx(np.sqrt(0.4), rel=1e-3)  # z^2 - z + 0.4
    assert near.fresh_pole_radius < near.pole_radius < far.pole_radius


def test_what_is_unstable_loses_everything():
    fast = replace(TIMING, gains=np.full(N_CONTROLLED, 0.9))
    assert judged(shifted(0.3), timing=fast).loss_m == float("inf")


def still(*modes):
    gains = np.full(N_CONTROLLED, 0.4)
    gains[list(modes)] = 0.0
    return replace(TIMING, gains=gains)


def test_a_mode_without_gain_is_one_beyond_the_loop():
    """The last of them: as if the matrices had a row less."""
    matrix, n_fewer = matrix_at(shifted(0.1)), N_CONTROLLED - 1
    in_use, fresh = (invert(m, N_CONTROLLED).matrix for m in (matrix_at(Misregistration()), matrix))
    fewer = replace(TIMING, gains=np.full(n_fewer, 0.4))
    expected = predict_gain(in_use[:n_fewer], fresh[:n_fewer], matrix, fewer, SKY)
    found = judged(shifted(0.1), timing=still(n_fewer))
    for name in ("loss_m", "wavefront_m", "pole_radius", "fresh_pole_radius"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-6)


def test_whichever_of_them_it_is_the_others_still_gain_from_another_matrix():
    found = judged(shifted(0.1), timing=still(3, 7))
    assert 0.0 < found.loss_m < float("inf")
    assert found.fresh_pole_radius == pytest.approx(np.sqrt(0.4), rel=1e-2)
    assert found.wavefront_m > judged(shifted(0.1)).wavefront_m


def test_a_loop_without_any_gain_is_no_reason_for_another_matrix():
    found = judged(shifted(0.1), timing=still(*range(N_CONTROLLED)))
    assert (found.loss_m, found.fresh_pole_radius) == (0.0, pytest.approx(1.0))


def test_noise_alone_leaves_what_the_closed_form_says():
    """An integrator of delay 1 passes a share g / (2 - g) of white noise."""
    quiet = replace(SKY, variance_m2=np.full(N_MODES, 1e-30))
    found = judged(Misregistration(), quiet, replace(TIMING, delay_frames=1.0))
    rows = invert(matrix_at(Misregistration()), N_CONTROLLED).matrix.astype(float)
    expected = NOISE * np.linalg.norm(rows) * np.sqrt(0.4 / 1.6)
    # frequencies below a thousandth of the frame rate are left out
    assert found.wavefront_m == pytest.approx(expected, rel=5e-3)


def test_the_optical_gain_acts_like_the_loop_gain_on_the_turbulence():
    still = replace(SKY, slope_noise=1e-12, variance_m2=SKY.variance_m2.copy())
    still.variance_m2[N_CONTROLLED:] = 1e-30
    dim = replace(TIMING, optical_gain=np.full(N_MODES, 0.5))
    low = replace(TIMING, gains=np.full(N_CONTROLLED, 0.2))
    one, other = judged(shifted(0.1), still, dim), judged(shifted(0.1), still, low)
    assert one.wavefront_m == pytest.approx(other.wavefront_m, rel=1e-6)
    assert one.loss_m == pytest.approx(other.loss_m, rel=1e-4)


def test_it_is_what_a_loop_leaves_when_run_frame_by_frame():
    """White slope noise through a mis-registered loop of 4000 frames."""
    alpha = shifted(0.2)
    in_use = invert(matrix_at(Misregistration()), N_CONTROLLED).matrix.astype(float)
    sensor = matrix_at(alpha)[:, :N_CONTROLLED].astype(float)
    rng = np.random.default_rng(5)
    command, power = np.zeros((4002, N_CONTROLLED)), 0.0
    for k in range(4000):
        slopes = sensor @ command[k] + NOISE * rng.standard_normal(len(sensor))
        command[k + 2] = command[k + 1] - 0.4 * in_use @ slopes
    power = float(np.sum(command[200:4000] ** 2, axis=1).mean())
    calm = replace(SKY, variance_m2=np.full(N_MODES, 1e-30))
    found = judged(alpha, calm)
    left = found.wavefront_m + found.loss_m
    # 30 modes of some 1000 independent samples: 1 % of the RMS
    assert left == pytest.approx(np.sqrt(power), rel=0.02)


def test_modes_that_are_the_eigenvectors_and_mixtures_of_them_are_summed_alike():
    """A ten-thousandth of every mode in every other makes general eigenvectors of single modes."""
    fresh = invert(matrix_at(Misregistration()), N_CONTROLLED).matrix
    mixing = np.eye(N_CONTROLLED) + 1e-4 * np.random.default_rng(6).standard_normal(
        (N_CONTROLLED, N_CONTROLLED)
    )
    mixed = (mixing @ fresh).astype(np.float32)
    found = predict_gain(mixed, fresh, matrix_at(Misregistration()), TIMING, SKY)
    assert found.pole_radius != found.fresh_pole_radius
    assert abs(found.loss_m) < 2e-4 * found.wavefront_m


def test_the_tail_of_a_power_law_is_its_integral():
    modes = np.arange(1, 301)
    law = modes ** (-11 / 6)
    beyond = np.sum(np.arange(301, 2_000_000) ** (-11 / 6))
    assert extrapolate_variance_m2(law) == pytest.approx(beyond, rel=2e-3)


def test_radial_orders_count_like_zernikes_without_piston():
    assert compute_radial_orders(9).tolist() == [1, 1, 2, 2, 2, 3, 3, 3, 3]


class TestNoise:
    """How much of a loss is only the registration's own uncertainty."""

    def test_a_step_of_two_sigma_in_one_parameter_is_all_noise(self):
        assert estimate_noise_loss_m(1e-9, np.array([2.0, 0, 0, 0]), np.eye(4)) == 1e-9

    def test_a_large_step_is_hardly_any(self):
        assert estimate_noise_loss_m(1e-9, np.array([20.0, 0, 0, 0]), np.eye(4)) == pytest.approx(
            1e-11
        )


# --- noise


def test_a_bright_star_has_photon_noise_and_a_faint_one_four_reads_besides():
    bright, dimmer, faint = (
        estimate_slope_noise(small_instrument(), magnitude=m, frame_rate_hz=1000.0, n_valid=100)
        for m in (-5.0, 0.0, 12.5)
    )
    assert dimmer == pytest.approx(10.0 * bright, rel=1e-3)
    electrons = bright**-2.0 * 10.0**-7.0
    assert faint == pytest.approx(np.sqrt(electrons + 4 * 4.0**2) / electrons, rel=1e-3)
