"""How noisy a slope is."""

from __future__ import annotations

import numpy as np
import pytest

from service.control.expected_gain import estimate_slope_noise
from tests.numerics import small_instrument


def test_a_bright_star_has_photon_noise_and_a_faint_one_four_reads_besides():
    bright, dimmer, faint = (
        estimate_slope_noise(small_instrument(), magnitude=m, frame_rate_hz=1000.0, n_valid=100)
        for m in (-5.0, 0.0, 12.5)
    )
    assert dimmer == pytest.approx(10.0 * bright, rel=1e-3)
    electrons = bright**-2.0 * 10.0**-7.0
    assert faint == pytest.approx(np.sqrt(electrons + 4 * 4.0**2) / electrons, rel=1e-3)
