"""The registration as a random walk, and the bias of its passive estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.kalman import (
    JUMP_THRESHOLD,
    Drift,
    Joint,
    allow_scatter,
    begin_joint,
    correct_state,
    expect_stretches,
    forget,
    innovation,
    predict_state,
    widen_after_jump,
    with_stretches,
)
from service.records.estimates import BIAS_FLOOR, BIAS_OVER_SCATTER

DITHERED = np.diag(np.array([0.008, 0.008, np.deg2rad(0.02), 0.0008]) ** 2)
SCATTER = np.diag(np.array([0.003, 0.003, np.deg2rad(0.01), 0.0003]) ** 2)
DRIFT = Drift(alpha_rate=np.array([0.05, 0.05, np.deg2rad(0.05), 0.0005]) / np.sqrt(3600.0))
STILL = Drift(alpha_rate=np.zeros(4), bias_memory_s=np.inf)
NOWHERE = np.array([0.0, 0.0, 0.0, 1.0])
SIGMA = np.array([0.015, 0.015, np.deg2rad(0.01), 0.0005])
"""A window's 1 σ: 1.5 % of a subaperture."""


def begun(measured: np.ndarray, covariance: np.ndarray) -> Joint:
    """The filter after a window, nothing known of the bias."""
    return forget(begin_joint(measured, covariance))


def away(*step: float) -> np.ndarray:
    """A registration this far from none at all."""
    return NOWHERE + np.array(step)


class TestWindows:
    """Dithered windows alone: an ordinary Kalman filter."""

    def test_the_first_measurement_is_taken_as_it_is(self):
        found = begin_joint(np.arange(4.0), DITHERED)
        np.testing.assert_array_equal(found.alpha, np.arange(4.0))
        np.testing.assert_array_equal(found.alpha_covariance, DITHERED)

    def test_two_equal_measurements_are_averaged(self):
        """The arithmetic mean, and half the variance; the innovation is 4 x 1/2."""
        noise = np.diag(SIGMA**2)
        begun = begin_joint(np.zeros(4), noise)
        found = correct_state(begun, SIGMA, noise)
        np.testing.assert_allclose(found.alpha, SIGMA / 2)
        np.testing.assert_allclose(found.alpha_covariance, noise / 2)
        assert innovation(begun, SIGMA, noise) == pytest.approx(2.0)

    def test_the_random_walk_widens_with_the_square_root_of_time(self):
        drift = Drift(alpha_rate=np.array([0.01, 0.02, 0.001, 0.0003]))
        found = predict_state(begin_joint(NOWHERE, np.zeros((4, 4))), drift, 9.0)
        sigma = np.sqrt(np.diag(found.alpha_covariance))
        np.testing.assert_allclose(sigma, 3 * drift.alpha_rate)

    def test_time_that_runs_backwards_does_not_shrink_it(self):
        begun = begin_joint(NOWHERE, DITHERED)
        early = predict_state(begun, DRIFT, -3.0)
        np.testing.assert_array_equal(early.covariance, begun.covariance)

    def test_what_flexure_adds_is_a_variance_too(self):
        """0.3 and 0.4 make 0.5."""
        begun = begin_joint(NOWHERE, np.diag([0.09, 0.0, 0.0, 0.0]))
        bent = predict_state(begun, STILL, 1.0, np.array([0.4, 0.0, 0.0, 0.0]))
        assert np.sqrt(bent.covariance[0, 0]) == pytest.approx(0.5)

    @pytest.mark.parametrize(
        "jump", [[0.10, 0, 0, 0], [0, -0.10, 0, 0], [0, 0, np.deg2rad(0.1), 0], [0, 0, 0, 0.003]]
    )
    def test_a_jump_is_far_out_and_a_widened_prior_follows_it_at_once(self, jump):
        """10 % of a subaperture, 0.1 deg or 0.3 % at a noise of 1.5 %, 0.01 deg and 0.05 %."""
        rng = np.random.default_rng(11)
        noise, walk = np.diag(SIGMA**2), Drift(alpha_rate=SIGMA / 20)
        joint = begin_joint(SIGMA * rng.normal(size=4), noise)
        for _ in range(100):
            prior = predict_state(joint, walk, 1.0)
            read = SIGMA * rng.normal(size=4)
            assert innovation(prior, read, noise) < JUMP_THRESHOLD
            joint = correct_state(prior, read, noise)
        assert np.all(np.abs(joint.alpha) < 4 * np.sqrt(np.diag(joint.alpha_covariance)))
        measured = joint.alpha + jump
        prior = predict_state(joint, walk, 1.0)
        assert innovation(prior, measured, noise) > JUMP_THRESHOLD
        found = correct_state(widen_after_jump(prior, noise), measured, noise)
        assert np.all(np.abs(found.alpha - measured) < 0.02 * np.abs(jump).max())
        assert np.all(np.diag(found.alpha_covariance) > 0.9 * SIGMA**2)

    def test_the_threshold_is_what_four_degrees_of_freedom_exceed_once_in_ten_thousand(self):
        """Survival function of chi-squared with 4 degrees: (1 + x/2) exp(-x/2)."""
        half = JUMP_THRESHOLD / 2
        assert (1 + half) * np.exp(-half) == pytest.approx(1e-4, rel=0.02)

    def test_the_inputs_are_left_alone(self):
        begun, measured, noise = begin_joint(NOWHERE, DITHERED), away(0.1, 0, 0, 0), SCATTER.copy()
        correct_state(predict_state(begun, DRIFT, 5.0), measured, noise)
        np.testing.assert_array_equal(begun.alpha_covariance, DITHERED)
        np.testing.assert_array_equal(noise, SCATTER)
        np.testing.assert_array_equal(measured, away(0.1, 0, 0, 0))


class TestBias:
    """What a passive estimate adds, and what it must not."""

    def test_many_passive_readings_say_nothing_better_than_the_bias_allows(self):
        """Prior of α: 1 subaperture. A bias does not average out, of no parameter."""
        joint = begun(NOWHERE, np.diag([1.0, 1.0, 0.01, 0.01]))
        for _ in range(50):
            joint = correct_state(joint, NOWHERE, SCATTER, passive=True)
        assert np.all(np.sqrt(np.diag(joint.alpha_covariance)) > 0.99 * BIAS_FLOOR)

    def test_the_bias_is_the_difference_of_the_two_readings(self):
        """Both many times: to a tenth of a percent of a subaperture."""
        joint = begun(NOWHERE, DITHERED)
        for _ in range(400):
            joint = correct_state(joint, NOWHERE, DITHERED)
            joint = correct_state(joint, away(0.06, -0.03, 3e-4, 0.0), SCATTER, passive=True)
        np.testing.assert_allclose(joint.offset, [0.06, -0.03, 3e-4, 0.0], atol=1e-3)
        np.testing.assert_allclose(joint.alpha, NOWHERE, atol=1e-3)

    def test_once_the_bias_is_learnt_a_passive_reading_moves_the_registration(self):
        joint = begun(NOWHERE, DITHERED)
        for _ in range(100):
            joint = correct_state(joint, NOWHERE, DITHERED)
            joint = correct_state(joint, away(0.06, 0, 0, 0), SCATTER, passive=True)
        later = predict_state(joint, Drift(alpha_rate=np.full(4, 0.01), bias_memory_s=np.inf), 1.0)
        found = correct_state(later, away(0.08, 0, 0, 0), SCATTER, passive=True)
        assert found.alpha[0] == pytest.approx(0.02, abs=0.003)
        assert np.sqrt(found.covariance[0, 0]) < 0.005

    def test_a_change_of_wind_is_far_out_and_what_is_forgotten_is_the_bias_alone(self):
        joint = begun(NOWHERE, DITHERED)
        for _ in range(20):
            joint = correct_state(joint, NOWHERE, DITHERED)
            joint = correct_state(joint, NOWHERE, SCATTER, passive=True)
        assert innovation(joint, away(0.12, 0, 0, 0), SCATTER, passive=True) > JUMP_THRESHOLD
        gone = forget(joint)
        np.testing.assert_array_equal(gone.alpha, joint.alpha)
        np.testing.assert_array_equal(gone.alpha_covariance, joint.alpha_covariance)
        np.testing.assert_array_equal(gone.covariance[4:, 4:], np.diag(BIAS_FLOOR**2))

    def test_a_jump_seen_by_the_dither_keeps_the_bias(self):
        joint = begun(NOWHERE, DITHERED)
        for _ in range(50):
            joint = correct_state(joint, NOWHERE, DITHERED)
            joint = correct_state(joint, away(0.05, 0, 0, 0), SCATTER, passive=True)
        moved = correct_state(widen_after_jump(joint, DITHERED), away(0.1, 0, 0, 0), DITHERED)
        assert moved.alpha[0] == pytest.approx(0.1, abs=0.005)
        assert moved.offset[0] == pytest.approx(0.05, abs=0.01)

    def test_what_was_learnt_of_the_bias_fades_to_knowing_nothing(self):
        joint = begun(NOWHERE, DITHERED)
        learnt = replace(joint, mean=joint.mean + np.array([0, 0, 0, 0, 0.05, 0, 0, 0]))
        later = predict_state(learnt, DRIFT, 20 * DRIFT.bias_memory_s)
        np.testing.assert_allclose(later.offset, 0.0, atol=1e-9)
        np.testing.assert_allclose(np.sqrt(np.diag(later.covariance)[4:]), BIAS_FLOOR)


class TestExcess:
    """What a look's own scatter tells of how large its bias may be."""

    def test_where_nothing_is_learnt_a_reading_is_worth_what_the_estimate_says(self):
        """10 % and, at a scatter of 1.4 %, 14 % more of it: together with the scatter 17.3 %."""
        excess = np.array([0.14, 0.14, 0.0, 0.0]) ** 2
        found = allow_scatter(begun(NOWHERE, DITHERED), excess)
        np.testing.assert_allclose(np.diag(found.covariance)[4:], BIAS_FLOOR**2 + excess)
        np.testing.assert_array_equal(found.alpha_covariance, DITHERED)

    def test_the_same_wind_adds_it_once_however_often_it_is_looked_at(self):
        """And the bias that was learnt meanwhile stays learnt."""
        excess = np.array([0.1, 0.1, 0.0, 0.0]) ** 2
        joint = begun(NOWHERE, DITHERED)
        for _ in range(50):
            joint = correct_state(joint, NOWHERE, DITHERED)
            joint = correct_state(
                allow_scatter(joint, excess),
                away(0.15, 0, 0, 0),
                SCATTER,
                passive=True,
            )
        again = allow_scatter(joint, excess)
        np.testing.assert_array_equal(again.covariance, joint.covariance)
        assert np.sqrt(again.covariance[4, 4]) < 0.002
        assert again.offset[0] == pytest.approx(0.15, abs=0.005)

    def test_a_look_that_tells_of_more_moves_a_known_registration_less(self):
        """The bias may have changed with the wind: 1 % of a subaperture of drift, a step of 6 %."""
        joint = begun(NOWHERE, DITHERED)
        for _ in range(50):
            joint = correct_state(joint, NOWHERE, DITHERED)
            joint = correct_state(joint, NOWHERE, SCATTER, passive=True)
        joint = predict_state(joint, Drift(alpha_rate=np.full(4, 0.01), bias_memory_s=np.inf), 1.0)
        calm = correct_state(joint, away(0.06, 0, 0, 0), SCATTER, passive=True)
        windy = allow_scatter(joint, np.array([0.12, 0.12, 0.0, 0.0]) ** 2)
        stormy = correct_state(windy, away(0.06, 0, 0, 0), 16 * SCATTER, passive=True)
        assert calm.alpha[0] > 0.04
        assert stormy.alpha[0] < 0.001
        assert stormy.offset[0] > 0.05

    def test_what_is_forgotten_is_as_uncertain_as_the_look_that_made_it_be(self):
        excess = np.array([0.05, 0.0, 0.0, 0.0])
        much = allow_scatter(begun(NOWHERE, DITHERED), 3.0 * excess)
        gone = forget(much, excess)
        np.testing.assert_allclose(np.diag(gone.covariance)[4:], BIAS_FLOOR**2 + excess)
        np.testing.assert_array_equal(gone.bias.excess, excess)

    def test_a_wind_that_lasts_keeps_it_while_the_filter_fades_it(self):
        """For days: one hour of memory, a look every minute."""
        excess = np.array([0.2, 0.2, 0.0, 0.0]) ** 2
        joint = allow_scatter(begun(NOWHERE, DITHERED), excess)
        for _ in range(3000):
            joint = allow_scatter(predict_state(joint, DRIFT, 60.0), excess)
        np.testing.assert_allclose(np.diag(joint.covariance)[4:], BIAS_FLOOR**2 + excess)


CALM = np.array([0.003, 0.003, np.deg2rad(0.01), 3e-4])
STRONG = np.array([0.0125, 0.0125, np.deg2rad(0.01), 3e-4])
"""Scatter of a look in 25 m/s at a bright star."""


def windy_night(seed: int, scatters: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Normalised errors and their square ``(n, 5)``: a look every 6 s, dithers at 120 and 180 s.

    The mirror is known to 20 % of a subaperture at first. The scatter changes at 240 s, and the
    bias grows with it.
    """
    rng = np.random.default_rng(seed)
    drift = Drift(alpha_rate=DRIFT.alpha_rate)
    coarse = np.diag([0.2, 0.2, 5e-3, 5e-3]) ** 2
    true = NOWHERE.copy()
    joint = begun(true + np.sqrt(np.diag(coarse)) * rng.normal(size=4), coarse)
    bias, allowed, found = BIAS_FLOOR * rng.normal(size=4), np.zeros(4), []
    for t in range(6, 301, 6):
        scatter = scatters[t > 240]
        excess = BIAS_OVER_SCATTER**2 * scatter**2
        bias = bias + np.sqrt(np.maximum(excess - allowed, 0.0)) * rng.normal(size=4)
        allowed = np.maximum(excess, allowed)
        true = true + DRIFT.alpha_rate * np.sqrt(6.0) * rng.normal(size=4)
        joint = predict_state(joint, drift, 6.0)
        if t in {120, 180}:
            read = true + np.sqrt(np.diag(DITHERED)) * rng.normal(size=4)
            joint = correct_state(joint, read, DITHERED)
        read = true + bias + scatter * rng.normal(size=4)
        joint = correct_state(allow_scatter(joint, excess), read, np.diag(scatter**2), passive=True)
        error, covariance = joint.alpha - true, joint.alpha_covariance
        square = error @ np.linalg.solve(covariance, error)
        found.append([*error / np.sqrt(np.diag(covariance)), square])
    return np.array(found)


@pytest.mark.parametrize(
    "scatters", [(CALM, STRONG), pytest.param((STRONG, CALM), marks=pytest.mark.long)]
)
def test_sigma_covers_before_and_after_a_dither_and_when_the_wind_changes(scatters):
    """200 nights at four moments, each one draw: shifts within 1.96 σ in 95 %, chi2/4 of 1.

    Two shifts of 200 nights leave 1.1 % of the share, and 5 % of chi2/4, to chance: 3 of each.
    """
    nights = np.array([windy_night(seed, scatters) for seed in range(200)])
    for seconds in (6, 114, 240, 300):
        moment = nights[:, seconds // 6 - 1]
        assert 0.917 < np.mean(np.abs(moment[:, :2]) < 1.96) < 0.983, seconds
        assert 0.85 < np.mean(moment[:, 4]) / 4 < 1.15, seconds


def night(seed: int, dither_every_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors ``(n, 4)`` and normalised squares ``(n,)`` of an hour: passive every 10 s."""
    rng = np.random.default_rng(seed)
    joint: Joint | None = None
    size = np.array([0.06, 0.06, np.deg2rad(0.03), 0.0006])
    true, bias, errors, squares = NOWHERE.copy(), rng.normal(size=4) * size, [], []
    for t in np.arange(0.0, 3600.0, 10.0):
        true = true + DRIFT.alpha_rate * np.sqrt(10.0) * rng.normal(size=4)
        keep = np.exp(-10.0 / DRIFT.bias_memory_s)
        bias = keep * bias + size * np.sqrt(1 - keep**2) * rng.normal(size=4)
        joint = None if joint is None else predict_state(joint, DRIFT, 10.0)
        if t % dither_every_s == 0.0:
            read = true + np.sqrt(np.diag(DITHERED)) * rng.normal(size=4)
            fresh = begun(read, DITHERED)
            joint = fresh if joint is None else correct_state(joint, read, DITHERED)
        assert joint is not None
        read = true + bias + np.sqrt(np.diag(SCATTER)) * rng.normal(size=4)
        joint = correct_state(joint, read, SCATTER, passive=True)
        if t > 600.0:
            error = joint.alpha - true
            errors.append(error)
            squares.append(error @ np.linalg.solve(joint.alpha_covariance, error))
    return np.array(errors), np.array(squares)


def test_one_dither_a_minute_holds_the_shifts_to_a_percent_whatever_the_wind():
    """The bias is 6 % RMS, the dither alone scatters by 0.8 %.

    The bias is smaller than the filter allows for, so its σ is on the safe side.
    """
    errors, squares = zip(*(night(seed, 60.0) for seed in range(6)), strict=True)
    rms = np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))
    assert np.all(rms[:2] < 0.01)
    assert 0.5 < np.mean(np.concatenate(squares)) / 4 < 1.1


class TestAnamorphosis:
    """Two more numbers of α, where they are followed."""

    NOISE = np.diag([*SIGMA, 0.004, 0.003]) ** 2 + 2e-6 * np.outer(*2 * [[1, 1, 0, 0, 1, 0]])
    SEEN = np.array([0.02, -0.01, 0.001, 1.002, 0.018, -0.003])

    def test_a_first_window_and_what_is_expected_are_weighed_by_their_precision(self):
        """Expected is 0 with 2 %; what the window knows together follows as it is correlated."""
        found = expect_stretches(begin_joint(self.SEEN, self.NOISE), np.zeros(2))
        prior = np.diag([0.0, 0.0, 0.0, 0.0, 2500.0, 2500.0])
        precision = np.linalg.inv(self.NOISE)
        expected = np.linalg.solve(precision + prior, precision @ self.SEEN)
        np.testing.assert_allclose(found.mean, expected, rtol=1e-9)
        np.testing.assert_allclose(found.covariance, np.linalg.inv(precision + prior), rtol=1e-7)
        np.testing.assert_array_equal(found.stretches, found.mean[4:])

    def test_one_that_is_followed_from_now_on_is_as_uncertain_as_any(self):
        before = begun(NOWHERE, DITHERED)
        found = with_stretches(before, np.array([0.01, 0.0]))
        assert with_stretches(found, np.ones(2)) is found
        np.testing.assert_array_equal(found.stretches, [0.01, 0.0])
        np.testing.assert_array_equal(found.covariance[4:6, 4:6], 4e-4 * np.eye(2))
        np.testing.assert_array_equal(found.alpha_covariance, before.alpha_covariance)
        np.testing.assert_array_equal(found.offset, before.offset)
        assert np.count_nonzero(found.covariance[4:6, :4]) == 0

    def test_a_window_that_does_not_tell_it_tells_the_four(self):
        prior = expect_stretches(begin_joint(self.SEEN, self.NOISE), np.zeros(2))
        found = correct_state(prior, self.SEEN[:4], DITHERED)
        assert np.all(np.diag(found.covariance) <= np.diag(prior.covariance) + 1e-15)
        assert len(found.mean) == 6

    def test_a_jump_of_the_mirror_leaves_it(self):
        prior = begin_joint(self.SEEN, self.NOISE)
        wider = widen_after_jump(prior, DITHERED)
        np.testing.assert_array_equal(wider.covariance[4:, 4:], prior.covariance[4:, 4:])
        assert np.all(np.diag(wider.covariance)[:4] > 50.0 * np.diag(DITHERED))

    def test_it_walks_far_more_slowly_than_the_mirror(self):
        """1e-4 after a minute, where the magnification drifts by 5e-4."""
        later = predict_state(begin_joint(self.SEEN, 0.0 * self.NOISE), DRIFT, 60.0)
        np.testing.assert_allclose(np.sqrt(np.diag(later.covariance)[4:]), 1e-4)
