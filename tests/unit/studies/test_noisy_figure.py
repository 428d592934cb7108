"""What the picture of a noisy matrix shows, and what it refuses."""

import sys

import h5py
import numpy as np
import pytest

from pyrcal_studies.noisy_figure import draw, shown_columns
from service.errors import ConfigurationError, MatrixError
from tests.numerics import small_instrument


def test_the_papers_modes_are_shown_where_they_were_dithered():
    """The paper counts from one: its modes 1, 50, 200 and 400 are 0, 49, 199 and 399."""
    assert shown_columns(np.arange(400)) == [0, 49, 199, 399]


def test_other_modes_are_spread_over_all_that_were_dithered():
    assert shown_columns(np.array([501, 511, 521])) == [0, 1, 2]
    assert shown_columns(np.arange(500, 560)) == [0, 20, 39, 59]


def test_a_file_of_something_else_is_refused(tmp_path):
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["interaction_matrix"] = np.zeros((4, 3))
    with pytest.raises(MatrixError, match=r"other.h5: no noisy interaction matrix"):
        draw(path, small_instrument())


def test_a_matrix_of_another_instrument_is_refused(tmp_path):
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        for name in ("interaction_matrix", "synthetic", "element_noise"):
            file[name] = np.ones((4, 3))
        file["optical_gain"] = file["snr"] = np.ones(3)
        file.attrs["modes"] = [0, 1, 2]
    with pytest.raises(MatrixError, match="found 4 slopes, expected"):
        draw(path, small_instrument())


def test_without_matplotlib_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigurationError, match="noisy matrix: needs matplotlib"):
        draw(tmp_path / "none.h5", small_instrument())
