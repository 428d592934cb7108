"""How precise windows of dither are: by table, then as measured."""

from __future__ import annotations

import numpy as np
import pytest

from service.control.dither import (
    PRECISION_RATIO_RANGE,
    PRECISION_TABLE,
    TABLE_MAGNITUDES,
    compute_precision_ratio,
    look_up_precision,
    update_mean_ratio,
)


@pytest.mark.parametrize("row", range(3))
def test_the_table_is_met_at_its_own_magnitudes(row):
    np.testing.assert_allclose(look_up_precision(TABLE_MAGNITUDES[row]), PRECISION_TABLE[row])


def test_between_two_magnitudes_it_is_their_geometric_mean():
    np.testing.assert_allclose(
        look_up_precision(8.5), np.sqrt(PRECISION_TABLE[0] * PRECISION_TABLE[1])
    )


def test_the_brightest_are_no_better_than_the_table_and_fainter_ones_worse():
    np.testing.assert_allclose(look_up_precision(3.0), PRECISION_TABLE[0])
    np.testing.assert_allclose(
        look_up_precision(15.0), PRECISION_TABLE[2] ** 2 / PRECISION_TABLE[1]
    )


def test_an_unknown_star_is_taken_for_a_faint_one():
    np.testing.assert_allclose(look_up_precision(None), PRECISION_TABLE[2])


def test_a_window_of_the_tables_own_precision_has_the_ratio_one():
    """σ = κ / (A sqrt(T)): 4 nm for 25 s is 20 times the precision of 1 nm for 1 s."""
    sigma = look_up_precision(10.0) / (4e-9 * 5.0)
    ratio = compute_precision_ratio(np.diag(sigma**2), 4e-9, 25.0, 10.0)
    np.testing.assert_allclose(ratio, 1.0)
    ratio = compute_precision_ratio(np.diag(4.0 * sigma**2), 4e-9, 25.0, 10.0)
    np.testing.assert_allclose(ratio, 2.0)


def test_a_window_beyond_belief_counts_as_the_edge_of_belief():
    ratio = compute_precision_ratio(np.diag([1e6, 1e-30, 1.0, 1.0]), 1e-9, 1.0, 10.0)
    assert (ratio[0], ratio[1]) == (PRECISION_RATIO_RANGE[1], PRECISION_RATIO_RANGE[0])


def test_the_first_window_is_believed_and_a_change_after_a_dozen():
    mean = None
    for number in range(20):
        mean = update_mean_ratio(mean, number, np.full(4, 0.5))
    np.testing.assert_allclose(mean, 0.5)
    for number in range(20, 36):
        mean = update_mean_ratio(mean, number, np.full(4, 2.0))
    # (7/8)^16 = 12 % of the mean square is still the old one
    np.testing.assert_allclose(mean, np.sqrt(0.118 * 0.25 + 0.882 * 4.0), rtol=1e-2)
