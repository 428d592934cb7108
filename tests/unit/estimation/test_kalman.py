"""The registration as a random walk."""

from __future__ import annotations

import numpy as np
import pytest

from service.estimation.kalman import JUMP_THRESHOLD, begin, update

NONE = np.zeros(4)
SIGMA = np.array([0.015, 0.015, np.deg2rad(0.01), 0.0005])
"""A window's 1 σ: 1.5 % of a subaperture."""


def test_the_first_measurement_is_taken_as_it_is():
    found = begin(np.arange(4.0), np.diag(SIGMA**2))
    np.testing.assert_array_equal(found.mean, np.arange(4.0))
    assert found.innovation == 0.0
    assert not found.jumped


def test_two_equal_measurements_are_averaged():
    """The arithmetic mean, and half the variance."""
    noise = np.diag(SIGMA**2)
    found = update(NONE, noise, SIGMA, noise, drift_rate=NONE, elapsed_s=5.0)
    np.testing.assert_allclose(found.mean, SIGMA / 2)
    np.testing.assert_allclose(found.covariance, noise / 2)
    assert found.innovation == pytest.approx(4 * 0.5)


def test_without_drift_a_perfect_estimate_is_not_moved_by_a_noisy_measurement():
    found = update(NONE, 1e-30 * np.eye(4), SIGMA, np.diag(SIGMA**2), drift_rate=NONE, elapsed_s=1)
    np.testing.assert_allclose(found.mean, 0.0, atol=1e-20)


def test_a_perfect_measurement_is_believed():
    prior = np.diag(SIGMA**2)
    found = update(NONE, prior, SIGMA, np.zeros((4, 4)), drift_rate=NONE, elapsed_s=1.0)
    np.testing.assert_allclose(found.mean, SIGMA)
    np.testing.assert_allclose(found.covariance, 0.0, atol=1e-12 * prior.max())


def test_the_random_walk_widens_with_the_square_root_of_time():
    drift = np.array([0.01, 0.02, 0.001, 0.0003])
    huge = 1e12 * np.eye(4)
    found = update(NONE, np.zeros((4, 4)), NONE, huge, drift_rate=drift, elapsed_s=9.0)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), 3 * drift, rtol=1e-6)


def test_a_measurement_out_of_order_does_not_shrink_the_prior():
    noise = np.diag(SIGMA**2)
    late, now = (
        update(NONE, noise, SIGMA, noise, drift_rate=SIGMA, elapsed_s=t) for t in (-3.0, 0.0)
    )
    np.testing.assert_array_equal(late.covariance, now.covariance)


def tracked(n_windows: int) -> tuple[np.ndarray, np.ndarray]:
    """An estimate after many windows of a mirror at rest."""
    rng = np.random.default_rng(11)
    noise = np.diag(SIGMA**2)
    found = begin(SIGMA * rng.normal(size=4), noise)
    for _ in range(n_windows):
        found = update(
            found.mean,
            found.covariance,
            SIGMA * rng.normal(size=4),
            noise,
            drift_rate=SIGMA / 20,
            elapsed_s=1.0,
        )
        assert not found.jumped
    return found.mean, found.covariance


def test_a_mirror_at_rest_raises_no_jump_and_is_found_to_a_fraction_of_a_windows_sigma():
    mean, covariance = tracked(300)
    assert np.all(np.abs(mean) < 4 * np.sqrt(np.diag(covariance)))
    assert np.all(np.sqrt(np.diag(covariance)) < SIGMA / 3)


@pytest.mark.parametrize(
    "jump", [[0.10, 0, 0, 0], [0, -0.10, 0, 0], [0, 0, np.deg2rad(0.1), 0], [0, 0, 0, 0.003]]
)
def test_a_jump_is_flagged_on_the_first_window_and_followed_at_once(jump):
    """10 % of a subaperture, 0.1 deg or 0.3 % at a noise of 1.5 %, 0.01 deg and 0.05 %."""
    mean, covariance = tracked(100)
    measured = mean + jump
    found = update(
        mean, covariance, measured, np.diag(SIGMA**2), drift_rate=SIGMA / 20, elapsed_s=1.0
    )
    assert found.jumped
    assert found.innovation > JUMP_THRESHOLD
    assert np.all(np.abs(found.mean - measured) < 0.02 * np.abs(jump).max())
    assert np.all(np.diag(found.covariance) > 0.9 * SIGMA**2)


def test_the_threshold_is_what_four_degrees_of_freedom_exceed_once_in_ten_thousand():
    """Survival function of chi-squared with 4 degrees: (1 + x/2) exp(-x/2)."""
    half = JUMP_THRESHOLD / 2
    assert (1 + half) * np.exp(-half) == pytest.approx(1e-4, rel=0.02)


def test_the_inputs_are_left_alone():
    mean, covariance = np.zeros(4), np.diag(SIGMA**2)
    update(mean, covariance, SIGMA * 9, covariance, drift_rate=SIGMA, elapsed_s=1.0)
    np.testing.assert_array_equal(mean, 0.0)
    np.testing.assert_array_equal(covariance, np.diag(SIGMA**2))
