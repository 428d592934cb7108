import numpy as np
import pytest

from pyrcal.fitting.reference import check_reference
from service.errors import MatrixError
from service.estimation.reference import Reference

N_SLOPES, N_MODES = 24, 10


def matrix(n_columns: int = 6) -> np.ndarray:
    return 1e6 * np.random.default_rng(1).normal(size=(N_SLOPES, n_columns))


def check(reference: Reference, **changes):
    about = {"n_slopes": N_SLOPES, "n_modes": N_MODES, "wavelength_m": 750e-9} | changes
    return check_reference(reference, **about)


def test_a_good_matrix_passes_unchanged():
    given = matrix()
    found = check(Reference(matrix=given))
    np.testing.assert_array_equal(found.matrix, given)
    assert found.left_out == ()


def test_dead_and_nan_columns_are_named_and_left_out():
    given = matrix()
    given[3, 2] = np.nan
    given[:, 4] = 0.0
    found = check(Reference(matrix=given, modes=np.array([0, 1, 7, 3, 9, 5])))
    assert list(found.columns) == [0, 1, 3, 5]
    assert found.left_out == ("not finite: mode 7", "dead (no response): mode 9")


def test_a_column_with_a_value_whose_squares_overflow_is_left_out():
    given = matrix()
    given[3, 2] = 1e300
    found = check(Reference(matrix=given))
    assert list(found.columns) == [0, 1, 3, 4, 5]
    assert "not finite: mode 2" in found.left_out


def test_a_transposed_matrix_is_called_transposed():
    with pytest.raises(MatrixError, match="transposed"):
        check(Reference(matrix=matrix().T))


def test_a_matrix_of_another_instrument_is_refused_with_both_shapes():
    with pytest.raises(MatrixError, match=r"\(23, 6\); expected \(24 slopes"):
        check(Reference(matrix=matrix()[1:]))


def test_a_dead_subaperture_costs_its_slopes_and_no_column():
    given = matrix()
    given[3] = np.nan
    given[:, 4] = np.nan
    found = check(Reference(matrix=given))
    assert found.left_out == ("not finite: slope 3", "not finite: mode 4")
    assert not found.matrix[3].any()
    assert found.matrix.shape[1] == given.shape[1] - 1


@pytest.mark.parametrize(("factor", "unit"), [(1e-9, "nanometre"), (1e-6, "micrometre")])
def test_another_unit_than_the_metre_is_named(factor, unit):
    with pytest.raises(MatrixError, match=f"looks like slope per {unit}"):
        check(Reference(matrix=factor * matrix()))


def test_any_unit_will_do_where_the_stroke_is_unknown():
    found = check(Reference(matrix=1e-9 * matrix()), stroke_known=False)
    assert found.matrix.shape == (N_SLOPES, 6)


def test_modes_beyond_the_basis_are_refused():
    with pytest.raises(MatrixError, match="basis has 0 to 9"):
        check(Reference(matrix=matrix(), modes=np.arange(5, 11)))


def test_a_mode_measured_twice_is_refused():
    with pytest.raises(MatrixError, match="twice"):
        check(Reference(matrix=matrix(), modes=np.array([0, 1, 2, 3, 4, 4])))


def test_a_matrix_without_any_answer_is_refused():
    with pytest.raises(MatrixError, match="no usable column among 6"):
        check(Reference(matrix=np.zeros((N_SLOPES, 6))))
