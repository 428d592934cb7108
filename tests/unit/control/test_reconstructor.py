"""From an interaction matrix to a reconstructor."""

from __future__ import annotations

import numpy as np
import pytest

from service.control import reconstructor
from service.control.reconstructor import MAX_CONDITION, invert
from service.errors import ModelError
from tests.numerics import N_MODES, small_linearisation


def with_singular_values(values: list[float], n_slopes: int = 20) -> np.ndarray:
    rng = np.random.default_rng(6)
    left, _ = np.linalg.qr(rng.normal(size=(n_slopes, len(values))))
    right, _ = np.linalg.qr(rng.normal(size=(len(values), len(values))))
    return left * values @ right.T


@pytest.mark.parametrize("n_modes", [1, 10, N_MODES])
def test_the_reconstructor_undoes_the_controlled_modes(n_modes):
    """1e-5: rounded to single precision."""
    matrix = small_linearisation().matrix
    found = invert(matrix, n_modes)
    assert found.matrix.shape == (n_modes, len(matrix))
    np.testing.assert_allclose(found.matrix @ matrix[:, :n_modes], np.eye(n_modes), atol=1e-5)
    assert found.n_truncated == 0


def test_the_reconstructor_is_the_pseudo_inverse():
    matrix = small_linearisation().matrix.astype(float)
    found = invert(matrix, N_MODES).matrix
    expected = np.linalg.pinv(matrix)
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_noise_outside_the_response_of_the_modes_is_ignored():
    matrix = with_singular_values([3.0, 2.0, 1.0])
    slopes = np.random.default_rng(2).normal(size=20)
    outside = slopes - matrix @ np.linalg.lstsq(matrix, slopes, rcond=None)[0]
    np.testing.assert_allclose(invert(matrix, 3).matrix @ outside, 0.0, atol=1e-6)


def test_the_condition_number_is_that_of_the_controlled_columns_before_truncation():
    matrix = with_singular_values([500.0, 100.0, 20.0, 1.0])
    found = invert(matrix, 4)
    assert found.condition_number == pytest.approx(500.0)
    assert found.n_truncated == 1
    assert invert(matrix, 1).condition_number == pytest.approx(1.0)


def test_truncation_drops_what_would_amplify_noise_and_keeps_the_rest():
    """The rest still obeys R D R = R, and is no larger than max_condition allows."""
    matrix = with_singular_values([1.0, 0.5, 0.9 / MAX_CONDITION, 1e-9])
    found = invert(matrix, 4)
    assert found.n_truncated == 2
    assert np.linalg.matrix_rank(found.matrix, tol=1e-3) == 2
    np.testing.assert_allclose(found.matrix @ matrix @ found.matrix, found.matrix, atol=1e-5)
    assert np.linalg.norm(found.matrix, 2) == pytest.approx(2.0, rel=1e-5)


def test_the_limit_of_the_condition_can_be_chosen():
    matrix = with_singular_values([1.0, 0.5, 0.01])
    assert [invert(matrix, 3, max_condition=c).n_truncated for c in (1000.0, 10.0, 1.5)] == [
        0,
        1,
        2,
    ]


def test_many_modes_are_truncated_by_their_eigenvectors_as_fewer_are(monkeypatch):
    """1e-6 of the largest element at a condition of 5000: squares of it lose half of 16 digits."""
    matrix = with_singular_values(list(np.geomspace(1.0, 2e-4, 12)))
    by_svd = invert(matrix, 12)
    monkeypatch.setattr(reconstructor, "_N_MODES_FOR_EIGENVECTORS", 1)
    monkeypatch.setattr(reconstructor, "_SLOPES_PER_BLOCK", 7)
    found = invert(matrix, 12)
    assert found.n_truncated == by_svd.n_truncated == 6
    assert found.condition_number == pytest.approx(by_svd.condition_number, rel=1e-6)
    np.testing.assert_allclose(found.matrix, by_svd.matrix, atol=1e-6 * np.abs(by_svd.matrix).max())


def test_a_mode_that_nobody_sees_leaves_a_condition_that_cannot_be_told(monkeypatch):
    matrix = with_singular_values([3.0, 2.0, 0.0])
    monkeypatch.setattr(reconstructor, "_N_MODES_FOR_EIGENVECTORS", 1)
    found = invert(matrix, 3)
    assert found.n_truncated == 1
    assert found.condition_number > 1e7
    assert np.all(np.isfinite(found.matrix))


def test_what_travels_is_single_precision_row_after_row():
    matrix = invert(small_linearisation().matrix, 10).matrix
    assert matrix.dtype == np.float32
    assert matrix.flags.c_contiguous


@pytest.mark.parametrize(
    ("shape", "n_modes", "text"),
    [
        ((20, 5), 6, r"found 6 modes to control; expected 1 to 5 \(5 modes, 20 slopes\)"),
        ((4, 5), 5, r"expected 1 to 4 \(5 modes, 4 slopes\)"),
        ((20, 5), 0, "found 0 modes to control"),
        ((20, 5), -1, "found -1 modes to control"),
    ],
)
def test_a_number_of_modes_that_cannot_be_controlled_is_refused(shape, n_modes, text):
    with pytest.raises(ModelError, match=text):
        invert(np.ones(shape), n_modes)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_matrix_that_is_not_finite_is_refused(bad):
    matrix = with_singular_values([3.0, 2.0, 1.0])
    matrix[7, 1] = bad
    with pytest.raises(ModelError, match="NaN or Inf"):
        invert(matrix, 3)


def test_a_bad_number_in_a_mode_that_is_not_controlled_does_no_harm():
    matrix = with_singular_values([3.0, 2.0, 1.0])
    matrix[7, 2] = np.nan
    assert np.all(np.isfinite(invert(matrix, 2).matrix))


def test_the_interaction_matrix_is_left_alone():
    matrix = with_singular_values([3.0, 2.0, 1.0])
    before = matrix.copy()
    invert(matrix, 3)
    np.testing.assert_array_equal(matrix, before)
