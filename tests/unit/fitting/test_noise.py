"""Noise told from structure by singular values."""

import numpy as np
import pytest

from pyrcal.fitting.noise import measure_structure, noise_sigma

RNG = np.random.default_rng(4)


def low_rank(shape: tuple[int, int], rank: int) -> np.ndarray:
    left, right = RNG.normal(size=(shape[0], rank)), RNG.normal(size=(rank, shape[1]))
    return left @ right / np.sqrt(rank)


@pytest.mark.parametrize("shape", [(224, 137), (1408, 400), (300, 300), (224, 40)])
def test_the_size_of_noise_is_found_beside_what_is_no_noise(shape):
    noise = 0.3 * RNG.normal(size=shape)
    assert noise_sigma(noise) == pytest.approx(0.3, rel=0.03)
    assert noise_sigma(noise + low_rank(shape, 4)) == pytest.approx(0.3, rel=0.1)


def test_only_what_is_no_noise_counts():
    shape, power = (600, 200), np.full(200, 600.0)
    noise, wrong = 0.3 * RNG.normal(size=shape), 0.15 * low_rank(shape, 10)
    assert measure_structure(noise, power, None) < 0.05
    assert measure_structure(noise + wrong, power, None) == pytest.approx(0.15, abs=0.03)


def test_noise_that_is_alike_in_slopes_counts_in_columns_of_all_sizes():
    power = 600.0 * np.geomspace(0.02, 1.0, 200)
    noise = 0.1 * RNG.normal(size=(600, 200))
    share = np.sqrt(np.mean(np.sum(noise**2, axis=0) / power))
    assert measure_structure(noise, power, None) < 0.3 * share


def test_noise_that_was_measured_does_not_count_either():
    power, noise = np.full(200, 600.0), np.full(200, 0.2)
    wrong = 0.2 * low_rank((600, 200), 10)
    assert measure_structure(wrong, power, None) == pytest.approx(0.2, abs=0.02)
    assert measure_structure(wrong, power, noise) < 0.06
