"""The registration and the wind's bias of its passive estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.wind import (
    BIAS_SIGMA_SUBAP,
    PASSIVE_FLOOR,
    Drift,
    Joint,
    begin_joint,
    predicted,
    with_dithered,
    with_passive,
)

DITHERED = np.diag(np.array([0.008, 0.008, np.deg2rad(0.02), 0.0008]) ** 2)
SCATTER = np.diag(np.array([0.003, 0.003, np.deg2rad(0.01), 0.0003]) ** 2)
DRIFT = Drift(alpha_rate=np.array([0.05, 0.05, np.deg2rad(0.05), 0.0005]) / np.sqrt(3600.0))
STILL = Drift(alpha_rate=np.zeros(4), bias_memory_s=np.inf)
NOWHERE = np.array([0.0, 0.0, 0.0, 1.0])


def away(*step: float) -> np.ndarray:
    """A registration this far from none at all."""
    return NOWHERE + np.array(step)


def test_one_passive_reading_alone_says_nothing_better_than_the_wind_allows():
    """Prior of α: 1 subaperture. The sum of bias, scatter and floor is what remains of it."""
    begun = begin_joint(NOWHERE, np.diag([1.0, 1.0, 0.01, 0.001]), 0.0)
    found = with_passive(begun, NOWHERE, SCATTER, drift=STILL, t_s=0.0)
    sigma = np.sqrt(np.diag(found.alpha_covariance))
    assert np.all(sigma[:2] > 0.99 * BIAS_SIGMA_SUBAP)
    floor = np.sqrt(np.diag(SCATTER) + PASSIVE_FLOOR**2)
    np.testing.assert_allclose(sigma[2:], floor[2:], rtol=0.1)


def test_the_bias_is_the_difference_of_the_two_readings():
    """Both many times: to a tenth of a percent of a subaperture."""
    joint = begin_joint(NOWHERE, DITHERED, 0.0)
    for _ in range(400):
        joint = with_dithered(joint, NOWHERE, DITHERED, drift=STILL, t_s=0.0)
        read = away(0.06, -0.03, 0.0, 0.0)
        joint = with_passive(joint, read, SCATTER, drift=STILL, t_s=0.0)
    np.testing.assert_allclose(joint.bias_subap, [0.06, -0.03], atol=1e-3)
    np.testing.assert_allclose(joint.alpha, NOWHERE, atol=1e-3)


def night(seed: int, dither_every_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors ``(n, 4)`` and normalised squares ``(n,)`` of an hour: passive every 10 s."""
    rng = np.random.default_rng(seed)
    joint: Joint | None = None
    true, bias, errors, squares = NOWHERE.copy(), rng.normal(size=2) * 0.06, [], []
    for t in np.arange(0.0, 3600.0, 10.0):
        true = true + DRIFT.alpha_rate * np.sqrt(10.0) * rng.normal(size=4)
        keep = np.exp(-10.0 / DRIFT.bias_memory_s)
        bias = keep * bias + 0.06 * np.sqrt(1 - keep**2) * rng.normal(size=2)
        if t % dither_every_s == 0.0:
            read = true + np.sqrt(np.diag(DITHERED)) * rng.normal(size=4)
            if joint is None:
                joint = begin_joint(read, DITHERED, t)
            joint = with_dithered(joint, read, DITHERED, drift=DRIFT, t_s=t)
        assert joint is not None
        read = true + np.sqrt(np.diag(SCATTER)) * rng.normal(size=4)
        read[:2] += bias
        joint = with_passive(joint, read, SCATTER, drift=DRIFT, t_s=t)
        if t > 600.0:
            error = joint.alpha - true
            errors.append(error)
            squares.append(error @ np.linalg.solve(joint.alpha_covariance, error))
    return np.array(errors), np.array(squares)


def test_one_dither_a_minute_holds_the_shifts_to_a_percent_whatever_the_wind():
    """The bias is 6 % RMS; the dither alone scatters by 0.8 %."""
    errors, squares = zip(*(night(seed, 60.0) for seed in range(6)), strict=True)
    rms = np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))
    assert np.all(rms[:2] < 0.01)
    assert 0.6 < np.mean(np.concatenate(squares)) / 4 < 1.2


def test_a_change_of_wind_is_not_taken_for_a_moved_mirror():
    joint = begin_joint(NOWHERE, DITHERED, 0.0)
    for _ in range(20):
        joint = with_dithered(joint, NOWHERE, DITHERED, drift=STILL, t_s=0.0)
        joint = with_passive(joint, NOWHERE, SCATTER, drift=STILL, t_s=0.0)
    gust = with_passive(joint, away(0.12, 0, 0, 0), SCATTER, drift=STILL, t_s=0.0)
    assert gust.jumped
    np.testing.assert_allclose(gust.alpha, joint.alpha)
    assert gust.covariance[4, 4] == pytest.approx(BIAS_SIGMA_SUBAP**2)


def test_a_jump_seen_by_the_dither_moves_the_registration_and_keeps_the_bias():
    joint = begin_joint(NOWHERE, DITHERED, 0.0)
    for _ in range(50):
        joint = with_dithered(joint, NOWHERE, DITHERED, drift=STILL, t_s=0.0)
        read = away(0.05, 0, 0, 0)
        joint = with_passive(joint, read, SCATTER, drift=STILL, t_s=0.0)
    moved = with_dithered(joint, away(0.1, 0, 0, 0), DITHERED, drift=STILL, t_s=0.0)
    assert moved.jumped
    assert moved.alpha[0] == pytest.approx(0.1, abs=0.005)
    assert moved.bias_subap[0] == pytest.approx(0.05, abs=0.01)


def test_what_was_learnt_of_the_bias_fades_to_knowing_nothing():
    joint = begin_joint(NOWHERE, DITHERED, 0.0)
    learnt = replace(joint, mean=joint.mean + np.array([0, 0, 0, 0, 0.05, 0]))
    later = predicted(learnt, DRIFT, 20 * DRIFT.bias_memory_s)
    np.testing.assert_allclose(later.bias_subap, 0.0, atol=1e-9)
    assert later.covariance[4, 4] == pytest.approx(BIAS_SIGMA_SUBAP**2)
