"""How noisy a slope is."""

from __future__ import annotations

import numpy as np
import pytest

from service.control.expected_gain import noise_of_star
from service.errors import ModelError
from service.model.interaction import reference_slopes
from studies.slope_noise import noise_of_counts
from tests.numerics import small_instrument

VALID = np.ones((6, 6), dtype=bool)
VALID[0, 0] = False


def test_the_noise_of_counts_is_that_of_slopes_made_of_them():
    """3 %: 2000 frames, σ known to 1.6 % each, 70 slopes."""
    rng = np.random.default_rng(1)
    counts = rng.uniform(200.0, 900.0, size=(4, 6, 6))
    frames = []
    for _ in range(2000):
        seen = rng.poisson(counts) + 10.0 * rng.normal(size=counts.shape)
        frames.append(reference_slopes(seen.reshape(2, 2, 6, 6).transpose(0, 2, 1, 3), VALID)[0])
    expected = np.std(frames, axis=0)
    ratio = noise_of_counts(counts, VALID, read_noise_electrons=10.0) / expected
    assert np.median(ratio) == pytest.approx(1.0, abs=0.01)
    assert np.abs(ratio - 1.0).max() < 0.08


def test_excess_noise_multiplies_the_variance_of_bright_light():
    counts = np.full((4, 6, 6), 1e4)
    plain = noise_of_counts(counts, VALID, read_noise_electrons=0.0)
    excess = noise_of_counts(counts, VALID, read_noise_electrons=0.0, excess_noise=2.0)
    np.testing.assert_allclose(excess, np.sqrt(2.0) * plain)
    np.testing.assert_allclose(plain, 1 / np.sqrt(4e4))


def test_a_bright_star_has_photon_noise_and_a_faint_one_four_reads_besides():
    bright, dimmer, faint = (
        noise_of_star(small_instrument(), magnitude=m, frame_rate_hz=1000.0, n_valid=100)
        for m in (-5.0, 0.0, 12.5)
    )
    assert dimmer == pytest.approx(10.0 * bright, rel=1e-3)
    electrons = bright**-2.0 * 10.0**-7.0
    assert faint == pytest.approx(np.sqrt(electrons + 4 * 4.0**2) / electrons, rel=1e-3)


def test_what_tells_nothing_of_noise_is_refused():
    with pytest.raises(ModelError, match=r"found counts \(4, 5, 5\); expected \(4, 6, 6\)"):
        noise_of_counts(np.ones((4, 5, 5)), VALID)
    with pytest.raises(ModelError, match="found 0 electrons"):
        noise_of_counts(np.zeros((4, 6, 6)), VALID)
