from __future__ import annotations

import numpy as np
import pytest

from pyrcal_studies.heritier2018.matrices import (
    column_gains,
    condition,
    correlations,
    noisy_singular_values,
    singular_values,
)
from pyrcal_studies.heritier2018.matrix_figures import slope_maps


def test_gains_of_scaled_columns_are_their_scales() -> None:
    rng = np.random.default_rng(1)
    synthetic = rng.standard_normal((50, 4))
    scales = np.array([1.0, 0.5, -1.0, 2.0])
    assert column_gains(synthetic * scales, synthetic) == pytest.approx(scales)
    assert correlations(synthetic * scales, synthetic) == pytest.approx(np.sign(scales))


def test_the_condition_number_is_largest_over_smallest() -> None:
    assert condition(singular_values(np.diag([8.0, 2.0, 4.0]))) == pytest.approx(4.0)


def test_noise_fills_up_the_smallest_singular_values() -> None:
    matrix = np.eye(200, 20) * np.linspace(10.0, 0.1, 20)
    noise = np.full(20, 0.05)
    noisy = noisy_singular_values(matrix, noise)
    assert condition(noisy) < condition(singular_values(matrix))
    # white noise of 200 rows adds about its own norm to what is orthogonal to it
    assert noisy[-1] == pytest.approx(np.hypot(0.1, 0.05 * np.sqrt(200)), rel=0.25)


def test_maps_put_x_slopes_first_and_leave_the_dark_empty() -> None:
    valid = np.array([[True, False], [True, True]])
    maps = slope_maps(np.arange(6.0), valid)
    assert np.isnan(maps[:, 0, 1]).all()
    assert maps[0][valid].tolist() == [0.0, 1.0, 2.0]
    assert maps[1][valid].tolist() == [3.0, 4.0, 5.0]
