from __future__ import annotations

import numpy as np
import pytest

from pyrcal_studies.heritier2018 import paper
from pyrcal_studies.heritier2018.simulator import optimum
from pyrcal_studies.heritier2018.table2 import columns_by_part_nm, order_word, shares_nm


def test_the_papers_table_is_quoted_row_by_row() -> None:
    rows = {row.name: row.errors_nm for row in paper.TABLE_2.values()}
    assert rows == {
        "PSIM, 400 modes": (195.0, 41.7, 30.1),
        "LBT, 400 modes": (216.0, 42.1, 30.8),
        "PSIM, 500 modes": (228.3, 42.5, 27.39),
    }
    assert paper.SIMULATED_SYNTHETIC.values < paper.SIMULATED_MEASURED.values
    assert paper.CONDITION_SYNTHETIC.values < paper.CONDITION_MEASURED.values


def test_shares_of_columns_add_up_in_quadrature() -> None:
    shares = shares_nm(np.array([[13.0, 5.0, 3.0]]))[0]
    assert shares == pytest.approx([12.0, 4.0, 3.0])
    assert np.sqrt((shares**2).sum()) == pytest.approx(13.0)


def test_the_first_column_of_the_papers_table_is_tip_and_tilt() -> None:
    for row in paper.TABLE_2.values():
        tilt, _, _ = shares_nm(np.array(row.errors_nm))
        assert tilt**2 > 0.95 * row.errors_nm[0] ** 2


def test_an_order_counts_only_where_every_telescope_has_it() -> None:
    assert order_word(np.array([0.1, 2.0]), 0.4) == "same"
    assert order_word(np.array([-0.1, -2.0]), 0.4) == "other way"
    assert order_word(np.array([-0.1, 2.0]), 0.4) == "either way"
    assert order_word(np.array([-0.1, -2.0]), -0.4) == "same"


def test_parts_of_a_loop_have_columns_of_their_own() -> None:
    modal = np.zeros((2, 60))
    modal[0, 0], modal[1, 52], modal[1, 59] = 9.0, 16.0, 100.0
    columns = columns_by_part_nm({"modal_by_part_nm2": modal, "slopes_nm2": np.zeros(55)})
    assert columns == pytest.approx(np.array([[3.0, 0.0, 0.0], [4.0, 4.0, 4.0]]))


def test_the_optimum_of_a_sweep_is_that_of_its_parabola() -> None:
    values = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    assert optimum(values, 3.0 * (values - 0.5) ** 2 + 7.0) == pytest.approx(0.5)
    assert optimum(values, -(values**2)) is None
