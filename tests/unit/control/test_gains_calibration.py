"""Calibration gains and passes, each in its place."""

from __future__ import annotations

import numpy as np
import pytest

from service.control.gains import CalibrationGains
from service.control.reconstructor import invert
from service.errors import ModelError
from tests.support.numerics import N_MODES, small_linearisation

MATRIX = small_linearisation().matrix


def gains_of(values, modes=None, n_basis=N_MODES):
    values = np.asarray(values, dtype=float)
    modes = np.arange(len(values)) if modes is None else np.asarray(modes)
    return CalibrationGains.of_modes(values, modes, n_basis)


def test_a_tuned_matrix_has_each_column_times_its_gain():
    values = np.linspace(0.9, 1.1, N_MODES)
    tuned = gains_of(values).tuned(MATRIX)
    np.testing.assert_allclose(tuned[:, 7], MATRIX[:, 7] * values[7], rtol=1e-6)
    assert tuned.dtype == MATRIX.dtype


def test_tuning_the_columns_divides_the_rows_of_the_reconstructor():
    """R of D diag(g) is diag(1/g) R of D: a stroke too large is commanded too small."""
    values = np.linspace(0.9, 1.1, N_MODES)
    tuned = invert(gains_of(values).tuned(MATRIX), N_MODES).matrix
    plain = invert(MATRIX, N_MODES).matrix
    scale = 1e-4 * np.abs(plain).max()
    np.testing.assert_allclose(tuned, plain / values[:, None], atol=scale)


def test_modes_beyond_the_reference_take_the_median_of_the_last_measured_ones():
    values = np.concatenate([np.full(5, 2.0), np.full(25, 1.1)])
    found = gains_of(values)
    np.testing.assert_allclose(found.values[30:], 1.1)
    np.testing.assert_array_equal(found.measured, np.arange(N_MODES) < 30)


def test_one_wild_gain_does_not_spread():
    values = np.full(30, 1.0)
    values[29] = 5.0
    assert gains_of(values).values[35] == pytest.approx(1.0)


def test_modes_may_come_in_any_order_and_with_gaps():
    found = gains_of([3.0, 1.0, 2.0], modes=[9, 4, 6])
    assert found.values[[4, 6, 9]].tolist() == [1.0, 2.0, 3.0]
    assert found.values[5] == pytest.approx(2.0)  # the median of the three
    assert np.flatnonzero(found.measured).tolist() == [4, 6, 9]


@pytest.mark.parametrize(
    ("values", "modes", "text"),
    [
        ([1.0, 1.0], [3], "2 gains for 1 modes"),
        ([1.0, 1.0], [3, 3], "every mode once"),
        ([], [], "0 gains for 0 modes"),
        ([1.0, 1.0], [3, 40], "expected modes of the basis, 0 to 39"),
        ([1.0, -1.0], [3, 4], "not a positive number"),
        ([1.0, np.nan], [3, 4], "not a positive number"),
    ],
)
def test_gains_that_cannot_be_are_refused(values, modes, text):
    with pytest.raises(ModelError, match=text):
        gains_of(values, modes=np.array(modes, dtype=int))


def test_more_columns_than_the_gains_know_are_refused():
    with pytest.raises(ModelError, match="found 40 modes to tune; the gains know 30"):
        gains_of(np.ones(10), n_basis=30).tuned(MATRIX)
