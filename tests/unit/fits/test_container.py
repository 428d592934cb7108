import gzip
import sys

import h5py
import numpy as np
import pytest

from service.errors import MatrixError
from service.fits import container
from service.fits.container import opened

VALUES = np.arange(6.0).reshape(2, 3)


@pytest.fixture
def hdf5(tmp_path):
    path = tmp_path / "some.h5"
    with h5py.File(path, "w") as file:
        file["measured/D"] = VALUES
        file["big"] = VALUES.astype(">f4")
        file["name"] = "not a number"
        file.attrs["double_pass"] = True
    return path


def numbers(path, name):
    with opened(path) as file:
        return file.find(name).numbers()


def refused(path, name="x"):
    with pytest.raises(MatrixError) as error:
        numbers(path, name)
    text = str(error.value)
    assert str(path) in text
    assert "\n" not in text
    return text


def test_an_array_is_found_with_or_without_its_first_slash(hdf5):
    assert np.array_equal(numbers(hdf5, "/measured/D"), VALUES)
    assert np.array_equal(numbers(hdf5, "measured/D"), VALUES)


def test_big_endian_numbers_come_out_native(hdf5):
    found = numbers(hdf5, "big")
    assert found.dtype == np.float64
    assert found.dtype.isnative
    assert np.array_equal(found, VALUES)


def test_what_is_in_a_file_is_listed_with_its_shape(hdf5):
    with opened(hdf5) as file:
        assert "measured/D (2, 3)" in file.listing()
        assert file.find("interaction_matrix") is None
        assert file.find("MEASURED/D") is None, "HDF5 tells capitals apart"
        assert file.facts["double_pass"]


def test_a_link_is_followed(hdf5):
    with h5py.File(hdf5, "a") as file:
        file["interaction_matrix"] = h5py.SoftLink("/measured/D")
    assert np.array_equal(numbers(hdf5, "interaction_matrix"), VALUES)


def test_text_is_no_matrix(hdf5):
    assert "expected real numbers" in refused(hdf5, "name")


def test_an_array_too_large_for_memory_is_not_read(hdf5, monkeypatch):
    monkeypatch.setattr(container, "MOST_BYTES", 40)
    assert "found shape (2, 3)" in refused(hdf5, "big")


def test_a_missing_file_is_said(tmp_path):
    assert "No such file" in refused(tmp_path / "none.h5")


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"", "an empty file"),
        (b"\x93NUMPY\x01\x00v", "a NumPy file"),
        (b"MATLAB 5.0 MAT-file", "a MATLAB file"),
        (b"shift,rotation\n", "something else"),
    ],
)
def test_another_kind_of_file_is_named(tmp_path, content, kind):
    path = tmp_path / "matrix.h5"
    path.write_bytes(content)
    text = refused(path)
    assert kind in text
    assert "expected an HDF5 or a FITS file" in text


def test_a_truncated_hdf5_file_is_damaged(hdf5, tmp_path):
    path = tmp_path / "half.h5"
    path.write_bytes(hdf5.read_bytes()[: hdf5.stat().st_size // 2])
    assert "damaged" in refused(path)


@pytest.fixture
def fits_file(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    path = tmp_path / "some.fits"
    fits.HDUList(
        [
            fits.PrimaryHDU(VALUES.astype(">f4")),
            fits.ImageHDU(np.array([3, 4, 5], dtype=np.int16), name="MODES"),
            fits.ImageHDU(VALUES + 1.0),
            fits.CompImageHDU(np.ones((20, 30), dtype=np.float32), name="packed"),
        ]
    ).writeto(path)
    with fits.open(path, mode="update") as file:
        file[0].header["DBLPASS"] = True
    return path


def test_fits_images_are_found_by_name_in_any_case_or_by_number(fits_file):
    assert np.array_equal(numbers(fits_file, "0"), VALUES)
    assert np.array_equal(numbers(fits_file, "modes"), [3.0, 4.0, 5.0])
    assert np.array_equal(numbers(fits_file, "2"), VALUES + 1.0)
    assert numbers(fits_file, "PACKED").shape == (20, 30)
    with opened(fits_file) as file:
        assert file.facts["dblpass"] is True


def test_a_compressed_fits_file_is_read_too(fits_file, tmp_path):
    path = tmp_path / "some.fits.gz"
    path.write_bytes(gzip.compress(fits_file.read_bytes()))
    assert np.array_equal(numbers(path, "0"), VALUES)


def test_a_truncated_fits_file_is_damaged(fits_file, tmp_path):
    path = tmp_path / "half.fits"
    path.write_bytes(fits_file.read_bytes()[:2900])
    assert "damaged" in refused(path, "0")


def test_without_astropy_it_says_what_to_install(fits_file, monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy.io", None)
    assert "extra 'fits'" in refused(fits_file, "0")
