"""Files that claim what cannot be: refused in a moment, with what was found."""

import gzip
import time
from contextlib import suppress

import h5py
import numpy as np
import pytest

from pyrcal.fitting.recorded import check_sealed
from service.errors import MatrixError
from service.files import container
from service.files.container import opened
from tests.support.forged import TWO_BY_THREE, fits_bytes

AT_ONCE_S = 2.0
"""Of processor time: astropy's import takes a quarter of it."""


def refusal(path, look=None):
    began_s = time.process_time()
    with pytest.raises(MatrixError) as caught:
        look(path) if look else opened(path).__enter__()
    assert time.process_time() - began_s < AT_ONCE_S
    text = str(caught.value)
    assert str(path) in text
    assert "\n" not in text
    return text


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    "changes",
    [
        {"NAXIS": 1, "NAXIS1": -360, "NAXIS2": None},
        {"NAXIS1": -3},
        {"NAXIS": 999},
        {"NAXIS": "'two'"},
        {"NAXIS2": "2.5"},
        {"NAXIS2": None},
        {"NAXIS2": 2**40},
        {"NAXIS2": "9" * 30},
        {"GCOUNT": -5},
        {"PCOUNT": -(10**9)},
        {"BITPIX": 7},
        {"BITPIX": None},
    ],
)
def test_a_fits_header_that_claims_what_cannot_be_is_refused(tmp_path, changes, packed):
    path = tmp_path / "claims.fits"
    content = fits_bytes(TWO_BY_THREE | changes)
    path.write_bytes(gzip.compress(content) if packed else content)
    refusal(path, read_all)


def read_all(path):
    with opened(path) as file:
        for array in file.arrays.values():
            array.read()


def test_a_number_that_is_told_twice_ends_in_a_moment(tmp_path):
    path = tmp_path / "twice.fits"
    content = bytearray(fits_bytes(TWO_BY_THREE))
    place = content.index(b"COMMENT")
    content[place : place + 80] = b"NAXIS1  =                 -360".ljust(80)
    path.write_bytes(content)
    began_s = time.process_time()
    with suppress(MatrixError):
        read_all(path)
    assert time.process_time() - began_s < AT_ONCE_S


def test_a_header_that_does_not_end_is_refused(tmp_path):
    path = tmp_path / "endless.fits"
    content = fits_bytes(TWO_BY_THREE).replace(b"END".ljust(80), b"COMMENT".ljust(80))
    path.write_bytes(content + b" " * 4 * 2880)
    refusal(path)


def test_a_file_of_too_many_parts_is_refused(tmp_path):
    path = tmp_path / "parts.fits"
    head = fits_bytes({"BITPIX": 8, "NAXIS": 0}).replace(b"SIMPLE  =", b"XTENSION=")[:2880]
    path.write_bytes(fits_bytes(TWO_BY_THREE) + head * 1001)
    assert "more than 1000 parts" in refusal(path)


def test_an_honest_file_is_read_as_it_was(tmp_path):
    path = tmp_path / "honest.fits"
    path.write_bytes(fits_bytes(TWO_BY_THREE) + b"what follows the last part")
    with opened(path) as file:
        assert file.find("0").shape == (2, 3)
        assert file.find("0").numbers().sum() == 0.0


# --- HDF5


@pytest.fixture
def deep(tmp_path):
    path = tmp_path / "deep.h5"
    with h5py.File(path, "w") as file:
        group = file
        for _ in range(3000):
            group = group.create_group("g")
        group["interaction_matrix"] = np.ones((2, 2))
    return path


def test_groups_within_each_other_are_followed_so_far_and_no_further(deep):
    assert "more than 32 groups within each other" in refusal(deep)


def test_too_many_things_are_not_looked_at_one_by_one(tmp_path, monkeypatch):
    monkeypatch.setattr(container, "MAX_OBJECTS", 50)
    path = tmp_path / "wide.h5"
    with h5py.File(path, "w") as file:
        for k in range(60):
            file[f"d{k}"] = h5py.SoftLink("/nowhere")
    expected = "more than 50 groups, datasets or links"
    assert expected in refusal(path)
    assert expected in refusal(path, check_sealed)
    with h5py.File(path, "w") as file:
        for k in range(60):
            file.attrs[f"a{k}"] = k
    assert "60 attributes, expected at most 50" in refusal(path)


def test_an_object_of_two_names_is_listed_once(tmp_path):
    path = tmp_path / "two.h5"
    with h5py.File(path, "w") as file:
        file["a/b/c"] = np.ones(3)
        file["z"] = np.ones(2)
        file["a/again"] = file["/a"]
        file["y"] = h5py.SoftLink("/z")
    with opened(path) as read:
        assert list(read.arrays) == ["z", "a/b/c"]
